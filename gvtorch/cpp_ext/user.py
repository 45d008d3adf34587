"""Compiles a user's shader, a C++ header, into a library of one op, and keeps the library.

csrc/user_shader.h says what a header holds, csrc/user.cpp how it becomes an op. A library is found
by a digest of all that it is made of: the header and what it includes from its folder, gvtorch's
headers, the flags (and with them the CPU's instruction set), torch's version, and the compilers
(path, size, time of change, and the environment variables that they read). It is written beside its
place and then renamed, so two processes may compile the same one at once.

Environment:
    GVTORCH_CACHE  folder of the libraries; else gvtorch in XDG_CACHE_HOME or in ~/.cache. gvtorch
                   never deletes them; anybody may.
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

from . import SOURCES, compilers, instructions

_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]*"([^"\n]+)"', re.MULTILINE)
_NAME = re.compile(r"(?=.{1,128}$)[A-Za-z_]\w*(::[A-Za-z_]\w*)*", re.ASCII)
_READ_BY_COMPILERS = ("CPATH", "CPLUS_INCLUDE_PATH", "NVCC_PREPEND_FLAGS", "NVCC_APPEND_FLAGS")
_lock = threading.Lock()


class CompileError(RuntimeError):
    """A compiler refused a user's shader: a line with file and command, then its output."""


@dataclass(frozen=True)
class ShaderSource:
    """A struct of a header, with the digest of all the code that it is compiled from."""

    header: Path
    name: str  # of the struct, with its namespaces
    digest: str

    @staticmethod
    def read(header: Path, name: str) -> ShaderSource:
        """Reads the header, all that it includes from its folder, and gvtorch's own headers."""
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
        return ShaderSource(header, name, digest.hexdigest())

    @property
    def op(self) -> str:
        """Name of the op, in the namespace gvtorch_user."""
        return f"{self.name.replace('::', '_')}_{self.digest[:16]}"

    def require_unchanged(self) -> None:
        """Raises RuntimeError if the code has changed since it was read."""
        header = self.header
        if not header.is_file() or self.read(header, self.name).digest != self.digest:
            raise RuntimeError(f"CompiledShader: {header} has changed: make the shader anew")


@dataclass(frozen=True)
class UserShader(ShaderSource):
    """A compiled shader, and what its struct says of itself."""

    features: int  # numbers it gives for each ray; -1: as many as the second channel holds
    whole: bool  # a ray must not be traced in pieces
    uniforms: tuple[str, ...] | None  # their names; None: any number, without names


