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
from ..sparse_grid import (
    COUNTS,
    SIDES,
    VOXELS,
    SparseGrid,
    SparseSource,
    bits,
    check_roots,
)
from .format import Format, choose

_MAGIC = 0x56444220
_VERSIONS = range(220, 225)
_MASKED = 222  # first version that packs values by masks and stores the compression of each grid
_MOST_GRIDS, _MOST_TOLD = 4096, 65536
_MOST_NAME, _MOST_TEXT = 4096, 1 << 20  # bytes of a name, of names and types of metadata
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
_TOLD = {"vec3i": "<3i", "int32": "<i", "int64": "<q", "float": "<f", "double": "<d", "bool": "<?"}
# Number of doubles in a transform's map, and the index of its translation and of its scale.
_MAPS = {
    "UniformScaleMap": (15, None, 0),
    "ScaleMap": (15, None, 0),
    "UniformScaleTranslateMap": (18, 0, 3),
    "ScaleTranslateMap": (18, 0, 3),
    "TranslationMap": (3, 0, None),
}


class Cursor:
    """Reads bytes one after another, from offset `at` to `end` or to the end of the data."""

    def __init__(self, data: Any, at: int = 0, end: int | None = None) -> None:
        self.data, self.at = data, at
        self.end = len(data) if end is None else end

    def skip(self, count: int) -> int:
        """Skips `count` bytes; returns the offset at which they begin."""
        begin = self.at
        if count < 0 or begin + count > self.end:
            raise ValueError(f"ends at {self.end}, within {count} bytes from {begin} on")
        self.at = begin + count
        return begin

    def take(self, count: int) -> bytes:
        """Reads bytes."""
        begin = self.skip(count)
        return bytes(self.data[begin : begin + count])

    def numbers(self, layout: str) -> tuple[Any, ...]:
        """Reads numbers in a layout of `struct`."""
        return struct.unpack(layout, self.take(struct.calcsize(layout)))

    def number(self, layout: str) -> Any:
        """Reads a number."""
        return self.numbers(layout)[0]

    def array(self, dtype: Any, count: int) -> np.ndarray:
        """Reads an array."""
        dtype = np.dtype(dtype)
        return np.frombuffer(self.data, dtype, count, self.skip(count * dtype.itemsize))

    def mask(self, count: int) -> np.ndarray:
        """Reads (count,) bool."""
        return bits(self.data, self.skip(count // 8), count)

    def text(self, most: int = _MOST_NAME) -> str:
        """Reads a string."""
        length = self.number("<I")
        if length > most:
            raise ValueError(f"has a name of {length} bytes")
        return self.take(length).decode("utf-8", "replace")

    def told(self) -> dict[str, Any]:
        """Reads metadata; values of unknown types are left out."""
        found: dict[str, Any] = {}
        count = self.number("<I")
        if count > _MOST_TOLD:
            raise ValueError(f"has {count} metadata")
        for _ in range(count):
            name, kind = self.text(_MOST_TEXT), self.text(_MOST_TEXT)
            size = self.number("<I")
            value = self.take(size)
            if kind == "string":
                found[name] = value.decode("utf-8", "replace")
            elif kind in _TOLD and struct.calcsize(_TOLD[kind]) == size:
                numbers = struct.unpack(_TOLD[kind], value)
                found[name] = numbers if len(numbers) > 1 else numbers[0]
        return found


@dataclass
class Entry:
    """The descriptor and the metadata of a grid."""

    unique: str  # its name, with a number if several have the same
    tree: str  # type of its tree
    half: bool
    parent: str  # name of the grid whose tree it shares, or ""
    at: int  # offset at which it begins
    leaves_at: int
    end: int
    compression: int = 0
    told: dict[str, Any] = field(default_factory=dict)
    affine: np.ndarray = field(default_factory=lambda: np.eye(4))
    tree_at: int = 0

    @property
    def name(self) -> str:
        """Its name for users: "density", or "density[1]" for the second of that name."""
        name, _, number = self.unique.partition("\x1e")
        return f"{name}[{number}]" if number not in ("", "0") else name


@Format("OpenVDB", ".vdb", options=("key",))
def open_openvdb(path: str, key: str | None = None) -> SparseSource:
    """Opens the grid `key` (its name or number); "density" or the first, if left out."""
    with _mapped(path) as data:
        version, entries = _entries(data)
        names = [entry.name for entry in entries]
        at, lost = choose(path, "grid", names, key, preferred="density")
        entry = entries[at]
        number = at  # index of the grid that has the tree
        if entry.parent:
            owners = [n for n, other in enumerate(entries) if other.unique == entry.parent]
            if not owners or entries[owners[0]].parent:
                raise ValueError(f"grid {entry.name!r} shares the tree of {entry.parent!r}, "
                                 "which is not there")  # fmt: skip
            number = owners[0]
            if _kind(entries[number]) != _kind(entry):
                raise ValueError(f"grid {entry.name!r} is a {entry.tree}, the tree that it shares "
                                 f"is a {entries[number].tree}")  # fmt: skip
        _read_head(data, entry, version)
    kind = _kind(entry)
    dtype, width = _TYPES[kind]
    told = entry.told.get("file_bbox_min"), entry.told.get("file_bbox_max")
    if all(isinstance(one, tuple) for one in told):
        low, high = np.array(told[0]), np.array(told[1]) + 1
    else:
        low, high = VdbGrid.read(path, number).box()
    grid_class = str(entry.told.get("class", ""))
    return SparseSource.of(
        *(path, entry.name, grid_class, dtype, width, low, high, entry.affine),
        grid_type=VdbGrid,
        number=number,
        lost=lost,
    )


def _mapped(path: str) -> mmap.mmap:
    with open(path, "rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _kind(entry: Entry) -> str:
    """Returns the type of a grid's values."""
    found = re.fullmatch(r"Tree_(\w+?)_5_4_3", entry.tree)
    if found is None or found[1] not in _TYPES:
        raise ValueError(
            f"grid {entry.name!r} is a {entry.tree}; known are trees 5_4_3 of {', '.join(_TYPES)}"
        )
    return found[1]


def _entries(data: Any) -> tuple[int, list[Entry]]:
    """Returns the version of a file, and the descriptors of its grids."""
    cursor = Cursor(data)
    magic, version = cursor.numbers("<qI")
    if magic != _MAGIC:
        raise ValueError("does not start like a VDB file")
    if version not in _VERSIONS:
        raise ValueError(
            f"is of file version {version}; {_VERSIONS[0]} to {_VERSIONS[-1]} are known"
        )
    cursor.skip(8)  # version of the library
    with_places = cursor.number("<?")
    packed = cursor.number("<?") if version < _MASKED else False
    cursor.skip(36)  # uuid
    cursor.told()
    count = cursor.number("<i")
    if not with_places:
        raise ValueError("is a stream without the positions of its grids; write it as a file")
    if not 0 <= count <= _MOST_GRIDS:
        raise ValueError(f"has {count} grids")
    entries = []
    for _ in range(count):
        unique, tree, parent = cursor.text(), cursor.text(), cursor.text()
        at, leaves_at, end = cursor.numbers("<3q")
        begin = cursor.at
        ordered = at <= end if parent else at <= leaves_at <= end  # with a shared tree, no leaves
        if not (begin <= at and ordered and end <= len(data)):
            raise ValueError(
                f"a grid from {at} to {end}, its leaves at {leaves_at}, in a file of {len(data)} "
                f"bytes; expected in this order, from {begin} on"
            )
        half = tree.endswith("_HalfFloat")
        entry = Entry(unique, tree.removesuffix("_HalfFloat"), half, parent, at, leaves_at, end)
        entry.compression = _ZIP if packed else 0
        entries.append(entry)
        cursor.at = end  # the descriptor of the next grid
    return version, entries


def _read_head(data: Any, entry: Entry, version: int) -> None:
    """Reads what precedes a grid's tree into `entry`: compression, metadata, transform."""
    cursor = Cursor(data, entry.at, entry.end)
    if version >= _MASKED:
        entry.compression = cursor.number("<I")
    entry.told = cursor.told()
    kind = cursor.text()
    if kind in _MAPS:
        count, translation, scale = _MAPS[kind]
        numbers = cursor.array("<f8", count)
        if translation is not None:
            entry.affine[:3, 3] = numbers[translation : translation + 3]
        if scale is not None:
            entry.affine[[0, 1, 2], [0, 1, 2]] = numbers[scale : scale + 3]
    elif kind in ("AffineMap", "UnitaryMap"):
        entry.affine = cursor.array("<f8", 16).reshape(4, 4).T.copy()  # the file's is for rows
    else:
        raise ValueError(f"grid {entry.name!r} is placed in the world by an unknown {kind}")
    entry.tree_at = cursor.at


@dataclass(frozen=True)
class _Packing:
    """How the values of a grid's nodes are stored.

    A byte says what inactive values are; with `_ACTIVE`, only the active ones are stored after it.
    0: the background; 1: minus the background; 2: a number, which is stored; 3: minus the
    background or the background; 4: a stored number or the background; 5: one of two stored
    numbers; of 3 to 5 a mask says which of the two; 6: all values are stored.
    """

    stored: np.dtype  # of the values in the file
    dtype: np.dtype
    width: int
    background: np.ndarray
    compression: int
    masked: bool  # version 222 or later

    def skip(self, cursor: Cursor, active: int, count: int) -> None:
        """Skips the `count` values of a node, of which `active` are active."""
        if self.masked:
            code = cursor.number("<B")
            told = {2: 1, 4: 1, 5: 2}.get(code, 0)
            cursor.skip(told * self.dtype.itemsize * self.width)
            cursor.skip(count // 8 if code in (3, 4, 5) else 0)
            count = self._written(code, active, count)
        size = count * self.stored.itemsize * self.width
        cursor.skip(abs(cursor.number("<q")) if self.compression & (_ZIP | _BLOSC) else size)

    def values(self, cursor: Cursor, active: np.ndarray) -> np.ndarray:
        """Reads the values of a node, (n, c); `active`, (n,) bool, says which are active."""
        if not self.masked:
            return self._read(cursor, len(active))
        code = cursor.number("<B")
        one = self.background
        zero = one if code == 0 else ~one if self.dtype.kind == "b" else -one
        if code in (2, 4, 5):
            zero = cursor.array(self.dtype, self.width)
        if code == 5:
            one = cursor.array(self.dtype, self.width)
        chosen = np.zeros(len(active), bool)
        if code in (3, 4, 5):
            chosen = cursor.mask(len(active))
        written = self._written(code, int(np.count_nonzero(active)), len(active))
        values = self._read(cursor, written)
        if written == len(active):
            return values
        out = np.where(chosen[:, None], one, zero)
        out[active] = values
        return out

    def _written(self, code: int, active: int, count: int) -> int:
        if code > 6:
            raise ValueError(f"a node's values are packed by an unknown method ({code})")
        return active if self.compression & _ACTIVE and code != 6 else count

    def _read(self, cursor: Cursor, count: int) -> np.ndarray:
        """Reads numbers that may be packed."""
        count *= self.width
        size = int(count) * self.stored.itemsize
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
        values = np.frombuffer(content, self.stored).astype(self.dtype, copy=False)
        return values.reshape(-1, self.width)


@dataclass(kw_only=True)
class VdbGrid(SparseGrid):
    """A grid of a file; `places` are the offsets of the masks of each node."""

    packing: _Packing

    @classmethod
    def read(cls, path: str, number: int) -> VdbGrid:
        data = _mapped(path)
        version, entries = _entries(data)
        entry = entries[number]
        _read_head(data, entry, version)
        kind = _kind(entry)
        name, width = _TYPES[kind]
        dtype = np.dtype(name)
        cursor = Cursor(data, entry.tree_at, entry.end)
        if (buffers := cursor.number("<I")) != 1:
            raise ValueError(f"grid {entry.name!r} has {buffers} buffers; expected 1")
        background = cursor.array(dtype, width)
        stored = np.dtype("<f2") if entry.half and dtype.kind == "f" else dtype
        compression = entry.compression
        packing = _Packing(stored, dtype, width, background, compression, version >= _MASKED)
        topology = _Topology(cursor, packing).read(kind, entry.leaves_at)
        return cls(
            dtype=dtype,
            background=background,
            data=data,
            kind=kind,
            packing=packing,
            **topology,
        )

    def tiles(self, level: int, number: int) -> tuple[np.ndarray, np.ndarray]:
        n = COUNTS[level]
        cursor = Cursor(self.data, int(self.places[level][number]))
        is_child, active = (cursor.mask(n**3) for _ in range(2))
        if self.packing.masked:
            values = self.packing.values(cursor, active)
        else:  # only the values of tiles are stored
            values = np.zeros((n**3, self.packing.width), self.dtype)
            values[~is_child] = self.packing.values(cursor, active[~is_child])
        return values.reshape(n, n, n, -1), ~is_child.reshape(n, n, n)

    def leaves(self, numbers: np.ndarray) -> np.ndarray:
        out = np.empty((len(numbers), VOXELS, self.packing.width), self.dtype)
        for at, place in enumerate(self.places[2][numbers].tolist()):
            cursor = Cursor(self.data, place)
            active = cursor.mask(VOXELS)
            if self.kind == "mask":
                out[at, :, 0] = active
            elif self.kind == "bool":
                cursor.skip(12)
                out[at, :, 0] = cursor.mask(VOXELS)
            else:
                cursor.skip(0 if self.packing.masked else 13)
                out[at] = self.packing.values(cursor, active)
        return out


class _Topology:
    """Finds the nodes of a tree; `cursor` is at its root."""

    def __init__(self, cursor: Cursor, packing: _Packing) -> None:
        self.cursor, self.packing = cursor, packing
        self.origins: tuple[list[Any], ...] = ([], [], [])
        self.places: tuple[list[Any], ...] = ([], [], [])

    def read(self, kind: str, leaves_at: int) -> dict[str, Any]:
        """Returns `origins`, `places`, `root_places` and `root_values` of a `VdbGrid`; raises
        ValueError if the leaves do not begin at `leaves_at`, behind the other nodes.
        """
        cursor, packing = self.cursor, self.packing
        tiles, children = cursor.numbers("<2I")
        check_roots(tiles + children)
        value = (packing.dtype, (packing.width,))
        table = cursor.array([("place", "<i4", (3,)), ("value", *value), ("on", "u1")], tiles)
        for _ in range(children):
            self._node(0, np.array(cursor.numbers("<3i"), np.int64))
        counts, none = self.places[2], np.zeros((0, 3), np.int64)
        active = np.concatenate(counts) if counts else none[:, 0]
        if cursor.at != leaves_at:
            raise ValueError(f"leaves begin at {leaves_at}, the nodes above end at {cursor.at}")
        places = self._leaves(kind, active.tolist())
        return {
            "origins": tuple(np.concatenate([none, *part]) for part in self.origins),
            "places": (
                np.array(self.places[0], np.int64),
                np.array(self.places[1], np.int64),
                places,
            ),
            "root_places": table["place"].astype(np.int64),
            "root_values": table["value"],
        }

    def _node(self, level: int, origin: np.ndarray) -> None:
        """Visits a node and all below it."""
        cursor, n = self.cursor, COUNTS[level]
        self.origins[level].append(origin[None])
        self.places[level].append(cursor.at)
        is_child, active = (cursor.mask(n**3) for _ in range(2))
        which = np.flatnonzero(is_child)
        written = n**3 if self.packing.masked else n**3 - len(which)
        self.packing.skip(cursor, int(np.count_nonzero(active)), written)
        corners = origin + np.stack(np.unravel_index(which, (n, n, n)), 1) * SIDES[level + 1]
        if level == 0:
            for corner in corners:
                self._node(1, corner)
            return
        masks = cursor.array("u1", len(which) * VOXELS // 8).reshape(-1, VOXELS // 8)
        self.origins[2].append(corners)
        self.places[2].append(np.unpackbits(masks, axis=1).sum(1, dtype=np.int64))

    def _leaves(self, kind: str, active: list[int]) -> np.ndarray:
        """Returns the offset of each leaf; `active` has the count of active voxels of each."""
        cursor, places = self.cursor, np.empty(len(active), np.int64)
        for number, count in enumerate(active):
            places[number] = cursor.skip(VOXELS // 8)
            if kind == "mask":
                cursor.skip(12)
            elif kind == "bool":
                cursor.skip(12 + VOXELS // 8)
            elif self.packing.masked:
                self.packing.skip(cursor, count, VOXELS)
            else:
                cursor.skip(12)
                if (buffers := cursor.number("<b")) != 1:
                    raise ValueError(f"a leaf has {buffers} buffers; expected 1")
                self.packing.skip(cursor, count, VOXELS)
        return places
