"""Sparse grids with the tree of VDB, read box by box without a dense copy of the whole.

The tree is a root, upper nodes of 32^3 entries, lower nodes of 16^3 and leaves of 8^3 voxels: 4096,
128 and 8 voxels a side. An entry without a child is a tile, one value for all of its voxels; voxels
that no node covers have the background value. `SparseGrid` fills boxes from nodes in any format;
`SparseSource` is a grid as a volume: the box of its active voxels.

Source: Museth, "VDB: High-resolution sparse volumes with dynamic topology", ACM TOG 2013.
"""

from __future__ import annotations

import functools
import math
import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ..base import boxes
from ..base.image_info import SIGNED_DISTANCE, ChannelInfo, ImageInfo
from .source import Index, VolumeSource, place_axes

SIDES = (4096, 128, 8)  # voxels along a side of an upper node, a lower node and a leaf
COUNTS = (32, 16, 8)  # entries along a side of each
VOXELS = 512  # of a leaf
MAX_INDEX = 2**31
MAX_ROOTS = 1 << 20  # entries of a root
_BATCH_LEAVES = 4096
# Voxels of the whole leaves around a thin box, above which it is filled in pieces.
_MAX_PADDED_VOXELS = 1 << 22
_LOCK = threading.Lock()
_QUANTITIES = {"level set": SIGNED_DISTANCE, "fog volume": "density"}


