"""Cameras, transfer functions, the renderer and the pictures it makes."""

from .camera import Camera
from .costs import Cost, cost
from .module import TreeTracer
from .module_shader import ModuleShader, TransferModule
from .picture import Picture
from .renderer import RenderOptions, render
from .shader import TransferFunction

__all__ = [
    "Camera",
    "Cost",
    "ModuleShader",
    "Picture",
    "RenderOptions",
    "TransferFunction",
    "TransferModule",
    "TreeTracer",
    "cost",
    "render",
]
