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
from .around import around
from .composite import TraceRays, box_span, nothing_like, over
from .options import RenderOptions
from .pose import poses_of, world_box
from .tracer import Batch, Tracer

_PARTS = 8  # of a stretch where trees overlap, front to back: ended rays request nothing behind
_RAYS = {"cpu": 1 << 14, "cuda": 1 << 18}  # composited by sample at once
_SLIVER = 1e-3  # steps: ends of intervals that are closer count as one
_MOST_ALPHA = 1 - 1e-9  # of a sample: the extinction of an opaque one would be infinite

#: A shader for all trees, or one for each by name.
Shaders = Shader | Mapping[str, Shader]


@dataclass(frozen=True, eq=False)
class TreeTrace:
    """The tracers of one of several trees."""

    box: Tensor  # (2, 3) float64 world corners around the tree
    trace: TraceRays  # the tracer, wrapped by `around`
    tracer: Tracer  # the tree alone


def tree_traces(
    where: str,
    scene: Mapping[str, tuple[N3Tree, Collection[str]]],  # by name: the tree, and its channel names
    shaders: Shaders,
    options: RenderOptions,  # its channel is the first of each tree if left out
    box: Tensor,  # (2, 3) world corners of the scene
    **settings: Any,  # of `Tracer`
) -> list[TreeTrace]:
    """Prepares the tracers of all trees for one frame. Raises ValueError if a shader is missing, or
    a tree has no such channel; see `Tracer` and `around`.
    """
    traces, poses = [], poses_of(where, scene, options.pose)
    for name, (tree, channels) in scene.items():
        shader: Any = shaders.get(name) if isinstance(shaders, Mapping) else shaders
        check_shader(where, f"shader of tree {name!r}", shader)
        channel = options.channel or next(iter(channels))
        for needed in (channel, *shader.channels):
            if needed not in channels:
                known = ", ".join(channels)
                raise ValueError(
                    f"{where}: tree {name!r} has no channel {needed!r}; it has {known}"
                )
        chosen = replace(options, channel=channel, pose=poses[name])
        tracer = Tracer(tree, shader, chosen, **settings)
        here = world_box(tree.box, poses[name])
        traces.append(TreeTrace(here, around(tracer, chosen, box), tracer))
    return traces


def box_around(where: str, trees: Mapping[str, N3Tree], poses: Any = None) -> Tensor:
    """Returns (2, 3) float64 world corners around all trees, given `RenderOptions.pose`."""
    placed = poses_of(where, trees, poses)
    boxes = [world_box(tree.box, placed[name]) for name, tree in trees.items()]
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
        return _in_order(trees, rays)
    trees = [one for one in trees if _shows(one)] or trees[:1]
    if len(trees) == 1:
        return trees[0].trace(rays)
    span = _spans(trees, rays)
    first, last = span.unbind(2)
    pairs = combinations(range(len(trees)), 2)
    shared = [torch.maximum(first[a], first[b]) < torch.minimum(last[a], last[b]) for a, b in pairs]
    both = torch.stack(shared).any(0)
    mixed, apart = both.nonzero()[:, 0], (~both).nonzero()[:, 0]
    if not len(mixed):
        return _in_order(trees, rays)
    if not len(apart):
        return _by_sample(trees, rays)
    found = _in_order(trees, rays[apart]), _by_sample(trees, rays[mixed])
    return _scattered(found, (apart, mixed))


def overlaps(trees: Sequence[TreeTrace]) -> bool:
    """Returns whether trees are composited by sample, which makes the host wait for the device."""
    if any(one.tracer.shader.projection or one.tracer.shader.whole_ray for one in trees):
        return False
    return any(
        bool((torch.maximum(a.box[0], b.box[0]) < torch.minimum(a.box[1], b.box[1])).all())
        for a, b in combinations(trees, 2)
    )


def _shows(one: TreeTrace) -> bool:
    """Returns False if a tree is hidden by a transfer function without any opacity."""
    shader = one.tracer.shader  # surfaces and others only use the colour of a transfer function
    transfer = shader.transfer if isinstance(shader, Lit) else shader
    transfer = shader.function if isinstance(shader, Filtered) else transfer
    return not isinstance(transfer, TransferFunction) or bool(transfer.opacity[:, 1].any())


# --- one tree behind the other


