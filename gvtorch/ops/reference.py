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

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ..config import (
    ABSENT,
    EMPTY,
    REQUEST_LOAD,
    REQUEST_PRIORITY,
    REQUEST_SUBDIVIDE,
)
from .exact import clamp, divide, exp2_exact, larger, log2_exact, smaller

INF = math.inf


# --- rays
# -----------------------------------------------------------------------------------------


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


# --- the tree
# -----------------------------------------------------------------------------------------


@dataclass
class Place:
    """Where a descent ended, and the two nodes whose bricks answer (-1: nobody)."""

    corner: Tensor  # (r, 3) of the box in which the answer stays the same
    size: Tensor  # (r,)
    depth: Tensor  # (r,)
    node: Tensor  # (r,) last node reached
    parent: Tensor  # (r,)
    hidden: Tensor  # (r,) bool: nothing in the node or below it is seen
    fine_node: Tensor  # (r,)
    fine_corner: Tensor  # (r, 3)
    fine_size: Tensor  # (r,)
    coarse_node: Tensor  # (r,)
    coarse_corner: Tensor  # (r, 3)
    coarse_size: Tensor  # (r,)


@dataclass
class Tree:
    """The node pool as flat words, and the numbers of one tree in it."""

    child_n: Tensor
    brick_n: Tensor
    request_n: Tensor
    stamp_t: Tensor
    stamp_b: Tensor
    frame: Tensor  # ()
    root_voxel: Tensor  # () world size of a depth-0 voxel
    branching: int
    nodes_per_tile: int
    root: int
    max_depth: int
    by_level: bool

    def voxel_at(self, depth: Tensor) -> Tensor:
        """World size of a voxel at each depth."""
        voxel = self.root_voxel.expand(depth.shape)
        for level in range(self.max_depth):
            voxel = torch.where(depth > level, divide(voxel, self.branching, voxel), voxel)
        return voxel

    def mark(
        self, found: Place, wanted: Tensor, blends: Tensor, cone: Tensor, seen: Tensor
    ) -> Tensor:
        """Stamps the bricks that answer where something is seen; requests what is not there, and
        returns (r,) bool whether it did.

        Straight to the wanted level, or level by level: then a brick is there before its node is
        subdivided.
        """
        for node in (found.fine_node, found.coarse_node):
            slot = torch.where(seen & (node >= 0), self.brick_n[node.clamp(min=0)], -1)
            self.stamp_b[torch.unique(slot[slot >= 0]).to(torch.int64)] = self.frame
        absent = self.brick_n[found.node] == ABSENT
        deeper = (found.depth < wanted) & (self.child_n[found.node] == ABSENT)
        short = seen & deeper & ~(self.by_level & absent)
        missing = seen & absent & (self.by_level | ~deeper | (found.fine_node < 0))
        parent = found.parent.clamp(min=0)
        above = seen & blends & (found.depth == wanted) & (self.brick_n[parent] == ABSENT)
        self.request(found.node[short], found.depth[short], cone[short], REQUEST_SUBDIVIDE)
        self.request(found.node[missing], found.depth[missing], cone[missing], REQUEST_LOAD)
        self.request(parent[above], found.depth[above] - 1, cone[above], REQUEST_LOAD)
        return short | missing | above

    def request(self, node: Tensor, depth: Tensor, cone: Tensor, kind: int) -> None:
        """Joins wishes into the request words: kinds by OR, priorities by maximum.

        The priority is the width of one voxel of the node on the screen in sixteenths of a pixel.
        """
        priority = torch.where(cone > 0, self.voxel_at(depth) / cone * 16, REQUEST_PRIORITY)
        priority = torch.where(priority < REQUEST_PRIORITY, priority, REQUEST_PRIORITY)
        wished, inverse = torch.unique(node, return_inverse=True)
        most = torch.zeros_like(wished, dtype=torch.int32)
        most.scatter_reduce_(0, inverse, priority.to(torch.int32), "amax")
        word = self.request_n[wished]
        kinds = (word & ~REQUEST_PRIORITY) | kind
        self.request_n[wished] = kinds | torch.maximum(word & REQUEST_PRIORITY, most)


