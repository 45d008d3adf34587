"""`read_volume`: a file into memory; `open_source`: a file of any size, to be read in regions.

Every header is read first and refused if its extent does not fit, before memory is taken.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from ..base import check
from ..base.constants import MAX_VOXELS
from ..base.volume import Volume, check_extent
from .formats import FORMATS, find_format
from .level_reader import no_time
from .ngff import is_zarr
from .oblique import Oblique, straighten
from .source import VolumeSource, told_as
from .store_layout import DTYPES, MOST_TIMES, MOST_VOXELS, StoreError

_MOST_CHANNELS = 2**10


class FormatSettings(TypedDict, total=False):
    """Options of `read_volume` that only some formats take."""

    shape: Sequence[int] | None
    dtype: str | np.dtype | None
    key: str | None
    axes: str | None


def read_volume(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    nan: float | None = None,
    time: int | None = None,
    oblique: Oblique | None = None,
    labels: bool = False,
    **options: Unpack[FormatSettings],
) -> Volume:
    """Reads a volume, with what the file tells of it: `Volume.info`.

    Formats: RAW (`.raw`, `.raw.gz`; x fastest), `.npy`, `.npy.gz`, `.npy.bz2`, `.npz`, NIfTI
    (`.nii`, `.nii.gz`), NRRD (`.nrrd`, `.nhdr`), TIFF (`.tif`, `.tiff`, or a folder of them), FITS
    (`.fits`, `.fits.gz`), OME-Zarr (a folder or a URL). NumPy arrays are (z, y, x), or
    (z, y, x, c) with at most 4 channels; others are asked about (`axes`). NIfTI and NRRD with axes
    along the world's are turned to x, y, z; oblique ones are resampled along them. What is done so,
    and what of the file is not kept, is told in a warning.

    Args:
        path: The file, or a folder of TIFF slices.
        spacing: (x, y, z) world units; overrides the file's. 1 where neither tells.
        origin: (x, y, z) world place of the first voxel's centre; overrides the file's. 0 where
            neither tells.
        nan: Value for voxels that are NaN or infinite; they are refused if left out.
        time: Which time point, from 0; the first, with a warning, if left out where there are more.
        oblique: Of voxel axes that do not lie along the world's: "resample" (the default), or
            "keep", which keeps the voxels and takes their axes for the world's.
        labels: Values are numbers of things, see `Volume`; also where the file says so.
        **options: RAW only: shape, (x, y, z) voxels, and dtype, a NumPy dtype as in "int16" or
            ">i2"; the name's `_XxYxZ_dtype` if left out. `.npz`: key, which array; needed where
            there are several. OME-Zarr: key, name, number or folder of the image. Formats without
            names of axes (NPY, NPZ, NRRD): axes, a letter among t c z y x for each axis of the
            array, the slowest first.

    Returns:
        The volume, dtype kept (64 and 32 bit integers and float64 become float32, unless they are
        labels).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The format is unknown, the file is damaged or too short, or an argument does
            not fit.
        ImportError: A library is missing; the message tells which pip command brings it.
    """
    told: dict[str, Any] = {"spacing": spacing, "origin": origin, "time": time, "oblique": oblique}
    source = open_source(path, most=MAX_VOXELS, labels=labels, **told, **options)
    if time is None and source.times > 1:
        warnings.warn(
            f"{path}: has {source.times} time points, this is the first; time=N (--time N) reads "
            f"another, up to {source.times - 1}",
            stacklevel=2,
        )
    return volume_of(source, nan)


def volume_of(source: VolumeSource, nan: float | None = None) -> Volume:
    """Reads a source's time point; `nan` and errors as of `read_volume`."""
    data, name = read_whole(source, source.time)[0], Path(source.path).name
    return Volume(data, source.spacing, source.origin, name=name, nan=nan, info=source.info)


def open_source(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    time: int | None = None,
    oblique: Oblique | None = None,
    labels: bool = False,
    most: int = MOST_VOXELS * _MOST_CHANNELS,
    **options: Unpack[FormatSettings],
) -> VolumeSource:
    """Reads a volume's header: what there is, where it lies, what reading will take.

    Args, Raises: as `read_volume`, and
        most: Values (voxels times channels) of a time point; a larger volume is refused.

    Returns:
        The source, its `time` as asked for, or 0.
    """
    text = str(path)
    check.known("read_volume", options, FormatSettings)
    if not is_zarr(text) and not Path(text).exists():
        raise FileNotFoundError(f"volume not found: {path}")
    found = find_format(text)
    given = {name: value for name, value in options.items() if value is not None}
    for name in sorted(set(given).difference(found.options)):
        owners = ", ".join(other.name for other in FORMATS if name in other.options)
        raise ValueError(f"{path}: {name} is for {owners} files, this is {found.name}")
    found.need_library(text)
    with told_as(ValueError, text, f"can't be read as {found.name}", StoreError, TimeoutError):
        source = found.open(text, **given)
        if labels:
            source = dataclasses.replace(source, info=dataclasses.replace(source.info, labels=True))
        check_extent(text, (*source.extent, source.width), most=most)
        check_extent(text, source.extent, most=MOST_VOXELS)
        if not 1 <= source.times <= MOST_TIMES or min(source.shape) < 1:
            raise ValueError(f"{path}: expected 1 to {MOST_TIMES} time points, got {source.times}")
        if time is not None and (type(time) is not int or not 0 <= time < source.times):
            raise ValueError(no_time(text, time, source.times))
        source = source.at_time(time or 0)
        kind = np.dtype(source.dtype).kind
        if source.dtype not in DTYPES and not (source.info.labels and kind in "iuf"):
            raise ValueError(f"{path}: values must be real numbers, got dtype {source.dtype}")
        source.check_file()
        if source.oblique is not None and spacing is not None and oblique != "keep":
            raise ValueError(
                f"{path}: voxel axes are oblique, resampling finds their spacing: leave spacing "
                "out, or keep the voxels as they are with oblique='keep' (--oblique keep)"
            )
        source = straighten(source, oblique)
    if source.lost:
        told = " ".join("; ".join(source.lost).split())  # in one line, whatever the file says
        warnings.warn(f"{path}: not kept: {told}", stacklevel=2)
    return placed(text, source, spacing, origin)


def placed(
    where: str,
    source: VolumeSource,
    spacing: Sequence[float] | None,
    origin: Sequence[float] | None,
) -> VolumeSource:
    """Returns the source with the user's spacing and origin; None keeps those of the file."""
    steps = source.spacing if spacing is None else spacing
    place = source.origin if origin is None else origin
    return dataclasses.replace(
        source,
        spacing=check.triple(where, "spacing", steps, positive=True),
        origin=check.triple(where, "origin", place),
    )


def read_whole(source: VolumeSource, first: int = 0, times: int = 1) -> np.ndarray:
    """Reads whole time points, (t, z, y, x, c); raises ValueError if the file is damaged."""
    text = f"can't be read as {find_format(source.path).name}"
    with told_as(ValueError, source.path, text, StoreError, TimeoutError):
        return source.read_times(first, first + times)
