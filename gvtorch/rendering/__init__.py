"""Cameras, transfer functions, the renderer and the pictures it makes."""

from . import opengl
from .camera import Camera
from .layer import Layer
from .module import TreeTracer
from .picture import Picture
from .renderer import RenderOptions, render
from .shader import TransferFunction

__all__ = [
    "Camera",
    "Layer",
    "Picture",
    "RenderOptions",
    "TransferFunction",
    "TreeTracer",
    "opengl",
    "render",
]
