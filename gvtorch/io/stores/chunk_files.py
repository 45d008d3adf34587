"""What the files of a chunked array may be: how long, of which kind, and how much Blosc makes of
them. tensorstore opens what lies there, of any length, and takes the memory that Blosc's head asks
for, up to 2 GiB a chunk; so `begin_read` looks first, and the relay at what servers send.

gzip, zlib, bzip2, xz and zstd need no look: tensorstore unpacks only what a chunk has room for.
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

HEADS = ("zarr.json", ".zarray", "attributes.json")  # files of an array that are no chunks
_MOST_CHUNK = 1 << 31  # bytes
_ENTRY = 16  # bytes of a shard's index: where a chunk lies, and how long it is
_CHECKSUM = 4  # bytes
_NOWHERE = 2**63  # and beyond: of chunks that are not there
_BLOSC = 8  # bytes of its head; the last four tell what it makes


def index_bytes(values: int, chunk: int, *, summed: bool = True) -> int:
    """Bytes of the index of a shard of so many values, in chunks of so many."""
    return _ENTRY * (values // max(1, chunk)) + _CHECKSUM * summed


def file_limit(values: int, chunk: int, item: int) -> int:
    """Bytes that a file of so many values of `item` bytes each may take, and its index: no codec
    makes twice of what it packs.
    """
    return 2 * values * item + index_bytes(values, chunk) + SMALL


def check_file(path: str, most: int) -> int | None:
    """Returns the bytes of a file; None if there is none. Links are followed.

    Raises:
        Endless: It is a folder, a pipe, a device, or longer than `most` bytes.
    """
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None  # tensorstore tells what is wrong, if it is
    if not stat.S_ISREG(found.st_mode):
        raise Endless("is no regular file")
    if found.st_size > most:
        raise Endless(f"takes {found.st_size} bytes, more than the {most} that fit")
    return found.st_size


def files_of(where: str, array: Any) -> ChunkFiles:
    """Reads the metadata of one of tensorstore's arrays; raises ValueError where reading a chunk
    takes too much memory, or can.
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
    """Begins to read an array, once its files on disk were looked at.

    Args:
        view: tensorstore's array, or a part of one.
        files: Those of the whole array.
        chunks: (n, axes) int64 places of the chunks that it needs, where they are known: numbers
            of chunks along each axis of the whole array. Else tensorstore is asked, which is slow.

    Returns:
        tensorstore's future of the values, in the order of C; a failed one where a file is not
        what it may be.
    """
    try:
        if files.folder:
            files.check(view.spec().transform if chunks is None else chunks)
    except Endless as error:
        return failed(error)
    return view.read(order="C")


def failed(error: Exception) -> Any:
    """Returns a future of tensorstore's that has failed."""
    import tensorstore as ts

    promised: tuple[Any, Any] = ts.Promise.new()
    promised[0].set_exception(error)
    return promised[1]


