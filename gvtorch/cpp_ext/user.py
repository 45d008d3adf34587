"""Compiles a user's shader, a C++ header, into a library of one op, and caches the library.

csrc/user_shader.h describes what a header contains, csrc/user.cpp makes an op of it. The name of a
library has a digest of all that it is made of: the header and what it includes, gvtorch's headers,
the flags (and with them the CPU's instruction set), torch's version, the machine, and the compilers
(path, size, time of change, and the environment variables that they read). It is written in a
folder next to it and then renamed, so two processes may compile the same one at once.

The includes of a header are found by searching its lines. Other files that the compiler reads, by a
macro or from another folder, are listed in a file (*.more) and are part of the digest from then
on. Compilers run in a folder where files have fixed names, so no path of a user reaches a shell. A
library's owner, permissions and digest are checked before it is loaded.

Environment:
    GVTORCH_CACHE  folder of the libraries; else gvtorch in XDG_CACHE_HOME or in ~/.cache. gvtorch
                   never deletes them; anybody may.
    CXX, NVCC, CUDA_HOME  see compilers.py
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import json
import os
import platform
import re
import shlex
import shutil
import stat
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from ..base.messages import one_line
from ..base.whole_file import cache_folder
from . import SOURCES, compilers, instructions

_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]*"([^"\n]+)"', re.MULTILINE)
_NAME = re.compile(r"(?=.{1,128}$)[A-Za-z_]\w*(::[A-Za-z_]\w*)*", re.ASCII)
_COMPILER_VARIABLES = ("CPATH", "CPLUS_INCLUDE_PATH", "NVCC_PREPEND_FLAGS", "NVCC_APPEND_FLAGS")
_HEADER, _DRAFT = "gv_user_header.h", "draft-"  # a header's name for compilers; prefix of folders
_MAX_COMPILE_SECONDS = 3600.0  # an older folder is taken for that of a killed compilation
_lock = threading.Lock()


class CompileError(RuntimeError):
    """A compiler refused a user's shader. Text: a line with file and command, then its output."""


@dataclass(frozen=True)
class ShaderSource:
    """A struct of a header, with the digest of all the code that it is compiled from."""

    header: Path
    name: str  # of the struct, with its namespaces
    digest: str
    header_files: tuple[Path, ...]  # the header, and what its lines include
    list_path: Path  # the file that lists the other files that it is compiled from
    listed_files: tuple[tuple[Path, bytes], ...]  # those files, each with its digest

    @staticmethod
    def read(header: Path, name: str) -> ShaderSource:
        """Reads the header, all that it includes from its folder, and gvtorch's own headers."""
        contents: dict[Path, bytes] = {}
        pending = [header]
        while pending:
            file = pending.pop()
            contents[file] = text = file.read_bytes()
            lines = text.decode(errors="replace").replace("\\\r\n", "").replace("\\\n", "")
            for included in _INCLUDE.findall(lines):
                path = _existing(file.parent / included)
                if path is not None and path not in contents:
                    pending.append(path)
        digest = hashlib.sha256(name.encode() + _source_digests())
        for file in sorted(contents):
            digest.update(os.fsencode(os.path.relpath(file, header.parent)) + b"\0")
            digest.update(hashlib.sha256(contents[file]).digest())
        list_path = _library_folder() / f"{name.replace('::', '_')}_{digest.hexdigest()[:16]}.more"
        listed_files = []
        for file in _read_list(list_path):
            is_there = _existing(file) is not None
            file_digest = hashlib.sha256(file.read_bytes()).digest() if is_there else b"none"
            digest.update(os.fsencode(file) + b"\0" + file_digest)
            listed_files.append((file, file_digest))
        return ShaderSource(
            header, name, digest.hexdigest(), tuple(contents), list_path, tuple(listed_files)
        )

    @property
    def op(self) -> str:
        """Name of the op, in the namespace gvtorch_user."""
        return f"{self.name.replace('::', '_')}_{self.digest[:16]}"

    def unchanged(self) -> ShaderSource:
        """Returns the source read again, for which a compiler may have listed more files. Raises
        RuntimeError if a file that was read before has changed.
        """
        if self.header.is_file():
            current = self.read(self.header, self.name)
            if current.list_path == self.list_path and set(self.listed_files) <= set(
                current.listed_files
            ):
                return current
        raise RuntimeError(f"CompiledShader: {self.header} has changed: create the shader again")


