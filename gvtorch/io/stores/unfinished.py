"""`UnfinishedStore`: lock, manifest and journal of a store that is being written, and the last
step, which completes it. The conversion itself is in conversion.py.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from ...base.image_info import ImageInfo
from ...base.whole_file import durable_file, name_in_errors, rename
from ..remote import content_version
from .checksums import CHECKSUMS_FILE, FileChecksums, json_checksum
from .ngff import image_metadata, read_json_file
from .store_layout import GROUPS, JOURNAL, MANIFEST, WORK, StoreLayout

Task = tuple[int, ...]  # level, z, y, x, or level, t, z, y, x
_LOCK = "lock"


class TaskResult(NamedTuple):
    """What a finished task has written."""

    shard_index: tuple[int, ...]  # z, y, x, or t, z, y, x
    voxels: int
    files: FileChecksums  # checksums
    bad_values: int = 0  # values that are not finite; if there are any, nothing was written


@dataclass
class UnfinishedStore:
    """A store that only this process is writing; `done` holds the tasks in the journal."""

    target: Path
    journal: IO[str]
    done: dict[Task, TaskResult]

    def record(self, done: Mapping[Task, TaskResult]) -> None:
        """Adds finished tasks to the journal; they are on disk when this returns."""
        self.done |= done
        with name_in_errors(self.target / WORK / JOURNAL):
            _write_journal_lines(self.journal, done)

    def finish(self, layout: StoreLayout, info: ImageInfo, settings: Mapping[str, Any]) -> None:
        """Writes the metadata, the root's last of all, and removes the work folder."""
        for name in GROUPS:
            write_json(self.target / name / "zarr.json", group_metadata({}))
        files = {path: crc for result in self.done.values() for path, crc in result.files.items()}
        write_json(self.target / CHECKSUMS_FILE, {"files": files})
        placement = {"spacing": settings["spacing"], "origin": settings["origin"]}
        name = Path(os.path.realpath(self.target)).name.removesuffix(".zarr")
        ome, extras = image_metadata(name, layout, info, **placement)
        store_json = layout.attributes(placement) | ({"info": extras} if extras else {})
        store_json["files_sum"] = json_checksum(files)
        store_json["checksum"] = json_checksum(as_json(store_json))
        attributes = {"ome": ome, "gvtorch": store_json}
        write_json(self.target / "zarr.json", group_metadata(attributes))
        shutil.rmtree(self.target / WORK, ignore_errors=True)

    def discard(self) -> None:
        """Removes everything from the target, which may be a link, except the lock."""
        for folder in (self.target, self.target / WORK):
            for entry in folder.iterdir():
                if entry.is_dir() and entry.name != WORK:
                    shutil.rmtree(entry, ignore_errors=True)
                elif entry.name not in (WORK, _LOCK):
                    entry.unlink()


def is_finished(target: Path) -> bool:
    return (target / "zarr.json").exists()


def is_half_written(target: Path, manifest: str = MANIFEST) -> bool:
    """Returns whether a store was begun here and not finished."""
    return (target / WORK / manifest).exists()


def is_begun(target: Path, *, resume: bool, manifest: str = MANIFEST) -> bool:
    """Returns whether there is a half-written store, with a file `manifest`, to continue.

    Raises:
        FileExistsError: There is a finished store, a half-written one without `resume`, or
            something else.
        FileNotFoundError: Its parent folder is not there.
    """
    if is_finished(target):
        raise FileExistsError(f"{target}: there is a store already; remove it or choose a new name")
    folder = target / WORK
    if is_half_written(target, manifest):
        if resume:
            return True
        raise FileExistsError(
            f"{target}: half-written; continue with --resume (resume=True), or remove it"
        )
    empty = target.is_dir() and {entry.name for entry in target.iterdir()} <= {WORK}
    if empty and not any(folder.glob("*.json")):
        return False
    if target.exists():
        raise FileExistsError(f"{target}: exists and is not a store; choose a new name")
    if not target.absolute().parent.is_dir():
        raise FileNotFoundError(f"folder not found: {target.absolute().parent}")
    return False


@contextmanager
def claimed(target: Path, settings: dict[str, Any], *, resume: bool) -> Iterator[UnfinishedStore]:
    """Creates the work folder, or takes over an existing one. Checks `is_begun` again under the
    lock: another process may have begun, or even finished, since the first check.

    Raises:
        OSError: Another process is writing there.
        FileExistsError: As for `is_begun`.
        ValueError: Settings or source differ from those of the store to resume.
    """
    folder = target / WORK
    with claimed_folder(target):
        begun = is_begun(target, resume=resume)
        done = {}
        if begun:
            _check_settings(target, settings)
            done = _read_journal(folder / JOURNAL)
        else:
            write_json(folder / MANIFEST, settings)
        draft = folder / f".{JOURNAL}.draft"
        with draft.open("w", encoding="utf-8") as journal:
            with name_in_errors(draft):
                _write_journal_lines(journal, done)
            rename(draft, folder / JOURNAL)
            yield UnfinishedStore(target, journal, done)


