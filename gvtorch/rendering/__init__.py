"""Cameras, transfer functions, the renderer and the pictures it makes."""

from . import opengl
from .camera import Camera
from .costs import Cost, cost
from .layer import Layer
from .module import TreeTracer
from .module_shader import ModuleShader, TransferModule
from .picture import Picture
from .renderer import RenderOptions, render
from .shader import TransferFunction

__all__ = [
    "Camera",
    "Cost",
    "Layer",
    "ModuleShader",
    "Picture",
    "RenderOptions",
    "TransferFunction",
    "TransferModule",
    "TreeTracer",
    "cost",
    "opengl",
    "render",
]
