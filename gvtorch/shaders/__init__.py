"""Shaders: they turn the values along a ray into colour."""

from .built_in import *  # noqa: F403
from .built_in import __all__ as _built_in
from .channels import ChannelLook, Channels
from .compiled import CompiledShader
from .filtered import Filtered
from .labels import Labels
from .lights import DirectionalLight, Headlight, PointLight
from .module import ModuleShader, TransferModule
from .shader import Shader
from .transfer_function import TransferFunction

__all__ = [  # noqa: PLE0604
    "ChannelLook",
    "Channels",
    "CompiledShader",
    "DirectionalLight",
    "Filtered",
    "Headlight",
    "Labels",
    "ModuleShader",
    "PointLight",
    "Shader",
    "TransferFunction",
    "TransferModule",
    *_built_in,
]
