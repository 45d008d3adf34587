"""VTK images without VTK: XML (`.vti`) and legacy files (`.vtk`, STRUCTURED_POINTS).

Raw numbers are read by region; packed ones block by block, each bounded by the size in the header.
Values are point data, or cell data (voxels between the points). Axes may be rotated (Direction).
Source: "VTK File Formats" (VTK User's Guide, Kitware), simple legacy and XML formats.
"""

from __future__ import annotations

import base64
import io
import math
import mmap
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from ...base.boxes import check_extent
from ...base.image_info import ChannelInfo, ImageInfo
from ..packed import unpack_block
from ..source import ArraySource, Index, VolumeSource, number_type, place_axes
from ..text_source import TextSource, text_numbers
from .format import Format, choose

_LONG_TYPES = {"long": "i8", "unsigned_long": "u8", "vtktypeint64": "i8", "vtktypeuint64": "u8"}
_LONG_TYPES["vtkidtype"] = "i4"  # which VTK writes as int
_BYTE_ORDERS = {"LittleEndian": "<", "BigEndian": ">"}
_SIZE_DTYPES = {"UInt32": "u4", "UInt64": "u8"}
_COMPRESSORS = {
    "": "",
    "vtkZLibDataCompressor": "zlib",
    "vtkLZMADataCompressor": "lzma",
    "vtkLZ4DataCompressor": "lz4",
}
_MAX_HEADER_BYTES = 1 << 22
_MAX_INLINE_BYTES = 1 << 31  # of a file whose numbers are inside its XML
_MAX_ARRAYS = 64
_MAX_LINE_BYTES = 4096  # of a line that are parsed
_ARRAY_KEYWORDS = ("SCALARS", "VECTORS", "COLOR_SCALARS")


