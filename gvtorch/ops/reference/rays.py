"""Part of the torch twin: rays in tree units and their fixed intervals, as in csrc/walk/ray.h."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from ...base.constants import DEEP_VOXELS, MAX_INTERVALS
from ..arguments import RayArguments, TraceArguments
from .exact import clamp, divide, larger, smaller

INF = math.inf


@dataclass
class Rows:
    """Base of dataclasses whose tensors, but not those in other records, have one row per ray."""

    def __getitem__(self, index: Tensor) -> Self:
        """Returns the rows of some rays."""
        rows = {n: f[index] for n, f in vars(self).items() if isinstance(f, (Tensor, Rows))}
        return replace(self, **rows)

    def index_put(self, index: tuple[Tensor], rows: Self) -> Self:
        """Returns a copy with the rows of some rays replaced."""
        own_fields = vars(self).items()
        return replace(
            self, **{name: row.index_put(index, vars(rows)[name]) for name, row in own_fields}
        )


class SceneBox(NamedTuple):
    """The part of the root cube that holds the scene, in tree units; its low corner is 0."""

    high: Tensor  # (3,) float64 corner
    last: Tensor  # (3,) float64 largest coordinates of positions inside
    deep: bool  # see `is_deep`


@dataclass
class Beam(Rows):
    """Rays in tree units that start where they enter the scene; distances stay world lengths."""

    scene: SceneBox
    origin: Tensor  # (r, 3)
    exact_origin: Tensor  # (r, 3) float64; more exact than `origin` only where the tree is deep
    direction: Tensor  # (r, 3)
    cone_near: Tensor  # (r,)
    cone_growth: Tensor  # (r,)
    first: Tensor  # (r,)
    last: Tensor  # (r,)
    moved: Tensor  # (r,) distance from the camera to the origin

    @classmethod
    def enter(cls, rays: RayArguments, args: TraceArguments, real: torch.dtype) -> Beam:
        """Transforms world rays to tree units in float64, then rounds them to `real`."""
        corner, size, high = args.place_33
        high = high.nan_to_num(0.0).clamp(0, 1)  # keeps a caller's scene inside the root cube
        origin, direction = (rays.origin_r3 - corner) / size, rays.direction_r3 / size
        low_t, high_t = -origin / direction, (high - origin) / direction
        entry = torch.full_like(origin[:, 0], -INF)
        for axis in range(3):
            axis_entry = larger(entry, smaller(low_t[:, axis], high_t[:, axis]))
            entry = torch.where(direction[:, axis] != 0, axis_entry, entry)
        moved = torch.where((entry > 0) & (entry < INF), entry, 0.0)
        near_cone, growth = (rays.cone_r2 * args.cone_scale).unbind(1)
        high_real, deep = high.to(real), is_deep(args)
        last_real = (high_real * (1 - 2.0**-23)).double()
        scene = SceneBox(high, high * (1 - 2.0**-50) if deep else last_real, deep)
        columns = (
            direction,
            near_cone + growth * moved,
            growth,
            rays.range_r2[:, 0] - moved,
            rays.range_r2[:, 1] - moved,
            moved,
        )
        real_direction, *numbers = (column.to(real) for column in columns)
        start = rounded(origin + moved[:, None] * direction, deep, real)
        beam = cls(scene, *start, real_direction, *numbers).clipped()
        seen = torch.isfinite(origin + direction).all(1) & (direction != 0).any(1)
        return replace(beam, last=torch.where(seen, beam.last, beam.first))

    def clipped(self) -> Beam:
        """Returns the rays with distances clipped to the scene (slab test, Kay and Kajiya, 1986). A
        ray that no face bounds, or whose cone is NaN, gets an empty range.
        """
        first, last, direction = self.first, self.last, self.direction
        position, high = self.exact_origin, self.scene.high
        a, b = -self.origin / direction, (high - position).to(direction) / direction
        parallel_r3 = direction == 0
        outside_r3 = parallel_r3 & ~((position >= 0) & (position <= high))
        columns_r3 = (smaller(a, b), larger(a, b), parallel_r3, outside_r3)
        for near, far, parallel, outside in zip(*(c.unbind(1) for c in columns_r3), strict=True):
            last = torch.where(outside, first, last)
            first = torch.where(parallel, first, larger(first, near))
            last = torch.where(parallel, last, smaller(last, far))
        is_cone = (self.cone_near == self.cone_near) & (self.cone_growth == self.cone_growth)
        return replace(self, first=first, last=torch.where(is_cone & (last < INF), last, first))

    def cone(self, t: Tensor) -> Tensor:
        """Returns (r,) world widths of the cones at distances t (r,)."""
        return self.cone_near + self.cone_growth * t

    def along(self, t: Tensor) -> Tensor:
        """Returns (r, 3) float64 positions at distances t (r,), computed in float64 if deep."""
        if self.scene.deep:
            return self.exact_origin + t[:, None].double() * self.direction.double()
        return (self.origin + t[:, None] * self.direction).double()

    def at(self, t: Tensor) -> Tensor:
        """Returns the positions of `along`, clamped into the scene; its high faces belong to it."""
        return clamp(self.along(t), 0, self.scene.last)

    def leave(self, low: Tensor, high: Tensor) -> Tensor:
        """Returns (r,) distances at which rays leave float64 boxes; +inf for a direction of 0."""
        face = torch.where(self.direction > 0, high, low)
        inverse = divide(1.0, self.direction, self.direction)
        distance = (face - self.exact_origin).to(self.direction)
        x, y, z = torch.where(self.direction == 0, INF, distance * inverse).unbind(1)
        return smaller(smaller(smaller(torch.full_like(x, INF), x), y), z)


def is_deep(args: TraceArguments) -> bool:
    """Returns whether positions are computed in float64: where the root cube has more than 2^18
    voxels a side, or N is no power of two, so that float32 can't hold corners of nodes.
    """
    brick_size = args.bricks_bzyxc.shape[1] - 2 * args.border
    is_power = args.branching & (args.branching - 1) == 0
    return not is_power or brick_size * args.branching**args.max_depth > DEEP_VOXELS


def rounded(position: Tensor, deep: bool, real: torch.dtype) -> tuple[Tensor, Tensor]:
    """Rounds float64 positions (r, 3) to numbers of dtype `real`, and also, if `deep`, to sums of
    two such numbers: the rounded ones and what rounding took away. Returns both, sums in float64.
    """
    origin = position.to(real)
    exact = origin.double()
    return origin, exact + (position - exact).to(real).double() if deep else exact


class Intervals:
    """Each ray's position in its fixed sequence of intervals. An interval is step * 2^level long,
    the longest that is not longer than the cone is wide where it starts. See ray.h.
    """

    def __init__(self, beam: Beam, step: float | Tensor, levels: int) -> None:
        first = beam.first
        length = [torch.as_tensor(step, dtype=first.dtype, device=first.device)]
        for _ in range(levels - 1):
            length.append(length[-1] + length[-1])
        self.beam, self.start = beam, first
        self.length_l = torch.stack(length)  # (l,) world units
        self.level = torch.zeros_like(first, dtype=torch.int64)
        self.base = first  # (r,) where the level was chosen
        self.count = torch.zeros_like(first)  # intervals since base
        self.length = self.length_l[self.level]
        self._choose_level(torch.ones_like(first, dtype=torch.bool))

    @property
    def state(self) -> Tensor:
        """(r, 3) base, count and level, for `resume`."""
        return torch.stack((self.base, self.count, self.level.to(self.base)), 1)

    def resume(self, state_r3: Tensor) -> None:
        """Continues from an earlier `state`."""
        self.base, self.count, level = state_r3.unbind(1)
        self.level = clamp(level, 0, len(self.length_l) - 1).to(torch.int64)
        self.start = self.base + self.count * self.length_l[self.level]
        self._update()

    def inside(self) -> Tensor:
        """Returns (r,) bool: the interval starts before the far side."""
        return self.start < self.beam.last

    def next(self, mask: Tensor) -> None:
        """Moves to the next interval where `mask` (r,) is true."""
        self.count = torch.where(mask, self.count + 1, self.count)
        self.start = torch.where(mask, self.whole_end, self.start)
        self._choose_level(mask)

    def _choose_level(self, mask: Tensor) -> None:
        width, top = self.beam.cone(self.start), len(self.length_l) - 1
        too_long = (self.level > 0) & (width < self.length)
        too_short = (self.level < top) & (width >= self.length + self.length)
        full = self.count >= MAX_INTERVALS  # as many as are counted from one base
        changes = mask & (full | too_long | too_short)
        if changes.any():
            stuck = changes & full & ~(self.start > self.base)
            self.start = torch.where(stuck, self.beam.last, self.start)
            self.base = torch.where(changes, self.start, self.base)
            self.count = torch.where(changes, 0.0, self.count)
            level = (width[:, None] >= self.length_l[1:]).sum(1)
            self.level = torch.where(changes, level, self.level)
        self._update()

    def _update(self) -> None:
        """Works out the places of the interval, given its level, base and count."""
        self.length = self.length_l[self.level]  # (r,) of whole intervals
        self.whole_end = self.base + (self.count + 1) * self.length  # (r,) where the next starts
        self.cut = ~(self.whole_end <= self.beam.last)  # (r,) bool: cut at the far side
        cut_middle = self.start + (self.beam.last - self.start) * 0.5
        middle = self.base + (self.count + 0.5) * self.length
        self.middle = torch.where(self.cut, cut_middle, middle)  # (r,) where values are sampled
