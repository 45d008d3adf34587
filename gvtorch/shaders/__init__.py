"""Shaders: they turn the values along a ray into colour."""

from .built_in import *  # noqa: F403
from .channels import ChannelLook as ChannelLook
from .channels import Channels as Channels
from .compiled import CompiledShader as CompiledShader
from .filtered import Filtered as Filtered
from .labels import Labels as Labels
from .lights import DirectionalLight as DirectionalLight
from .lights import Headlight as Headlight
from .lights import PointLight as PointLight
from .module import ModuleShader as ModuleShader
from .module import TransferModule as TransferModule
from .shader import Shader as Shader
from .transfer_function import TransferFunction as TransferFunction
