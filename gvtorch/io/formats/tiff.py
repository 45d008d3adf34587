"""TIFF, read with tifffile: plain, BigTIFF, OME-TIFF and ImageJ's, with times and channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...base import boxes
from ...base.image_info import ImageInfo, color_channels
from ..source import ArraySource, FileMetadata, Index, VolumeSource, read_planes
from ..tiff_info import (
    JPEG,
    check_pictures,
    imagej_info,
    ome_info,
    opened_tiff,
    shown_as,
    tiff_messages,
)
from .format import Format, choose

#: What tifffile calls programs and standards with tags of their own, which are not read here.
_OTHER_METADATA = {
    *("andor", "epics", "fei", "fluoview", "geotiff", "lsm", "mdgel", "metaseries", "nih"),
    *("scanimage", "sem", "sis", "stk", "tvips"),
}


@dataclass(frozen=True, kw_only=True)
class TiffSource(VolumeSource):
    """A series of packed pages; reading a part unpacks only the tiles and strips that it needs."""

    series: int = 0
    files: tuple[str, ...] = ()  # that hold its pages, if they are several

    def read_stored(self, index: Index) -> np.ndarray:
        with opened_tiff(self.path) as (file, _):
            series = file.series[self.series]
            if self.whole:
                check_pictures(series.pages)
                return series.asarray()[index]
            leading = len(self.shape) - len(series.keyframe.shape)

            def read(position: tuple[int, ...]) -> np.ndarray:
                number = int(np.ravel_multi_index(position, self.shape[:leading])) if leading else 0
                if (page := series.pages[number]) is None:
                    raise ValueError(f"{self.path}: page {number} is missing")
                return read_page(page, series.keyframe, index[leading:])

            return read_planes(index, leading, self.stored, read)


def read_page(page: Any, keyframe: Any, index: Index) -> np.ndarray:
    """Unpacks a part (rows, columns) or (rows, columns, c) of a page.

    Raises:
        ValueError: The file ends too early.
    """
    check_pictures([page, keyframe])
    planes, depth, length, width, samples = keyframe.shaped
    if planes != 1 or depth != 1 or len(page.dataoffsets) != math.prod(keyframe.chunked):
        return page.asarray()[index]
    height, across = min(keyframe.rowsperstrip, length), width
    if keyframe.is_tiled:
        height, across = keyframe.tilelength, keyframe.tilewidth
    low, high = boxes.box_of(index[:2])
    out = np.zeros((*np.subtract(high, low), samples), keyframe.dtype)
    file = page.parent.filehandle
    with ExitStack() as stack:
        if file.closed:  # tifffile closes those beside the one it opened: planes of an OME-TIFF
            file.open()
            stack.callback(file.close)
        for row, column in boxes.tile_indices(low, high, (height, across)):
            tile = _unpack_tile(page, keyframe, row * -(-width // across) + column)
            if tile is not None:
                boxes.paste(out, low, tile, (row * height, column * across))
    return out[..., index[2]] if len(index) == 3 else out[..., 0]


def _unpack_tile(page: Any, keyframe: Any, tile_number: int) -> np.ndarray | None:
    """Returns (rows, columns, c) of a tile or strip; None if it is not stored: all are zero."""
    offset, size = page.dataoffsets[tile_number], page.databytecounts[tile_number]
    if not size:
        return None
    file = page.parent.filehandle
    file.seek(offset)
    packed = file.read(size)
    if len(packed) != size:
        raise ValueError(f"{file.path}: ends before its tile {tile_number}")
    tables = {}
    if keyframe.compression in JPEG:
        tables = {"jpegtables": page.jpegtables, "jpegheader": keyframe.jpegheader}
    decoded = keyframe.decode(packed, tile_number, **tables)[0]
    return None if decoded is None else decoded[0]


@Format(
    "TIFF", ".tif", ".tiff", ".btf", ".tf8", options=("key",), library="tifffile"
)  # pyramids: a series is its finest level
def open_tiff(path: str, key: str | None = None) -> VolumeSource:
    """Opens a stack: the series `key` (its number or name) of a file, the first if left out."""
    with opened_tiff(path) as (file, log):
        if not file.series:
            raise ValueError("it holds no images")
        chosen, others = choose(path, "series", [item.name for item in file.series], key)
        series = file.series[chosen]
        shape = tuple(int(n) for n in series.shape)
        axes = _axes(path, shape, series.axes)
        info, spacing, dropped = _read_metadata(file, series, chosen, axes, shape)
        messages = dict.fromkeys(tiff_messages(log))
        dropped += [*others, *(f"what tifffile warns of ({text})" for text in messages)]
        fields: dict[str, Any] = {"path": path, "shape": shape, "axes": axes, "info": info}
        fields["spacing"] = spacing
        if series.dataoffset is not None:
            fields |= {"dropped": tuple(dropped), "offset": int(series.dataoffset)}
            stored = series.dtype.newbyteorder(file.byteorder).str
            return ArraySource(file=path, stored=stored, **fields)
        keyframe = series.keyframe
        leading = len(shape) - len(keyframe.shape)
        is_whole_pages = shape[leading:] == tuple(keyframe.shape)
        by_page = is_whole_pages and len(series.pages) == math.prod(shape[:leading])
        by_page &= axes[leading:] in ("yx", "yxc")
        piece_values = int(np.prod(keyframe.chunks)) if by_page else math.prod(shape)
        if series.is_multifile:
            handles = (page.parent.filehandle for page in series.pages if page is not None)
            fields["files"] = tuple(sorted({handle.path for handle in handles}))
        missing_pages = sum(page is None for page in series.pages)
        if missing_pages:
            dropped.append(f"{missing_pages} of {len(series.pages)} pages, which are not there")
    fields |= {"dropped": tuple(dropped), "unpacked_bytes": piece_values * series.dtype.itemsize}
    return TiffSource(stored=series.dtype.str, whole=not by_page, series=chosen, **fields)


def _axes(path: str, shape: Sequence[int], axes: str) -> str:
    """Returns what each axis of a series is: t, z, y, x, c, or - for one of size 1 to drop."""
    axis_order = "".join(
        "-" if size == 1 and letter not in "ZYX" else letter
        for size, letter in zip(shape, axes, strict=True)
    )
    other_axes = [letter for letter in axis_order if letter not in "TZYXCS-"]
    if "Z" not in axis_order and len(other_axes) == 1 and other_axes[0] in "QI":
        # Pages of unknown meaning are slices.
        axis_order, other_axes = axis_order.replace(other_axes[0], "Z"), []
    channels = [letter for letter in axis_order if letter in "CS"]
    if other_axes or len(channels) > 1 or axis_order.count("Y") != 1 or axis_order.count("X") != 1:
        expected = "T, Z, Y, X and at most one of C, S"
        raise ValueError(f"{path}: axes {axes} {tuple(shape)}; expected {expected}")
    return axis_order.replace("S", "C").lower()


def _read_metadata(
    file: Any, series: Any, number: int, axes: str, shape: Sequence[int]
) -> FileMetadata:
    """Returns info and spacing of a series, and which metadata is not kept."""
    width = shape[axes.index("c")] if "c" in axes else 1
    if series.kind == "ome":
        return ome_info(file.ome_metadata, number, series.name, width)
    is_color, dropped = shown_as(series, width)
    channels = color_channels(width) if is_color else ()
    if series.kind == "imagej":
        info, spacing, also_dropped = imagej_info(file.imagej_metadata, _resolution(file), width)
        info = replace(info, channels=channels) if is_color else info
        return info, spacing, [*also_dropped, *dropped]
    if others := sorted(_OTHER_METADATA & file.pages[0].flags):
        dropped.append(f"metadata of {', '.join(others)}, such as sizes of voxels")
    tags = series.keyframe.tags
    if "XResolution" in tags and tags.valueof("ResolutionUnit", 2) == 3:  # inches are for printers
        dropped.append("the size of a pixel in centimeters: the distance between pages is missing")
    return ImageInfo(channels=channels), (1.0, 1.0, 1.0), dropped


def _resolution(file: Any) -> list[float | None]:
    """Returns width and height of a pixel, which ImageJ stores as pixels per unit, in tags."""
    tags, sides = file.pages[0].tags, []
    for name in ("XResolution", "YResolution"):
        pixels, units = tags[name].value if name in tags else (1, 1)
        sides.append(units / pixels if pixels > 0 and units > 0 else None)
    return sides
