"""Shaders of users, and compilers that are quick or listened to."""

from __future__ import annotations

import shutil
from pathlib import Path

from gvtorch.cpp_ext import compilers
from helpers import TESTS

HEADER = TESTS / "cpp" / "user_shaders.h"


def quick_compiler(folder: Path, *before: str) -> str:
    """A compiler that does not optimise, after some lines of shell."""
    real, file = shutil.which(compilers.find_cxx()[0]), folder / "c++"
    file.write_text("\n".join(("#!/bin/sh", *before, f'exec {real} "$@" -O0\n')))
    file.chmod(0o755)
    return str(file)
