"""The ops on bare tensors. Importing this package loads the compiled libraries, so that TorchScript
archives and exported programs that hold `gvtorch::` ops can be loaded."""

from .registry import available
from .trace import trace_rays

__all__ = ["available", "trace_rays"]
