"""`ProjectedPieces`: the maximum, minimum or mean along rays of which several pieces are kept."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from ..base.records import Hits, Rays
from ..shaders.fused import Projection
from .tracer import Tracer


class ProjectedPieces:
    """Traces the pieces of rays one by one; the picture is that of what all of them hold."""

    def __init__(self, tracer: Tracer, shader: Projection) -> None:
        """Takes what traces with the projection."""
        self._tracer, self._which = tracer, shader.which

    def __call__(self, pieces: Iterable[Rays]) -> Hits:
        """Returns the extreme of pieces in world units, where it is nearest, or the mean of their
        means, weighted by their lengths in the box.
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
        clear = torch.ones_like(depth) if rays[0].clear is None else rays[0].clear[:, None]
        clear = clear.to(depth)
        return Hits(
            color=torch.where(seen, clear * self._color(value), 0),
            alpha=torch.where(seen, 1, 1 - clear),
            depth=depth,
            samples=torch.stack([one.samples for one in hits]).sum(0, dtype=torch.int32),
            missed=torch.stack([one.missed for one in hits]).any(0),
            normal=hits[0].normal,
            features=value,
        )

    def _color(self, value: Tensor) -> Tensor:
        """(r, 3) the transfer function's colours of values (r, 1)."""
        table = self._tracer.arguments["table_lm4"][0, :, :3]  # (m, 3), at even distances
        low, high = self._tracer.arguments["domain_2"].unbind(0)
        last = len(table) - 1
        place = ((value - low) / (high - low) * last).clamp(0, last)
        row = place.to(torch.int64).clamp(max=last - 1)
        a, b = (table[(row + k)[:, 0]] for k in (0, 1))
        return a + (place - row) * (b - a)

    def _length(self, rays: Rays) -> Tensor:
        """(r,) world length of what lies in the tree's box."""
        low, size, high = self._tracer.tree.place
        a, b = ((end - rays.origin) / rays.direction for end in (low, low + size * high))
        first, last = rays.range.unbind(1)
        enter, leave = torch.fmin(a, b).amax(1), torch.fmax(a, b).amin(1)
        return (torch.minimum(last, leave) - torch.maximum(first, enter)).clamp(min=0)
