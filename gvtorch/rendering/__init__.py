"""Cameras, transfer functions, the renderer and the pictures it makes."""

from .background import Backdrop, Environment, Gradient
from .camera import Camera
from .custom import CustomCamera
from .image import read_image
from .module import TreeTracer
from .picture import Picture
from .progressive import Progressive
from .renderer import RenderOptions, render
from .shader import TransferFunction
from .tiles import render_tiles

__all__ = [
    "Backdrop",
    "Camera",
    "CustomCamera",
    "Environment",
    "Gradient",
    "Picture",
    "Progressive",
    "RenderOptions",
    "TransferFunction",
    "TreeTracer",
    "read_image",
    "render",
    "render_tiles",
]
