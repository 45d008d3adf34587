"""Checksums of a store's files: they detect a file that was replaced by another valid one, which
the checksums inside each chunk can't.

    STORE.zarr/gvtorch/checksums.json   {"files": {"gvtorch/cells/0/c/0/0/0/0/0": CRC-32, ...}}

The checksum of a cells file covers the whole file, that of a pyramid or blocks file only its end,
where its index lies. A file is checked when it is first read. The root's metadata holds its own
checksum and that of the list. Stores without a list are read unchecked.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from .chunk_files import file_limit, index_bytes
from .ngff import read_json
from .store_layout import Deadline, StoreError, StoreLayout, read_key

LIST = "gvtorch/checksums.json"
_LINE = 128  # bytes of a file's line in the list, at most
Files = dict[str, int | None]  # CRC-32 by a file's path in the store; None: no such file


def sum_of(content: Mapping[str, Any]) -> int:
    """Returns the CRC-32 of JSON content, independent of formatting, without key "checksum"."""
    kept = {name: value for name, value in content.items() if name != "checksum"}
    return zlib.crc32(json.dumps(kept, sort_keys=True, separators=(",", ":")).encode())


def shard_files(
    root: Any, specs: Iterable[Mapping[str, Any]], place: tuple[int, ...], deadline: Deadline
) -> Files:
    """Computes the checksums of the shards at index (t,) z, y, x of arrays of the store."""
    found: Files = {}
    for spec in specs:
        name = file_of(spec, place)
        content = _read(root.get("path", "store"), root, spec, name, deadline)
        found[name] = None if content is None else zlib.crc32(content)
    return found


def file_of(spec: Mapping[str, Any], place: tuple[int, ...]) -> str:
    """Returns the path of a shard's file in the store."""
    shape, names = spec["metadata"]["shape"], spec["metadata"].get("dimension_names", "")
    at = list(place)
    if "c" in names:  # each shard holds all channels
        at.insert(len(at) - 3, 0)
    at += [0] * (len(shape) - len(at))
    return "/".join(map(str, (spec["path"], "c", *at)))


def _read(where: str, root: Any, spec: Mapping[str, Any], name: str, deadline: Deadline) -> Any:
    """Reads the bytes of a file that its checksum covers; None: there is no such file."""
    metadata = spec["metadata"]
    shard = math.prod(metadata["chunk_grid"]["configuration"]["chunk_shape"])
    chunk = math.prod(metadata["codecs"][0]["configuration"]["chunk_shape"])
    whole = spec["path"].startswith("gvtorch/cells")
    part = None if whole else slice(-index_bytes(shard, chunk), None)
    most = file_limit(shard, chunk, np.dtype(metadata["data_type"]).itemsize)
    return read_key(where, root, name, deadline, part, most)


class Checksums:
    """A store's list of checksums, read when first needed. Safe to use from several threads."""

    def __init__(self, where: str, root: Any, layout: StoreLayout, time: int) -> None:
        self._where, self._root, self._sum = where, root, layout.files_sum
        self._time = (time,) if layout.times > 1 else ()
        shards = sum(math.prod(layout.shards(level)) for level in range(layout.levels))
        self._most = _LINE * (1 + 3 * layout.times * shards)
        self._files: Mapping[str, Any] | None = None
        self._seen: set[str] = set()

    def check(self, spec: Mapping[str, Any], place: tuple[int, ...], deadline: Deadline) -> None:
        """Raises StoreError unless the shard at index z, y, x is the one that was written."""
        if self._sum is None:
            return
        name = file_of(spec, (*self._time, *place))
        if name in self._seen:
            return
        if self._files is None:
            self._files = self._read(deadline)
        wanted = self._files.get(name)
        where = f"{self._where}/{name}"
        if wanted is not None:  # None: no file was written, so there is nothing to compare
            content = _read(self._where, self._root, spec, name, deadline)
            if content is None:
                return  # it reads as zeros, and the store then finds out why
            if zlib.crc32(content) != wanted:
                raise StoreError(f"{where}: its checksum is not the one that was written")
        self._seen.add(name)

    def _read(self, deadline: Deadline) -> Mapping[str, Any]:
        try:
            content = read_json(self._where, self._root, LIST, deadline, self._most)
        except ValueError as error:
            raise StoreError(str(error)) from None
        files = None if content is None else content.get("files")
        if not isinstance(files, dict) or sum_of(files) != self._sum:
            what = "is missing" if content is None else "is not the one that was written"
            raise StoreError(f"{self._where}/{LIST}: {what}")
        return files
