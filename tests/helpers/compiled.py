"""User-defined shaders, and compilers that are fast or only preprocess."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
from pathlib import Path

import gvtorch as gv
from gvtorch.cpp_ext import compilers
from helpers import TESTS

HEADER = TESTS / "cpp" / "user_shaders.h"


def quick_compiler(folder: Path, *first_lines: str) -> str:
    """Writes a compiler that does not optimise, after some lines of shell; returns its path."""
    compiler, file = shutil.which(compilers.find_cxx()[0]), folder / "c++"
    file.write_text("\n".join(("#!/bin/sh", *first_lines, f'exec {compiler} "$@" -O0\n')))
    file.chmod(0o755)
    return str(file)


def users_shader(header: Path, struct: str, **options) -> gv.CompiledShader:
    """Makes a user's shader; if several test processes want the same one, only one compiles it."""
    identity = "\0".join((os.environ.get("CXX", ""), struct, str(header), header.read_text()))
    name = hashlib.sha256(identity.encode()).hexdigest()
    with Path(os.environ["GVTORCH_CACHE"]).with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return gv.CompiledShader(header, struct, **options)


def only_included(folder: Path, *first_lines: str) -> str:
    """Writes a compiler that only preprocesses: it lists included files, but compiles nothing."""
    return quick_compiler(folder, *first_lines, 'set -- "$@" -E')


def write_header(folder: Path, body: str, name: str = "own.h") -> Path:
    """Writes a header with a struct `Own` around `body`, without packets, which compile slowly."""
    path = folder / name
    path.write_text(
        '#define GV_RAY_BY_RAY\n#include "user_shader.h"\n'
        "template <class T>\nstruct Own : gv::UserShader<T> {\n"
        f"  using gv::UserShader<T>::UserShader;\n{body}\n}};\n"
    )
    return path


ADD = """
  GV_HD void add(const gv::Piece<T>& piece, const gv::Probe<T>&, gv::ShadeSum<T>& sum) const {
    this->composite({COLOR, 0, 0, 1}, piece, sum);
  }"""
