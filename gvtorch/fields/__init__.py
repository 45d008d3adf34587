"""Fields: functions of place, in torch alone."""

from . import sdf
from .combine import Blend, Mask, Painted, Stack, Warp
from .distance import Distance
from .field import Bounds, Field, Interval, Values, length, tighter
from .fractals import Fractal, Iteration, Julia, Mandelbox, Mandelbulb
from .solid import Solid

#: What makes a field of fields, by a verb.
blend, mask, stack, warp = Blend, Mask, Stack, Warp

__all__ = [
    "Blend",
    "Bounds",
    "Distance",
    "Field",
    "Fractal",
    "Interval",
    "Iteration",
    "Julia",
    "Mandelbox",
    "Mandelbulb",
    "Mask",
    "Painted",
    "Solid",
    "Stack",
    "Values",
    "Warp",
    "blend",
    "length",
    "mask",
    "sdf",
    "stack",
    "tighter",
    "warp",
]
