"""Part of the reference: rays in tree units and their fixed intervals, as csrc/ray.h."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .exact import clamp, divide, larger, smaller

INF = math.inf


@dataclass
class Beam:
    """Rays in tree units, begun where they enter the scene; distances stay world lengths."""

    origin: Tensor  # (r, 3)
    direction: Tensor  # (r, 3)
    high: Tensor  # (3,) corner of the scene; its low corner is 0
    cone_near: Tensor  # (r,)
    cone_growth: Tensor  # (r,)
    first: Tensor  # (r,)
    last: Tensor  # (r,)
    moved: Tensor  # (r,) distance from the camera to the origin

    @classmethod
    def enter(
        cls,
        origin_r3: Tensor,
        direction_r3: Tensor,
        cone_r2: Tensor,
        range_r2: Tensor,
        place_33: Tensor,
        cone_scale: float,
        real: torch.dtype,
    ) -> Beam:
        """Brings world rays into the tree in float64, then rounds them to `real`."""
        corner, size, high = place_33
        origin, direction = (origin_r3 - corner) / size, direction_r3 / size
        low_t, high_t = -origin / direction, (high - origin) / direction
        near = torch.full_like(origin[:, 0], -INF)
        for axis in range(3):
            entry = larger(near, smaller(low_t[:, axis], high_t[:, axis]))
            near = torch.where(direction[:, axis] != 0, entry, near)
        moved = torch.where((near > 0) & (near < INF), near, 0.0)
        growth = cone_r2[:, 1] * cone_scale
        columns = (
            origin + moved[:, None] * direction,
            direction,
            high,
            cone_r2[:, 0] * cone_scale + growth * moved,
            growth,
            range_r2[:, 0] - moved,
            range_r2[:, 1] - moved,
            moved,
        )
        beam = cls(*(column.to(real) for column in columns))
        beam.clip()
        return beam

    def clip(self) -> None:
        """Cuts the distances at the scene (slab test, Kay and Kajiya, 1986); what no face bounds is
        closed.
        """
        first, last = self.first, self.last
        for axis in range(3):
            origin, direction = self.origin[:, axis], self.direction[:, axis]
            a, b = -origin / direction, (self.high[axis] - origin) / direction
            flat = direction == 0
            beside = flat & ~((origin >= 0) & (origin <= self.high[axis]))
            last = torch.where(beside, first, last)
            first = torch.where(flat, first, larger(first, smaller(a, b)))
            last = torch.where(flat, last, smaller(last, larger(a, b)))
        self.first, self.last = first, torch.where(last < INF, last, first)

    def at(self, which: Tensor, t: Tensor) -> Tensor:
        """(k, 3) places of some rays inside the root cube: a place on the scene's high face belongs
        to the scene.
        """
        inside = self.high * torch.tensor(0.9999999).to(self.high)
        return clamp(self.origin[which] + t[:, None] * self.direction[which], 0, inside)

    def leave(self, which: Tensor, corner: Tensor, size: Tensor) -> Tensor:
        """(k,) distances at which some rays leave boxes (+inf without a direction)."""
        origin, direction = self.origin[which], self.direction[which]
        face = torch.where(direction > 0, corner + size[:, None], corner)
        inverse = divide(1.0, direction, direction)
        t = torch.where(direction == 0, INF, (face - origin) * inverse)
        inf = torch.full_like(size, INF)
        return smaller(smaller(smaller(inf, t[:, 0]), t[:, 1]), t[:, 2])


_MOST_INTERVALS = 2**23  # counted in a float32


@dataclass
class Intervals:
    """Where each ray stands in its fixed sequence of intervals, which are step * 2^level long, the
    longest not longer than the cone is wide where they start. See ray.h.
    """

    near: Tensor  # (r,) cone, world units
    growth: Tensor  # (r,) per world unit
    stop: Tensor  # (r,) world units
    length_l: Tensor  # (l,) world units
    level: Tensor  # (r,) int64
    base: Tensor  # (r,) where the level was chosen
    count: Tensor  # (r,) intervals since base, as a float
    start: Tensor  # (r,)

    @classmethod
    def begin(cls, beam: Beam, step: float, levels: int) -> Intervals:
        """Stands at the first interval of every ray."""
        first = beam.first
        length = [torch.tensor(step, dtype=first.dtype).to(first)]
        for _ in range(levels - 1):
            length.append(length[-1] + length[-1])
        level, count = torch.zeros_like(first, dtype=torch.int64), torch.zeros_like(first)
        lengths = torch.stack(length)
        at = cls(beam.cone_near, beam.cone_growth, beam.last, lengths, level, first, count, first)
        at._choose_level(torch.ones_like(first, dtype=torch.bool))
        return at

    @property
    def length(self) -> Tensor:
        """(r,) of whole intervals."""
        return self.length_l[self.level]

    @property
    def whole_end(self) -> Tensor:
        """(r,) where the next interval starts."""
        return self.base + (self.count + 1) * self.length

    @property
    def cut(self) -> Tensor:
        """(r,) bool: the last interval, which ends at the far side."""
        return ~(self.whole_end <= self.stop)

    @property
    def middle(self) -> Tensor:
        """(r,) where values are taken."""
        cut = self.start + (self.stop - self.start) * 0.5
        return torch.where(self.cut, cut, self.base + (self.count + 0.5) * self.length)

    def cone(self, t: Tensor) -> Tensor:
        """Width of the cone at distance t."""
        return self.near + self.growth * t

    def inside(self) -> Tensor:
        """(r,) bool: the interval lies before the far side."""
        return (self.start < self.stop) & (self.count < _MOST_INTERVALS)

    def next(self, move: Tensor) -> None:
        """Goes to the next interval where `move` (r,) is true."""
        start = self.whole_end
        self.count = torch.where(move, self.count + 1, self.count)
        self.start = torch.where(move, start, self.start)
        self._choose_level(move)

    def _choose_level(self, move: Tensor) -> None:
        width = self.cone(self.start)
        top = len(self.length_l) - 1
        short, long = self.level > 0, self.level < top
        fits = (~short | ~(width < self.length)) & (~long | ~(width >= self.length + self.length))
        level = (width[:, None] >= self.length_l[1:]).sum(1)
        change = move & ~fits
        self.base = torch.where(change, self.start, self.base)
        self.count = torch.where(change, 0.0, self.count)
        self.level = torch.where(change, level, self.level)
