"""The compilers and the flags that gvtorch's own libraries and users' shaders have in common.

libraries.py runs this file by its path, before gvtorch is installed, so it imports nothing of it.

Environment: CXX and NVCC name the compilers, CUDA_HOME a folder with bin/nvcc.
"""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path

TARGET_VERSION = "0x020b000000000000"  # torch 2.11, the oldest that may load the libraries
# Contraction stays off: a fused multiply-add would round differently from the torch twin.
SHARED = ("-std=c++17", "-O3", f"-DTORCH_TARGET_VERSION={TARGET_VERSION}")
CXX_FLAGS = (
    *(*SHARED, "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden"),
    "-Wno-psabi",
)
# If a struct's scalars are packed into vectors, the descent waits for its own stores.
PACKET_FLAGS = ("-fno-tree-slp-vectorize",)
AVX2_FLAGS = (*PACKET_FLAGS, "-mavx2", "-mf16c")
# Packets are compiled for each of these, a user's shader for the one that cpu.cpp chooses.
INSTRUCTION_SETS = {
    "baseline": PACKET_FLAGS,
    "avx2": AVX2_FLAGS,
    "avx512": (
        *(*AVX2_FLAGS, "-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl"),
        # GCC's own header causes warnings of uninitialised variables.
        *("-mprefer-vector-width=512", "-Wno-maybe-uninitialized", "-Wno-uninitialized"),
    ),
}
NVCC_FLAGS = (
    *(*SHARED, "-DUSE_CUDA", "-fmad=false", "-cudart=static"),
    "-Xcompiler=-fPIC,-fvisibility=hidden",
)


def find_cxx() -> list[str]:
    """Returns the C++ compiler's command: CXX, which may be several words, or g++. Raises
    RuntimeError if CXX has a quote that does not end.
    """
    command = os.environ.get("CXX", "").strip() or "g++"
    try:
        return shlex.split(command)
    except ValueError as error:
        raise RuntimeError(f"CXX must be a command, got {command!r}: {error}") from None


def find_nvcc() -> str | None:
    """Returns nvcc: NVCC, the one on PATH, or the one in CUDA_HOME; None where there is none."""
    home = os.environ.get("CUDA_HOME", "/usr/local/cuda")
    named = os.environ.get("NVCC")
    return named or shutil.which("nvcc") or shutil.which("nvcc", path=f"{home}/bin")


def machine_codes(archs: Sequence[str]) -> list[str]:
    """Returns nvcc's flags for compute capabilities, as in ("80", "90")."""
    return [f"-gencode=arch=compute_{arch},code=sm_{arch}" for arch in archs]


def torch_flags() -> tuple[list[str], list[str]]:
    """Returns the flags that find torch's headers, and those that link its libraries."""
    import torch

    root = Path(torch.__file__).parent
    return (
        ["-isystem", str(root / "include")],
        ["-shared", f"-L{root / 'lib'}", "-ltorch", "-ltorch_cpu"],
    )
