"""The torch twins of the compiled ops, right by definition: plain tensor code, in float32 or float64.

Every float operation stands in the order of the kernel (cpp_ext/csrc), and no two of them are fused, so integers
come out equal and colours equal to rounding. All rays walk in lockstep: a row of every tensor is a ray.

Sources: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and Detailed Voxel
Rendering", I3D 2009; Crassin, PhD thesis 2011, chapter 6. The method is told in docs/design.md, section 3.
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

INF = math.inf


# --- numbers ----------------------------------------------------------------------------------------------


def clamp(value: Tensor, low: float | Tensor, high: float | Tensor) -> Tensor:
    """Clamps; NaN ends at the lower bound."""
    low, high = torch.as_tensor(low).to(value), torch.as_tensor(high).to(value)
    raised = torch.where(value > low, value, low)
    return torch.where(raised < high, raised, high)


def divide(a: Tensor | float, b: Tensor | float, like: Tensor) -> Tensor:
    """Returns a / b, rounded once: torch turns a number on either side into a product with a reciprocal."""
    return torch.div(torch.as_tensor(a).to(like), torch.as_tensor(b).to(like).expand(like.shape))


def smaller(a: Tensor, b: Tensor) -> Tensor:
    """Returns b where it is smaller, else a."""
    return torch.where(b < a, b, a)


def larger(a: Tensor, b: Tensor) -> Tensor:
    """Returns b where it is larger, else a."""
    return torch.where(b > a, b, a)


def log2_exact(value: Tensor) -> Tensor:
    """Base-2 logarithm of positive normal floats, from + - * / alone (float64: torch.log2).

    Source: Abramowitz and Stegun, "Handbook of Mathematical Functions", 1964, 4.1.27.
    """
    if value.dtype == torch.float64:
        return torch.log2(value)
    bits = value.contiguous().view(torch.int32)
    exponent = ((bits >> 23) - 127).to(torch.float32)
    mantissa = ((bits & 0x007FFFFF) | 0x3F800000).view(torch.float32)
    high = mantissa > 1.41421356
    mantissa = torch.where(high, mantissa * 0.5, mantissa)
    exponent = torch.where(high, exponent + 1, exponent)
    s = (mantissa - 1) / (mantissa + 1)
    z = s * s
    series = torch.full_like(z, 0.320598898)
    for coefficient in (0.412198583, 0.577078016, 0.961796694, 2.885390082):
        series = series * z + coefficient
    return exponent + series * s


def exp2_exact(value: Tensor) -> Tensor:
    """2 to the power of a float below 127, from + - * alone; 0 below -126 (float64: torch.exp2).

    Source: Abramowitz and Stegun, "Handbook of Mathematical Functions", 1964, 4.2.1.
    """
    if value.dtype == torch.float64:
        return torch.exp2(value)
    tiny = ~(value > -126)
    x = torch.where(tiny, 0.0, smaller(value, torch.full_like(value, 126.0)))
    whole = torch.floor(x + 0.5)
    f = x - whole
    series = torch.full_like(f, 1.52527338e-5)
    for coefficient in (
        1.54035304e-4,
        1.33335581e-3,
        9.61812911e-3,
        5.55041087e-2,
        2.40226507e-1,
        6.93147181e-1,
        1.0,
    ):
        series = series * f + coefficient
    power = ((whole.to(torch.int32) + 127) << 23).view(torch.float32)
    return torch.where(tiny, 0.0, series * power)


# --- the intervals of a ray -------------------------------------------------------------------------------


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


# --- the tree ---------------------------------------------------------------------------------------------


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


def descend(
    position_r3: Tensor,
    wanted_r: Tensor,
    child_n: Tensor,
    brick_n: Tensor,
    stamp_t: Tensor,
    frame: Tensor,
    *,
    branching: int,
    root: int,
    max_depth: int,
) -> Place:
    """Descends from the root to the wanted depth, or as far as tiles exist; stamps the tiles on the way."""
    rays = position_r3.shape[0]
    children = branching**3
    local = position_r3
    node = torch.full((rays,), root, dtype=torch.int64, device=position_r3.device)
    nobody = torch.full_like(node, -1)
    corner, size = torch.zeros_like(position_r3), torch.ones_like(position_r3[:, 0])
    place = Place(
        *(corner, size, torch.zeros_like(node), node, nobody),
        *(nobody, corner, size, nobody, corner, size),
    )
    going = torch.ones_like(node, dtype=torch.bool)
    for _ in range(max_depth + 1):
        stamp_t[torch.unique(place.node[going] // children)] = frame
        answers = going & (brick_n[place.node] != ABSENT)
        place.fine_node = torch.where(answers, place.node, place.fine_node)
        place.fine_corner = torch.where(answers[:, None], place.corner, place.fine_corner)
        place.fine_size = torch.where(answers, place.size, place.fine_size)
        above = answers & (place.depth < wanted_r)
        place.coarse_node = torch.where(above, place.node, place.coarse_node)
        place.coarse_corner = torch.where(above[:, None], place.corner, place.coarse_corner)
        place.coarse_size = torch.where(above, place.size, place.coarse_size)

        tile = child_n[place.node].to(torch.int64)
        going = going & (place.depth < wanted_r) & (tile >= 0)
        if not going.any():
            break
        size = divide(place.size, branching, place.size)
        scaled = local * branching
        digit = clamp(torch.floor(scaled), 0, branching - 1)
        x, y, z = digit.to(torch.int64).unbind(1)
        child = (z * branching + y) * branching + x
        local = torch.where(going[:, None], scaled - digit, local)
        place.corner = torch.where(
            going[:, None], place.corner + digit * size[:, None], place.corner
        )
        place.size = torch.where(going, size, place.size)
        place.parent = torch.where(going, place.node, place.parent)
        place.node = torch.where(going, tile * children + child, place.node)
        place.depth = torch.where(going, place.depth + 1, place.depth)
    return place


def exit_distance(origin_r3: Tensor, direction_r3: Tensor, corner_r3: Tensor, size_r: Tensor) -> Tensor:
    """Distance at which a ray leaves a box (+inf without a direction)."""
    face = torch.where(direction_r3 > 0, corner_r3 + size_r[:, None], corner_r3)
    t = torch.where(direction_r3 == 0, INF, (face - origin_r3) / direction_r3)
    inf = torch.full_like(size_r, INF)
    return smaller(smaller(smaller(inf, t[:, 0]), t[:, 1]), t[:, 2])


def voxel_at(depth: Tensor, root_voxel: Tensor, branching: int, max_depth: int) -> Tensor:
    """World size of a voxel at each depth."""
    voxel = root_voxel.expand(depth.shape)
    for level in range(max_depth):
        voxel = torch.where(depth > level, divide(voxel, branching, voxel), voxel)
    return voxel


def wanted_depth(
    cone: Tensor, root_voxel: Tensor, branching: int, max_depth: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Level of detail: the first depth whose voxel fits into the cone, its voxel, and the voxel above it."""
    voxel = root_voxel.expand(cone.shape).clone()
    above = torch.full_like(cone, INF)
    wanted = torch.zeros_like(cone, dtype=torch.int64)
    for _ in range(max_depth):
        deeper = voxel > cone
        above = torch.where(deeper, voxel, above)
        wanted = torch.where(deeper, wanted + 1, wanted)
        voxel = torch.where(deeper, divide(voxel, branching, voxel), voxel)
    return wanted, voxel, above