def _in_order(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Composites trees in the order in which rays enter their boxes."""
    first, last = _spans(trees, rays).unbind(2)
    order = torch.where(first <= last, first, torch.inf).argsort(dim=0, stable=True)  # (m, r)
    hits = [one.trace(rays) for one in trees]
    fields = {name: _ranked(hits, name, order) for name in vars(hits[0])}
    ranked = [Hits(**{name: f[rank] for name, f in fields.items()}) for rank in range(len(trees))]
    return replace(reduce(over, ranked), normal=_mean_normal(ranked))


def _mean_normal(ranked: Sequence[Hits]) -> Tensor | None:
    """Returns (r, 3) mean normals, weighted by the light each tree absorbs; None if none exist."""
    taken = [one.normal * one.alpha for one in ranked if one.normal is not None]
    if not taken:
        return None
    total, alpha = taken[0], ranked[0].alpha
    for more, one in zip(taken[1:], ranked[1:], strict=True):
        total = total + (1 - alpha) * more
        alpha = alpha + (1 - alpha) * one.alpha
    return normalize(total, dim=1)


def _ranked(hits: Sequence[Hits], name: str, order: Tensor) -> Sequence[Any]:
    """Returns a field (r, ...) of m trees, in the order (m, r) of the trees along each ray."""
    filled = _filled(hits, name)
    if filled is None:
        return [None] * len(hits)
    stacked = torch.stack(filled)
    if stacked.dim() == 3:
        order = order[:, :, None].expand_as(stacked)
    return stacked.gather(0, order).unbind(0)


def _filled(hits: Sequence[Hits], name: str) -> list[Tensor] | None:
    """Returns a field (r, ...) of all `hits`, zeros or -1 where one lacks it; None if all do."""
    fields = [getattr(one, name) for one in hits]
    given = [field for field in fields if field is not None]
    if not given:
        return None
    if len({field.shape[1:] for field in given}) > 1:
        raise ValueError("render: all trees must give the same number of features")
    return [
        nothing_like(given[0], len(one.alpha)) if field is None else field
        for one, field in zip(hits, fields, strict=True)
    ]


# --- several trees in the same space


def _by_sample(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Composites trees by sample, a block of rays at a time."""
    size = _RAYS[rays.origin.device.type]
    blocks = [
        torch.arange(at, min(at + size, len(rays.origin)), device=rays.origin.device)
        for at in range(0, len(rays.origin), size)
    ]
    return _scattered([_block(trees, rays[block]) for block in blocks], blocks)


def _block(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces the nearest surface, and composites the media in front over it."""
    surfaces = [one for one in trees if one.tracer.shader.cut_surface() is not None]
    if not surfaces:
        return _media(trees, rays)
    media = [one for one in trees if one not in surfaces]
    back = reduce(_nearer, [one.trace(replace(rays, transmittance=None)) for one in surfaces])
    depth = back.depth.to(rays.range.dtype)
    front_range = torch.cat((rays.range[:, :1], torch.minimum(rays.range[:, 1:], depth)), 1)
    front = _nothing(rays, trees[0].tracer.dtype)
    if media:
        front = _media(media, replace(rays, range=front_range))
    hit_clear = 1 - trees[0].tracer.arguments.depth_alpha
    gone = rays.light() < hit_clear  # depth was found before these rays begin
    return over(front, replace(back, depth=torch.where(gone, torch.inf, back.depth)))


def _nearer(one: Hits, two: Hits) -> Hits:
    """Returns the nearer of two hits of each ray."""
    first, fields = (one.depth <= two.depth)[:, 0], {}
    for name in vars(one):
        pair = _filled((one, two), name)
        if pair is not None:
            a, b = pair
            fields[name] = torch.where(first if a.dim() == 1 else first[:, None], a, b)
    fields |= {"samples": one.samples + two.samples, "missed": one.missed | two.missed}
    return Hits(**fields)


def _media(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces rays from box to box: where a ray is in one box only, its tree is traced as usual."""
    span = _spans(trees, rays)
    ends = span.transpose(0, 1).flatten(1).sort(1).values  # (r, 2m)
    hits = _nothing(rays, trees[0].tracer.dtype, trees)
    stop = trees[0].tracer.arguments.stop_alpha
    for near, far in pairwise(ends.unbind(1)):
        middle = (near + far) / 2
        inside = (span[:, :, 0] <= middle) & (middle <= span[:, :, 1]) & (near < far)  # (m, r)
        for one, mine in zip(trees, inside, strict=True):
            alone = mine & (inside.sum(0) == 1)
            hits = _further(hits, rays, alone, (near, far), stop, one.trace)
        several = inside.sum(0) > 1
        if not bool(several.any()):
            continue
        for part in range(_PARTS):
            low, high = (near + (far - near) * (at / _PARTS) for at in (part, part + 1))
            high = far if part == _PARTS - 1 else high
            hits = _further(hits, rays, several, (low, high), stop, lambda r: _together(trees, r))
    return hits if hits.normal is None else replace(hits, normal=_unit(hits.normal))


def _further(
    hits: Hits,
    rays: Rays,
    which: Tensor,
    span: tuple[Tensor, Tensor],
    stop: float,
    trace: TraceRays,
) -> Hits:
    """Traces a stretch of those rays `which` (r,) bool that have not ended, and adds it behind
    their `hits`, whose normals are sums weighted by light.
    """
    at = (which & (hits.alpha[:, 0] < stop)).nonzero()[:, 0]
    if not len(at):
        return hits
    before = hits.alpha[at]
    light = (1 - before[:, 0]).to(torch.float64)
    part = replace(rays[at], range=torch.stack(span, 1)[at], transmittance=light)
    found = vars(trace(part)).copy()
    if found["normal"] is not None:
        found["normal"] = found["normal"] * (found["alpha"] - before)
    join: dict[str, Any] = {"depth": torch.minimum, "missed": torch.logical_or}
    join |= {"alpha": lambda _, whole: whole, "label": torch.maximum}  # only one is hit
    fields: dict[str, Any] = vars(hits).copy()
    for name, more in found.items():
        if more is None:
            continue
        known = fields[name]
        if known is None:
            known = nothing_like(more, len(which))
        fields[name] = known.index_copy(0, at, join.get(name, torch.add)(known[at], more))
    return Hits(**fields)


def _together(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces rays through media that fill the same space."""
    pieces, missed = _cut(trees, rays)
    shown = _Shown(pieces, trees[0].tracer.dtype)
    for one, covered in zip(trees, pieces.covered, strict=True):
        at = covered.nonzero()[:, 0]
        if len(at):
            hits = one.trace(pieces.rays(rays, at))
            shown.add(at, hits)
            missed = missed.index_put((pieces.ray[at[hits.missed]],), missed.new_ones(()))
    known, backend = trees[0].tracer.arguments, trees[0].tracer.backend
    clear = rays.light()[:, 0].contiguous()
    alpha, features = shown.alpha(), shown.features()
    total, left, before = ops.composite(
        *(alpha, features, pieces.offset(len(clear)), clear),
        stop_alpha=known.stop_alpha,
        backend=backend,
    )
    hit_clear = 1 - known.depth_alpha
    hit = ((before >= hit_clear) & (before * (1 - alpha) < hit_clear)).nonzero()[:, 0]
    near, far = pieces.span[hit].unbind(1)
    place = near + torch.log(before[hit] / hit_clear) / shown.extinction[hit, 0] * (far - near)
    label, samples = None, torch.zeros(len(clear), dtype=torch.int32, device=clear.device)
    if any(one.tracer.shader.reads_labels for one in trees):
        label = samples.new_full((len(clear), 1), -1, dtype=torch.int64)
    single = pieces.covered.sum(0)[hit] == 1
    for one, covered in zip(trees, pieces.covered, strict=True):
        mine, light = covered[hit], before[hit]
        if label is not None and one.tracer.shader.reads_labels:
            light = torch.where(single, light, hit_clear)  # among others: any alpha is a hit
        else:
            mine = mine & single  # a run of samples: its tree finds the depth
        at = mine.nonzero()[:, 0]
        if not len(at):
            continue
        found = one.trace(pieces.rays(rays, hit[at], light[at]))
        far = found.depth[:, 0].to(place)
        place[at] = torch.where(single[at] & (far < torch.inf), far, place[at])
        if found.label is not None and label is not None:
            label[pieces.ray[hit[at]]] = found.label
    depth = left.new_full((len(clear),), torch.inf).index_put((pieces.ray[hit],), place)
    samples.index_add_(0, pieces.ray, torch.where(before > 0, shown.samples, 0))
    return replace(shown.hits(total, left, depth, samples, missed), label=label)


class _Shown:
    """Colours, normals and features of pieces: sums over trees, weighted by extinction."""

    def __init__(self, pieces: _Pieces, dtype: torch.dtype) -> None:
        count, device = len(pieces.ray), pieces.ray.device
        self.dtype = dtype
        self.extinction = torch.zeros(count, 1, dtype=torch.float64, device=device)
        self.samples = torch.zeros(count, dtype=torch.int32, device=device)
        self.sums: dict[str, Tensor] = {}

    def add(self, at: Tensor, hits: Hits) -> None:
        """Adds a tree's hits in the pieces `at` (k,)."""
        alpha = hits.alpha.to(torch.float64)
        thick = -torch.log1p(-alpha.clamp(max=_MOST_ALPHA))
        self.extinction.index_add_(0, at, thick)
        self.samples.index_add_(0, at, hits.samples)
        share = thick / alpha.clamp(min=1e-300)  # from weights of alpha to weights of extinction
        normal = None if hits.normal is None else hits.normal * hits.alpha
        given = {"color": hits.color, "normal": normal, "features": hits.features}
        for name, field in given.items():
            if field is None:
                continue
            shape = (len(self.extinction), field.shape[1])
            known = self.sums.setdefault(name, self.extinction.new_zeros(shape))
            if known.shape != shape:
                raise ValueError("render: all trees must give the same number of features")
            known.index_add_(0, at, share * field)

    def alpha(self) -> Tensor:
        """Returns (k,) alphas of the pieces."""
        return -torch.expm1(-self.extinction)[:, 0]

    def features(self) -> Tensor:
        """Returns (k, c) all fields of `sums` of the pieces side by side, not premultiplied."""
        columns = [*self.sums.values()] or [self.extinction[:, :0]]
        return torch.cat(columns, 1) / self.extinction.clamp(min=1e-300)

    def hits(
        self, total: Tensor, left: Tensor, depth: Tensor, samples: Tensor, missed: Tensor
    ) -> Hits:
        """Returns the hits of rays, given sums (r, c) of `features` and the transmittance left."""
        widths = [one.shape[1] for one in self.sums.values()]
        given = dict(zip(self.sums, total.to(self.dtype).split(widths, 1), strict=True))
        color = given.get("color", total.new_zeros((len(total), 3), dtype=self.dtype))
        return Hits(
            color=color,
            alpha=(1 - left)[:, None].to(self.dtype),
            depth=depth[:, None].to(self.dtype),
            samples=samples,
            missed=missed,
            normal=_unit(given["normal"]) if "normal" in given else None,
            features=given.get("features"),
        )


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces of rays, ray after ray and front to back along each."""

    ray: Tensor  # (k,) int64
    span: Tensor  # (k, 2) float64 distances from the camera
    covered: Tensor  # (m, k) bool, the trees sampled there

    def rays(self, rays: Rays, at: Tensor, transmittance: Tensor | None = None) -> Rays:
        """Returns the pieces `at` (k,) as separate rays."""
        return replace(rays[self.ray[at]], range=self.span[at], transmittance=transmittance)

    def offset(self, rays: int) -> Tensor:
        """Returns (r + 1,) int64 indices of each ray's first piece; the last is their number."""
        count = torch.bincount(self.ray, minlength=rays)
        return torch.cat((count.new_zeros(1), count.cumsum(0)))


def _cut(trees: Sequence[TreeTrace], rays: Rays) -> tuple[_Pieces, Tensor]:
    """Cuts rays wherever an interval that one of the trees samples begins or ends; where only one
    is sampled, its intervals stay together. Also returns (r,) bool: the ray missed something.
    """
    missed = torch.zeros(len(rays.origin), dtype=torch.bool, device=rays.origin.device)
    ray, place, change = [], [], []
    for number, one in enumerate(trees):
        tracer = one.tracer
        given = ops.RayArguments.of(tracer.inside(replace(rays, transmittance=None)))
        known, table = tracer.arguments, tracer.arguments.table_lm4
        if table.dim() == 4:  # pre-integrated, (l, m, m, 4): use intervals of one value
            known = known._replace(table_lm4=table.diagonal(dim1=1, dim2=2).mT.contiguous())
        segments = ops.trace_segments(given, known, by_node=True, backend=tracer.backend)
        missed |= segments.missed
        batch = Batch(tracer, given, segments, ops.list_samples(segments))
        first = batch.moved[batch.ray] + batch.starts
        last = first + batch.lengths[:, 0]
        ends = [end.to(torch.float64).clamp(*rays.range[batch.ray].T) for end in (first, last)]
        for end, step in zip(ends, (1, -1), strict=True):
            ray.append(batch.ray)
            place.append(end)
            change.append(torch.zeros(len(end), len(trees), dtype=torch.int32, device=end.device))
            change[-1][:, number] = step
    rays_k, places_k = torch.cat(ray), torch.cat(place)
    order = places_k.argsort(stable=True)
    order = order[rays_k[order].argsort(stable=True)]
    rays_k, places_k = rays_k[order], places_k[order]
    covered = torch.cat(change)[order].cumsum(0) > 0  # just behind each end
    sliver = _SLIVER * min(one.tracer.arguments.step for one in trees)
    return _joined(rays_k, places_k, covered, sliver), missed


def _joined(ray: Tensor, place: Tensor, covered: Tensor, sliver: float) -> _Pieces:
    """Makes pieces from the sorted ends (k,) of intervals; `covered` (k, m): trees just behind."""
    same = ray[1:] == ray[:-1]
    near, far = place[:-1], place[1:]
    kept = (same & covered[:-1].any(1) & (far - near > sliver)).nonzero()[:, 0]
    ray, near, far, covered = ray[:-1][kept], near[kept], far[kept], covered[:-1][kept]
    if not len(ray):
        return _Pieces(ray, place.new_zeros((0, 2)), covered.T)
    # Slivers between pieces are added to the piece behind; a run of one tree stays one piece.
    joins = (ray[1:] == ray[:-1]) & (near[1:] - far[:-1] <= 8 * sliver)
    near = torch.cat((near[:1], torch.where(joins, far[:-1], near[1:])))
    alone = covered.sum(1) == 1
    run = joins & alone[1:] & alone[:-1] & (covered[1:] == covered[:-1]).all(1)
    starts = torch.cat((run.new_ones(1), ~run)).nonzero()[:, 0]
    ends = torch.cat((starts[1:] - 1, starts.new_tensor([len(ray) - 1])))
    return _Pieces(ray[starts], torch.stack((near[starts], far[ends]), 1), covered[starts].T)


# --- helpers


def _spans(trees: Sequence[TreeTrace], rays: Rays) -> Tensor:
    """Returns (m, r, 2) distances of rays in the trees' boxes; last < first where they miss."""
    spans = []
    for one in trees:
        own = one.tracer.inside(rays)
        low, high = pack((one.tracer.tree.box,), own.origin.dtype, own.origin.device).view(2, 3)
        first, last = box_span(low, high, own.origin, own.direction)
        near, far = rays.range.to(first).unbind(1)
        spans.append(torch.stack((torch.maximum(first, near), torch.minimum(last, far)), 1))
    return torch.stack(spans)


def _nothing(rays: Rays, dtype: torch.dtype, trees: Sequence[TreeTrace] = ()) -> Hits:
    """Returns hits of rays that have met nothing yet, with all fields that the trees give."""
    column = torch.zeros(len(rays.origin), 1, dtype=dtype, device=rays.origin.device)
    color = column.expand(-1, 3).contiguous()
    shaded = [
        (one.tracer.names, shading) for one in trees if (shading := one.tracer.shading) is not None
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


def _scattered(found: Sequence[Hits], places: Sequence[Tensor]) -> Hits:
    """Joins hits to (r,); each of `found` holds those at its indices `places` (k,)."""
    if len(found) == 1:
        return found[0]
    at = torch.cat(list(places)).argsort()
    fields = {}
    for name in vars(found[0]):
        if (parts := _filled(found, name)) is not None:
            fields[name] = torch.cat(parts)[at]
    return Hits(**fields)


def _unit(vectors: Tensor) -> Tensor:
    """Returns vectors (r, 3) of unit length, zeros as they are; the bits do not depend on r."""
    x, y, z = vectors.unbind(1)
    length = (x * x + y * y + z * z).sqrt()
    return vectors / torch.where(length > 0, length, 1)[:, None]
