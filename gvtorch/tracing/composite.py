"""Hits put over hits: of the pieces of a ray, and of several trees.

Source: Porter, Duff, "Compositing digital images", 1984 (over, premultiplied).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from ..base.records import Hits, Rays
from ..ops.shading import pack

Trace = Callable[[Rays], Hits]


def trace_pieces(trace: Trace, pieces: Iterable[Rays]) -> Hits:
    """Traces pieces of the same rays, nearest first. What a piece lets through reaches the next, so
    a ray that has ended takes no samples any more, and depth is found in whichever piece it lies.
    """
    front: Hits | None = None
    for piece in pieces:
        if front is None:
            front = trace(piece)
        else:
            front = join(front, trace(behind(piece, front)))
    assert front is not None
    return front


def behind(rays: Rays, front: Hits) -> Rays:
    """The rays, with what `front` lets through of them."""
    return dataclasses.replace(rays, clear=1 - front.alpha[:, 0].to(torch.float64))


def join(front: Hits, back: Hits) -> Hits:
    """Hits of rays that were traced `behind` others: colours and features add up, alpha is the
    later one, and a normal counts by what its piece took of the light.
    """
    normal = _sum(front.normal, back.normal, front.alpha, back.alpha - front.alpha)
    return Hits(
        color=front.color + back.color,
        alpha=back.alpha,
        depth=torch.minimum(front.depth, back.depth),
        samples=front.samples + back.samples,
        missed=front.missed | back.missed,
        normal=None if normal is None else torch.nn.functional.normalize(normal, dim=1),
        features=_sum(front.features, back.features, 1, 1),
    )


def _sum(
    front: Tensor | None, back: Tensor | None, front_weight: Tensor | int, back_weight: Tensor | int
) -> Tensor | None:
    """The weighted sum of those that are given."""
    if front is None or back is None:
        return back if front is None else front
    return front * front_weight + back * back_weight


def composite_trees(trees: Sequence[tuple[Tensor, Trace]], rays: Rays) -> Hits:
    """Traces rays through several trees, each a (2, 3) box and what traces it, and puts them one
    over the other, nearest box first.

    Right wherever boxes do not overlap along a ray; where they do, the nearer box as a whole comes
    first.
    """
    near = torch.stack([_entry(box, rays) for box, _ in trees])  # (m, r)
    order = near.argsort(dim=0, stable=True)
    hits = [trace(rays) for _, trace in trees]
    fields = {
        name: torch.stack([vars(one)[name] for one in hits])
        for name in ("color", "alpha", "depth", "samples", "missed")
    }
    which = order[:, :, None]
    over = {name: fields[name] for name in ("color", "alpha")}
    for name in ("normal", "features"):
        given = [vars(one)[name] for one in hits if vars(one)[name] is not None]
        if given and len({field.shape[1] for field in given}) > 1:
            raise ValueError("render: trees must give as many features each")
        if given:
            none = torch.zeros_like(given[0])
            found = [vars(one)[name] for one in hits]
            over[name] = torch.stack([none if field is None else field for field in found])
    if "normal" in over:
        over["normal"] = over["normal"] * over["alpha"]
    over = {name: field.gather(0, which.expand_as(field)) for name, field in over.items()}
    depths = fields["depth"].gather(0, which)
    total = {name: field[0] for name, field in over.items()}
    for behind in range(1, len(trees)):
        clear = 1 - total["alpha"]
        total = {name: total[name] + clear * field[behind] for name, field in over.items()}
    if "normal" in total:
        total["normal"] = torch.nn.functional.normalize(total["normal"], dim=1)
    return Hits(
        **total,
        depth=depths.amin(0),
        samples=fields["samples"].sum(0, dtype=torch.int32),
        missed=fields["missed"].any(0),
    )


def _entry(box: Tensor, rays: Rays) -> Tensor:
    """(r,) distance at which rays enter a world box, +inf where they pass it by."""
    low, high = pack((box,), rays.origin.dtype, rays.origin.device).view(2, 3)
    a, b = (low - rays.origin) / rays.direction, (high - rays.origin) / rays.direction
    first, last = torch.fmin(a, b).amax(1), torch.fmax(a, b).amin(1)
    return torch.where(first <= last, first.clamp(min=0), torch.inf)
