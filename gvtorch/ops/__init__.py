"""The ops on bare tensors. Importing this package loads the compiled libraries, so that TorchScript
archives and exported programs that hold `gvtorch::` ops can be loaded."""

from .cache import (
    compact_requests,
    lacking,
    link,
    link_bricks,
    link_tiles,
    locate,
    lru_partition,
    unlink,
)
from .cut import cut_bricks
from .registry import available
from .segments import Samples, Segments, composite, list_samples, sample_bricks, trace_segments
from .shade import shade_rays
from .trace import trace_rays

__all__ = [
    "Samples",
    "Segments",
    "available",
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
    "sample_bricks",
    "shade_rays",
    "trace_rays",
    "trace_segments",
    "unlink",
]
