"""The torch twins of the compiled ops, right by definition: plain tensor code, in float32 or
float64.

Every float operation stands in the order of the kernel (cpp_ext/csrc), and no two of them are
fused, so integers come out equal and colours equal to rounding. All rays walk in lockstep: a row of
every tensor is a ray.

Sources: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and
Detailed Voxel Rendering", I3D 2009; Crassin, PhD thesis 2011, chapter 6. The method is told in
docs/design.md, section 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ...base.constants import EMPTY
from ..arguments import RayArguments, TraceArguments
from .exact import TINY, clamp, divide, larger, log2_exact, smaller, stretch
from .rays import INF, Beam, Intervals
from .tree import Bricks, Place, Tree, descend, wanted_depth


@dataclass
class Accumulator:
    """Front-to-back sums of every ray."""

    color: Tensor  # (r, 3) premultiplied
    clear: Tensor  # (r,) transmittance
    depth: Tensor  # (r,)

    @classmethod
    def begin(cls, beam: Beam, clear_r: Tensor | None = None) -> Accumulator:
        """Nothing yet, but for what a ray lost before."""
        zero = torch.zeros_like(beam.first)
        clear = zero + 1 if clear_r is None else clear_r.to(zero.dtype)
        return cls(torch.zeros_like(beam.origin), clear, zero + INF)

    def add(
        self, rgba: Tensor, start: Tensor, length: Tensor, hit_clear: Tensor, where: Tensor
    ) -> None:
        """Adds an interval where `where` is true. Depth is where, inside it, the transmittance fell
        to hit_clear, as if it were of one value.
        """
        kept = 1 - rgba[:, 3]
        share = self.clear * rgba[:, 3]
        left = self.clear * kept
        color = self.color + share[:, None] * rgba[:, :3]
        hit = where & (left < hit_clear) & (self.clear >= hit_clear)
        solid = ~(kept > TINY)
        part = log2_exact(torch.where(hit, hit_clear / self.clear, 1.0))
        part = part / log2_exact(torch.where(hit & ~solid, kept, 0.5))
        part = torch.where(solid, 0.0, clamp(part, 0, 1))
        self.depth = torch.where(hit, start + part * length, self.depth)
        self.color = torch.where(where[:, None], color, self.color)
        self.clear = torch.where(where, left, self.clear)


@dataclass
class Transfer:
    """The transfer function: rows at even distances over a domain."""

    table_lm4: Tensor  # linear RGB, alpha of an interval of step * 2^l
    domain_2: Tensor  # value of the first row, of the last row
    opaque_m: Tensor  # rows with an opacity up to this one

    def place(self, value: Tensor) -> Tensor:
        """Row of a value, with a fraction."""
        low, high = self.domain_2.unbind(0)
        last = self.table_lm4.shape[1] - 1
        return clamp((value - low) * divide(last, high - low, high), 0, last)

    def look_up(self, value: Tensor, level: Tensor) -> Tensor:
        """(r, 4) linear RGB and the alpha of an interval of each ray's level."""
        place = self.place(value)
        most = torch.full_like(place, self.table_lm4.shape[1] - 2)
        row = smaller(torch.floor(place), most)
        weight, row = place - row, row.to(torch.int64)
        a, b = self.table_lm4[level, row], self.table_lm4[level, row + 1]
        return a + weight[:, None] * (b - a)

    def piece(self, value: Tensor, lengths: Tensor) -> Tensor:
        """(r, 4) linear RGB and the alpha of any number of shortest intervals."""
        rgba = self.look_up(value, torch.zeros_like(value, dtype=torch.int64))
        return torch.cat((rgba[:, :3], stretch(rgba[:, 3], lengths)[:, None]), 1)

    def interval(self, value: Tensor, piece: Piece) -> Tensor:
        """(r, 4) linear RGB and the alpha of an interval."""
        odd, whole = self.piece(value, piece.lengths), self.look_up(value, piece.level)
        return torch.where(piece.odd[:, None], odd, whole)

    def transparent(self, smallest: Tensor, largest: Tensor) -> Tensor:
        """Bool: no value between the two is seen. They are taken a little apart, since
        interpolation may round beyond its ends.
        """
        below = smallest - larger(smallest, -smallest) * 2.0**-20
        above = largest + larger(largest, -largest) * 2.0**-20
        first = torch.floor(self.place(below)).to(torch.int64)
        end = torch.ceil(self.place(above)).to(torch.int64)
        before = torch.where(first > 0, self.opaque_m[(first - 1).clamp(min=0)], 0)
        return self.opaque_m[end] == before


# --- the op
# -------------------------------------------------------------------------------------------


