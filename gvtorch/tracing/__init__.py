"""Tracing: from rays to hits, and from a camera to a picture of a resident tree."""

from .clip import Clip
from .costs import Cost, cost
from .layer import Layer
from .lighting import Lighting
from .options import RenderOptions, RenderSettings
from .pixels import render, trace
from .thin_lens import ThinLens
from .tree_tracer import TreeTracer

__all__ = [
    "Clip",
    "Cost",
    "Layer",
    "Lighting",
    "RenderOptions",
    "RenderSettings",
    "ThinLens",
    "TreeTracer",
    "cost",
    "render",
    "trace",
]
