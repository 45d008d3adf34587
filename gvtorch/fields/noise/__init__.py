"""Noise as functions of position: `gv.noise.perlin(points)` and others. It is determined by its
seed, periodic on request, float32 or float64, and its bounds are known.
"""

from .basis import MEAN_DECAY, VARIANCE, Bounds, bounds, cellular, perlin, simplex, value
from .fractal import fbm, fbm_bounds, ridged, turbulence, warp
from .levels import OctaveSum, inherit
from .spline import SplineSum

__all__ = [
    "MEAN_DECAY",
    "VARIANCE",
    "Bounds",
    "OctaveSum",
    "SplineSum",
    "bounds",
    "cellular",
    "fbm",
    "fbm_bounds",
    "inherit",
    "perlin",
    "ridged",
    "simplex",
    "turbulence",
    "value",
    "warp",
]
