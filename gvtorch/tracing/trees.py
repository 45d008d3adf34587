"""Rays through several trees: `trace_trees`.

Where boxes do not overlap along a ray, trees are traced one by one and composited in the order in
which the ray enters them. Where they do, they are composited by sample, as media that fill the same
space: the ray is cut wherever an interval of one of the trees begins or ends, each tree is traced
in each piece, and the extinctions of a piece add up. Surfaces are opaque: they end the ray for all.

Source: Max, "Optical models for direct volume rendering", IEEE TVCG 1995 (emission and absorption).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations, pairwise
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from .. import ops
from ..base.records import Hits, Rays
from ..ops.shading import pack
from ..pool import N3Tree
from ..shaders.built_in import Lit
from ..shaders.filtered import Filtered
from ..shaders.shader import Shader, check_shader
from ..shaders.transfer_function import TransferFunction
from .composite import TraceRays, box_span, nothing_like, over
from .effects import with_effects
from .options import RenderOptions
from .pose import poses_of, world_box
from .tracer import Batch, Tracer

#: Parts of a stretch where trees overlap, front to back: ended rays request nothing behind.
_PARTS_PER_STRETCH = 8
_RAYS_PER_BLOCK = {"cpu": 1 << 14, "cuda": 1 << 18}  # composited by sample at once
_SLIVER_STEPS = 1e-3  # steps: ends of intervals that are closer count as one
_MAX_ALPHA = 1 - 1e-9  # of a sample: the extinction of an opaque one would be infinite

#: A shader for all trees, or one for each by name.
Shaders = Shader | Mapping[str, Shader]


@dataclass(frozen=True, eq=False)
class TreeTrace:
    """The tracers of one of several trees."""

    box: Tensor  # (2, 3) float64 world corners around the tree
    trace: TraceRays  # the tracer, wrapped by `with_effects`
    tracer: Tracer  # the tree alone


def tree_traces(
    context: str,
    scene: Mapping[str, tuple[N3Tree, Collection[str]]],  # by name: the tree, and its channel names
    shaders: Shaders,
    options: RenderOptions,  # its channel is the first of each tree if left out
    box: Tensor,  # (2, 3) world corners of the scene
    **settings: Any,  # of `Tracer`
) -> list[TreeTrace]:
    """Prepares the tracers of all trees for one frame. Raises ValueError if a shader is missing, or
    a tree has no such channel; see `Tracer` and `with_effects`.
    """
    traces, poses = [], poses_of(context, scene, options.pose)
    for name, (tree, channels) in scene.items():
        shader: Any = shaders.get(name) if isinstance(shaders, Mapping) else shaders
        check_shader(context, f"shader of tree {name!r}", shader)
        channel = options.channel or next(iter(channels))
        for needed in (channel, *shader.channels):
            if needed not in channels:
                channel_list = ", ".join(channels)
                raise ValueError(
                    f"{context}: tree {name!r} has no channel {needed!r}; it has {channel_list}"
                )
        tree_options = replace(options, channel=channel, pose=poses[name])
        tracer = Tracer(tree, shader, tree_options, **settings)
        tree_box = world_box(tree.box, poses[name])
        traces.append(TreeTrace(tree_box, with_effects(tracer, tree_options, box), tracer))
    return traces


def box_around(context: str, trees: Mapping[str, N3Tree], poses: Any = None) -> Tensor:
    """Returns (2, 3) float64 world corners around all trees, given `RenderOptions.pose`."""
    tree_poses = poses_of(context, trees, poses)
    boxes = [world_box(tree.box, tree_poses[name]) for name, tree in trees.items()]
    if len(boxes) == 1:
        return boxes[0]
    low, high = torch.stack(boxes).unbind(1)
    return torch.stack((low.amin(0), high.amax(0)))


def trace_trees(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces rays through several trees; see the head of this file.

    Projections, and shaders that must see a whole ray at once, are not composited by sample: the
    tree whose box is entered first is in front as a whole.
    """
    if len(trees) == 1:
        return trees[0].trace(rays)
    if not overlaps(trees):
        return _trace_in_order(trees, rays)
    trees = [tree for tree in trees if _has_opacity(tree)] or trees[:1]
    if len(trees) == 1:
        return trees[0].trace(rays)
    spans = _box_spans(trees, rays)
    first, last = spans.unbind(2)
    pairs = combinations(range(len(trees)), 2)
    shared = [torch.maximum(first[a], first[b]) < torch.minimum(last[a], last[b]) for a, b in pairs]
    is_shared = torch.stack(shared).any(0)
    mixed_rays, separate_rays = is_shared.nonzero()[:, 0], (~is_shared).nonzero()[:, 0]
    if not len(mixed_rays):
        return _trace_in_order(trees, rays)
    if not len(separate_rays):
        return _mix_by_sample(trees, rays)
    parts = _trace_in_order(trees, rays[separate_rays]), _mix_by_sample(trees, rays[mixed_rays])
    return _join_hits(parts, (separate_rays, mixed_rays))


