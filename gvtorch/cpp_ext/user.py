"""Compiles a user's shader, a C++ header, into a library of one op; keeps the library by content.

What a header holds is told in csrc/user_shader.h, how it becomes an op in csrc/user.cpp. A library
is known by the digest of all it is made of: the header and what it includes from its folder,
gvtorch's headers, flags (which tell the CPU's instruction set), torch's version, and the compilers
(path, size and time of change, and the variables that they heed). It is written beside its place
and then renamed, so that of two processes that compile at once one merely works in vain. Its last
bytes are the digest of the others: what a crash or a full disk left behind is compiled again, never
loaded. A folder that others can write to is refused, for a library is code.

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
import stat
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from . import compilers, instructions

SOURCES = Path(__file__).parent / "csrc"
_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]*"([^"\n]+)"', re.MULTILINE)
_NAME = re.compile(r"(?=.{1,128}$)[A-Za-z_]\w*(::[A-Za-z_]\w*)*", re.ASCII)
_HEEDED = ("CPATH", "CPLUS_INCLUDE_PATH", "NVCC_PREPEND_FLAGS", "NVCC_APPEND_FLAGS")
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
        ValueError: There is no such file, it is no text, or the name is none.
        CompileError: The compiler refuses it.
        RuntimeError: There is no compiler, the header changes meanwhile, the cache's folder can't
            be written, or is not the user's own, or what was compiled can't be loaded from there.
    """
    if not isinstance(header, (str, os.PathLike)) or "\0" in str(header):
        raise ValueError(f"CompiledShader: header must be a path, got {header!r}")
    path = Path(header).expanduser().resolve()
    if not path.is_file():
        raise ValueError(f"CompiledShader: there is no header {path}")
    if path.name == "user_shader.h":
        raise ValueError(f"CompiledShader: {path} has the name of the header that it includes")
    if b"\0" in path.read_bytes():
        raise ValueError(f"CompiledShader: {path} is no text")
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise ValueError(
            "CompiledShader: name must be that of a C++ struct, of at most 128 letters, "
            f"got {name!r}"
        )
    content = _content(path, name)
    op = _op(name, content)
    told = ctypes.CDLL(str(_loaded(path, name, content, ())))
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
    content = _content(header, name) if header.is_file() else ""
    if op != _op(name, content):
        raise _changed(header)
    devices = range(torch.cuda.device_count())
    found = {"".join(map(str, torch.cuda.get_device_capability(device))) for device in devices}
    _loaded(header, name, content, sorted(found))


def reload(shader: UserShader) -> UserShader:
    """Returns a shader that came from another process with its op loaded: the same one, or what its
    header makes here.

    Raises:
        ValueError, CompileError, RuntimeError: See `load`.
    """
    return shader if (shader.op, "cpu") in _libraries else load(shader.header, shader.name)


_libraries: dict[tuple[str, str], Path] = {}  # what is loaded, by op and device type


def libraries(op: str) -> list[Path]:
    """Returns the libraries of an op that are loaded, the CPU's first."""
    return [_libraries[op, kind] for kind in ("cpu", "cuda") if (op, kind) in _libraries]


def _op(name: str, content: str) -> str:
    return f"{name.replace('::', '_')}_{content[:16]}"


def _loaded(header: Path, name: str, content: str, archs: Sequence[str]) -> Path:
    key = (_op(name, content), "cuda" if archs else "cpu")
    with _lock:
        if key not in _libraries:
            library = compiled(header, name, content, archs)
            try:
                torch.ops.load_library(library)
            except OSError as error:  # its cause has the loader's words
                raise RuntimeError(f"CompiledShader: {error.__cause__ or error}") from None
            _libraries[key] = library
        return _libraries[key]


