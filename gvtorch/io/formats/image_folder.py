"""A folder of images: TIFF (with tifffile), PNG, JPEG or BMP (with imagecodecs) slices in the
natural order of their names.

The size in an image's header is compared with that of the first image before it is decoded.
Source: Microsoft, BITMAPINFOHEADER.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ...base.boxes import check_extent
from ...base.image_info import ImageInfo, color_channels
from ..picture_size import has_jpeg_end, picture_size
from ..resources import check_memory
from ..source import Index, VolumeSource, convert_errors
from ..stores.ngff import is_zarr
from ..tiff_info import INKS, check_pictures, opened_tiff, shown_as
from .format import Format

_TIFF_ENDINGS = (".tif", ".tiff")
_CODECS = {".png": "png", ".jpg": "jpeg8", ".jpeg": "jpeg8", ".bmp": "bmp"}
_KINDS = _CODECS | dict.fromkeys(_TIFF_ENDINGS, "tiff")
_HEADER_BYTES = 1 << 20  # at the start of an image that hold its header
_MAX_PIXELS = 2**31


@dataclass(frozen=True, kw_only=True)
class SlicesSource(VolumeSource):
    """A folder of slices."""

    files: tuple[str, ...]  # one per slice

    def read_stored(self, index: Index) -> np.ndarray:
        files = self.files[index[0]]
        data = np.empty((len(files), *[s.stop - s.start for s in index[1:]]), self.stored)
        for z, file in enumerate(files):
            shape = _header_shape(file)
            if shape[:2] != self.shape[1:3]:
                raise self._mismatch(file, shape)
            image = _decode_image(file)
            if image.shape != self.shape[1:] or image.dtype != data.dtype:
                raise self._mismatch(file, f"{image.shape} {image.dtype}")
            data[z] = image[index[1:]]
        return data

    def _mismatch(self, file: str, actual: object) -> ValueError:
        expected = f"{self.shape[1:]} {np.dtype(self.stored)} of {Path(self.files[0]).name}"
        return ValueError(f"{file}: {actual} differs from {expected}")


def _slices(path: str) -> list[Path]:
    """Returns the images in a folder; raises ValueError if they are of several kinds."""
    files: dict[str, list[Path]] = {}
    for file in Path(path).iterdir():
        kind = _KINDS.get(file.suffix.lower())
        if kind and not file.name.startswith(".") and file.is_file():
            files.setdefault(kind, []).append(file)
    if len(files) > 1:
        kinds = " and ".join(f"{len(group)} {kind}" for kind, group in sorted(files.items()))
        raise ValueError(f"{path}: images of several kinds: {kinds}; expected those of one stack")
    return next(iter(files.values()), [])


@Format(
    "a folder of images",
    matches=lambda path: Path(path).is_dir() and not is_zarr(path),
    library="imagecodecs",
)
def open_folder(path: str) -> SlicesSource:
    """Opens a folder of slices, in natural order of their names."""
    files = _slices(path)
    if not files:
        raise ValueError(
            f"{path}: no .tif, .tiff, .png, .jpg, .jpeg or .bmp slices in this folder, and no "
            "DICOM files"
        )
    files.sort(key=lambda file: _natural_key(file.name))
    shape = _header_shape(str(files[0]))
    check_extent(str(files[0]), shape, max_values=_MAX_PIXELS)
    check_memory(str(files[0]), 8 * math.prod(shape))
    first = _decode_image(str(files[0]))
    if first.ndim not in (2, 3):
        raise ValueError(f"{files[0]}: expected one slice (y, x) or (y, x, c), got {first.shape}")
    width, dropped = (*first.shape, 1)[2], list[str]()
    kind = _KINDS[files[0].suffix.lower()]
    is_color = width == 3 or (width == 4 and kind == "png")
    if kind == "tiff":
        with _opened_slice(str(files[0])) as (series, _):
            is_color, dropped = shown_as(series, width)
    elif kind == "jpeg8" and width == 4:
        dropped.append(INKS)
    dropped += _gaps([file.name for file in files])
    return SlicesSource(
        path=path,
        shape=(len(files), *first.shape),
        axes="zyxc"[: 1 + first.ndim],
        stored=first.dtype.str,
        files=tuple(str(file) for file in files),
        info=ImageInfo(channels=color_channels(width) if is_color else ()),
        dropped=tuple(dropped),
    )


@contextmanager
def _opened_slice(file: str) -> Iterator[tuple[Any, list[int]]]:
    """Opens a TIFF image: yields its series, and which axes of it are y, x and, if any, colours.
    Raises ValueError if it has others.
    """
    with opened_tiff(file) as (tiff, _):
        series = tiff.series[0]
        axes = series.axes.replace("C", "S")
        if sorted(axes) not in (["X", "Y"], ["S", "X", "Y"]):
            raise ValueError(f"{file}: expected one slice, got {series.axes} {series.shape}")
        yield series, [axes.index(letter) for letter in "YXS" if letter in axes]


def _decode_image(file: str) -> np.ndarray:
    codec = _CODECS.get(Path(file).suffix.lower())
    if codec is None:
        with _opened_slice(file) as (series, axes):
            check_pictures(series.pages)
            pixels: np.ndarray = series.asarray().transpose(axes)
            return pixels
    import imagecodecs

    packed = Path(file).read_bytes()
    if codec == "jpeg8" and not has_jpeg_end(packed):
        raise ValueError(f"{file}: is truncated: the picture has no end")
    with convert_errors(ValueError, file, f"can't be read as {codec.rstrip('8').upper()}"):
        pixels = np.asarray(getattr(imagecodecs, f"{codec}_decode")(packed))
    return pixels[..., 0] if pixels.ndim == 3 and pixels.shape[2] == 1 else pixels


def _header_shape(file: str) -> tuple[Any, ...]:
    """Returns the shape from the header of an image: rows and columns first."""
    if Path(file).suffix.lower() in _TIFF_ENDINGS:
        with _opened_slice(file) as (series, axes):
            return tuple(series.shape[axis] for axis in axes)
    with open(file, "rb") as stream:
        header = stream.read(_HEADER_BYTES)
    if header[:2] == b"BM" and len(header) >= 26:
        columns, rows = map(abs, struct.unpack_from("<ii", header, 18))
    elif (size := picture_size(header)) is not None:
        columns, rows = size
    else:
        raise ValueError(f"{file}: is not a PNG, JPEG or BMP image")
    return (rows, columns)


def _natural_key(name: str) -> list[tuple[int, str]]:
    """Returns a sorting key, by which s9 comes before s10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part) if part.isdecimal() else -1, part) for part in parts]


def _gaps(names: list[str]) -> list[str]:
    """Returns a phrase on slices that seem to be missing: names differ in a single number, in steps
    that are not all equal.
    """
    keys = [_natural_key(name) for name in names]
    if len({tuple(text if number < 0 else "" for number, text in key) for key in keys}) > 1:
        return []
    numbers = [[number for number, _ in key] for key in keys]
    varying = [column for column in zip(*numbers, strict=True) if len(set(column)) > 1]
    steps = [b - a for a, b in pairwise(varying[0])] if len(varying) == 1 else []
    if len(set(steps)) < 2:
        return []
    index = steps.index(max(steps))
    return [f"gaps between the numbers of its slices: {names[index + 1]} follows {names[index]}"]
