"""GigaVoxels on PyTorch tensors: explore, render and learn from scenes far larger than memory.

Names are loaded when they are first used, so that `gvtorch --help` does not wait for torch. A
program that only loads TorchScript archives or exported programs imports `gvtorch.ops`, which
registers the ops.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .engine import Engine, EngineOptions
    from .frame import FrameStats, Hits, Rays
    from .io import read_volume
    from .pool import BrickPool, BrickTable, Channel, N3Tree, NodePool
    from .producers import Bricks, Nodes, Producer, Region, Regions, StoredProducer, VolumeProducer
    from .production import ProductionError
    from .rendering import (
        Camera,
        Clip,
        Picture,
        RenderOptions,
        ThinLens,
        TransferFunction,
        TreeTracer,
        render,
    )
    from .volume import Volume

__version__ = "0.1.0"

_HOME = {
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
    "Clip": ".rendering",
    "Hits": ".frame",
    "N3Tree": ".pool",
    "NodePool": ".pool",
    "Picture": ".rendering",
    "Rays": ".frame",
    "RenderOptions": ".rendering",
    "ThinLens": ".rendering",
    "TransferFunction": ".rendering",
    "TreeTracer": ".rendering",
    "Volume": ".volume",
    "read_volume": ".io",
    "render": ".rendering",
}

__all__ = [
    "BrickPool",
    "BrickTable",
    "Bricks",
    "Camera",
    "Channel",
    "Clip",
    "Engine",
    "EngineOptions",
    "FrameStats",
    "Hits",
    "N3Tree",
    "NodePool",
    "Nodes",
    "Picture",
    "Producer",
    "ProductionError",
    "Rays",
    "Region",
    "Regions",
    "RenderOptions",
    "StoredProducer",
    "ThinLens",
    "TransferFunction",
    "TreeTracer",
    "Volume",
    "VolumeProducer",
    "read_volume",
    "render",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'gvtorch' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name], __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
