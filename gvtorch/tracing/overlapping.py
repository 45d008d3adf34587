"""Trees that fill the same space, composited by sample: `mix_by_sample`.

A ray is cut wherever an interval of one of the trees begins or ends, each tree is traced in each
piece, and the extinctions of a piece add up. Surfaces are opaque: they end the ray for all.

Source: Max, "Optical models for direct volume rendering", IEEE TVCG 1995 (emission and absorption).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..base.records import Hits, Rays
from .composite import TraceRays, join_hits, merged, nothing_like, over, reaches_depth
from .effects import TreeTrace, box_spans
from .tracer import Batch

#: Where trees overlap, a stretch of rays is traced in so many parts, front to back: rays that have
#: ended request nothing behind.
_PARTS_PER_STRETCH = 8
_RAYS_PER_BLOCK = {"cpu": 1 << 14, "cuda": 1 << 18}  # composited by sample at once
_SLIVER_STEPS = 1e-3  # steps: ends of intervals that are closer count as one
_MAX_ALPHA = 1 - 1e-9  # of a sample: the extinction of an opaque one would be infinite
#: How the fields of a stretch join those of the stretches before it; all others are added.
_JOINS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "alpha": lambda _, total: total,
    "depth": torch.minimum,
    "missed": torch.logical_or,
    "label": torch.maximum,  # only one is hit
}


def mix_by_sample(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Composites trees by sample, a block of rays at a time."""
    index = torch.arange(len(rays.origin), device=rays.origin.device)
    blocks = index.split(_RAYS_PER_BLOCK[index.device.type])
    return join_hits([_trace_block(trees, rays[block]) for block in blocks], blocks)


