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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..packed import blosc_begin, unpack_block
from ..sparse_grid import COUNTS, SIDES, VOXELS, SparseGrid, SparseSource, bits, check_roots
from .format import Format, choose

_FILE_MAGICS = (b"NanoVDB0", b"NanoVDB2")
_GRID_MAGICS = (b"NanoVDB0", b"NanoVDB1")
_VERSION = 32
_CODECS = {0: "none", 1: "zlib", 2: "blosc"}
_CLASSES = {1: "level set", 2: "fog volume", 3: "staggered"}
_TYPE_OFFSET, _TREE_OFFSET, _ROOT_OFFSET = 636, 672, 736  # in a grid
_COUNTS_OFFSET = _TREE_OFFSET + 32  # offset of the numbers of leaves, lower and upper nodes
_METADATA = struct.Struct("<4Q2I6d6i3d8I2HI")
_MAX_GRIDS, _MAX_NAME_BYTES = 4096, 4096
_ALIGNMENT = 32
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
_REFUSED_TYPES = {
    9: "Half", 12: "RGBA8", 19: "Index", 20: "OnIndex", 21: "IndexMask", 22: "OnIndexMask",
    23: "PointIndex",
}  # fmt: skip
_CODE_BITS = {"Fp4": 4, "Fp8": 8, "Fp16": 16}


class GridMetadata(NamedTuple):
    """The metadata of a grid, and where it lies in its file."""

    name: str
    type_code: int
    grid_class: int
    codec: str
    size: int  # bytes of the grid
    offset: int  # in the file
    packed_size: int  # bytes in the file


@Format("NanoVDB", ".nvdb", options=("key",))
def open_nanovdb(path: str, key: str | None = None) -> SparseSource:
    """Opens the grid `key` (its name or number); "density" or the first, if left out."""
    grids = _list_grids(path)
    chosen, dropped = choose(path, "grid", [grid.name for grid in grids], key, preferred="density")
    grid = grids[chosen]
    if grid.type_code not in _TYPES:
        type_name = _REFUSED_TYPES.get(grid.type_code, f"type {grid.type_code}")
        raise ValueError(f"{path}: grid {grid.name!r} holds {type_name}, not a grid of numbers")
    _, dtype, width = _TYPES[grid.type_code]
    affine, low, high = _placement(_read_grid(path, grid, _ROOT_OFFSET + 24), grid)
    grid_bytes = grid.size if grid.codec != "none" else 0
    return SparseSource.of(
        *(path, grid.name, _CLASSES.get(grid.grid_class, ""), dtype, width, low, high, affine),
        grid_type=NanoGrid,
        number=chosen,
        held=grid_bytes,
        dropped=dropped,
    )


def _list_grids(path: str) -> list[GridMetadata]:
    """Returns the metadata of all grids of a file."""
    grids: list[GridMetadata] = []
    size = os.stat(path).st_size
    with open(path, "rb") as file:
        while file.tell() < size:
            magic, version, count, _ = struct.unpack("<8sIHH", file.read(16))
            if magic not in _FILE_MAGICS or version >> 21 != _VERSION:
                actual = f"of version {version >> 21}" if magic in _FILE_MAGICS else repr(magic)
                raise ValueError(f"a segment {actual}; expected NanoVDB of version {_VERSION}")
            for grid in [_read_metadata(file) for _ in range(count)]:
                offset = file.tell()
                packed_size = _packed_size(file, grid, size)
                grids.append(grid._replace(offset=offset, packed_size=packed_size))
                if packed_size > (left := size - offset):
                    grid_bytes = f"grid {grid.name!r} takes {packed_size} bytes"
                    raise ValueError(f"{grid_bytes}, the file has {left}")
                file.seek(offset + packed_size)
            if len(grids) > _MAX_GRIDS or not count:
                raise ValueError(f"has {len(grids)} grids; expected 1 to {_MAX_GRIDS}")
    return grids


