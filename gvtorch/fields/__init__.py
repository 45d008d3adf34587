"""Fields: functions of place, in torch alone."""

from . import noise, sdf
from .distance import Distance
from .field import Bounds, Field, Interval, Values, length, tighter
from .fractals import Fractal, Iteration, Julia, Mandelbox, Mandelbulb
from .fur import Fur
from .sampled import SampledDistance
from .solid import Solid

__all__ = [
    "Bounds",
    "Distance",
    "Field",
    "Fractal",
    "Fur",
    "Interval",
    "Iteration",
    "Julia",
    "Mandelbox",
    "Mandelbulb",
    "SampledDistance",
    "Solid",
    "Values",
    "length",
    "noise",
    "sdf",
    "tighter",
]
