"""The torch twins of the ops on rays, right by definition: plain tensors, float32 or float64. Here:
the walk of rays through a tree, what a visitor of it may ask, the transfer function, compositing,
and `trace_rays`.

Every float operation stands in the order of the kernel (cpp_ext/csrc), and no two of them are
fused, so integers come out equal and colours equal to rounding. All rays walk in lockstep: a row of
every tensor is a ray. docs/design.md, section 3, tells the method.

Sources: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels", I3D 2009; Crassin, PhD thesis 2011,
chapter 6.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
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
    """The one or two nodes whose bricks tell a ray's values."""

    fine: Holder
    coarse: Holder  # the fine one again where only one answers
    voxel: Tensor  # (r,) world size of a voxel at the wanted depth
    above: Tensor  # (r,) and at the depth above it


@dataclass
class Visit(NodePair):
    """The node each ray stands in: where the visit ends, and what the node shows."""

    seen: Tensor  # (r,) distance at which the node was looked up
    wanted: Tensor  # (r,) int64 depth that the cone asked for
    reaches: Tensor  # (r,) bool: the cone is at least as wide as a voxel of the wanted depth
    exit: Tensor  # (r,) distance at which the ray leaves the node
    nothing: Tensor  # (r,) bool: no node answers, or only EMPTY ones
    uniform: Tensor  # (r,) bool: one value answers all over the node

    @classmethod
    def none(cls, like: Tensor) -> Visit:
        """Rays that have not looked up any node yet."""
        zero, no = torch.zeros_like(like), torch.zeros_like(like, dtype=torch.bool)
        word = zero.to(torch.int64)
        holder = Holder(word, word, word, torch.stack((zero,) * 3, 1).double(), zero)
        return cls(holder, holder, zero, zero, zero, word, no, zero, no, no)

    def stays(self, at: Intervals) -> Tensor:
        """(r,) bool: the interval's middle still lies in the node, and wants the same levels."""
        middle = at.middle
        cone = at.beam.cone(middle)
        fits = torch.where(
            self.reaches, (cone >= self.voxel) & (cone < self.above), cone < self.voxel
        )
        return at.inside() & (middle < self.exit) & fits


@dataclass
class Probe:
    """What a visitor may ask of the tree at places of its rays."""

    beam: Beam
    nodes: NodePair
    channel: ChannelBricks

    def value(self, t: Tensor) -> Tensor:
        """(r,) values at distances t (r,)."""
        return self.number(self.channel, t)

    def number(self, bricks: ChannelBricks, t: Tensor) -> Tensor:
        """(r,) numbers of any channel at distances t (r,)."""
        return self.blend(t, lambda holder: bricks.sample(holder, self.beam, t))

    def gradient(self, t: Tensor, cube: Tensor) -> Tensor:
        """(r, 3) gradients by world units, over one voxel; `cube` (3,): that of the root cube."""
        return self.blend(t, lambda holder: self.slope(holder, t, cube))

    def slope(self, holder: Holder, t: Tensor, cube: Tensor) -> Tensor:
        """(r, 3) gradients as one of the nodes tells them; see `gradient`."""
        slopes = []
        for axis in range(3):
            shifts = [[way if a == axis else 0.0 for a in range(3)] for way in (-0.5, 0.5)]
            low, high = (self.channel.sample(holder, self.beam, t, shift) for shift in shifts)
            slopes.append((high - low) * (holder.scale / cube[axis]))
        return torch.stack(slopes, 1)

    def blend(self, t: Tensor, ask: Callable[[Holder], Tensor]) -> Tensor:
        """(r,) or (r, c): what the node says and what its parent says, whose weight grows from 0
        where the cone is as wide as the node's voxels to 1 where it is as wide as its parent's.
        """
        nodes = self.nodes
        two, value = nodes.fine.node != nodes.coarse.node, ask(nodes.fine)
        if not two.any():
            return value
        share = divide(1.0, nodes.above - nodes.voxel, nodes.voxel)
        weight = clamp((self.beam.cone(t) - nodes.voxel) * share, 0, 1)
        if value.dim() == 2:
            weight, two = weight[:, None], two[:, None]
        return torch.where(two, value + weight * (ask(nodes.coarse) - value), value)


