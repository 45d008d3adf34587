"""`write_shard`: one task of the converter, a plain function of picklable arguments.

A task writes one cube of a level: its shard of the pyramid, of the blocks and of the cells. It
reads the source (level 0) or the stored level below, including the voxels around the cube, so it
depends on no other task of its level, and may be run again after a crash.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ...base import boxes
from ...base.downsample import Reduction, pool_max, pool_mean, pool_min, reduce_windows, round_array
from ..source import VolumeSource
from .block_reader import needed_cells
from .checksums import shard_checksums
from .chunk_files import files_of
from .level_reader import Pool, StoredArray
from .store_layout import BORDER, CELL, RESUME_ADVICE, StoreLayout
from .tensorstores import LOCAL_TIMEOUT, Deadline, StoreError, one_line_error, open_array
from .unfinished import TaskResult

_SLAB_PLANES = 32  # planes of a level made at a time, from one chunk (64 planes) of the level below

ShardIndex = tuple[int, ...]  # z, y, x, or t, z, y, x where a store has several time points


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """What all tasks of a conversion share: their source, target and settings."""

    root: dict[str, Any]  # tensorstore's spec of the store's folder
    layout: StoreLayout
    source: VolumeSource
    nan: float | None
    pool: Pool = pool_mean  # makes coarser voxels


def write_shard(conversion: Conversion, level: int, index: ShardIndex) -> TaskResult:
    """Writes the shards of one cube of a level, `index` (z, y, x), or (t, z, y, x), in shards;
    level 0 is the finest.

    Raises:
        OSError: The source can't be read, or the store can't be written (ENOSPC: the disk is full).
    """
    layout = conversion.layout
    shape = layout.shape(level)
    low = [i * layout.shard for i in index[-3:]]
    time = index[0] if len(index) > 3 else None
    stop = [min(a + layout.shard, n) for a, n in zip(low, shape, strict=True)]
    size = [b - a for a, b in zip(low, stop, strict=True)]
    padded = [-(-n // layout.block) * layout.block for n in size]
    box = [a - BORDER for a in low], [a + n + BORDER for a, n in zip(low, padded, strict=True)]
    inner = tuple(slice(BORDER, BORDER + n) for n in size)
    if level == 0:
        values, bad_values = _read_source(conversion, time or 0, *box, inner)
        if bad_values:
            return TaskResult(index, 0, {}, bad_values)
        lowest = highest = values
    else:
        values, lowest, highest = _pool_finer_level(conversion, level, time or 0, *box)
    writes = []
    pyramids = (layout.pyramid(level), *layout.bounds(level))
    for spec, part in zip(pyramids, (values, lowest, highest), strict=False):
        data = np.moveaxis(part[inner], 3, 0) if "c" in layout.axes else part[inner][..., 0]
        writes.append(begin_write(conversion.root, spec, low, data, time))
    reduction: Reduction = "min" if conversion.source.info.labels else "mean"  # a mean is no label
    cells = _cells(values, lowest, highest, [-(-n // CELL) for n in size], reduction)
    first = [a // CELL for a in low]
    writes.append(begin_write(conversion.root, layout.cells(level), first, cells, time))
    blocks = _blocks(layout, values, needed_cells(cells, layout.threshold))
    if blocks is not None:
        first_block = [a // layout.block for a in low]
        writes.append(begin_write(conversion.root, layout.blocks(level), first_block, blocks, time))
    for future in writes:
        finish_write(future, conversion.root.get("path", "store"))
    specs = (layout.pyramid(level), layout.cells(level), layout.blocks(level))
    files = shard_checksums(conversion.root, specs, index, Deadline(LOCAL_TIMEOUT))
    return TaskResult(index, int(np.prod(size)), files)


def _read_source(
    conversion: Conversion, time: int, low: list[int], high: list[int], inner: tuple[slice, ...]
) -> tuple[np.ndarray, int]:
    """Reads a box; also returns how many of its `inner` values are not finite and not replaced."""
    start, stop = boxes.clamped_box(low, high, conversion.layout.shape(0))
    source = conversion.source.at_time(conversion.source.time + time)
    values, bad_values = source.read_region(start, stop), 0
    if values.dtype.kind == "f" and (not_finite := ~np.isfinite(values)).any():
        if conversion.nan is None:
            bad_values = int(boxes.repeat_edges(not_finite, start, low, high)[inner].sum())
        else:
            values = np.where(not_finite, values.dtype.type(conversion.nan), values)
    return boxes.repeat_edges(values, start, low, high), bad_values


def _pool_finer_level(
    conversion: Conversion, level: int, time: int, low: list[int], high: list[int]
) -> list[np.ndarray]:
    """Computes a box of a level, which may reach beyond the volume, from the level below: means
    (labels: the most frequent), and smallest and largest finest values.
    """
    pools: tuple[Pool, ...] = (conversion.pool, pool_min, pool_max)
    layout, deadline = conversion.layout, Deadline(LOCAL_TIMEOUT)
    arrays = []
    # Level 0 has no bounds: there, values are both the smallest and the largest.
    for spec in (layout.pyramid(level - 1), *layout.bounds(level - 1)):
        array = open_array(conversion.root, spec)
        files = files_of(spec["path"], array)
        array = layout.at_time(array, time)
        arrays.append(StoredArray(array, files, "czyx"[-array.rank :], (1, 1, 1), spec["path"]))
    start, stop = boxes.clamped_box(low, high, layout.shape(level))
    size = (*[b - a for a, b in zip(start, stop, strict=True)], layout.width)
    pooled = [np.empty(size, layout.dtype) for _ in pools]
    for slab in range(start[0] // _SLAB_PLANES, -(-stop[0] // _SLAB_PLANES)):
        z, end = max(start[0], slab * _SLAB_PLANES), min(stop[0], (slab + 1) * _SLAB_PLANES)
        first = [2 * z, 2 * start[1], 2 * start[2]]
        last = np.minimum([2 * end, 2 * stop[1], 2 * stop[2]], layout.shape(level - 1)).tolist()
        parts = [array.read(first, last, deadline) for array in arrays]
        for out, part, pool in zip(pooled, parts * (len(pools) // len(parts)), pools, strict=True):
            out[z - start[0] : end - start[0]] = pool(part, 2)
    return [boxes.repeat_edges(values, start, low, high) for values in pooled]


def _cells(
    values: np.ndarray,
    lowest: np.ndarray,
    highest: np.ndarray,
    count: list[int],
    reduction: Reduction,
) -> np.ndarray:
    """Returns (gz, gy, gx, 3, c) low, high, mean of the cells of a cube with its border."""
    with_border = tuple(slice(0, n * CELL + 2 * BORDER) for n in count)
    without_border = tuple(slice(BORDER, BORDER + n * CELL) for n in count)
    size = CELL + 2 * BORDER
    low = reduce_windows(lowest[with_border], "min", size=size, step=CELL)
    high = reduce_windows(highest[with_border], "max", size=size, step=CELL)
    mean = reduce_windows(values[without_border], reduction, size=CELL, step=CELL)
    return np.stack((low, high, round_array(mean, values.dtype)), axis=3)


def _blocks(layout: StoreLayout, values: np.ndarray, needed: np.ndarray) -> np.ndarray | None:
    """Returns (gz, gy, gx, s, s, s, c) blocks of a cube: zeros, which are not written, where no
    cell needs the block; None if no block is needed.
    """
    needed_blocks = pool_max(needed[..., None], layout.block // CELL)[..., 0]
    if not needed_blocks.any():
        return None
    all_blocks = bordered(layout, values)
    blocks = np.zeros(all_blocks.shape, values.dtype)
    blocks[needed_blocks] = all_blocks[needed_blocks]
    return blocks


def bordered(layout: StoreLayout, values: np.ndarray) -> np.ndarray:
    """Returns a bordered cube (z, y, x, c) as bordered blocks: a view (gz, gy, gx, s, s, s, c)."""
    every, side = slice(None, None, layout.block), layout.bordered_side
    view = sliding_window_view(values, (side, side, side), (0, 1, 2))[every, every, every]
    return np.moveaxis(view, 3, 6)


def begin_write(
    root: dict[str, Any],
    spec: dict[str, Any],
    low: list[int],
    data: np.ndarray,
    time: int | None = None,
) -> Any:
    """Starts writing a box into an array of the store, at `time` if given; returns a future."""
    array = open_array(root, spec, "write")
    array = array if time is None else array[time]
    low = [0, *low] if data.ndim == 4 else low  # (c, z, y, x)
    low = [*low, *[0] * (data.ndim - len(low))]
    return array[boxes.index(low, np.add(low, data.shape).tolist())].write(data)


def finish_write(future: Any, context: str, advice: str = RESUME_ADVICE) -> None:
    """Waits for a write; `advice` ends the error message if the disk is full."""
    try:
        future.result()
    except Exception as error:  # tensorstore raises exceptions of several types
        if "No space left" in str(error):
            text = f"the disk is full; with room again, {advice}"
            raise OSError(errno.ENOSPC, text, context) from None
        raise StoreError(f"{context}: can't be written: {one_line_error(error)}") from None


def create_arrays(conversion: Conversion, level: int) -> None:
    layout = conversion.layout
    arrays = (layout.pyramid(level), layout.blocks(level), layout.cells(level))
    for spec in (*arrays, *layout.bounds(level)):
        open_array(conversion.root, spec, "create")


def write_label_array(conversion: Conversion, labels: np.ndarray) -> None:
    root, spec = conversion.root, conversion.layout.labels()
    open_array(root, spec, "create")
    finish_write(begin_write(root, spec, [0], labels), root.get("path", "store"))
