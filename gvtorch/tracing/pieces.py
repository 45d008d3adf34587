"""Rays traced in pieces, from front to back, as if each were traced in one go."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from ..base.records import Hits, Rays

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
