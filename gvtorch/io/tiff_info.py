"""Reads the metadata in TIFF files of microscopes: OME-XML, and ImageJ's description and tags.

Source: OME model 2016-06 (Pixels, Channel, Plane); ImageJ, class TiffEncoder (metadata of stacks).
"""

from __future__ import annotations

import logging
import math
import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..base.digits import finite_number
from ..base.image_info import ChannelInfo, ImageInfo, Rgb, color_channels
from ..base.messages import collected_log
from ..base.units import NO_DEPTH, spacing_of, time_unit
from .budget import check_beside
from .picture_size import picture_size
from .source import FileMetadata, microscope_info

JPEG = (6, 7, 34892, 33007)
_LERC = 34887
_PICTURE_COMPRESSIONS = (
    *JPEG, _LERC, 22610, 33003, 33004, 33005, 34712, 34933, 34934, 50001, 50002, 52546,
)  # fmt: skip
#: The note for pictures of inks, which are not light.
INKS = "that its channels are inks (CMYK)"
_PHOTOMETRIC_DROPPED = {  # by the tag PhotometricInterpretation
    0: "that high values are meant to be dark (MinIsWhite)",
    3: "the colours of its palette: values are numbers of its entries",
    5: INKS,
}
_MAX_XML_CHARS = 1 << 28
_MAX_PLANES = 1 << 16
_MAX_LISTED_PLANES = 1 << 22  # that OME-XML may list


@contextmanager
def opened_tiff(path: str) -> Iterator[tuple[Any, list[logging.LogRecord]]]:
    """Opens a file with tifffile, and raises an error for damage that tifffile only logs.

    Yields:
        The `TiffFile`, and what tifffile logs, a list that grows while it is read.

    Raises:
        ValueError: The file is damaged.
    """
    import tifffile

    with collected_log("tifffile") as log, tifffile.TiffFile(path) as file:
        pages = len(file.pages)  # follows the chain of pages to its end
        _check_ome_xml(path, file.pages.first.description if pages else "")
        if file.is_micromanager:  # tifffile opens other files of the data set
            for name in os.listdir(os.path.dirname(os.path.abspath(path))):
                if name == "NDTiff.index" or "_MMStack" in name:
                    check_beside(path, name)
                if name == "NDTiff.index":
                    index = os.path.join(os.path.dirname(path), name)
                    for file_name in {entry[1] for entry in tifffile.read_ndtiff_index(index)}:
                        check_beside(path, file_name)
        yield file, log
        if damage := tiff_messages(log, damage=True):
            raise ValueError(f"{path}: damaged: {damage[0]}")


def tiff_messages(log: list[logging.LogRecord], *, damage: bool = False) -> list[str]:
    """Returns the warnings of tifffile's log, or those of its messages that mean damage."""
    messages = []
    for record in log:
        text = " ".join(record.getMessage().split())[:200]
        is_damage = record.levelno >= logging.ERROR or "invalid page offset" in text
        if record.levelno >= logging.WARNING and is_damage == damage:
            messages.append(text)
    return messages


def shown_as(series: Any, width: int) -> tuple[bool, list[str]]:
    """Returns whether `width` numbers of a pixel are a colour, and what is not kept of how they are
    to be shown.
    """
    photometric = int(series.keyframe.photometric)
    dropped = [_PHOTOMETRIC_DROPPED[photometric]] if photometric in _PHOTOMETRIC_DROPPED else []
    if series.keyframe.tags.valueof("Orientation", 1) != 1:
        dropped.append("that its pages are to be shown turned or mirrored")
    return width in (3, 4) and photometric in (2, 6), dropped  # RGB, YCbCr


