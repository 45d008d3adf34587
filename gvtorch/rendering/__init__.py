"""Cameras, transfer functions, the renderer and the pictures it makes."""

from .camera import Camera
from .picture import Picture
from .module import TreeTracer
from .renderer import RenderOptions, render
from .shader import TransferFunction

__all__ = ["Camera", "Picture", "RenderOptions", "TransferFunction", "TreeTracer", "render"]
