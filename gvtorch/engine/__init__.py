"""The engine: frames that stream what the rays ask for."""

from .engine import Engine as Engine
from .frame_graph import FrameGraph as FrameGraph
from .production import Failure as Failure
from .production import ProductionError as ProductionError
from .setup import EngineOptions as EngineOptions
from .setup import EngineSettings as EngineSettings
from .stats import FrameStats as FrameStats
