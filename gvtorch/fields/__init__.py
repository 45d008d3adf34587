"""Fields: functions of position, from torch tensors to torch tensors."""

from . import noise, sdf
from .combine import Blend, Mask, Painted, Stack, Warp
from .distance import Distance
from .field import Bounds, Field, Interval, Values, length, tighter
from .fractals import Fractal, Iteration, Julia, Mandelbox, Mandelbulb
from .fur import Fur
from .sampled import SampledDistance
from .solid import Solid

#: Verbs for the classes that combine fields.
blend, mask, stack, warp = Blend, Mask, Stack, Warp

__all__ = [
    "Blend",
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
    "Mask",
    "Painted",
    "SampledDistance",
    "Solid",
    "Stack",
    "Values",
    "Warp",
    "blend",
    "length",
    "mask",
    "noise",
    "sdf",
    "stack",
    "tighter",
    "warp",
]
