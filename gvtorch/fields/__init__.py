"""Fields: functions of place, in torch alone."""

from . import noise, sdf
from .distance import Distance
from .field import Bounds, Field, Interval, Values, length, tighter
from .fur import Fur
from .sampled import SampledDistance
from .solid import Solid

__all__ = [
    "Bounds",
    "Distance",
    "Field",
    "Fur",
    "Interval",
    "SampledDistance",
    "Solid",
    "Values",
    "length",
    "noise",
    "sdf",
    "tighter",
]
