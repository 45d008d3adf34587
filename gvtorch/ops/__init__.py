"""The ops on bare tensors. Importing this package loads the compiled libraries, so that TorchScript
archives and exported programs that hold `gvtorch::` ops can be loaded."""

from .cache import compact_requests, link, lru_partition, unlink
from .registry import available
from .shade import shade_rays
from .trace import trace_rays

__all__ = [
    "available",
    "compact_requests",
    "link",
    "lru_partition",
    "shade_rays",
    "trace_rays",
    "unlink",
]