@contextmanager
def claimed_folder(target: Path) -> Iterator[None]:
    """Holds the lock of a target. At the end, removes the work folder if it is empty, and then the
    target if this created it. If another process removes folder and lock meanwhile, tries again.
    """
    folder, created = target / WORK, not target.exists()
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / _LOCK, f"{target}: another process is converting to it") as lock:
            try:
                is_same_file = os.path.samestat(os.fstat(lock.fileno()), (folder / _LOCK).stat())
            except FileNotFoundError:
                is_same_file = False
            if not is_same_file:
                continue
            try:
                yield
            finally:
                if {entry.name for entry in folder.iterdir()} <= {_LOCK} if folder.exists() else ():
                    shutil.rmtree(folder, ignore_errors=True)
                    if created:
                        with suppress(OSError):
                            target.rmdir()
            return


@contextmanager
def locked(file: Path, message: str) -> Iterator[IO[str]]:
    """Opens a file that one process at a time may hold open; raises OSError if one does."""
    import fcntl

    with file.open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(message) from None
        yield lock


def _check_settings(target: Path, settings: dict[str, Any]) -> None:
    manifest = target / WORK / MANIFEST
    previous = read_json_file(manifest)
    current = as_json(settings)
    if previous.get("fingerprint") != current["fingerprint"]:
        raise ValueError(
            f"{target}: the source is not the one that it was begun with "
            f"({previous.get('source')}): its size, time of change or what is read of it differ; "
            "remove the store to begin again"
        )
    for key, value in current.items():
        if key != "source" and previous.get(key) != value:
            raise ValueError(
                f"{target}: was begun with {key} {previous.get(key)!r}, now it is {value!r}; "
                "remove the store to begin again"
            )


def _write_journal_lines(journal: IO[str], done: Mapping[Task, TaskResult]) -> None:
    """Writes a line with a checksum for each task; they are on disk when this returns."""
    for task, result in done.items():
        entry = {"task": list(task), "voxels": result.voxels, "files": result.files}
        journal.write(json.dumps(entry | {"checksum": json_checksum(entry)}) + "\n")
    journal.flush()
    os.fsync(journal.fileno())


def _read_journal(path: Path) -> dict[Task, TaskResult]:
    """Returns the finished tasks. A truncated or altered line is skipped: its task runs again."""
    done = {}
    for line in path.read_bytes().splitlines() if path.exists() else []:
        try:
            entry = json.loads(line)
            if entry["checksum"] == json_checksum(entry):
                task = tuple(int(n) for n in entry["task"])
                done[task] = TaskResult(task[1:], int(entry["voxels"]), dict(entry["files"]))
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
    return done


def as_json(value: Any) -> Any:
    """Returns a value as JSON reads it back: tuples become lists."""
    return json.loads(json.dumps(value))


def group_metadata(attributes: dict[str, Any]) -> dict[str, Any]:
    """Returns the metadata of a Zarr group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": attributes}


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a JSON file, which appears only when complete."""
    with durable_file(path) as file:
        file.write(json.dumps(content, indent=1, allow_nan=False).encode())


def checksum(arrays: Iterable[np.ndarray]) -> int:
    """Returns the CRC-32 of the bytes of arrays, one after the other."""
    total = 0
    for array in arrays:
        total = zlib.crc32(np.ascontiguousarray(array).data, total)
    return total


def fingerprint(source: str | Path, target: Path | None = None) -> list[Any]:
    """Returns the sizes and modification times of a file or folder, or what identifies the version
    of a file that was downloaded: equal while unchanged.
    `target`, a store that may lie in a source's folder, does not count.
    """
    text = str(source)
    if "://" in text:
        return [text]
    path = Path(text)
    if (version := content_version(path)) is not None:
        return [version]
    if not path.is_dir():
        stat = path.stat()
        return [stat.st_size, stat.st_mtime_ns]
    digest, file_count = hashlib.sha256(), 0
    skipped = None if target is None else os.path.realpath(target)
    for folder, folders, names in os.walk(path):
        paths = {name: os.path.realpath(os.path.join(folder, name)) for name in sorted(folders)}
        folders[:] = [name for name, inner in paths.items() if inner != skipped]
        for file in sorted(os.path.join(folder, name) for name in names):
            stat = os.stat(file, follow_symlinks=os.path.exists(file))
            line = f"{os.path.relpath(file, path)} {stat.st_size} {stat.st_mtime_ns}\n"
            digest.update(os.fsencode(line))
            file_count += 1
    return [file_count, digest.hexdigest()]
