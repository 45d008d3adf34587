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
from dataclasses import dataclass

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


# --- the intervals of a ray
# -------------------------------------------------------------------------------


@dataclass
class Intervals:
    """The fixed sequence of intervals; each has its value taken in the middle. See trace.h."""

    cone_near: Tensor  # (r,) world units
    cone_growth: Tensor  # (r,) per world unit
    step: Tensor  # () world units
    stop: Tensor  # (r,) world units
    base: Tensor  # (r,)
    length: Tensor  # (r,)
    count: Tensor  # (r,) intervals since base, as a float
    start: Tensor  # (r,)
    end: Tensor  # (r,)
    middle: Tensor  # (r,)

    @classmethod
    def begin(cls, first: Tensor, last: Tensor, cone_r2: Tensor, step: float) -> Intervals:
        """Stands at the first interval of every ray."""
        near, growth = cone_r2[:, 0], cone_r2[:, 1]
        step_t = torch.tensor(step, dtype=first.dtype, device=first.device)
        length = larger(near + growth * first, step_t)
        zero = torch.zeros_like(first)
        at = cls(near, growth, step_t, last, first, length, zero, first, first, first)
        at.start, at.end, at.middle = at._placed(first, length)
        return at

    def _placed(self, start: Tensor, length: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        end = smaller(start + length, self.stop)
        return start, end, start + (end - start) * 0.5

    def cone(self, t: Tensor) -> Tensor:
        """Width of the cone at distance t."""
        return self.cone_near + self.cone_growth * t

    def inside(self) -> Tensor:
        """(r,) bool: the interval lies before the far side."""
        return self.start < self.stop

    def next(self, move: Tensor) -> None:
        """Goes to the next interval where `move` (r,) is true."""
        count = self.count + 1
        at = self.base + count * self.length
        stuck = ~(at > self.start)  # the step is below the resolution of the dtype
        wanted = larger(self.cone(at), self.step)
        changed = wanted != self.length
        start, end, middle = self._placed(at, torch.where(changed, wanted, self.length))
        go = move & ~stuck
        self.base = torch.where(go & changed, at, self.base)
        self.count = torch.where(go, torch.where(changed, 0.0, count), self.count)
        self.length = torch.where(go & changed, wanted, self.length)
        self.start = torch.where(go, start, torch.where(move & stuck, self.stop, self.start))
        self.end = torch.where(go, end, self.end)
        self.middle = torch.where(go, middle, self.middle)


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


def descend(position_r3: Tensor, wanted_r: Tensor, tree: Tree) -> Place:
    """Descends from the root to the wanted depth, or as far as tiles exist; stamps the tiles."""
    n = tree.branching
    local, corner = position_r3, torch.zeros_like(position_r3)
    size = torch.ones_like(position_r3[:, 0])
    node = torch.full_like(wanted_r, tree.root)
    nobody = torch.full_like(node, -1)
    place = Place(
        *(corner, size, torch.zeros_like(node), node, nobody),
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
        going = going & (place.depth < wanted_r) & (tile >= 0)
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
    return place


def exit_distance(
    origin_r3: Tensor, direction_r3: Tensor, corner_r3: Tensor, size_r: Tensor
) -> Tensor:
    """Distance at which a ray leaves a box (+inf without a direction)."""
    face = torch.where(direction_r3 > 0, corner_r3 + size_r[:, None], corner_r3)
    t = torch.where(direction_r3 == 0, INF, (face - origin_r3) / direction_r3)
    inf = torch.full_like(size_r, INF)
    return smaller(smaller(smaller(inf, t[:, 0]), t[:, 1]), t[:, 2])


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

    def unseen(self, node: Tensor, transfer: Transfer) -> Tensor:
        """(r,) bool: all in reach of the nodes' bricks, and of the nodes below, is transparent."""
        real = transfer.table_m4.dtype
        ends = self.range_n2c[node, :, self.component].to(real)
        return transfer.transparent(ends[:, 0], ends[:, 1])

    def sample(
        self,
        brick_n: Tensor,
        node: Tensor,
        corner: Tensor,
        size: Tensor,
        origin_r3: Tensor,
        direction_r3: Tensor,
        t: Tensor,
    ) -> Tensor:
        """Trilinear value of each ray's node at distance t; its constant where it has no brick."""
        real, known = origin_r3.dtype, node.clamp(min=0)
        constant = torch.where(node >= 0, self.constant_nc[known, self.component].to(real), 0.0)
        slot = torch.where(node >= 0, brick_n[known].to(torch.int64), -1)
        if self.bricks_bzyxc.shape[0] == 0:
            return constant
        side = self.bricks_bzyxc.shape[1]
        scale = divide(side - 2 * self.border, size, size)
        offset = (origin_r3 - corner) * scale[:, None] + (self.border - 0.5)
        place = clamp(offset + t[:, None] * (direction_r3 * scale[:, None]), 0, side - 1)
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


@dataclass
class Accumulator:
    """Front-to-back sums of every ray."""

    color: Tensor  # (r, 3) premultiplied
    clear: Tensor  # (r,) transmittance
    depth: Tensor  # (r,)
    hit: Tensor  # (r,) bool


@dataclass
class Transfer:
    """The transfer function: rows at even distances over a domain."""

    table_m4: Tensor
    domain_3: Tensor  # value of the first row, of the last row, reference length
    opaque_m: Tensor  # rows with an opacity up to this one

    def place(self, value: Tensor) -> Tensor:
        """Row of a value, with a fraction."""
        low, high, _ = self.domain_3.unbind(0)
        rows = self.table_m4.shape[0]
        return clamp((value - low) * divide(rows - 1, high - low, high), 0, rows - 1)

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


def composite(
    sum_: Accumulator,
    value: Tensor,
    start: Tensor,
    length: Tensor,
    transfer: Transfer,
    hit_clear: Tensor,
    where: Tensor,
) -> None:
    """Adds an interval of `length` with one value, seen through the transfer function, where
    `where` is true.

    Opacity is per reference length: 1 - (1 - a)^(length / reference).
    """
    reference = transfer.domain_3[2]
    place = transfer.place(value)
    last_cell = transfer.table_m4.shape[0] - 2
    cell = smaller(torch.floor(place), torch.full_like(place, last_cell))
    weight = place - cell
    row = cell.to(torch.int64)
    r0, r1 = transfer.table_m4[row], transfer.table_m4[row + 1]
    rgba = r0 + weight[:, None] * (r1 - r0)
    opacity = rgba[:, 3]

    add = where & (opacity > 0)
    opaque = opacity >= 1
    decay = log2_exact(torch.where(opaque | ~add, 0.5, 1 - opacity))
    kept = torch.where(opaque, 0.0, exp2_exact(decay * (length / reference)))
    clear = sum_.clear * kept
    share = sum_.clear - clear
    sum_.color = torch.where(add[:, None], sum_.color + share[:, None] * rgba[:, :3], sum_.color)
    first = add & ~sum_.hit & (clear < hit_clear)
    safe = torch.where(first, sum_.clear, 1.0)
    into = torch.where(opaque, 0.0, log2_exact(hit_clear / safe) / decay * reference)
    into = clamp(into, torch.zeros_like(length), length)
    sum_.depth = torch.where(first, start + into, sum_.depth)
    sum_.hit = sum_.hit | first
    sum_.clear = torch.where(add, clear, sum_.clear)


# --- the op
# -------------------------------------------------------------------------------------------


def trace_rays(
    origin_r3: Tensor,
    direction_r3: Tensor,
    cone_r2: Tensor,
    range_r2: Tensor,
    bounds_23: Tensor,
    child_tn: Tensor,
    brick_tn: Tensor,
    request_tn: Tensor,
    stamp_t: Tensor,
    bricks_bzyxc: Tensor,
    constant_tnc: Tensor,
    range_tn2c: Tensor,
    stamp_b: Tensor,
    table_m4: Tensor,
    domain_3: Tensor,
    opaque_m: Tensor,
    frame_1: Tensor,
    branching: int,
    root: int,
    max_depth: int,
    border: int,
    component: int,
    root_voxel: float,
    step: float,
    stop_alpha: float,
    depth_alpha: float,
    by_level: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.trace_rays`; arguments as in `gvtorch.ops.trace_rays`.

    Writes request_tn, stamp_t and stamp_b in place.
    """
    first, last = _clip(origin_r3, direction_r3, range_r2, bounds_23)
    stop_clear = 1 - torch.tensor(stop_alpha, dtype=origin_r3.dtype).to(origin_r3)
    hit_clear = 1 - torch.tensor(depth_alpha, dtype=origin_r3.dtype).to(origin_r3)
    top_voxel = torch.tensor(root_voxel, dtype=origin_r3.dtype).to(origin_r3)
    # A place on the scene's high face belongs to the scene.
    inside_3 = bounds_23[1] * torch.tensor(0.9999999, dtype=bounds_23.dtype).to(bounds_23)
    at = Intervals.begin(first, last, cone_r2, step)
    tree = Tree(
        *(child_tn.view(-1), brick_tn.view(-1), request_tn.view(-1), stamp_t, stamp_b, frame_1[0]),
        *(top_voxel, branching, child_tn.shape[1], root, max_depth, by_level),
    )
    values = constant_tnc.flatten(0, 1), range_tn2c.flatten(0, 1)
    bricks = Bricks(bricks_bzyxc, *values, border, component)
    transfer = Transfer(table_m4, domain_3, opaque_m)
    visit = Visit.none(origin_r3, tree)
    zero = torch.zeros_like(first)
    sum_ = Accumulator(torch.zeros_like(origin_r3), zero + 1, zero + INF, zero > 0)
    samples = torch.zeros_like(zero, dtype=torch.int32)

    active = at.inside() & (sum_.clear > stop_clear)
    arrived = active  # rays that stand in a node they have not looked up yet
    while active.any():
        if arrived.any():
            visit.look_up(arrived, origin_r3, direction_r3, inside_3, at, tree, bricks, transfer)
        value = visit.value(active, origin_r3, direction_r3, at, tree, bricks)

        # A node of one value, or of none, is left in one go; else one interval is taken.
        whole = active & (visit.uniform | visit.nothing)
        entry, one = at.start, at.end - at.start
        at.next(active)
        leaving = whole & visit.stays(at)
        while leaving.any():
            at.next(leaving)
            leaving = whole & visit.stays(at)
        length = torch.where(whole, smaller(at.start, at.stop) - entry, one)
        shaded = active & ~visit.nothing
        composite(sum_, value, entry, length, transfer, hit_clear, shaded)
        samples = samples + shaded.to(torch.int32)
        active = at.inside() & (sum_.clear > stop_clear)
        arrived = active & (whole | ~visit.stays(at))
    return sum_.color, (1 - sum_.clear)[:, None], sum_.depth[:, None], samples, visit.missed


@dataclass
class Visit:
    """The node each ray stands in: where the visit ends, and what the node shows."""

    place: Place
    exit: Tensor  # (r,) distance at which the ray leaves the node
    cone_low: Tensor  # (r,) the visit ends where the cone is below this
    cone_high: Tensor  # (r,) or not below this
    voxel: Tensor  # (r,) world size of a voxel at the wanted depth
    mixed: Tensor  # (r,) bool: two nodes answer
    nothing: Tensor  # (r,) bool: no node answers, or only EMPTY ones
    uniform: Tensor  # (r,) bool: one value answers all over the node
    missed: Tensor  # (r,) bool: here or before, something that was seen was not there

    @classmethod
    def none(cls, origin_r3: Tensor, tree: Tree) -> Visit:
        """Stands in no node: every field is filled by `look_up` before it is read."""
        rays = origin_r3.shape[0]
        number = origin_r3.new_zeros(rays)
        word = torch.full((rays,), tree.root, dtype=torch.int64, device=origin_r3.device)
        corner = torch.zeros_like(origin_r3)
        place = Place(
            *(corner, number, word, word, word),
            *(word, corner, number + 1, word, corner, number + 1),
        )
        place = Place(*(field.clone() for field in vars(place).values()))
        no = number > 0
        return cls(place, number, number, number, number, no, no, no, no)

    def look_up(
        self,
        arrived: Tensor,
        origin_r3: Tensor,
        direction_r3: Tensor,
        inside_3: Tensor,
        at: Intervals,
        tree: Tree,
        bricks: Bricks,
        transfer: Transfer,
    ) -> None:
        """Finds the node of the rays that arrived; marks what they use and what they miss."""
        which = arrived.nonzero()[:, 0]
        cone, middle = at.cone(at.middle)[which], at.middle[which]
        wanted, fits, above = wanted_depth(cone, tree)
        position = origin_r3[which] + middle[:, None] * direction_r3[which]
        position = clamp(position, 0, inside_3)
        found = descend(position, wanted, tree)
        reaches = fits <= cone
        blends = reaches & (wanted > 0)
        alone = ~blends | (found.coarse_node < 0)
        found.coarse_node = torch.where(alone, found.fine_node, found.coarse_node)
        found.coarse_corner = torch.where(alone[:, None], found.fine_corner, found.coarse_corner)
        found.coarse_size = torch.where(alone, found.fine_size, found.coarse_size)
        unseen = bricks.unseen(found.node, transfer) & (
            ~blends | (found.depth < wanted) | bricks.unseen(found.parent.clamp(min=0), transfer)
        )
        missed = tree.mark(found, wanted, blends, cone, ~unseen)
        self.missed = self.missed.index_put((which,), self.missed[which] | missed)

        for name, field in vars(found).items():
            getattr(self.place, name)[which] = field
        leave = exit_distance(origin_r3[which], direction_r3[which], found.corner, found.size)
        low = torch.where(reaches, fits, -INF)
        high = torch.where(reaches, above, fits)
        fine, coarse = found.fine_node.clamp(min=0), found.coarse_node.clamp(min=0)
        fine_brick, coarse_brick = tree.brick_n[fine], tree.brick_n[coarse]
        empty = (fine_brick == EMPTY) & (coarse_brick == EMPTY)
        nothing = unseen | (found.fine_node < 0) | empty
        values = bricks.constant_nc[:, bricks.component]
        same = values[fine] == values[coarse]
        uniform = ~nothing & (fine_brick < 0) & (coarse_brick < 0) & same
        mixed = found.fine_node != found.coarse_node
        for name, now in (
            *(("exit", leave), ("cone_low", low), ("cone_high", high), ("voxel", fits)),
            *(("mixed", mixed), ("nothing", nothing), ("uniform", uniform)),
        ):
            setattr(self, name, getattr(self, name).index_put((which,), now))

    def stays(self, at: Intervals) -> Tensor:
        """(r,) bool: the interval's middle still lies in the node, and wants the same levels."""
        cone = at.cone(at.middle)
        fits = (cone >= self.cone_low) & (cone < self.cone_high)
        return at.inside() & (at.middle < self.exit) & fits

    def value(
        self,
        active: Tensor,
        origin_r3: Tensor,
        direction_r3: Tensor,
        at: Intervals,
        tree: Tree,
        bricks: Bricks,
    ) -> Tensor:
        """Value at the interval's middle: the node's and its parent's, by weight log_N(cone /
        voxel)."""
        p, ray = self.place, (origin_r3, direction_r3, at.middle)
        value = bricks.sample(tree.brick_n, p.fine_node, p.fine_corner, p.fine_size, *ray)
        blend = active & self.mixed
        if not blend.any():
            return value
        other = bricks.sample(tree.brick_n, p.coarse_node, p.coarse_corner, p.coarse_size, *ray)
        ratio = torch.where(blend, at.cone(at.middle) / self.voxel, 1.0)
        levels = log2_exact(torch.full_like(ratio, tree.branching))
        weight = clamp(log2_exact(ratio) / levels, 0, 1)
        return torch.where(self.mixed, value + weight * (other - value), value)


def _clip(
    origin_r3: Tensor, direction_r3: Tensor, range_r2: Tensor, bounds_23: Tensor
) -> tuple[Tensor, Tensor]:
    """First and last distance of each ray inside the bounds (slab test, Kay and Kajiya, 1986)."""
    first, last = range_r2[:, 0], range_r2[:, 1]
    for axis in range(3):
        origin, direction = origin_r3[:, axis], direction_r3[:, axis]
        low, high = bounds_23[0, axis], bounds_23[1, axis]
        a, b = (low - origin) / direction, (high - origin) / direction
        flat = direction == 0
        beside = flat & ~((origin >= low) & (origin <= high))
        last = torch.where(beside, first, last)
        first = torch.where(flat, first, larger(first, smaller(a, b)))
        last = torch.where(flat, last, smaller(last, larger(a, b)))
    return first, torch.where(last < INF, last, first)
