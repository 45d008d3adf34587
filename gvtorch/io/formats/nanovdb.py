"""NanoVDB (`.nvdb`, versions 32.*): grids laid out as in memory, packed as a whole or not.

A file is a sequence of segments: a header, the metadata of each grid, then the grids. A grid is a
header of 672 bytes (name, transform, class, type), 64 bytes of tree, the root with its tiles, and
nodes anywhere behind, found by offsets. Each part has the layout of its C++ struct.
Source: the NanoVDB headers of OpenVDB (NanoVDB.h, PNanoVDB.h, io/IO.h).
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..packed import blosc_begin, unpack_block
from ..sparse_grid import (
    COUNTS,
    VOXELS,
    SparseGrid,
    SparseSource,
    bits,
    check_roots,
)
from .format import Format, choose

_FILES = (b"NanoVDB0", b"NanoVDB2")
_GRIDS = (b"NanoVDB0", b"NanoVDB1")
_VERSION = 32
_CODECS = {0: "none", 1: "zlib", 2: "blosc"}
_CLASSES = {1: "level set", 2: "fog volume", 3: "staggered"}
_TYPE, _TREE, _ROOT = 636, 672, 736  # offsets in a grid of its type, its tree and its root
_COUNTS = _TREE + 32  # offset of the numbers of leaves, lower and upper nodes
_META = struct.Struct("<4Q2I6d6i3d8I2HI")
_MOST_GRIDS, _MOST_NAME = 4096, 4096
_ALIGN = 32
# By number of the type: its name, dtype of a number, numbers per value.
_TYPES: dict[int, tuple[str, str, int]] = {
    1: ("float", "<f4", 1),
    2: ("double", "<f8", 1),
    3: ("int16", "<i2", 1),
    4: ("int32", "<i4", 1),
    5: ("int64", "<i8", 1),
    6: ("Vec3f", "<f4", 3),
    7: ("Vec3d", "<f8", 3),
    8: ("Mask", "|b1", 1),
    10: ("uint32", "<u4", 1),
    11: ("bool", "|b1", 1),
    13: ("Fp4", "<f4", 1),
    14: ("Fp8", "<f4", 1),
    15: ("Fp16", "<f4", 1),
    16: ("FpN", "<f4", 1),
    17: ("Vec4f", "<f4", 4),
    18: ("Vec4d", "<f8", 4),
    24: ("Vec3u8", "|u1", 3),
    25: ("Vec3u16", "<u2", 3),
    26: ("uint8", "|u1", 1),
}
_REFUSED = {
    9: "Half", 12: "RGBA8", 19: "Index", 20: "OnIndex", 21: "IndexMask", 22: "OnIndexMask",
    23: "PointIndex",
}  # fmt: skip
_BITS = {"Fp4": 4, "Fp8": 8, "Fp16": 16}


class Head(NamedTuple):
    """The metadata of a grid, and where it lies in its file."""

    name: str
    kind: int
    grid_class: int
    codec: str
    size: int  # bytes of the grid
    offset: int  # in the file
    packed: int  # bytes in the file


@Format("NanoVDB", ".nvdb", options=("key",))
def open_nanovdb(path: str, key: str | None = None) -> SparseSource:
    """Opens the grid `key` (its name or number); "density" or the first, if left out."""
    heads = _heads(path)
    number, lost = choose(path, "grid", [head.name for head in heads], key, preferred="density")
    head = heads[number]
    if head.kind not in _TYPES:
        kind = _REFUSED.get(head.kind, f"type {head.kind}")
        raise ValueError(
            f"{path}: grid {head.name!r} holds {kind}, not a grid of numbers that can be read"
        )
    _, dtype, width = _TYPES[head.kind]
    affine, low, high = _place(_content(path, head, _ROOT + 24), head)
    held = head.size if head.codec != "none" else 0
    return SparseSource.of(
        *(path, head.name, _CLASSES.get(head.grid_class, ""), dtype, width, low, high, affine),
        grid_type=NanoGrid,
        number=number,
        held=held,
        lost=lost,
    )


def _heads(path: str) -> list[Head]:
    """Returns the metadata of all grids of a file."""
    found: list[Head] = []
    size = os.stat(path).st_size
    with open(path, "rb") as file:
        while file.tell() < size:
            magic, version, count, _ = struct.unpack("<8sIHH", file.read(16))
            if magic not in _FILES or version >> 21 != _VERSION:
                told = f"of version {version >> 21}" if magic in _FILES else repr(magic)
                raise ValueError(f"begins a segment {told}; expected NanoVDB of version {_VERSION}")
            for head in [_head(file) for _ in range(count)]:
                at = file.tell()
                packed = _packed(file, head, size)
                found.append(head._replace(offset=at, packed=packed))
                if packed > size - at:
                    raise ValueError(
                        f"grid {head.name!r} takes {packed} bytes, the file has {size - at}"
                    )
                file.seek(at + packed)
            if len(found) > _MOST_GRIDS or not count:
                raise ValueError(f"has {len(found)} grids; expected 1 to {_MOST_GRIDS}")
    return found


def _head(file: Any) -> Head:
    told = _META.unpack(file.read(_META.size))
    length, codec = told[21], told[29]
    if not 0 < length <= _MOST_NAME or codec not in _CODECS:
        raise ValueError(f"a grid's head is damaged: a name of {length} bytes, codec {codec}")
    name = file.read(length).rstrip(b"\0").decode("utf-8", "replace")
    return Head(name, told[4], told[5], _CODECS[codec], told[0], 0, told[1])


def _packed(file: Any, head: Head, end: int) -> int:
    """Returns the bytes that a grid takes in the file. For packed grids they are counted, because
    some writers state them with the length before each part, some without.
    """
    if head.codec == "none":
        return head.packed
    count, size = 0, 0
    while size < head.size:
        (length,) = struct.unpack("<Q", file.read(8))
        if head.codec == "zlib":
            return 8 + length
        part = file.read(16)
        if not 16 <= length <= end or (told := int.from_bytes(part[4:8], "little")) < 1:
            raise ValueError(f"grid {head.name!r} has a packed part of {length} bytes")
        file.seek(length - 16, os.SEEK_CUR)
        count, size = count + 8 + length, size + told
    return count


def _content(path: str, head: Head, most: int = 0) -> Any:
    """Returns a grid's bytes, mapped or unpacked; if `most` is given, at least its first `most`."""
    with open(path, "rb") as file:
        if head.codec == "none":
            if head.size > head.packed or head.size < _ROOT:
                raise ValueError(f"{head.size} bytes of a grid expected, {head.packed} found")
            mapped = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
            return mapped[head.offset : head.offset + head.size]
        file.seek(head.offset)
        parts, size = [], 0
        while size < (most or head.size):
            (length,) = struct.unpack("<Q", file.read(8))
            part = file.read(length)
            if head.codec == "zlib":
                if most:
                    return zlib.decompressobj().decompress(part, most)
                return unpack_block("zlib", part, head.size)
            if most:
                parts.append(blosc_begin(part, most - size))
            else:
                told = int.from_bytes(part[4:8], "little")
                parts.append(unpack_block("blosc", part, min(told, head.size - size)))
            size += len(parts[-1])
        return b"".join(parts)


