"""Checks of a chunked array's files: their length and kind, and the size that Blosc unpacks them
to. tensorstore opens any file of any length, and allocates what Blosc's header asks for, up to
2 GiB a chunk; so `begin_read` checks the files first, and the relay checks what servers send.

gzip, zlib, bzip2, xz and zstd need no check: tensorstore unpacks only what fits into a chunk.
Source: Blosc, README_CHUNK_FORMAT; Zarr 3, sharding codec; N5 specification.
"""

from __future__ import annotations

import itertools
import math
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
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


def index_bytes(values: int, chunk_values: int, *, summed: bool = True) -> int:
    """Returns the size in bytes of a shard's index: `values` values, `chunk_values` in a chunk."""
    return _ENTRY_BYTES * (values // max(1, chunk_values)) + _CHECKSUM_BYTES * summed


def file_limit(values: int, chunk_values: int, item_bytes: int) -> int:
    """Returns the most bytes that a file may have, of `values` values of `item_bytes` each, plus
    the index of its chunks of `chunk_values` values: no codec doubles the size of its input.
    """
    return 2 * values * item_bytes + index_bytes(values, chunk_values) + EXTRA_BYTES


def check_file(path: str, max_bytes: int) -> int | None:
    """Returns the size of a file in bytes; None if there is none. Follows links.

    Raises:
        Endless: It is a folder, a pipe, a device, or longer than `max_bytes`.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None  # if this is an error, tensorstore reports it
    if not stat.S_ISREG(status.st_mode):
        raise Endless("is not a regular file")
    if status.st_size > max_bytes:
        raise Endless(f"takes {status.st_size} bytes, more than the {max_bytes} that fit")
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
            return cls(folder=folder, item_bytes=item_bytes, **_fields_of_zarr3(metadata))
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

    @cached_property
    def chunks(self) -> int:
        """Number of chunks in a file."""
        return math.prod(self.file) // max(1, math.prod(self.chunk))

    @cached_property
    def max_bytes(self) -> int:
        """Bytes of a file, at most."""
        return file_limit(math.prod(self.file), math.prod(self.chunk), self.item_bytes)

    @cached_property
    def chunk_bytes(self) -> int:
        """Bytes of a chunk, unpacked."""
        return math.prod(self.chunk) * self.item_bytes

    @cached_property
    def index_bytes(self) -> int:
        """Bytes of a shard's index."""
        return index_bytes(math.prod(self.file), math.prod(self.chunk), summed=self.summed)

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
        """Returns (n, 2) uint64 offset and length of chunks in a shard, parsed from its index or
        from some entries.
        """
        numbers = np.frombuffer(index, f"{self.order}u8", len(index) // _ENTRY_BYTES * 2)
        return numbers.astype(np.uint64).reshape(-1, 2)

    def check(self, part: Any) -> None:
        """Checks the files on disk that hold a part of the array, given as indices of chunks, or as
        tensorstore's IndexTransform from the part to the array.

        Raises:
            Endless: A file is not a regular one, or is too long, or Blosc would unpack too much.
        """
        chunks_by_file = (
            self._files_of_chunks(part)
            if isinstance(part, np.ndarray)
            else self._files_of_part(part)
        )
        for file_index, chunks in chunks_by_file:
            name = f"{self.begin}{self.separator.join(map(str, file_index))}"
            try:
                size = check_file(self.folder + name, self.max_bytes)
                if size is not None and self.blosc:
                    self._check_chunk_headers(self.folder + name, size, chunks)
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
            self._check_blosc_headers(
                [content[self._blosc_offset(content) :][:_BLOSC_HEADER_BYTES]] if begin == 0 else []
            )
            return
        last = begin + len(content) - _BLOSC_HEADER_BYTES
        starts = entries[(entries[:, 0] >= begin) & (entries[:, 0] <= max(last, 0)), 0].tolist()
        self._check_blosc_headers(
            [content[start - begin : start - begin + _BLOSC_HEADER_BYTES] for start in starts]
        )

    @cached_property
    def _all_chunks(self) -> np.ndarray | None:
        """Numbers of all chunks of a file, if files are checked as a whole: if they are not shards,
        or transposed ones, where chunks can't be matched to a part of the array. Else None.
        """
        return np.arange(self.chunks) if self.transposed or not self.index else None

    @cached_property
    def _counts_and_strides(self) -> tuple[np.ndarray, np.ndarray]:
        """(axes,) chunks of a file along each axis (1 if files are checked as a whole), and the
        stride of a chunk's number in its file along each axis.
        """
        count = [a // b for a, b in zip(self.file, self.chunk, strict=True)]
        strides = [math.prod(count[axis + 1 :]) for axis in range(len(count))]
        if self._all_chunks is not None:  # each file counts as one chunk
            count = [1] * len(count)
        return np.array(count, np.int64), np.array(strides, np.int64)

    def _files_of_chunks(self, chunks: np.ndarray) -> Iterator[tuple[Sequence[int], np.ndarray]]:
        """Yields the index of each file that holds chunks (n, axes), and their numbers in it."""
        count, strides = self._counts_and_strides
        files = chunks // count
        for file_index, numbers in _group_by_row(files, (chunks - files * count) @ strides):
            yield file_index, numbers if self._all_chunks is None else self._all_chunks

    def _files_of_part(self, transform: Any) -> Iterator[tuple[Sequence[int], np.ndarray]]:
        """Yields the same for the part of the array that an IndexTransform of tensorstore maps."""
        counted_shape = self.chunk if self._all_chunks is None else self.file
        counts, strides = self._counts_and_strides
        count = counts.tolist()
        spans, indexed_axes, chunk_rows = _chunks_of_part(transform, counted_shape)
        files = [
            range(span.start // n, (span.stop - 1) // n + 1)
            for span, n in zip(spans, count, strict=True)
        ]
        file_rows = chunk_rows // counts[indexed_axes]
        numbers_in_file = (chunk_rows - file_rows * counts[indexed_axes]) @ strides[indexed_axes]
        for file_row, numbers_in_row in _group_by_row(file_rows, numbers_in_file):
            for axis, file in zip(indexed_axes, file_row, strict=True):
                files[axis] = range(file, file + 1)
            for file_index in itertools.product(*files):
                chunk_numbers = numbers_in_row
                for axis in set(range(len(count))) - set(indexed_axes):
                    first = file_index[axis] * count[axis]
                    low = max(spans[axis].start - first, 0)
                    high = min(spans[axis].stop - first, count[axis])
                    if high > 1:
                        offsets = strides[axis] * np.arange(low, high)
                        chunk_numbers = np.add.outer(chunk_numbers, offsets).ravel()
                yield file_index, chunk_numbers if self._all_chunks is None else self._all_chunks

    def _check_chunk_headers(self, path: str, size: int, chunks: np.ndarray) -> None:
        try:
            file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            return  # tensorstore reports the error
        try:
            if not self.index:
                content = os.pread(file, 64 + 4 * len(self.file), 0)
                self._check_blosc_headers(
                    [content[self._blosc_offset(content) :][:_BLOSC_HEADER_BYTES]]
                )
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
            self._check_blosc_headers(
                [os.pread(file, _BLOSC_HEADER_BYTES, start) for start in starts]
            )
        finally:
            os.close(file)

    def _blosc_offset(self, content: bytes) -> int:
        """Returns how many bytes of a chunk precede Blosc's header: those of N5's."""
        if not self.n5:
            return 0
        return 4 + 4 * len(self.file) + (4 if content[:2] != b"\0\0" else 0)

    def _check_blosc_headers(self, headers: Iterable[bytes]) -> None:
        max_bytes = 2 * self.chunk_bytes + _ENTRY_BYTES
        unpacked_sizes = np.frombuffer(
            b"".join(header for header in headers if len(header) == _BLOSC_HEADER_BYTES), "<u4"
        )[1::2]
        if (unpacked_sizes > max_bytes).any():
            raise Endless(
                f"Blosc would make {unpacked_sizes.max()} bytes of a chunk, more than the "
                f"{max_bytes} that fit"
            )


def _fields_of_zarr3(metadata: dict[str, Any]) -> dict[str, Any]:
    """Returns fields of `ChunkFiles` from an array's zarr.json."""
    file = tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"])
    key_encoding = metadata["chunk_key_encoding"]
    is_default = key_encoding["name"] == "default"
    separator = key_encoding.get("configuration", {}).get("separator", "/" if is_default else ".")
    codecs, shard = metadata["codecs"], dict[str, Any](chunk=file)
    if codecs[-1]["name"] == "sharding_indexed":
        inner = codecs[-1]["configuration"]
        index = inner["index_codecs"]
        is_big_endian = any(
            codec.get("configuration", {}).get("endian") == "big" for codec in index
        )
        shard = {
            "chunk": tuple(inner["chunk_shape"]),
            "index": inner.get("index_location", "end"),
            "order": ">" if is_big_endian else "<",
            "summed": any(codec["name"] == "crc32c" for codec in index),
            "transposed": len(codecs) > 1,
        }
        codecs = inner["codecs"]
    *outer, innermost = [name for name in _codec_names(codecs) if name != "crc32c"]
    if "blosc" in outer:
        raise Endless(f"Blosc lies inside {innermost}, where its output can't be checked")
    begin = f"c{separator}" if is_default else ""
    return {
        **shard,
        "begin": begin,
        "separator": separator,
        "file": file,
        "blosc": innermost == "blosc",
    }


def _codec_names(codecs: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Yields the names of codecs, nested ones before the codec that holds them."""
    for codec in codecs:
        yield from _codec_names(codec.get("configuration", {}).get("codecs", ()))
        yield codec["name"]


def _chunks_of_part(
    transform: Any, chunk_shape: Sequence[int]
) -> tuple[list[range], list[int], np.ndarray]:
    """Returns the chunks of `chunk_shape` values that hold a part of an array: a range of chunk
    indices for each axis; the axes that index arrays select instead; and (n, axes) chunk indices
    along those.
    """
    spans, indexed_axes, index_arrays = [], [], []
    origin, shape = transform.input_origin, transform.input_shape
    for axis, (output, n) in enumerate(zip(transform.output, chunk_shape, strict=True)):
        bounds = (output.offset, output.offset)
        if output.index_array is not None:
            indexed_axes.append(axis)
            index_arrays.append(
                (output.offset + output.stride * np.asarray(output.index_array)) // n
            )
        elif output.input_dimension is not None:
            low, n_along = origin[output.input_dimension], shape[output.input_dimension]
            bounds = (
                output.offset + output.stride * low,
                output.offset + output.stride * (low + n_along - 1),
            )
        spans.append(range(min(bounds) // n, max(bounds) // n + 1))
    if not indexed_axes:
        return spans, indexed_axes, np.zeros((1, 0), np.int64)
    columns = [indices.ravel() for indices in np.broadcast_arrays(*index_arrays)]
    return spans, indexed_axes, np.stack(columns, axis=1)


def _group_by_row(rows: np.ndarray, numbers: np.ndarray) -> Iterator[tuple[list[int], np.ndarray]]:
    """Yields each distinct row of `rows` (n, k), with those of `numbers` (n,) that belong to it."""
    if (rows == rows[:1]).all():
        if len(rows):
            yield rows[0].tolist(), numbers
        return
    distinct_rows, members = group_rows(rows)
    for row, selected in zip(distinct_rows.tolist(), members, strict=True):
        yield row, numbers[selected]
