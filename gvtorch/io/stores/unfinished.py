"""`UnfinishedStore`: lock, manifest and journal of a store in the making, and the last step, which
makes it a store. The work itself is in conversion.py.
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
from ...base.volume import Volume, movable
from ...base.whole_file import durable_file, rename, told_of
from .checksums import LIST, Files, sum_of
from .ngff import image_metadata, read_json_file
from .store_layout import GROUPS, WORK, StoreLayout

Task = tuple[int, ...]  # level, z, y, x, or level, t, z, y, x
_JOURNAL, _MANIFEST, _LOCK = "journal.jsonl", "manifest.json", "lock"


class Done(NamedTuple):
    """What a task that is done has written."""

    place: tuple[int, ...]  # z, y, x, or t, z, y, x
    voxels: int
    files: Files  # checksums
    bad: int = 0  # values that are not finite; nothing is written then


@dataclass
class UnfinishedStore:
    """A store that is being made, by this process alone; `done` stands in the journal already."""

    target: Path
    journal: IO[str]
    done: dict[Task, Done]

    def note(self, done: Mapping[Task, Done]) -> None:
        """Writes down that tasks are done; on disk when this returns."""
        self.done |= done
        with told_of(self.target / WORK / _JOURNAL):
            _write_lines(self.journal, done)

    def finish(self, layout: StoreLayout, info: ImageInfo, settings: Mapping[str, Any]) -> None:
        """Writes the metadata, the root's last of all, and removes the hidden folder."""
        for name in GROUPS:
            write_json(self.target / name / "zarr.json", group({}))
        files = {name: one for done in self.done.values() for name, one in done.files.items()}
        write_json(self.target / LIST, {"files": files})
        place = {"spacing": settings["spacing"], "origin": settings["origin"]}
        name = Path(os.path.realpath(self.target)).name.removesuffix(".zarr")
        image, beside = image_metadata(name, layout, info, **place)
        own = layout.attributes(place) | ({"info": beside} if beside else {})
        own["files_sum"] = sum_of(files)
        own["checksum"] = sum_of(as_json(own))
        attributes = {"ome": image, "gvtorch": own}
        write_json(self.target / "zarr.json", group(attributes))
        shutil.rmtree(self.target / WORK, ignore_errors=True)


def is_finished(target: Path) -> bool:
    """Returns whether there is a whole store."""
    return (target / "zarr.json").exists()


def is_begun(target: Path, *, resume: bool, manifest: str = _MANIFEST) -> bool:
    """Returns whether there is a half-written store to go on with, begun with a file of this name.

    Raises:
        FileExistsError: There is a whole store, a half-written one without `resume`, or something
            else.
        FileNotFoundError: Its parent folder is not there.
    """
    if is_finished(target):
        raise FileExistsError(f"{target}: there is a store already; remove it or choose a new name")
    folder = target / WORK
    if (folder / manifest).exists():
        if not resume:
            raise FileExistsError(
                f"{target}: half-written; --resume (resume=True) goes on with it, or remove it"
            )
        return True
    empty = target.is_dir() and {entry.name for entry in target.iterdir()} <= {WORK}
    if empty and not any(folder.glob("*.json")):
        return False
    if target.exists():
        raise FileExistsError(f"{target}: exists and is no store; choose a new name")
    if not target.absolute().parent.is_dir():
        raise FileNotFoundError(f"folder not found: {target.absolute().parent}")
    return False


@contextmanager
def claimed(target: Path, settings: dict[str, Any], *, resume: bool) -> Iterator[UnfinishedStore]:
    """Makes or takes over the hidden folder. What is there is looked at once more under the lock:
    another process may have begun, or even finished, since `is_begun` was asked.

    Raises:
        OSError: Another process is at work there.
        FileExistsError: As of `is_begun`.
        ValueError: Settings or source differ from those of the store to resume.
    """
    folder = target / WORK
    with _claimed_folder(target):
        begun = is_begun(target, resume=resume)
        done = {}
        if begun:
            _compare(target, settings)
            done = _read_journal(folder / _JOURNAL)
        else:
            write_json(folder / _MANIFEST, settings)
        draft = folder / f".{_JOURNAL}.draft"
        with draft.open("w", encoding="utf-8") as journal:
            with told_of(draft):
                _write_lines(journal, done)
            rename(draft, folder / _JOURNAL)
            yield UnfinishedStore(target, journal, done)