def _read_metadata(file: Any) -> GridMetadata:
    fields = _METADATA.unpack(file.read(_METADATA.size))
    name_bytes, codec = fields[21], fields[29]
    if not 0 < name_bytes <= _MAX_NAME_BYTES or codec not in _CODECS:
        raise ValueError(f"a grid's head is damaged: a name of {name_bytes} bytes, codec {codec}")
    name = file.read(name_bytes).rstrip(b"\0").decode("utf-8", "replace")
    return GridMetadata(name, fields[4], fields[5], _CODECS[codec], fields[0], 0, fields[1])


def _packed_size(file: Any, grid: GridMetadata, end: int) -> int:
    """Returns the bytes that a grid takes in the file. For packed grids they are counted, because
    some writers state them with the length before each part, some without.
    """
    if grid.codec == "none":
        return grid.packed_size
    count, size = 0, 0
    while size < grid.size:
        (length,) = struct.unpack("<Q", file.read(8))
        if grid.codec == "zlib":
            return 8 + length
        blosc_header = file.read(16)
        if not 16 <= length <= end or (unpacked := int.from_bytes(blosc_header[4:8], "little")) < 1:
            raise ValueError(f"grid {grid.name!r} has a packed part of {length} bytes")
        file.seek(length - 16, os.SEEK_CUR)
        count, size = count + 8 + length, size + unpacked
    return count


def _read_grid(path: str, grid: GridMetadata, min_bytes: int = 0) -> Any:
    """Returns a grid's bytes, mapped or unpacked: all, or at least the first `min_bytes`."""
    with open(path, "rb") as file:
        if grid.codec == "none":
            if grid.size > grid.packed_size or grid.size < _ROOT_OFFSET:
                raise ValueError(f"{grid.size} bytes of a grid expected, {grid.packed_size} found")
            mapped = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
            return mapped[grid.offset : grid.offset + grid.size]
        file.seek(grid.offset)
        parts, size = [], 0
        while size < (min_bytes or grid.size):
            (length,) = struct.unpack("<Q", file.read(8))
            part = file.read(length)
            if grid.codec == "zlib":
                if min_bytes:
                    return zlib.decompressobj().decompress(part, min_bytes)
                return unpack_block("zlib", part, grid.size)
            if min_bytes:
                parts.append(blosc_begin(part, min_bytes - size))
            else:
                unpacked = int.from_bytes(part[4:8], "little")
                parts.append(unpack_block("blosc", part, min(unpacked, grid.size - size)))
            size += len(parts[-1])
        return b"".join(parts)


