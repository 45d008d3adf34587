"""Compiles a user's shader, a C++ header, into a library of one op; keeps the library by content.

What a header holds is told in csrc/user_shader.h, how it becomes an op in csrc/user.cpp. A library
is known by the digest of all it is made of: the header and what it includes from its folder,
gvtorch's headers, flags, torch's version, and the compilers (path, size and time of change). It is
written beside its place and then renamed, so that a half-written one is never loaded, and of two
processes that compile at once one merely works in vain.

Environment:
    GVTORCH_CACHE  where libraries are kept; else gvtorch in XDG_CACHE_HOME or ~/.cache. Nobody
                   cleans it up, and anybody may.
    CXX, NVCC, CUDA_HOME  see compilers.py
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from . import compilers

SOURCES = Path(__file__).parent / "csrc"
_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]*"([^"\n]+)"', re.MULTILINE)
_NAME = re.compile(r"[A-Za-z_]\w*(::[A-Za-z_]\w*)*", re.ASCII)
_lock = threading.Lock()


class CompileError(RuntimeError):
    """A compiler refused a user's shader: one line with file and command, then all that it said."""


@dataclass(frozen=True)
class UserShader:
    """A compiled shader, as its struct tells of itself."""

    header: Path
    name: str
    op: str  # in the namespace gvtorch_user
    features: int  # how many it gives; -1: as many as the second channel holds
    whole: bool  # a ray must not be traced in pieces
    uniforms: tuple[str, ...] | None  # their names; None: any number, without names


def load(header: str | os.PathLike[str], name: str) -> UserShader:
    """Compiles a struct of a header for the CPU, if that is not done yet, and loads its op.

    Args:
        header: The file.
        name: The struct's name, with its namespaces.

    Raises:
        ValueError: There is no such file, or the name is none.
        CompileError: The compiler refuses it.
        RuntimeError: There is no compiler, or the cache's folder can't be written.
    """
    path = Path(header).expanduser().resolve()
    if not path.is_file():
        raise ValueError(f"CompiledShader: there is no header {path}")
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise ValueError(f"CompiledShader: name must be that of a C++ struct, got {name!r}")
    op = f"{name.replace('::', '_')}_{_content(path, name)[:16]}"
    told = ctypes.CDLL(str(_loaded(path, name, op, ())))
    told.gvtorch_uniforms.restype = ctypes.c_char_p
    names = told.gvtorch_uniforms().decode()
    return UserShader(
        header=path,
        name=name,
        op=op,
        features=told.gvtorch_features(),
        whole=bool(told.gvtorch_whole()),
        uniforms=tuple(re.findall(r"\w+", names)) if told.gvtorch_named() else None,
    )


def load_cuda(shader: UserShader) -> None:
    """Compiles and loads the CUDA kernel, for the devices that are here.

    Raises:
        RuntimeError: The header has changed since `load`; else as there.
    """
    header, name, op = shader.header, shader.name, shader.op
    if (op, "cuda") in _libraries:
        return
    if not header.is_file() or not op.endswith(_content(header, name)[:16]):
        raise RuntimeError(f"CompiledShader: {header} has changed: make the shader anew")
    devices = range(torch.cuda.device_count())
    found = {"".join(map(str, torch.cuda.get_device_capability(device))) for device in devices}
    _loaded(header, name, op, sorted(found))


_libraries: dict[tuple[str, str], Path] = {}  # what is loaded, by op and device type


def libraries(op: str) -> list[Path]:
    """Returns the libraries of an op that are loaded, the CPU's first."""
    return [_libraries[op, kind] for kind in ("cpu", "cuda") if (op, kind) in _libraries]


def _loaded(header: Path, name: str, op: str, archs: Sequence[str]) -> Path:
    key = (op, "cuda" if archs else "cpu")
    with _lock:
        if key not in _libraries:
            library = compiled(header, name, op, archs)
            torch.ops.load_library(library)
            _libraries[key] = library
        return _libraries[key]


