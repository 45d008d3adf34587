"""Shaders: what turns the values along a ray into colour."""

from .compiled import CompiledShader
from .fused import Features, Lit, PreIntegrated, Projection, Shader, StoredColor
from .lights import DirectionalLight, Headlight, PointLight
from .surfaces import DistanceField, Isosurface
from .transfer_function import TransferFunction

__all__ = [
    "CompiledShader",
    "DirectionalLight",
    "DistanceField",
    "Features",
    "Headlight",
    "Isosurface",
    "Lit",
    "PointLight",
    "PreIntegrated",
    "Projection",
    "Shader",
    "StoredColor",
    "TransferFunction",
]