@contextmanager
def _claimed_folder(target: Path) -> Iterator[None]:
    """Holds the lock of a target. At the end a folder is removed that this made and that is still
    empty. While it waits, the process before may remove the folder and the lock: it tries again.
    """
    folder, made = target / WORK, not target.exists()
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / _LOCK, f"{target}: another process is converting to it") as lock:
            try:
                same = os.path.samestat(os.fstat(lock.fileno()), (folder / _LOCK).stat())
            except FileNotFoundError:
                same = False
            if not same:
                continue
            try:
                yield
            finally:
                if {entry.name for entry in folder.iterdir()} <= {_LOCK} if folder.exists() else ():
                    shutil.rmtree(folder, ignore_errors=True)
                    if made:
                        with suppress(OSError):
                            target.rmdir()
            return


@contextmanager
def locked(file: Path, other: str) -> Iterator[IO[str]]:
    """Opens a file that one process at a time may hold open; raises OSError(other) if one does."""
    import fcntl

    with file.open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(other) from None
        yield lock


def _compare(target: Path, settings: dict[str, Any]) -> None:
    manifest = target / WORK / _MANIFEST
    before = read_json_file(manifest)
    plain = as_json(settings)
    if before.get("fingerprint") != plain["fingerprint"]:
        raise ValueError(
            f"{target}: the source is not the one that it was begun with ({before.get('source')}): "
            "size or time of change differ; remove the store to begin again"
        )
    for key, value in plain.items():
        if key != "source" and before.get(key) != value:
            raise ValueError(
                f"{target}: was begun with {key} {before.get(key)!r}, now it is {value!r}; "
                "remove the store to begin again"
            )


def count_done(target: Path) -> int:
    """Number of tasks that a journal names as done."""
    journal = target / WORK / _JOURNAL
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def _write_lines(journal: IO[str], done: Mapping[Task, Done]) -> None:
    """Writes a line with a checksum for each task; on disk when this returns."""
    for task, one in done.items():
        entry = {"task": list(task), "voxels": one.voxels, "files": one.files}
        journal.write(json.dumps(entry | {"checksum": sum_of(entry)}) + "\n")
    journal.flush()
    os.fsync(journal.fileno())


def _read_journal(path: Path) -> dict[Task, Done]:
    """Finished tasks. A line that was cut off or changed tells of none: its task runs again."""
    done = {}
    for line in path.read_bytes().splitlines() if path.exists() else []:
        try:
            entry = json.loads(line)
            if entry["checksum"] == sum_of(entry):
                task = tuple(int(n) for n in entry["task"])
                done[task] = Done(task[1:], int(entry["voxels"]), dict(entry["files"]))
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
    return done


def as_json(value: Any) -> Any:
    """Returns a value as it comes back from a JSON file: tuples are lists."""
    return json.loads(json.dumps(value))


def group(attributes: dict[str, Any]) -> dict[str, Any]:
    """Returns the metadata of a Zarr group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": attributes}


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a file that is either there as a whole or not at all."""
    with durable_file(path) as file:
        file.write(json.dumps(content, indent=1, allow_nan=False).encode())


def checksum(arrays: Iterable[np.ndarray]) -> int:
    """Returns the CRC-32 of the numbers of arrays, one after the other."""
    total = 0
    for one in arrays:
        total = zlib.crc32(one.tobytes(), total)
    return total


def fingerprint(source: str | Path | Volume) -> list[Any]:
    """Sizes and modification times of a source, or a checksum: equal while it is unchanged."""
    if isinstance(source, Volume):
        data = movable(source.data).cpu().numpy()
        return [list(data.shape), str(source.data.dtype), checksum([data])]
    text = str(source)
    if "://" in text:
        return [text]
    path = Path(text)
    if not path.is_dir():
        stat = path.stat()
        return [stat.st_size, stat.st_mtime_ns]
    digest, files = hashlib.sha256(), 0
    for file in sorted(path.iterdir()):
        stat = file.stat()
        size = stat.st_size if file.is_file() else 0
        digest.update(f"{file.name} {size} {stat.st_mtime_ns}\n".encode())
        files += 1
    return [files, digest.hexdigest()]