def overlaps(trees: Sequence[TreeTrace]) -> bool:
    """Returns whether trees are composited by sample, which makes the host wait for the device."""
    if any(tree.tracer.shader.projection or tree.tracer.shader.whole_ray for tree in trees):
        return False
    return any(
        bool((torch.maximum(a.box[0], b.box[0]) < torch.minimum(a.box[1], b.box[1])).all())
        for a, b in combinations(trees, 2)
    )


def _has_opacity(tree: TreeTrace) -> bool:
    """Returns False if a tree is hidden by a transfer function without any opacity."""
    shader = tree.tracer.shader  # surfaces and others only use the colour of a transfer function
    transfer = shader.transfer if isinstance(shader, Lit) else shader
    transfer = shader.function if isinstance(shader, Filtered) else transfer
    return not isinstance(transfer, TransferFunction) or bool(transfer.opacity[:, 1].any())


# --- one tree behind the other


def _trace_in_order(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Composites trees in the order in which rays enter their boxes."""
    first, last = _box_spans(trees, rays).unbind(2)
    order = torch.where(first <= last, first, torch.inf).argsort(dim=0, stable=True)  # (m, r)
    hits = [tree.trace(rays) for tree in trees]
    ordered = {name: _in_ray_order(hits, name, order) for name in vars(hits[0])}
    ranked = [
        Hits(**{name: values[rank] for name, values in ordered.items()})
        for rank in range(len(trees))
    ]
    return replace(reduce(over, ranked), normal=_mean_normal(ranked))


def _mean_normal(ranked: Sequence[Hits]) -> Tensor | None:
    """Returns (r, 3) mean normals, weighted by the light each tree absorbs; None if none exist."""
    weighted = [hits.normal * hits.alpha for hits in ranked if hits.normal is not None]
    if not weighted:
        return None
    total, alpha = weighted[0], ranked[0].alpha
    for behind, hits in zip(weighted[1:], ranked[1:], strict=True):
        total = total + (1 - alpha) * behind
        alpha = alpha + (1 - alpha) * hits.alpha
    return normalize(total, dim=1)


def _in_ray_order(hits: Sequence[Hits], name: str, order: Tensor) -> Sequence[Any]:
    """Returns a field (r, ...) of m trees, in the order (m, r) of the trees along each ray."""
    columns = _filled(hits, name)
    if columns is None:
        return [None] * len(hits)
    stacked = torch.stack(columns)
    if stacked.dim() == 3:
        order = order[:, :, None].expand_as(stacked)
    return stacked.gather(0, order).unbind(0)


def _filled(hits: Sequence[Hits], name: str) -> list[Tensor] | None:
    """Returns a field (r, ...) of all `hits`, zeros or -1 where one lacks it; None if all do."""
    fields = [getattr(tree_hits, name) for tree_hits in hits]
    present = [field for field in fields if field is not None]
    if not present:
        return None
    if len({field.shape[1:] for field in present}) > 1:
        raise ValueError("render: all trees must give the same number of features")
    return [
        nothing_like(present[0], len(tree_hits.alpha)) if field is None else field
        for tree_hits, field in zip(hits, fields, strict=True)
    ]


# --- several trees in the same space


def _mix_by_sample(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Composites trees by sample, a block of rays at a time."""
    size = _RAYS_PER_BLOCK[rays.origin.device.type]
    blocks = [
        torch.arange(start, min(start + size, len(rays.origin)), device=rays.origin.device)
        for start in range(0, len(rays.origin), size)
    ]
    return _join_hits([_trace_block(trees, rays[block]) for block in blocks], blocks)


def _trace_block(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces the nearest surface, and composites the media in front over it."""
    surfaces = [tree for tree in trees if tree.tracer.shader.cut_surface() is not None]
    if not surfaces:
        return _trace_media(trees, rays)
    media = [tree for tree in trees if tree not in surfaces]
    back = reduce(
        _nearer_hits, [tree.trace(replace(rays, transmittance=None)) for tree in surfaces]
    )
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
    a_is_nearer, fields = (hits_a.depth <= hits_b.depth)[:, 0], {}
    for name in vars(hits_a):
        pair = _filled((hits_a, hits_b), name)
        if pair is not None:
            a, b = pair
            fields[name] = torch.where(a_is_nearer if a.dim() == 1 else a_is_nearer[:, None], a, b)
    fields |= {"samples": hits_a.samples + hits_b.samples, "missed": hits_a.missed | hits_b.missed}
    return Hits(**fields)


def _trace_media(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces rays from box to box: where a ray is in one box only, its tree is traced as usual."""
    span = _box_spans(trees, rays)
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
        for part in range(_PARTS_PER_STRETCH):
            low, high = (
                near + (far - near) * (index / _PARTS_PER_STRETCH) for index in (part, part + 1)
            )
            high = far if part == _PARTS_PER_STRETCH - 1 else high
            hits = _add_stretch(
                hits, rays, several, (low, high), stop, lambda piece: _trace_mixed(trees, piece)
            )
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
    joins: dict[str, Any] = {"depth": torch.minimum, "missed": torch.logical_or}
    joins |= {"alpha": lambda _, total: total, "label": torch.maximum}  # only one is hit
    fields: dict[str, Any] = vars(hits).copy()
    for name, values in fields_behind.items():
        if values is None:
            continue
        values_before = fields[name]
        if values_before is None:
            values_before = nothing_like(values, len(mask))
        fields[name] = values_before.index_copy(
            0, index, joins.get(name, torch.add)(values_before[index], values)
        )
    return Hits(**fields)


def _trace_mixed(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces rays through media that fill the same space."""
    pieces, missed = _cut_into_pieces(trees, rays)
    piece_sums = _PieceSums(pieces, trees[0].tracer.dtype)
    for tree, covered in zip(trees, pieces.covered, strict=True):
        piece_index = covered.nonzero()[:, 0]
        if len(piece_index):
            hits = tree.trace(pieces.rays(rays, piece_index))
            piece_sums.add(piece_index, hits)
            missed = missed.index_put((pieces.ray[piece_index[hits.missed]],), missed.new_ones(()))
    arguments, backend = trees[0].tracer.arguments, trees[0].tracer.backend
    clear = rays.light()[:, 0].contiguous()
    alpha, features = piece_sums.alpha(), piece_sums.features()
    sums, clear_after, clear_before = ops.composite(
        *(alpha, features, pieces.offset(len(clear)), clear),
        stop_alpha=arguments.stop_alpha,
        backend=backend,
    )
    hit_clear = 1 - arguments.depth_alpha
    hit = ((clear_before >= hit_clear) & (clear_before * (1 - alpha) < hit_clear)).nonzero()[:, 0]
    near, far = pieces.span[hit].unbind(1)
    hit_depth = near + torch.log(clear_before[hit] / hit_clear) / piece_sums.extinction[hit, 0] * (
        far - near
    )
    label, samples = None, torch.zeros(len(clear), dtype=torch.int32, device=clear.device)
    if any(tree.tracer.shader.reads_labels for tree in trees):
        label = samples.new_full((len(clear), 1), -1, dtype=torch.int64)
    single = pieces.covered.sum(0)[hit] == 1
    for tree, covered in zip(trees, pieces.covered, strict=True):
        candidates, transmittance = covered[hit], clear_before[hit]
        if label is not None and tree.tracer.shader.reads_labels:
            # Among other trees any alpha is a hit.
            transmittance = torch.where(single, transmittance, hit_clear)
        else:
            candidates = candidates & single  # a run of samples: its tree finds the depth
        piece_index = candidates.nonzero()[:, 0]
        if not len(piece_index):
            continue
        hits = tree.trace(pieces.rays(rays, hit[piece_index], transmittance[piece_index]))
        far = hits.depth[:, 0].to(hit_depth)
        hit_depth[piece_index] = torch.where(
            single[piece_index] & (far < torch.inf), far, hit_depth[piece_index]
        )
        if hits.label is not None and label is not None:
            label[pieces.ray[hit[piece_index]]] = hits.label
    depth = clear_after.new_full((len(clear),), torch.inf).index_put((pieces.ray[hit],), hit_depth)
    samples.index_add_(0, pieces.ray, torch.where(clear_before > 0, piece_sums.samples, 0))
    return replace(piece_sums.hits(sums, clear_after, depth, samples, missed), label=label)


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

    def hits(
        self, sums: Tensor, clear: Tensor, depth: Tensor, samples: Tensor, missed: Tensor
    ) -> Hits:
        """Returns the hits of rays, given sums (r, c) of `features` and the transmittance left."""
        widths = [columns.shape[1] for columns in self.sums.values()]
        fields = dict(zip(self.sums, sums.to(self.dtype).split(widths, 1), strict=True))
        color = fields.get("color", sums.new_zeros((len(sums), 3), dtype=self.dtype))
        return Hits(
            color=color,
            alpha=(1 - clear)[:, None].to(self.dtype),
            depth=depth[:, None].to(self.dtype),
            samples=samples,
            missed=missed,
            normal=_unit_vectors(fields["normal"]) if "normal" in fields else None,
            features=fields.get("features"),
        )


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces of rays, ray after ray and front to back along each."""

    ray: Tensor  # (k,) int64
    span: Tensor  # (k, 2) float64 distances from the camera
    covered: Tensor  # (m, k) bool, the trees sampled there

    def rays(self, rays: Rays, index: Tensor, transmittance: Tensor | None = None) -> Rays:
        """Returns the pieces `index` (k,) as separate rays."""
        return replace(rays[self.ray[index]], range=self.span[index], transmittance=transmittance)

    def offset(self, rays: int) -> Tensor:
        """Returns (r + 1,) int64 indices of each ray's first piece; the last is their number."""
        count = torch.bincount(self.ray, minlength=rays)
        return torch.cat((count.new_zeros(1), count.cumsum(0)))


def _cut_into_pieces(trees: Sequence[TreeTrace], rays: Rays) -> tuple[_Pieces, Tensor]:
    """Cuts rays wherever an interval that one of the trees samples begins or ends; where only one
    is sampled, its intervals stay together. Also returns (r,) bool: the ray missed something.
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
            change_parts.append(
                torch.zeros(len(end), len(trees), dtype=torch.int32, device=end.device)
            )
            change_parts[-1][:, tree_index] = step
    ray_k, distance_k = torch.cat(ray_parts), torch.cat(distance_parts)
    order = distance_k.argsort(stable=True)
    order = order[ray_k[order].argsort(stable=True)]
    ray_k, distance_k = ray_k[order], distance_k[order]
    covered = torch.cat(change_parts)[order].cumsum(0) > 0  # just behind each end
    sliver = _SLIVER_STEPS * min(tree.tracer.arguments.step for tree in trees)
    return _join_intervals(ray_k, distance_k, covered, sliver), missed


def _join_intervals(ray: Tensor, distance: Tensor, covered: Tensor, sliver: float) -> _Pieces:
    """Makes pieces from the sorted ends (k,) of intervals; `covered` (k, m): trees just behind."""
    same_ray = ray[1:] == ray[:-1]
    near, far = distance[:-1], distance[1:]
    kept = (same_ray & covered[:-1].any(1) & (far - near > sliver)).nonzero()[:, 0]
    ray, near, far, covered = ray[:-1][kept], near[kept], far[kept], covered[:-1][kept]
    if not len(ray):
        return _Pieces(ray, distance.new_zeros((0, 2)), covered.T)
    # Slivers between pieces are added to the piece behind; a run of one tree stays one piece.
    joins = (ray[1:] == ray[:-1]) & (near[1:] - far[:-1] <= 8 * sliver)
    near = torch.cat((near[:1], torch.where(joins, far[:-1], near[1:])))
    alone = covered.sum(1) == 1
    run = joins & alone[1:] & alone[:-1] & (covered[1:] == covered[:-1]).all(1)
    starts = torch.cat((run.new_ones(1), ~run)).nonzero()[:, 0]
    ends = torch.cat((starts[1:] - 1, starts.new_tensor([len(ray) - 1])))
    return _Pieces(ray[starts], torch.stack((near[starts], far[ends]), 1), covered[starts].T)


# --- helpers


def _box_spans(trees: Sequence[TreeTrace], rays: Rays) -> Tensor:
    """Returns (m, r, 2) distances of rays in the trees' boxes; last < first where they miss."""
    spans = []
    for tree in trees:
        tree_rays = tree.tracer.to_tree(rays)
        low, high = pack(
            (tree.tracer.tree.box,), tree_rays.origin.dtype, tree_rays.origin.device
        ).view(2, 3)
        first, last = box_span(low, high, tree_rays.origin, tree_rays.direction)
        near, far = rays.range.to(first).unbind(1)
        spans.append(torch.stack((torch.maximum(first, near), torch.minimum(last, far)), 1))
    return torch.stack(spans)


def _no_hits(rays: Rays, dtype: torch.dtype, trees: Sequence[TreeTrace] = ()) -> Hits:
    """Returns hits of rays that have met nothing yet, with all fields that the trees give."""
    column = torch.zeros(len(rays.origin), 1, dtype=dtype, device=rays.origin.device)
    color = column.expand(-1, 3).contiguous()
    shaded = [
        (tree.tracer.label_names, shading)
        for tree in trees
        if (shading := tree.tracer.shading) is not None
    ]
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


def _join_hits(parts: Sequence[Hits], indices: Sequence[Tensor]) -> Hits:
    """Joins hits to (r,); each of `parts` holds those at its indices `indices` (k,)."""
    if len(parts) == 1:
        return parts[0]
    order = torch.cat(list(indices)).argsort()
    fields = {}
    for name in vars(parts[0]):
        if (columns := _filled(parts, name)) is not None:
            fields[name] = torch.cat(columns)[order]
    return Hits(**fields)


def _unit_vectors(vectors: Tensor) -> Tensor:
    """Returns vectors (r, 3) of unit length, zeros as they are; the bits do not depend on r."""
    x, y, z = vectors.unbind(1)
    length = (x * x + y * y + z * z).sqrt()
    return vectors / torch.where(length > 0, length, 1)[:, None]
