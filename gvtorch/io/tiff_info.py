"""Reads the metadata in TIFF files of microscopes: OME-XML, and ImageJ's description and tags.

Source: OME model 2016-06 (Pixels, Channel, Plane); ImageJ, class TiffEncoder (metadata of stacks).
"""

from __future__ import annotations

import logging
import math
import os
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..base.digits import finite_number
from ..base.image_info import ChannelInfo, ImageInfo, Rgb, color_channels
from ..base.units import NO_DEPTH, spacing_of, time_unit
from .budget import check_beside
from .picture_size import picture_size
from .source import Told

JPEG = (6, 7, 34892, 33007)
_LERC = 34887
_PICTURES = (*JPEG, _LERC, 22610, 33003, 33004, 33005, 34712, 34933, 34934, 50001, 50002, 52546)
_MOST_XML = 1 << 28  # characters
_MOST_PLANES = 1 << 16
_MOST_LISTED = 1 << 22  # planes that OME-XML may list


@contextmanager
def opened_tiff(path: str) -> Iterator[tuple[Any, list[str]]]:
    """Opens a file with tifffile, and raises an error for damage that tifffile only logs.

    Yields:
        The `TiffFile`, and the list of its warnings, which grows while it is read.

    Raises:
        ValueError: The file is damaged.
    """
    import tifffile

    heard = _TiffLog()
    log = logging.getLogger("tifffile")
    log.addHandler(heard)
    try:
        with tifffile.TiffFile(path) as file:
            pages = len(file.pages)  # follows the chain of pages to its end
            _check_told(path, file.pages.first.description if pages else "")
            if file.is_micromanager:  # tifffile opens other files of the data set
                for name in os.listdir(os.path.dirname(os.path.abspath(path))):
                    if name == "NDTiff.index" or "_MMStack" in name:
                        check_beside(path, name)
                    if name == "NDTiff.index":
                        index = os.path.join(os.path.dirname(path), name)
                        for other in {entry[1] for entry in tifffile.read_ndtiff_index(index)}:
                            check_beside(path, other)
            yield file, heard.warned
            if heard.damage:
                raise ValueError(f"{path}: damaged: {heard.damage[0]}")
    finally:
        log.removeHandler(heard)


def _check_told(path: str, text: str) -> None:
    """Raises ValueError if OME-XML lists too many planes, or refers to files outside the folder of
    `path`.
    """
    if not text[-10:].strip().endswith("OME>"):
        return
    if len(text) > _MOST_XML:
        raise ValueError(f"{path}: {len(text)} characters of OME-XML are too many")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return  # tifffile reports it
    counts = dict[str, int]()
    for element in root.iter():
        if (other := element.get("FileName")) is not None:
            check_beside(path, other)
        for name in ("SizeC", "SizeZ", "SizeT", "PlaneCount"):
            count = finite_number(element.get(name))
            counts[name] = max(counts.get(name, 1), int(count or 1))
    for total in (counts.pop("PlaneCount"), math.prod(counts.values())):
        if total > _MOST_LISTED:
            raise ValueError(f"{path}: declares {total} planes, at most {_MOST_LISTED} are read")


def check_pictures(pages: Iterable[Any]) -> None:
    """Makes pages check the size of the picture in each tile and strip before it is decoded, as
    tifffile would decode all of it, and drop what is too much.
    """
    for page in pages:
        frame = None if page is None else page.keyframe
        if frame is not None and frame.compression in _PICTURES and "checked" not in vars(frame):
            frame.checked, frame.decode = True, _checked(frame, frame.decode)


def _checked(frame: Any, decode: Callable[..., Any]) -> Callable[..., Any]:
    """Wraps a page's `decode` to raise ValueError for pictures larger than their tile or strip."""
    is_jpeg = frame.compression in JPEG
    wide, tall = frame.tilewidth, frame.tilelength
    if not frame.is_tiled:
        wide, tall = frame.imagewidth, frame.imagelength
        tall += -tall % 16 if is_jpeg else 0  # the last strip may hold whole blocks
        tall = min(frame.rowsperstrip, tall)

    most = 2 * wide * tall * frame.samplesperpixel * 8 + 4096  # bytes of LERC

    def checked(packed: bytes | None, number: int, /, **more: Any) -> Any:
        if packed and frame.compression == _LERC:
            packed = _lerc(packed, most)
        heads = [packed, more.get("jpegtables"), more.get("jpegheader")]
        sizes = [size for head in heads if head and (size := picture_size(head)) is not None]
        if packed and not sizes and not is_jpeg:
            raise ValueError(f"tile {number} is not a picture whose size can be read")
        for columns, rows in sizes:
            if columns > wide or rows > tall:
                raise ValueError(
                    f"tile {number} holds a picture of {rows} rows and {columns} columns, "
                    f"more than its {tall} and {wide}"
                )
        return decode(packed, number, **more)

    return checked


