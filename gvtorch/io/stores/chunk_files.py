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

from ...base.boxes import rows_by_place
from ..http import SMALL, Endless

HEADS = ("zarr.json", ".zarray", "attributes.json")  # an array's metadata files
_MOST_CHUNK = 1 << 31  # bytes
_ENTRY = 16  # bytes per chunk in a shard's index: the chunk's offset and length
_CHECKSUM = 4  # bytes
_NOWHERE = 2**63  # offsets from here on mark missing chunks
_BLOSC = 8  # bytes read of its header; the last four are the unpacked size


def index_bytes(values: int, chunk: int, *, summed: bool = True) -> int:
    """Returns the size in bytes of a shard's index: `values` values, `chunk` in a chunk."""
    return _ENTRY * (values // max(1, chunk)) + _CHECKSUM * summed


def file_limit(values: int, chunk: int, item: int) -> int:
    """Returns the most bytes that a file may have, of `values` values of `item` bytes each, plus
    the index of its chunks of `chunk` values: no codec doubles the size of its input.
    """
    return 2 * values * item + index_bytes(values, chunk) + SMALL


def check_file(path: str, most: int) -> int | None:
    """Returns the size of a file in bytes; None if there is none. Follows links.

    Raises:
        Endless: It is a folder, a pipe, a device, or longer than `most` bytes.
    """
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None  # if this is an error, tensorstore reports it
    if not stat.S_ISREG(found.st_mode):
        raise Endless("is not a regular file")
    if found.st_size > most:
        raise Endless(f"takes {found.st_size} bytes, more than the {most} that fit")
    return found.st_size


def files_of(where: str, array: Any) -> ChunkFiles:
    """Returns the file metadata of one of tensorstore's arrays; raises ValueError if reading a
    chunk takes too much memory, or if that can't be checked.
    """
    try:
        files = ChunkFiles.of(array)
    except Endless as error:
        raise ValueError(f"{where}: {error}") from None
    if files.chunk_bytes > _MOST_CHUNK:
        raise ValueError(
            f"{where}: a chunk takes {files.chunk_bytes} bytes, more than {_MOST_CHUNK}"
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
        return failed(error)
    return view.read(order="C")


def failed(error: Exception) -> Any:
    """Returns a tensorstore future that has failed."""
    import tensorstore as ts

    promised: tuple[Any, Any] = ts.Promise.new()
    promised[0].set_exception(error)
    return promised[1]


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
    item: int  # bytes of a value
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
        told, item = array.spec().to_json(), array.dtype.numpy_dtype.itemsize
        folder = told["kvstore"]["path"] if told["kvstore"]["driver"] == "file" else ""
        about, kind = told["metadata"], told["driver"]
        if kind == "zarr3":
            return cls(folder=folder, item=item, **_of_zarr3(about))
        file = tuple(about["chunks" if kind == "zarr" else "blockSize"])
        packed = about["compressor" if kind == "zarr" else "compression"] or {}
        return cls(
            folder=folder,
            separator=about.get("dimension_separator", ".") if kind == "zarr" else "/",
            file=file,
            chunk=file,
            item=item,
            blosc="blosc" in packed.values(),
            n5=kind == "n5",
        )

    @cached_property
    def chunks(self) -> int:
        """Number of chunks in a file."""
        return math.prod(self.file) // max(1, math.prod(self.chunk))

    @cached_property
    def most(self) -> int:
        """Bytes of a file, at most."""
        return file_limit(math.prod(self.file), math.prod(self.chunk), self.item)

    @cached_property
    def chunk_bytes(self) -> int:
        """Bytes of a chunk, unpacked."""
        return math.prod(self.chunk) * self.item

    @cached_property
    def index_bytes(self) -> int:
        """Bytes of a shard's index."""
        return index_bytes(math.prod(self.file), math.prod(self.chunk), summed=self.summed)

    @property
    def index_part(self) -> slice:
        """The slice of a shard's bytes that is its index."""
        size = self.index_bytes
        return slice(0, size) if self.index == "start" else slice(-size, None)

    def places(self, time: int, zyx: np.ndarray, shape: Sequence[int]) -> np.ndarray | None:
        """Returns (n, axes) indices of the chunks of items at (n, 3) z, y, x, in an array
        ([t,] z, y, x, *shape) whose chunks hold one item of `shape` each; None for any other array.
        """
        before = len(self.chunk) - len(shape)
        if self.transposed or before < 3 or self.chunk != (1,) * before + tuple(shape):
            return None
        found = np.zeros((len(zyx), len(self.chunk)), np.int64)
        found[:, : before - 3], found[:, before - 3 : before] = time, zyx
        return found

    def entries(self, index: bytes) -> np.ndarray:
        """Returns (n, 2) uint64 offset and length of chunks in a shard, parsed from its index or
        from some entries.
        """
        found = np.frombuffer(index, f"{self.order}u8", len(index) // _ENTRY * 2)
        return found.astype(np.uint64).reshape(-1, 2)

    def check(self, part: Any) -> None:
        """Checks the files on disk that hold a part of the array, given as indices of chunks, or as
        tensorstore's IndexTransform from the part to the array.

        Raises:
            Endless: A file is not a regular one, or is too long, or Blosc would unpack too much.
        """
        found = self._listed(part) if isinstance(part, np.ndarray) else self._files(part)
        for place, chunks in found:
            name = f"{self.begin}{self.separator.join(map(str, place))}"
            try:
                size = check_file(self.folder + name, self.most)
                if size is not None and self.blosc:
                    self._check_file(self.folder + name, size, chunks)
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
            self._check_heads([content[self._head(content) :][:_BLOSC]] if begin == 0 else [])
            return
        last = begin + len(content) - _BLOSC
        starts = entries[(entries[:, 0] >= begin) & (entries[:, 0] <= max(last, 0)), 0].tolist()
        self._check_heads([content[at - begin : at - begin + _BLOSC] for at in starts])

    @cached_property
    def _every(self) -> np.ndarray | None:
        """Numbers of all chunks of a file, if files are checked as a whole: if they are not shards,
        or transposed ones, where chunks can't be matched to a part of the array. Else None.
        """
        return np.arange(self.chunks) if self.transposed or not self.index else None

    @cached_property
    def _counts(self) -> tuple[np.ndarray, np.ndarray]:
        """(axes,) chunks of a file along each axis (1 if files are checked as a whole), and the
        stride of a chunk's number in its file along each axis.
        """
        count = [a // b for a, b in zip(self.file, self.chunk, strict=True)]
        strides = [math.prod(count[axis + 1 :]) for axis in range(len(count))]
        if self._every is not None:  # each file counts as one chunk
            count = [1] * len(count)
        return np.array(count, np.int64), np.array(strides, np.int64)

    def _listed(self, chunks: np.ndarray) -> Iterator[tuple[Sequence[int], np.ndarray]]:
        """Yields the index of each file that holds chunks (n, axes), and their numbers in it."""
        count, strides = self._counts
        files = chunks // count
        for place, numbers in _by_row(files, (chunks - files * count) @ strides):
            yield place, numbers if self._every is None else self._every

    def _files(self, transform: Any) -> Iterator[tuple[Sequence[int], np.ndarray]]:
        """Yields the same for the part of the array that an IndexTransform of tensorstore maps."""
        side = self.chunk if self._every is None else self.file
        counts, strides = self._counts
        count = counts.tolist()
        spans, listed, points = _places(transform, side)
        files = [
            range(span.start // n, (span.stop - 1) // n + 1)
            for span, n in zip(spans, count, strict=True)
        ]
        rows = points // counts[listed]
        inner = (points - rows * counts[listed]) @ strides[listed]
        for group, numbers in _by_row(rows, inner):
            for axis, file in zip(listed, group, strict=True):
                files[axis] = range(file, file + 1)
            for place in itertools.product(*files):
                wanted = numbers
                for axis in set(range(len(count))) - set(listed):
                    first = place[axis] * count[axis]
                    low = max(spans[axis].start - first, 0)
                    high = min(spans[axis].stop - first, count[axis])
                    if high > 1:
                        along = strides[axis] * np.arange(low, high)
                        wanted = np.add.outer(wanted, along).ravel()
                yield place, wanted if self._every is None else self._every

    def _check_file(self, path: str, size: int, chunks: np.ndarray) -> None:
        try:
            file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            return  # tensorstore reports the error
        try:
            if not self.index:
                content = os.pread(file, 64 + 4 * len(self.file), 0)
                self._check_heads([content[self._head(content) :][:_BLOSC]])
                return
            low, high = int(chunks.min()), int(chunks.max()) + 1
            at = _ENTRY * low
            if self.index == "end":
                at += size - self.index_bytes
            if at < 0:
                return  # the file is truncated; tensorstore reports it
            entries = self.entries(os.pread(file, _ENTRY * (high - low), at))
            starts = entries[chunks[chunks - low < len(entries)] - low, 0]
            starts = starts[starts < _NOWHERE].tolist()
            self._check_heads([os.pread(file, _BLOSC, start) for start in starts])
        finally:
            os.close(file)

    def _head(self, content: bytes) -> int:
        """Returns how many bytes of a chunk precede Blosc's header: those of N5's."""
        if not self.n5:
            return 0
        return 4 + 4 * len(self.file) + (4 if content[:2] != b"\0\0" else 0)

    def _check_heads(self, heads: Iterable[bytes]) -> None:
        most = 2 * self.chunk_bytes + _ENTRY
        found = np.frombuffer(b"".join(head for head in heads if len(head) == _BLOSC), "<u4")[1::2]
        if (found > most).any():
            raise Endless(
                f"Blosc would make {found.max()} bytes of a chunk, more than the {most} that fit"
            )


def _of_zarr3(about: dict[str, Any]) -> dict[str, Any]:
    """Returns fields of `ChunkFiles` from an array's zarr.json."""
    file = tuple(about["chunk_grid"]["configuration"]["chunk_shape"])
    keys = about["chunk_key_encoding"]
    plain = keys["name"] == "default"
    separator = keys.get("configuration", {}).get("separator", "/" if plain else ".")
    codecs, shard = about["codecs"], dict[str, Any](chunk=file)
    if codecs[-1]["name"] == "sharding_indexed":
        inner = codecs[-1]["configuration"]
        index = inner["index_codecs"]
        big = any(codec.get("configuration", {}).get("endian") == "big" for codec in index)
        shard = {
            "chunk": tuple(inner["chunk_shape"]),
            "index": inner.get("index_location", "end"),
            "order": ">" if big else "<",
            "summed": any(codec["name"] == "crc32c" for codec in index),
            "transposed": len(codecs) > 1,
        }
        codecs = inner["codecs"]
    *before, last = [name for name in _names(codecs) if name != "crc32c"]
    if "blosc" in before:
        raise Endless(f"Blosc lies inside {last}, where its output can't be checked")
    begin = f"c{separator}" if plain else ""
    return {**shard, "begin": begin, "separator": separator, "file": file, "blosc": last == "blosc"}


def _names(codecs: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Yields the names of codecs, nested ones before the codec that holds them."""
    for codec in codecs:
        yield from _names(codec.get("configuration", {}).get("codecs", ()))
        yield codec["name"]


def _places(transform: Any, side: Sequence[int]) -> tuple[list[range], list[int], np.ndarray]:
    """Returns the chunks of `side` values that hold a part of an array: a range of chunk indices
    for each axis; the axes that index arrays select instead; and (n, axes) chunk indices along
    those.
    """
    spans, listed, lists = [], [], []
    first, count = transform.input_origin, transform.input_shape
    for axis, (out, n) in enumerate(zip(transform.output, side, strict=True)):
        ends = (out.offset, out.offset)
        if out.index_array is not None:
            listed.append(axis)
            lists.append((out.offset + out.stride * np.asarray(out.index_array)) // n)
        elif out.input_dimension is not None:
            low, n_along = first[out.input_dimension], count[out.input_dimension]
            ends = (out.offset + out.stride * low, out.offset + out.stride * (low + n_along - 1))
        spans.append(range(min(ends) // n, max(ends) // n + 1))
    if not listed:
        return spans, listed, np.zeros((1, 0), np.int64)
    points = [at.ravel() for at in np.broadcast_arrays(*lists)]
    return spans, listed, np.stack(points, axis=1)


def _by_row(rows: np.ndarray, numbers: np.ndarray) -> Iterator[tuple[list[int], np.ndarray]]:
    """Yields each distinct row of `rows` (n, k), with those of `numbers` (n,) that belong to it."""
    if (rows == rows[:1]).all():
        if len(rows):
            yield rows[0].tolist(), numbers
        return
    different, members = rows_by_place(rows)
    for row, at in zip(different.tolist(), members, strict=True):
        yield row, numbers[at]