def _check_ome_xml(path: str, description: str) -> None:
    """Raises ValueError if OME-XML lists too many planes, or refers to files in other folders."""
    if not description[-10:].strip().endswith("OME>"):
        return
    if len(description) > _MAX_XML_CHARS:
        raise ValueError(f"{path}: {len(description)} characters of OME-XML are too many")
    try:
        root = ElementTree.fromstring(description)
    except ElementTree.ParseError:
        return  # tifffile reports it
    counts = dict[str, int]()
    for element in root.iter():
        if (file_name := element.get("FileName")) is not None:
            check_beside(path, file_name)
        for name in ("SizeC", "SizeZ", "SizeT", "PlaneCount"):
            count = finite_number(element.get(name))
            counts[name] = max(counts.get(name, 1), int(count or 1))
    for total in (counts.pop("PlaneCount"), math.prod(counts.values())):
        if total > (limit := _MAX_LISTED_PLANES):
            raise ValueError(f"{path}: declares {total} planes, at most {limit} are read")


def check_pictures(pages: Iterable[Any]) -> None:
    """Makes pages check the size of the picture in each tile and strip before it is decoded, as
    tifffile would decode all of it, and drop what is too much.
    """
    for page in pages:
        keyframe = None if page is None else page.keyframe
        if (
            keyframe is not None
            and keyframe.compression in _PICTURE_COMPRESSIONS
            and "checked" not in vars(keyframe)
        ):
            keyframe.checked, keyframe.decode = True, _checked_decode(keyframe, keyframe.decode)


def _checked_decode(keyframe: Any, decode: Callable[..., Any]) -> Callable[..., Any]:
    """Wraps a page's `decode` to raise ValueError for pictures larger than their tile or strip."""
    is_jpeg = keyframe.compression in JPEG
    tile_width, tile_height = keyframe.tilewidth, keyframe.tilelength
    if not keyframe.is_tiled:
        tile_width, tile_height = keyframe.imagewidth, keyframe.imagelength
        tile_height += -tile_height % 16 if is_jpeg else 0  # the last strip may hold whole blocks
        tile_height = min(keyframe.rowsperstrip, tile_height)

    max_lerc_bytes = 2 * tile_width * tile_height * keyframe.samplesperpixel * 8 + 4096

    def checked(packed: bytes | None, number: int, /, **tables: Any) -> Any:
        if packed and keyframe.compression == _LERC:
            packed = _unpack_lerc(packed, max_lerc_bytes)
        headers = [packed, tables.get("jpegtables"), tables.get("jpegheader")]
        sizes = [size for header in headers if header and (size := picture_size(header))]
        if packed and not sizes and not is_jpeg:
            raise ValueError(f"tile {number} is not a picture whose size can be read")
        for columns, rows in sizes:
            if columns > tile_width or rows > tile_height:
                raise ValueError(
                    f"tile {number} holds a picture of {rows} rows and {columns} columns, "
                    f"more than its {tile_height} and {tile_width}"
                )
        return decode(packed, number, **tables)

    return checked


def _unpack_lerc(packed: bytes, max_bytes: int) -> bytes:
    """Returns LERC data; if it is packed by zstd or zlib too, unpacked to at most `max_bytes`."""
    if packed[:4] == b"\x28\xb5\x2f\xfd":
        import imagecodecs

        return bytes(imagecodecs.zstd_decode(packed, out=max_bytes))
    return zlib.decompressobj().decompress(packed, max_bytes) if packed[:1] == b"x" else packed


def ome_info(xml: str, number: int, name: str, width: int) -> FileMetadata:
    """Reads the OME-XML of an image, found by its name, or by its number if that is not unique."""
    root = ElementTree.fromstring(xml)
    images = root.findall(".//{*}Image")
    same_name = [image for image in images if image.get("Name") == name]
    chosen = same_name if len(same_name) == 1 else images[number : number + 1]
    pixels = chosen[0].find("{*}Pixels") if chosen else None
    if pixels is None:
        return ImageInfo(), (1.0, 1.0, 1.0), ["OME-XML, which tells nothing of this image"]
    sizes = [finite_number(pixels.get(f"PhysicalSize{axis}")) for axis in "XYZ"]
    units = [pixels.get(f"PhysicalSize{axis}Unit", "\u00b5m") for axis in "XYZ"]
    spacing, unit = spacing_of(sizes, units)
    dropped = []
    if unit and sizes[2] is None and int(finite_number(pixels.get("SizeZ")) or 1) > 1:
        dropped.append(NO_DEPTH)
    step = finite_number(pixels.get("TimeIncrement"))
    step_unit = pixels.get("TimeIncrementUnit", "s")
    if step is None and int(finite_number(pixels.get("SizeT")) or 1) > 1:
        step, step_unit = _step_of_planes(pixels)
    elements = pixels.findall("{*}Channel")
    channels = [_ome_channel(element) for element in elements]
    if [int(e.get("SamplesPerPixel", 1)) for e in elements] == [3] and width == 3:
        channels = [*color_channels()]
    if root.find("{*}ROI") is not None:
        dropped.append("regions of interest (ROI)")
    return microscope_info(unit, channels, width, step, time_unit(step_unit)), spacing, dropped


