"""Compiles the two extension libraries. They use the LibTorch Stable ABI and no Python C API: one
wheel serves every Python >= 3.11 and every torch >= 2.11. The CUDA library is built where nvcc is
found and is loaded only where torch has CUDA.

Run as a program, this file compiles them in the source tree: both, or with the word cpu or cuda
one. With the word packets it compiles only the CPU's objects that need nothing of torch, so that
any Python can do so while torch is still being installed; with the word objects the CPU's others,
one after the other, while the packets are being compiled. It runs before gvtorch is installed, so
it imports nothing of gvtorch and runs compilers.py by its path.

Environment:
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
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import SimpleNamespace

ARCHS = "75;80;86;89;90;100;120"
FOLDER = Path("gvtorch") / "cpp_ext"
SOURCES = FOLDER / "csrc"
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


def packet_commands(output: Path) -> dict[Path, list[str]]:
    """Returns the compiler calls of the packets' objects, by the object's path under `output`. They
    need nothing of torch.
    """
    sets = compilers.INSTRUCTION_SETS if _is_x86() else {"baseline": ()}
    return {
        output / f"packet.{name}.o": _compile(
            "packet", output / f"packet.{name}.o", [f"-DGV_NAMESPACE={name}", *flags]
        )
        for name, flags in sets.items()
    }


def object_commands(output: Path) -> dict[Path, list[str]]:
    """Returns the compiler calls of the CPU's other objects, by the object's path under `output`.
    They need torch's headers.
    """
    include, _ = compilers.torch_flags()
    flags = (["-DGV_X86"] if _is_x86() else []) + include
    return {
        output / f"{name}.o": _compile(name, output / f"{name}.o", flags)
        for name in ("cpu_rays", "cpu_segments", "cpu")
    }


def commands(output: Path) -> dict[Path, list[list[str]]]:
    """Returns the compiler calls of each library, by the library's path under `output`; all but the
    last, which links, may run in parallel.
    """
    include, link = compilers.torch_flags()
    objects = object_commands(output) | packet_commands(output)
    link_call = [*compilers.find_cxx(), *map(str, objects), "-Wl,--no-as-needed", *link, "-pthread"]
    calls = {output / "libgvtorch_cpu.so": [*objects.values(), link_call]}
    nvcc = chosen_nvcc()
    if nvcc is not None:
        archs = (os.environ.get("GVTORCH_CUDA_ARCHS") or ARCHS).split(";")
        codes = compilers.machine_codes(archs)
        codes.append(f"-gencode=arch=compute_{archs[-1]},code=compute_{archs[-1]}")
        call = [nvcc, *compilers.NVCC_FLAGS, f"-I{SOURCES}", "--threads=0", *codes, *include]
        call += [compression(nvcc), str(SOURCES / "cuda.cu"), "-Xlinker=--no-as-needed", *link]
        calls[output / "libgvtorch_cuda.so"] = [call]
    return calls


def compile_libraries(output: Path, kind: str = "") -> list[Path]:
    """Compiles, in parallel, the libraries that are missing or were made of other sources or with
    other flags; returns the paths of all. `kind` is cpu or cuda to compile one only.
    """
    output.mkdir(parents=True, exist_ok=True)
    digest = _source_digest()
    calls = {path: call for path, call in commands(output).items() if path.stem.endswith(kind)}
    with ThreadPoolExecutor(os.cpu_count()) as pool, ThreadPoolExecutor(2) as linkers:

        def make(library: Path) -> None:
            *compile_calls, link_call = calls[library]
            state = digest + " " + " ; ".join(shlex.join(call) for call in calls[library])
            if not _is_current(library, state):
                list(pool.map(partial(_make, digest), compile_calls))
                _run([*link_call, "-o", str(library)])
                library.with_suffix(".stamp").write_text(state)

        list(linkers.map(make, calls))
    return list(calls)


def compile_objects(output: Path, calls: dict[Path, list[str]], jobs: int) -> None:
    """Compiles, `jobs` at a time, the objects that are missing or out of date."""
    output.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(partial(_make, _source_digest()), calls.values()))


def _is_x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


def _compile(name: str, target: Path, flags: Sequence[str]) -> list[str]:
    call = [*compilers.find_cxx(), *compilers.CXX_FLAGS, f"-I{SOURCES}", "-Wall", "-Wextra"]
    return [*call, *flags, "-c", str(SOURCES / f"{name}.cpp"), "-o", str(target)]


def _source_digest() -> str:
    sources = sorted(path for path in SOURCES.rglob("*") if path.is_file())
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def _is_current(target: Path, state: str) -> bool:
    """Returns whether a file is there, and was made in this state of sources and flags."""
    stamp = target.with_suffix(".stamp")
    return target.exists() and stamp.exists() and stamp.read_text() == state


def _make(digest: str, call: list[str]) -> None:
    """Runs a call that makes an object, its last argument, unless that is current."""
    target, state = Path(call[-1]), f"{digest} {shlex.join(call)}"
    if not _is_current(target, state):
        _run(call)
        target.with_suffix(".stamp").write_text(state)


def _run(call: list[str]) -> None:
    print("gvtorch:", shlex.join(call), file=sys.stderr, flush=True)
    subprocess.run(call, check=True)


if __name__ == "__main__":
    target, words = FOLDER / "lib", sys.argv[1:]
    if words == ["packets"]:
        compile_objects(target, packet_commands(target), os.cpu_count() or 1)
    elif words == ["objects"]:
        compile_objects(target, object_commands(target), 1)
    else:
        compile_libraries(target, *words)