@dataclass(frozen=True, kw_only=True)
class VtkSource(VolumeSource):
    """An array of an XML file that is packed, or encoded as text."""

    encoding: str  # "raw", "base64" or "ascii"
    compressor: str  # "zlib", "lzma", "lz4", or none
    size_dtype: str  # dtype of the sizes before the data
    number: int  # of its DataArray in the file
    offset: int | None  # where its data begin in the file; None if the DataArray holds them
    whole: bool = True

    def read_stored(self, index: Index) -> np.ndarray:
        count, dtype = math.prod(self.shape), np.dtype(self.stored)
        if self.offset is None:
            root = ElementTree.fromstring(_read_xml(self.path)[0])
            content = (list(root.iter("DataArray"))[self.number].text or "").encode()
        else:
            with open(self.path, "rb") as file:
                file.seek(self.offset)
                content = file.read()
        if self.encoding == "ascii":
            text = io.BytesIO(content)
            numbers = text_numbers(self.path, text, count, self.stored, exact=True)
        else:
            numbers = np.frombuffer(self._unpack(content, count * dtype.itemsize), dtype)
        return numbers.reshape(self.shape)[index]

    def _unpack(self, content: bytes, needed_bytes: int) -> bytes:
        item_bytes = np.dtype(self.size_dtype).itemsize
        if self.encoding == "base64":
            content = re.split(rb"[<\s]", content.strip(), maxsplit=1)[0]
        if not self.compressor:
            decoded = _decode(content, self.encoding, item_bytes + needed_bytes)
            declared = self._sizes(content, 1)[0]
            if declared != needed_bytes or len(decoded) < item_bytes + needed_bytes:
                raise ValueError(f"{self.path}: {needed_bytes} bytes expected, {declared} found")
            return decoded[item_bytes : item_bytes + needed_bytes]
        block_count = self._sizes(content, 1)[0]
        if not 1 <= block_count <= len(content):
            raise ValueError(f"{self.path}: {block_count} blocks in {len(content)} bytes")
        table_bytes = (3 + block_count) * item_bytes
        _, block_size, last_size, *packed_sizes = self._sizes(content, 3 + block_count)
        unpacked_sizes = [block_size] * (block_count - 1) + [last_size or block_size]
        if (found := sum(unpacked_sizes)) != needed_bytes:
            raise ValueError(f"{self.path}: {needed_bytes} bytes expected, {found} found")
        if sum(packed_sizes) > len(content):
            raise ValueError(f"{self.path}: ends before its {sum(packed_sizes)} packed bytes")
        # The table and the blocks are each encoded as one stretch of base64.
        start = table_bytes if self.encoding == "raw" else -(-table_bytes // 3) * 4
        data, parts, position = _decode(content[start:], self.encoding, sum(packed_sizes)), [], 0
        for packed_size, unpacked_size in zip(packed_sizes, unpacked_sizes, strict=True):
            packed = data[position : position + packed_size]
            parts.append(unpack_block(self.compressor, packed, unpacked_size))
            position += packed_size
        return b"".join(parts)

    def _sizes(self, content: bytes, count: int) -> list[int]:
        """Returns the first `count` sizes before the data."""
        size_dtype = np.dtype(self.size_dtype)
        table = _decode(content, self.encoding, count * size_dtype.itemsize)
        sizes: list[int] = np.frombuffer(table, size_dtype, count).tolist()
        return sizes


def _decode(content: bytes, encoding: str, count: int) -> bytes:
    """Returns the first `count` bytes of raw or base64 content."""
    if encoding == "raw":
        return content[:count]
    return base64.b64decode(content[: -(-count // 3) * 4])[:count]


@Format("VTK", ".vti", ".vtk", options=("key",))
def open_vtk(path: str, key: str | None = None) -> VolumeSource:
    """Opens an image; `key` is the name or number of an array, the first if left out."""
    return _open_legacy(path, key) if path.lower().endswith(".vtk") else _open_xml(path, key)


def _extent(points: Sequence[int], cells: bool) -> list[int]:
    """Returns the values along x, y and z: at points, or in the cells between them."""
    return [max(n - 1, 1) if cells else n for n in points]


def _source_fields(
    path: str, points: Sequence[int], affine: np.ndarray, array: dict[str, Any]
) -> dict[str, Any]:
    """Returns the fields of a source of (z, y, x) or (z, y, x, c) values at points, or in cells."""
    size = _extent(points, array["cells"])
    if array["cells"]:
        affine = affine.copy()
        half_voxel = [0.5 * (n > 1) for n in points]
        affine[:3, 3] += affine[:3, :3] @ half_voxel
    width = array["width"]
    placement = place_axes(path, affine, size)
    placement["axes"] = placement["axes"][::-1] + "c" * (width > 1)
    return {
        "path": path,
        "shape": (*size[::-1], *((width,) if width > 1 else ())),
        "info": ImageInfo(channels=(ChannelInfo(name=array["name"]),) if width == 1 else ()),
        **placement,
    }


# --- XML


def _open_xml(path: str, key: str | None) -> VolumeSource:
    xml, appended = _read_xml(path)
    root = ElementTree.fromstring(xml)
    image = root.find("ImageData")
    if root.get("type") == "ImageData" and image is None:
        raise ValueError(f"{path}: has no ImageData in it")
    if root.tag != "VTKFile" or image is None:
        raise ValueError(f"{path}: is not ImageData, but {root.get('type', root.tag)!r}")
    pieces = image.findall("Piece")
    if len(pieces) != 1:
        raise ValueError(f"{path}: has {len(pieces)} pieces; expected one")
    affine, points = _xml_grid(path, image, pieces[0])
    arrays = _xml_arrays(root, pieces[0])
    chosen, dropped = choose(path, "array", [array["name"] for array in arrays], key)
    array = arrays[chosen]
    if (number_dtype := number_type(array["kind"])) is None:
        raise ValueError(f"{path}: {array['name']} is of {array['kind']}; expected numbers")
    byte_order = _BYTE_ORDERS[root.get("byte_order", "LittleEndian")]
    size_dtype = byte_order + _SIZE_DTYPES[root.get("header_type", "UInt32")]
    compressor = _COMPRESSORS[root.get("compressor", "")]
    fields = _source_fields(path, points, affine, array)
    fields |= {"stored": byte_order + number_dtype, "dropped": dropped}
    offset, encoding = None, "ascii" if array["format"] == "ascii" else "base64"
    if array["format"] == "appended":
        if appended is None:
            raise ValueError(f"{path}: has no appended data")
        offset, size = appended.end() + array["offset"], os.stat(path).st_size
        if offset >= size:
            name = array["name"]
            raise ValueError(f"{path}: {name} begins at {offset}, the file has {size} bytes")
        encoding = "base64" if b"base64" in appended.group() else "raw"
        if encoding == "raw" and not compressor:
            return ArraySource(file=path, offset=offset + np.dtype(size_dtype).itemsize, **fields)
    fields |= {"encoding": encoding, "compressor": compressor, "size_dtype": size_dtype}
    return VtkSource(number=array["number"], offset=offset, **fields)


def _read_xml(path: str) -> tuple[bytes, re.Match[bytes] | None]:
    """Returns a file's XML, and a match that ends where appended data begin, if there are any."""
    with open(path, "rb") as file:
        content = file.read(_MAX_HEADER_BYTES)
        # At the first tag only: with many tags that never end, time would grow as their square.
        start = content.find(b"<AppendedData")
        tag = re.compile(rb"<AppendedData\b[^>]*>\s*_")
        appended = tag.match(content, start) if start >= 0 else None
        if appended is not None:
            return content[: appended.start()] + b"</VTKFile>", appended
        size = os.stat(path).st_size
        if size > _MAX_INLINE_BYTES:
            raise ValueError(f"{path}: {size} bytes of XML are too many; write appended data")
        return content + file.read(), None


def _xml_grid(path: str, image: Any, piece: Any) -> tuple[np.ndarray, list[int]]:
    """Returns (4, 4) from the piece's points to the world, and their number along x, y and z."""

    def numbers(name: str, default: str) -> np.ndarray:
        return np.array([float(number) for number in image.get(name, default).split()])

    extent = [int(n) for n in piece.get("Extent", image.get("WholeExtent", "")).split()]
    if len(extent) != 6:
        raise ValueError(f"{path}: has no extent")
    low, high = extent[::2], extent[1::2]
    direction = numbers("Direction", "1 0 0 0 1 0 0 0 1").reshape(3, 3)
    affine = np.eye(4)
    affine[:3, :3] = direction * numbers("Spacing", "1 1 1")
    affine[:3, 3] = numbers("Origin", "0 0 0") + affine[:3, :3] @ low
    return affine, [b - a + 1 for a, b in zip(low, high, strict=True)]


def _xml_arrays(root: Any, piece: Any) -> list[dict[str, Any]]:
    """Returns the arrays of a piece: the scalars first; within both groups, points before cells."""
    arrays: list[dict[str, Any]] = []
    numbers = {id(element): number for number, element in enumerate(root.iter("DataArray"))}
    for kind in ("PointData", "CellData"):
        group = piece.find(kind)
        for element in [] if group is None else group.findall("DataArray"):
            width = int(element.get("NumberOfComponents", 1))
            if not 1 <= width <= 1 << 16 or int(element.get("offset", 0)) < 0:
                raise ValueError(f"{width} components at {element.get('offset')}")
            arrays.append(
                {
                    "name": element.get("Name", f"array {len(arrays)}"),
                    "kind": element.get("type", ""),
                    "width": width,
                    "format": element.get("format", "ascii"),
                    "offset": int(element.get("offset", 0)),
                    "cells": kind == "CellData",
                    "number": numbers[id(element)],
                    "first": element.get("Name") == group.get("Scalars"),
                }
            )
    return sorted(arrays, key=lambda array: not array["first"])


# --- legacy


def _open_legacy(path: str, key: str | None) -> VolumeSource:
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        lines = content[:4096].split(b"\n", 4)
        if len(lines) < 5 or not lines[0].startswith(b"# vtk DataFile"):
            raise ValueError(f"{path}: is not a legacy VTK file")
        if lines[3].upper().split() != [b"DATASET", b"STRUCTURED_POINTS"]:
            dataset = lines[3][:60].decode("latin-1")
            raise ValueError(f"{path}: {dataset!r}; expected STRUCTURED_POINTS")
        binary = lines[2].strip().upper() == b"BINARY"
        header_bytes = sum(len(line) + 1 for line in lines[:4])
        affine, points, arrays = _legacy_parts(path, content, header_bytes, binary)
    chosen, dropped = choose(path, "array", [array["name"] for array in arrays], key)
    array = arrays[chosen]
    fields = _source_fields(path, points, affine, array)
    fields |= {"file": path, "offset": array["offset"], "stored": array["stored"]}
    fields["dropped"] = dropped
    if binary:
        return ArraySource(**fields)
    return TextSource(fractions=array["colors"], **fields)


def _legacy_parts(
    path: str, content: mmap.mmap, position: int, binary: bool
) -> tuple[np.ndarray, list[int], list[dict[str, Any]]]:
    """Returns affine, number of points, and the arrays in the order of `_xml_arrays`.

    In text files, lines of numbers are passed over, as they match no keyword.
    """
    affine, points = np.eye(4), [1, 1, 1]
    arrays: list[dict[str, Any]] = []
    cells, field_arrays_left = False, 0
    while (end := content.find(b"\n", position)) >= 0 and len(arrays) < _MAX_ARRAYS:
        tokens = content[position : min(end, position + _MAX_LINE_BYTES)].decode("latin-1").split()
        position = end + 1
        name = tokens[0].upper() if tokens else ""
        if name == "DIMENSIONS":
            points = [int(n) for n in tokens[1:4]]
        elif name in ("SPACING", "ASPECT_RATIO"):
            affine[:3, :3] = np.diag([float(n) for n in tokens[1:4]])
        elif name == "ORIGIN":
            affine[:3, 3] = [float(n) for n in tokens[1:4]]
        elif name in ("POINT_DATA", "CELL_DATA"):
            cells = name == "CELL_DATA"
            count = math.prod(_extent(points, cells))
            if int(tokens[1]) != count:
                raise ValueError(f"{path}: {' '.join(tokens)[:80]!r} of a grid that has {count}")
        elif name == "FIELD":
            field_arrays_left = int(tokens[2])
        elif name in _ARRAY_KEYWORDS or (
            len(tokens) == 4 and _legacy_type(tokens[3]) and field_arrays_left > 0
        ):
            array = _legacy_array(path, tokens, points, cells)
            next_line = content[position : position + 200]
            lookup_table = re.match(rb"(?i)LOOKUP_TABLE[^\n]*\n", next_line)
            position += lookup_table.end() if lookup_table and name == "SCALARS" else 0
            arrays.append({**array, "offset": position})
            field_arrays_left -= name not in _ARRAY_KEYWORDS
            position += array["bytes"] * binary
    return affine, points, sorted(arrays, key=lambda array: (not array["first"], array["cells"]))


def _legacy_type(name: str) -> str:
    return _LONG_TYPES.get(name.lower()) or number_type(name) or ""


def _legacy_array(
    path: str, tokens: list[str], points: Sequence[int], cells: bool
) -> dict[str, Any]:
    kind = tokens[0].upper()
    if kind == "COLOR_SCALARS":
        name, dtype, width = tokens[1].replace("%%", "%"), "u1", int(tokens[2])  # VTK doubles the %
    elif kind not in _ARRAY_KEYWORDS:  # of a field
        name, width, dtype = tokens[0], int(tokens[1]), _legacy_type(tokens[3])
    else:
        name, dtype = tokens[1], _legacy_type(tokens[2])
        width = 3 if kind == "VECTORS" else int(tokens[3]) if len(tokens) > 3 else 1
    if not dtype:
        raise ValueError(f"{path}: {' '.join(tokens)[:80]!r} is not an array of numbers")
    check_extent(path, (*points, width), max_values=1 << 62)
    nbytes = math.prod(_extent(points, cells)) * width * np.dtype(dtype).itemsize
    return {
        "name": unquote(name),
        "first": kind in ("SCALARS", "COLOR_SCALARS"),
        "colors": kind == "COLOR_SCALARS",
        "width": width,
        "stored": ">" + dtype,
        "cells": cells,
        "bytes": nbytes,
    }
