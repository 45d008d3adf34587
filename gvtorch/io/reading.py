"""`read_volume`: a file into memory; `open_source`: a file of any size, to be read in regions.

Every header is read first and refused if its extent does not fit, before memory is taken.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np

from ..base import check
from ..base.constants import MAX_VOXELS
from ..base.volume import Volume, check_extent
from .formats import check_options, find_format
from .ngff import is_zarr
from .source import VolumeSource, told_as
from .store_layout import DTYPES, MOST_VOXELS, StoreError

_MOST_CHANNELS = 2**10


class FormatSettings(TypedDict, total=False):
    """Options of `read_volume` that only some formats take."""

    shape: Sequence[int] | None
    dtype: str | np.dtype | None
    key: str | None


def read_volume(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    nan: float | None = None,
    **options: Unpack[FormatSettings],
) -> Volume:
    """Reads a volume.

    Formats: RAW (`.raw`, `.raw.gz`; x fastest), `.npy`, `.npy.gz`, `.npy.bz2`, `.npz`, NIfTI
    (`.nii`, `.nii.gz`), NRRD (`.nrrd`, `.nhdr`), TIFF (`.tif`, `.tiff`, or a folder of them), FITS
    (`.fits`, `.fits.gz`), OME-Zarr (a folder or a URL). NumPy arrays are (z, y, x) or
    (z, y, x, c). NIfTI and NRRD with axes along the world's are turned to x, y, z; oblique ones
    keep their voxel axes, with a warning.

    Args:
        path: The file, or a folder of TIFF slices.
        spacing: (x, y, z) world units; overrides the file's. 1 where neither tells.
        origin: (x, y, z) world place of the first voxel's centre; overrides the file's. 0 where
            neither tells.
        nan: Value for voxels that are NaN or infinite; they are refused if left out.
        **options: RAW only: shape, (x, y, z) voxels, and dtype, a NumPy dtype as in "int16" or
            ">i2"; the name's `_XxYxZ_dtype` if left out. `.npz` only: key, which array; needed
            where there are several.

    Returns:
        The volume, dtype kept (64 and 32 bit integers and float64 become float32).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The format is unknown, the file is damaged or too short, or an argument does
            not fit.
        ImportError: A library is missing; the message tells which pip command brings it.
    """
    source = open_source(path, spacing=spacing, origin=origin, most=MAX_VOXELS, **options)
    data, name = read_whole(source), Path(path).name
    return Volume(data, source.spacing, source.origin, name=name, nan=nan, info=source.info)


def open_source(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    most: int = MOST_VOXELS * _MOST_CHANNELS,
    **options: Unpack[FormatSettings],
) -> VolumeSource:
    """Reads a volume's header: what there is, where it lies, what reading will take.

    Args, Raises: as `read_volume`, and
        most: Values (voxels times channels); a larger volume is refused.
    """
    text = str(path)
    check.known("read_volume", options, FormatSettings)
    if not is_zarr(text) and not Path(text).exists():
        raise FileNotFoundError(f"volume not found: {path}")
    given = {name: value for name, value in options.items() if value is not None}
    found = find_format(text, raw="shape" in given)
    check_options(text, found, given)
    found.need_library(text)
    with told_as(ValueError, text, f"can't be read as {found.name}", StoreError, TimeoutError):
        source = found.open(text, **given)
        check_extent(text, source.shape, most=most)
        check_extent(text, source.extent, most=MOST_VOXELS)
        if source.dtype not in DTYPES:
            raise ValueError(f"{path}: values must be real numbers, got dtype {source.dtype}")
        source.check_file()
    if source.lost:
        warnings.warn(f"{path}: not kept: {'; '.join(source.lost)}", stacklevel=2)
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


def read_whole(source: VolumeSource) -> np.ndarray:
    """Reads all of a source, (z, y, x, c); raises ValueError if the file is damaged."""
    text = f"can't be read as {find_format(source.path, raw=True).name}"
    with told_as(ValueError, source.path, text, StoreError, TimeoutError):
        return source.read_whole()
