"""The torch twins of the ops on rays, right by definition: plain tensors, float32 or float64. Here:
the walk of rays through a tree, the queries that its visitors may make, the transfer function,
compositing, and `trace_rays`.

Float operations are in the order of the kernel (cpp_ext/csrc), and no two of them are fused, so
integers are equal and colours equal to rounding. All rays walk in lockstep: each row of a tensor is
a ray. docs/design.md, section 3, describes the method.

Sources: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels", I3D 2009; Crassin, PhD thesis 2011,
chapter 6.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Self

import torch
from torch import Tensor

from ...base.constants import EMPTY
from ..arguments import RayArguments, TraceArguments
from .exact import TINY, clamp, divide, larger, log2_exact, smaller, stretch
from .rays import INF, Beam, Intervals, Rows
from .tree import ChannelBricks, Holder, Tree

_SLACK = 2.0**-20  # relative


@dataclass
class NodePair(Rows):
    """The one or two nodes whose bricks a ray's values are read from."""

    fine: Holder
    coarse: Holder  # same as `fine` where only one node is used
    voxel: Tensor  # (r,) world size of a voxel at the wanted depth
    voxel_above: Tensor  # (r,) and at the depth above it


@dataclass
class Visit(NodePair):
    """The node that each ray is in: where the visit ends, and what the node shows."""

    lookup_t: Tensor  # (r,) distance at which the node was looked up
    wanted: Tensor  # (r,) int64 depth that the cone asked for
    voxel_fits: Tensor  # (r,) bool: the cone is at least as wide as a voxel of the wanted depth
    exit: Tensor  # (r,) distance at which the ray leaves the node
    invisible: Tensor  # (r,) bool: nothing is seen, no node has data, or only EMPTY ones
    uniform: Tensor  # (r,) bool: the node has one value everywhere

    @classmethod
    def initial(cls, like: Tensor) -> Visit:
        """Returns the visit of rays that have not looked up any node yet."""
        zero, false = torch.zeros_like(like), torch.zeros_like(like, dtype=torch.bool)
        zero_index = zero.to(torch.int64)
        zeros = torch.stack((zero,) * 3, 1)
        holder = Holder(zero_index, zero_index, zero_index, zero, zeros, zeros)
        return cls(holder, holder, zero, zero, zero, zero_index, false, zero, false, false)

    def stays(self, intervals: Intervals) -> Tensor:
        """Returns (r,) bool: the interval's middle is in the node and wants the same levels."""
        middle = intervals.middle
        cone = intervals.beam.cone(middle)
        between = (cone >= self.voxel) & (cone < self.voxel_above)
        fits = torch.where(self.voxel_fits, between, cone < self.voxel)
        return intervals.inside() & (middle < self.exit) & fits


@dataclass
class Probe:
    """The queries that a visitor may make at points of its rays."""

    beam: Beam
    nodes: NodePair
    channel: ChannelBricks

    def value(self, t: Tensor) -> Tensor:
        """Returns (r,) values at distances t (r,)."""
        return self.number(self.channel, t)

    def number(self, channel: ChannelBricks, t: Tensor) -> Tensor:
        """Returns (r,) numbers of any channel at distances t (r,): its component."""
        return self.blend(t, lambda holder: channel.sample(holder, t))

    def numbers(self, channel: ChannelBricks, t: Tensor) -> Tensor:
        """Returns (r, c) all numbers of any channel at distances t (r,)."""
        return self.blend(t, lambda holder: channel.samples(holder, t))

    def gradient(self, t: Tensor, cube: Tensor) -> Tensor:
        """Returns (r, 3) gradients per world unit, over one voxel; `cube` (3,): root cube size."""
        return self.blend(t, lambda holder: self.slope(holder, t, cube))

    def slope(self, holder: Holder, t: Tensor, cube: Tensor) -> Tensor:
        """Returns (r, 3) gradients from one of the nodes; see `gradient`."""
        # (axis, 1, 3) voxels along each axis
        half = 0.5 * torch.eye(3, dtype=t.dtype, device=t.device)[:, None]
        low, high = self.channel.sample(holder, t, torch.stack((-half, half)))  # (axis, r)
        return ((high - low) * (holder.scale / cube[:, None])).mT

    def blend(self, t: Tensor, read: Callable[[Holder], Tensor]) -> Tensor:
        """Returns (r,) or (r, c): `read` of the fine node, blended with `read` of the coarse one,
        whose weight grows from 0 where the cone is `voxel` wide to 1 where it is `voxel_above`.
        """
        nodes = self.nodes
        mixed, value = nodes.fine.node != nodes.coarse.node, read(nodes.fine)
        if not mixed.any():
            return value
        scale = divide(1.0, nodes.voxel_above - nodes.voxel, nodes.voxel)
        weight = clamp((self.beam.cone(t) - nodes.voxel) * scale, 0, 1)
        if value.dim() == 2:
            weight, mixed = weight[:, None], mixed[:, None]
        return torch.where(mixed, value + weight * (read(nodes.coarse) - value), value)


