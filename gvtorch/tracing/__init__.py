"""Tracing: from rays to hits, and from a camera to a picture of a resident tree."""

from .clip import Clip as Clip
from .costs import Cost as Cost
from .costs import cost as cost
from .layer import Layer as Layer
from .lighting import Lighting as Lighting
from .options import RenderOptions as RenderOptions
from .options import RenderSettings as RenderSettings
from .pixels import render as render
from .pixels import trace as trace
from .point_layer import point_layer as point_layer
from .slices import slice_picture as slice_picture
from .thin_lens import ThinLens as ThinLens
from .tree_tracer import TreeTracer as TreeTracer
