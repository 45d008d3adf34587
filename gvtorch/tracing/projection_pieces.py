"""`ProjectedPieces`: a `Projection` (maximum, minimum or mean) of rays cut into several pieces."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import torch
from torch import Tensor

from ..base.records import Hits, Rays
from .spans import tree_span
from .tracer import Tracer


class ProjectedPieces:
    """Projects each piece, then combines the pieces' values into that of the whole ray."""

    def __init__(self, tracer: Tracer, which: Literal["maximum", "minimum", "mean"]) -> None:
        """Takes the frame's tracer, and which projection it draws."""
        self._tracer, self._which = tracer, which

    def __call__(self, pieces: Iterable[Rays]) -> Hits:
        """Returns the largest or smallest value of all pieces, at its nearest place, or the mean of
        their means, weighted by their lengths inside the tree's box.
        """
        rays = list(pieces)
        hits = [self._tracer(piece) for piece in rays]
        depths = torch.stack([one.depth for one in hits])  # (pieces, r, 1)
        known = depths < torch.inf
        values = torch.stack([one.features for one in hits if one.features is not None])
        if self._which == "mean":
            lengths = torch.stack([self._length(piece) for piece in rays]).to(values)[..., None]
            lengths = torch.where(known, lengths, 0)
            value = (values * lengths).sum(0) / lengths.sum(0).clamp(min=1e-30)
        else:
            sign = 1 if self._which == "maximum" else -1
            best = torch.where(known, sign * values, -torch.inf).amax(0)
            known, value = known & (sign * values == best), sign * best
        depth = torch.where(known, depths, torch.inf).amin(0)
        seen = depth < torch.inf
        value = torch.where(seen, value, 0)
        light = rays[0].light().to(depth)
        return Hits(
            color=torch.where(seen, light * self._color(value), 0),
            alpha=torch.where(seen, 1, 1 - light),
            depth=depth,
            samples=torch.stack([one.samples for one in hits]).sum(0, dtype=torch.int32),
            missed=torch.stack([one.missed for one in hits]).any(0),
            normal=hits[0].normal,
            features=value,
        )

    def _color(self, value: Tensor) -> Tensor:
        """(r, 3) the transfer function's colours of values (r, 1), interpolated in its table."""
        table = self._tracer.arguments.table_lm4[0, :, :3]  # (m, 3), at even distances
        low, high = self._tracer.arguments.domain_2.unbind(0)
        last = len(table) - 1
        place = ((value - low) / (high - low) * last).clamp(0, last)
        row = place.to(torch.int64).clamp(max=last - 1)
        a, b = (table[(row + k)[:, 0]] for k in (0, 1))
        return a + (place - row) * (b - a)

    def _length(self, rays: Rays) -> Tensor:
        """(r,) world length of each ray inside the tree's box."""
        enter, leave = tree_span(self._tracer.tree.place, rays.origin, rays.direction)
        first, last = rays.range.unbind(1)
        return (torch.minimum(last, leave) - torch.maximum(first, enter)).clamp(min=0)