def _trace_block(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces the nearest surface, and composites the media in front over it."""
    surfaces = [tree for tree in trees if tree.tracer.shader.cut_surface() is not None]
    if not surfaces:
        return _trace_media(trees, rays)
    media = [tree for tree in trees if tree not in surfaces]
    lit_rays = replace(rays, transmittance=None)
    back = reduce(_nearer_hits, [tree.trace(lit_rays) for tree in surfaces])
    depth = back.depth.to(rays.range.dtype)
    front_range = torch.cat((rays.range[:, :1], torch.minimum(rays.range[:, 1:], depth)), 1)
    front = _no_hits(rays, trees[0].tracer.dtype)
    if media:
        front = _trace_media(media, replace(rays, range=front_range))
    hit_clear = 1 - trees[0].tracer.arguments.depth_alpha
    depth_passed = rays.light() < hit_clear  # depth was found before these rays begin
    return over(front, replace(back, depth=torch.where(depth_passed, torch.inf, back.depth)))


def _nearer_hits(hits_a: Hits, hits_b: Hits) -> Hits:
    """Returns the nearer of two hits of each ray."""
    a_is_nearer = hits_a.depth <= hits_b.depth

    def nearer(columns: list[Tensor]) -> Tensor:
        a, b = columns
        return torch.where(a_is_nearer if a.dim() > 1 else a_is_nearer[:, 0], a, b)

    samples, missed = hits_a.samples + hits_b.samples, hits_a.missed | hits_b.missed
    return replace(merged((hits_a, hits_b), nearer), samples=samples, missed=missed)


def _trace_media(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces rays from box to box: where a ray is in one box only, its tree is traced as usual."""
    span = box_spans(trees, rays)
    ends = span.transpose(0, 1).flatten(1).sort(1).values  # (r, 2m)
    hits = _no_hits(rays, trees[0].tracer.dtype, trees)
    stop = trees[0].tracer.arguments.stop_alpha
    for near, far in pairwise(ends.unbind(1)):
        middle = (near + far) / 2
        inside = (span[:, :, 0] <= middle) & (middle <= span[:, :, 1]) & (near < far)  # (m, r)
        for tree, in_tree in zip(trees, inside, strict=True):
            alone = in_tree & (inside.sum(0) == 1)
            hits = _add_stretch(hits, rays, alone, (near, far), stop, tree.trace)
        several = inside.sum(0) > 1
        if not bool(several.any()):
            continue
        shares = [part / _PARTS_PER_STRETCH for part in range(_PARTS_PER_STRETCH)]
        part_ends = [near + (far - near) * share for share in shares]
        for part in pairwise([*part_ends, far]):
            hits = _add_stretch(hits, rays, several, part, stop, partial(_trace_mixed, trees))
    return hits if hits.normal is None else replace(hits, normal=_unit_vectors(hits.normal))


def _add_stretch(
    hits: Hits,
    rays: Rays,
    mask: Tensor,
    span: tuple[Tensor, Tensor],
    stop: float,
    trace: TraceRays,
) -> Hits:
    """Traces a stretch of those rays `mask` (r,) bool that have not ended, and adds it behind
    their `hits`, whose normals are sums weighted by light.
    """
    index = (mask & (hits.alpha[:, 0] < stop)).nonzero()[:, 0]
    if not len(index):
        return hits
    alpha_before = hits.alpha[index]
    transmittance = (1 - alpha_before[:, 0]).to(torch.float64)
    stretch = replace(rays[index], range=torch.stack(span, 1)[index], transmittance=transmittance)
    fields_behind = vars(trace(stretch)).copy()
    if fields_behind["normal"] is not None:
        fields_behind["normal"] = fields_behind["normal"] * (fields_behind["alpha"] - alpha_before)
    fields: dict[str, Any] = vars(hits).copy()
    for name, values in fields_behind.items():
        if values is None:
            continue
        before = nothing_like(values, len(mask)) if fields[name] is None else fields[name]
        joined = _JOINS.get(name, torch.add)(before[index], values)
        fields[name] = before.index_copy(0, index, joined)
    return Hits(**fields)


def _trace_mixed(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces rays through media that fill the same space."""
    tracer = trees[0].tracer
    pieces = _cut_into_pieces(trees, rays)
    piece_sums = _trace_pieces(trees, rays, pieces)
    alpha, clear = piece_sums.alpha(), rays.light()[:, 0].contiguous()
    sums, clear_after, clear_before = ops.composite(
        *(alpha, piece_sums.features(), pieces.offset(len(clear)), clear),
        stop_alpha=tracer.arguments.stop_alpha,
        backend=tracer.backend,
    )
    depth_alpha = tracer.arguments.depth_alpha
    hit = reaches_depth(clear_before, clear_before * (1 - alpha), depth_alpha).nonzero()[:, 0]
    within = torch.log(clear_before[hit] / (1 - depth_alpha)) / piece_sums.extinction[hit, 0]
    depth, label = _locate_hits(trees, rays, pieces, hit, clear_before[hit], within)
    samples = torch.zeros(len(clear), dtype=torch.int32, device=clear.device)
    samples.index_add_(0, pieces.ray, torch.where(clear_before > 0, piece_sums.samples, 0))
    return Hits(
        **piece_sums.fields(sums),
        alpha=(1 - clear_after)[:, None].to(tracer.dtype),
        depth=depth[:, None].to(tracer.dtype),
        label=label,
        samples=samples,
        missed=pieces.missed,
    )


def _trace_pieces(trees: Sequence[TreeTrace], rays: Rays, pieces: _Pieces) -> _PieceSums:
    """Traces each tree in the pieces where it is sampled; marks the rays that missed something."""
    piece_sums = _PieceSums(pieces, trees[0].tracer.dtype)
    for tree, covered in zip(trees, pieces.covered, strict=True):
        piece_index = covered.nonzero()[:, 0]
        if len(piece_index):
            hits = tree.trace(pieces.rays(rays, piece_index))
            piece_sums.add(piece_index, hits)
            pieces.missed[pieces.ray[piece_index[hits.missed]]] = True
    return piece_sums


def _locate_hits(
    trees: Sequence[TreeTrace],
    rays: Rays,
    pieces: _Pieces,
    hit: Tensor,  # (h,) int64, the pieces in which the depth of their rays lies
    clear_before: Tensor,  # (h,) transmittance before them
    within: Tensor,  # (h,) share of their length at which it lies if they are homogeneous
) -> tuple[Tensor, Tensor | None]:
    """Returns (r,) depths, +inf where nothing was hit, and (r, 1) labels there, None without any.
    A piece of a single tree is a run of samples: the tree finds the depth in it.
    """
    near, far = pieces.span[hit].unbind(1)
    hit_depth, hit_clear = near + within * (far - near), 1 - trees[0].tracer.arguments.depth_alpha
    ray_count, label = len(rays.origin), None
    if any(tree.tracer.shader.reads_labels for tree in trees):
        label = hit.new_full((ray_count, 1), -1)
    single = pieces.covered.sum(0)[hit] == 1
    for tree, covered in zip(trees, pieces.covered, strict=True):
        candidates, transmittance = covered[hit], clear_before
        if tree.tracer.shader.reads_labels:
            # Among other trees any alpha is a hit.
            transmittance = torch.where(single, transmittance, hit_clear)
        else:
            candidates = candidates & single
        index = candidates.nonzero()[:, 0]
        if not len(index):
            continue
        hits = tree.trace(pieces.rays(rays, hit[index], transmittance[index]))
        tree_depth = hits.depth[:, 0].to(hit_depth)
        found = single[index] & (tree_depth < torch.inf)
        hit_depth[index] = torch.where(found, tree_depth, hit_depth[index])
        if hits.label is not None and label is not None:
            label[pieces.ray[hit[index]]] = hits.label
    depth = hit_depth.new_full((ray_count,), torch.inf).index_put((pieces.ray[hit],), hit_depth)
    return depth, label


class _PieceSums:
    """Colours, normals and features of pieces: sums over trees, weighted by extinction."""

    def __init__(self, pieces: _Pieces, dtype: torch.dtype) -> None:
        count, device = len(pieces.ray), pieces.ray.device
        self.dtype = dtype
        self.extinction = torch.zeros(count, 1, dtype=torch.float64, device=device)
        self.samples = torch.zeros(count, dtype=torch.int32, device=device)
        self.sums: dict[str, Tensor] = {}

    def add(self, index: Tensor, hits: Hits) -> None:
        """Adds a tree's hits in the pieces `index` (k,)."""
        alpha = hits.alpha.to(torch.float64)
        extinction = -torch.log1p(-alpha.clamp(max=_MAX_ALPHA))
        self.extinction.index_add_(0, index, extinction)
        self.samples.index_add_(0, index, hits.samples)
        # From weights of alpha to weights of extinction.
        weight = extinction / alpha.clamp(min=1e-300)
        normal = None if hits.normal is None else hits.normal * hits.alpha
        fields = {"color": hits.color, "normal": normal, "features": hits.features}
        for name, field in fields.items():
            if field is None:
                continue
            shape = (len(self.extinction), field.shape[1])
            sums = self.sums.setdefault(name, self.extinction.new_zeros(shape))
            if sums.shape != shape:
                raise ValueError("render: all trees must give the same number of features")
            sums.index_add_(0, index, weight * field)

    def alpha(self) -> Tensor:
        """Returns (k,) alphas of the pieces."""
        return -torch.expm1(-self.extinction)[:, 0]

    def features(self) -> Tensor:
        """Returns (k, c) all fields of `sums` of the pieces side by side, not premultiplied."""
        columns = [*self.sums.values()] or [self.extinction[:, :0]]
        return torch.cat(columns, 1) / self.extinction.clamp(min=1e-300)

    def fields(self, sums: Tensor) -> dict[str, Tensor]:
        """Returns colours, normals and features of rays: sums (r, c) of `features` along each."""
        widths = [columns.shape[1] for columns in self.sums.values()]
        fields = dict(zip(self.sums, sums.to(self.dtype).split(widths, 1), strict=True))
        fields.setdefault("color", sums.new_zeros((len(sums), 3), dtype=self.dtype))
        if "normal" in fields:
            fields["normal"] = _unit_vectors(fields["normal"])
        return fields


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces of rays, ray after ray and front to back along each."""

    ray: Tensor  # (k,) int64
    span: Tensor  # (k, 2) float64 distances from the camera
    covered: Tensor  # (m, k) bool, the trees sampled there
    missed: Tensor  # (r,) bool, the rays that missed something

    def rays(self, rays: Rays, index: Tensor, transmittance: Tensor | None = None) -> Rays:
        """Returns the pieces `index` (k,) as separate rays."""
        return replace(rays[self.ray[index]], range=self.span[index], transmittance=transmittance)

    def offset(self, rays: int) -> Tensor:
        """Returns (r + 1,) int64 indices of each ray's first piece; the last is their number."""
        count = torch.bincount(self.ray, minlength=rays)
        return torch.cat((count.new_zeros(1), count.cumsum(0)))


def _cut_into_pieces(trees: Sequence[TreeTrace], rays: Rays) -> _Pieces:
    """Cuts rays wherever an interval that one of the trees samples begins or ends; where only one
    is sampled, its intervals stay together.
    """
    missed = torch.zeros(len(rays.origin), dtype=torch.bool, device=rays.origin.device)
    ray_parts, distance_parts, change_parts = [], [], []
    for tree_index, tree in enumerate(trees):
        tracer = tree.tracer
        ray_arguments = ops.RayArguments.of(tracer.to_tree(replace(rays, transmittance=None)))
        arguments, table = tracer.arguments, tracer.arguments.table_lm4
        if table.dim() == 4:  # pre-integrated, (l, m, m, 4): use intervals of one value
            arguments = arguments._replace(table_lm4=table.diagonal(dim1=1, dim2=2).mT.contiguous())
        segments = ops.trace_segments(
            ray_arguments, arguments, by_node=True, backend=tracer.backend
        )
        missed |= segments.missed
        batch = Batch(tracer, ray_arguments, segments, ops.list_samples(segments))
        first = batch.entry_distance[batch.ray] + batch.starts
        last = first + batch.lengths[:, 0]
        ends = [end.to(torch.float64).clamp(*rays.range[batch.ray].T) for end in (first, last)]
        for end, step in zip(ends, (1, -1), strict=True):
            ray_parts.append(batch.ray)
            distance_parts.append(end)
            change = torch.zeros(len(end), len(trees), dtype=torch.int32, device=end.device)
            change[:, tree_index] = step
            change_parts.append(change)
    ray_k, distance_k = torch.cat(ray_parts), torch.cat(distance_parts)
    order = distance_k.argsort(stable=True)
    order = order[ray_k[order].argsort(stable=True)]
    ray_k, distance_k = ray_k[order], distance_k[order]
    covered = torch.cat(change_parts)[order].cumsum(0) > 0  # just behind each end
    sliver = _SLIVER_STEPS * min(tree.tracer.arguments.step for tree in trees)
    return _Pieces(*_join_intervals(ray_k, distance_k, covered, sliver), missed)


def _join_intervals(
    ray: Tensor, distance: Tensor, covered: Tensor, sliver: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns ray, span and trees of pieces, see `_Pieces`, given the sorted ends (k,) of intervals
    and the trees just behind them, `covered` (k, m).
    """
    same_ray = ray[1:] == ray[:-1]
    near, far = distance[:-1], distance[1:]
    kept = (same_ray & covered[:-1].any(1) & (far - near > sliver)).nonzero()[:, 0]
    ray, near, far, covered = ray[:-1][kept], near[kept], far[kept], covered[:-1][kept]
    if not len(ray):
        return ray, distance.new_zeros((0, 2)), covered.T
    # Slivers between pieces are added to the piece behind; a run of one tree stays one piece.
    joins = (ray[1:] == ray[:-1]) & (near[1:] - far[:-1] <= 8 * sliver)
    near = torch.cat((near[:1], torch.where(joins, far[:-1], near[1:])))
    alone = covered.sum(1) == 1
    run = joins & alone[1:] & alone[:-1] & (covered[1:] == covered[:-1]).all(1)
    starts = torch.cat((run.new_ones(1), ~run)).nonzero()[:, 0]
    ends = torch.cat((starts[1:] - 1, starts.new_tensor([len(ray) - 1])))
    return ray[starts], torch.stack((near[starts], far[ends]), 1), covered[starts].T


def _no_hits(rays: Rays, dtype: torch.dtype, trees: Sequence[TreeTrace] = ()) -> Hits:
    """Returns hits of rays that have met nothing yet, with all fields that the trees give."""
    column = torch.zeros(len(rays.origin), 1, dtype=dtype, device=rays.origin.device)
    color = column.expand(-1, 3).contiguous()
    tracers = [tree.tracer for tree in trees]
    shaded = [(t.label_names, t.shading) for t in tracers if t.shading is not None]
    # The kernel returns a label as its only feature, which the tracer turns into `label`.
    widths = [shading.features if names is None else 0 for names, shading in shaded]
    labeled = any(names is not None for names, _ in shaded)
    return Hits(
        color=color,
        normal=color if shaded else None,
        features=column.expand(-1, max(widths)).contiguous() if shaded else None,
        label=torch.full_like(column, -1, dtype=torch.int64) if labeled else None,
        alpha=1 - rays.light().to(dtype),
        depth=torch.full_like(column, torch.inf),
        samples=torch.zeros_like(column[:, 0], dtype=torch.int32),
        missed=torch.zeros_like(column[:, 0], dtype=torch.bool),
    )


def _unit_vectors(vectors: Tensor) -> Tensor:
    """Returns vectors (r, 3) of unit length, zeros as they are; the bits do not depend on r."""
    x, y, z = vectors.unbind(1)
    length = (x * x + y * y + z * z).sqrt()
    return vectors / torch.where(length > 0, length, 1)[:, None]
