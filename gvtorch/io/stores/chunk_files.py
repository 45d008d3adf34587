"""Checks of a chunked array's files: their length and kind, and the size that Blosc unpacks them
to. tensorstore opens any file of any length, and allocates what Blosc's header asks for, up to
2 GiB a chunk; so `begin_read` checks the files first, and the relay checks what servers send.

gzip, zlib, bzip2, xz and zstd need no check: tensorstore unpacks only what fits into a chunk.
Source: Blosc, README_CHUNK_FORMAT; Zarr 3, sharding codec; N5 specification.
"""

from __future__ import annotations

import math
import os
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...base.boxes import group_rows
from ..http import EXTRA_BYTES, Endless

METADATA_FILES = ("zarr.json", ".zarray", "attributes.json")  # an array's metadata files
_MAX_CHUNK_BYTES = 1 << 31
_ENTRY_BYTES = 16  # per chunk in a shard's index: the chunk's offset and length
_CHECKSUM_BYTES = 4
_MISSING_OFFSET = 2**63  # offsets from here on mark missing chunks
_BLOSC_HEADER_BYTES = 8  # that are read of its header; the last four are the unpacked size


def check_file(path: str, max_bytes: int, name: str = "") -> int | None:
    """Returns the size of a file in bytes; None if there is none. Follows links.

    Raises:
        Endless: It is a folder, a pipe, a device, or longer than `max_bytes`; the message begins
            with `name`, if given.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None  # if this is an error, tensorstore reports it
    prefix = f"{name}: " if name else ""
    if not stat.S_ISREG(status.st_mode):
        raise Endless(f"{prefix}is not a regular file")
    if status.st_size > max_bytes:
        raise Endless(f"{prefix}takes {status.st_size} bytes, more than the {max_bytes} that fit")
    return status.st_size


def files_of(context: str, array: Any) -> ChunkFiles:
    """Returns the file metadata of one of tensorstore's arrays; raises ValueError if reading a
    chunk takes too much memory, or if that can't be checked.
    """
    try:
        files = ChunkFiles.of(array)
    except Endless as error:
        raise ValueError(f"{context}: {error}") from None
    if files.chunk_bytes > _MAX_CHUNK_BYTES:
        raise ValueError(
            f"{context}: a chunk takes {files.chunk_bytes} bytes, more than {_MAX_CHUNK_BYTES}"
        )
    return files


def begin_read(view: Any, files: ChunkFiles, chunks: np.ndarray | None = None) -> Any:
    """Starts reading an array, after checking its files on disk.

    Args:
        view: tensorstore's array, or a part of one.
        files: The file metadata of the whole array.
        chunks: (n, axes) int64 indices of the chunks to be read, counted along each axis of the
            whole array, if known. If left out, they come from tensorstore, which is slow.

    Returns:
        tensorstore's future of the values, in C order; a failed one if a file fails its check.
    """
    try:
        if files.folder:
            files.check(view.spec().transform if chunks is None else chunks)
    except Endless as error:
        return failed_future(error)
    return view.read(order="C")


def failed_future(error: Exception) -> Any:
    """Returns a tensorstore future that has failed."""
    import tensorstore as ts

    promise_and_future: tuple[Any, Any] = ts.Promise.new()
    promise_and_future[0].set_exception(error)
    return promise_and_future[1]


@dataclass(frozen=True, kw_only=True)
class ChunkFiles:
    """What an array's metadata specifies about its files. A file holds one chunk, or is a shard
    with an index and many inner chunks; "chunk" then means an inner one.
    """

    folder: str  # path of the array; "" for a URL, whose files the relay checks
    begin: str = ""  # prefix of a file's name
    separator: str  # between the numbers in a file's name
    file: tuple[int, ...]  # values along each axis of a file
    chunk: tuple[int, ...]  # values along each axis of a chunk
    item_bytes: int  # bytes of a value
    index: str = ""  # "start" or "end": where a shard's index lies; "": files are not shards
    order: str = "<"  # byte order of the index
    summed: bool = True  # whether a checksum follows the index
    transposed: bool = False  # whether a shard's axes are in another order than the array's
    blosc: bool = False  # whether chunks begin with Blosc's header
    n5: bool = False  # whether N5's header comes first

    @classmethod
    def of(cls, array: Any) -> ChunkFiles:
        """Reads the array's metadata.

        Raises:
            Endless: Blosc is nested inside another codec, where it can't be checked.
        """
        spec, item_bytes = array.spec().to_json(), array.dtype.numpy_dtype.itemsize
        folder = spec["kvstore"]["path"] if spec["kvstore"]["driver"] == "file" else ""
        metadata, driver = spec["metadata"], spec["driver"]
        if driver == "zarr3":
            return cls.of_zarr3(folder, metadata, item_bytes)
        file = tuple(metadata["chunks" if driver == "zarr" else "blockSize"])
        compressor = metadata["compressor" if driver == "zarr" else "compression"] or {}
        return cls(
            folder=folder,
            separator=metadata.get("dimension_separator", ".") if driver == "zarr" else "/",
            file=file,
            chunk=file,
            item_bytes=item_bytes,
            blosc="blosc" in compressor.values(),
            n5=driver == "n5",
        )

    @classmethod
    def of_zarr3(cls, folder: str, metadata: Mapping[str, Any], item_bytes: int) -> ChunkFiles:
        """Reads an array's zarr.json; raises as `of`."""
        file = tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"])
        key_encoding = metadata.get("chunk_key_encoding", {"name": "default"})
        is_default = key_encoding["name"] == "default"
        settings = key_encoding.get("configuration", {})
        separator = settings.get("separator", "/" if is_default else ".")
        codecs, shard = metadata["codecs"], dict[str, Any](chunk=file)
        if codecs[-1]["name"] == "sharding_indexed":
            inner = codecs[-1]["configuration"]
            index = {c["name"]: c.get("configuration", {}) for c in inner["index_codecs"]}
            shard = {
                "chunk": tuple(inner["chunk_shape"]),
                "index": inner.get("index_location", "end"),
                "order": ">" if index.get("bytes", {}).get("endian") == "big" else "<",
                "summed": "crc32c" in index,
                "transposed": len(codecs) > 1,
            }
            codecs = inner["codecs"]
        *outer, innermost = [name for name in _codec_names(codecs) if name != "crc32c"]
        if "blosc" in outer:
            raise Endless(f"Blosc lies inside {innermost}, where its output can't be checked")
        begin, blosc = f"c{separator}" if is_default else "", innermost == "blosc"
        names = {"folder": folder, "begin": begin, "separator": separator}
        return cls(file=file, item_bytes=item_bytes, blosc=blosc, **names, **shard)

    @cached_property
    def chunks(self) -> int:
        """Number of chunks in a file."""
        return math.prod(self.file) // max(1, math.prod(self.chunk))

    @cached_property
    def max_bytes(self) -> int:
        """Bytes of a file, at most: its values, its index and more; no codec doubles its input."""
        value_bytes = math.prod(self.file) * self.item_bytes
        return 2 * value_bytes + _ENTRY_BYTES * self.chunks + EXTRA_BYTES

    @cached_property
    def chunk_bytes(self) -> int:
        """Bytes of a chunk, unpacked."""
        return math.prod(self.chunk) * self.item_bytes

    @cached_property
    def index_bytes(self) -> int:
        """Bytes of a shard's index."""
        return _ENTRY_BYTES * self.chunks + _CHECKSUM_BYTES * self.summed

    @property
    def index_part(self) -> slice:
        """The slice of a shard's bytes that is its index."""
        size = self.index_bytes
        return slice(0, size) if self.index == "start" else slice(-size, None)

    def chunk_indices(self, time: int, zyx: np.ndarray, shape: Sequence[int]) -> np.ndarray | None:
        """Returns (n, axes) indices of the chunks of items at (n, 3) z, y, x, in an array
        ([t,] z, y, x, *shape) whose chunks hold one item of `shape` each; None for any other array.
        """
        grid_axes = len(self.chunk) - len(shape)
        if self.transposed or grid_axes < 3 or self.chunk != (1,) * grid_axes + tuple(shape):
            return None
        indices = np.zeros((len(zyx), len(self.chunk)), np.int64)
        indices[:, : grid_axes - 3], indices[:, grid_axes - 3 : grid_axes] = time, zyx
        return indices

    def entries(self, index: bytes) -> np.ndarray:
        """Returns (n, 2) uint64 offset and length of chunks, from a shard's index or a part."""
        numbers = np.frombuffer(index, f"{self.order}u8", len(index) // _ENTRY_BYTES * 2)
        return numbers.astype(np.uint64).reshape(-1, 2)

    def check(self, part: Any) -> None:
        """Checks the files on disk that hold a part of the array, given as indices of chunks, or as
        tensorstore's IndexTransform from the part to the array.

        Raises:
            Endless: A file is not a regular one, or is too long, or Blosc would unpack too much.
        """
        chunks = part if isinstance(part, np.ndarray) else self._chunks_of_part(part)
        count = np.floor_divide(self.file, self._counted)  # chunks of a file along each axis
        files = chunks // count
        numbers = (chunks - files * count) @ (np.cumprod(count[::-1])[::-1] // count)
        for file_index, rows in zip(*group_rows(files), strict=True):
            name = f"{self.begin}{self.separator.join(map(str, file_index.tolist()))}"
            try:
                size = check_file(self.folder + name, self.max_bytes)
                if size is not None and self.blosc:
                    in_file = np.arange(self.chunks) if self.transposed else numbers[rows]
                    self._check_chunk_headers(self.folder + name, size, in_file)
            except Endless as error:
                raise Endless(f"{name}: {error}") from None

    def check_sent(self, begin: int, content: bytes, entries: np.ndarray | None) -> None:
        """Checks bytes that a server sent, those of a file from byte `begin` on. Raises as `check`.

        Args:
            begin: 0 for the file's first byte.
            content: The bytes.
            entries: (n, 2) offset and length of the file's chunks, if it is a shard.
        """
        if not self.blosc:
            return
        if entries is None:
            starts = [self._blosc_offset(content)] if begin == 0 else []
        else:
            last = begin + len(content) - _BLOSC_HEADER_BYTES
            sent = entries[(entries[:, 0] >= begin) & (entries[:, 0] <= max(last, 0)), 0]
            starts = [start - begin for start in sent.tolist()]
        self._check_blosc_headers(content[s : s + _BLOSC_HEADER_BYTES] for s in starts)

    @property
    def _counted(self) -> tuple[int, ...]:
        """Values along each axis of what is counted as a chunk: files of transposed shards, whose
        chunks can't be matched to a part of the array.
        """
        return self.file if self.transposed else self.chunk

    def _chunks_of_part(self, transform: Any) -> np.ndarray:
        """Returns (n, axes) indices of the chunks that an IndexTransform maps a part to."""
        origin, shape = transform.input_origin, transform.input_shape
        spans, indexed = dict[int, np.ndarray](), dict[int, np.ndarray]()
        for axis, (output, n) in enumerate(zip(transform.output, self._counted, strict=True)):
            if output.index_array is not None:
                positions = output.offset + output.stride * np.asarray(output.index_array)
                indexed[axis] = positions // n
                continue
            ends = [output.offset] * 2
            if (dimension := output.input_dimension) is not None:
                first, last = origin[dimension], origin[dimension] + shape[dimension] - 1
                ends = [output.offset + output.stride * end for end in (first, last)]
            spans[axis] = np.arange(min(ends) // n, max(ends) // n + 1)
        columns = [part.ravel() for part in np.broadcast_arrays(*indexed.values())]
        rows = np.zeros((1, 0), np.int64)
        if columns:
            rows = group_rows(np.stack(columns, axis=1))[0]
        grid = np.meshgrid(np.arange(len(rows)), *spans.values(), indexing="ij")
        chunks = np.empty((grid[0].size, len(self.chunk)), np.int64)
        chunks[:, [*indexed]] = rows[grid[0].ravel()]
        for axis, part in zip(spans, grid[1:], strict=True):
            chunks[:, axis] = part.ravel()
        return chunks

    def _check_chunk_headers(self, path: str, size: int, chunks: np.ndarray) -> None:
        try:
            file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            return  # tensorstore reports the error
        try:
            if not self.index:
                self.check_sent(0, os.pread(file, 64 + 4 * len(self.file), 0), None)
                return
            low, high = int(chunks.min()), int(chunks.max()) + 1
            entry_start = _ENTRY_BYTES * low
            if self.index == "end":
                entry_start += size - self.index_bytes
            if entry_start < 0:
                return  # the file is truncated; tensorstore reports it
            entries = self.entries(os.pread(file, _ENTRY_BYTES * (high - low), entry_start))
            starts = entries[chunks[chunks - low < len(entries)] - low, 0]
            starts = starts[starts < _MISSING_OFFSET].tolist()
            self._check_blosc_headers(os.pread(file, _BLOSC_HEADER_BYTES, s) for s in starts)
        finally:
            os.close(file)

    def _blosc_offset(self, content: bytes) -> int:
        """Returns how many bytes of a chunk precede Blosc's header: those of N5's."""
        if not self.n5:
            return 0
        return 4 + 4 * len(self.file) + (4 if content[:2] != b"\0\0" else 0)

    def _check_blosc_headers(self, headers: Iterable[bytes]) -> None:
        max_bytes = 2 * self.chunk_bytes + _ENTRY_BYTES
        sizes = [int.from_bytes(h[4:], "little") for h in headers if len(h) == _BLOSC_HEADER_BYTES]
        if (size := max(sizes, default=0)) > max_bytes:
            raise Endless(
                f"Blosc would make {size} bytes of a chunk, more than the {max_bytes} that fit"
            )


def _codec_names(codecs: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Yields the names of codecs, nested ones before the codec that holds them."""
    for codec in codecs:
        yield from _codec_names(codec.get("configuration", {}).get("codecs", ()))
        yield codec["name"]
