"""`whole_file`, `write_text`, `durable_file`: files that appear only when complete; `write_npy`:
arrays, without losing write errors; `text_path`: paths for libraries that reject some paths;
`cache_folder`: where caches on disk lie.
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
def name_in_errors(path: Path, *drafts: str) -> Iterator[None]:
    """Makes an OSError of the block name `path`, if it names no file (a full disk) or one of the
    drafts of this file.
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
    """Yields a temporary path to write to; it is renamed to `path` if the block succeeds."""
    try:
        handle, temp_path = tempfile.mkstemp(suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    try:
        draft = os.path.join(text_path(os.path.abspath(path.parent)), os.path.basename(temp_path))
        # On an error, an existing file stays as it is.
        with name_in_errors(path, temp_path, draft):
            os.close(handle)
            yield Path(draft)
            mask = os.umask(0)
            os.umask(mask)
            os.chmod(temp_path, 0o666 & ~mask)
            os.replace(temp_path, path)
    finally:
        Path(temp_path).unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file; on a full disk an existing file stays as it is."""
    with whole_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


@contextmanager
def durable_file(path: Path) -> Iterator[IO[bytes]]:
    """Opens a draft that is synced to disk and renamed to `path` if the block succeeds: a power cut
    leaves the whole file or none.
    """
    draft = path.with_name(f".{path.name}.draft")
    with name_in_errors(path), draft.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    rename(draft, path)


def rename(draft: Path, path: Path) -> None:
    """Renames a draft to `path`; the new name is on disk when this returns."""
    draft.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_npy(file: IO[bytes], values: np.ndarray) -> None:
    """Writes an array into an open file without flushing it; raises OSError if the disk is full.
    `np.save` into a file on disk uses `tofile`, which reports no error if the disk fills up within
    the last bytes, those that the C library buffers.
    """
    import numpy as np

    writer: Any = SimpleNamespace(write=file.write)
    np.lib.format.write_array(writer, np.asarray(values), allow_pickle=False)


def save_npy(path: Path, values: np.ndarray) -> None:
    """Writes an array as a .npy file; raises OSError where the disk is full."""
    with path.open("wb") as file:
        write_npy(file, values)


def text_path(path: str) -> str:
    """Returns an absolute path (which need not exist) in a form that every library accepts: itself,
    or, if it is not valid UTF-8 or holds ".__lock" or a backslash that is no separator, a link to
    it in a folder that is removed when this process ends. (tensorstore turns backslashes into "/"
    and refuses folders named like its locks.)
    """
    path_bytes = os.fsencode(path)
    is_plain = path.encode(errors="replace") == path_bytes and ".__lock" not in path
    if is_plain and (os.sep == "\\" or "\\" not in path):
        return path
    name = hashlib.sha256(path_bytes).hexdigest()[:32]
    link = os.path.join(_link_folder(os.getpid()), name)
    try:
        os.symlink(path, link)
    except FileExistsError:
        pass  # an earlier call made it
    return link


def cache_folder(name: str) -> Path:
    """Returns the folder `name` of the cache on disk: in GVTORCH_CACHE, else in gvtorch below
    XDG_CACHE_HOME or ~/.cache. Raises RuntimeError if there is no home folder.
    """
    configured = os.environ.get("GVTORCH_CACHE")
    base = configured or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "gvtorch"
    return Path(base).expanduser().absolute() / name


@functools.cache
def _link_folder(process_id: int) -> str:
    folder = tempfile.mkdtemp(prefix="gvtorch-")

    def remove() -> None:
        if os.getpid() == process_id:  # not in a forked child
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder
