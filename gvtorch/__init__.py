"""GigaVoxels on PyTorch tensors: explore, render and learn from scenes far larger than memory.

Names are loaded when they are first used, so that `gvtorch --help` does not wait for torch. A
program that only loads TorchScript archives or exported programs imports `gvtorch.ops`, which
registers the ops.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .cpp_ext.user import CompileError
    from .engine import Engine, EngineOptions
    from .frame import FrameStats, Hits, Rays
    from .io import read_volume
    from .pool import BrickPool, BrickTable, Channel, N3Tree, NodePool
    from .producers import Bricks, Nodes, Producer, Region, Regions, StoredProducer, VolumeProducer
    from .production import ProductionError
    from .rendering import (
        Backdrop,
        Camera,
        Clip,
        CompiledShader,
        Cost,
        CustomCamera,
        DirectionalLight,
        DistanceField,
        Environment,
        Features,
        Gradient,
        Headlight,
        Isosurface,
        Layer,
        Lighting,
        Lit,
        ModuleShader,
        Picture,
        PointLight,
        PreIntegrated,
        Progressive,
        Projection,
        RenderOptions,
        Shader,
        StoredColor,
        ThinLens,
        TransferFunction,
        TransferModule,
        TreeTracer,
        cost,
        opengl,
        read_image,
        render,
        render_tiles,
    )
    from .volume import Volume

__version__ = "0.1.0"

_HOME = {
    "Backdrop": ".rendering",
    "CustomCamera": ".rendering",
    "Environment": ".rendering",
    "Gradient": ".rendering",
    "Progressive": ".rendering",
    "read_image": ".rendering",
    "render_tiles": ".rendering",
    "BrickPool": ".pool",
    "BrickTable": ".pool",
    "Bricks": ".producers",
    "Engine": ".engine",
    "EngineOptions": ".engine",
    "FrameStats": ".frame",
    "Nodes": ".producers",
    "Producer": ".producers",
    "ProductionError": ".production",
    "Region": ".producers",
    "Regions": ".producers",
    "StoredProducer": ".producers",
    "VolumeProducer": ".producers",
    "Camera": ".rendering",
    "Channel": ".pool",
    "Cost": ".rendering",
    "Clip": ".rendering",
    "CompileError": ".cpp_ext.user",
    "CompiledShader": ".rendering",
    "Hits": ".frame",
    "ModuleShader": ".rendering",
    "Layer": ".rendering",
    "N3Tree": ".pool",
    "NodePool": ".pool",
    "Picture": ".rendering",
    "Rays": ".frame",
    "RenderOptions": ".rendering",
    "DirectionalLight": ".rendering",
    "DistanceField": ".rendering",
    "Features": ".rendering",
    "Headlight": ".rendering",
    "Isosurface": ".rendering",
    "Lighting": ".rendering",
    "Lit": ".rendering",
    "PointLight": ".rendering",
    "PreIntegrated": ".rendering",
    "Projection": ".rendering",
    "Shader": ".rendering",
    "StoredColor": ".rendering",
    "ThinLens": ".rendering",
    "TransferFunction": ".rendering",
    "TransferModule": ".rendering",
    "TreeTracer": ".rendering",
    "Volume": ".volume",
    "cost": ".rendering",
    "opengl": ".rendering",
    "read_volume": ".io",
    "render": ".rendering",
}

__all__ = [
    "Backdrop",
    "BrickPool",
    "BrickTable",
    "Bricks",
    "Camera",
    "Channel",
    "Clip",
    "CompileError",
    "CompiledShader",
    "Cost",
    "CustomCamera",
    "DirectionalLight",
    "DistanceField",
    "Engine",
    "EngineOptions",
    "Environment",
    "Features",
    "FrameStats",
    "Gradient",
    "Headlight",
    "Hits",
    "Isosurface",
    "Layer",
    "Lighting",
    "Lit",
    "ModuleShader",
    "N3Tree",
    "NodePool",
    "Nodes",
    "Picture",
    "PointLight",
    "PreIntegrated",
    "Producer",
    "ProductionError",
    "Progressive",
    "Projection",
    "Rays",
    "Region",
    "Regions",
    "RenderOptions",
    "Shader",
    "StoredColor",
    "StoredProducer",
    "ThinLens",
    "TransferFunction",
    "TransferModule",
    "TreeTracer",
    "Volume",
    "VolumeProducer",
    "cost",
    "opengl",
    "read_image",
    "read_volume",
    "render",
    "render_tiles",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'gvtorch' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name], __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
