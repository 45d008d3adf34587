"""Exchange with OpenGL: cameras, depth, and the pictures themselves."""

from .conventions import ClipDepth as ClipDepth
from .conventions import camera as camera
from .conventions import matrices as matrices
from .conventions import ray_distance as ray_distance
from .conventions import window_depth as window_depth
from .exchange import Exchange as Exchange
