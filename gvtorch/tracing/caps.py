"""What a cut through the inside of an isosurface shows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from ..base.records import Hits, Rays
from ..ops.shading import pack
from ..shaders.fused import Projection
from ..shaders.surfaces import Isosurface
from ..shaders.transfer_function import TransferFunction
from .composite import Trace

_WHITE = TransferFunction.from_points([(0, 1)])  # kept: its table is made once


class SurfaceSlab:
    """Traces slabs behind cuts: opaque where the first value lies inside of a surface, in the
    surface's own colour, unlit. An isosurface alone shows nothing where a ray begins inside.
    """

    def __init__(self, shader: Isosurface, trace_with: Callable[[Projection], Trace]) -> None:
        """Takes the surface, and what gives the tracer of the same frame with another shader."""
        self._shader = shader
        value = Projection("maximum", _WHITE)
        value.channel, value.component = shader.channel, shader.component
        self._value = trace_with(value)
        self._color: Trace | None = None
        if isinstance(shader.color, TransferFunction):
            color = Projection("maximum", shader.color)
            color.channel, color.component = shader.other, shader.other_component
            self._color = trace_with(color)

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units, each no longer than one interval."""
        hits = self._value(rays)
        color = hits.color
        if self._color is not None:
            color = self._color(rays).color
        elif not isinstance(self._shader.color, TransferFunction):
            color = color * pack((self._shader.color,), color.dtype, color.device)
        assert hits.features is not None
        level = pack((self._shader.value,), color.dtype, color.device)
        inside = (hits.features >= level) != self._shader.distance
        inside = inside & (hits.depth < torch.inf)
        clear = torch.ones_like(hits.alpha) if rays.clear is None else rays.clear[:, None]
        return dataclasses.replace(
            hits,
            color=torch.where(inside, color, 0),
            alpha=torch.where(inside, hits.alpha, 1 - clear.to(hits.alpha)),
            depth=torch.where(inside, hits.depth, torch.inf),
            features=None,
        )
