"""Finds and loads the compiled libraries.

Loading `libgvtorch_cpu.so` defines `torch.ops.gvtorch.*` and its CPU kernels; `libgvtorch_cuda.so`
adds the CUDA kernels. A C++ program loads the same files with `dlopen` before it loads a
TorchScript archive.
"""

from __future__ import annotations

import ctypes
import functools
import os
import warnings
from pathlib import Path

import torch

from .compilers import INSTRUCTION_SETS

FOLDER = Path(__file__).parent / "lib"
SOURCES = Path(__file__).parent / "csrc"


@functools.cache
def load() -> dict[str, str]:
    """Loads each library once; returns for each backend, `cpp` and `cuda`, an empty text if it can
    be used, else the reason why it can't.
    """
    limit = os.environ.get("GVTORCH_CPU", "baseline")
    if limit not in INSTRUCTION_SETS:
        known = ", ".join(INSTRUCTION_SETS)
        warnings.warn(f"GVTORCH_CPU={limit!r} means baseline; known are {known}", stacklevel=2)
    reasons = {"cpp": _load("libgvtorch_cpu.so")}
    if reasons["cpp"]:
        reasons["cuda"] = "it needs the C++ library"
    elif torch.version.cuda is None:
        reasons["cuda"] = f"this torch ({torch.__version__}) is built without CUDA"
    elif torch.cuda.device_count() == 0:  # `is_available` would keep forked children from CUDA
        reasons["cuda"] = "torch sees no CUDA device"
    else:
        reasons["cuda"] = _load("libgvtorch_cuda.so")
    return reasons


def instructions() -> str:
    """Returns the instruction set of this process's kernels on the CPU: the widest that the
    processor has, or that GVTORCH_CPU allows (baseline, avx2, avx512).
    """
    if load()["cpp"]:
        return "baseline"
    read_name = ctypes.CDLL(str(FOLDER / "libgvtorch_cpu.so")).gvtorch_instructions
    read_name.restype = ctypes.c_char_p
    return str(read_name().decode())


def _load(name: str) -> str:
    library = FOLDER / name
    if not library.exists():
        return f"{name} was not built (pip install builds it; CUDA needs nvcc at build time)"
    try:
        torch.ops.load_library(library)
    except OSError as error:
        return f"{name} does not load: {error}"
    return ""
