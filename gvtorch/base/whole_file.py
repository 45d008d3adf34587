"""`whole_file`, `write_whole`, `durable_file`: files that appear when they are whole; `write_npy`:
arrays whose errors of writing are told; `text_path`: paths for libraries that do not take all;
`cache_folder`: where what is kept lies.
NumPy is not imported here, so that `gvtorch --help` does not wait for it.
"""

from __future__ import annotations

import atexit
import errno
import functools
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np


@contextmanager
def told_of(path: Path, *drafts: str) -> Iterator[None]:
    """Gives an OSError of writing that names no file, as of a full disk, or one of its drafts, the
    name of this file.
    """
    try:
        yield
    except OSError as error:
        if error.filename not in (None, *drafts):
            raise
        text = f"can't be written: {error.strerror or error}"
        raise OSError(error.errno or errno.EIO, text, str(path)) from None


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A place to write to, which takes the file's name once the block ends well."""
    try:
        handle, name = tempfile.mkstemp(suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    try:
        part = os.path.join(text_path(os.path.abspath(path.parent)), os.path.basename(name))
        with told_of(path, name, part):  # what stands there already stays
            os.close(handle)
            yield Path(part)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(name, path)
    finally:
        Path(name).unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Writes text; on a full disk what stands there already stays."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def durable_file(path: Path) -> Iterator[IO[bytes]]:
    """Opens a file that takes its name once the block ends well, and is on disk then: a power cut
    leaves the whole file or none.
    """
    draft = path.with_name(f".{path.name}.draft")
    with told_of(path), draft.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    rename(draft, path)


def rename(draft: Path, path: Path) -> None:
    """Gives a file its name; on disk when this returns."""
    draft.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_npy(file: IO[bytes], values: np.ndarray) -> None:
    """Writes an array into an open file, which is not flushed; raises OSError where the disk is
    full. NumPy's `save` and `tofile`, which it takes for files on disk, end well where it is full
    within the last bytes, which the C library holds back.
    """
    import numpy as np

    plain: Any = SimpleNamespace(write=file.write)
    np.lib.format.write_array(plain, np.asarray(values), allow_pickle=False)


def save_npy(path: Path, values: np.ndarray) -> None:
    """Writes an array as a .npy file; raises OSError where the disk is full."""
    with path.open("wb") as file:
        write_npy(file, values)


def text_path(path: str) -> str:
    """Returns an absolute path itself, or another one of the same place, which need not exist, that
    can be written as UTF-8, and holds no backslash (where these part no folders) and no ".__lock":
    a link in a folder of this process, which goes when the process ends. So take it libraries that
    do not take all: tensorstore makes "/" of backslashes and refuses folders named as its locks.
    """
    bytes_of = os.fsencode(path)
    plain = path.encode(errors="replace") == bytes_of and ".__lock" not in path
    if plain and (os.sep == "\\" or "\\" not in path):
        return path
    name = hashlib.sha256(bytes_of).hexdigest()[:32]
    link = os.path.join(_folder(os.getpid()), name)
    try:
        os.symlink(path, link)
    except FileExistsError:
        pass  # made before
    return link


def cache_folder(part: str) -> Path:
    """Returns the folder of a part of what is kept between processes: in GVTORCH_CACHE, else in
    gvtorch of XDG_CACHE_HOME or ~/.cache. Raises RuntimeError where there is no home.
    """
    named = os.environ.get("GVTORCH_CACHE")
    base = named or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "gvtorch"
    return Path(base).expanduser().absolute() / part


@functools.cache
def _folder(process: int) -> str:
    folder = tempfile.mkdtemp(prefix="gvtorch-")

    def remove() -> None:
        if os.getpid() == process:  # not in one that was forked
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder
