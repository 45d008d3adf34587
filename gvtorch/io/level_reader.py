"""`LevelReader`: the tree levels of a multiscale image, read from whatever arrays it stores.

A tree level is 2^L coarser along every axis. Where no array is, the level is averaged: from the
coarsest array whose factors divide 2^L, or tile by tile from the tree level below, whichever
reads less. Memory stays bounded, and tiles that were made are kept for a while.
"""

from __future__ import annotations

import itertools
import math
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..pool.downsample import pool_mean
from .store_layout import level_shape

_TILE = 64  # voxels along a side of a tile that is made on demand
_KEPT = 128 << 20  # bytes of such tiles

Zyx = Sequence[int]


class StoreError(OSError):
    """A store could not be read or written."""


class Deadline:
    """A moment until which reads may take."""

    def __init__(self, timeout: float) -> None:
        """Starts the clock: `timeout` seconds from now."""
        self.timeout = timeout
        self._end = time.monotonic() + timeout

    def wait(self, future: Any, where: str) -> Any:
        """Returns the result of one of tensorstore's futures.

        Raises:
            TimeoutError: It took too long.
            StoreError: It failed.
        """
        try:
            return future.result(timeout=max(0.0, self._end - time.monotonic()))
        except TimeoutError:
            future.cancel()
            raise TimeoutError(f"{where}: no answer within {self.timeout:g} s") from None
        except Exception as error:  # tensorstore raises what its status maps to
            raise StoreError(f"{where}: {short(error)}") from None


def short(error: BaseException) -> str:
    """tensorstore's message in one line, without its annotations."""
    text = re.sub(r"\s*\[[a-z_]+(=| locations=).*", "", str(error), flags=re.DOTALL)
    return " ".join(text.split())[:400] or type(error).__name__


@dataclass(frozen=True)
class StoredArray:
    """One array of a multiscale image, the time point chosen."""

    array: Any  # tensorstore.TensorStore
    axes: str  # letters among c, z, y, x in stored order
    factors: tuple[int, int, int]  # z y x, finest voxels along a side of one of its own
    where: str

    def size(self, axis: str) -> int:
        """Voxels along an axis, 1 where it has none."""
        return int(self.array.shape[self.axes.index(axis)]) if axis in self.axes else 1

    def read(self, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        """Reads (z, y, x, c); voxels beyond the array repeat its outermost ones."""
        start, stop = clamp_box(low, high, [self.size(axis) for axis in "zyx"])
        inside = dict(zip("zyx", map(slice, start, stop), strict=True))
        place = tuple(inside.get(axis, slice(None)) for axis in self.axes)
        data = deadline.wait(self.array[place].read(order="C"), self.where)
        missing = "".join(axis for axis in "zyxc" if axis not in self.axes)
        letters = missing + self.axes
        data = data[(None,) * len(missing)].transpose([letters.index(axis) for axis in "zyxc"])
        return repeat_edges(data, start, low, high)


def clamp_box(low: Zyx, high: Zyx, shape: Zyx) -> tuple[list[int], list[int]]:
    """The part of a box that lies in a grid, or what is next to it: at least one voxel a side."""
    start = [min(max(a, 0), n - 1) for a, n in zip(low, shape, strict=True)]
    stop = [max(min(b, n), a + 1) for a, b, n in zip(start, high, shape, strict=True)]
    return start, stop


def repeat_edges(data: np.ndarray, start: Zyx, low: Zyx, high: Zyx) -> np.ndarray:
    """Extends (z, y, x, c) voxels, which begin at `start`, to a box; the outermost repeat."""
    for axis, (at, a, b) in enumerate(zip(start, low, high, strict=True)):
        size = data.shape[axis]
        if (at, at + size) != (a, b):
            data = data.take(np.arange(a - at, b - at).clip(0, size - 1), axis)
    return data


class LevelReader:
    """Tree levels over stored arrays. Safe to use from several threads."""

    def __init__(self, stored: Sequence[StoredArray], count: int, dtype: np.dtype) -> None:
        """Plans how each level is read.

        Args:
            stored: Arrays, the finest first.
            count: Number of tree levels.
            dtype: What values are converted to.
        """
        first = stored[0]
        self.extent = (first.size("x"), first.size("y"), first.size("z"))
        self.dtype, self.width = dtype, first.size("c")
        self._plans: list[tuple[StoredArray, tuple[int, ...]] | None] = []
        cost = 1.0
        for level in range(count):
            base, rest = _coarsest(stored, 2**level)
            direct = math.prod(rest)
            if level == 0 or direct < 8 * cost:
                self._plans.append((base, rest))
                cost = direct
            else:
                self._plans.append(None)
                cost *= 8
        self._tiles: OrderedDict[tuple[int, ...], np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, level: int, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        """Reads (z, y, x, c) voxels `low` to `high` of a level; beyond it the outermost repeat."""
        start, stop = clamp_box(low, high, level_shape(self.extent, level))
        data = self._inside(level, start, stop, deadline)
        return np.ascontiguousarray(repeat_edges(data, start, low, high))

    def _inside(self, level: int, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        plan = self._plans[level]
        if plan is None:
            return self._from_tiles(level, low, high, deadline)
        base, rest = plan
        ends = [-(-n // f) for n, f in zip(self.extent[::-1], base.factors, strict=True)]
        start = [a * r for a, r in zip(low, rest, strict=True)]
        stop = [min(b * r, n) for b, r, n in zip(high, rest, ends, strict=True)]
        data = base.read(start, stop, deadline).astype(self.dtype, copy=False)
        return data if math.prod(rest) == 1 else pool_mean(data, rest)

    def _from_tiles(self, level: int, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        out = np.empty((*[b - a for a, b in zip(low, high, strict=True)], self.width), self.dtype)
        spans = [range(a // _TILE, -(-b // _TILE)) for a, b in zip(low, high, strict=True)]
        for place in itertools.product(*spans):
            tile = self._tile(level, place, deadline)
            source, target = [], []
            for axis, at in enumerate(place):
                a = max(low[axis], at * _TILE)
                b = min(high[axis], at * _TILE + tile.shape[axis])
                source.append(slice(a - at * _TILE, b - at * _TILE))
                target.append(slice(a - low[axis], b - low[axis]))
            out[tuple(target)] = tile[tuple(source)]
        return out

    def _tile(self, level: int, place: Zyx, deadline: Deadline) -> np.ndarray:
        key = (level, *place)
        with self._lock:
            if key in self._tiles:
                self._tiles.move_to_end(key)
                return self._tiles[key]
        below = level_shape(self.extent, level - 1)
        low = [2 * _TILE * at for at in place]
        high = [min(a + 2 * _TILE, n) for a, n in zip(low, below, strict=True)]
        tile = pool_mean(self._inside(level - 1, low, high, deadline), 2)
        with self._lock:
            self._tiles[key] = tile
            size = sum(kept.nbytes for kept in self._tiles.values())
            while len(self._tiles) > 1 and size > _KEPT:
                # The finest level's oldest: coarse tiles are few, and cost most to make again.
                victim = min(self._tiles, key=lambda key: key[0])
                size -= self._tiles.pop(victim).nbytes
        return tile


def _coarsest(stored: Sequence[StoredArray], factor: int) -> tuple[StoredArray, tuple[int, ...]]:
    """The coarsest array whose factors divide `factor`, and what is left to average."""
    fits = [s for s in stored if all(factor % f == 0 for f in s.factors)]
    best = max(fits, key=lambda s: math.prod(s.factors))
    return best, tuple(factor // f for f in best.factors)