def _ome_channel(element: Any) -> ChannelInfo:
    code, color = finite_number(element.get("Color")), None
    if code is not None:
        red, green, blue, _ = (int(code) % 2**32).to_bytes(4)
        color = (red / 255, green / 255, blue / 255)
    return ChannelInfo(name=element.get("Name", ""), color=color)


def _step_of_planes(pixels: Any) -> tuple[float | None, str]:
    """Returns the mean time step between the first channel's first slices, and its unit."""
    times: dict[int, float] = {}
    unit = "s"
    for plane in pixels.findall("{*}Plane")[:_MAX_PLANES]:
        plane_time = finite_number(plane.get("DeltaT"))
        if plane_time is not None and plane.get("TheZ", "0") == plane.get("TheC", "0") == "0":
            times[int(plane.get("TheT", 0))] = plane_time
            unit = plane.get("DeltaTUnit", "s")
    if len(times) < 2:
        return None, unit
    first, last = min(times), max(times)
    step = (times[last] - times[first]) / (last - first)
    return (step if step > 0 else None), unit


def imagej_info(
    metadata: dict[str, Any], resolution: list[float | None], width: int
) -> FileMetadata:
    """Reads ImageJ's metadata; `resolution` is the width and height of a pixel."""
    unit = str(metadata.get("unit", "")).replace("\\u00B5", "\u00b5").replace("\\u00b5", "\u00b5")
    distance = finite_number(metadata.get("spacing"))
    sides = resolution if unit or distance is not None else (None, None)  # is it calibrated?
    depth = None if distance is None else abs(distance)
    spacing, unit_name = spacing_of([*sides, depth], [unit] * 3)
    dropped = []
    if unit and unit_name is None and unit.lower() not in ("pixel", "pixels", "inch"):
        dropped.append(f"the unit {unit!r}, which is unknown")
    step = finite_number(metadata.get("finterval"))
    ranges = [float(v) for v in metadata.get("Ranges", ())]
    if not ranges and {"min", "max"} <= set(metadata):
        ranges = [float(metadata["min"]), float(metadata["max"])] * width
    tables = metadata.get("LUTs", [])
    channels = []
    for channel in range(width):
        low, high = (*ranges[2 * channel : 2 * channel + 2], 0.0, 0.0)[:2]
        color = _color(tables[channel]) if width > 1 and channel < len(tables) else None
        channels.append(ChannelInfo(color=color, window=(low, high) if low < high else None))
    if any(name in metadata for name in ("Overlays", "ROI")):
        dropped.append("overlays and regions of interest")
    if any(finite_number(metadata.get(f"{axis}origin")) for axis in "xyz"):
        dropped.append("the position of its origin")
    displayed = channels if any(c.color or c.window for c in channels) else []
    step_unit = time_unit(str(metadata.get("tunit", "sec")))
    return microscope_info(unit_name, displayed, width, step, step_unit), spacing, dropped


def _color(table: Any) -> Rgb | None:
    """Returns the last colour of a look-up table; None if that is black."""
    last = np.asarray(table).reshape(3, -1)[:, -1] / 255
    return (float(last[0]), float(last[1]), float(last[2])) if last.any() else None