def _placement(data: Any, grid: GridMetadata) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (4, 4) from voxels to the world, (3,) the first active voxel and (3,) one past the
    last, from the header and the root of a grid.
    """
    if len(data) < _ROOT_OFFSET + 24 or bytes(data[:8]) not in _GRID_MAGICS:
        raise ValueError("a grid does not begin as grids of NanoVDB do")
    (type_code,) = struct.unpack_from("<I", data, _TYPE_OFFSET)
    if type_code != (declared := grid.type_code):
        raise ValueError(f"grid {grid.name!r} is of type {type_code}, its file declares {declared}")
    affine = np.eye(4)
    affine[:3, :3] = np.frombuffer(data, "<f8", 9, 384).reshape(3, 3)
    affine[:3, 3] = np.frombuffer(data, "<f8", 3, 528)
    if struct.unpack_from("<q", data, _TREE_OFFSET + 24)[0] != _ROOT_OFFSET - _TREE_OFFSET:
        raise ValueError("a grid's root does not follow its head")
    box = np.frombuffer(data, "<i4", 6, _ROOT_OFFSET).astype(np.int64)
    return affine, box[:3], box[3:] + 1


class NodeFormat(NamedTuple):
    """The layout of the nodes of grids with one type of values: offsets and sizes in bytes."""

    tiles_start: int  # offset of the tiles in the root
    tile_size: int  # size of a tile
    value_offset: int  # offset of the value in a tile
    entry_size: int  # size of an entry of an upper or lower node
    entries_start: tuple[int, int]  # offset of the entries in an upper, in a lower node
    voxels_start: int  # offset of the voxels in a leaf
    leaf_size: int  # size of a leaf; of FpN: without its codes

    @classmethod
    def of(cls, kind: str, dtype: str, width: int) -> NodeFormat:
        """Computes the layout that a compiler gives to the structs of a type of values: smallest,
        largest (in a root after the background), then mean and deviation.
        """
        item_bytes = np.dtype(dtype).itemsize
        value_bytes = item_bytes * width
        mean_bytes = item_bytes if dtype == "|b1" else 8 if item_bytes == 8 else 4

        def behind(start: int, value_count: int) -> int:
            """Returns the offset behind values, mean and deviation, a multiple of 32 bytes."""
            end = _round_up(start, item_bytes) + value_count * value_bytes
            return _round_up(_round_up(end, mean_bytes) + 2 * mean_bytes, _ALIGNMENT)

        value_offset = _round_up(20, item_bytes)
        coded_bytes = {name: 64 * code_bits for name, code_bits in _CODE_BITS.items()} | {"FpN": 0}
        fixed_bytes = coded_bytes | {"Mask": 0, "bool": 64}
        voxel_bytes = fixed_bytes.get(kind, VOXELS * value_bytes)
        voxels_start = 16 if kind == "Mask" else 96 if kind in coded_bytes else behind(80, 2)
        return cls(
            tiles_start=behind(28, 3),
            tile_size=_round_up(value_offset + value_bytes, _ALIGNMENT),
            value_offset=value_offset,
            entry_size=_round_up(max(value_bytes, 8), 8),
            entries_start=(behind(32 + 2 * 4096, 2), behind(32 + 2 * 512, 2)),
            voxels_start=voxels_start,
            leaf_size=96 if kind == "Mask" else _round_up(voxels_start + voxel_bytes, _ALIGNMENT),
        )


def _round_up(n: int, multiple: int) -> int:
    return -(-n // multiple) * multiple


@dataclass(kw_only=True)
class NanoGrid(SparseGrid):
    """A grid in memory; `node_offsets` are the offsets of the nodes in bytes."""

    layout: NodeFormat

    @classmethod
    def read(cls, path: str, number: int) -> NanoGrid:
        grid = _list_grids(path)[number]
        data, (kind, dtype, width) = _read_grid(path, grid), _TYPES[grid.type_code]
        layout = NodeFormat.of(kind, dtype, width)
        (count,) = struct.unpack_from("<I", data, _ROOT_OFFSET + 24)
        check_roots(count)
        fields = {
            "names": ["key", "child", "value"],
            "formats": ["<u8", "<i8", (dtype, (width,))],
            "offsets": [0, 8, layout.value_offset],
            "itemsize": layout.tile_size,
        }
        root_table = np.ndarray((count,), np.dtype(fields), data, _ROOT_OFFSET + layout.tiles_start)  # type: ignore[call-overload]
        keys = root_table["key"][:, None] >> np.array((42, 21, 0), np.uint64)
        keys[:, 1:] &= np.uint64(2**21 - 1)
        if (keys >> np.uint64(20)).any():
            raise ValueError("a key of the root is not a voxel's position")
        corners = (keys.astype(np.int64) << 44 >> 44) * 4096  # 20 bits, signed
        has_child = root_table["child"] != 0
        child_offsets = _ROOT_OFFSET + root_table["child"][has_child]
        inner = zip(layout.entries_start, COUNTS, strict=False)
        sizes = [*(start + n**3 * layout.entry_size for start, n in inner), layout.leaf_size]
        node_offsets = [_checked_offsets(child_offsets, len(data), sizes[0])]
        origins = [corners[has_child]]
        for level in (0, 1):
            children, firsts = _children(data, layout, level, node_offsets[-1], origins[-1])
            node_offsets.append(_checked_offsets(children, len(data), sizes[level + 1]))
            origins.append(firsts)
        _check_apart(node_offsets, sizes)
        counts = [len(part) for part in node_offsets]
        declared = struct.unpack_from("<3I", data, _COUNTS_OFFSET)
        if counts != [*declared[::-1]]:
            raise ValueError(f"it has {counts[::-1]} nodes, leaves first; it declares {declared}")
        background_start = _ROOT_OFFSET + _round_up(28, np.dtype(dtype).itemsize)
        return cls(
            dtype=np.dtype(dtype),
            background=np.ndarray((width,), dtype, data, background_start),
            origins=(origins[0], origins[1], origins[2]),
            root_origins=corners[~has_child],
            root_values=root_table["value"][~has_child],
            data=data,
            kind=kind,
            layout=layout,
            node_offsets=(node_offsets[0], node_offsets[1], node_offsets[2]),
        )

    def tiles(self, level: int, number: int) -> tuple[np.ndarray, np.ndarray]:
        n, offset = COUNTS[level], int(self.node_offsets[level][number])
        shape, strides = (n**3, len(self.background)), (self.layout.entry_size, self.dtype.itemsize)
        start = offset + self.layout.entries_start[level]
        values = np.ndarray(shape, self.dtype, self.data, start, strides)
        is_child = bits(self.data, offset + 32 + n**3 // 8, n**3)
        return values.reshape(n, n, n, -1), ~is_child.reshape(n, n, n)

    def leaf(self, offset: int) -> np.ndarray:
        start = offset + self.layout.voxels_start
        if self.kind in ("Mask", "bool"):
            return bits(self.data, start, VOXELS)[:, None]
        if self.kind in _CODE_BITS or self.kind == "FpN":
            low, step = np.frombuffer(self.data, "<f4", 2, offset + 80)
            code_bits = _CODE_BITS.get(self.kind) or 1 << (self.data[offset + 15] >> 5)
            return (_codes(self.data, start, code_bits) * step + low)[:, None]
        width = len(self.background)
        return np.frombuffer(self.data, self.dtype, VOXELS * width, start).reshape(VOXELS, width)


def _codes(data: Any, offset: int, code_bits: int) -> np.ndarray:
    """Returns (512,) float32, numbers of `code_bits` bits each, the lowest bits of a byte first."""
    if code_bits > 16:
        raise ValueError(f"a leaf has numbers of {code_bits} bits")
    if code_bits == 16:
        return np.frombuffer(data, "<u2", VOXELS, offset).astype(np.float32)
    packed = np.frombuffer(data, "u1", VOXELS * code_bits // 8, offset)
    shifts = np.arange(0, 8, code_bits, dtype=np.uint8)
    return ((packed[:, None] >> shifts) & (2**code_bits - 1)).reshape(-1).astype(np.float32)


def _children(
    data: Any, layout: NodeFormat, level: int, node_offsets: np.ndarray, origins: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the offsets of the children of nodes, and their first voxels."""
    n, strides = COUNTS[level], (layout.entry_size,)
    offsets, corners = [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
    for offset, origin in zip(node_offsets.tolist(), origins, strict=True):
        is_child = bits(data, offset + 32 + n**3 // 8, n**3)
        steps_start = offset + layout.entries_start[level]
        child_steps = np.ndarray((n**3,), "<i8", data, steps_start, strides)
        positions = np.argwhere(is_child.reshape(n, n, n)) * SIDES[level + 1]
        offsets.append(offset + child_steps[is_child])
        corners.append(origin + positions)
    return np.concatenate(offsets), np.concatenate(corners)


def _checked_offsets(offsets: np.ndarray, size: int, node_bytes: int) -> np.ndarray:
    """Returns offsets of nodes; raises ValueError unless they differ, are aligned and inside."""
    if len(offsets) and not (offsets.min() >= _ROOT_OFFSET and offsets.max() <= size - node_bytes):
        raise ValueError(f"a node lies outside of the grid's {size} bytes")
    if (offsets % _ALIGNMENT).any():
        raise ValueError(f"a node lies at no multiple of {_ALIGNMENT} bytes")
    if len(np.unique(offsets)) != len(offsets):
        raise ValueError("several positions of the tree share a node")
    return offsets


def _check_apart(offsets: Sequence[np.ndarray], sizes: Sequence[int]) -> None:
    """Raises ValueError if nodes overlap; by level: their offsets, and the bytes of one node."""
    start = np.concatenate(offsets)
    order = np.argsort(start)
    end = start + np.repeat(sizes, [len(part) for part in offsets])
    if (end[order][:-1] > start[order][1:]).any():
        raise ValueError("nodes of the tree overlap")