def trace_rays(
    rays: RayArguments, arguments: TraceArguments
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.trace_rays`; see `gvtorch.ops.trace_rays`.

    Writes request_tn, stamp_t and stamp_b in place. `width` orders the rays, which changes nothing.
    """
    a, real = arguments, arguments.table_lm4.dtype
    beam = Beam.enter(*rays[:4], a.place_33, a.cone_scale, real)

    def number(value: float) -> Tensor:
        return torch.tensor(value, dtype=real).to(a.table_lm4)

    hit_clear = 1 - number(a.depth_alpha)
    at = Intervals.begin(beam, a.step, a.table_lm4.shape[0])
    tree = Tree.of(a, number(a.root_voxel))
    bricks = Bricks.of(a)
    sum_ = Accumulator.begin(beam, rays.clear_r)
    shader = Plain(Transfer(a.table_lm4, a.domain_2, a.opaque_m), sum_, hit_clear)
    samples, visit = walk(beam, at, tree, bricks, shader, number(a.step), 1 - number(a.stop_alpha))
    depth = sum_.depth + beam.moved
    return sum_.color, (1 - sum_.clear)[:, None], depth[:, None], samples, visit.missed


@dataclass
class Piece:
    """An interval of every ray: whole, or of any length."""

    start: Tensor  # (r,)
    end: Tensor  # (r,)
    middle: Tensor  # (r,)
    length: Tensor  # (r,)
    level: Tensor  # (r,) int64, of its whole interval
    lengths: Tensor  # (r,) shortest intervals in it
    odd: Tensor  # (r,) bool: no whole interval


class Shader(Protocol):
    """What a ray makes of the values it meets; see csrc/shaders.h."""

    sum: Accumulator
    sees_empty: bool

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """(k,) bool: nothing between two values (k,) changes the sums of the rays `which` (k,)."""

    def same(self, bricks: Bricks, fine: Tensor, coarse: Tensor) -> Tensor:
        """(k,) bool: two nodes without bricks hold the same numbers."""

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """Adds an interval where `where` (r,) is true."""


@dataclass
class Plain:
    """The transfer function."""

    transfer: Transfer
    sum: Accumulator
    hit_clear: Tensor
    sees_empty: bool = False

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """See `Shader`."""
        return self.transfer.transparent(low, high)

    def same(self, bricks: Bricks, fine: Tensor, coarse: Tensor) -> Tensor:
        """See `Shader`."""
        values = bricks.constant_nc[:, bricks.component]
        return values[fine] == values[coarse]

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """See `Shader`."""
        value = probe.value(piece.middle)
        rgba = self.transfer.interval(value, piece)
        self.sum.add(rgba, piece.start, piece.length, self.hit_clear, where)


def walk(
    beam: Beam,
    at: Intervals,
    tree: Tree,
    bricks: Bricks,
    shader: Shader,
    step: Tensor,
    stop_clear: Tensor,
) -> tuple[Tensor, Visit]:
    """Takes every ray from the scene's near side to its far side; returns (r,) samples, and the
    last visits, which know what was missed.
    """
    visit = Visit.none(beam, tree)
    samples = torch.zeros_like(beam.first, dtype=torch.int32)
    active = at.inside() & (shader.sum.clear > stop_clear)
    arrived = active  # rays that stand in a node they have not looked up yet
    while active.any():
        if arrived.any():
            visit.look_up(arrived, beam, at, tree, bricks, shader)
        probe = Probe(visit, active, beam, at.near, at.growth, tree, bricks)

        # A node of one value, or of none, is left in one go; else one interval is taken.
        whole = active & (visit.uniform | visit.nothing)
        start, middle, level, length, cut = at.start, at.middle, at.level, at.length, at.cut
        at.next(active)
        leaving = whole & visit.stays(at)
        while leaving.any():
            at.next(leaving)
            leaving = whole & visit.stays(at)
        end = smaller(at.start, at.stop)
        odd = visit.uniform | cut
        length = torch.where(odd, end - start, length)
        middle = torch.where(visit.uniform, start + length * 0.5, middle)
        lengths = divide(length, step, length)
        shaded = active & ~visit.nothing
        shader.add(Piece(start, end, middle, length, level, lengths, odd), probe, shaded)
        samples = samples + shaded.to(torch.int32)
        active = at.inside() & (shader.sum.clear > stop_clear)
        arrived = active & (whole | ~visit.stays(at))
    return samples, visit


@dataclass
class Visit:
    """The node each ray stands in: where the visit ends, and what the node shows."""

    place: Place
    exit: Tensor  # (r,) distance at which the ray leaves the node
    cone_low: Tensor  # (r,) the visit ends where the cone is below this
    cone_high: Tensor  # (r,) or not below this
    voxel: Tensor  # (r,) world size of a voxel at the wanted depth
    blend: Tensor  # (r,) 1 / (voxel above - voxel)
    mixed: Tensor  # (r,) bool: two nodes answer
    nothing: Tensor  # (r,) bool: no node answers, or only EMPTY ones
    uniform: Tensor  # (r,) bool: one value answers all over the node
    missed: Tensor  # (r,) bool: here or before, something that was seen was not there

    @classmethod
    def none(cls, beam: Beam, tree: Tree) -> Visit:
        """Stands in no node: every field is filled by `look_up` before it is read."""
        number = torch.zeros_like(beam.first)
        word = torch.full_like(number, tree.root, dtype=torch.int64)
        corner, no = torch.zeros_like(beam.origin), number > 0
        place = Place(
            *(corner, number, word, word, word, no),
            *(word, corner, number + 1, word, corner, number + 1),
        )
        place = Place(*(field.clone() for field in vars(place).values()))
        return cls(place, number, number, number, number, number, no, no, no, no)

    def look_up(
        self,
        arrived: Tensor,
        beam: Beam,
        at: Intervals,
        tree: Tree,
        bricks: Bricks,
        shader: Shader,
        t: Tensor | None = None,
    ) -> None:
        """Finds the node of the rays that arrived, in the middle of their intervals or at distance
        t (r,); marks what they use and what they miss.
        """
        which = arrived.nonzero()[:, 0]
        t = at.middle if t is None else t
        middle, cone = t[which], at.cone(t)[which]
        wanted, fits, above = wanted_depth(cone, tree)
        position = beam.at(which, middle)

        def hides(node: Tensor) -> Tensor:
            return shader.hides(which, *bricks.ends(node, middle.dtype))

        found = descend(position, wanted, tree, hides)
        reaches = fits <= cone
        blends = reaches & (wanted > 0)
        alone = ~blends | (found.coarse_node < 0)
        found.coarse_node = torch.where(alone, found.fine_node, found.coarse_node)
        found.coarse_corner = torch.where(alone[:, None], found.fine_corner, found.coarse_corner)
        found.coarse_size = torch.where(alone, found.fine_size, found.coarse_size)
        unseen = found.hidden & ((found.depth < wanted) | ~blends)
        missed = tree.mark(found, wanted, blends, cone, ~unseen)
        self.missed = self.missed.index_put((which,), self.missed[which] | missed)

        for name, field in vars(found).items():
            getattr(self.place, name)[which] = field
        leave = beam.leave(which, found.corner, found.size)
        low = torch.where(reaches, fits, -INF)
        high = torch.where(reaches, above, fits)
        blend = divide(1.0, above - fits, fits)
        fine, coarse = found.fine_node.clamp(min=0), found.coarse_node.clamp(min=0)
        fine_brick, coarse_brick = tree.brick_n[fine], tree.brick_n[coarse]
        empty = (fine_brick == EMPTY) & (coarse_brick == EMPTY)
        nothing = unseen | (found.fine_node < 0) | (empty & (not shader.sees_empty))
        same = shader.same(bricks, fine, coarse)
        uniform = ~nothing & (fine_brick < 0) & (coarse_brick < 0) & same
        mixed = found.fine_node != found.coarse_node
        for name, now in (
            *(("exit", leave), ("cone_low", low), ("cone_high", high), ("voxel", fits)),
            *(("blend", blend), ("mixed", mixed), ("nothing", nothing), ("uniform", uniform)),
        ):
            setattr(self, name, getattr(self, name).index_put((which,), now))

    def stays(self, at: Intervals) -> Tensor:
        """(r,) bool: the interval's middle still lies in the node, and wants the same levels."""
        middle = at.middle
        cone = at.cone(middle)
        fits = (cone >= self.cone_low) & (cone < self.cone_high)
        return at.inside() & (middle < self.exit) & fits


@dataclass
class Probe:
    """What a shader may ask of the tree at places of its rays."""

    visit: Visit
    active: Tensor  # (r,) bool
    beam: Beam
    near: Tensor  # (r,) cone
    growth: Tensor  # (r,)
    tree: Tree
    bricks: Bricks

    def value(self, t: Tensor) -> Tensor:
        """(r,) values at distances t (r,)."""
        return self.number(self.bricks, t)

    def number(self, bricks: Bricks, t: Tensor) -> Tensor:
        """(r,) numbers of any channel at distances t (r,)."""
        return self.blend(t, lambda node, corner, size: self.read(bricks, node, corner, size, t))

    def blend(self, t: Tensor, ask: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Tensor:
        """What the node says and what its parent says, whose weight grows from 0 where the cone is
        as wide as the node's voxels to 1 where it is as wide as its parent's. `ask(node, corner,
        size)` gives (r,).
        """
        visit, p = self.visit, self.visit.place
        value = ask(p.fine_node, p.fine_corner, p.fine_size)
        if not (self.active & visit.mixed).any():
            return value
        other = ask(p.coarse_node, p.coarse_corner, p.coarse_size)
        weight = clamp((self.near + self.growth * t - visit.voxel) * visit.blend, 0, 1)
        return torch.where(visit.mixed, value + weight * (other - value), value)

    def read(
        self,
        bricks: Bricks,
        node: Tensor,
        corner: Tensor,
        size: Tensor,
        t: Tensor,
        shift: tuple[float, float, float] = (0, 0, 0),
    ) -> Tensor:
        """(r,) numbers of nodes, `shift` voxels beside the rays."""
        ray = self.beam.origin, self.beam.direction, t
        return bricks.sample(self.tree.brick_n, node, corner, size, *ray, shift)