@dataclass
class Piece:
    """An interval of every ray: a whole one, or an odd one of any length."""

    start: Tensor  # (r,)
    end: Tensor  # (r,)
    middle: Tensor  # (r,) where values are taken
    length: Tensor  # (r,)
    lengths: Tensor  # (r,) the same in shortest intervals
    odd: Tensor  # (r,) bool
    level: Tensor  # (r,) int64, of the whole interval that starts here
    base: Tensor  # (r,) where its level was chosen
    count: Tensor  # (r,) its number since then, as a float


class Accumulator:
    """Front-to-back sums of every ray."""

    def __init__(self, beam: Beam, hit_clear: Tensor, clear_r: Tensor | None) -> None:
        one = torch.ones_like(beam.first)
        self.color = torch.zeros_like(beam.origin)  # (r, 3) premultiplied
        self.clear = one if clear_r is None else clear_r.to(one)  # (r,) transmittance
        self.depth = one * INF  # (r,) where the transmittance falls to hit_clear; +inf: nowhere
        self.hit_clear = hit_clear  # ()

    def hits(self, beam: Beam) -> tuple[Tensor, Tensor, Tensor]:
        """Colours (r, 3), alphas (r, 1) and world depths (r, 1)."""
        return self.color, (1 - self.clear)[:, None], (self.depth + beam.moved)[:, None]

    def add(self, rgba: Tensor, piece: Piece, where: Tensor) -> None:
        """Adds an interval of a colour and an alpha where `where` is true."""
        share = self.clear * rgba[:, 3]
        self.add_light(share[:, None] * rgba[:, :3], where)
        self.absorb(rgba[:, 3], piece, where)

    def add_light(self, color: Tensor, where: Tensor) -> None:
        """Adds (r, 3) light that comes to the eye, where `where` is true."""
        self.color = torch.where(where[:, None], self.color + color, self.color)

    def absorb(self, alpha: Tensor, piece: Piece, where: Tensor) -> None:
        """Lets an interval take its share of the light where `where` is true. Depth is where,
        inside it, the transmittance fell to hit_clear, as if it were of one value.
        """
        kept = 1 - alpha
        left = self.clear * kept
        hit = where & (left < self.hit_clear) & (self.clear >= self.hit_clear)
        solid = ~(kept > TINY)
        part = log2_exact(torch.where(hit, self.hit_clear / self.clear, 1.0))
        part = part / log2_exact(torch.where(hit & ~solid, kept, 0.5))
        part = torch.where(solid, 0.0, clamp(part, 0, 1))
        self.depth = torch.where(hit, piece.start + part * piece.length, self.depth)
        self.clear = torch.where(where, left, self.clear)


