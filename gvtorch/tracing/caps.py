"""Caps of isosurfaces: what a cut through their inside shows."""

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

_WHITE = TransferFunction.from_points([(0, 1)])  # one object, so that its table is made once


class SurfaceSlab:
    """Traces the intervals behind cuts: opaque where the first value lies inside the surface, in
    the surface's own colour, unlit. The isosurface shader itself shows nothing where a ray begins
    inside.
    """

    def __init__(self, shader: Isosurface, trace_with: Callable[[Projection], Trace]) -> None:
        """Takes the surface, and a function that gives the frame's tracer with another shader."""
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
        return dataclasses.replace(
            hits,
            color=torch.where(inside, color, 0),
            alpha=torch.where(inside, hits.alpha, 1 - rays.light().to(hits.alpha)),
            depth=torch.where(inside, hits.depth, torch.inf),
            features=None,
        )
