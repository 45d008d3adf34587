"""`whole_file`, `write_whole`, `durable_file`: files that appear when they are whole."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from .text_path import text_path


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