class Transfer:
    """The transfer function: rows at even distances over a domain; see `TraceArguments`."""

    def __init__(self, a: TraceArguments) -> None:
        self.table_lm4, self.domain_2, self.opaque_m = a.table_lm4, a.domain_2, a.opaque_m

    def place(self, value: Tensor) -> Tensor:
        """(r,) rows of values, with a fraction."""
        low, high = self.domain_2.unbind(0)
        last = len(self.opaque_m) - 1
        return clamp((value - low) * divide(last, high - low, high), 0, last)

    def cell(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """(r,) int64 rows before values, and (r,) how far they are on the way to the next."""
        place = self.place(value)
        row = smaller(torch.floor(place), torch.full_like(place, len(self.opaque_m) - 2))
        return row.to(torch.int64), place - row

    def look_up(self, value: Tensor, level: Tensor | None = None) -> Tensor:
        """(r, 4) linear RGB and the alpha of an interval of each ray's level; None: the first."""
        row, weight = self.cell(value)
        which = torch.zeros_like(row) if level is None else level
        return mix(self.table_lm4[which, row], self.table_lm4[which, row + 1], weight)

    def interval(self, value: Tensor, piece: Piece) -> Tensor:
        """(r, 4) linear RGB and the alpha of an interval of one value."""
        odd, whole = self.look_up(value), self.look_up(value, piece.level)
        alpha = stretch(odd[:, 3], piece.lengths)[:, None]
        odd = torch.cat((odd[:, :3], alpha), 1)
        return torch.where(piece.odd[:, None], odd, whole)

    def transparent(self, smallest: Tensor, largest: Tensor) -> Tensor:
        """Bool: no value between the two is seen."""
        first = torch.floor(self.place(a_little_below(smallest))).to(torch.int64)
        end = torch.ceil(self.place(a_little_above(largest))).to(torch.int64)
        before = torch.where(first > 0, self.opaque_m[(first - 1).clamp(min=0)], 0)
        return self.opaque_m[end] == before


def mix(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """(r, c) numbers between two."""
    return a + weight[:, None] * (b - a)


def a_little_above(value: Tensor) -> Tensor:
    """A little more, since interpolation may round beyond its ends."""
    return value + larger(value, -value) * _SLACK


def a_little_below(value: Tensor) -> Tensor:
    """A little less."""
    return value - larger(value, -value) * _SLACK


@dataclass
class Visitor(ABC):
    """What rays do on their way: a shader, or a list of what one would sample."""

    transfer: Transfer
    channel: ChannelBricks
    sees_empty = False  # whether EMPTY nodes are sampled, too

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """(k,) bool: nothing between two values (k,) changes anything for the rays `which` (k,)."""
        return self.transfer.transparent(low, high)

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """(k,) bool: two nodes without bricks (k,) hold the same numbers, everywhere."""
        return self.channel.same(fine, coarse)

    @abstractmethod
    def goes_on(self, leaves: Tensor) -> Tensor:
        """(r,) bool: the ray has not ended; `leaves` (r,): it is between two nodes."""

    @abstractmethod
    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """Takes an interval where `where` (r,) is true."""


class Walk:
    """Rays on their way through a tree."""

    def __init__(self, at: Intervals, tree: Tree, channel: ChannelBricks) -> None:
        self.at, self.tree, self.channel = at, tree, channel
        self.visit = Visit.none(at.start)
        self.samples = self.visits = torch.zeros_like(at.start, dtype=torch.int32)
        self.missed = torch.zeros_like(at.start, dtype=torch.bool)  # something that was seen

    @classmethod
    def enter(
        cls, rays: RayArguments, a: TraceArguments, channel: type[ChannelBricks] = ChannelBricks
    ) -> Walk:
        """World rays where they enter the scene."""
        beam = Beam.enter(rays, a, a.table_lm4.dtype)
        return cls(Intervals(beam, a.step, len(a.table_lm4)), Tree(a), channel.of(a))

    def go(self, visitor: Visitor) -> None:
        """Takes every ray from where it stands to the scene's far side, or until it ends."""
        at, leaves = self.at, torch.ones_like(self.missed)
        active = at.inside() & visitor.goes_on(leaves)
        while active.any():
            if (active & leaves).any():
                self.look_up((active & leaves).nonzero()[:, 0], at.middle, visitor)
            visit = self.visit

            # A node of one value, or of none, is left in one go; else one interval is taken.
            whole = active & (visit.uniform | visit.nothing)
            level, base, count, start = at.level, at.base, at.count, at.start
            middle, odd, length = at.middle, visit.uniform | at.cut, at.length
            moves = active
            while moves.any():
                at.next(moves)
                moves = whole & visit.stays(at)
            end = smaller(at.start, at.beam.last)
            length = torch.where(odd, end - start, length)
            middle = torch.where(visit.uniform, start + length * 0.5, middle)
            lengths = divide(length, at.length_l[0], length)
            piece = Piece(start, end, middle, length, lengths, odd, level, base, count)
            seen = active & ~visit.nothing
            self.samples = self.samples + seen.to(torch.int32)
            visitor.add(piece, Probe(at.beam, visit, self.channel), seen)
            leaves = whole | ~visit.stays(at)
            active = at.inside() & visitor.goes_on(leaves)

    def look_up(self, which: Tensor, t: Tensor, visitor: Visitor) -> None:
        """Finds the nodes of the rays `which` (k,) at t (r,); marks what they use and miss."""
        tree, beam, t = self.tree, self.at.beam[which], t[which]
        cone, position = beam.cone(t), beam.at(t)
        wanted = tree.levels.wanted(cone)
        voxel, above = tree.levels.voxels(wanted)

        def hides(node: Tensor) -> Tensor:
            return visitor.hides(which, *self.channel.ends(node, t.dtype))

        found = tree.descend(position, wanted, hides)
        reaches = voxel <= cone
        blends = reaches & (wanted > 0)
        alone = ~blends | (found.coarse < 0)
        fine = tree.holder(found.fine, found.fine_depth, position)
        coarse_node = torch.where(alone, found.fine, found.coarse)
        coarse_depth = torch.where(alone, found.fine_depth, found.coarse_depth)
        coarse = tree.holder(coarse_node, coarse_depth, position)
        unseen = found.hidden & ((found.depth < wanted) | ~blends)
        tree.stamp(torch.cat((fine.brick[~unseen], coarse.brick[~unseen])))
        missed = tree.mark(found, wanted, blends, cone, ~unseen)

        empty = (fine.brick == EMPTY) & (coarse.brick == EMPTY)
        nothing = unseen | (found.fine < 0) | (empty & (not visitor.sees_empty))
        same = visitor.same(fine.node.clamp(min=0), coarse.node.clamp(min=0))
        uniform = ~nothing & (fine.brick < 0) & (coarse.brick < 0) & same
        leave = beam.leave(*tree.levels.corners(position, found.depth))
        visit = Visit(fine, coarse, voxel, above, t, wanted, reaches, leave, nothing, uniform)
        self.visit = self.visit.index_put((which,), visit)
        self.visits = self.visits.index_add(0, which, torch.ones_like(which, dtype=torch.int32))
        self.missed = self.missed.index_put((which,), self.missed[which] | missed)


@dataclass
class Plain(Visitor):
    """The transfer function."""

    sum: Accumulator
    stop_clear: Tensor  # (): a ray ends where no more light is left

    @classmethod
    def begin(cls, rays: RayArguments, a: TraceArguments, walk: Walk, *more: Any) -> Self:
        """A shader before its first interval; `more` are a subclass's own fields."""
        hit_clear, stop_clear = (
            1 - torch.tensor(alpha, dtype=a.table_lm4.dtype).to(a.table_lm4)
            for alpha in (a.depth_alpha, a.stop_alpha)
        )
        sums = Accumulator(walk.at.beam, hit_clear, rays.clear_r)
        return cls(Transfer(a), walk.channel, sums, stop_clear, *more)

    def goes_on(self, leaves: Tensor) -> Tensor:
        return self.sum.clear > self.stop_clear

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        self.sum.add(self.rgba(piece, probe), piece, where)

    def rgba(self, piece: Piece, probe: Probe) -> Tensor:
        """(r, 4) what the transfer function makes of intervals."""
        return self.transfer.interval(probe.value(piece.middle), piece)

    def alpha(self, piece: Piece, probe: Probe, along: Tensor) -> Tensor:
        """(r,) what intervals take from the light that goes along `along` (r, 3)."""
        return self.rgba(piece, probe)[:, 3]


def trace_rays(
    rays: RayArguments, arguments: TraceArguments
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Twin of `ops.trace_rays`. The rays' `width` orders them, which changes nothing."""
    walk = Walk.enter(rays, arguments)
    plain = Plain.begin(rays, arguments, walk)
    walk.go(plain)
    return *plain.sum.hits(walk.at.beam), walk.samples, walk.missed