def descend(
    position_r3: Tensor, wanted_r: Tensor, tree: Tree, hides: Callable[[Tensor], Tensor]
) -> Place:
    """Descends from the root to the wanted depth, or as far as tiles exist and something is seen;
    stamps the tiles.
    """
    n = tree.branching
    local, corner = position_r3, torch.zeros_like(position_r3)
    size = torch.ones_like(position_r3[:, 0])
    node = torch.full_like(wanted_r, tree.root)
    nobody = torch.full_like(node, -1)
    place = Place(
        *(corner, size, torch.zeros_like(node), node, nobody, hides(node)),
        *(nobody, corner, size, nobody, corner, size),
    )
    going = torch.ones_like(node, dtype=torch.bool)
    for _ in range(tree.max_depth + 1):
        tree.stamp_t[torch.unique(place.node[going] // tree.nodes_per_tile)] = tree.frame
        answers = going & (tree.brick_n[place.node] != ABSENT)
        place.fine_node = torch.where(answers, place.node, place.fine_node)
        place.fine_corner = torch.where(answers[:, None], place.corner, place.fine_corner)
        place.fine_size = torch.where(answers, place.size, place.fine_size)
        above = answers & (place.depth < wanted_r)
        place.coarse_node = torch.where(above, place.node, place.coarse_node)
        place.coarse_corner = torch.where(above[:, None], place.corner, place.coarse_corner)
        place.coarse_size = torch.where(above, place.size, place.coarse_size)

        tile = tree.child_n[place.node].to(torch.int64)
        going = going & (place.depth < wanted_r) & (tile >= 0) & ~place.hidden
        if not going.any():
            break
        size = divide(place.size, n, place.size)
        scaled = local * n
        digit = clamp(torch.floor(scaled), 0, n - 1)
        x, y, z = digit.to(torch.int64).unbind(1)
        child = (z * n + y) * n + x
        moved = place.corner + digit * size[:, None]
        local = torch.where(going[:, None], scaled - digit, local)
        place.corner = torch.where(going[:, None], moved, place.corner)
        place.size = torch.where(going, size, place.size)
        place.parent = torch.where(going, place.node, place.parent)
        place.node = torch.where(going, tile * tree.nodes_per_tile + child, place.node)
        place.depth = torch.where(going, place.depth + 1, place.depth)
        place.hidden = torch.where(going, hides(place.node), place.hidden)
    return place


def wanted_depth(cone: Tensor, tree: Tree) -> tuple[Tensor, Tensor, Tensor]:
    """Level of detail: the first depth whose voxel fits the cone, its voxel, and the voxel
    above."""
    voxel = tree.root_voxel.expand(cone.shape)
    above = torch.full_like(cone, INF)
    wanted = torch.zeros_like(cone, dtype=torch.int64)
    for _ in range(tree.max_depth):
        deeper = voxel > cone
        above = torch.where(deeper, voxel, above)
        wanted = torch.where(deeper, wanted + 1, wanted)
        voxel = torch.where(deeper, divide(voxel, tree.branching, voxel), voxel)
    return wanted, voxel, above


# --- bricks
# -------------------------------------------------------------------------------------------


@dataclass
class Bricks:
    """One component of one channel."""

    bricks_bzyxc: Tensor
    constant_nc: Tensor
    range_n2c: Tensor
    border: int
    component: int

    def ends(self, node: Tensor, real: torch.dtype) -> tuple[Tensor, Tensor]:
        """(r,) smallest and largest value in reach of the nodes' bricks, and of the nodes below."""
        low, high = self.range_n2c[node, :, self.component].to(real).unbind(1)
        return low, high

    def sample(
        self,
        brick_n: Tensor,
        node: Tensor,
        corner: Tensor,
        size: Tensor,
        origin_r3: Tensor,
        direction_r3: Tensor,
        t: Tensor,
        shift: tuple[float, float, float] = (0, 0, 0),
    ) -> Tensor:
        """Trilinear value of each ray's node at distance t, `shift` voxels beside the ray; its
        constant where it has no brick.
        """
        real, known = origin_r3.dtype, node.clamp(min=0)
        constant = torch.where(node >= 0, self.constant_nc[known, self.component].to(real), 0.0)
        slot = torch.where(node >= 0, brick_n[known].to(torch.int64), -1)
        if self.bricks_bzyxc.shape[0] == 0:
            return constant
        side = self.bricks_bzyxc.shape[1]
        scale = divide(side - 2 * self.border, size, size)
        offset = (origin_r3 - corner) * scale[:, None] + (self.border - 0.5)
        place = offset + t[:, None] * (direction_r3 * scale[:, None])
        place = torch.stack(
            [p + d if d else p for p, d in zip(place.unbind(1), shift, strict=True)], 1
        )
        place = clamp(place, 0, side - 1)
        cell = smaller(torch.floor(place), torch.full_like(place, side - 2))
        wx, wy, wz = (place - cell).unbind(1)
        x, y, z = cell.to(torch.int64).unbind(1)
        brick = slot.clamp(min=0)

        def voxel(dx: int, dy: int, dz: int) -> Tensor:
            found = self.bricks_bzyxc[brick, z + dz, y + dy, x + dx, self.component]
            return found.to(real)

        def row(dy: int, dz: int) -> Tensor:
            left, right = voxel(0, dy, dz), voxel(1, dy, dz)
            return left + wx * (right - left)

        def plane(dz: int) -> Tensor:
            low, high = row(0, dz), row(1, dz)
            return low + wy * (high - low)

        near, far = plane(0), plane(1)
        return torch.where(slot >= 0, near + wz * (far - near), constant)


# --- colour
# -----------------------------------------------------------------------------------------------


_TINY = 1.1754944e-38  # smallest normal float32: what lets less through is opaque


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
        solid = ~(kept > _TINY)
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
        kept = 1 - rgba[:, 3]
        solid = ~(kept > _TINY)
        alpha = 1 - exp2_exact(log2_exact(torch.where(solid, 0.5, kept)) * lengths)
        return torch.cat((rgba[:, :3], torch.where(solid, 1.0, alpha)[:, None]), 1)

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
    origin_r3: Tensor,
    direction_r3: Tensor,
    cone_r2: Tensor,
    range_r2: Tensor,
    place_33: Tensor,
    child_tn: Tensor,
    brick_tn: Tensor,
    request_tn: Tensor,
    stamp_t: Tensor,
    bricks_bzyxc: Tensor,
    constant_tnc: Tensor,
    range_tn2c: Tensor,
    stamp_b: Tensor,
    table_lm4: Tensor,
    domain_2: Tensor,
    opaque_m: Tensor,
    frame_1: Tensor,
    width: int,
    branching: int,
    root: int,
    max_depth: int,
    border: int,
    component: int,
    cone_scale: float,
    root_voxel: float,
    step: float,
    stop_alpha: float,
    depth_alpha: float,
    by_level: bool,
    clear_r: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.trace_rays`; arguments as in `gvtorch.ops.trace_rays`.

    Writes request_tn, stamp_t and stamp_b in place. `width` orders the rays, which changes nothing.
    """
    real = table_lm4.dtype
    beam = Beam.enter(*(origin_r3, direction_r3, cone_r2, range_r2, place_33), cone_scale, real)

    def number(value: float) -> Tensor:
        return torch.tensor(value, dtype=real).to(table_lm4)

    hit_clear = 1 - number(depth_alpha)
    at = Intervals.begin(beam, step, table_lm4.shape[0])
    tree = Tree(
        *(child_tn.view(-1), brick_tn.view(-1), request_tn.view(-1), stamp_t, stamp_b, frame_1[0]),
        *(number(root_voxel), branching, child_tn.shape[1], root, max_depth, by_level),
    )
    values = constant_tnc.flatten(0, 1), range_tn2c.flatten(0, 1)
    bricks = Bricks(bricks_bzyxc, *values, border, component)
    sum_ = Accumulator.begin(beam, clear_r)
    shader = Plain(Transfer(table_lm4, domain_2, opaque_m), sum_, hit_clear)
    samples, visit = walk(beam, at, tree, bricks, shader, number(step), 1 - number(stop_alpha))
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