@dataclass(frozen=True)
class UserShader(ShaderSource):
    """A compiled shader, and the facts that its struct declares."""

    features: int  # numbers it writes for each ray; -1: as many as the second channel holds
    whole: bool  # a ray must not be traced in pieces
    uniforms: tuple[str, ...] | None  # their names; None: any number, without names


def load_op(header: str | os.PathLike[str], name: str) -> UserShader:
    """Loads the op of a header's struct for the CPU; compiles it unless the cache has it. Raises
    what `CompiledShader` does.
    """
    if not isinstance(header, (str, os.PathLike)) or "\0" in str(header):
        raise ValueError(f"CompiledShader: header must be a path, got {header!r}")
    path = _existing(Path(header))
    if path is None:
        raise ValueError(f"CompiledShader: there is no header {one_line(header, 200)}")
    if path.name == "user_shader.h":
        raise ValueError(f"CompiledShader: {path} has the name of the header that it includes")
    if b"\0" in path.read_bytes():
        raise ValueError(f"CompiledShader: {path} is not a text file")
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise ValueError(
            "CompiledShader: name must be that of a C++ struct, of at most 128 letters, "
            f"got {name!r}"
        )
    compiled(ShaderSource.read(path, name), ())
    source = ShaderSource.read(path, name)  # the compiler may have listed more files
    _load(source, ())
    library = _handles[source.op, "cpu"]
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
    shader.unchanged()
    devices = range(torch.cuda.device_count())
    capabilities = {
        "".join(map(str, torch.cuda.get_device_capability(device))) for device in devices
    }
    _load(shader, sorted(capabilities))


def reload(shader: UserShader) -> UserShader:
    """Returns the shader itself if its op is loaded in this process; else, as for an unpickled one,
    the shader that `load_op` loads from its header.
    """
    return shader if (shader.op, "cpu") in _libraries else load_op(shader.header, shader.name)


_libraries: dict[tuple[str, str], Path] = {}  # the loaded ones, by op and device type
_handles: dict[tuple[str, str], ctypes.CDLL] = {}


def libraries(op: str) -> list[Path]:
    """Returns the paths of an op's loaded libraries, the CPU's first."""
    return [_libraries[op, kind] for kind in ("cpu", "cuda") if (op, kind) in _libraries]


def _load(source: ShaderSource, archs: Sequence[str]) -> Path:
    """Returns the path of a library after loading it, once."""
    key = (source.op, "cuda" if archs else "cpu")
    with _lock:
        if key not in _libraries:
            library = compiled(source, archs, source.op)
            checked_path = _open_checked(library)
            try:
                with torch._ops.dl_open_guard():  # torch.ops.load_library resolves links
                    _handles[key] = ctypes.CDLL(checked_path)
            except OSError as error:
                text = str(error).replace(checked_path, str(library))
                raise RuntimeError(f"CompiledShader: {text}") from None
            torch.ops.loaded_libraries.add(str(library))
            _libraries[key] = library
        return _libraries[key]