def post_requests(request_n: Tensor, node: Tensor, kind: int, voxel: Tensor, cone: Tensor) -> None:
    """Joins wishes into the request words: kinds by OR, priorities by maximum.

    The priority is the width of one voxel of the node on the screen in sixteenths of a pixel.
    """
    priority = torch.where(cone > 0, voxel / cone * 16, REQUEST_PRIORITY)
    priority = torch.where(priority < REQUEST_PRIORITY, priority, REQUEST_PRIORITY).to(torch.int32)
    wished, inverse = torch.unique(node, return_inverse=True)
    most = torch.zeros_like(wished, dtype=torch.int32)
    most.scatter_reduce_(0, inverse, priority, "amax")
    word = request_n[wished]
    kinds = (word & ~REQUEST_PRIORITY) | kind
    request_n[wished] = kinds | torch.maximum(word & REQUEST_PRIORITY, most)


# --- bricks -----------------------------------------------------------------------------------------------


def sample_bricks(
    bricks_bzyxc: Tensor,
    constant_nc: Tensor,
    brick_n: Tensor,
    node: Tensor,
    corner: Tensor,
    size: Tensor,
    origin_r3: Tensor,
    direction_r3: Tensor,
    t: Tensor,
    *,
    border: int,
    component: int,
) -> Tensor:
    """Trilinear value of each ray's node at distance t; the node's constant where it has no brick."""
    real = origin_r3.dtype
    constant = torch.where(node >= 0, constant_nc[node.clamp(min=0), component].to(real), 0.0)
    slot = torch.where(node >= 0, brick_n[node.clamp(min=0)].to(torch.int64), -1)
    if bricks_bzyxc.shape[0] == 0:
        return constant
    side = bricks_bzyxc.shape[1]
    scale = divide(side - 2 * border, size, size)
    offset = (origin_r3 - corner) * scale[:, None] + (border - 0.5)
    place = clamp(offset + t[:, None] * (direction_r3 * scale[:, None]), 0, side - 1)
    cell = smaller(torch.floor(place), torch.full_like(place, side - 2))
    wx, wy, wz = (place - cell).unbind(1)
    x, y, z = cell.to(torch.int64).unbind(1)
    brick = slot.clamp(min=0)

    def voxel(dx: int, dy: int, dz: int) -> Tensor:
        return bricks_bzyxc[brick, z + dz, y + dy, x + dx, component].to(real)

    def row(dy: int, dz: int) -> Tensor:
        left, right = voxel(0, dy, dz), voxel(1, dy, dz)
        return left + wx * (right - left)

    def plane(dz: int) -> Tensor:
        low, high = row(0, dz), row(1, dz)
        return low + wy * (high - low)

    near, far = plane(0), plane(1)
    return torch.where(slot >= 0, near + wz * (far - near), constant)


