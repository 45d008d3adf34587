"""Compiles the two extension libraries and makes the wheel that holds them.

setuptools loads this file by itself (see `[tool.setuptools]` in pyproject.toml), so it imports
nothing of gvtorch and runs compilers.py by its path. Both libraries use the LibTorch Stable ABI and
no Python C API: one wheel serves every Python >= 3.11 and every torch >= 2.11. The CUDA library is
built where nvcc is found and is loaded only where torch has CUDA.

Run as a program, this file compiles them in the source tree.

Environment:
    GVTORCH_COMPILE     0: an installation compiles nothing (the program does)
    GVTORCH_CUDA        auto (default: build when nvcc is found), 0 (never), 1 (fail without nvcc)
    GVTORCH_CUDA_ARCHS  compute capabilities, as in "80;90"; the last one is also shipped as PTX
    CXX, NVCC           the compilers
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

ARCHS = "75;80;86;89;90;100;120"
FOLDER = Path("gvtorch") / "cpp_ext"
compilers = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("compilers.py"))))


def chosen_nvcc() -> str | None:
    """Returns the path of nvcc, or None where there is none or GVTORCH_CUDA=0."""
    choice = os.environ.get("GVTORCH_CUDA", "auto")
    if choice not in ("auto", "0", "1"):
        raise SystemExit(f"GVTORCH_CUDA must be auto, 0 or 1, got {choice!r}")
    if choice == "0":
        return None
    nvcc: str | None = compilers.find_nvcc()
    if nvcc is None and choice == "1":
        raise SystemExit("GVTORCH_CUDA=1, but nvcc is neither on PATH nor in CUDA_HOME/bin")
    return nvcc


def compression(nvcc: str) -> str:
    """Returns the flag that compresses the machine code of all architectures: from CUDA 13 on to a
    twelfth, in a form that drivers of CUDA 13 read; before, in one that every driver reads.
    """
    stdout = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=True).stdout
    release = re.search(r"release (\d+)", stdout)
    if release is not None and int(release[1]) >= 13:
        return "--compress-mode=size"
    return "-Xfatbin=-compress-all"


def commands(output: Path) -> dict[Path, list[list[str]]]:
    """Returns the compiler calls of each library, by the library's path under `output`; all but the
    last, which links, may run in parallel.
    """
    source = FOLDER / "csrc"
    include, link = compilers.torch_flags()
    cxx = [*compilers.find_cxx(), *compilers.CXX_FLAGS, f"-I{source}", "-Wall", "-Wextra"]
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    scalar_flags = (["-DGV_X86"] if x86 else []) + include
    object_flags = dict.fromkeys(("cpu_rays", "cpu_segments", "cpu"), scalar_flags)
    for name, flags in compilers.INSTRUCTION_SETS.items():
        if x86 or name == "baseline":
            object_flags[f"packet.{name}"] = [f"-DGV_NAMESPACE={name}", *flags]
    objects = [str(output / f"{name}.o") for name in object_flags]
    calls = {
        output / "libgvtorch_cpu.so": [
            *(
                [*cxx, *flags, "-c", str(source / f"{name.split('.')[0]}.cpp"), "-o", target]
                for (name, flags), target in zip(object_flags.items(), objects, strict=True)
            ),
            [*compilers.find_cxx(), *objects, "-Wl,--no-as-needed", *link, "-pthread"],
        ]
    }
    nvcc = chosen_nvcc()
    if nvcc is not None:
        archs = (os.environ.get("GVTORCH_CUDA_ARCHS") or ARCHS).split(";")
        codes = compilers.machine_codes(archs)
        codes.append(f"-gencode=arch=compute_{archs[-1]},code=compute_{archs[-1]}")
        call = [nvcc, *compilers.NVCC_FLAGS, f"-I{source}", "--threads=0", *codes, *include]
        call += [compression(nvcc), str(source / "cuda.cu"), "-Xlinker=--no-as-needed", *link]
        calls[output / "libgvtorch_cuda.so"] = [call]
    return calls


def compile_libraries(output: Path) -> list[Path]:
    """Compiles, in parallel, the libraries that are missing or were made of other sources or with
    other flags; returns the paths of all.
    """
    sources = sorted(path for path in (FOLDER / "csrc").rglob("*") if path.is_file())
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    output.mkdir(parents=True, exist_ok=True)
    calls = commands(output)
    with ThreadPoolExecutor(os.cpu_count()) as pool, ThreadPoolExecutor(len(calls)) as linkers:

        def make(library: Path) -> None:
            stamp = library.with_suffix(".stamp")
            state = digest + " " + " ; ".join(shlex.join(call) for call in calls[library])
            if not (library.exists() and stamp.exists() and stamp.read_text() == state):
                *compile_calls, link_call = calls[library]
                list(pool.map(_run, compile_calls))
                _run([*link_call, "-o", str(library)])
                stamp.write_text(state)

        list(linkers.map(make, calls))
    return list(calls)


def _run(call: list[str]) -> None:
    print("gvtorch:", shlex.join(call), file=sys.stderr, flush=True)
    subprocess.run(call, check=True)


class BuildExt(build_ext):
    """Puts the libraries into cpp_ext/lib, in the source tree and in the wheel."""

    def run(self) -> None:
        """Compiles the libraries in the source tree, where the next build can reuse them, then
        copies them into the wheel.
        """
        if os.environ.get("GVTORCH_COMPILE") == "0":
            return
        libraries = compile_libraries(FOLDER / "lib")
        if not (self.inplace or self.editable_mode):
            for library in libraries:
                target = Path(self.build_lib) / library
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(library, target)

    def get_outputs(self) -> list[str]:
        """Returns the paths of the libraries in the build folder."""
        return list(self.get_output_mapping())

    def get_output_mapping(self) -> dict[str, str]:
        """Returns build folder path -> source tree path, for editable installs."""
        libraries = commands(FOLDER / "lib")
        return {str(Path(self.build_lib) / library): str(library) for library in libraries}


class BdistWheel(bdist_wheel):
    """Tags the wheel for any Python 3: the libraries do not use the Python C API."""

    def get_tag(self) -> tuple[str, str, str]:
        """Returns (py3, none, platform)."""
        return ("py3", "none", super().get_tag()[2])


if __name__ == "__main__":
    compile_libraries(FOLDER / "lib")
