"""The engine: frames that stream what the rays ask for."""

from .engine import Engine
from .frame_graph import FrameGraph
from .production import Failure, ProductionError
from .setup import EngineOptions, EngineSettings
from .stats import FrameStats

__all__ = [
    "Engine",
    "EngineOptions",
    "EngineSettings",
    "Failure",
    "FrameGraph",
    "FrameStats",
    "ProductionError",
]
