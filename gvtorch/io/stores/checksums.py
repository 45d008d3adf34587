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

from .chunk_files import ChunkFiles
from .ngff import read_json
from .store_layout import StoreLayout
from .tensorstores import Deadline, StoreError, read_key

CHECKSUMS_FILE = "gvtorch/checksums.json"
_MAX_LINE_BYTES = 128  # bytes of a file's line in the list, at most
FileChecksums = dict[str, int | None]  # CRC-32 by a file's path in the store; None: no such file


def json_checksum(content: Mapping[str, Any]) -> int:
    """Returns the CRC-32 of JSON content, independent of formatting, without key "checksum"."""
    entries = {name: value for name, value in content.items() if name != "checksum"}
    return zlib.crc32(json.dumps(entries, sort_keys=True, separators=(",", ":")).encode())


def shard_checksums(
    root: Any, specs: Iterable[Mapping[str, Any]], index: tuple[int, ...], deadline: Deadline
) -> FileChecksums:
    """Computes the checksums of the shards at index (t,) z, y, x of arrays of the store."""
    checksums: FileChecksums = {}
    for spec in specs:
        path = shard_path(spec, index)
        content = _read_covered_bytes(root.get("path", "store"), root, spec, path, deadline)
        checksums[path] = None if content is None else zlib.crc32(content)
    return checksums


def shard_path(spec: Mapping[str, Any], index: tuple[int, ...]) -> str:
    """Returns the path of a shard's file in the store."""
    file_index = list(index)
    if "c" in spec["metadata"].get("dimension_names", ""):  # each shard holds all channels
        file_index.insert(len(file_index) - 3, 0)
    file_index += [0] * (len(spec["metadata"]["shape"]) - len(file_index))
    return "/".join(map(str, (spec["path"], "c", *file_index)))


def _read_covered_bytes(
    location: str, root: Any, spec: Mapping[str, Any], path: str, deadline: Deadline
) -> Any:
    """Reads the bytes of a file that its checksum covers; None: there is no such file."""
    metadata = spec["metadata"]
    files = ChunkFiles.of_zarr3("", metadata, np.dtype(metadata["data_type"]).itemsize)
    byte_range = None if spec["path"].startswith("gvtorch/cells") else files.index_part
    return read_key(location, root, path, deadline, byte_range, files.max_bytes)


class Checksums:
    """A store's list of checksums, read when first needed. Safe to use from several threads."""

    def __init__(self, location: str, root: Any, layout: StoreLayout, time: int) -> None:
        self._location, self._root, self._list_checksum = location, root, layout.files_sum
        self._time_index = (time,) if layout.times > 1 else ()
        shards = sum(math.prod(layout.shards(level)) for level in range(layout.levels))
        self._max_list_bytes = _MAX_LINE_BYTES * (1 + 3 * layout.times * shards)
        self._checksums: Mapping[str, Any] | None = None
        self._checked_paths: set[str] = set()

    def check(self, spec: Mapping[str, Any], index: tuple[int, ...], deadline: Deadline) -> None:
        """Raises StoreError unless the shard at index z, y, x is the one that was written."""
        if self._list_checksum is None:
            return
        path = shard_path(spec, (*self._time_index, *index))
        if path in self._checked_paths:
            return
        if self._checksums is None:
            self._checksums = self._read_list(deadline)
        expected = self._checksums.get(path)
        if expected is not None:  # None: no file was written, so there is nothing to compare
            content = _read_covered_bytes(self._location, self._root, spec, path, deadline)
            if content is None:
                return  # it reads as zeros, and the store then finds out why
            if zlib.crc32(content) != expected:
                context = f"{self._location}/{path}"
                raise StoreError(f"{context}: its checksum is not the one that was written")
        self._checked_paths.add(path)

    def _read_list(self, deadline: Deadline) -> Mapping[str, Any]:
        location, root, max_bytes = self._location, self._root, self._max_list_bytes
        try:
            content = read_json(location, root, CHECKSUMS_FILE, deadline, max_bytes)
        except ValueError as error:
            raise StoreError(str(error)) from None
        checksums = None if content is None else content.get("files")
        if not isinstance(checksums, dict) or json_checksum(checksums) != self._list_checksum:
            problem = "is missing" if content is None else "is not the one that was written"
            raise StoreError(f"{location}/{CHECKSUMS_FILE}: {problem}")
        return checksums
