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

_MAX_HEADER_CHARS = 1 << 28
_MAX_BLOCKS = 1 << 20
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
    channels = element.findall("./Data/Image/ImageDescription/Channels/ChannelDescription")
    axes = element.findall("./Data/Image/ImageDescription/Dimensions/DimensionDescription")
    sample_types = {
        (int(c.get("DataType", 0)), -(-int(c.get("Resolution", 8)) // 8)) for c in channels
    }
    dtypes = {(0, 1): "<u1", (0, 2): "<u2", (1, 4): "<f4"}
    stored = dtypes.get(next(iter(sample_types))) if len(sample_types) == 1 else None
    if stored is None:
        raise ValueError(f"{path}: channels of several or unknown kinds of numbers")
    shape, strides, axis_order = [], [], ""
    sampling: dict[str, tuple[float | None, str | None]] = {}
    for axis in axes:
        dimension_id, count = int(axis.get("DimID", 0)), int(axis.get("NumberOfElements", 0))
        letter = _AXIS_LETTERS.get(dimension_id, "-")
        if letter == "-" and count > 1:
            axis_name = _OTHER_AXES.get(dimension_id, f"elements of the axis {dimension_id}")
            raise ValueError(f"{path}: an image of {count} {axis_name} is not known here")
        length = float(axis.get("Length") or 0)
        step = abs(length) / (count - 1) if count > 1 and length else None
        sampling[letter] = (step, axis.get("Unit"))
        shape.append(count)
        strides.append(int(axis.get("BytesInc", 0)))
        axis_order += letter
    if len(channels) > 1:
        offsets = [int(channel.get("BytesInc", 0)) for channel in channels]
        steps = {b - a for a, b in itertools.pairwise(offsets)}
        if len(steps) != 1:
            raise ValueError(f"{path}: channels are not evenly spaced")
        shape, strides = [len(channels), *shape], [steps.pop(), *strides]
        axis_order = "c" + axis_order
    offset, block_bytes = _find_block(element, blocks) or (0, 0)
    image_bytes = sum((n - 1) * s for n, s in zip(shape, strides, strict=True)) + int(stored[2])
    if (
        min(shape, default=0) < 1
        or min(strides, default=0) < 0
        or not 0 < image_bytes <= block_bytes
    ):
        raise ValueError(
            f"{path}: the image takes {image_bytes} bytes, its block has {block_bytes}"
        )
    spacing, unit = spacing_of(
        [sampling.get(a, (None, None))[0] for a in "xyz"],
        [sampling.get(a, (None, None))[1] or "m" for a in "xyz"],
    )
    if unit == "meter":  # micrometres suit microscopes
        x, y, z = (1e6 * side for side in spacing)
        spacing, unit = (x, y, z), "micrometer"
    if unit and sampling.get("z", (1.0, None))[0] is None:
        dropped.append(NO_DEPTH)
    step = sampling.get("t", (None, None))[0]
    return LifSource(
        path=path,
        shape=tuple(shape),
        axes=axis_order,
        stored=stored,
        spacing=spacing,
        info=ImageInfo(
            unit=unit,
            channels=tuple(_channel(channel) for channel in channels),
            time_step=step,
            time_unit="second" if step else None,
        ),
        dropped=tuple(dropped),
        offset=offset,
        length=image_bytes,
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
    while file.tell() < size and len(blocks) < _MAX_BLOCKS:
        header = file.read(13)
        if len(header) < 13:
            raise ValueError("ends within a block's head")
        magic, _, marker, length = struct.unpack("<IIBI", header)
        if magic != 0x70 or marker != 0x2A:
            raise ValueError(f"a block's head at {file.tell() - 13} is damaged")
        next_byte = file.read(1)
        if next_byte != b"\x2a":  # the length has eight bytes
            rest = next_byte + file.read(4)
            length, marker = struct.unpack("<QB", header[9:] + rest)
            if marker != 0x2A:
                raise ValueError(f"a block's head at {file.tell()} is damaged")
        (count,) = struct.unpack("<I", file.read(4))
        name = file.read(2 * min(count, 1 << 12)).decode("utf-16-le")
        offset = file.tell()
        if count > 1 << 12 or offset + length > size:
            raise ValueError(f"{name!r} takes {length} bytes, the file has {size - offset}")
        blocks[name] = (offset, length)
        file.seek(offset + length)
    return blocks