@dataclass(kw_only=True)
class SparseGrid(ABC):
    """The nodes of a grid; all positions except `node_offsets` are voxel indices i, j, k."""

    data: Any  # the bytes that hold the nodes
    kind: str  # type of the values, as the format calls it
    # (n,) The offset in `data` of each node of `origins`.
    node_offsets: tuple[np.ndarray, np.ndarray, np.ndarray]
    dtype: np.dtype
    background: np.ndarray  # (c,)
    origins: tuple[np.ndarray, np.ndarray, np.ndarray]  # (n, 3) int64 of uppers, lowers and leaves
    root_origins: np.ndarray  # (t, 3) int64 of the root's tiles
    root_values: np.ndarray  # (t, c)

    def __post_init__(self) -> None:
        origins = np.concatenate((self.root_origins, self.origins[0]))
        misaligned = origins[(origins % SIDES[0]).any(1)]
        if len(misaligned):
            raise ValueError(
                f"an entry of the root lies at {misaligned[0].tolist()}; expected multiples of "
                f"{SIDES[0]}"
            )
        cells = origins // SIDES[0] + (1 << 20)
        if len(np.unique(cells @ np.array((1 << 42, 1 << 21, 1)))) < len(cells):
            raise ValueError("two entries of the root have one position")

    @classmethod
    @abstractmethod
    def read(cls, path: str, number: int) -> Self:
        """Finds the nodes of a file's grid."""

    @abstractmethod
    def tiles(self, level: int, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns (n, n, n, c) values of an upper (0) or lower (1) node's entries, and (n, n, n)
        bool, whether each is a tile.
        """

    @abstractmethod
    def leaf(self, offset: int) -> np.ndarray:
        """Returns (512, c) the voxels of the leaf at an offset in `data`."""

    def fill(self, low: ArrayLike, high: ArrayLike) -> np.ndarray:
        """Returns (i, j, k, c) values of a box."""
        leaf, a, b = SIDES[2], np.asarray(low), np.asarray(high)
        start, stop = a // leaf * leaf, -(-b // leaf) * leaf  # whole leaves
        padded_voxels, axis = math.prod((stop - start).tolist()), int((b - a).argmax())
        if padded_voxels > max(_MAX_PADDED_VOXELS, 2 * math.prod((b - a).tolist())):
            out = np.empty((*(b - a), len(self.background)), self.dtype)
            section_voxels = padded_voxels // int((stop - start)[axis])
            step = max(leaf, _MAX_PADDED_VOXELS // section_voxels // leaf * leaf)
            for edge in range(int(start[axis]), int(b[axis]), step):  # in pieces along that axis
                part_low, part_high = a.copy(), b.copy()
                part_low[axis], part_high[axis] = max(edge, a[axis]), min(edge + step, b[axis])
                out[boxes.index(part_low - a, part_high - a)] = self.fill(part_low, part_high)
            return out
        out = np.empty((*(stop - start), len(self.background)), self.dtype)
        out[:] = self.background
        tiles = self._overlapping(self.root_origins, SIDES[0], start, stop)
        self._write_tiles(out, start, SIDES[0], self.root_origins[tiles], self.root_values[tiles])
        for level in (0, 1):
            for number in self._overlapping(self.origins[level], SIDES[level], start, stop):
                origins, values = self._visible_tiles(level, number, start, stop)
                self._write_tiles(out, start, SIDES[level + 1], origins, values)
        hits = self._overlapping(self.origins[2], leaf, start, stop)
        blocks = _blocks(out)
        for first in range(0, len(hits), _BATCH_LEAVES):
            numbers = hits[first : first + _BATCH_LEAVES]
            i, j, k = ((self.origins[2][numbers] - start) // leaf).T
            leaves = np.empty((len(numbers), VOXELS, out.shape[3]), self.dtype)
            for row, offset in enumerate(self.node_offsets[2][numbers].tolist()):
                leaves[row] = self.leaf(offset)
            blocks[i, :, j, :, k] = leaves.reshape(-1, 8, 8, 8, out.shape[3])
        return out[boxes.index(a - start, b - start)]

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns (3,) the lowest voxel and (3,) one past the highest voxel of all leaves and all
        tiles that differ from the background.
        """
        low, high = [self.origins[2]], [self.origins[2] + SIDES[2]]
        everywhere = np.array((-MAX_INDEX,) * 3), np.array((MAX_INDEX,) * 3)
        tile_groups = [(SIDES[0], self.root_origins[self._is_foreground(self.root_values)])]
        for level in (0, 1):
            for number in range(len(self.origins[level])):
                tiles, _ = self._visible_tiles(level, number, *everywhere)
                tile_groups.append((SIDES[level + 1], tiles))
        for side, origins in tile_groups:
            low.append(origins)
            high.append(origins + side)
        if not sum(map(len, low)):
            raise ValueError("the grid is empty")
        return np.concatenate(low).min(0), np.concatenate(high).max(0)

    def _visible_tiles(
        self, level: int, number: int, start: np.ndarray, stop: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns (t, 3) positions and (t, c) values of a node's non-background tiles in a box."""
        values, is_tile = self.tiles(level, number)
        side, origin = SIDES[level + 1], self.origins[level][number]
        a = np.maximum((start - origin) // side, 0)
        b = np.minimum(-((origin - stop) // side), COUNTS[level])
        index = boxes.index(a, b)
        is_visible = is_tile[index] & self._is_foreground(values[index])
        return origin + (a + np.argwhere(is_visible)) * side, values[index][is_visible]

    def _is_foreground(self, values: np.ndarray) -> np.ndarray:
        differs = values != self.background
        if self.dtype.kind == "f":
            differs &= ~(np.isnan(values) & np.isnan(self.background))
        return differs.any(-1)

    @staticmethod
    def _overlapping(
        origins: np.ndarray, side: int, start: np.ndarray, stop: np.ndarray
    ) -> np.ndarray:
        """Returns (k,) the indices of the nodes that overlap a box."""
        return np.flatnonzero(((origins < stop) & (origins + side > start)).all(1))

    @staticmethod
    def _write_tiles(
        out: np.ndarray, start: np.ndarray, side: int, origins: np.ndarray, values: np.ndarray
    ) -> None:
        """Writes tiles into a box that begins at `start`."""
        size = np.array(out.shape[:3])
        if side == SIDES[2]:
            i, j, k = ((origins - start) // side).T
            _blocks(out)[i, :, j, :, k] = values[:, None, None, None]
            return
        for origin, value in zip(origins - start, values, strict=True):
            a, b = np.maximum(origin, 0), np.minimum(origin + side, size)
            if (a < b).all():
                out[boxes.index(a, b)] = value


def _blocks(out: np.ndarray) -> np.ndarray:
    """Returns a view of a box of whole leaves as (i, 8, j, 8, k, 8, c)."""
    i, j, k, c = out.shape
    return out.reshape(i // 8, 8, j // 8, 8, k // 8, 8, c)


def check_roots(count: int) -> None:
    """Raises ValueError if a root has more entries than can be read."""
    if count > MAX_ROOTS:
        raise ValueError(f"a root of {count} entries, at most {MAX_ROOTS} are read")


@functools.lru_cache(maxsize=2)
def _read_grid(kind: type[SparseGrid], path: str, number: int, _opened: int) -> SparseGrid:
    return kind.read(path, number)


@dataclass(frozen=True, kw_only=True)
class SparseSource(VolumeSource):
    """A grid of a file; the array is (i, j, k), or (i, j, k, c)."""

    grid_type: type[SparseGrid]
    number: int  # index of the grid in its file
    low: tuple[int, int, int]  # voxel index i, j, k of the array's first voxel
    held: int = 0  # bytes of the grid itself, where it is unpacked as a whole

    @classmethod
    def of(
        cls,
        path: str,
        name: str,
        grid_class: str,
        stored: str,
        width: int,
        low: np.ndarray,
        high: np.ndarray,
        affine: np.ndarray,
        **fields: Any,
    ) -> SparseSource:
        """Returns the source of a grid.

        Args:
            path, name: Of the file and the grid.
            grid_class: The grid's class: "level set", "fog volume", ...
            stored: Dtype of a number.
            width: Numbers per voxel.
            low, high: (3,) The first voxel, and one past the last.
            affine: (4, 4) From voxel indices to the world.
            **fields: Other fields of the source.
        """
        size = [int(n) for n in high - low]
        if min(size) < 1 or np.abs((low, high)).max() > MAX_INDEX:
            raise ValueError(f"{path}: grid {name!r} has no active voxel")
        shifted = affine.astype(np.float64)
        shifted[:3, 3] += shifted[:3, :3] @ low
        shape = (*size, width) if width > 1 else tuple(size)
        names = [f"{name}.{'xyzw'[n]}" for n in range(width)] if width > 1 else [name]
        channels = tuple(ChannelInfo(name=channel_name) for channel_name in names) if name else ()
        return cls(
            path=path,
            shape=shape,
            stored=stored,
            low=tuple(low.tolist()),
            info=ImageInfo(channels=channels, quantity=_QUANTITIES.get(grid_class)),
            **place_axes(path, shifted, shape, component=3 if width > 1 else None),
            **fields,
        )

    @property
    def peak_bytes(self) -> int:
        """Bytes of memory that reading takes, and those of the grid itself."""
        return super().peak_bytes + self.held

    def grid(self) -> SparseGrid:
        """Returns the grid, which is cached."""
        with _LOCK:  # the first thread searches the nodes
            return _read_grid(self.grid_type, self.path, self.number, self.opened)

    def read_stored(self, index: Index) -> np.ndarray:
        low = [part.start + first for part, first in zip(index[:3], self.low, strict=True)]
        high = [part.stop + first for part, first in zip(index[:3], self.low, strict=True)]
        values = self.grid().fill(low, high)
        return values[..., index[3]] if len(index) > 3 else values[..., 0]


def bits(data: Any, offset: int, count: int) -> np.ndarray:
    """Returns (count,) bool, the bits of a mask at byte `offset`, a byte's lowest bit first."""
    packed = np.frombuffer(data, "u1", count // 8, offset)
    return np.unpackbits(packed, bitorder="little").view(bool)
