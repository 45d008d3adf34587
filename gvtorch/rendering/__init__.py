"""Cameras, shaders, the renderer and the pictures it makes."""

from . import opengl
from .background import Backdrop, Environment, Gradient
from .camera import Camera
from .clip import Clip
from .compiled_shader import CompiledShader
from .costs import Cost, cost
from .custom import CustomCamera
from .image import read_image
from .layer import Layer
from .lens import ThinLens
from .lighting import Lighting
from .lights import DirectionalLight, Headlight, PointLight
from .module import TreeTracer
from .module_shader import ModuleShader, TransferModule
from .picture import Picture
from .progressive import Progressive
from .renderer import RenderOptions, render
from .shader import TransferFunction
from .shaders import (
    Features,
    Lit,
    PreIntegrated,
    Projection,
    Shader,
    StoredColor,
)
from .surfaces import DistanceField, Isosurface
from .tiles import render_tiles

__all__ = [
    "Backdrop",
    "Camera",
    "Clip",
    "CompiledShader",
    "Cost",
    "CustomCamera",
    "DirectionalLight",
    "DistanceField",
    "Environment",
    "Features",
    "Gradient",
    "Headlight",
    "Isosurface",
    "Layer",
    "Lighting",
    "Lit",
    "ModuleShader",
    "Picture",
    "PointLight",
    "PreIntegrated",
    "Progressive",
    "Projection",
    "RenderOptions",
    "Shader",
    "StoredColor",
    "ThinLens",
    "TransferFunction",
    "TransferModule",
    "TreeTracer",
    "cost",
    "opengl",
    "read_image",
    "render",
    "render_tiles",
]