def compiled(source: ShaderSource, archs: Sequence[str], op: str | None = None) -> Path:
    """Returns the path of a library in the cache, after compiling it if it is not there. `archs`
    are CUDA compute capabilities, as in ("90",); none for the CPU. `op` is the name of its op if
    that is fixed, as by a library that is loaded already; else it is the source's.
    """
    header, name, requested_op, op = source.header, source.name, op, op or source.op
    kind, device = ("cuda", "CUDA") if archs else ("cpu", "the CPU")
    command, flags = _compiler(archs)
    tools = [command, compilers.find_cxx()] if archs else [command]  # nvcc calls the C++ compiler
    digest_parts = [source.digest, *flags, torch.__version__, platform.machine()]
    digest_parts += [
        *map(_identity, tools),
        *(os.environ.get(variable, "") for variable in _COMPILER_VARIABLES),
    ]
    digest = hashlib.sha256("\0".join(digest_parts).encode(errors="surrogateescape")).hexdigest()
    library = _library_folder() / f"{op}_{kind}_{digest[:16]}.so"
    if _is_intact(library):
        return library
    if shutil.which(command[0]) is None:
        raise RuntimeError(
            f"CompiledShader: no compiler {command[0]!r} to compile {header.name} for {device} "
            f"with; {'NVCC' if archs else 'CXX'} names another"
        )
    _sweep(library.parent)
    try:
        scratch = tempfile.TemporaryDirectory(prefix=_DRAFT, dir=library.parent)
    except OSError as error:
        raise _refused(error) from None
    with scratch as folder:
        target = Path(folder) / "shader.so"
        (Path(folder) / "beside").symlink_to(header.parent)
        (Path(folder) / _HEADER).symlink_to(header)
        include, link = compilers.torch_flags()
        quote_flags = ["-Xcompiler=-iquote,beside"] if archs else ["-iquote", "beside"]
        call = [*command, *flags, f"-DGV_USER_SHADER={name}", f"-DGV_USER_OP={op}"]
        call += [f"-DGV_NAMESPACE=user_{op}", *quote_flags, "-I", str(SOURCES), *include]
        call += ["-include", _HEADER, str(SOURCES / "user.cpp"), "-o", target.name]
        call += [*link, "-MD", "-MF", "shader.d"]
        run = subprocess.run(
            call, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
            check=False, cwd=folder,
        )  # fmt: skip
        if run.returncode or not target.exists():
            errors = run.stdout.replace("beside/", f"{header.parent}/").replace(
                _HEADER, str(header)
            )
            raise CompileError(
                f"{header}: {name} did not compile for {device} with: {shlex.join(call)}\n{errors}"
            )
        _extend_list(source.unchanged(), Path(folder))
        current = source.unchanged()
        if current.digest != source.digest:  # this compiler, or another process's, listed more
            return compiled(current, archs, requested_op)
        with target.open("ab") as file:
            file.write(hashlib.sha256(target.read_bytes()).digest())
        target.chmod(0o644)
        target.replace(library)
    return library


def _extend_list(source: ShaderSource, folder: Path) -> None:
    """Adds the files that a compiler has read, and that the source does not know, to the list of
    other files. Files of gvtorch, of torch and of the system are left out.
    """
    try:
        rule = (folder / "shader.d").read_text(errors="surrogateescape")
    except OSError:
        return  # this compiler lists nothing
    tokens = re.findall(r"(?:[^\s\\]|\\.)+", rule.partition(":")[2].replace("\\\n", " "))
    names = (re.sub(r"\\(.)", r"\1", token).replace("$$", "$") for token in tokens)
    read_files = {(folder / name).resolve() for name in names}
    torch_root = Path(torch.__file__).resolve().parent
    ignored_roots = (SOURCES.resolve(), torch_root, Path("/usr"), folder.resolve())
    listed_files = {file for file, _ in source.listed_files}
    new_files = {
        file
        for file in read_files - listed_files - {path.resolve() for path in source.header_files}
        if not any(file.is_relative_to(root) for root in ignored_roots)
    }
    if new_files:
        draft = folder / "more"
        draft.write_text(json.dumps(sorted(map(str, new_files | listed_files))))
        draft.replace(source.list_path)


def _read_list(list_path: Path) -> list[Path]:
    """Returns the files in a list of other files; none where it is missing or damaged."""
    try:
        entries = json.loads(list_path.read_text())
    except (OSError, ValueError, RecursionError):
        return []
    if not isinstance(entries, list):
        return []
    return [Path(file) for file in entries if isinstance(file, str)]


def _existing(path: Path) -> Path | None:
    """Returns the absolute path of a file, without links and `~`; None if there is none, also where
    the name is too long or the links are a loop.
    """
    try:
        absolute = path.expanduser().resolve()
        return absolute if absolute.is_file() else None
    except (OSError, RuntimeError, ValueError):
        return None


