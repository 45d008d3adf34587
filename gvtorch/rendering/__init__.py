"""Cameras, transfer functions, the renderer and the pictures it makes."""

from . import opengl
from .background import Backdrop, Environment, Gradient
from .camera import Camera
from .costs import Cost, cost
from .custom import CustomCamera
from .image import read_image
from .layer import Layer
from .module import TreeTracer
from .module_shader import ModuleShader, TransferModule
from .picture import Picture
from .progressive import Progressive
from .renderer import RenderOptions, render
from .shader import TransferFunction
from .tiles import render_tiles

__all__ = [
    "Backdrop",
    "Camera",
    "Cost",
    "CustomCamera",
    "Environment",
    "Gradient",
    "Layer",
    "ModuleShader",
    "Picture",
    "Progressive",
    "RenderOptions",
    "TransferFunction",
    "TransferModule",
    "TreeTracer",
    "cost",
    "opengl",
    "read_image",
    "render",
    "render_tiles",
]
