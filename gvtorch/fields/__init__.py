"""Fields: functions of place, in torch alone."""

from . import sdf
from .distance import Distance
from .field import Bounds, Field, Interval, Values, length, tighter
from .fractals import Fractal, Iteration, Julia, Mandelbox, Mandelbulb
from .solid import Solid

__all__ = [
    "Bounds",
    "Distance",
    "Field",
    "Fractal",
    "Interval",
    "Iteration",
    "Julia",
    "Mandelbox",
    "Mandelbulb",
    "Solid",
    "Values",
    "length",
    "sdf",
    "tighter",
]
