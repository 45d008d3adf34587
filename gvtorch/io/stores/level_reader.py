"""`LevelReader`: the tree levels of a multiscale image, from the arrays that `open_arrays` opens.

Tree level L is 2^L times coarser along every axis. A level without an array is averaged: from the
coarsest array whose factors divide 2^L, or tile by tile from the tree level below, whichever reads
less. Computed tiles are cached, in bounded memory.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ...base import boxes
from ...base.boxes import Zyx
from ...base.downsample import pool_majority, pool_mean
from ...base.image_info import ImageInfo
from ...base.labels import background, check_narrowed
from ..source import check_time
from .chunk_files import ChunkFiles, begin_read, files_of
from .ngff import ImageArray, MultiscaleImage, read_json
from .store_layout import MAX_STORE_VOXELS, StoreLayout, value_dtype
from .tensorstores import Deadline, StoreError, begin_open, child, one_line_error

Pool = Callable[[np.ndarray, int | Sequence[int]], np.ndarray]
_TILE_SIDE = 64  # voxels along a side of a tile that is computed on demand
_CACHE_BYTES = 128 << 20  # bytes of cached tiles


def pool_of(info: ImageInfo, label_values: np.ndarray | None) -> Pool:
    """Returns what makes coarser voxels of an image: the mean, or the most frequent label."""
    if not info.labels:
        return pool_mean
    return partial(pool_majority, background=background(label_values))


@dataclass(frozen=True)
class StoredArray:
    """One array of a multiscale image, at one time point."""

    array: Any  # tensorstore.TensorStore
    files: ChunkFiles
    axes: str  # letters among c, z, y, x in stored order
    factors: tuple[int, int, int]  # z y x, finest voxels along a side of one of its voxels
    context: str

    def size(self, axis: str) -> int:
        """Returns the voxels along an axis; 1 if the array lacks the axis."""
        return int(self.array.shape[self.axes.index(axis)]) if axis in self.axes else 1

    def read(self, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        """Reads (z, y, x, c); voxels beyond the array repeat its outermost ones."""
        start, stop = boxes.clamped_box(low, high, [self.size(axis) for axis in "zyx"])
        slices = dict(zip("zyx", boxes.index(start, stop), strict=True))
        index = tuple(slices.get(axis, slice(None)) for axis in self.axes)
        data = deadline.wait(begin_read(self.array[index], self.files), self.context)
        return boxes.repeat_edges(boxes.to_zyxc(data, self.axes), start, low, high)


def open_arrays(
    location: str,
    root: Any,
    image: MultiscaleImage,
    time: int,
    channels: Sequence[int] | None,
    deadline: Deadline,
) -> tuple[list[StoredArray], slice | list[int], int]:
    """Opens the image's arrays, the finest first, at one time point, without those that are not
    coarser by whole factors, or whose place, dtype, times or channels differ. Returns them, the
    index of their channels, and the number of times. Reduces the image's metadata to the channels.
    """
    finest = image.scales[0]
    folder = child(root, finest.path)
    is_v3 = read_json(f"{location}/{finest.path}", folder, "zarr.json", deadline) is not None
    driver = "zarr3" if is_v3 else "zarr"
    futures = [begin_open(root, {"driver": driver, "path": scale.path}) for scale in image.scales]
    stored: list[StoredArray] = []
    for scale, future in zip(image.scales, futures, strict=True):
        context = f"{location}/{scale.path}"
        try:
            array = deadline.wait(future, context)
        except StoreError as error:
            raise ValueError(f"{context}: can't be opened: {one_line_error(error)}") from None
        files = _check_array(context, array, image.axes)
        level_sizes = dict(zip(image.axes, map(int, array.shape), strict=True))
        level_dtype = value_dtype(array.dtype.numpy_dtype)
        if not stored:
            channel_index = _channel_index(location, array, image.axes, time, channels)
            sizes, dtype = level_sizes, level_dtype
        elif level_dtype != dtype or any(level_sizes.get(a) != sizes.get(a) for a in "tc"):
            continue
        selection: dict[str, Any] = {"t": time, "c": channel_index, "-": 0}
        # An index array of channels would move its axis: oindex leaves every axis in place.
        array = array.oindex[tuple(selection.get(axis, slice(None)) for axis in image.axes)]
        axes = image.axes.replace("t", "").replace("-", "")
        opened = StoredArray(array, files, axes, (1, 1, 1), context)
        factors = _factors(stored[0], opened, finest, scale) if stored else opened.factors
        if factors is not None:
            stored.append(replace(opened, factors=factors))
    _keep_channels(image, sizes, channel_index)
    return stored, channel_index, sizes.get("t", 1)


def _keep_channels(
    image: MultiscaleImage, sizes: dict[str, int], channel_index: slice | list[int]
) -> None:
    """Reduces the channel metadata to the chosen channels; drops it if it doesn't fit the array."""
    channels, width = image.info.channels, sizes.get("c", 1)
    if channels and len(channels) != width:
        image.dropped.append(f"metadata of {len(channels)} channels, where there are {width}")
        channels = ()
    if sizes.get("-", 1) > 1:
        note = f"an axis that is none of t, c, z, y, x: the first of {sizes['-']} is read"
        image.dropped.append(note)
    if channels and not isinstance(channel_index, slice):
        channels = tuple(channels[number] for number in channel_index)
    image.info = replace(image.info, channels=channels)


def _check_array(context: str, array: Any, axes: str) -> ChunkFiles:
    if array.rank != len(axes):
        raise ValueError(f"{context}: has {array.rank} axes, the metadata {len(axes)}: {axes}")
    voxels = math.prod(array.shape[axes.index(axis)] for axis in "zyx" if axis in axes)
    if voxels > MAX_STORE_VOXELS:
        raise ValueError(
            f"{context}: {voxels} voxels are more than the {MAX_STORE_VOXELS} of a store"
        )
    if min(array.shape) < 1 or math.prod(array.shape) > MAX_STORE_VOXELS * 2**10:
        raise ValueError(f"{context}: extent {tuple(array.shape)} is empty or far too large")
    return files_of(context, array)


