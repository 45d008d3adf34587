"""Leica LIF: blocks of numbers that are described by an XML header, mapped and read by region.

Source: the LIF file format in the documentation of Bio-Formats (blocks, DimensionDescription,
ChannelDescription, LUTName).
"""

from __future__ import annotations

import itertools
import os
import struct
from dataclasses import dataclass
from typing import IO, Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from ...base.image_info import COLORS, ChannelInfo
from ...base.units import NO_DEPTH, spacing_of
from ..source import Index, VolumeSource, microscope_info
from .format import Format, choose

_MAX_HEADER_CHARS = 1 << 28
_MAX_BLOCKS = 1 << 20
_DTYPES = {(0, 1): "<u1", (0, 2): "<u2", (1, 4): "<f4"}  # by DataType and bytes
_AXIS_LETTERS = {1: "x", 2: "y", 3: "z", 4: "t"}
_OTHER_AXES = {5: "wavelengths", 9: "excitation wavelengths", 10: "tiles"}


@dataclass(frozen=True, kw_only=True)
class LifSource(VolumeSource):
    """An image of a file; `strides` are bytes from one number to the next along each axis."""

    offset: int
    length: int
    strides: tuple[int, ...]

    def read_stored(self, index: Index) -> np.ndarray:
        block = np.memmap(self.path, "u1", "r", self.offset, (self.length,))
        image = np.ndarray(self.shape, self.stored, block, 0, self.strides)
        return image[index].copy()


@Format("LIF", ".lif", options=("key",))
def open_lif(path: str, key: str | None = None) -> LifSource:
    """Opens the image `key` (its number or name), the first one if left out."""
    size = os.stat(path).st_size
    with open(path, "rb") as file:
        root = ElementTree.fromstring(_read_xml(file))
        blocks = _read_blocks(file, size)
    images = [e for e in root.iter("Element") if e.find("./Data/Image") is not None]
    images = [e for e in images if _find_block(e, blocks) is not None]
    names = [str(element.get("Name", "")) for element in images]
    chosen, others = choose(path, "image", names, key)
    return _image_source(path, images[chosen], blocks, [*others])


def _image_source(
    path: str, element: Any, blocks: dict[str, tuple[int, int]], dropped: list[str]
) -> LifSource:
    description = "./Data/Image/ImageDescription"
    channels = element.findall(f"{description}/Channels/ChannelDescription")
    dimensions = element.findall(f"{description}/Dimensions/DimensionDescription")
    kinds = {(int(c.get("DataType", 0)), -(-int(c.get("Resolution", 8)) // 8)) for c in channels}
    if len(kinds) != 1 or (kind := kinds.pop()) not in _DTYPES:
        raise ValueError(f"{path}: channels of several or unknown kinds of numbers")
    stored = _DTYPES[kind]
    axes = [_axis(path, dimension) for dimension in dimensions]
    if len(channels) > 1:
        offsets = [int(channel.get("BytesInc", 0)) for channel in channels]
        strides = {b - a for a, b in itertools.pairwise(offsets)}
        if len(strides) != 1:
            raise ValueError(f"{path}: channels are not evenly spaced")
        axes.insert(0, _Axis("c", len(channels), strides.pop()))
    offset, block_bytes = _find_block(element, blocks) or (0, 0)
    image_bytes = sum((axis.size - 1) * axis.stride for axis in axes) + np.dtype(stored).itemsize
    is_valid = axes and all(axis.size >= 1 and axis.stride >= 0 for axis in axes)
    if not is_valid or not 0 < image_bytes <= block_bytes:
        raise ValueError(f"{path}: an image of {image_bytes} bytes in a block of {block_bytes}")
    steps = {axis.letter: axis.step for axis in axes}
    units = {axis.letter: axis.unit or "m" for axis in axes}
    spacing, unit = spacing_of([steps.get(a) for a in "xyz"], [units.get(a, "m") for a in "xyz"])
    if unit == "meter":  # micrometres suit microscopes
        x, y, z = (1e6 * side for side in spacing)
        spacing, unit = (x, y, z), "micrometer"
    if unit and "z" in steps and steps["z"] is None:
        dropped.append(NO_DEPTH)
    infos = [_channel(channel) for channel in channels]
    return LifSource(
        path=path,
        shape=tuple(axis.size for axis in axes),
        axes="".join(axis.letter for axis in axes),
        flips="".join(axis.letter for axis in axes if axis.letter == "z" and axis.backwards),
        stored=stored,
        spacing=spacing,
        info=microscope_info(unit, infos, len(infos), steps.get("t"), "second"),
        dropped=tuple(dropped),
        offset=offset,
        length=image_bytes,
        strides=tuple(axis.stride for axis in axes),
    )


class _Axis(NamedTuple):
    letter: str
    size: int
    stride: int  # bytes
    step: float | None = None  # between two values, in `unit`
    unit: str | None = None
    backwards: bool = False


def _axis(path: str, element: Any) -> _Axis:
    number, size = int(element.get("DimID", 0)), int(element.get("NumberOfElements", 0))
    letter = _AXIS_LETTERS.get(number, "-")
    if letter == "-" and size > 1:
        name = _OTHER_AXES.get(number, f"elements of the axis {number}")
        raise ValueError(f"{path}: an image of {size} {name} is not known here")
    length = float(element.get("Length") or 0)
    step = abs(length) / (size - 1) if size > 1 and length else None
    stride, unit = int(element.get("BytesInc", 0)), element.get("Unit")
    return _Axis(letter, size, stride, step, unit, length < 0)


def _channel(element: Any) -> ChannelInfo:
    table = str(element.get("LUTName", ""))
    properties = element.iter("ChannelProperty")
    named = (item for item in properties if item.findtext("Key") in ("DyeName", "Name"))
    names = (item.findtext("Value", "") for item in named)
    return ChannelInfo(name=next(filter(None, names), table), color=COLORS.get(table.lower()))


def _find_block(element: Any, blocks: dict[str, tuple[int, int]]) -> tuple[int, int] | None:
    memory = element.find("./Memory")
    block = None if memory is None else blocks.get(str(memory.get("MemoryBlockID")))
    return block if block and block[1] else None


def _read_xml(file: IO[bytes]) -> str:
    magic, _, marker, count = struct.unpack("<IIBI", file.read(13))
    if magic != 0x70 or marker != 0x2A or count > _MAX_HEADER_CHARS:
        raise ValueError("does not start like a LIF file")
    return file.read(2 * count).decode("utf-16-le")


def _read_blocks(file: IO[bytes], size: int) -> dict[str, tuple[int, int]]:
    """Returns the offset and the size in bytes of each block of numbers, by its name."""
    blocks: dict[str, tuple[int, int]] = {}
    while (start := file.tell()) < size and len(blocks) < _MAX_BLOCKS:
        header = file.read(22)  # the block's length has four bytes, or eight
        layout = "<IIBQBI" if header[17:18] == b"\x2a" else "<IIBIBI"
        if len(header) < struct.calcsize(layout):
            raise ValueError("ends within a block's head")
        magic, _, marker, length, second_marker, count = struct.unpack_from(layout, header)
        if magic != 0x70 or not marker == second_marker == 0x2A:
            raise ValueError(f"a block's head at {start} is damaged")
        file.seek(start + struct.calcsize(layout))
        name = file.read(2 * min(count, 1 << 12)).decode("utf-16-le")
        offset = file.tell()
        if count > 1 << 12 or offset + length > size:
            raise ValueError(f"{name!r} takes {length} bytes, the file has {size - offset}")
        blocks[name] = (offset, length)
        file.seek(offset + length)
    return blocks
