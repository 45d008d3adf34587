"""OpenVDB (`.vdb`, file versions 220 to 224): trees 5-4-3 of numbers, vectors and masks.

A file is a header, then for each grid a descriptor with its offsets, and the grid: metadata,
transform, topology (masks, and the tiles of inner nodes), then the values of the leaves one after
another. `_Topology` visits all nodes once and records where each begins; their values are unpacked
on demand. Inactive values other than the background are stored in a few bytes, see `_Packing`.
Source: the source code of OpenVDB (io/Archive.cc, io/Compression.h, tree/*.h).
"""

from __future__ import annotations

import mmap
import re
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..packed import unpack_block
from ..sparse_grid import COUNTS, SIDES, VOXELS, SparseGrid, SparseSource, bits, check_roots
from .format import Format, choose

_MAGIC = 0x56444220
_VERSIONS = range(220, 225)
_MASKED_VERSION = 222  # first that packs values by masks and stores each grid's compression
_MAX_GRIDS, _MAX_METADATA = 4096, 65536
_MAX_NAME_BYTES, _MAX_TEXT_BYTES = 4096, 1 << 20  # of a name, of names and types of metadata
_ZIP, _ACTIVE, _BLOSC = 1, 2, 4
_TYPES: dict[str, tuple[str, int]] = {
    "float": ("<f4", 1),
    "double": ("<f8", 1),
    "int32": ("<i4", 1),
    "int64": ("<i8", 1),
    "bool": ("|b1", 1),
    "mask": ("|b1", 1),
    "vec3s": ("<f4", 3),
    "vec3d": ("<f8", 3),
    "vec3i": ("<i4", 3),
}
# Number of doubles in a transform's map, and the index of its translation and of its scale.
_MAPS = {
    "UniformScaleMap": (15, None, 0),
    "ScaleMap": (15, None, 0),
    "UniformScaleTranslateMap": (18, 0, 3),
    "ScaleTranslateMap": (18, 0, 3),
    "TranslationMap": (3, 0, None),
}


