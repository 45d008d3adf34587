"""Fields: functions of position, from torch tensors to torch tensors."""

from . import noise as noise
from . import sdf as sdf
from .combine import Blend as Blend
from .combine import Mask as Mask
from .combine import Painted as Painted
from .combine import Stack as Stack
from .combine import Warp as Warp
from .distance import Distance as Distance
from .field import Bounds as Bounds
from .field import Field as Field
from .field import Interval as Interval
from .field import Values as Values
from .field import length as length
from .field import tighter as tighter
from .fractals import Fractal as Fractal
from .fractals import Iteration as Iteration
from .fractals import Julia as Julia
from .fractals import Mandelbox as Mandelbox
from .fractals import Mandelbulb as Mandelbulb
from .fur import Fur as Fur
from .sampled import SampledDistance as SampledDistance
from .solid import Solid as Solid

#: Verbs for the classes that combine fields.
blend, mask, stack, warp = Blend, Mask, Stack, Warp
