"""All distance fields under one name: `gv.sdf.Sphere(1) - gv.sdf.Box((1, 1, 1))`."""

from .distance import (
    Difference,
    Distance,
    Intersection,
    Negative,
    Pair,
    SmoothDifference,
    SmoothIntersection,
    SmoothUnion,
    Union,
)
from .shapes import Box, Sphere

__all__ = [
    "Box",
    "Difference",
    "Distance",
    "Intersection",
    "Negative",
    "Pair",
    "SmoothDifference",
    "SmoothIntersection",
    "SmoothUnion",
    "Sphere",
    "Union",
]