class Cursor:
    """Reads bytes one after another, from `offset` to `end` or to the end of the data."""

    def __init__(self, data: Any, offset: int = 0, end: int | None = None) -> None:
        self.data, self.offset = data, offset
        self.end = len(data) if end is None else end

    def skip(self, count: int) -> int:
        """Skips `count` bytes; returns the offset at which they begin."""
        start = self.offset
        if count < 0 or start + count > self.end:
            raise ValueError(f"ends at {self.end}, within {count} bytes from {start} on")
        self.offset = start + count
        return start

    def take(self, count: int) -> bytes:
        start = self.skip(count)
        return bytes(self.data[start : start + count])

    def numbers(self, layout: str) -> tuple[Any, ...]:
        """Reads numbers in a layout of `struct`."""
        return struct.unpack(layout, self.take(struct.calcsize(layout)))

    def number(self, layout: str) -> Any:
        return self.numbers(layout)[0]

    def array(self, dtype: Any, count: int) -> np.ndarray:
        dtype = np.dtype(dtype)
        return np.frombuffer(self.data, dtype, count, self.skip(count * dtype.itemsize))

    def mask(self, count: int) -> np.ndarray:
        """Reads (count,) bool."""
        return bits(self.data, self.skip(count // 8), count)

    def text(self, max_bytes: int = _MAX_NAME_BYTES) -> str:
        length = self.number("<I")
        if length > max_bytes:
            raise ValueError(f"has a name of {length} bytes")
        return self.take(length).decode("utf-8", "replace")

    def metadata(self) -> dict[str, Any]:
        """Reads metadata; only strings and boxes' corners are kept."""
        metadata: dict[str, Any] = {}
        count = self.number("<I")
        if count > _MAX_METADATA:
            raise ValueError(f"has {count} metadata")
        for _ in range(count):
            name, kind = self.text(_MAX_TEXT_BYTES), self.text(_MAX_TEXT_BYTES)
            size = self.number("<I")
            value = self.take(size)
            if kind == "string":
                metadata[name] = value.decode("utf-8", "replace")
            elif kind == "vec3i" and size == 12:
                metadata[name] = struct.unpack("<3i", value)
        return metadata


@dataclass
class GridDescriptor:
    """The descriptor and the metadata of a grid."""

    unique_name: str  # its name, with a number if several have the same
    tree_type: str
    is_half: bool
    parent: str  # name of the grid whose tree it shares, or ""
    start: int  # offset in the file
    leaves_start: int
    end: int
    compression: int = 0
    metadata: dict[str, Any] = field(default_factory=dict)
    affine: np.ndarray = field(default_factory=lambda: np.eye(4))
    tree_start: int = 0

    @property
    def name(self) -> str:
        """Its name for users: "density", or "density[1]" for the second of that name."""
        name, _, number = self.unique_name.partition("\x1e")
        return f"{name}[{number}]" if number not in ("", "0") else name


@Format("OpenVDB", ".vdb", options=("key",))
def open_openvdb(path: str, key: str | None = None) -> SparseSource:
    """Opens the grid `key` (its name or number); "density" or the first, if left out."""
    with _map_file(path) as data:
        version, grids = _read_descriptors(data)
        names = [grid.name for grid in grids]
        chosen, dropped = choose(path, "grid", names, key, preferred="density")
        grid = grids[chosen]
        tree_number = chosen  # index of the grid that has the tree
        if grid.parent:
            owners = [n for n, other in enumerate(grids) if other.unique_name == grid.parent]
            if not owners or grids[owners[0]].parent:
                raise ValueError(f"grid {grid.name!r} shares the tree of {grid.parent!r}, "
                                 "which is not there")  # fmt: skip
            tree_number = owners[0]
            if _kind(grids[tree_number]) != _kind(grid):
                raise ValueError(f"grid {grid.name!r} is a {grid.tree_type}, the tree that it "
                                 f"shares is a {grids[tree_number].tree_type}")  # fmt: skip
        _read_grid_header(data, grid, version)
    kind = _kind(grid)
    dtype, width = _TYPES[kind]
    corners = grid.metadata.get("file_bbox_min"), grid.metadata.get("file_bbox_max")
    if all(isinstance(corner, tuple) for corner in corners):
        low, high = np.array(corners[0]), np.array(corners[1]) + 1
    else:
        low, high = VdbGrid.read(path, tree_number).box()
    grid_class = str(grid.metadata.get("class", ""))
    return SparseSource.of(
        *(path, grid.name, grid_class, dtype, width, low, high, grid.affine),
        grid_type=VdbGrid,
        number=tree_number,
        dropped=dropped,
    )


def _map_file(path: str) -> mmap.mmap:
    with open(path, "rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _kind(grid: GridDescriptor) -> str:
    """Returns the type of a grid's values."""
    match = re.fullmatch(r"Tree_(\w+?)_5_4_3", grid.tree_type)
    if match is None or match[1] not in _TYPES:
        known = f"known are trees 5_4_3 of {', '.join(_TYPES)}"
        raise ValueError(f"grid {grid.name!r} is a {grid.tree_type}; {known}")
    return match[1]


def _read_descriptors(data: Any) -> tuple[int, list[GridDescriptor]]:
    """Returns the version of a file, and the descriptors of its grids."""
    cursor = Cursor(data)
    magic, version = cursor.numbers("<qI")
    if magic != _MAGIC:
        raise ValueError("does not start like a VDB file")
    if version not in _VERSIONS:
        raise ValueError(f"is of file version {version}; known: {_VERSIONS[0]} to {_VERSIONS[-1]}")
    cursor.skip(8)  # version of the library
    has_offsets = cursor.number("<?")
    is_zipped = cursor.number("<?") if version < _MASKED_VERSION else False
    cursor.skip(36)  # uuid
    cursor.metadata()
    count = cursor.number("<i")
    if not has_offsets:
        raise ValueError("is a stream without the positions of its grids; write it as a file")
    if not 0 <= count <= _MAX_GRIDS:
        raise ValueError(f"has {count} grids")
    grids = []
    for _ in range(count):
        unique, tree, parent = cursor.text(), cursor.text(), cursor.text()
        start, leaves_start, end = cursor.numbers("<3q")
        descriptor_end = cursor.offset
        # A grid with a shared tree has no leaves.
        is_ordered = start <= end if parent else start <= leaves_start <= end
        if not (descriptor_end <= start and is_ordered and end <= len(data)):
            raise ValueError(
                f"a grid from {start} to {end}, its leaves at {leaves_start}, in a file of "
                f"{len(data)} bytes; expected in this order, from {descriptor_end} on"
            )
        kind, is_half = tree.removesuffix("_HalfFloat"), tree.endswith("_HalfFloat")
        grid = GridDescriptor(unique, kind, is_half, parent, start, leaves_start, end)
        grid.compression = _ZIP if is_zipped else 0
        grids.append(grid)
        cursor.offset = end  # the descriptor of the next grid
    return version, grids


def _read_grid_header(data: Any, grid: GridDescriptor, version: int) -> None:
    """Reads what precedes a grid's tree into `grid`: compression, metadata, transform."""
    cursor = Cursor(data, grid.start, grid.end)
    if version >= _MASKED_VERSION:
        grid.compression = cursor.number("<I")
    grid.metadata = cursor.metadata()
    map_type = cursor.text()
    if map_type in _MAPS:
        count, translation, scale = _MAPS[map_type]
        numbers = cursor.array("<f8", count)
        if translation is not None:
            grid.affine[:3, 3] = numbers[translation : translation + 3]
        if scale is not None:
            grid.affine[[0, 1, 2], [0, 1, 2]] = numbers[scale : scale + 3]
    elif map_type in ("AffineMap", "UnitaryMap"):
        grid.affine = cursor.array("<f8", 16).reshape(4, 4).T.copy()  # the file's is for rows
    else:
        raise ValueError(f"grid {grid.name!r} is placed in the world by an unknown {map_type}")
    grid.tree_start = cursor.offset


@dataclass(frozen=True)
class _Packing:
    """How the values of a grid's nodes are stored.

    A byte says what inactive values are; with `_ACTIVE`, only the active ones are stored after it.
    0: the background; 1: minus the background; 2: a number, which is stored; 3: minus the
    background or the background; 4: a stored number or the background; 5: one of two stored
    numbers; of 3 to 5 a mask says which of the two; 6: all values are stored.
    """

    stored_dtype: np.dtype  # of the values in the file
    dtype: np.dtype
    width: int
    background: np.ndarray
    compression: int
    has_masks: bool  # version 222 or later

    def skip(self, cursor: Cursor, active_count: int, count: int) -> None:
        """Skips the `count` values of a node, of which `active_count` are active."""
        if self.has_masks:
            code = cursor.number("<B")
            inactive_count = {2: 1, 4: 1, 5: 2}.get(code, 0)
            cursor.skip(inactive_count * self.dtype.itemsize * self.width)
            cursor.skip(count // 8 if code in (3, 4, 5) else 0)
            count = self._stored_count(code, active_count, count)
        size = count * self.stored_dtype.itemsize * self.width
        cursor.skip(abs(cursor.number("<q")) if self.compression & (_ZIP | _BLOSC) else size)

    def values(self, cursor: Cursor, active: np.ndarray) -> np.ndarray:
        """Reads the values of a node, (n, c); `active`, (n,) bool, says which are active."""
        if not self.has_masks:
            return self._read(cursor, len(active))
        code = cursor.number("<B")
        inactive_0 = inactive_1 = self.background
        if code != 0:
            inactive_0 = ~inactive_1 if self.dtype.kind == "b" else -inactive_1
        if code in (2, 4, 5):
            inactive_0 = cursor.array(self.dtype, self.width)
        if code == 5:
            inactive_1 = cursor.array(self.dtype, self.width)
        selection = np.zeros(len(active), bool)
        if code in (3, 4, 5):
            selection = cursor.mask(len(active))
        stored_count = self._stored_count(code, int(np.count_nonzero(active)), len(active))
        values = self._read(cursor, stored_count)
        if stored_count == len(active):
            return values
        out = np.where(selection[:, None], inactive_1, inactive_0)
        out[active] = values
        return out

    def _stored_count(self, code: int, active_count: int, count: int) -> int:
        if code > 6:
            raise ValueError(f"a node's values are packed by an unknown method ({code})")
        return active_count if self.compression & _ACTIVE and code != 6 else count

    def _read(self, cursor: Cursor, count: int) -> np.ndarray:
        """Reads numbers that may be packed."""
        count *= self.width
        size = int(count) * self.stored_dtype.itemsize
        if self.compression & (_ZIP | _BLOSC):
            length = cursor.number("<q")
            content = cursor.take(abs(length))
            if length > 0:
                codec = "blosc" if self.compression & _BLOSC else "zlib"
                content = unpack_block(codec, content, size)
        else:
            content = cursor.take(size)
        if len(content) != size:
            raise ValueError(f"{size} bytes of values expected, {len(content)} found")
        values = np.frombuffer(content, self.stored_dtype).astype(self.dtype, copy=False)
        return values.reshape(-1, self.width)


@dataclass(kw_only=True)
class VdbGrid(SparseGrid):
    """A grid of a file; `node_offsets` are the offsets of the masks of each node."""

    packing: _Packing

    @classmethod
    def read(cls, path: str, number: int) -> VdbGrid:
        data = _map_file(path)
        version, grids = _read_descriptors(data)
        grid = grids[number]
        _read_grid_header(data, grid, version)
        kind = _kind(grid)
        dtype_name, width = _TYPES[kind]
        dtype = np.dtype(dtype_name)
        cursor = Cursor(data, grid.tree_start, grid.end)
        if (buffers := cursor.number("<I")) != 1:
            raise ValueError(f"grid {grid.name!r} has {buffers} buffers; expected 1")
        background = cursor.array(dtype, width)
        stored, has_masks = dtype, version >= _MASKED_VERSION
        if grid.is_half and dtype.kind == "f":
            stored = np.dtype("<f2")
        packing = _Packing(stored, dtype, width, background, grid.compression, has_masks)
        fields = _Topology(cursor, packing).read(kind, grid.leaves_start)
        fields |= {"dtype": dtype, "background": background, "kind": kind, "packing": packing}
        return cls(data=data, **fields)

    def tiles(self, level: int, number: int) -> tuple[np.ndarray, np.ndarray]:
        n = COUNTS[level]
        cursor = Cursor(self.data, int(self.node_offsets[level][number]))
        is_child, active = (cursor.mask(n**3) for _ in range(2))
        if self.packing.has_masks:
            values = self.packing.values(cursor, active)
        else:  # only the values of tiles are stored
            values = np.zeros((n**3, self.packing.width), self.dtype)
            values[~is_child] = self.packing.values(cursor, active[~is_child])
        return values.reshape(n, n, n, -1), ~is_child.reshape(n, n, n)

    def leaf(self, offset: int) -> np.ndarray:
        cursor = Cursor(self.data, offset)
        active = cursor.mask(VOXELS)
        if self.kind == "mask":
            return active[:, None]
        if self.kind == "bool":
            cursor.skip(12)
            return cursor.mask(VOXELS)[:, None]
        cursor.skip(0 if self.packing.has_masks else 13)
        return self.packing.values(cursor, active)


class _Topology:
    """Finds the nodes of a tree; `cursor` is at its root."""

    def __init__(self, cursor: Cursor, packing: _Packing) -> None:
        self.cursor, self.packing = cursor, packing
        self.origins: tuple[list[Any], ...] = ([], [], [])
        self.inner_offsets: tuple[list[int], list[int]] = ([], [])  # of upper and lower nodes
        self.leaf_active_counts: list[np.ndarray] = []  # active voxels of the leaves of each node

    def read(self, kind: str, leaves_start: int) -> dict[str, Any]:
        """Returns `origins`, `node_offsets`, `root_origins` and `root_values` of a `VdbGrid`.

        Raises:
            ValueError: The leaves do not begin at `leaves_start`, behind the other nodes.
        """
        cursor, packing = self.cursor, self.packing
        tiles, children = cursor.numbers("<2I")
        check_roots(tiles + children)
        value = (packing.dtype, (packing.width,))
        table = cursor.array([("origin", "<i4", (3,)), ("value", *value), ("on", "u1")], tiles)
        for _ in range(children):
            self._node(0, np.array(cursor.numbers("<3i"), np.int64))
        none = np.zeros((0, 3), np.int64)
        active_counts = np.concatenate([none[:, 0], *self.leaf_active_counts])
        if (end := cursor.offset) != leaves_start:
            raise ValueError(f"leaves begin at {leaves_start}, the nodes above end at {end}")
        uppers, lowers = (np.array(part, np.int64) for part in self.inner_offsets)
        leaves = self._leaves(kind, active_counts.tolist())
        return {
            "origins": tuple(np.concatenate([none, *part]) for part in self.origins),
            "node_offsets": (uppers, lowers, leaves),
            "root_origins": table["origin"].astype(np.int64),
            "root_values": table["value"],
        }

    def _node(self, level: int, origin: np.ndarray) -> None:
        """Visits a node and all below it."""
        cursor, n = self.cursor, COUNTS[level]
        self.origins[level].append(origin[None])
        self.inner_offsets[level].append(cursor.offset)
        is_child, active = (cursor.mask(n**3) for _ in range(2))
        child_entries = np.flatnonzero(is_child)
        value_count = n**3 if self.packing.has_masks else n**3 - len(child_entries)
        self.packing.skip(cursor, int(np.count_nonzero(active)), value_count)
        corners = origin + np.argwhere(is_child.reshape(n, n, n)) * SIDES[level + 1]
        if level == 0:
            for corner in corners:
                self._node(1, corner)
            return
        masks = cursor.array("u1", len(child_entries) * VOXELS // 8).reshape(-1, VOXELS // 8)
        self.origins[2].append(corners)
        self.leaf_active_counts.append(np.unpackbits(masks, axis=1).sum(1, dtype=np.int64))

    def _leaves(self, kind: str, active_counts: list[int]) -> np.ndarray:
        """Returns the offset of each leaf; `active_counts` are the active voxels of each."""
        cursor, offsets = self.cursor, np.empty(len(active_counts), np.int64)
        for number, count in enumerate(active_counts):
            offsets[number] = cursor.skip(VOXELS // 8)
            if kind in ("mask", "bool") or not self.packing.has_masks:
                cursor.skip(12)
            if kind == "bool":
                cursor.skip(VOXELS // 8)
            elif kind != "mask":
                if not self.packing.has_masks and (buffers := cursor.number("<b")) != 1:
                    raise ValueError(f"a leaf has {buffers} buffers; expected 1")
                self.packing.skip(cursor, count, VOXELS)
        return offsets
