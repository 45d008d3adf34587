"""Cameras, transfer functions, the renderer and the pictures it makes."""

from .camera import Camera
from .clip import Clip
from .lens import ThinLens
from .module import TreeTracer
from .picture import Picture
from .renderer import RenderOptions, render
from .shader import TransferFunction

__all__ = [
    "Camera",
    "Clip",
    "Picture",
    "RenderOptions",
    "ThinLens",
    "TransferFunction",
    "TreeTracer",
    "render",
]
