"""The engine: frames that stream what the rays ask for."""

from .engine import Engine, FrameGraph
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