def _channel_index(
    context: str, array: Any, axes: str, time: int, channels: Sequence[int] | None
) -> slice | list[int]:
    size = {axis: int(n) for axis, n in zip(axes, array.shape, strict=True)}
    times, width = size.get("t", 1), size.get("c", 1)
    check_time(context, time, times)
    if channels is None:
        return slice(None)
    from ...base import check  # imports torch, which workers of a conversion do without

    selected = list(check.instance(context, "channels", channels, tuple, list, range))
    if not selected or not all(isinstance(c, int) and 0 <= c < width for c in selected):
        raise ValueError(f"{context}: has no channels {selected!r}; it has {width}, from 0")
    return selected if "c" in axes else slice(None)


def _factors(
    first: StoredArray, other: StoredArray, fine: ImageArray, coarse: ImageArray
) -> tuple[int, int, int] | None:
    """Returns whole factors (z, y, x) between the finest array and another; None if not whole, or
    if the other lies elsewhere, by more than one of its voxels.
    """
    factors = []
    shifts = [b - a for a, b in zip(fine.translation, coarse.translation, strict=True)]
    for axis, a, b, shift in zip("zyx", fine.scale, coarse.scale, shifts, strict=True):
        if not abs(shift) <= max(a, b):
            return None
        fine_size, coarse_size = first.size(axis), other.size(axis)
        # Sizes are the fallback for scales; a partial last voxel may have been dropped.
        for ratio in (b / a, fine_size / coarse_size):
            factor = round(ratio) if math.isfinite(ratio) else 0
            if factor >= 1 and coarse_size in (-(-fine_size // factor), fine_size // factor):
                factors.append(factor)
                break
    return (factors[0], factors[1], factors[2]) if len(factors) == 3 else None


class LevelReader:
    """Tree levels over stored arrays. Safe to use from several threads."""

    def __init__(self, stored: Sequence[StoredArray], layout: StoreLayout, pool: Pool) -> None:
        """Plans how each level of the layout is read from the arrays, the finest first; `pool`
        averages the voxels of a level without an array.
        """
        self._layout, self._pool, self.width = layout, pool, stored[0].size("c")
        self.finest = next(s for s in stored if max(s.factors) == 1)
        self._plans: list[tuple[StoredArray, list[int]] | None] = []
        cost = 1.0
        for level in range(layout.levels):
            candidates = [s for s in stored if all(2**level % f == 0 for f in s.factors)]
            base = max(candidates, key=lambda s: math.prod(s.factors))
            remaining = [2**level // f for f in base.factors]  # factors that remain to be averaged
            is_direct = level == 0 or math.prod(remaining) < 8 * cost
            self._plans.append((base, remaining) if is_direct else None)
            cost = math.prod(remaining) if is_direct else 8 * cost
        self._tiles: OrderedDict[tuple[int, ...], np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, level: int, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        """Reads (z, y, x, c) voxels `low` to `high` of a level; edge voxels repeat beyond it."""
        start, stop = boxes.clamped_box(low, high, self._layout.shape(level))
        data = self._read_inside(level, start, stop, deadline)
        return np.ascontiguousarray(boxes.repeat_edges(data, start, low, high))

    def coarsest(self, level: int) -> int:
        """Returns the coarsest level up to `level` that is read without averaging finer ones."""
        plans = enumerate(self._plans[: level + 1])
        return [n for n, plan in plans if plan and max(plan[1]) == 1][-1]

    def _read_inside(self, level: int, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        plan = self._plans[level]
        if plan is None:
            size = [b - a for a, b in zip(low, high, strict=True)]
            out = np.empty((*size, self.width), self._layout.dtype)
            for tile_index in boxes.tile_indices(low, high, [_TILE_SIDE] * 3):
                tile = self._tile(level, tile_index, deadline)
                boxes.paste(out, low, tile, [_TILE_SIDE * i for i in tile_index])
            return out
        base, remaining = plan
        base_shape = [-(-n // f) for n, f in zip(self._layout.shape(0), base.factors, strict=True)]
        start = [a * r for a, r in zip(low, remaining, strict=True)]
        stop = [min(b * r, n) for b, r, n in zip(high, remaining, base_shape, strict=True)]
        data = base.read(start, stop, deadline)
        if self._layout.dtype == "float32":
            check_narrowed(base.context, data)
        data = data.astype(self._layout.dtype, copy=False)
        return data if math.prod(remaining) == 1 else self._pool(data, remaining)

    def _tile(self, level: int, tile_index: Zyx, deadline: Deadline) -> np.ndarray:
        key = (level, *tile_index)
        with self._lock:
            if key in self._tiles:
                self._tiles.move_to_end(key)
                return self._tiles[key]
        finer_shape = self._layout.shape(level - 1)
        low = [2 * _TILE_SIDE * i for i in tile_index]
        high = [min(a + 2 * _TILE_SIDE, n) for a, n in zip(low, finer_shape, strict=True)]
        tile = self._pool(self._read_inside(level - 1, low, high, deadline), 2)
        with self._lock:
            self._tiles[key] = tile
            cached_bytes = sum(cached.nbytes for cached in self._tiles.values())
            while len(self._tiles) > 1 and cached_bytes > _CACHE_BYTES:
                # The oldest of the finest level: coarse tiles are few, and cost most to recompute.
                victim = min(self._tiles, key=lambda key: key[0])
                cached_bytes -= self._tiles.pop(victim).nbytes
        return tile
