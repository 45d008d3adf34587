"""Fields: functions of place, in torch alone."""

from . import sdf
from .distance import Distance
from .field import Bounds, Field, Interval, Values, length, tighter
from .solid import Solid

__all__ = ["Bounds", "Distance", "Field", "Interval", "Solid", "Values", "length", "sdf", "tighter"]
