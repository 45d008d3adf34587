"""Cameras, shaders, lights, the renderer and the pictures it makes."""

from .camera import Camera
from .lights import DirectionalLight, Headlight, PointLight
from .module import TreeTracer
from .picture import Picture
from .renderer import RenderOptions, render
from .shader import TransferFunction
from .shaders import (
    DistanceField,
    Features,
    Isosurface,
    Lit,
    PreIntegrated,
    Projection,
    Shader,
    StoredColor,
)

__all__ = [
    "Camera",
    "DirectionalLight",
    "DistanceField",
    "Features",
    "Headlight",
    "Isosurface",
    "Lit",
    "Picture",
    "PointLight",
    "PreIntegrated",
    "Projection",
    "RenderOptions",
    "Shader",
    "StoredColor",
    "TransferFunction",
    "TreeTracer",
    "render",
]
