"""The engine: frames that stream what the rays ask for."""

from .engine import Engine
from .production import ProductionError
from .setup import EngineOptions

__all__ = ["Engine", "EngineOptions", "ProductionError"]