def compiled(header: Path, name: str, content: str, archs: Sequence[str]) -> Path:
    """Returns a library from the cache, where it is put if it is not there.

    Args:
        header: See `load`.
        name: See `load`.
        content: The digest by which the header is known, which makes the op's name.
        archs: CUDA compute capabilities, as in ("90",); none: the CPU.

    Raises:
        CompileError: The compiler refuses it.
        RuntimeError: See `load`.
    """
    for_whom = "CUDA" if archs else "the CPU"
    command, flags = _call(archs)
    tools = [command, compilers.find_cxx()] if archs else [command]  # nvcc calls it
    parts = [content, *flags, torch.__version__, platform.machine(), *map(_identity, tools)]
    parts += [os.environ.get(variable, "") for variable in _HEEDED]
    digest = hashlib.sha256("\0".join(parts).encode(errors="surrogateescape")).hexdigest()
    kind, op = "cuda" if archs else "cpu", _op(name, content)
    library = _folder() / f"{op}_{kind}_{digest[:16]}.so"
    if _whole(library):
        return library
    if shutil.which(command[0]) is None:
        raise RuntimeError(
            f"CompiledShader: no compiler {command[0]!r} to compile {header.name} for {for_whom} "
            f"with; {'NVCC' if archs else 'CXX'} names another"
        )
    try:
        scratch = tempfile.TemporaryDirectory(dir=library.parent)
    except OSError as error:
        raise _refused(error) from None
    with scratch as folder:
        target = Path(folder) / library.name
        include, link = compilers.torch_flags()
        call = [*command, *flags, f"-DGV_USER_SHADER={name}", f"-DGV_USER_OP={op}"]
        call += [f"-DGV_NAMESPACE=user_{op}", "-I", str(SOURCES), *include]
        call += ["-include", str(header), str(SOURCES / "user.cpp"), "-o", str(target)]
        call += link
        run = subprocess.run(
            call, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
            check=False,
        )  # fmt: skip
        if run.returncode or not target.exists():
            raise CompileError(
                f"{header}: {name} did not compile for {for_whom} with: {shlex.join(call)}\n"
                f"{run.stdout}"
            )
        if not header.is_file() or _content(header, name) != content:
            raise _changed(header)
        with target.open("ab") as file:
            file.write(hashlib.sha256(target.read_bytes()).digest())
        target.chmod(0o644)
        target.replace(library)
    return library


def _whole(library: Path) -> bool:
    """Tells whether a library is there, and is what was written."""
    try:
        kept = library.read_bytes()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise _refused(error) from None
    return kept[-32:] == hashlib.sha256(kept[:-32]).digest()


def _call(archs: Sequence[str]) -> tuple[list[str], list[str]]:
    """The compiler, and its flags but for those that name a path."""
    if not archs:  # what is nowhere defined is an error here, as it will be when it is loaded
        linker = "-Wl,--no-as-needed,-z,defs"
        own = compilers.INSTRUCTION_SETS[instructions()]
        return compilers.find_cxx(), [*compilers.CXX_FLAGS, *own, "-pthread", linker]
    nvcc, own = compilers.find_nvcc() or "nvcc", ("-Xlinker=--no-as-needed", "-x", "cu")
    return [nvcc], [*compilers.NVCC_FLAGS, *compilers.machine_codes(archs), *own]


def _folder() -> Path:
    """Returns where libraries are kept, as a full path; makes it, for its owner alone."""
    try:
        named = os.environ.get("GVTORCH_CACHE")
        base = named or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "gvtorch"
        folder = Path(base).expanduser().absolute() / "shaders"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.stat()
    except (OSError, RuntimeError) as error:  # the latter: there is no home
        raise _refused(error) from None
    if state.st_uid not in (0, os.geteuid()):
        raise _refused(f"{folder} is another user's")
    if state.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise _refused(f"others may write to {folder}")
    return folder


def _changed(header: Path) -> RuntimeError:
    return RuntimeError(f"CompiledShader: {header} has changed: make the shader anew")


def _refused(reason: object) -> RuntimeError:
    return RuntimeError(
        f"CompiledShader: {reason}; GVTORCH_CACHE names another folder for libraries"
    )


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
        digest.update(os.fsencode(os.path.relpath(file, header.parent)) + b"\0")
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
