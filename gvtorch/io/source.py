"""`VolumeSource`: a volume in a file whose header has been read; its voxels are read by region.

A source is plain data (path, shape, offset, ...) that can be pickled for worker processes; files
are opened in the process that reads. The formats (formats/) make sources: `ArraySource` if numbers
lie one after another in the file; `place_axes` helps if the header has an affine from voxels to the
world.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import time_ns
from typing import Any, Self

import numpy as np

from ..base import boxes
from ..base.image_info import ChannelInfo, ImageInfo
from ..base.labels import check_narrowed
from ..base.messages import one_line
from ..base.whole_file import name_in_errors, save_npy
from .packed import open_unpacked
from .stores.store_layout import value_dtype

Index = tuple[slice, ...]
Triple = tuple[float, float, float]
FileMetadata = tuple[ImageInfo, Triple, list[str]]  # info, spacing, metadata that is not kept
_PART_BYTES = 1 << 20  # bytes that are unpacked at a time
_INTEGERS = {"char": "i1", "short": "i2", "int": "i4", "longlong": "i8"}
_INTEGERS |= {"int8": "i1", "int16": "i2", "int32": "i4", "int64": "i8"}
_DTYPE_CODES = {
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
    **_INTEGERS,
    **{f"u{name}": code.replace("i", "u") for name, code in _INTEGERS.items()},
}
_C_INTEGER = re.compile(
    r"(?:(?P<un>un)?signed )?(?:(?P<any>char|int)|(?P<long>short|longlong)(?: int)?)"
)
#: (4, 4) from world axes left, posterior, superior (LPS) to right, anterior, superior (RAS).
LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class VolumeSource(ABC):
    """A volume as its header describes it: axes in any order, and a position in the world."""

    path: str  # the file, folder or URL, as the user named it
    shape: tuple[int, ...]  # of the array as it is stored
    axes: str  # a letter for each of its axes: t, c, z, y, x, or - for one of size 1 to drop
    stored: str  # NumPy dtype as it is stored, with byte order
    flips: str = ""  # letters of axes that run backwards
    spacing: Triple = (1.0, 1.0, 1.0)  # x y z, world units
    origin: Triple = (0.0, 0.0, 0.0)  # x y z, centre of voxel 0
    # (3, 4) from voxels to the world, if the axes x, y, z are not parallel to the world's.
    oblique: tuple[tuple[float, ...], ...] | None = None
    info: ImageInfo = dataclasses.field(default_factory=ImageInfo)  # unit, channels, ...
    dropped: tuple[str, ...] = ()  # metadata of the file that is not kept, a few words each
    time: int = 0  # the time point that is read
    whole: bool = False  # every read unpacks the whole file: one read of all is better
    unpacked_bytes: int = 0  # size of the largest piece that is unpacked at once
    # Time in ns; distinguishes sources of one path in caches of open files.
    opened: int = dataclasses.field(default_factory=time_ns, repr=False)

    @property
    def extent(self) -> tuple[int, int, int]:
        """(x, y, z) voxels."""
        return (self.size("x"), self.size("y"), self.size("z"))

    @property
    def width(self) -> int:
        """Number of channels."""
        return self.size("c")

    @property
    def times(self) -> int:
        """Number of time points."""
        return self.size("t")

    @property
    def dtype(self) -> str:
        """Dtype of the values read: wide numbers become float32, as in `Volume`; labels do not."""
        return value_dtype(np.dtype(self.stored), labels=self.info.labels)

    @property
    def nbytes(self) -> int:
        """Bytes of all values of a time point as they are read."""
        return math.prod(self.shape) // self.times * np.dtype(self.dtype).itemsize

    @property
    def peak_bytes(self) -> int:
        """Bytes of memory that reading a time point takes: the stored values and the result."""
        unpacked = self.times if self.whole else 1  # time points that are unpacked
        values = self.nbytes // np.dtype(self.dtype).itemsize
        return self.nbytes + values * unpacked * np.dtype(self.stored).itemsize

    def size(self, axis: str) -> int:
        """Returns the size along an axis; 1 if the array lacks the axis."""
        return self.shape[self.axes.index(axis)] if axis in self.axes else 1

    def at_time(self, time: int) -> Self:
        """Returns the source of another time point."""
        return self if time == self.time else dataclasses.replace(self, time=time)

    def as_labels(self) -> Self:
        """Returns the source as one of labels: its values are label numbers, kept exactly."""
        return dataclasses.replace(self, info=dataclasses.replace(self.info, labels=True))

    def staged(self, folder: Path) -> VolumeSource:
        """Returns a source that other processes can read; data in memory is written to `folder`."""
        return self

    def fingerprint(self) -> list[Any] | None:
        """Returns values that change with the content; None if the files at `path` identify it."""
        return None

    def check_file(self) -> None:  # noqa: B027, most formats find out when they read
        """Raises ValueError if the file is evidently too short, without reading it."""

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
        with convert_errors(OSError, self.path, "can't be read", OSError):
            data = self.read_box(low, high, (self.time, self.time + 1))[0]
            # A copy, because pages of a mapping that is kept would count as this process's memory.
            return data.copy() if isinstance(data.base, np.memmap) else data

    def read_times(self, start: int, stop: int) -> np.ndarray:
        """Reads or maps whole time points; see `read_box`."""
        return self.read_box((0, 0, 0), self.extent[::-1], (start, stop))

    def read_box(
        self, low: Sequence[int], high: Sequence[int], times: tuple[int, int]
    ) -> np.ndarray:
        """Reads or maps a box of time points, (t, z, y, x, c) of `dtype`; may raise anything."""
        index, spans = [], dict(zip("tzyx", (times, *zip(low, high, strict=True)), strict=True))
        for axis, size in zip(self.axes, self.shape, strict=True):
            start, stop = spans.get(axis, (0, size))
            backwards = axis in self.flips
            index.append(slice(size - stop, size - start) if backwards else slice(start, stop))
        with np.errstate(all="ignore"):  # NaN and infinity are refused or replaced later
            data = self.read_stored(tuple(index))
        data = boxes.to_zyxc(data, self.axes, "tzyxc")
        data = np.flip(data, tuple("tzyx".index(axis) for axis in self.flips))
        if not self.info.labels:
            check_narrowed(self.path, data)
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite
            return np.asarray(data).astype(self.dtype, order="C", copy=False)


@dataclass(frozen=True, kw_only=True)
class ArraySource(VolumeSource):
    """An array that is contiguous in a file: mapped into memory, or unpacked whole."""

    file: str  # holds the array
    member: str = ""  # the file inside it, if it is a ZIP archive
    codec: str = ""  # "gzip", "bz2" or "zlib", if the file's ending does not say it
    start: int = 0  # bytes before the packed array, in the file
    offset: int = 0  # bytes before the array, in the unpacked file
    fortran: bool = False  # first axis fastest
    exact: bool = False  # nothing may follow the array

    def check_file(self) -> None:
        if not self.whole:
            self._check_size(os.stat(self.file).st_size - self.offset)

    def read_stored(self, index: Index) -> np.ndarray:
        order: Any = "F" if self.fortran else "C"
        if not self.whole:
            dtype = np.dtype(self.stored)
            return np.memmap(self.file, dtype, "r", self.offset, self.shape, order)[index]
        content, size = np.empty(self._expected_bytes + self.exact, np.uint8), 0
        with open_unpacked(self.file, self.member, self.codec, self.start) as stream:
            stream.read(self.offset)
            while part := stream.read(min(_PART_BYTES, len(content) - size)):
                content[size : size + len(part)] = memoryview(part)
                size += len(part)
        self._check_size(size)
        numbers = content[: self._expected_bytes].view(self.stored)
        return numbers.reshape(self.shape, order=order)[index]

    @property
    def _expected_bytes(self) -> int:
        return math.prod(self.shape) * np.dtype(self.stored).itemsize

    def _check_size(self, size: int) -> None:
        if size < self._expected_bytes or (self.exact and size > self._expected_bytes):
            array = f"{'x'.join(map(str, self.shape))} {np.dtype(self.stored).name}"
            actual = "more" if self.whole and size > self._expected_bytes else max(size, 0)
            raise ValueError(
                f"{self.path}: {array} takes {self._expected_bytes} bytes, the file has {actual}"
            )


@dataclass(frozen=True, kw_only=True)
class MemorySource(VolumeSource):
    """A volume that lies in memory."""

    data: np.ndarray = dataclasses.field(repr=False)

    @classmethod
    def of(cls, data: np.ndarray, **fields: Any) -> MemorySource:
        """Wraps (z, y, x, c) or (t, z, y, x, c) values; `fields`: path, spacing, origin, info."""
        axes = "tzyxc"[-data.ndim :]
        return cls(data=data, shape=data.shape, axes=axes, stored=data.dtype.str, **fields)

    def staged(self, folder: Path) -> VolumeSource:
        file = folder / "source.npy"
        with name_in_errors(file):
            save_npy(file, self.data)
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(VolumeSource)}
        fields |= {"path": str(file), "file": str(file), "fortran": self.data.flags.fnc}
        return ArraySource(offset=file.stat().st_size - self.data.nbytes, **fields)

    def read_stored(self, index: Index) -> np.ndarray:
        return self.data[index]


def microscope_info(
    unit: str | None,
    channels: Sequence[ChannelInfo],
    width: int,
    step: float | None = None,
    step_unit: str | None = None,
) -> ImageInfo:
    """Returns an image's info: its channels, if there is one for each of the `width` numbers of a
    voxel; the time step and its unit, if the step is positive.
    """
    fitting = tuple(channels) if len(channels) == width else ()
    return ImageInfo(unit=unit, channels=fitting, **time_fields(step, step_unit))


def time_fields(step: float | None, unit: str | None, origin: float = 0.0) -> dict[str, Any]:
    """Returns time_step, time_unit and time_origin of an `ImageInfo`, as far as they are usable."""
    has_step = step is not None and 0 < step < math.inf
    known: dict[str, Any] = {"time_step": step, "time_unit": unit} if has_step else {}
    return known | {"time_origin": origin if math.isfinite(origin) else 0.0}


def read_planes(
    index: Index, count: int, stored: str, read: Callable[[tuple[int, ...]], np.ndarray]
) -> np.ndarray:
    """Returns the part `index` of an array of dtype `stored` that is read plane by plane: `read`
    gets a position along the first `count` axes, and returns the part `index[count:]` there.
    """
    data = np.empty([span.stop - span.start for span in index], stored)
    for offset in np.ndindex(data.shape[:count]):
        data[offset] = read(tuple(s.start + n for s, n in zip(index, offset, strict=False)))
    return data


def place_axes(
    path: str,
    affine: np.ndarray,
    shape: Sequence[int],
    component: int | None = None,
    time: int | None = None,
) -> dict[str, Any]:
    """Matches voxel axes with the world's, by `affine` (4, 4) from voxel indices to the world.

    Axes count as parallel to the world's if this moves no voxel by more than half a voxel. Others
    are called x, y, z in their order, and `oblique` is their affine (see oblique.py).

    Args:
        path: For messages.
        affine: From indices along the three axes of space, in the order of the array.
        shape: Of the array as it is stored.
        component: The axis of the array that counts components, if any.
        time: The axis that counts time points, if any.

    Returns:
        The fields axes, flips, spacing, origin and oblique of a `VolumeSource`.
    """
    matrix, origin = affine[:3, :3].astype(np.float64), affine[:3, 3].astype(np.float64)
    lengths = np.linalg.norm(matrix, axis=0)
    volume = np.linalg.det(matrix / np.where(lengths > 0, lengths, 1))
    finite = np.isfinite(affine).all() and np.isfinite(lengths).all()
    if not finite or (lengths == 0).any() or abs(volume) < 1e-6:
        rows = affine[:3].tolist()
        raise ValueError(f"{path}: the header's voxel axes are degenerate: {rows}")
    axis_letters = ["t" if axis == time else "c" for axis in range(len(shape))]
    spatial = [axis for axis in range(len(shape)) if axis not in (component, time)]
    world_axis = np.abs(matrix).argmax(axis=0)  # of each voxel axis
    axis_aligned = np.zeros((3, 3))
    axis_aligned[world_axis, [0, 1, 2]] = matrix[world_axis, [0, 1, 2]]
    last_index = np.array([shape[axis] - 1 for axis in spatial])
    # By which the farthest voxel is moved.
    displacement = np.abs((matrix - axis_aligned) * last_index).sum(1)
    is_oblique = len(set(world_axis.tolist())) != 3 or (displacement > lengths.min() / 2).any()
    if is_oblique:
        order, steps = np.arange(3), lengths
    else:
        order = np.argsort(world_axis)
        steps = axis_aligned[[0, 1, 2], order]
    for axis, letter in enumerate("xyz"):
        voxel_axis = spatial[order[axis]]
        axis_letters[voxel_axis] = letter
        if steps[axis] < 0:
            origin[axis] += steps[axis] * (shape[voxel_axis] - 1)
    return {
        "axes": "".join(axis_letters),
        "flips": "".join(letter for letter, step in zip("xyz", steps, strict=True) if step < 0),
        "spacing": tuple(np.abs(steps).tolist()),
        "origin": tuple(origin.tolist()),
        "oblique": tuple(map(tuple, affine[:3].tolist())) if is_oblique else None,
    }


def number_type(name: str) -> str | None:
    """Returns the dtype, without byte order, for the name of a type as in C or with its bits:
    "unsigned short int", "uchar", "long_long", "uint16_t", "Float32". None if it is unknown, as is
    "long", which has 4 bytes or 8.
    """
    normalized = name.lower().replace("_", " ").replace("long long", "longlong")
    if match := _C_INTEGER.fullmatch(normalized):  # in several words
        normalized = ("u" if match["un"] else "") + (match["any"] or match["long"])
    has_size = normalized[-3:-2].isdigit()  # as in "uint16 t"
    return _DTYPE_CODES.get(normalized.removesuffix(" t") if has_size else normalized)


def check_time(context: str, time: object, times: int) -> None:
    """Raises ValueError if there is no such time point."""
    if type(time) is not int or not 0 <= time < times:
        several = f"{times} time points, 0 to {times - 1}"
        available = several if times > 1 else "1 time point, which is 0"
        raise ValueError(f"{context}: has no time {time!r}; it has {available}")


@contextmanager
def convert_errors(
    kind: type[Exception], path: str, problem: str, *passed: type[Exception]
) -> Iterator[None]:
    """Converts whatever a format library raises for a damaged file to `kind`, with the one-line
    message "path: what: reason". Errors about missing libraries and files, and the types in
    `passed`, pass unchanged.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, (ImportError, FileNotFoundError, *passed)):
            raise
        reason = one_line(error)
        prefix = "" if reason.startswith(one_line(path)) else f"{path}: {problem}: "
        raise kind(prefix + reason) from error
