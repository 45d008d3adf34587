"""Compositing of hits: of a ray's pieces, of another renderer's picture; where rays meet boxes.

Source: Porter, Duff, "Compositing digital images", 1984 (over, premultiplied).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..base.records import Hits, Rays

TraceRays = Callable[[Rays], Hits]  # a tracer, possibly wrapped by the options' effects


def over(front: Hits, back: Hits, *, dimmed: bool = False) -> Hits:
    """Composites `front` over `back`, hits of the same rays; normals are the mean of both, weighted
    by the light each absorbs. If `dimmed`, `back` was traced with `behind(rays, front)` and its
    alpha includes that of `front`; else with rays of full light.
    """
    color, alpha, features = back.color, back.alpha, back.features
    absorbed = None if back.normal is None else back.normal * (alpha - front.alpha)
    if not dimmed:
        transmittance = 1 - front.alpha
        color, alpha = transmittance * color, front.alpha + transmittance * alpha
        features = None if features is None else transmittance * features
        absorbed = None if back.normal is None else transmittance * (back.normal * back.alpha)
    normal = front.normal if back.normal is None else back.normal
    if front.normal is not None and absorbed is not None:
        normal = normalize(front.normal * front.alpha + absorbed, dim=1)
    if front.features is not None:
        features = front.features if features is None else front.features + features
    return Hits(
        color=front.color + color,
        alpha=alpha,
        depth=torch.minimum(front.depth, back.depth),
        samples=front.samples + back.samples,
        missed=front.missed | back.missed,
        normal=normal,
        features=features,
        label=_nearer_label(front, back),
    )


def _nearer_label(front: Hits, back: Hits) -> Tensor | None:
    """Returns (r, 1) the label of whichever is hit first; None if neither has labels."""
    labels = columns_of((front, back), "label")
    if labels is None:
        return None
    near, far = labels
    return torch.where(front.depth <= back.depth, near, far)


def nothing_like(field: Tensor, rays: int) -> Tensor:
    """Returns the field (r, ...) of rays that hit nothing: zeros, or -1 for labels."""
    return field.new_full((rays, *field.shape[1:]), -1 if field.dtype == torch.int64 else 0)


def columns_of(hits: Sequence[Hits], name: str) -> list[Tensor] | None:
    """Returns a field (r, ...) of all `hits`, zeros or -1 where one lacks it; None if all do."""
    fields = [getattr(tree_hits, name) for tree_hits in hits]
    present = [field for field in fields if field is not None]
    if not present:
        return None
    if len({field.shape[1:] for field in present}) > 1:
        raise ValueError("render: all trees must give the same number of features")
    pairs = zip(hits, fields, strict=True)
    return [nothing_like(present[0], len(h.alpha)) if f is None else f for h, f in pairs]


def merged(hits: Sequence[Hits], merge: Callable[[list[Tensor]], Tensor]) -> Hits:
    """Returns hits of which each field is `merge` of its columns in all `hits`: `columns_of`."""
    columns = {name: columns_of(hits, name) for name in vars(hits[0])}
    return Hits(**{name: merge(parts) for name, parts in columns.items() if parts is not None})


def join_hits(parts: Sequence[Hits], indices: Sequence[Tensor]) -> Hits:
    """Joins hits to (r,); each of `parts` holds those at its indices `indices` (k,)."""
    if len(parts) == 1:
        return parts[0]
    order = torch.cat(list(indices)).argsort()
    return merged(parts, lambda columns: torch.cat(columns)[order])


def behind(rays: Rays, front: Hits) -> Rays:
    """Returns the rays with the transmittance that `front` leaves."""
    return replace(rays, transmittance=1 - front.alpha[:, 0].to(torch.float64))


def reaches_depth(before: Tensor, after: Tensor, depth_alpha: float) -> Tensor:
    """Returns (k,) bool, in which parts of rays alpha passes `depth_alpha`, so that the depth lies
    there, given the transmittance before and after each part (k,).
    """
    hit_clear = 1 - depth_alpha
    return (before >= hit_clear) & (after < hit_clear)


def indices_if_few(mask: Tensor) -> Tensor | None:
    """Returns the indices where `mask` (r,) is true if they are less than half, on the CPU; else
    None: for more of them a separate trace saves no time, and on the GPU the host would wait.
    """
    if mask.device.type != "cpu":
        return None
    index = mask.nonzero()[:, 0]
    return index if 2 * len(index) < len(mask) else None


def scatter_hits(rays: Rays, index: Tensor, hits: Hits) -> Hits:
    """Returns the hits of all rays (r), given those of the rays `index` (k,): the others have empty
    ranges, so they hit nothing and keep their transmittance.
    """
    columns: dict[str, Any] = {}
    for name, values in vars(hits).items():
        if values is not None:
            filler = nothing_like(values, len(rays.origin))
            if name == "alpha":
                filler = 1 - rays.light().to(values)
            elif name == "depth":
                filler.fill_(torch.inf)
            columns[name] = filler.index_put((index,), values)
    return Hits(**columns)


def trace_pieces(trace: TraceRays, pieces: Iterable[Rays], *, cap: TraceRays | None = None) -> Hits:
    """Traces pieces of the same rays, nearest first. The result is that of tracing each ray in one
    pass: one that has ended takes no more samples, and its depth is found in the piece that
    contains it. `cap` traces the cap in front of each piece.
    """

    def trace_open(rays: Rays) -> Hits:
        index = indices_if_few(rays.range[:, 0] < rays.range[:, 1])
        return trace(rays) if index is None else scatter_hits(rays, index, trace(rays[index]))

    steps = ((step, piece) for piece in pieces for step in (cap, trace_open) if step is not None)
    first, piece = next(steps)
    front = first(piece)
    for step, piece in steps:
        front = over(front, step(behind(piece, front)), dimmed=True)
    return front


def box_span(low: Tensor, high: Tensor, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Returns (r,) first and last distances of lines (r, 3) in a box; last < first if outside."""
    a, b = (low - origin) / direction, (high - origin) / direction
    # 0 / 0: the line lies in a face, so this axis does not bound it.
    first = torch.minimum(a, b).nan_to_num(-torch.inf, torch.inf, -torch.inf)
    last = torch.maximum(a, b).nan_to_num(torch.inf, torch.inf, -torch.inf)
    return first.amax(1), last.amin(1)


def tree_span(place_33: Tensor, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Returns `box_span` of a tree's box, given `N3Tree.place`."""
    low, size, high = place_33
    return box_span(low, low + size * high, origin, direction)
