"""Leica LIF: blocks of numbers that are described by an XML header, mapped and read by region.

Source: the LIF file format in the documentation of Bio-Formats (blocks, DimensionDescription,
ChannelDescription, LUTName).
"""

from __future__ import annotations

import itertools
import os
import struct
from dataclasses import dataclass
from typing import IO, Any
from xml.etree import ElementTree

import numpy as np

from ...base.image_info import COLORS, ChannelInfo, ImageInfo
from ...base.units import NO_DEPTH, spacing_of
from ..source import Index, VolumeSource
from .format import Format, choose

_MOST_HEADER = 1 << 28  # characters
_MOST_BLOCKS = 1 << 20
_LETTERS = {1: "x", 2: "y", 3: "z", 4: "t"}
_NAMES = {5: "wavelengths", 9: "excitation wavelengths", 10: "tiles"}


@dataclass(frozen=True, kw_only=True)
class LifSource(VolumeSource):
    """An image of a file; `strides` are bytes from one number to the next along each axis."""

    offset: int
    length: int
    strides: tuple[int, ...]

    def read_stored(self, index: Index) -> np.ndarray:
        block = np.memmap(self.path, "u1", "r", self.offset, (self.length,))
        whole = np.ndarray(self.shape, self.stored, block, 0, self.strides)
        return whole[index].copy()


@Format("LIF", ".lif", options=("key",))
def open_lif(path: str, key: str | None = None) -> LifSource:
    """Opens the image `key` (its number or name), the first one if left out."""
    size = os.stat(path).st_size
    with open(path, "rb") as file:
        root = ElementTree.fromstring(_header(file))
        blocks = _blocks(file, size)
    found = [e for e in root.iter("Element") if e.find("./Data/Image") is not None]
    found = [e for e in found if _block(e, blocks) is not None]
    names = [str(element.get("Name", "")) for element in found]
    at, others = choose(path, "image", names, key)
    return _image(path, found[at], blocks, [*others])


def _image(
    path: str, element: Any, blocks: dict[str, tuple[int, int]], lost: list[str]
) -> LifSource:
    channels = element.findall("./Data/Image/ImageDescription/Channels/ChannelDescription")
    axes = element.findall("./Data/Image/ImageDescription/Dimensions/DimensionDescription")
    kinds = {(int(c.get("DataType", 0)), -(-int(c.get("Resolution", 8)) // 8)) for c in channels}
    known = {(0, 1): "<u1", (0, 2): "<u2", (1, 4): "<f4"}
    stored = known.get(next(iter(kinds))) if len(kinds) == 1 else None
    if stored is None:
        raise ValueError(f"{path}: channels of several or unknown kinds of numbers")
    shape, strides, letters = [], [], ""
    told: dict[str, tuple[float | None, str | None]] = {}
    for axis in axes:
        number, count = int(axis.get("DimID", 0)), int(axis.get("NumberOfElements", 0))
        letter = _LETTERS.get(number, "-")
        if letter == "-" and count > 1:
            what = _NAMES.get(number, f"elements of the axis {number}")
            raise ValueError(f"{path}: an image of {count} {what} is not known here")
        length = float(axis.get("Length") or 0)
        step = abs(length) / (count - 1) if count > 1 and length else None
        told[letter] = (step, axis.get("Unit"))
        shape.append(count)
        strides.append(int(axis.get("BytesInc", 0)))
        letters += letter
    if len(channels) > 1:
        places = [int(channel.get("BytesInc", 0)) for channel in channels]
        steps = {b - a for a, b in itertools.pairwise(places)}
        if len(steps) != 1:
            raise ValueError(f"{path}: channels are not evenly spaced")
        shape, strides = [len(channels), *shape], [steps.pop(), *strides]
        letters = "c" + letters
    offset, held = _block(element, blocks) or (0, 0)
    reach = sum((n - 1) * s for n, s in zip(shape, strides, strict=True)) + int(stored[2])
    if min(shape, default=0) < 1 or min(strides, default=0) < 0 or not 0 < reach <= held:
        raise ValueError(f"{path}: the image takes {reach} bytes, its block has {held}")
    spacing, unit = spacing_of(
        [told.get(a, (None, None))[0] for a in "xyz"],
        [told.get(a, (None, None))[1] or "m" for a in "xyz"],
    )
    if unit == "meter":  # micrometres suit microscopes
        x, y, z = (1e6 * side for side in spacing)
        spacing, unit = (x, y, z), "micrometer"
    if unit and told.get("z", (1.0, None))[0] is None:
        lost.append(NO_DEPTH)
    step = told.get("t", (None, None))[0]
    return LifSource(
        path=path,
        shape=tuple(shape),
        axes=letters,
        stored=stored,
        spacing=spacing,
        info=ImageInfo(
            unit=unit,
            channels=tuple(_channel(channel) for channel in channels),
            time_step=step,
            time_unit="second" if step else None,
        ),
        lost=tuple(lost),
        offset=offset,
        length=reach,
        strides=tuple(strides),
    )


def _channel(element: Any) -> ChannelInfo:
    table = str(element.get("LUTName", ""))
    names = [
        item.findtext("Value", "")
        for item in element.iter("ChannelProperty")
        if item.findtext("Key") in ("DyeName", "Name")
    ]
    return ChannelInfo(name=next(filter(None, names), table), color=COLORS.get(table.lower()))


def _block(element: Any, blocks: dict[str, tuple[int, int]]) -> tuple[int, int] | None:
    memory = element.find("./Memory")
    found = None if memory is None else blocks.get(str(memory.get("MemoryBlockID")))
    return found if found and found[1] else None


def _header(file: IO[bytes]) -> str:
    magic, _, mark, count = struct.unpack("<IIBI", file.read(13))
    if magic != 0x70 or mark != 0x2A or count > _MOST_HEADER:
        raise ValueError("does not start like a LIF file")
    return file.read(2 * count).decode("utf-16-le")


def _blocks(file: IO[bytes], size: int) -> dict[str, tuple[int, int]]:
    """Returns the offset and the size in bytes of each block of numbers, by its name."""
    found: dict[str, tuple[int, int]] = {}
    while file.tell() < size and len(found) < _MOST_BLOCKS:
        head = file.read(13)
        if len(head) < 13:
            raise ValueError("ends within a block's head")
        magic, _, mark, length = struct.unpack("<IIBI", head)
        if magic != 0x70 or mark != 0x2A:
            raise ValueError(f"a block's head at {file.tell() - 13} is damaged")
        more = file.read(1)
        if more != b"\x2a":  # the length has eight bytes
            rest = more + file.read(4)
            length, mark = struct.unpack("<QB", head[9:] + rest)
            if mark != 0x2A:
                raise ValueError(f"a block's head at {file.tell()} is damaged")
        (count,) = struct.unpack("<I", file.read(4))
        name = file.read(2 * min(count, 1 << 12)).decode("utf-16-le")
        at = file.tell()
        if count > 1 << 12 or at + length > size:
            raise ValueError(f"{name!r} takes {length} bytes, the file has {size - at}")
        found[name] = (at, length)
        file.seek(at + length)
    return found
