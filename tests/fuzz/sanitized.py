"""Builds the CPU library with sanitizers, and runs tests with it in the place of the other.

    python tests/fuzz/sanitized.py address,undefined tests/test_words.py ...

The package is copied into build/sanitized-KINDS, so that the usual library stays as it is.
"""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
OPTIONS = {
    "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=1:allocator_may_return_null=1",
    "UBSAN_OPTIONS": "halt_on_error=1:print_stacktrace=1",
    "TSAN_OPTIONS": f"suppressions={ROOT / 'tests/fuzz/tsan.txt'}:halt_on_error=1",
    "OMP_NUM_THREADS": "4",
}


def main(kinds: str, *tests: str) -> int:
    """Returns pytest's exit status."""
    folder = ROOT / "build" / f"sanitized-{kinds.replace(',', '-')}"
    package = folder / "gvtorch"
    shutil.copytree(
        *(ROOT / "gvtorch", package),
        ignore=shutil.ignore_patterns("lib", "__pycache__"),
        dirs_exist_ok=True,
    )
    os.chdir(folder)
    flags = f"-fsanitize={kinds} -fno-sanitize-recover=all -fno-omit-frame-pointer -g1"
    os.environ |= {"GVTORCH_CUDA": "0", "CXX": f"{os.environ.get('CXX') or 'g++'} {flags}"}
    build = runpy.run_path("gvtorch/cpp_ext/build.py")
    compilers = build["compilers"]  # at -O3 it takes a quarter of an hour
    compilers.CXX_FLAGS = tuple(flag.replace("-O3", "-O1") for flag in compilers.CXX_FLAGS)
    build["compile_libraries"](Path("gvtorch/cpp_ext/lib"))
    name = {"thread": "libtsan.so"}.get(kinds, "libasan.so")
    told = subprocess.run(
        ["g++", f"-print-file-name={name}"], capture_output=True, text=True, check=True
    )
    own = {"LD_PRELOAD": told.stdout.strip(), "PYTHONPATH": str(folder), **OPTIONS}
    paths = [str(ROOT / test) if (ROOT / test).exists() else test for test in tests]
    call = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *paths]
    return subprocess.run(call, env=os.environ | own, cwd=folder, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
