"""TIFF, through tifffile: a stack in a file, or a folder of slices."""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..ngff import is_zarr
from ..source import ArraySource, Index, VolumeSource
from .format import Format


@dataclass(frozen=True, kw_only=True)
class TiffSource(VolumeSource):
    """A stack of packed pages. Where a page is no slice, all is read at once (`whole`)."""

    def read_stored(self, index: Index) -> np.ndarray:
        """Decodes the pages of a part."""
        if self.whole or self.covers(index):
            import tifffile

            with tifffile.TiffFile(self.path) as file:
                return file.series[0].asarray()[index]
        pages = _series(self).pages
        first = len(self.shape) - (3 if self.axes.endswith("c") else 2)
        spans = [range(*span.indices(n)) for span, n in zip(index, self.shape, strict=True)][:first]
        slices = next(
            (span for span, axis in zip(spans, self.axes, strict=False) if axis == "z"), range(1)
        )
        data = np.stack([pages[i].asarray()[index[first:]] for i in slices])
        return data.reshape([*map(len, spans), *data.shape[1:]])


@dataclass(frozen=True, kw_only=True)
class SlicesSource(VolumeSource):
    """A folder of slices."""

    files: tuple[str, ...]  # one a slice

    def read_stored(self, index: Index) -> np.ndarray:
        """Reads the files of a part."""
        import tifffile

        files = self.files[index[0]]
        data = np.empty((len(files), *[s.stop - s.start for s in index[1:]]), self.stored)
        for at, file in enumerate(files):
            image = tifffile.imread(file)
            if image.shape != self.shape[1:] or image.dtype != data.dtype:
                raise ValueError(
                    f"{file}: {image.shape} {image.dtype} differs from "
                    f"{self.shape[1:]} {data.dtype} of {Path(self.files[0]).name}"
                )
            data[at] = image[index[1:]]
        return data


@functools.lru_cache(maxsize=4)
def _series(source: TiffSource) -> Any:
    import tifffile

    return tifffile.TiffFile(source.path).series[0]


@Format("TIFF", ".tif", ".tiff", library="tifffile")
def open_tiff(path: str) -> VolumeSource:
    """Opens a stack: the first series of a file."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        series = file.series[0]
        axes = _axes(path, series.shape, series.axes)
        told: dict[str, Any] = {
            "path": path,
            "shape": tuple(int(n) for n in series.shape),
            "axes": axes,
            "spacing": _spacing(file),
        }
        if series.dataoffset is not None:
            stored = series.dtype.newbyteorder(file.byteorder).str
            return ArraySource(file=path, stored=stored, offset=int(series.dataoffset), **told)
    pages = re.fullmatch("-*z?-*yxc?", axes) is not None
    return TiffSource(stored=series.dtype.str, whole=not pages, **told)


def _is_folder(path: str) -> bool:
    return Path(path).is_dir() and not is_zarr(path)


@Format("a folder of TIFF slices", matches=_is_folder, library="tifffile")
def open_folder(path: str) -> SlicesSource:
    """Opens a folder of slices, in natural order of their names."""
    import tifffile

    files = [file for file in Path(path).iterdir() if file.suffix.lower() in (".tif", ".tiff")]
    if not files:
        raise ValueError(f"{path}: no .tif or .tiff slices in this folder")
    files.sort(key=lambda file: _natural(file.name))
    first = tifffile.imread(files[0])
    if first.ndim not in (2, 3):
        raise ValueError(f"{files[0]}: expected one slice (y, x) or (y, x, c), got {first.shape}")
    return SlicesSource(
        path=path,
        shape=(len(files), *first.shape),
        axes="zyxc"[: 1 + first.ndim],
        stored=first.dtype.str,
        files=tuple(str(file) for file in files),
    )


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts s9 before s10."""
    return [
        (int(part), part) if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)
    ]


def _axes(path: str, shape: Sequence[int], axes: str) -> str:
    """Returns what each axis of a series is: z, y, x, c, or - for one of size 1 to drop."""
    letters = "".join(
        "-" if size == 1 and letter not in "ZYX" else letter
        for size, letter in zip(shape, axes, strict=True)
    )
    others = [letter for letter in letters if letter not in "ZYXCS-"]
    if "Z" not in letters and len(others) == 1 and others[0] in "QI":
        letters, others = letters.replace(others[0], "Z"), []  # pages without a meaning: slices
    channels = [letter for letter in letters if letter in "CS"]
    if others or len(channels) > 1 or letters.count("Y") != 1 or letters.count("X") != 1:
        raise ValueError(
            f"{path}: axes {axes} {tuple(shape)}; expected Z, Y, X and at most one of C, S"
        )
    return letters.replace("S", "C").lower()


def _spacing(file: Any) -> tuple[float, float, float]:
    """Voxel size as ImageJ writes it: slices apart in the description, pixels per unit in tags."""
    described = file.imagej_metadata
    if not described or "spacing" not in described:
        return (1.0, 1.0, 1.0)
    tags = file.pages[0].tags
    sides = []
    for name in ("XResolution", "YResolution"):
        pixels, units = tags[name].value if name in tags else (1, 1)
        sides.append(units / pixels if pixels > 0 else 1.0)
    return (sides[0], sides[1], float(described["spacing"]))
