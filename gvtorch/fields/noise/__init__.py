"""Noise as functions of position: `gv.noise.perlin(points)` and others. It is determined by its
seed, periodic on request, float32 or float64, and its bounds are known.
"""

from .basis import MEAN_DECAY as MEAN_DECAY
from .basis import VARIANCE as VARIANCE
from .basis import Bounds as Bounds
from .basis import bounds as bounds
from .basis import cellular as cellular
from .basis import perlin as perlin
from .basis import simplex as simplex
from .basis import value as value
from .fractal import fbm as fbm
from .fractal import fbm_bounds as fbm_bounds
from .fractal import ridged as ridged
from .fractal import turbulence as turbulence
from .fractal import warp as warp
from .levels import OctaveSum as OctaveSum
from .levels import inherit as inherit
from .spline import SplineSum as SplineSum
