"""`write_shard`: one task of the converter, a plain function of picklable arguments.

A task writes one cube of a level: its shard of the pyramid, of the blocks and of the cells. It
reads the source (level 0) or the level below as stored, with the voxels around the cube, so it
depends on no other task of its own level, and may be run again after a crash.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..pool.downsample import extend, pool_max, pool_mean, pool_min, round_array, window
from .level_reader import Deadline, StoredArray, StoreError, short
from .source import VolumeSource
from .store import needed_cells
from .store_layout import BORDER, CELL, StoreLayout, opened

_TIMEOUT = 3600.0  # seconds for one read of local data
_SLAB = 32  # planes of a level made at a time: two chunks of the level below

Zyx = tuple[int, int, int]
_POOLS = (pool_mean, pool_min, pool_max)


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """What all tasks of a conversion share: where they read, where they write, and how."""

    root: dict[str, Any]  # kvstore of the store
    layout: StoreLayout
    source: VolumeSource
    threshold: float | None
    nan: float | None


@dataclass(frozen=True)
class ShardResult:
    """What a task reports back."""

    level: int
    place: Zyx
    voxels: int
    bad: int  # values that are not finite; the shard is not written then


def write_shard(conversion: Conversion, level: int, place: Zyx) -> ShardResult:
    """Writes the shards of one cube of a level.

    Args:
        conversion: The conversion.
        level: 0 is the finest.
        place: (z, y, x) of the cube, in shards.

    Raises:
        OSError: The source can't be read, or the store can't be written (ENOSPC: the disk is full).
    """
    layout = conversion.layout
    shape = layout.shape(level)
    low = [at * layout.shard for at in place]
    stop = [min(a + layout.shard, n) for a, n in zip(low, shape, strict=True)]
    size = [b - a for a, b in zip(low, stop, strict=True)]
    padded = [-(-n // layout.block) * layout.block for n in size]
    box = [a - BORDER for a in low], [a + n + BORDER for a, n in zip(low, padded, strict=True)]
    inner = tuple(slice(BORDER, BORDER + n) for n in size)
    if level == 0:
        values, bad = _from_source(conversion, *box, inner)
        if bad:
            return ShardResult(level, place, 0, bad)
        least = most = values
    else:
        values, least, most = _from_below(conversion, level, *box)
    writes = [_write(conversion, layout.plain(level), low, _plain(values[inner]))]
    if 0 < level < layout.levels - 1:
        for which, bound in (("low", least), ("high", most)):
            writes.append(_write(conversion, layout.bound(which, level), low, _plain(bound[inner])))
    cells = _cells(values, least, most, [-(-n // CELL) for n in size])
    writes.append(_write(conversion, layout.cells(level), [a // CELL for a in low], cells))
    blocks = _blocks(layout, values, needed_cells(cells, conversion.threshold))
    if blocks is not None:
        writes.append(
            _write(conversion, layout.blocks(level), [a // layout.block for a in low], blocks)
        )
    for write in writes:
        _finish(write, conversion.root.get("path", "store"))
    return ShardResult(level, place, int(np.prod(size)), 0)


def _from_source(
    conversion: Conversion, low: list[int], high: list[int], inner: tuple[slice, ...]
) -> tuple[np.ndarray, int]:
    shape = conversion.layout.shape(0)
    start = [max(a, 0) for a in low]
    stop = [min(b, n) for b, n in zip(high, shape, strict=True)]
    values = conversion.source.read_region(start, stop)
    bad = 0
    if values.dtype.kind == "f":
        wrong = ~np.isfinite(values)
        if wrong.any():
            if conversion.nan is not None:
                values = np.where(wrong, values.dtype.type(conversion.nan), values)
            else:
                bad = int(_pad(wrong, low, high, start, stop)[inner].sum())
    return _pad(values, low, high, start, stop), bad


def _from_below(
    conversion: Conversion, level: int, low: list[int], high: list[int]
) -> list[np.ndarray]:
    """Makes a box of a level, voxels around it included, from the level below: means, smallest and
    largest finest values.
    """
    layout = conversion.layout
    shape, below = layout.shape(level), layout.shape(level - 1)
    specs = [layout.plain(level - 1)]
    if level > 1:  # below that, the values are their own smallest and largest
        specs += [layout.bound(which, level - 1) for which in ("low", "high")]
    deadline = Deadline(_TIMEOUT)
    arrays = []
    for spec in specs:
        array = deadline.wait(opened(conversion.root, spec), spec["path"])
        arrays.append(StoredArray(array, "czyx"[-array.rank :], (1, 1, 1), spec["path"]))
    start = [max(a, 0) for a in low]
    stop = [min(b, n) for b, n in zip(high, shape, strict=True)]
    size = (*[b - a for a, b in zip(start, stop, strict=True)], layout.width)
    made = [np.empty(size, layout.dtype) for _ in _POOLS]
    for z in (start[0], *range((start[0] // _SLAB + 1) * _SLAB, stop[0], _SLAB)):
        end = min(stop[0], (z // _SLAB + 1) * _SLAB)
        first = [2 * z, 2 * start[1], 2 * start[2]]
        last = [min(2 * b, n) for b, n in zip((end, *stop[1:]), below, strict=True)]
        parts = [array.read(first, last, deadline) for array in arrays]
        for out, part, pool in zip(made, parts * (len(_POOLS) // len(parts)), _POOLS, strict=True):
            out[z - start[0] : end - start[0]] = pool(part, 2)
    return [_pad(values, low, high, start, stop) for values in made]


def _pad(
    values: np.ndarray, low: list[int], high: list[int], start: list[int], stop: list[int]
) -> np.ndarray:
    for axis in range(3):
        values = extend(values, axis, start[axis] - low[axis], high[axis] - stop[axis])
    return values


def _plain(values: np.ndarray) -> np.ndarray:
    """(z, y, x, c) as the pyramid stores it."""
    return values[..., 0] if values.shape[3] == 1 else np.moveaxis(values, 3, 0)


def _cells(values: np.ndarray, least: np.ndarray, most: np.ndarray, count: list[int]) -> np.ndarray:
    """(gz, gy, gx, 3, c) low, high, mean of the cells of a cube with its border."""
    reach = tuple(slice(0, n * CELL + 2 * BORDER) for n in count)
    own = tuple(slice(BORDER, BORDER + n * CELL) for n in count)
    size = CELL + 2 * BORDER
    low = window(least[reach], "min", size=size, step=CELL)
    high = window(most[reach], "max", size=size, step=CELL)
    mean = window(values[own], "mean", size=CELL, step=CELL)
    return np.stack((low, high, round_array(mean, values.dtype)), axis=3)


def _blocks(layout: StoreLayout, values: np.ndarray, needed: np.ndarray) -> np.ndarray | None:
    """(gz, gy, gx, s, s, s, c) blocks of a cube; zero, which is not written, where no cell needs
    them.
    """
    per, side = layout.block // CELL, layout.stored
    grid = [-(-n // per) for n in needed.shape]
    wanted = np.zeros([n * per for n in grid], bool)
    wanted[tuple(slice(0, n) for n in needed.shape)] = needed
    parts = wanted.reshape(grid[0], per, grid[1], per, grid[2], per)
    wanted = np.asarray(parts.any((1, 3, 5)))
    if not wanted.any():
        return None
    strides = values.strides
    view = np.lib.stride_tricks.as_strided(
        values,
        (*grid, side, side, side, layout.width),
        (*[step * layout.block for step in strides[:3]], *strides),
        writeable=False,
    )
    blocks = np.zeros(view.shape, values.dtype)
    blocks[wanted] = view[wanted]
    return blocks


def _write(conversion: Conversion, spec: dict[str, Any], low: list[int], data: np.ndarray) -> Any:
    """Begins to write a box into an array of the store."""
    array = Deadline(_TIMEOUT).wait(opened(conversion.root, spec, "write"), spec["path"])
    sizes = data.shape
    if len(sizes) == 4:  # (c, z, y, x)
        low = [0, *low]
    place = tuple(
        slice(a, a + n) for a, n in zip([*low, *[0] * (len(sizes) - len(low))], sizes, strict=True)
    )
    return array[place].write(data)


def _finish(write: Any, where: str) -> None:
    try:
        write.result()
    except Exception as error:  # tensorstore raises what its status maps to
        if "No space left" in str(error):
            text = "the disk is full; with room again, --resume (resume=True) goes on"
            raise OSError(errno.ENOSPC, text, where) from None
        raise StoreError(f"{where}: can't be written: {short(error)}") from None
