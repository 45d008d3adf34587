"""The torch twins of the ops for shaders that are no kernel, right by definition: segments of rays,
samples of their bricks, and what they add up to. See cpp_ext/csrc/segments.h.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..arguments import RayArguments, Samples, Segments, TraceArguments
from .exact import clamp, divide, smaller
from .march import Accumulator, Plain, Transfer, Visit
from .rays import Beam, Intervals
from .tree import Bricks, Tree, wanted_depth

_PIECE = -1  # level of an interval of any length


def walk_segments(
    rays: RayArguments,
    arguments: TraceArguments,
    state_r3: Tensor | None,
    limit: int,
    by_node: bool,
) -> Segments:
    """Twin of `torch.ops.gvtorch.count_segments` and `write_segments` in one; see
    `gvtorch.ops.trace_segments`.

    Writes request_tn, stamp_t and stamp_b in place.
    """
    a, real, levels = arguments, arguments.table_lm4.dtype, arguments.table_lm4.shape[0]
    beam = Beam.enter(*rays[:4], a.place_33, a.cone_scale, real)
    at = Intervals.begin(beam, a.step, levels)
    if state_r3 is not None:
        at.base, at.count = state_r3[:, 0].clone(), state_r3[:, 1].clone()
        at.level = clamp(state_r3[:, 2], 0, levels - 1).to(torch.int64)
        at.start = at.base + at.count * at.length
    tree = Tree.of(a, torch.tensor(a.root_voxel, dtype=real).to(a.domain_2))
    bricks = Bricks.of(a)
    transfer = Transfer(a.table_lm4, a.domain_2, a.opaque_m)
    shader = Plain(transfer, Accumulator.begin(beam), a.domain_2[0])  # asked what it hides alone
    visit = Visit.none(beam, tree)
    seen = torch.zeros_like(beam.first)
    samples, visits = torch.zeros_like(at.level), torch.zeros_like(at.level)
    parts: list[tuple[Tensor, ...]] = []

    active = at.inside()
    arrived = active
    while active.any():
        if arrived.any():
            visit.look_up(arrived, beam, at, tree, bricks, shader)
            if by_node:
                visit.uniform = visit.uniform & ~visit.mixed
            visits = visits + arrived.to(torch.int64)
            seen = torch.where(arrived, at.middle, seen)
        whole = active & (visit.uniform | visit.nothing)
        piece = visit.uniform | at.cut
        entry, level, base, count, end = at.start, at.level, at.base, at.count, at.whole_end
        at.next(active)
        leaving = whole & visit.stays(at)
        while leaving.any():
            at.next(leaving)
            leaving = whole & visit.stays(at)
        ray = (active & ~visit.nothing).nonzero()[:, 0]
        columns = (
            *(visits, visit.place.fine_node, visit.place.coarse_node),
            *(visit.place.fine_size, visit.place.coarse_size, seen, entry),
            torch.where(piece, smaller(at.start, at.stop), end),
            torch.where(piece, entry, base),
            torch.where(piece, 0.0, count),
            torch.where(piece, _PIECE, level),
        )
        parts.append((ray, *(column[ray] for column in columns)))
        samples[ray] += 1
        active = at.inside()
        arrived = active & (whole | ~visit.stays(at))
        if limit:
            active = active & ~(arrived & (samples >= limit))
            arrived = arrived & active
    segments = _joined(parts, beam, tree)
    counts = torch.bincount(segments[0].to(torch.int64), minlength=len(samples))
    count_r3 = torch.stack((counts, samples, visits), 1).to(torch.int32)
    state = torch.stack((at.base, at.count, at.level.to(real)), 1)
    return Segments._make((*segments, count_r3, state, visit.missed))


def _joined(parts: list[tuple[Tensor, ...]], beam: Beam, tree: Tree) -> tuple[Tensor, ...]:
    """Joins intervals, which came in lockstep, to segments, ray by ray."""
    if not parts:
        empty = torch.zeros_like(beam.first[:0])
        whole = empty.to(torch.int64)
        parts = [(whole, whole, whole, whole, *(empty,) * 7, whole)]
    columns = [torch.cat(column) for column in zip(*parts, strict=True)]
    order = columns[0].argsort(stable=True)
    ray, visit, fine, coarse, fine_size, coarse_size, seen, start, end, base, count, level = (
        column[order] for column in columns
    )
    new = torch.ones_like(ray, dtype=torch.bool)
    alike = [column[1:] == column[:-1] for column in (ray, visit, level, base)]
    new[1:] = ~(torch.stack(alike).all(0) & (level[1:] != _PIECE))
    first = new.nonzero()[:, 0]
    last = torch.cat((first[1:] - 1, torch.full_like(first[:1], len(ray) - 1)))
    pairs = torch.stack((fine, coarse), 1)[first]
    cone = (beam.cone_near[ray] + beam.cone_growth[ray] * seen)[first]
    depths = (_depth(fine_size[first], tree), _depth(coarse_size[first], tree))
    intervals = (count[first].to(torch.int64), last - first + 1, level[first])
    moved = beam.moved[ray[first]]
    return (
        ray[first].to(torch.int32),
        pairs.to(torch.int32),
        tree.brick_n[pairs],
        torch.stack((*depths, wanted_depth(cone, tree)[0]), 1).to(torch.int32),
        torch.stack(intervals, 1).to(torch.int32),
        torch.stack((base[first], end[last], seen[first]), 1),
        start[first] + moved,
        end[last] + moved,
    )


def _depth(size: Tensor, tree: Tree) -> Tensor:
    """(k,) int64 depths of nodes from the sides of their boxes."""
    depth, side = torch.zeros_like(size, dtype=torch.int64), torch.ones_like(size)
    for level in range(1, tree.max_depth + 1):
        side = divide(side, tree.branching, side)
        depth = torch.where(size == side, level, depth)
    return depth


def sample_bricks(
    rays: RayArguments, arguments: TraceArguments, segments: Segments, samples: Samples
) -> Tensor:
    """Twin of `torch.ops.gvtorch.sample_bricks`: (k, c). Bricks may be float64 here."""
    a, real, segment = arguments, segments.distance.dtype, samples.segment.to(torch.int64)
    beam = Beam.enter(*rays[:4], a.place_33, a.cone_scale, real)
    ray = segments.ray_index.to(torch.int64)[segment]
    base, end, seen = segments.distance[segment].unbind(1)
    first, _, level = segments.interval[segment].unbind(1)
    length = torch.tensor(a.step, dtype=real).to(base) * 2.0 ** level.clamp(min=0).to(real)
    middle = base + ((first + samples.number).to(real) + 0.5) * length
    t = torch.where(level == _PIECE, base + (end - base) * 0.5, middle)

    node, word = segments.node.to(torch.int64)[segment], segments.brick[segment]
    values = []
    for component in range(a.bricks_bzyxc.shape[4]):
        sides = []
        for which in range(2):
            corner, size = _box(
                beam.at(ray, seen), segments.depth[segment, which], a.branching, a.max_depth
            )
            constant = a.constant_tnc.flatten(0, 1)[node[:, which]]
            bricks = Bricks(a.bricks_bzyxc, constant, constant, a.border, component)
            own = torch.arange(len(segment), device=segment.device)
            place = (corner, size, beam.origin[ray], beam.direction[ray], t)
            sides.append(bricks.sample(word[:, which], own, *place))
        voxel, above = _voxels(
            segments.depth[segment, 2], a.root_voxel, a.branching, a.max_depth, base
        )
        cone = beam.cone_near[ray] + beam.cone_growth[ray] * t
        weight = clamp((cone - voxel) * divide(1.0, above - voxel, voxel), 0, 1)
        mixed = sides[0] + weight * (sides[1] - sides[0])
        values.append(torch.where(node[:, 0] != node[:, 1], mixed, sides[0]))
    return torch.stack(values, 1)


def _box(position: Tensor, depth: Tensor, branching: int, max_depth: int) -> tuple[Tensor, Tensor]:
    """Low corners (k, 3) and sides (k,) of the nodes at a depth in which places lie."""
    corner, local, size = torch.zeros_like(position), position, torch.ones_like(position[:, 0])
    for level in range(1, max_depth + 1):
        inside = depth >= level
        size = torch.where(inside, divide(size, branching, size), size)
        scaled = local * branching
        digit = clamp(torch.floor(scaled), 0, branching - 1)
        corner = torch.where(inside[:, None], corner + digit * size[:, None], corner)
        local = scaled - digit
    return corner, size


def _voxels(
    depth: Tensor, root_voxel: float, branching: int, max_depth: int, like: Tensor
) -> tuple[Tensor, Tensor]:
    """(k,) world sizes of a voxel at a depth, and of one above it."""
    voxel = torch.tensor(root_voxel, dtype=like.dtype).to(like).expand(depth.shape)
    above = torch.full_like(voxel, torch.inf)
    for level in range(max_depth):
        deeper = depth > level
        above = torch.where(deeper, voxel, above)
        voxel = torch.where(deeper, divide(voxel, branching, voxel), voxel)
    return voxel, above


def composite(
    alpha_k: Tensor, feature_kc: Tensor, offset_r: Tensor, clear_r: Tensor, stop_clear: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.composite`: rays in lockstep, from sample to sample."""
    begin, counts = offset_r[:-1], offset_r.diff()
    total = feature_kc.new_zeros((len(begin), feature_kc.shape[1]))
    left, before_k = clear_r, torch.zeros_like(alpha_k)
    for number in range(int(counts.max()) if len(counts) else 0):
        which = (counts > number).nonzero()[:, 0]
        if stop_clear > 0:
            which = which[left[which] > stop_clear]
        k, clear = begin[which] + number, left[which]
        before_k = before_k.index_put((k,), clear)
        share = clear * alpha_k[k]
        total = total.index_put((which,), total[which] + share[:, None] * feature_kc[k])
        left = left.index_put((which,), clear * (1 - alpha_k[k]))
    return total, left, before_k
