"""`read_volume`: reads a file into memory; `open_source`: opens a file of any size, to be read by
region. A header whose extent does not fit is refused before memory is allocated.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from ..base import check
from ..base.arrays import ArrayLike
from ..base.boxes import check_extent
from ..base.constants import MAX_VOXELS
from ..base.labels import check_narrowed
from ..base.volume import Volume, to_numpy
from .budget import check_files, check_regular, header_budget
from .formats import FORMATS, find_format, split_path
from .oblique import Oblique, straighten
from .remote import fetch, is_file_url, local_path
from .resources import check_memory
from .source import ArraySource, Index, MemorySource, VolumeSource, check_time, convert_errors
from .stores.ngff import is_zarr
from .stores.store_layout import DTYPES, MAX_STORE_VOXELS, MAX_TIMES
from .stores.tensorstores import StoreError

_MAX_CHANNELS = 2**10


class FormatSettings(TypedDict, total=False):
    """Options of `read_volume` that only some formats take."""

    shape: Sequence[int] | None
    dtype: str | np.dtype | None
    offset: int | None
    key: str | None
    axes: str | None


def read_volume(
    path: str | Path | Any,
    *,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    nan: float | None = None,
    time: int | None = None,
    oblique: Oblique | None = None,
    labels: bool = False,
    **options: Unpack[FormatSettings],
) -> Volume:
    """Reads a volume and the metadata of its file, `Volume.info`.

    `gvtorch info` and docs/formats.md list the formats. RAW has x as its fastest axis. NumPy arrays
    are (z, y, x), or (z, y, x, c) with at most 4 channels; others need `axes`. NIfTI and NRRD axes
    that are parallel to the world's are reordered and flipped to x, y, z; oblique ones are
    resampled. A warning reports resampling, and metadata that is not kept.

    Args:
        path: The file, a folder of slices, `file.h5:/dataset`, a URL (a file is downloaded, see
            docs/formats.md), or an array that `as_volume` takes.
        spacing: (x, y, z) world units; overrides the file's. 1 where neither is given.
        origin: (x, y, z) world position of the first voxel's centre; overrides the file's. 0 where
            neither is given.
        nan: Value that replaces NaN and infinite voxels; if left out, they are refused.
        time: Index of the time point; if left out, the first, with a warning if there are more.
        oblique: What to do if voxel axes are not parallel to the world's: "resample" (the default),
            or "keep", which keeps the voxels and uses their axes as the world's.
        labels: Values are label numbers, see `Volume`; also set if the file says so.
        **options: RAW, and files of unknown ending: shape, (x, y, z) voxels, dtype, a NumPy dtype
            as in "int16" or ">i2" (if left out, from `_XxYxZ_dtype` in the name), and offset, bytes
            of a header to skip. key: which of several arrays, series, scenes or images. Formats
            without names of axes (NPY, NPZ, NRRD, HDF5, Zarr): axes, a letter among t c z y x for
            each axis of the array, the slowest first. docs/formats.md has all formats.

    Returns:
        The volume, dtype kept (64 and 32 bit integers and float64 become float32, unless they are
        labels).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The format is unknown, the file is damaged or too short, or an argument does
            not fit.
        ImportError: A library is missing; the message has the pip command that installs it.
    """
    placement: dict[str, Any] = {"spacing": spacing, "origin": origin, "oblique": oblique}
    placement |= {"time": time, "labels": labels}
    source = open_source(path, max_values=MAX_VOXELS, **placement, **options)
    if time is None and source.times > 1:
        warnings.warn(
            f"{source.path}: has {source.times} time points, this is the first; "
            f"time=N (--time N) reads another, up to {source.times - 1}",
            stacklevel=2,
        )
    return volume_of(source, nan)


def volume_of(source: VolumeSource, nan: float | None = None) -> Volume:
    """Reads a source's time point; `nan` and errors as in `read_volume`."""
    data, name = read_time_points(source, source.time)[0], Path(source.path).name
    return Volume(data, source.spacing, source.origin, name=name, nan=nan, info=source.info)


def open_source(
    path: str | Path | Any,
    *,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    time: int | None = None,
    oblique: Oblique | None = None,
    labels: bool = False,
    max_values: int = MAX_STORE_VOXELS * _MAX_CHANNELS,
    **options: Unpack[FormatSettings],
) -> VolumeSource:
    """Reads a volume's header and returns a source, from which its voxels can be read by region.

    Args, Raises: as `read_volume`, and
        max_values: Values (voxels times channels) of a time point; a larger volume is refused.

    Returns:
        The source, its `time` as asked for, or 0.
    """
    check.known_options("read_volume", options, FormatSettings)
    arguments: dict[str, Any] = {name: v for name, v in options.items() if v is not None}
    text, kind, opener = _find_opener(path, arguments)
    for name in ("key", "axes"):
        check.text(text, name, arguments.get(name))
    check.instance(text, "labels", labels, bool)
    with convert_errors(ValueError, text, f"can't be read as {kind}", StoreError, TimeoutError):
        # Numbers out of range are refused below; NumPy would print its warnings before the error.
        with header_budget(text), np.errstate(all="ignore"):
            source = opener(**arguments)
        check_files(source)
        if labels:
            source = source.as_labels()
        if isinstance(source, MemorySource) and not source.info.labels:
            check_narrowed(text, source.data)  # before anything is written
        check_extent(text, (*source.extent, source.width), max_values=max_values)
        check_extent(text, source.extent, max_values=MAX_STORE_VOXELS)
        if not 1 <= source.times <= MAX_TIMES or min(source.shape) < 1:
            raise ValueError(f"{text}: expected 1 to {MAX_TIMES} time points, got {source.times}")
        check_time(text, 0 if time is None else time, source.times)
        source = source.at_time(time or 0)
        is_label_number = source.info.labels and np.dtype(source.dtype).kind in "iuf"
        if source.dtype not in DTYPES and not is_label_number:
            raise ValueError(f"{text}: values must be real numbers, got dtype {source.dtype}")
        source.check_file()
        if source.oblique is not None and spacing is not None and oblique != "keep":
            raise ValueError(
                f"{text}: voxel axes are oblique, resampling finds their spacing: leave spacing "
                "out, or keep the voxels as they are with oblique='keep' (--oblique keep)"
            )
        with np.errstate(all="ignore"):
            source = straighten(source, oblique, first_voxel=origin)
    if source.dropped:
        dropped = " ".join("; ".join(source.dropped).split())  # in one line, whatever the file says
        warnings.warn(f"{text}: not kept: {dropped}", stacklevel=2)
    return with_placement(text, source, spacing, origin)


