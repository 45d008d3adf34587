"""Cameras, transfer functions, the renderer and the pictures it makes."""

from .camera import Camera
from .module import TreeTracer
from .module_shader import ModuleShader, TransferModule
from .picture import Picture
from .renderer import RenderOptions, render
from .shader import TransferFunction

__all__ = [
    "Camera",
    "ModuleShader",
    "Picture",
    "RenderOptions",
    "TransferFunction",
    "TransferModule",
    "TreeTracer",
    "render",
]