def _place(grid: Any, head: Head) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (4, 4) from voxels to the world, (3,) the first active voxel and (3,) one past the
    last, from the header and the root of a grid.
    """
    if len(grid) < _ROOT + 24 or bytes(grid[:8]) not in _GRIDS:
        raise ValueError("a grid does not begin as grids of NanoVDB do")
    (kind,) = struct.unpack_from("<I", grid, _TYPE)
    if kind != head.kind:
        raise ValueError(f"grid {head.name!r} is of type {kind}, its file declares {head.kind}")
    affine = np.eye(4)
    affine[:3, :3] = np.frombuffer(grid, "<f8", 9, 384).reshape(3, 3)
    affine[:3, 3] = np.frombuffer(grid, "<f8", 3, 528)
    if struct.unpack_from("<q", grid, _TREE + 24)[0] != _ROOT - _TREE:
        raise ValueError("a grid's root does not follow its head")
    box = np.frombuffer(grid, "<i4", 6, _ROOT).astype(np.int64)
    return affine, box[:3], box[3:] + 1


class NodeFormat(NamedTuple):
    """The layout of the nodes of grids with one type of values: offsets and sizes in bytes."""

    tiles: int  # offset of the tiles in the root
    tile: int  # size of a tile
    tile_value: int  # offset of the value in a tile
    entry: int  # size of an entry of an upper or lower node
    entries: tuple[int, int]  # offset of the entries in an upper, in a lower node
    values: int  # offset of the voxels in a leaf
    leaf: int  # size of a leaf; of FpN: without its codes

    @classmethod
    def of(cls, kind: str, dtype: str, width: int) -> NodeFormat:
        """Computes the layout that a compiler gives to the structs of a type of values: smallest,
        largest (in a root after the background), then mean and deviation.
        """
        item = np.dtype(dtype).itemsize
        value = item * width
        mean = item if dtype == "|b1" else 8 if item == 8 else 4

        def behind(start: int, values: int) -> int:
            """Returns the offset behind values, mean and deviation, a multiple of 32 bytes."""
            return _up(_up(_up(start, item) + values * value, mean) + 2 * mean, _ALIGN)

        at = _up(20, item)
        plain = {"Mask": 0, "bool": 64, "FpN": 0}
        codes = 64 * _BITS[kind] if kind in _BITS else plain.get(kind, VOXELS * value)
        values = 16 if kind == "Mask" else 96 if kind in _BITS or kind == "FpN" else behind(80, 2)
        return cls(
            tiles=behind(28, 3),
            tile=_up(at + value, _ALIGN),
            tile_value=at,
            entry=_up(max(value, 8), 8),
            entries=(behind(32 + 2 * 4096, 2), behind(32 + 2 * 512, 2)),
            values=values,
            leaf=96 if kind == "Mask" else _up(values + codes, _ALIGN),
        )


def _up(n: int, step: int) -> int:
    return -(-n // step) * step


@dataclass(kw_only=True)
class NanoGrid(SparseGrid):
    """A grid in memory; `places` are the offsets of the nodes in bytes."""

    layout: NodeFormat

    @classmethod
    def read(cls, path: str, number: int) -> NanoGrid:
        head = _heads(path)[number]
        data, (kind, dtype, width) = _content(path, head), _TYPES[head.kind]
        layout = NodeFormat.of(kind, dtype, width)
        (count,) = struct.unpack_from("<I", data, _ROOT + 24)
        check_roots(count)
        fields = {
            "names": ["key", "child", "value"],
            "formats": ["<u8", "<i8", (dtype, (width,))],
            "offsets": [0, 8, layout.tile_value],
            "itemsize": layout.tile,
        }
        table = np.ndarray((count,), np.dtype(fields), data, _ROOT + layout.tiles)  # type: ignore[call-overload]
        keys = table["key"][:, None] >> np.array((42, 21, 0), np.uint64)
        keys[:, 1:] &= np.uint64(2**21 - 1)
        if (keys >> np.uint64(20)).any():
            raise ValueError("a key of the root is not a voxel's position")
        corners = (keys.astype(np.int64) << 44 >> 44) * 4096  # 20 bits, signed
        inner = table["child"] != 0
        found = [_checked(_ROOT + table["child"][inner], len(data), layout.entries[0])]
        origins = [corners[inner]]
        for level in (0, 1):
            least = layout.entries[1] if level == 0 else layout.leaf
            below = list(_children(data, layout, level, found[-1], origins[-1]))
            none = np.zeros((0, 3), np.int64)
            places = np.concatenate([none[:, 0], *(part for part, _ in below)])
            origins.append(np.concatenate([none, *(corners for _, corners in below)]))
            found.append(_checked(places, len(data), least))
        sizes = (
            layout.entries[0] + COUNTS[0] ** 3 * layout.entry,
            layout.entries[1] + COUNTS[1] ** 3 * layout.entry,
            layout.leaf,
        )
        _check_apart(found, sizes)
        counts, told = [len(places) for places in found], struct.unpack_from("<3I", data, _COUNTS)
        if counts != [*told[::-1]]:
            raise ValueError(f"the tree has {counts[::-1]} nodes, leaves first; it declares {told}")
        return cls(
            dtype=np.dtype(dtype),
            background=np.ndarray((width,), dtype, data, _ROOT + _up(28, np.dtype(dtype).itemsize)),
            origins=(origins[0], origins[1], origins[2]),
            root_places=corners[~inner],
            root_values=table["value"][~inner],
            data=data,
            kind=kind,
            layout=layout,
            places=(found[0], found[1], found[2]),
        )

    def tiles(self, level: int, number: int) -> tuple[np.ndarray, np.ndarray]:
        n, place = COUNTS[level], int(self.places[level][number])
        width, item = len(self.background), self.dtype.itemsize
        at = place + self.layout.entries[level]
        values = np.ndarray((n**3, width), self.dtype, self.data, at, (self.layout.entry, item))
        is_child = bits(self.data, place + 32 + n**3 // 8, n**3)
        return values.reshape(n, n, n, width), ~is_child.reshape(n, n, n)

    def leaves(self, numbers: np.ndarray) -> np.ndarray:
        out = np.empty((len(numbers), VOXELS, len(self.background)), self.dtype)
        for at, place in enumerate(self.places[2][numbers].tolist()):
            out[at] = self._voxels(place)
        return out

    def _voxels(self, place: int) -> np.ndarray:
        """Returns (512, c) the voxels of a leaf."""
        begin = place + self.layout.values
        if self.kind in ("Mask", "bool"):
            return bits(self.data, begin, VOXELS)[:, None]
        if self.kind in _BITS or self.kind == "FpN":
            low, step = np.frombuffer(self.data, "<f4", 2, place + 80)
            wide = _BITS.get(self.kind) or 1 << (self.data[place + 15] >> 5)
            return (_codes(self.data, begin, wide) * step + low)[:, None]
        width = len(self.background)
        return np.frombuffer(self.data, self.dtype, VOXELS * width, begin).reshape(VOXELS, width)


def _codes(data: Any, at: int, bits: int) -> np.ndarray:
    """Returns (512,) float32, numbers of `bits` bits each, the lowest bits of a byte first."""
    if bits > 16:
        raise ValueError(f"a leaf has numbers of {bits} bits")
    if bits == 16:
        return np.frombuffer(data, "<u2", VOXELS, at).astype(np.float32)
    packed = np.frombuffer(data, "u1", VOXELS * bits // 8, at)
    shifts = np.arange(0, 8, bits, dtype=np.uint8)
    return ((packed[:, None] >> shifts) & (2**bits - 1)).reshape(-1).astype(np.float32)


def _children(
    data: Any, layout: NodeFormat, level: int, places: np.ndarray, origins: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields for each node the offsets of its children, and their first voxels."""
    n, side = COUNTS[level], COUNTS[level + 1] * (8 if level == 0 else 1)
    for place, origin in zip(places.tolist(), origins, strict=True):
        which = np.flatnonzero(bits(data, place + 32 + n**3 // 8, n**3))
        steps = np.ndarray((n**3,), "<i8", data, place + layout.entries[level], (layout.entry,))
        corner = np.stack(np.unravel_index(which, (n, n, n)), 1)
        yield place + steps[which], origin + corner * side


def _checked(places: np.ndarray, size: int, least: int) -> np.ndarray:
    """Returns the offsets of nodes; raises ValueError unless all differ, are aligned, and have
    `least` bytes behind them.
    """
    if len(places) and not (places.min() >= _ROOT and places.max() <= size - least):
        raise ValueError(f"a node lies outside of the grid's {size} bytes")
    if (places % _ALIGN).any():
        raise ValueError(f"a node lies at no multiple of {_ALIGN} bytes")
    if len(np.unique(places)) != len(places):
        raise ValueError("several positions of the tree share a node")
    return places


def _check_apart(places: Sequence[np.ndarray], sizes: Sequence[int]) -> None:
    """Raises ValueError if nodes overlap; by level: their offsets, and the bytes of one node."""
    begin = np.concatenate(places)
    order = np.argsort(begin)
    end = begin + np.repeat(sizes, [len(part) for part in places])
    if (end[order][:-1] > begin[order][1:]).any():
        raise ValueError("nodes of the tree overlap")