def _lerc(packed: bytes, most: int) -> bytes:
    """Returns LERC data, unpacked to at most `most` bytes if it is packed by zstd or zlib too."""
    if packed[:4] == b"\x28\xb5\x2f\xfd":
        import imagecodecs

        return bytes(imagecodecs.zstd_decode(packed, out=most))
    return zlib.decompressobj().decompress(packed, most) if packed[:1] == b"x" else packed


class _TiffLog(logging.Handler):
    """Collects what tifffile logs in this thread."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.thread = threading.get_ident()
        self.damage: list[str] = []
        self.warned: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self.thread:
            text = " ".join(record.getMessage().split())[:200]
            wrong = record.levelno >= logging.ERROR or "invalid page offset" in text
            (self.damage if wrong else self.warned).append(text)


def ome_info(xml: str, number: int, name: str, width: int) -> Told:
    """Reads the OME-XML of an image, found by its name, or by its number if that is not unique."""
    root = ElementTree.fromstring(xml)
    images = [child for child in root.iter() if _tag(child) == "Image"]
    named = [image for image in images if image.get("Name") == name]
    image = named[0] if len(named) == 1 else images[number] if number < len(images) else None
    pixels = next((one for one in (() if image is None else image) if _tag(one) == "Pixels"), None)
    if pixels is None:
        return ImageInfo(), (1.0, 1.0, 1.0), ["OME-XML, which tells nothing of this image"]
    sizes = [finite_number(pixels.get(f"PhysicalSize{axis}")) for axis in "XYZ"]
    units = [pixels.get(f"PhysicalSize{axis}Unit", "\u00b5m") for axis in "XYZ"]
    spacing, unit = spacing_of(sizes, units)
    lost = []
    if unit and sizes[2] is None and int(finite_number(pixels.get("SizeZ")) or 1) > 1:
        lost.append(NO_DEPTH)
    step, of_time = finite_number(pixels.get("TimeIncrement")), pixels.get("TimeIncrementUnit", "s")
    if step is None and int(finite_number(pixels.get("SizeT")) or 1) > 1:
        step, of_time = _step_of_planes(pixels)
    channels = [_ome_channel(child) for child in pixels if _tag(child) == "Channel"]
    samples = [int(c.get("SamplesPerPixel", 1)) for c in pixels if _tag(c) == "Channel"]
    if samples == [3] and width == 3:
        channels = [*color_channels()]
    if any(_tag(child) == "ROI" for child in root):
        lost.append("regions of interest (ROI)")
    info = ImageInfo(
        unit=unit,
        channels=tuple(channels) if len(channels) == width else (),
        time_step=step if step else None,
        time_unit=time_unit(of_time) if step else None,
    )
    return info, spacing, lost


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
    for plane in [child for child in pixels if _tag(child) == "Plane"][:_MOST_PLANES]:
        at = finite_number(plane.get("DeltaT"))
        if at is not None and plane.get("TheZ", "0") == plane.get("TheC", "0") == "0":
            times[int(plane.get("TheT", 0))] = at
            unit = plane.get("DeltaTUnit", "s")
    if len(times) < 2:
        return None, unit
    first, last = min(times), max(times)
    step = (times[last] - times[first]) / (last - first)
    return (step if step > 0 else None), unit


def imagej_info(described: dict[str, Any], resolution: list[float | None], width: int) -> Told:
    """Reads ImageJ's metadata; `resolution` is the width and height of a pixel."""
    unit = str(described.get("unit", "")).replace("\\u00B5", "\u00b5").replace("\\u00b5", "\u00b5")
    distance = finite_number(described.get("spacing"))
    known = bool(unit) or distance is not None
    sizes = [*(resolution if known else (None, None)), None if distance is None else abs(distance)]
    spacing, named = spacing_of(sizes, [unit] * 3)
    lost = []
    if unit and named is None and unit.lower() not in ("pixel", "pixels", "inch"):
        lost.append(f"the unit {unit!r}, which is unknown")
    step = finite_number(described.get("finterval")) or None
    ranges = [float(v) for v in described.get("Ranges", ())]
    if not ranges and {"min", "max"} <= set(described):
        ranges = [float(described["min"]), float(described["max"])] * width
    tables = described.get("LUTs", [])
    channels = []
    for at in range(width):
        low, high = ranges[2 * at : 2 * at + 2] if len(ranges) >= 2 * at + 2 else (0.0, 0.0)
        color = _color(tables[at]) if width > 1 and at < len(tables) else None
        channels.append(ChannelInfo(color=color, window=(low, high) if low < high else None))
    if any(name in described for name in ("Overlays", "ROI")):
        lost.append("overlays and regions of interest")
    told = [c for c in channels if c.color or c.window]
    info = ImageInfo(
        unit=named,
        channels=tuple(channels) if told else (),
        time_step=step,
        time_unit=time_unit(described.get("tunit", "sec")) if step else None,
    )
    return info, spacing, lost


def _color(table: Any) -> Rgb | None:
    """Returns the last colour of a look-up table; None if that is black."""
    last = np.asarray(table).reshape(3, -1)[:, -1] / 255
    return (float(last[0]), float(last[1]), float(last[2])) if last.any() else None


def _tag(element: Any) -> str:
    return str(element.tag).rpartition("}")[2]
