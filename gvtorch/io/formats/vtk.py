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
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from ...base.image_info import ChannelInfo, ImageInfo
from ...base.volume import check_extent
from ..packed import PackedSource, text_numbers, unpack_block
from ..source import ArraySource, Index, VolumeSource, number_type, place_axes
from .format import Format, choose

_LONG = {"long": "i8", "unsigned_long": "u8", "vtktypeint64": "i8", "vtktypeuint64": "u8"}
_LONG["vtkidtype"] = "i4"  # which VTK writes as int
_MOST_HEADER = 1 << 22  # bytes
_MOST_VALUES = 1 << 33
_MOST_ARRAYS = 64
_MOST_LINE = 4096  # bytes of a line that are parsed
_ARRAYS = ("SCALARS", "VECTORS", "COLOR_SCALARS")


@dataclass(frozen=True, kw_only=True)
class VtkSource(VolumeSource):
    """An array of an XML file that is packed, or encoded as text."""

    encoding: str  # "raw", "base64" or "ascii"
    compressor: str  # "zlib", "lzma", "lz4", or none
    header: str  # dtype of the sizes before the data
    offset: int
    length: int  # bytes of the file that may belong to it
    whole: bool = True

    def read_stored(self, index: Index) -> np.ndarray:
        count, dtype = math.prod(self.shape), np.dtype(self.stored)
        with open(self.path, "rb") as file:
            file.seek(self.offset)
            content = file.read(self.length)
        if self.encoding == "ascii":
            text = io.BytesIO(content)
            return text_numbers(self.path, text, count, self.stored, exact=True).reshape(
                self.shape
            )[index]
        data = self._unpacked(content, count * dtype.itemsize)
        return np.frombuffer(data, dtype).reshape(self.shape)[index]

    def _unpacked(self, content: bytes, need: int) -> bytes:
        size = np.dtype(self.header).itemsize
        if self.encoding == "base64":
            content = re.split(rb"[<\s]", content.strip(), maxsplit=1)[0]
        if not self.compressor:
            first = _bytes(content, self.encoding, size + need)
            told = int(np.frombuffer(first[:size], self.header)[0])
            if told != need or len(first) < size + need:
                raise ValueError(f"{self.path}: {need} bytes expected, {told} found")
            return first[size : size + need]
        blocks = int(np.frombuffer(_bytes(content, self.encoding, size), self.header)[0])
        if not 1 <= blocks <= len(content):
            raise ValueError(f"{self.path}: {blocks} blocks in {len(content)} bytes")
        heads = (3 + blocks) * size
        table = np.frombuffer(_bytes(content, self.encoding, heads), self.header).tolist()
        block, last, packed = table[1], table[2], table[3:]
        sizes = [block] * (blocks - 1) + [last or block]
        if sum(sizes) != need:
            raise ValueError(f"{self.path}: {need} bytes expected, {sum(sizes)} found")
        if sum(packed) > len(content):
            raise ValueError(f"{self.path}: ends before its {sum(packed)} packed bytes")
        # The table and the blocks are each encoded as one stretch of base64.
        begin = heads if self.encoding == "raw" else -(-heads // 3) * 4
        data, parts, at = _bytes(content[begin:], self.encoding, sum(packed)), [], 0
        for here, unpacked in zip(packed, sizes, strict=True):
            parts.append(unpack_block(self.compressor, data[at : at + here], unpacked))
            at += here
        return b"".join(parts)


def _bytes(content: bytes, encoding: str, count: int) -> bytes:
    """Returns the first `count` bytes of raw or base64 content."""
    if encoding == "raw":
        return content[:count]
    return base64.b64decode(content[: -(-count // 3) * 4])[:count]


@Format("VTK", ".vti", ".vtk", options=("key",))
def open_vtk(path: str, key: str | None = None) -> VolumeSource:
    """Opens an image; `key` is the name or number of an array, the first if left out."""
    return _open_legacy(path, key) if path.lower().endswith(".vtk") else _open_xml(path, key)


def _told(
    path: str,
    points: Sequence[int],
    affine: np.ndarray,
    array: dict[str, Any],
    lost: tuple[str, ...],
) -> dict[str, Any]:
    """Returns the fields of a source of (z, y, x) or (z, y, x, c) values at points, or in cells."""
    size = [max(n - 1, 1) for n in points] if array["cells"] else list(points)
    check_extent(path, size, most=_MOST_VALUES)
    if array["cells"]:
        affine = affine.copy()
        half = [0.5 * (n > 1) for n in points]
        affine[:3, 3] += affine[:3, :3] @ half
    width = array["width"]
    place = place_axes(path, affine, size)
    place["axes"] = place["axes"][::-1] + "c" * (width > 1)
    return {
        "path": path,
        "shape": (*size[::-1], *((width,) if width > 1 else ())),
        "info": ImageInfo(channels=(ChannelInfo(name=array["name"]),) if width == 1 else ()),
        "lost": lost,
        **place,
    }


# --- XML


def _open_xml(path: str, key: str | None) -> VolumeSource:
    with open(path, "rb") as file:
        content = file.read(_MOST_HEADER)
        file.seek(0, 2)
        end = file.tell()
    # Matched at the first tag only: with many tags that never end, time would grow as their square.
    start = content.find(b"<AppendedData")
    appended = (
        re.compile(rb"<AppendedData\b[^>]*>\s*_").match(content, start) if start >= 0 else None
    )
    inline = appended is None
    if inline and end > _MOST_HEADER:
        content = _read_all(path, end)
    text = content if inline else content[: appended.start()] + b"</VTKFile>"  # type: ignore[union-attr]
    root = ElementTree.fromstring(text)
    image, piece = _image_and_piece(path, root)
    extent = [int(n) for n in piece.get("Extent", image.get("WholeExtent", "")).split()]
    if len(extent) != 6:
        raise ValueError(f"{path}: has no extent")
    low, high = extent[::2], extent[1::2]
    arrays = _xml_arrays(root, piece)
    chosen, lost = choose(path, "array", [array["name"] for array in arrays], key)
    array = arrays[chosen]
    if (kind := number_type(array["kind"])) is None:
        raise ValueError(f"{path}: {array['name']} is of {array['kind']}; expected numbers")
    numbers = {
        name: np.array([float(v) for v in image.get(name, plain).split()])
        for name, plain in (
            ("Origin", "0 0 0"), ("Spacing", "1 1 1"), ("Direction", "1 0 0 0 1 0 0 0 1"),
        )
    }  # fmt: skip
    affine = np.eye(4)
    affine[:3, :3] = numbers["Direction"].reshape(3, 3) * numbers["Spacing"]
    affine[:3, 3] = numbers["Origin"] + affine[:3, :3] @ low
    points = [b - a + 1 for a, b in zip(low, high, strict=True)]
    told = _told(path, points, affine, array, lost)
    order = {"LittleEndian": "<", "BigEndian": ">"}[root.get("byte_order", "LittleEndian")]
    header = order + {"UInt32": "u4", "UInt64": "u8"}[root.get("header_type", "UInt32")]
    packer = {"": "", "vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma",
              "vtkLZ4DataCompressor": "lz4"}[root.get("compressor", "")]  # fmt: skip
    stored = order + kind
    if array["format"] == "appended":
        if appended is None:
            raise ValueError(f"{path}: has no appended data")
        encoding = "base64" if b"base64" in appended.group() else "raw"
        offset = appended.end() + array["offset"]
        if not packer and encoding == "raw":
            data = ArraySource(
                file=path, offset=offset + np.dtype(header).itemsize, stored=stored, **told
            )
            data.check_file()
            return data
        length = end - offset
        if length <= 0:
            raise ValueError(
                f"{path}: {array['name']} begins at {offset}, the file has {end} bytes"
            )
    else:
        encoding = "ascii" if array["format"] == "ascii" else "base64"
        offset, length = _inline(content, array["number"])
    return VtkSource(
        stored=stored,
        encoding=encoding,
        compressor=packer,
        header=header,
        offset=offset,
        length=length,
        **told,
    )


def _image_and_piece(path: str, root: Any) -> tuple[Any, Any]:
    """Returns the ImageData of a file, and its only piece."""
    image = root.find("ImageData")
    if root.get("type") == "ImageData" and image is None:
        raise ValueError(f"{path}: has no ImageData in it")
    if root.tag != "VTKFile" or image is None:
        raise ValueError(f"{path}: is not ImageData, but {root.get('type', root.tag)!r}")
    pieces = image.findall("Piece")
    if len(pieces) != 1:
        raise ValueError(f"{path}: has {len(pieces)} pieces; expected one")
    return image, pieces[0]


def _read_all(path: str, size: int) -> bytes:
    """Reads a file whose numbers are inside its XML."""
    if size > 1 << 31:
        raise ValueError(f"{path}: {size} bytes of XML are too many; write it with appended data")
    with open(path, "rb") as file:
        return file.read()


def _xml_arrays(root: Any, piece: Any) -> list[dict[str, Any]]:
    """Returns the arrays of a piece: the scalars first; within both groups, points before cells."""
    found: list[dict[str, Any]] = []
    numbers = {id(item): at for at, item in enumerate(root.iter("DataArray"))}
    for kind in ("PointData", "CellData"):
        group = piece.find(kind)
        for item in [] if group is None else group.findall("DataArray"):
            width = int(item.get("NumberOfComponents", 1))
            if not 1 <= width <= 1 << 16 or int(item.get("offset", 0)) < 0:
                raise ValueError(f"{width} components at {item.get('offset')}")
            found.append(
                {
                    "name": item.get("Name", f"array {len(found)}"),
                    "kind": item.get("type", ""),
                    "width": width,
                    "format": item.get("format", "ascii"),
                    "offset": int(item.get("offset", 0)),
                    "cells": kind == "CellData",
                    "number": numbers[id(item)],
                    "first": item.get("Name") == group.get("Scalars"),
                }
            )
    return sorted(found, key=lambda array: not array["first"])


def _inline(content: bytes, number: int) -> tuple[int, int]:
    """Returns the offset and length of the content of a DataArray, by its number in the file."""
    found: list[list[int]] = []
    parser = expat.ParserCreate()

    def ended_tag(_text: str) -> None:
        """Records where the content behind a tag begins."""
        parser.DefaultHandler = None
        found[-1][0] = parser.CurrentByteIndex

    def start(name: str, _attributes: dict[str, str]) -> None:
        parser.DefaultHandler = None
        if name == "DataArray":
            found.append([0, 0])
            parser.DefaultHandler = ended_tag

    def end(name: str) -> None:
        parser.DefaultHandler = None
        if name == "DataArray" and not found[-1][1]:
            found[-1][1] = parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(content, True)
    begin, stop = found[number]
    return (begin, stop - begin) if begin else (0, 0)


# --- legacy


def _open_legacy(path: str, key: str | None) -> VolumeSource:
    with (
        open(path, "rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
    ):
        lines = content[:4096].split(b"\n", 4)
        if len(lines) < 5 or not lines[0].startswith(b"# vtk DataFile"):
            raise ValueError(f"{path}: is not a legacy VTK file")
        if lines[3].split() != [b"DATASET", b"STRUCTURED_POINTS"]:
            found = lines[3][:60].decode("latin-1")
            raise ValueError(f"{path}: {found!r}; expected STRUCTURED_POINTS")
        binary = lines[2].strip().upper() == b"BINARY"
        head = sum(len(line) + 1 for line in lines[:4])
        affine, points, arrays = _legacy_parts(path, content, head, binary)
    chosen, lost = choose(path, "array", [array["name"] for array in arrays], key)
    array = arrays[chosen]
    told = _told(path, points, affine, array, lost)
    told |= {"file": path, "offset": array["offset"], "stored": array["stored"]}
    if binary:
        return ArraySource(**told)
    return PackedSource(codec="shares" if array["colors"] else "text", **told)


def _legacy_parts(
    path: str, content: mmap.mmap, at: int, binary: bool
) -> tuple[np.ndarray, list[int], list[dict[str, Any]]]:
    """Returns affine, number of points, and the arrays in the order of `_xml_arrays`.

    In text files, lines of numbers are passed over, as they match no keyword.
    """
    affine, points = np.eye(4), [1, 1, 1]
    arrays: list[dict[str, Any]] = []
    cells, in_field = False, 0
    while (end := content.find(b"\n", at)) >= 0 and len(arrays) < _MOST_ARRAYS:
        words = content[at : min(end, at + _MOST_LINE)].decode("latin-1").split()
        at = end + 1
        name = words[0].upper() if words else ""
        if name == "DIMENSIONS":
            points = [int(n) for n in words[1:4]]
        elif name in ("SPACING", "ASPECT_RATIO"):
            affine[:3, :3] = np.diag([float(n) for n in words[1:4]])
        elif name == "ORIGIN":
            affine[:3, 3] = [float(n) for n in words[1:4]]
        elif name in ("POINT_DATA", "CELL_DATA"):
            cells = name == "CELL_DATA"
            count = math.prod(max(n - 1, 1) if cells else n for n in points)
            if int(words[1]) != count:
                raise ValueError(f"{path}: {' '.join(words)[:80]!r} of a grid that has {count}")
        elif name == "FIELD":
            in_field = int(words[2])
        elif name in _ARRAYS or (len(words) == 4 and _legacy_type(words[3]) and in_field > 0):
            array = _legacy_array(path, words, points, cells)
            table = re.match(rb"LOOKUP_TABLE[^\n]*\n", content[at : at + 200])
            at += table.end() if table and name == "SCALARS" else 0
            arrays.append({**array, "offset": at})
            in_field -= name not in _ARRAYS
            at += array["bytes"] * binary
    return affine, points, sorted(arrays, key=lambda array: (not array["first"], array["cells"]))


def _legacy_type(name: str) -> str:
    return _LONG.get(name.lower()) or number_type(name) or ""


def _legacy_array(
    path: str, words: list[str], points: Sequence[int], cells: bool
) -> dict[str, Any]:
    """Returns the description of an array from its header line."""
    kind = words[0].upper()
    if kind == "COLOR_SCALARS":
        name, dtype, width = words[1].replace("%%", "%"), "u1", int(words[2])  # VTK doubles the %
    elif kind not in _ARRAYS:  # of a field
        name, width, dtype = words[0], int(words[1]), _legacy_type(words[3])
    else:
        name, dtype = words[1], _legacy_type(words[2])
        width = 3 if kind == "VECTORS" else int(words[3]) if len(words) > 3 else 1
    if not dtype:
        raise ValueError(f"{path}: {' '.join(words)[:80]!r} is not an array of numbers")
    check_extent(path, (*points, width), most=_MOST_VALUES)
    count = math.prod(max(n - 1, 1) if cells else n for n in points) * width
    size = np.dtype(dtype).itemsize
    return {
        "name": unquote(name),
        "first": kind in ("SCALARS", "COLOR_SCALARS"),
        "colors": kind == "COLOR_SCALARS",
        "width": width,
        "stored": ">" + dtype,
        "cells": cells,
        "bytes": count * size,
    }
