"""Caps of isosurfaces: what a cut through their inside shows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from ..base.records import Hits, Rays
from ..ops.shading import pack
from ..shaders.shader import CutSurface, Shader
from .composite import Trace


class SurfaceSlab:
    """Traces the intervals behind cuts: opaque where the first value lies inside the surface, in
    the surface's own colour, unlit. The isosurface shader itself shows nothing where a ray begins
    inside.
    """

    def __init__(self, surface: CutSurface, trace_with: Callable[[Shader], Trace]) -> None:
        """Takes the surface, and a function that gives the frame's tracer with another shader."""
        self._surface = surface
        self._value = trace_with(surface.value)
        self._colors = None if surface.colors is None else trace_with(surface.colors)

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units, each no longer than one interval."""
        hits = self._value(rays)
        assert hits.features is not None
        colors = hits.color if self._colors is None else self._colors(rays).color
        color = colors * pack((self._surface.color,), colors.dtype, colors.device)
        level = pack((self._surface.level,), color.dtype, color.device)
        inside = (hits.features >= level) != self._surface.below
        inside = inside & (hits.depth < torch.inf)
        return dataclasses.replace(
            hits,
            color=torch.where(inside, color, 0),
            alpha=torch.where(inside, hits.alpha, 1 - rays.light().to(hits.alpha)),
            depth=torch.where(inside, hits.depth, torch.inf),
            features=None,
        )