def _find_opener(
    path: Any, arguments: dict[str, Any]
) -> tuple[str, str, Callable[..., VolumeSource]]:
    """Returns a volume's name in messages, its format, and its opener; may add `key`."""
    if not isinstance(path, (str, PathLike)):
        text, kind = "array", "an array"
        opener: Callable[..., VolumeSource] = partial(as_source, "read_volume", path)
        known_options: tuple[str, ...] = () if isinstance(path, Volume) else ("axes",)
    else:
        text, key = split_path(local_path(str(path)))
        if is_file_url(text):
            text = str(fetch(text))
        if key is not None:
            if "key" in arguments:
                raise ValueError(f"{path}: key is given twice, also as {arguments['key']!r}")
            arguments["key"] = key.strip("/") if is_zarr(text) else key
        if not is_zarr(text) and not Path(text).exists():
            raise FileNotFoundError(f"volume not found: {path}")
        if "://" not in text:
            check_regular(text)
        file_format = find_format(text, raw="shape" in arguments)
        kind, known_options = file_format.name, file_format.options
        opener = partial(file_format.open, text)
    for name in sorted(set(arguments).difference(known_options)):
        owners = ", ".join(other.name for other in FORMATS if name in other.options)
        raise ValueError(f"{text}: {name} is for {owners} files, this is {kind}")
    if isinstance(path, (str, PathLike)):
        file_format.need_library(text)
    return text, kind, opener


def with_placement(
    context: str,
    source: VolumeSource,
    spacing: Sequence[float] | None,
    origin: Sequence[float] | None,
) -> VolumeSource:
    """Returns the source with the user's spacing and origin; None keeps those of the file."""
    steps = source.spacing if spacing is None else spacing
    position = source.origin if origin is None else origin
    steps, position = check.grid_placement(context, steps, position, source.extent)
    return dataclasses.replace(source, spacing=steps, origin=position)


def read_time_points(source: VolumeSource, first: int = 0, times: int = 1) -> np.ndarray:
    """Reads whole time points, (t, z, y, x, c); raises ValueError if the file is damaged."""
    is_array = isinstance(source, (ObjectSource, MemorySource))
    same_dtype = np.dtype(source.stored).name == source.dtype
    # A file that is mapped is not copied.
    is_mapped = isinstance(source, ArraySource) and not source.whole and same_dtype
    if not isinstance(source, MemorySource) and not is_mapped:
        check_memory(source.path, source.peak_bytes + (times - 1) * source.nbytes)
    kind = "an array" if is_array else find_format(source.path, raw=True).name
    problem = f"can't be read as {kind}"
    with convert_errors(ValueError, source.path, problem, StoreError, TimeoutError):
        return source.read_times(first, first + times)


# --- arrays of other libraries, read part by part if they are not in memory


@dataclass(frozen=True, kw_only=True)
class ObjectSource(VolumeSource):
    """An array whose values are read or computed on demand (dask, zarr, h5py, lazy xarray). It can
    be pickled if the array can.
    """

    array: ArrayLike

    def read_stored(self, index: Index) -> np.ndarray:
        return self.array.read(index)


def as_source(context: str, data: Any, axes: str | None = None) -> VolumeSource:
    """Returns a volume or an array as a source; see `ArrayLike.of` for arguments and errors."""
    if isinstance(data, Volume):
        placement: dict[str, Any] = {"spacing": data.spacing, "origin": data.origin}
        values, labels = to_numpy(data.data), data.label_values
        values = values if labels is None else labels.numpy()[values.astype(np.int64)]
        return MemorySource.of(values, path=data.name, info=data.info, **placement)
    array = ArrayLike.of(context, data, axes)
    names = ("shape", "axes", "flips", "spacing", "origin", "info", "dropped")
    fields = {name: getattr(array, name) for name in names}
    fields |= {"stored": array.dtype, "path": array.name or "array"}
    mapped = _memory_map(data)
    if mapped is not None:
        return ArraySource(**fields, **mapped)
    if array.lazy:
        return ObjectSource(array=array, **fields)
    values = array.read(tuple(slice(0, size) for size in array.shape))
    return MemorySource(data=np.ascontiguousarray(values), **fields)


def _memory_map(array: Any) -> dict[str, Any] | None:
    """Returns file, offset and order of an array that is a whole memory map, which other processes
    can map too; None for others, among them a copy-on-write map, whose changes the file lacks.
    """
    if not isinstance(array, np.memmap) or array.filename is None or array.mode == "c":
        return None
    is_whole_map = array.base is not None and not isinstance(array.base, np.ndarray)
    if not is_whole_map or not (array.flags.c_contiguous or array.flags.f_contiguous):
        return None
    fortran = not array.flags.c_contiguous
    return {"file": str(array.filename), "offset": int(array.offset), "fortran": fortran}