def load(header: str | os.PathLike[str], name: str) -> UserShader:
    """Loads the op of a header's struct for the CPU; compiles it unless the cache has it. Raises
    what `CompiledShader` does.
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
    source = ShaderSource.read(path, name)
    library = ctypes.CDLL(str(_loaded(source, ())))
    library.gvtorch_uniforms.restype = ctypes.c_char_p
    names = library.gvtorch_uniforms().decode()
    return UserShader(
        **vars(source),
        features=library.gvtorch_features(),
        whole=bool(library.gvtorch_whole()),
        uniforms=tuple(re.findall(r"\w+", names)) if library.gvtorch_named() else None,
    )


def load_cuda(shader: UserShader) -> None:
    """Loads a shader's CUDA kernel; compiles it for this machine's devices unless the cache has it.
    Raises what `CompiledShader` does.
    """
    if (shader.op, "cuda") in _libraries:
        return
    shader.require_unchanged()
    devices = range(torch.cuda.device_count())
    found = {"".join(map(str, torch.cuda.get_device_capability(device))) for device in devices}
    _loaded(shader, sorted(found))


def reload(shader: UserShader) -> UserShader:
    """Returns a shader that another process compiled (an unpickled one, say) as it is if its op is
    loaded here, else made anew from its header.
    """
    return shader if (shader.op, "cpu") in _libraries else load(shader.header, shader.name)


_libraries: dict[tuple[str, str], Path] = {}  # the loaded ones, by op and device type


def libraries(op: str) -> list[Path]:
    """Returns the paths of an op's loaded libraries, the CPU's first."""
    return [_libraries[op, kind] for kind in ("cpu", "cuda") if (op, kind) in _libraries]


def _loaded(source: ShaderSource, archs: Sequence[str]) -> Path:
    """Returns the path of a library after loading it, once."""
    key = (source.op, "cuda" if archs else "cpu")
    with _lock:
        if key not in _libraries:
            library = compiled(source, archs)
            try:
                torch.ops.load_library(library)
            except OSError as error:  # its cause has the loader's words
                raise RuntimeError(f"CompiledShader: {error.__cause__ or error}") from None
            _libraries[key] = library
        return _libraries[key]


def compiled(source: ShaderSource, archs: Sequence[str]) -> Path:
    """Returns the path of a library in the cache, after compiling it if it is not there. `archs`
    are CUDA compute capabilities, as in ("90",); none for the CPU.
    """
    header, name, op = source.header, source.name, source.op
    kind, for_whom = ("cuda", "CUDA") if archs else ("cpu", "the CPU")
    command, flags = _compiler(archs)
    tools = [command, compilers.find_cxx()] if archs else [command]  # nvcc calls the C++ compiler
    parts = [source.digest, *flags, torch.__version__, platform.machine()]
    parts += [*map(_identity, tools), *(os.environ.get(one, "") for one in _READ_BY_COMPILERS)]
    digest = hashlib.sha256("\0".join(parts).encode(errors="surrogateescape")).hexdigest()
    library = _folder() / f"{op}_{kind}_{digest[:16]}.so"
    if _is_intact(library):
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
        source.require_unchanged()
        with target.open("ab") as file:
            file.write(hashlib.sha256(target.read_bytes()).digest())
        target.chmod(0o644)
        target.replace(library)
    return library


def _is_intact(library: Path) -> bool:
    """Returns whether a library is in the cache and ends with the digest of its other bytes, which
    it lacks where a crash or a full disk cut it short.
    """
    try:
        kept = library.read_bytes()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise _refused(error) from None
    return kept[-32:] == hashlib.sha256(kept[:-32]).digest()


def _compiler(archs: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns the compiler's call and its flags, without those that name a path."""
    if not archs:  # "defs": an undefined symbol is an error now, not when the library is loaded
        linker = "-Wl,--no-as-needed,-z,defs"
        own = compilers.INSTRUCTION_SETS[instructions()]
        return compilers.find_cxx(), [*compilers.CXX_FLAGS, *own, "-pthread", linker]
    nvcc, own = compilers.find_nvcc() or "nvcc", ("-Xlinker=--no-as-needed", "-x", "cu")
    return [nvcc], [*compilers.NVCC_FLAGS, *compilers.machine_codes(archs), *own]


def _folder() -> Path:
    """Returns the folder of the cache; makes it, for its owner alone. One that others can write
    to is refused, for a library is code.
    """
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


def _refused(reason: object) -> RuntimeError:
    return RuntimeError(
        f"CompiledShader: {reason}; GVTORCH_CACHE names another folder for libraries"
    )


@functools.cache
def _own_sources() -> bytes:
    """Returns the digests of gvtorch's own sources, one after the other."""
    files = sorted(path for path in SOURCES.rglob("*") if path.is_file())
    return b"".join(hashlib.sha256(path.read_bytes()).digest() for path in files)


def _identity(command: Sequence[str]) -> str:
    """Returns a text by which a compiler is known without calling it: its command, and path, size
    and time of change of each program in it (both `ccache` and `g++`, say).
    """
    parts = [shlex.join(command)]
    for word in command:
        program = shutil.which(word)
        if program is not None:
            state = os.stat(program)
            parts.append(f"{os.path.realpath(program)} {state.st_size} {state.st_mtime_ns}")
    return "\n".join(parts)
