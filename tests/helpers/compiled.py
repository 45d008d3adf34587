"""User-defined shaders, and compilers that are fast or only preprocess."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
from pathlib import Path

import gvtorch as gv
from gvtorch.cpp_ext import compilers, instructions
from helpers import TESTS

HEADER = TESTS / "cpp" / "user_shaders.h"


# What users' shaders include of torch and of the standard library: half of what is read.
PREFIX = """
#include <algorithm>
#ifdef __x86_64__
#include <immintrin.h>
#endif
#include <optional>
#include <string_view>
#include <tuple>
#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
"""


def quick_compiler(folder: Path, *first_lines: str, compiler: str | None = None) -> str:
    """Writes a compiler that does not optimise, after some lines of shell; returns its path."""
    compiler, file = compiler or shutil.which(compilers.find_cxx()[0]), folder / "c++"
    file.write_text("\n".join(("#!/bin/sh", *first_lines, f'exec {compiler} "$@" -O0\n')))
    file.chmod(0o755)
    return str(file)


def _links_by_gold(folder: Path) -> bool:
    """Returns whether the C++ compiler links a library by gold that uses the standard library."""
    source, library = folder / "trial.cpp", folder / "trial.so"
    source.write_text("#include <string>\nstd::string text(int n) { return std::to_string(n); }\n")
    command = [*compilers.find_cxx(), "-fPIC", "-shared", "-Wl,-z,defs", "-fuse-ld=gold"]
    run = subprocess.run([*command, source, "-o", library], capture_output=True, check=False)
    return run.returncode == 0


def prepared_compiler(folder: Path) -> str:
    """Writes a quick compiler with precompiled headers and, if there is one, a quick linker."""
    linker = "-fuse-ld=gold" if _links_by_gold(folder) else ""
    prefix = folder / "gv_prefix.h"
    prefix.write_text(PREFIX)
    # A header of the system's is not listed as one that the shader depends on.
    add = f'set -- -isystem {folder} -include {prefix.name} "$@" -MMD {linker}'
    compiler = quick_compiler(folder, f'case "$*" in *GV_USER_SHADER*) {add};; esac')
    flags = (*compilers.CXX_FLAGS, *compilers.INSTRUCTION_SETS[instructions()], "-pthread")
    include, _ = compilers.torch_flags()
    command = [compiler, *flags, *include, "-x", "c++-header", prefix, "-o", f"{prefix}.gch"]
    subprocess.run(command, check=True)
    return compiler


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
  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>&, gv::ShadeSum<T>& sum) const {
    this->composite({COLOR, 0, 0, 1}, interval, sum);
  }"""