# --- colour -----------------------------------------------------------------------------------------------


@dataclass
class Accumulator:
    """Front-to-back sums of every ray."""

    color: Tensor  # (r, 3) premultiplied
    clear: Tensor  # (r,) transmittance
    depth: Tensor  # (r,)
    hit: Tensor  # (r,) bool


def composite(
    sum_: Accumulator,
    value: Tensor,
    start: Tensor,
    length: Tensor,
    table_m4: Tensor,
    domain_3: Tensor,
    hit_clear: Tensor,
    where: Tensor,
) -> None:
    """Adds an interval of `length` with one value, seen through the transfer function, where `where` is true.

    Opacity is per reference length: 1 - (1 - a)^(length / reference).
    """
    low, high, reference = domain_3.unbind(0)
    rows = table_m4.shape[0]
    place = clamp((value - low) * divide(rows - 1, high - low, high), 0, rows - 1)
    cell = smaller(torch.floor(place), torch.full_like(place, rows - 2))
    weight = place - cell
    row = cell.to(torch.int64)
    r0, r1 = table_m4[row], table_m4[row + 1]
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


# --- the op -----------------------------------------------------------------------------------------------


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
    stamp_b: Tensor,
    table_m4: Tensor,
    domain_3: Tensor,
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
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.trace_rays`; arguments as in `gvtorch.ops.trace_rays`.

    Writes request_tn, stamp_t and stamp_b in place.
    """
    real, frame = origin_r3.dtype, frame_1[0]
    child_n, brick_n, request_n = child_tn.view(-1), brick_tn.view(-1), request_tn.view(-1)
    constant_nc = constant_tnc.view(child_n.shape[0], -1)
    root_voxel_t = torch.tensor(root_voxel, dtype=real, device=origin_r3.device)
    stop_clear = 1 - torch.tensor(stop_alpha, dtype=real, device=origin_r3.device)
    hit_clear = 1 - torch.tensor(depth_alpha, dtype=real, device=origin_r3.device)
    levels = log2_exact(torch.tensor([branching], dtype=real, device=origin_r3.device))

    first, last = _clip(origin_r3, direction_r3, range_r2, bounds_23)
    at = Intervals.begin(first, last, cone_r2, step)
    rays = origin_r3.shape[0]
    zero = torch.zeros(rays, dtype=real, device=origin_r3.device)
    sum_ = Accumulator(torch.zeros_like(origin_r3), zero + 1, zero + INF, zero > 0)
    samples = torch.zeros(rays, dtype=torch.int32, device=origin_r3.device)

    def alive() -> Tensor:
        return at.inside() & (sum_.clear > stop_clear)

    active = alive()
    arrived = active.clone()  # rays that stand in a node they have not looked up yet
    place: Place | None = None
    exit_t, cone_low, cone_high, voxel = zero, zero, zero, zero
    blend = mixed = nothing = uniform = arrived

    def look_up() -> None:
        """Finds the node of the rays that arrived, marks what it used and misses."""
        nonlocal place, exit_t, cone_low, cone_high, voxel, blend, mixed, nothing, uniform
        cone = at.cone(at.middle)
        wanted, fits, above = wanted_depth(cone, root_voxel_t, branching, max_depth)
        position = clamp(origin_r3 + at.middle[:, None] * direction_r3, 0, 1)
        which = arrived.nonzero()[:, 0]
        found = descend(
            *(position[which], wanted[which], child_n, brick_n, stamp_t, frame),
            branching=branching,
            root=root,
            max_depth=max_depth,
        )
        reaches = fits <= cone
        blends = reaches & (wanted > 0)
        alone = ~blends[which] | (found.coarse_node < 0)
        found.coarse_node = torch.where(alone, found.fine_node, found.coarse_node)
        found.coarse_corner = torch.where(alone[:, None], found.fine_corner, found.coarse_corner)
        found.coarse_size = torch.where(alone, found.fine_size, found.coarse_size)

        node_voxel = voxel_at(found.depth, root_voxel_t, branching, max_depth)
        missing = brick_n[found.node] == ABSENT
        short = (found.depth < wanted[which]) & (child_n[found.node] == ABSENT)
        parent = found.parent.clamp(min=0)
        parent_missing = blends[which] & (found.depth == wanted[which]) & (brick_n[parent] == ABSENT)
        parent_voxel = voxel_at(found.depth - 1, root_voxel_t, branching, max_depth)
        for chosen, node, kind, size in (
            (short, found.node, REQUEST_SUBDIVIDE, node_voxel),
            (missing, found.node, REQUEST_LOAD, node_voxel),
            (parent_missing, parent, REQUEST_LOAD, parent_voxel),
        ):
            post_requests(request_n, node[chosen], kind, size[chosen], cone[which][chosen])
        for node in (found.fine_node, found.coarse_node):
            slot = torch.where(node >= 0, brick_n[node.clamp(min=0)], -1)
            stamp_b[torch.unique(slot[slot >= 0]).to(torch.int64)] = frame

        if place is None:
            place = Place(*(f.new_zeros((rays, *f.shape[1:])) for f in vars(found).values()))
        for name, field in vars(found).items():
            getattr(place, name)[which] = field
        exit_t = torch.where(
            arrived, exit_distance(origin_r3, direction_r3, place.corner, place.size), exit_t
        )
        cone_low = torch.where(arrived, torch.where(reaches, fits, -INF), cone_low)
        cone_high = torch.where(arrived, torch.where(reaches, above, fits), cone_high)
        voxel = torch.where(arrived, fits, voxel)
        blend = torch.where(arrived, blends, blend)
        fine, coarse = place.fine_node, place.coarse_node
        fine_brick, coarse_brick = brick_n[fine.clamp(min=0)], brick_n[coarse.clamp(min=0)]
        mixed = fine != coarse
        nothing = (fine < 0) | ((fine_brick == EMPTY) & (coarse_brick == EMPTY))
        same = constant_nc[fine.clamp(min=0), component] == constant_nc[coarse.clamp(min=0), component]
        uniform = ~nothing & (fine_brick < 0) & (coarse_brick < 0) & same

    def stays() -> Tensor:
        cone = at.cone(at.middle)
        return at.inside() & (at.middle < exit_t) & (cone >= cone_low) & (cone < cone_high)

    while active.any():
        if arrived.any():
            look_up()
        assert place is not None
        fine = (place.fine_node, place.fine_corner, place.fine_size)
        coarse = (place.coarse_node, place.coarse_corner, place.coarse_size)
        rest = (origin_r3, direction_r3, at.middle)
        pools = (bricks_bzyxc, constant_nc, brick_n)
        value = sample_bricks(*pools, *fine, *rest, border=border, component=component)
        if (active & mixed).any():
            other = sample_bricks(*pools, *coarse, *rest, border=border, component=component)
            ratio = torch.where(active & mixed, at.cone(at.middle) / voxel, 1.0)
            weight = clamp(log2_exact(ratio) / levels, 0, 1)
            value = torch.where(mixed, value + weight * (other - value), value)

        # A node of one value, or of none, is left in one go; else one interval is taken.
        whole = active & (uniform | nothing)
        entry, one = at.start, at.end - at.start
        at.next(active)
        leaving = whole & stays()
        while leaving.any():
            at.next(leaving)
            leaving = whole & stays()
        length = torch.where(whole, smaller(at.start, at.stop) - entry, one)
        shaded = active & ~nothing
        composite(sum_, value, entry, length, table_m4, domain_3, hit_clear, shaded)
        samples = samples + shaded.to(torch.int32)
        active = alive()
        arrived = active & (whole | ~stays())
    return sum_.color, (1 - sum_.clear)[:, None], sum_.depth[:, None], samples


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