@dataclass
class Interval:
    """An interval of each ray: whole, or odd (of any other length)."""

    start: Tensor  # (r,)
    end: Tensor  # (r,)
    middle: Tensor  # (r,) where values are sampled
    length: Tensor  # (r,)
    lengths: Tensor  # (r,) the length in units of the shortest interval
    odd: Tensor  # (r,) bool
    level: Tensor  # (r,) int64, of the whole interval that starts here
    base: Tensor  # (r,) where its level was chosen
    count: Tensor  # (r,) number of intervals since the base, as a float


class ShadeSum:
    """Front-to-back sums of every ray."""

    def __init__(self, beam: Beam, hit_clear: Tensor, clear_r: Tensor | None) -> None:
        ones = torch.ones_like(beam.first)
        self.color = torch.zeros_like(beam.origin)  # (r, 3) premultiplied
        self.clear = ones if clear_r is None else clear_r.to(ones)  # (r,) transmittance
        self.depth = ones * INF  # (r,) where the transmittance falls to hit_clear; +inf: nowhere
        self.hit_clear = hit_clear  # ()

    def hits(self, beam: Beam) -> tuple[Tensor, Tensor, Tensor]:
        """Returns colours (r, 3), alphas (r, 1) and world depths (r, 1)."""
        return self.color, (1 - self.clear)[:, None], (self.depth + beam.moved)[:, None]

    def add(self, rgba: Tensor, interval: Interval, mask: Tensor) -> None:
        """Adds an interval with colour and alpha (r, 4) where `mask` is true."""
        share = self.clear * rgba[:, 3]
        self.add_light(share[:, None] * rgba[:, :3], mask)
        self.absorb(rgba[:, 3], interval, mask)

    def add_light(self, color: Tensor, mask: Tensor) -> None:
        """Adds light (r, 3) that reaches the eye, where `mask` is true."""
        self.color = torch.where(mask[:, None], self.color + color, self.color)

    def absorb(self, alpha: Tensor, interval: Interval, mask: Tensor) -> None:
        """Multiplies the transmittance by 1 - alpha where `mask` is true. Depth is where inside
        the interval the transmittance falls to hit_clear, as if the interval were homogeneous.
        """
        transmittance = 1 - alpha
        clear_after = self.clear * transmittance
        hit = mask & (clear_after < self.hit_clear) & (self.clear >= self.hit_clear)
        if hit.any():
            opaque = ~(transmittance > TINY)
            to_hit = torch.where(hit, self.hit_clear / self.clear, 1.0)
            to_end = torch.where(hit & ~opaque, transmittance, 0.5)
            halvings, most = log2_exact(torch.stack((to_hit, to_end)))
            fraction = torch.where(opaque, 0.0, clamp(halvings / most, 0, 1))
            self.depth = torch.where(hit, interval.start + fraction * interval.length, self.depth)
        self.clear = torch.where(mask, clear_after, self.clear)


