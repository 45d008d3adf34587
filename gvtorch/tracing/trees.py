"""Rays through several trees: `trace_trees`. Where their boxes do not overlap along a ray, trees
are traced one by one and composited in the order in which it enters them; else see overlapping.py.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from itertools import combinations
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..base import check
from ..base.records import Hits, Rays
from ..pool import N3Tree
from ..shaders.shader import Shader, check_shader
from .composite import join_hits, merged, over
from .effects import TreeTrace, box_spans
from .options import RenderOptions
from .overlapping import mix_by_sample
from .pose import poses_of, world_box
from .tracer import Tracer

#: A shader for all trees, or one for each by name.
Shaders = Shader | Mapping[str, Shader]


def tree_traces(
    context: str,
    scene: Mapping[str, tuple[N3Tree, Collection[str]]],  # by name: the tree, and its channel names
    shaders: Shaders,
    options: RenderOptions,  # its channel is the first of each tree if left out
    *,
    by_level: bool = False,
    frame_1: Tensor | None = None,
) -> list[TreeTrace]:
    """Prepares the tracers of all trees for one frame. Raises ValueError if a shader is missing, or
    a tree has no such channel; see `Tracer` and `with_effects`.
    """
    traces, poses = [], poses_of(context, scene, options.pose)
    box = box_around([world_box(tree.box, poses[name]) for name, (tree, _) in scene.items()])
    for name, (tree, channels) in scene.items():
        shader: Any = shaders.get(name) if isinstance(shaders, Mapping) else shaders
        check_shader(context, f"shader of tree {name!r}", shader)
        channel = options.channel or next(iter(channels))
        for needed in (channel, *shader.channels):
            check.channel(context, needed, channels, f"tree {name!r}")
        tree_options = replace(options, channel=channel, pose=poses[name])
        tracer = Tracer(tree, shader, tree_options, by_level=by_level, frame_1=frame_1)
        traces.append(TreeTrace.of(tracer, tree_options, box))
    return traces


def box_around(boxes: Sequence[Tensor]) -> Tensor:
    """Returns the corners (2, 3) of the box around all `boxes` (2, 3)."""
    if len(boxes) == 1:
        return boxes[0]
    low, high = torch.stack([*boxes]).unbind(1)
    return torch.stack((low.amin(0), high.amax(0)))


def trace_trees(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Traces rays through several trees; see the head of this file.

    Where no ray has a sample, gradients by all that module shaders learn are 0, so that a loss can
    always be taken backward.
    """
    hits = _trace_trees(trees, rays)
    if not torch.is_grad_enabled() or hits.color.requires_grad:
        return hits
    learned = [tensor for tree in trees for tensor in tree.tracer.learned()]
    if not learned:
        return hits
    zeros = [tensor.flatten()[:0].sum().to(hits.color) for tensor in learned]
    return replace(hits, color=sum(zeros, hits.color), alpha=sum(zeros, hits.alpha))


def _trace_trees(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """See `trace_trees`. Projections, and shaders that must see a whole ray at once, are not
    composited by sample: the tree whose box is entered first is in front as a whole.
    """
    if len(trees) == 1:
        return trees[0].trace(rays)
    if not overlaps(trees):
        return _trace_in_order(trees, rays)
    trees = [tree for tree in trees if not tree.tracer.shader.shows_nothing] or trees[:1]
    if len(trees) == 1:
        return trees[0].trace(rays)
    first, last = box_spans(trees, rays).unbind(2)
    pairs = combinations(range(len(trees)), 2)
    shared = [torch.maximum(first[a], first[b]) < torch.minimum(last[a], last[b]) for a, b in pairs]
    is_shared = torch.stack(shared).any(0)
    mixed_rays, separate_rays = is_shared.nonzero()[:, 0], (~is_shared).nonzero()[:, 0]
    if not len(mixed_rays):
        return _trace_in_order(trees, rays)
    if not len(separate_rays):
        return mix_by_sample(trees, rays)
    parts = _trace_in_order(trees, rays[separate_rays]), mix_by_sample(trees, rays[mixed_rays])
    return join_hits(parts, (separate_rays, mixed_rays))


def overlaps(trees: Sequence[TreeTrace]) -> bool:
    """Returns whether trees are composited by sample, which makes the host wait for the device."""
    if any(tree.tracer.shader.projection or tree.tracer.shader.whole_ray for tree in trees):
        return False
    return any(
        bool((torch.maximum(a.box[0], b.box[0]) < torch.minimum(a.box[1], b.box[1])).all())
        for a, b in combinations(trees, 2)
    )


def _trace_in_order(trees: Sequence[TreeTrace], rays: Rays) -> Hits:
    """Composites trees in the order in which rays enter their boxes."""
    first, last = box_spans(trees, rays).unbind(2)
    order = torch.where(first <= last, first, torch.inf).argsort(dim=0, stable=True)  # (m, r)

    def in_ray_order(columns: list[Tensor]) -> Tensor:
        stacked = torch.stack(columns)  # (m, r) or (m, r, c)
        index = order if stacked.dim() == 2 else order[:, :, None].expand_as(stacked)
        return stacked.gather(0, index)

    ordered = vars(merged([tree.trace(rays) for tree in trees], in_ray_order)).items()
    fields: dict[str, Tensor] = {name: field for name, field in ordered if field is not None}
    ranked = [Hits(**{n: f[rank] for n, f in fields.items()}) for rank in range(len(trees))]
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
