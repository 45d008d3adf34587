"""`VolumeSource`: a volume in a file, its header read, its voxels read region by region.

A source is plain data (path, shape, offset, ...) that can be pickled, so that worker processes can
have it; files are opened in the process that reads. The formats (formats/) make sources;
`ArraySource` serves all of those that hold their numbers one after another.
"""

from __future__ import annotations

import bz2
import dataclasses
import gzip
import math
import os
import time
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from .store_layout import value_dtype

Index = tuple[slice, ...]


@dataclass(frozen=True, kw_only=True)
class VolumeSource(ABC):
    """What a header tells: an array whose axes lie in any order, and its place in the world.

    Attributes:
        path: The file, folder or URL, as the user named it.
        shape: Of the array as it is stored.
        axes: A letter for each of its axes: z, y, x, c, or - for one of size 1 to drop.
        stored: NumPy dtype as it is stored, with byte order.
        flips: Letters of axes that run backwards.
        spacing: (x, y, z) world units, distance of neighbouring voxel centres.
        origin: (x, y, z) world units, centre of voxel 0.
        unit: Unit of length, or None.
        whole: Whether every read unpacks the whole file, so that one read of all is better.
        opened: When (ns): tells sources of one path apart, for what is kept open between reads.
    """

    path: str
    shape: tuple[int, ...]
    axes: str
    stored: str
    flips: str = ""
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: str | None = None
    whole: bool = False
    opened: int = dataclasses.field(default_factory=time.time_ns)

    @property
    def extent(self) -> tuple[int, int, int]:
        """(x, y, z) voxels."""
        return (self.size("x"), self.size("y"), self.size("z"))

    @property
    def width(self) -> int:
        """Number of channels."""
        return self.size("c")

    @property
    def dtype(self) -> str:
        """What values are read as: wide numbers become float32, as in `Volume`."""
        return value_dtype(np.dtype(self.stored))

    @property
    def nbytes(self) -> int:
        """Bytes of all values as they are read."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize

    @property
    def peak_bytes(self) -> int:
        """Bytes of memory that reading all at once takes: as it is stored, and as it is read."""
        return math.prod(self.shape) * np.dtype(self.stored).itemsize + self.nbytes

    def size(self, axis: str) -> int:
        """Voxels along an axis, 1 where it has none."""
        return self.shape[self.axes.index(axis)] if axis in self.axes else 1

    def covers(self, index: Index) -> bool:
        """Whether an index takes the whole array."""
        return all(s.stop - s.start == n for s, n in zip(index, self.shape, strict=True))

    def check_file(self) -> None:  # noqa: B027, most formats find out when they read
        """Raises ValueError if the file is seen to be too short, without reading it."""

    @abstractmethod
    def read_stored(self, index: Index) -> np.ndarray:
        """Reads a part of the array as it is stored; damaged files may raise anything."""

    def read_region(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Reads the box `low` to `high`, (z, y, x), which must lie inside.

        Returns:
            (z, y, x, c) of `dtype`.

        Raises:
            OSError: The file can't be read any more, or is damaged.
        """
        with told_as(OSError, self.path, "can't be read", OSError):
            data = self._read(low, high)
            # Pages of a mapping that stays would count as this process's memory.
            return data.copy() if isinstance(data.base, np.memmap) else data

    def read_whole(self) -> np.ndarray:
        """Reads or maps all, (z, y, x, c) of `dtype`; damaged files may raise anything."""
        return self._read((0, 0, 0), self.extent[::-1])

    def _read(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        spans = dict(zip("zyx", zip(low, high, strict=True), strict=True))
        index = []
        for axis, size in zip(self.axes, self.shape, strict=True):
            start, stop = spans.get(axis, (0, size))
            backwards = axis in self.flips
            index.append(slice(size - stop, size - start) if backwards else slice(start, stop))
        data = self.read_stored(tuple(index))
        data = data.squeeze(tuple(i for i, axis in enumerate(self.axes) if axis == "-"))
        missing = "".join(axis for axis in "zyxc" if axis not in self.axes)
        letters = missing + self.axes.replace("-", "")
        data = data[(None,) * len(missing)].transpose([letters.index(axis) for axis in "zyxc"])
        data = np.flip(data, tuple("zyx".index(axis) for axis in self.flips))
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite
            return np.asarray(data).astype(self.dtype, order="C", copy=False)


@dataclass(frozen=True, kw_only=True)
class ArraySource(VolumeSource):
    """Numbers one after another in a file: mapped into memory, or unpacked whole.

    Attributes:
        file: Where they lie.
        member: Which file inside it, where it is a ZIP archive.
        offset: Bytes before the array, unpacked.
        fortran: First axis fastest.
        exact: Whether nothing may follow the array.
    """

    file: str
    member: str = ""
    offset: int = 0
    fortran: bool = False
    exact: bool = False

    def check_file(self) -> None:
        """Compares the file's size with what the array takes."""
        if not self.whole:
            self._check_size(os.stat(self.file).st_size - self.offset)

    def read_stored(self, index: Index) -> np.ndarray:
        """Maps the file, or unpacks it."""
        order: Any = "F" if self.fortran else "C"
        if not self.whole:
            data: np.ndarray = np.memmap(
                self.file, np.dtype(self.stored), "r", self.offset, self.shape, order
            )
            return data[index]
        with open_unpacked(self.file, self.member) as stream:
            stream.read(self.offset)
            content = stream.read(self._expected + self.exact)
        self._check_size(len(content))
        return np.frombuffer(content, self.stored).reshape(self.shape, order=order)[index]

    @property
    def _expected(self) -> int:
        return math.prod(self.shape) * np.dtype(self.stored).itemsize

    def _check_size(self, size: int) -> None:
        if size < self._expected or (self.exact and size > self._expected):
            sizes = "x".join(str(n) for n in self.shape)
            raise ValueError(
                f"{self.path}: {sizes} {np.dtype(self.stored).name} takes {self._expected} bytes, "
                f"the file has {'more' if self.whole and size > self._expected else max(size, 0)}"
            )


@dataclass(frozen=True, kw_only=True)
class MemorySource(VolumeSource):
    """A volume that lies in memory.

    Attributes:
        data: (z, y, x, c).
    """

    data: np.ndarray = dataclasses.field(repr=False)

    @classmethod
    def of(cls, data: np.ndarray, **told: Any) -> MemorySource:
        """Takes (z, y, x, c) values; `told` are path, spacing, origin and unit."""
        return cls(data=data, shape=data.shape, axes="zyxc", stored=data.dtype.str, **told)

    def read_stored(self, index: Index) -> np.ndarray:
        """Returns a view."""
        return self.data[index]

    def read_region(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Returns the box `low` to `high`, (z, y, x), as a view."""
        return self.data[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]


def open_unpacked(file: str, member: str = "") -> IO[bytes]:
    """Opens a file to read what it unpacks to: .gz, .bz2, or a member of a ZIP archive."""
    if member:
        with zipfile.ZipFile(file) as archive:  # what is open in it stays open
            return archive.open(member)
    if file.lower().endswith(".gz"):
        return gzip.open(file, "rb")  # type: ignore[return-value]
    return bz2.open(file, "rb") if file.lower().endswith(".bz2") else open(file, "rb")


@contextmanager
def told_as(
    kind: type[Exception], path: str, what: str, *through: type[Exception]
) -> Iterator[None]:
    """Turns what a format library raises for a damaged file, which may be anything, into one line.

    Args:
        kind: What to raise.
        path: The file that the user named.
        what: "can't be read".
        through: What passes as it is, beside missing libraries and files.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, (ImportError, FileNotFoundError, *through)):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        prefix = "" if reason.startswith(path) else f"{path}: {what}: "
        raise kind(prefix + reason) from error
