"""Exchange with OpenGL: cameras, depth, and the pictures themselves."""

from .conventions import ClipDepth, camera, matrices, ray_distance, window_depth
from .exchange import Exchange

__all__ = ["ClipDepth", "Exchange", "camera", "matrices", "ray_distance", "window_depth"]