def compiled(header: Path, name: str, op: str, archs: Sequence[str]) -> Path:
    """Returns the library of an op from the cache, where it is put if it is not there.

    Args:
        header: See `load`.
        name: See `load`.
        op: The op's name, an identifier.
        archs: CUDA compute capabilities, as in ("90",); none: the CPU.

    Raises:
        CompileError: The compiler refuses it.
        RuntimeError: There is no compiler, or the cache's folder can't be written.
    """
    for_whom = "CUDA" if archs else "the CPU"
    command, flags = _call(archs)
    tools = [command, compilers.find_cxx()] if archs else [command]  # nvcc calls it
    parts = (op, *flags, torch.__version__, platform.machine(), *map(_identity, tools))
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    kind = "cuda" if archs else "cpu"
    library = _folder() / f"{op}_{kind}_{digest[:16]}.so"
    if library.exists():
        return library
    if shutil.which(command[0]) is None:
        raise RuntimeError(
            f"CompiledShader: no compiler {command[0]!r} to compile {header.name} for {for_whom} "
            f"with; {'NVCC' if archs else 'CXX'} names another"
        )
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        scratch = tempfile.TemporaryDirectory(dir=library.parent)
    except OSError as error:
        raise RuntimeError(
            f"CompiledShader: {error}; GVTORCH_CACHE names another folder for libraries"
        ) from None
    with scratch as folder:
        target = Path(folder) / library.name
        include, link = compilers.torch_flags()
        linker = "-Xlinker=--no-as-needed" if archs else "-Wl,--no-as-needed"
        call = [*command, *flags, f"-DGV_USER_SHADER={name}", f"-DGV_USER_OP={op}"]
        call += [f"-DGV_NAMESPACE=user_{op}", "-I", str(SOURCES), *include]
        call += ["-include", str(header), str(SOURCES / "user.cpp"), "-o", str(target)]
        call += [linker, *link]
        run = subprocess.run(
            call, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
            check=False,
        )  # fmt: skip
        if run.returncode or not target.exists():
            raise CompileError(
                f"{header}: {name} did not compile for {for_whom} with: {shlex.join(call)}\n"
                f"{run.stdout}"
            )
        target.replace(library)
    return library


def _call(archs: Sequence[str]) -> tuple[list[str], list[str]]:
    """The compiler, and its flags but for those that name a path."""
    if not archs:
        return compilers.find_cxx(), [*compilers.CXX_FLAGS, "-pthread"]
    nvcc = compilers.find_nvcc() or "nvcc"
    return [nvcc], [*compilers.NVCC_FLAGS, *compilers.machine_codes(archs), "-x", "cu"]


def _folder() -> Path:
    named = os.environ.get("GVTORCH_CACHE")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return (Path(named).expanduser() if named else home / "gvtorch") / "shaders"


def _content(header: Path, name: str) -> str:
    """Digest of a struct, of its header with all that it includes from its folder, and of
    gvtorch's own headers.
    """
    known: dict[Path, bytes] = {}
    waiting = [header]
    while waiting:
        file = waiting.pop()
        known[file] = text = file.read_bytes()
        for named in _INCLUDE.findall(text.decode(errors="replace")):
            beside = (file.parent / named).resolve()
            if beside.is_file() and beside not in known:
                waiting.append(beside)
    digest = hashlib.sha256(name.encode() + _own_sources())
    for file in sorted(known):
        digest.update(os.path.relpath(file, header.parent).encode() + b"\0")
        digest.update(hashlib.sha256(known[file]).digest())
    return digest.hexdigest()


@functools.cache
def _own_sources() -> bytes:
    digests = [hashlib.sha256(file.read_bytes()).digest() for file in sorted(SOURCES.iterdir())]
    return b"".join(digests)


def _identity(command: Sequence[str]) -> str:
    """Tells a compiler from another without calling it: the command, and the path, size and time of
    change of each program in it, as of `ccache` and `g++`.
    """
    parts = [shlex.join(command)]
    for word in command:
        program = shutil.which(word)
        if program is not None:
            state = os.stat(program)
            parts.append(f"{os.path.realpath(program)} {state.st_size} {state.st_mtime_ns}")
    return "\n".join(parts)