@dataclass(frozen=True, kw_only=True)
class ChunkFiles:
    """What an array's metadata tells of its files: a chunk each, or shards, which hold an index and
    many; "chunk" is then the inner one.
    """

    folder: str  # path of the array; "" behind a URL, where the relay looks
    begin: str = ""  # of a file's name
    separator: str  # of the numbers in a file's name
    file: tuple[int, ...]  # values of a file along each axis
    chunk: tuple[int, ...]  # and of a chunk
    item: int  # bytes of a value
    index: str = ""  # "start" or "end": where a shard's index lies; "": files are no shards
    order: str = "<"  # of the index's bytes
    summed: bool = True  # whether a checksum follows the index
    transposed: bool = False  # whether a shard's axes are in another order than the array's
    blosc: bool = False  # whether chunks begin with its head
    n5: bool = False  # its own head comes first

    @classmethod
    def of(cls, array: Any) -> ChunkFiles:
        """Reads the array's metadata.

        Raises:
            Endless: Blosc lies inside another codec, where it can't be looked at.
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
        """Number of them in a file."""
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
        """Where in a shard its index lies."""
        size = self.index_bytes
        return slice(0, size) if self.index == "start" else slice(-size, None)

    def places(self, time: int, zyx: np.ndarray, shape: Sequence[int]) -> np.ndarray | None:
        """Returns (n, axes) places of the chunks of items at places (n, 3), in an array
        ([t,] z, y, x, *shape) that has an item of this shape in each chunk; None for any other.
        """
        before = len(self.chunk) - len(shape)
        if self.transposed or before < 3 or self.chunk != (1,) * before + tuple(shape):
            return None
        found = np.zeros((len(zyx), len(self.chunk)), np.int64)
        found[:, : before - 3], found[:, before - 3 : before] = time, zyx
        return found

    def entries(self, index: bytes) -> np.ndarray:
        """(n, 2) uint64 where chunks lie in a shard and how long they are, of its index or of some
        entries.
        """
        found = np.frombuffer(index, f"{self.order}u8", len(index) // _ENTRY * 2)
        return found.astype(np.uint64).reshape(-1, 2)

    def check(self, part: Any) -> None:
        """Looks at the files on disk that a part of the array lies in: places of chunks, or
        tensorstore's IndexTransform from the part to the array.

        Raises:
            Endless: A file is no regular one, or too long, or Blosc would make too much of it.
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
        """Looks at bytes that a server sent, those of a file from byte `begin` on. Raises as
        `check`.

        Args:
            begin: 0 for the file's first byte.
            content: The bytes.
            entries: (n, 2) where the chunks lie in the file, if it is a shard.
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
        """Numbers of all chunks of a file, where it is looked at as a whole: it has one, or which
        are wanted can't be told.
        """
        return np.arange(self.chunks) if self.transposed or not self.index else None

    @cached_property
    def _counts(self) -> tuple[np.ndarray, np.ndarray]:
        """(axes,) chunks of a file along each axis, and by how much a chunk's number in its file
        grows along each; one chunk a file where it is looked at as a whole.
        """
        count = [a // b for a, b in zip(self.file, self.chunk, strict=True)]
        strides = [math.prod(count[axis + 1 :]) for axis in range(len(count))]
        if self._every is not None:  # files for chunks
            count = [1] * len(count)
        return np.array(count, np.int64), np.array(strides, np.int64)

    def _listed(self, chunks: np.ndarray) -> Iterator[tuple[Sequence[int], np.ndarray]]:
        """Places of the files of chunks at places (n, axes), and in each the numbers of those."""
        count, strides = self._counts
        files = chunks // count
        for place, numbers in _by_row(files, (chunks - files * count) @ strides):
            yield place, numbers if self._every is None else self._every

    def _files(self, transform: Any) -> Iterator[tuple[Sequence[int], np.ndarray]]:
        """The same for a part of the array, of which tensorstore's IndexTransform tells."""
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
            return  # tensorstore tells
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
                return  # cut, as tensorstore tells
            entries = self.entries(os.pread(file, _ENTRY * (high - low), at))
            starts = entries[chunks[chunks - low < len(entries)] - low, 0]
            starts = starts[starts < _NOWHERE].tolist()
            self._check_heads([os.pread(file, _BLOSC, start) for start in starts])
        finally:
            os.close(file)

    def _head(self, content: bytes) -> int:
        """Bytes of a chunk before Blosc's head."""
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
    """Fields of `ChunkFiles` out of an array's zarr.json."""
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
        raise Endless(f"Blosc lies inside {last}, where what it makes can't be looked at")
    begin = f"c{separator}" if plain else ""
    return {**shard, "begin": begin, "separator": separator, "file": file, "blosc": last == "blosc"}


def _names(codecs: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Names of codecs, those inside others too."""
    for codec in codecs:
        yield from _names(codec.get("configuration", {}).get("codecs", ()))
        yield codec["name"]


def _places(transform: Any, side: Sequence[int]) -> tuple[list[range], list[int], np.ndarray]:
    """Places of the chunks of `side` values that a part of an array lies in: along each axis those
    of a span; and which axes are listed instead, and (n, axes) places along these.
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
    """Yields each different row of `rows` (n, k) once, with the numbers (n,) that stand at it."""
    if (rows == rows[:1]).all():
        if len(rows):
            yield rows[0].tolist(), numbers
        return
    different, members = rows_by_place(rows)
    for row, at in zip(different.tolist(), members, strict=True):
        yield row, numbers[at]