def _sweep(folder: Path) -> None:
    """Removes the folders that killed compilations have left."""
    for draft in folder.glob(f"{_DRAFT}*"):
        with contextlib.suppress(OSError):
            if time.time() - draft.lstat().st_mtime > _MAX_COMPILE_SECONDS:
                shutil.rmtree(draft, ignore_errors=True)


def _is_intact(library: Path) -> bool:
    """Returns whether a library is in the cache and ends with the digest of its other bytes: it
    does not if a crash or a full disk cut it short.
    """
    try:
        with library.open("rb") as file:
            _check_owner(library, os.fstat(file.fileno()))
            content = file.read()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise _refused(error) from None
    return content[-32:] == hashlib.sha256(content[:-32]).digest()


def _open_checked(library: Path) -> str:
    """Opens a library, checks owner and permissions again, and returns a path of the open file, so
    that nothing else can be loaded instead. It stays open: loaders know libraries by their paths.
    """
    try:
        file = os.open(library, os.O_RDONLY | os.O_CLOEXEC)
        _check_owner(library, os.fstat(file))
    except OSError as error:
        raise _refused(error) from None
    path = f"/proc/self/fd/{file}"
    return path if os.path.exists(path) else str(library)


def _check_owner(path: Path, state: os.stat_result) -> None:
    """Raises RuntimeError if others may change a library, or a folder on its path. In a folder with
    the sticky bit, others can't rename or remove what is not theirs.
    """
    if state.st_uid not in (0, os.geteuid()):
        raise _refused(f"{path} is another user's")
    sticky = stat.S_ISDIR(state.st_mode) and state.st_mode & stat.S_ISVTX
    if state.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not sticky:
        raise _refused(f"others may write to {path}")


def _compiler(archs: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns the compiler's command and its flags, without those that contain a path."""
    if not archs:  # "defs": an undefined symbol is an error now, not when the library is loaded
        linker = "-Wl,--no-as-needed,-z,defs"
        target_flags = compilers.INSTRUCTION_SETS[instructions()]
        return compilers.find_cxx(), [*compilers.CXX_FLAGS, *target_flags, "-pthread", linker]
    nvcc, target_flags = compilers.find_nvcc() or "nvcc", ("-Xlinker=--no-as-needed", "-x", "cu")
    return [nvcc], [*compilers.NVCC_FLAGS, *compilers.machine_codes(archs), *target_flags]


def _library_folder() -> Path:
    """Returns the folder of the cache; makes it, for its owner alone. One that others can write
    to is refused, because a library is code.
    """
    try:
        folder = cache_folder("shaders")
        for path in (*reversed(folder.parents), folder):  # `parents=True` would let others write
            if not path.exists():
                path.mkdir(mode=0o700, exist_ok=True)
        real_folder = folder.resolve()
        states = {path: path.stat() for path in (real_folder, *real_folder.parents)}
    except (OSError, RuntimeError) as error:  # the latter: there is no home
        raise _refused(error) from None
    for path, state in states.items():
        _check_owner(path, state)
    return folder


def _refused(reason: object) -> RuntimeError:
    return RuntimeError(
        f"CompiledShader: {reason}; GVTORCH_CACHE names another folder for libraries"
    )


@functools.cache
def _source_digests() -> bytes:
    """Returns the digests of gvtorch's own sources, one after the other."""
    files = sorted(path for path in SOURCES.rglob("*") if path.is_file())
    return b"".join(hashlib.sha256(path.read_bytes()).digest() for path in files)


def _identity(command: Sequence[str]) -> str:
    """Returns a text that identifies a compiler without calling it: its command, and path, size and
    time of change of each program in it (both `ccache` and `g++`, say).
    """
    lines = [shlex.join(command)]
    for argument in command:
        program = shutil.which(argument)
        if program is not None:
            state = os.stat(program)
            lines.append(f"{os.path.realpath(program)} {state.st_size} {state.st_mtime_ns}")
    return "\n".join(lines)