class Transfer:
    """The transfer function: rows at even distances over a domain; see `TraceArguments`."""

    def __init__(self, table: Any) -> None:
        """Takes `TraceArguments`, or a shader's table, whose fields have the same names."""
        self.table_lm4, self.domain_2 = table.table_lm4, table.domain_2
        self.opaque_m = table.opaque_m
        self.low: Tensor | float
        self.scale: Tensor | float  # table rows per unit of the value
        self.low, high = self.domain_2.unbind(0)
        self.scale = divide(len(self.opaque_m) - 1, high - self.low, high)

    def row_position(self, value: Tensor) -> Tensor:
        """Returns (r,) fractional rows of values."""
        return clamp((value - self.low) * self.scale, 0, len(self.opaque_m) - 1)

    def cell(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (r,) int64 rows at or before values, and (r,) weights of the next rows."""
        position = self.row_position(value)
        row = smaller(torch.floor(position), torch.full_like(position, len(self.opaque_m) - 2))
        return row.to(torch.int64), position - row

    def look_up(self, value: Tensor, level: Tensor | None = None) -> Tensor:
        """Returns (r, 4) linear RGB and alpha of an interval of each ray's level; None: level 0."""
        row, weight = self.cell(value)
        table_level = torch.zeros_like(row) if level is None else level
        return mix(self.table_lm4[table_level, row], self.table_lm4[table_level, row + 1], weight)

    def interval(self, value: Tensor, interval: Interval) -> Tensor:
        """Returns (r, 4) linear RGB and the alpha of an interval of one value."""
        whole_rgba = self.look_up(value, interval.level)
        if not interval.odd.any():
            return whole_rgba
        odd_rgba = self.look_up(value)
        alpha = stretch(odd_rgba[:, 3], interval.lengths)[:, None]
        odd_rgba = torch.cat((odd_rgba[:, :3], alpha), 1)
        return torch.where(interval.odd[:, None], odd_rgba, whole_rgba)

    def transparent(self, smallest: Tensor, largest: Tensor) -> Tensor:
        """Returns bools: no value between the two has an opacity."""
        first = torch.floor(self.row_position(a_little_below(smallest))).to(torch.int64)
        end = torch.ceil(self.row_position(a_little_above(largest))).to(torch.int64)
        before = torch.where(first > 0, self.opaque_m[(first - 1).clamp(min=0)], 0)
        return self.opaque_m[end] == before


def mix(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """Interpolates linearly from a (r, c) to b (r, c)."""
    return a + weight[:, None] * (b - a)


def a_little_above(value: Tensor) -> Tensor:
    """Raises values by 2^-20 of their size, since interpolation may round beyond its ends."""
    return value + larger(value, -value) * _SLACK


def a_little_below(value: Tensor) -> Tensor:
    """Lowers values by 2^-20 of their size."""
    return value - larger(value, -value) * _SLACK


@dataclass
class Visitor(ABC):
    """Receives the intervals of a walk: a shader, or a recorder of what one would sample."""

    transfer: Transfer
    channel: ChannelBricks
    sees_empty = False  # whether EMPTY nodes are sampled, too

    @cached_property
    def transparent_n(self) -> Tensor:
        """(n,) bool, for each node: no value in it or below it affects a ray."""
        real = self.transfer.table_lm4.dtype
        return self.transparent(*self.channel.value_range(slice(None), real))

    def hides(self, ray_index: Tensor, node: Tensor) -> Tensor:
        """Returns (k,) bool: nothing in nodes (k,) or below affects the rays `ray_index` (k,)."""
        return self.transparent_n[node]

    def transparent(self, low: Tensor, high: Tensor) -> Tensor:
        """Returns (n,) bool: no value from low to high (n,) affects a ray."""
        return self.transfer.transparent(low, high)

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """Returns (k,) bool: two nodes without bricks (k,) are equal, so the region is uniform."""
        return self.channel.same(fine, coarse)

    @abstractmethod
    def goes_on(self, leaving: Tensor) -> Tensor:
        """Returns (r,) bool: the ray has not ended; `leaving` (r,): it is between two nodes."""

    @abstractmethod
    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        """Adds an interval where `mask` (r,) is true."""


class Walk:
    """Rays on their way through a tree."""

    def __init__(self, intervals: Intervals, tree: Tree, channel: ChannelBricks) -> None:
        self.intervals, self.tree, self.channel = intervals, tree, channel
        self.visit = Visit.initial(intervals.start)
        self.samples = self.visits = torch.zeros_like(intervals.start, dtype=torch.int32)
        self.missed = torch.zeros_like(intervals.start, dtype=torch.bool)

    @classmethod
    def enter(
        cls, rays: RayArguments, args: TraceArguments, channel: type[ChannelBricks] = ChannelBricks
    ) -> Walk:
        """Returns a walk of world rays, at the points where they enter the scene."""
        beam = Beam.enter(rays, args, args.table_lm4.dtype)
        return cls(Intervals(beam, args.step, len(args.table_lm4)), Tree(args), channel.of(args))

    def follow(self, visitor: Visitor) -> None:
        """Walks every ray to the scene's far side, or until it ends."""
        intervals, leaving = self.intervals, torch.ones_like(self.missed)
        active = intervals.inside() & visitor.goes_on(leaving)
        while active.any():
            if (active & leaving).any():
                self.find((active & leaving).nonzero()[:, 0], intervals.middle, visitor)
            visit = self.visit

            # A node of one value, or of none, is crossed in one step; else one interval is added.
            one_step = active & (visit.uniform | visit.invisible)
            level, base = intervals.level, intervals.base
            count, start = intervals.count, intervals.start
            middle, odd, length = intervals.middle, visit.uniform | intervals.cut, intervals.length
            moving = active
            while moving.any():
                intervals.next(moving)
                stays = visit.stays(intervals)
                moving = one_step & stays
            end = smaller(intervals.start, intervals.beam.last)
            length = torch.where(odd, end - start, length)
            middle = torch.where(visit.uniform, start + length * 0.5, middle)
            lengths = divide(length, intervals.length_l[0], length)
            interval = Interval(start, end, middle, length, lengths, odd, level, base, count)
            sampled = active & ~visit.invisible
            self.samples = self.samples + sampled.to(torch.int32)
            visitor.add(interval, Probe(intervals.beam, visit, self.channel), sampled)
            leaving = one_step | ~stays
            active = intervals.inside() & visitor.goes_on(leaving)

    def find(self, ray_index: Tensor, t: Tensor, visitor: Visitor) -> None:
        """Finds nodes of rays `ray_index` (k,) at t (r,); stamps the used, requests the absent."""
        tree, beam, t = self.tree, self.intervals.beam[ray_index], t[ray_index]
        cone, finest = beam.cone(t), tree.levels.finest_cells(beam.at(t))
        wanted = tree.levels.wanted(cone)
        voxel, voxel_above = tree.levels.voxels(wanted)

        descent = tree.descend(finest, wanted, partial(visitor.hides, ray_index))
        fits = voxel <= cone
        blends = fits & (wanted > 0)
        only_fine = ~blends | (descent.coarse < 0)
        fine = tree.holder(descent.fine, descent.fine_depth, finest, beam)
        coarse_node = torch.where(only_fine, descent.fine, descent.coarse)
        coarse_depth = torch.where(only_fine, descent.fine_depth, descent.coarse_depth)
        coarse = tree.holder(coarse_node, coarse_depth, finest, beam)
        hidden = descent.hidden & ((descent.depth < wanted) | ~blends)
        tree.stamp(torch.cat((fine.brick[~hidden], coarse.brick[~hidden])))
        missed = tree.mark_missing(descent, wanted, blends, cone, ~hidden)

        empty = (fine.brick == EMPTY) & (coarse.brick == EMPTY)
        invisible = hidden | (descent.fine < 0) | (empty & (not visitor.sees_empty))
        same = visitor.same(fine.node.clamp(min=0), coarse.node.clamp(min=0))
        uniform = ~invisible & (fine.brick < 0) & (coarse.brick < 0) & same
        exit_t = beam.leave(*tree.levels.corners(finest, descent.depth))
        visit = Visit(fine, coarse, voxel, voxel_above, t, wanted, fits, exit_t, invisible, uniform)
        self.visit = self.visit.index_put((ray_index,), visit)
        one = torch.ones_like(ray_index, dtype=torch.int32)
        self.visits = self.visits.index_add(0, ray_index, one)
        self.missed = self.missed.index_put((ray_index,), self.missed[ray_index] | missed)


@dataclass
class Plain(Visitor):
    """The transfer function."""

    sum: ShadeSum
    stop_clear: Tensor  # (): a ray ends where its transmittance is not above this

    @classmethod
    def begin(cls, rays: RayArguments, args: TraceArguments, walk: Walk, *fields: Any) -> Self:
        """Returns a shader before its first interval; `fields` are the fields of a subclass."""
        hit_clear, stop_clear = (
            1 - args.table_lm4.new_tensor(alpha) for alpha in (args.depth_alpha, args.stop_alpha)
        )
        sums = ShadeSum(walk.intervals.beam, hit_clear, rays.clear_r)
        return cls(Transfer(args), walk.channel, sums, stop_clear, *fields)

    def goes_on(self, leaving: Tensor) -> Tensor:
        return self.sum.clear > self.stop_clear

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        self.sum.add(self.rgba(interval, probe), interval, mask)

    def rgba(self, interval: Interval, probe: Probe) -> Tensor:
        """Returns (r, 4) colours and alphas of intervals by the transfer function."""
        return self.transfer.interval(probe.value(interval.middle), interval)

    def alpha(self, interval: Interval, probe: Probe, direction: Tensor) -> Tensor:
        """Returns (r,) alphas of intervals, seen along the directions `direction` (r, 3)."""
        return self.rgba(interval, probe)[:, 3]


def trace_rays(
    rays: RayArguments, arguments: TraceArguments
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Twin of `ops.trace_rays`. The rays' `width` only orders them, so it is ignored."""
    walk = Walk.enter(rays, arguments)
    plain = Plain.begin(rays, arguments, walk)
    walk.follow(plain)
    return *plain.sum.hits(walk.intervals.beam), walk.samples, walk.missed
