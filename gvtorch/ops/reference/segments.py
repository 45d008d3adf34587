"""The torch twins of the ops for module shaders, as in cpp_ext/csrc/shaders/segments.h."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..arguments import RayArguments, Samples, Segments, TraceArguments
from .march import Interval, NodePair, Probe, Transfer, Visitor, Walk
from .rays import Beam
from .tree import ChannelBricks, Levels

_ODD = -1  # level of an odd interval


@dataclass
class SegmentWriter(Visitor):
    """Records what rays would sample. A segment is all intervals of a visit with the same level and
    base, or one odd interval.
    """

    walk: Walk
    limit: int  # a ray pauses between two nodes once it has this many samples; 0: never
    by_node: bool  # a region counts as being of one value only where no two nodes blend

    def __post_init__(self) -> None:
        reals = self.walk.intervals.start[:0]
        integers = reals.to(torch.int64)
        tables = (integers.view(0, 2), integers.view(0, 2), integers.view(0, 3))
        empty: tuple[Tensor, ...] = (integers, integers, *tables, *(reals,) * 5, integers)
        self.parts = [empty]

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        same = super().same(fine, coarse)
        return same & (fine == coarse) if self.by_node else same

    def goes_on(self, leaving: Tensor) -> Tensor:
        return ~(leaving & (self.limit > 0) & (self.walk.samples >= self.limit))

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        visit, odd, ray_index = self.walk.visit, interval.odd, mask.nonzero()[:, 0]
        fine, coarse = visit.fine, visit.coarse
        columns = (
            self.walk.visits,
            torch.stack((fine.node, coarse.node), 1),
            torch.stack((fine.brick, coarse.brick), 1),
            torch.stack((fine.depth, coarse.depth, visit.wanted), 1),
            *(visit.lookup_t, interval.start, interval.end),
            torch.where(odd, interval.start, interval.base),
            torch.where(odd, 0.0, interval.count),
            torch.where(odd, _ODD, interval.level),
        )
        self.parts.append((ray_index, *(column[ray_index] for column in columns)))

    def segments(self) -> Segments:
        """Joins the intervals, recorded for all rays in lockstep, to segments ray by ray."""
        columns = [torch.cat(column) for column in zip(*self.parts, strict=True)]
        order = columns[0].argsort(stable=True)
        ray, visit, node, brick, depth, lookup_t, start, end, base, count, level = (
            column[order] for column in columns
        )
        begins = torch.ones_like(ray, dtype=torch.bool)
        alike = [column[1:] == column[:-1] for column in (ray, visit, level, base)]
        begins[1:] = ~(torch.stack(alike).all(0) & (level[1:] != _ODD))
        first = begins.nonzero()[:, 0]
        last = torch.cat((first[1:] - 1, torch.full_like(first[:1], len(ray) - 1)))
        intervals = (count[first].to(torch.int64), last - first + 1, level[first])
        walk, ray = self.walk, ray[first]
        moved = walk.intervals.beam.moved[ray]
        counts = (torch.bincount(ray, minlength=len(walk.samples)), walk.samples, walk.visits)
        return Segments(
            ray_index=ray.to(torch.int32),
            node=node[first].to(torch.int32),
            brick=brick[first].to(torch.int32),
            depth=depth[first].to(torch.int32),
            interval=torch.stack(intervals, 1).to(torch.int32),
            distance=torch.stack((base[first], end[last], lookup_t[first]), 1),
            t0=start[first] + moved,
            t1=end[last] + moved,
            counts=torch.stack(counts, 1).to(torch.int32),
            state=walk.intervals.state,
            missed=walk.missed,
        )


def walk_segments(
    rays: RayArguments, args: TraceArguments, state_r3: Tensor | None, limit: int, by_node: bool
) -> Segments:
    """Twin of `torch.ops.gvtorch.count_segments` and `write_segments` in one."""
    walk = Walk.enter(rays, args)
    if state_r3 is not None:
        walk.intervals.resume(state_r3)
    writer = SegmentWriter(Transfer(args), walk.channel, walk, limit, by_node)
    walk.follow(writer)
    return writer.segments()


def sample_bricks(
    rays: RayArguments, arguments: TraceArguments, segments: Segments, samples: Samples
) -> Tensor:
    """Twin of `torch.ops.gvtorch.sample_bricks`: (k, c). Bricks may be float64 here."""
    args, real, segment = arguments, segments.distance.dtype, samples.segment.to(torch.int64)
    count, ray_count = len(segments.distance), len(rays.origin_r3)
    if not count or not ray_count:
        return segments.distance.new_zeros((len(segment), args.bricks_bzyxc.shape[-1]))
    ray = segments.ray_index.to(torch.int64)
    valid = (segment >= 0) & (segment < count)
    segment = torch.where(valid, segment, 0)
    valid = valid & (ray[segment] >= 0) & (ray[segment] < ray_count)
    beam = Beam.enter(rays, args, real)[torch.where(valid, ray[segment], 0)]
    base, end, lookup_t = segments.distance[segment].unbind(1)
    first, _, level = segments.interval[segment].unbind(1)
    length = base.new_tensor(args.step) * 2.0 ** level.clamp(min=0).to(real)
    middle = base + ((first + samples.number).to(real) + 0.5) * length
    t = torch.where(level == _ODD, base + (end - base) * 0.5, middle)

    node_fields = (segments.node, segments.brick, segments.depth)
    nodes, bricks, depths = (field.to(torch.int64)[segment].unbind(1) for field in node_fields)
    levels = Levels(args, real)
    finest = levels.finest_cells(beam.at(lookup_t))
    words = zip(nodes, bricks, depths[:2], strict=True)
    fine, coarse = (levels.holder(node, brick, d, finest, beam) for node, brick, d in words)
    channel = ChannelBricks.of(args)
    probe = Probe(beam, NodePair(fine, coarse, *levels.voxels(depths[2])), channel)
    return torch.where(valid[:, None], probe.numbers(channel, t), 0.0)


def composite(
    alpha_k: Tensor, feature_kc: Tensor, offset_r: Tensor, clear_r: Tensor, stop_clear: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.composite`: rays in lockstep, from sample to sample."""
    begin, counts = offset_r[:-1], offset_r.diff()
    total = feature_kc.new_zeros((len(begin), feature_kc.shape[1]))
    remaining, before_k = clear_r, torch.zeros_like(alpha_k)
    for number in range(int(counts.max()) if len(counts) else 0):
        ray_index = (counts > number).nonzero()[:, 0]
        if stop_clear > 0:
            ray_index = ray_index[remaining[ray_index] > stop_clear]
        k, clear = begin[ray_index] + number, remaining[ray_index]
        before_k = before_k.index_put((k,), clear)
        share = clear * alpha_k[k]
        total = total.index_put((ray_index,), total[ray_index] + share[:, None] * feature_kc[k])
        remaining = remaining.index_put((ray_index,), clear * (1 - alpha_k[k]))
    return total, remaining, before_k
