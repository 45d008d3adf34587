"""The ops on bare tensors. Importing this package loads the compiled libraries, so that TorchScript
archives and exported programs that contain `gvtorch::` ops can be loaded."""

from .arguments import RayArguments, Samples, Segments, ShadeArguments, TraceArguments
from .cache import (
    choose_requests,
    compact_requests,
    cut_bricks,
    lacking,
    link,
    link_bricks,
    link_tiles,
    locate,
    lru_partition,
    orphan,
    put_rows,
    unlink,
)
from .cameras import pinhole_rays
from .noise import noise
from .orbits import Orbit, orbit_bounds, orbits
from .registry import unavailable
from .segments import composite, list_samples, sample_bricks, trace_segments
from .splat import splat
from .trace import shade_rays, trace_rays
from .voxelize import voxelize

__all__ = [
    "Orbit",
    "RayArguments",
    "Samples",
    "Segments",
    "ShadeArguments",
    "TraceArguments",
    "choose_requests",
    "compact_requests",
    "composite",
    "cut_bricks",
    "lacking",
    "link",
    "link_bricks",
    "link_tiles",
    "list_samples",
    "locate",
    "lru_partition",
    "noise",
    "orbit_bounds",
    "orbits",
    "orphan",
    "pinhole_rays",
    "put_rows",
    "sample_bricks",
    "shade_rays",
    "splat",
    "trace_rays",
    "trace_segments",
    "unavailable",
    "unlink",
    "voxelize",
]
