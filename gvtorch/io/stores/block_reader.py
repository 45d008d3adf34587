"""`BlockReader`: the bordered blocks and the cells of a store that `convert` made, read in bulk;
what is missing or was replaced is an error. `cut_blocks` cuts blocks out of any other image.
"""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ...base import boxes
from ...base.boxes import Zyx, group_rows
from .checksums import Checksums, shard_path
from .chunk_files import ChunkFiles, begin_read, files_of
from .level_reader import LevelReader
from .store_layout import BORDER, CELL, StoreLayout
from .tensorstores import Deadline, StoreError, begin_open, read_key

_BATCH_BLOCKS = 256  # blocks read at once; larger batches only cost memory traffic
_BLOCKS_AHEAD = 2 * _BATCH_BLOCKS  # blocks being read at a time
_GROUP_BLOCKS = 4  # blocks along a side of a group that may be read as one region
_READER_THREADS = 4  # threads that read such groups
ChunkedArray = tuple[Any, ChunkFiles]  # one of tensorstore's arrays, and its files
BlockErrors = dict[int, str]  # by row of the positions that were asked for


class BlockReader:
    """Blocks and cells at one time point. Safe to use from several threads."""

    def __init__(
        self,
        location: str,
        root: Any,
        layout: StoreLayout,
        time: int,
        levels: LevelReader,
        channels: slice | list[int],
        deadline: Deadline,
    ) -> None:
        """Opens the arrays of all levels and checks their shapes and dtypes; `levels` reads the
        pyramid, of which it keeps `channels`.
        """
        self.location, self._root, self._layout, self._time = location, root, layout, time
        self._levels, self._channels = levels, channels
        specs = [make(n) for make in (layout.blocks, layout.cells) for n in range(layout.levels)]
        arrays = []
        for spec, future in [(spec, begin_open(root, spec)) for spec in specs]:
            array, files = wait_for_array(location, spec, future, deadline)
            arrays.append((layout.at_time(array, time), files))
        self._blocks, self._cells = arrays[: layout.levels], arrays[layout.levels :]
        self._known_shards: set[tuple[Any, ...]] = set()
        self._checksums = Checksums(location, root, layout, time)

    def read_cells(self, level: int, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        """Reads (z, y, x, 3, c) cells, see `Store.read_cells`, with all channels of the store."""
        array, files = self._cells[level]
        future = begin_read(array[boxes.index(low, high)], files)
        data = deadline.wait(future, f"{self.location}: cells of level {level}")
        self.check_shards(self._layout.cells(level), data, low, high, deadline)
        return data

    def read_blocks(
        self, level: int, zyx: np.ndarray, deadline: Deadline
    ) -> tuple[np.ndarray, BlockErrors]:
        """Reads blocks as `Store.read_blocks` does; `zyx` must lie inside the grid."""
        layout = self._layout
        shape = (len(zyx), *[layout.bordered_side] * 3)
        out = np.empty((*shape, layout.width), layout.dtype)
        shard = zyx // (layout.shard // layout.block)
        order = np.lexsort((*zyx.T[::-1], *shard.T[::-1]))
        errors = self._read_chunks(self._blocks[level], level, zyx, order, out, deadline)
        for shard_index, rows in zip(*group_rows(shard), strict=True):
            try:
                self._checksums.check(layout.blocks(level), tuple(shard_index.tolist()), deadline)
            except (StoreError, ValueError) as error:
                for row in rows.tolist():
                    out[row] = 0
                    errors.setdefault(row, block_error(self.location, level, zyx[row], error))
        for row in _zero_rows(out):
            if row not in errors:
                try:
                    self._fill_unstored(level, zyx[row], out[row], deadline)
                except StoreError as error:
                    errors[row] = block_error(self.location, level, zyx[row], error)
        return out[..., self._channels], errors

    def read_coarse(
        self, spec: dict[str, Any], level: int, zyx: np.ndarray, deadline: Deadline
    ) -> tuple[np.ndarray, BlockErrors]:
        """Reads blocks of a coarse channel's array as `Store.read_coarse` does."""
        array = begin_open(self._root, spec)
        chunked = wait_for_array(self.location, spec, array, deadline)
        out = np.empty((len(zyx), *chunked[0].shape[3:]), np.float16)
        order = np.lexsort(zyx.T[::-1])
        errors = self._read_chunks(chunked, level, zyx, order, out, deadline)
        for row in _zero_rows(out):  # zeros are written, too: the shard of a zero block must exist
            try:
                if row not in errors:
                    low = zyx[row].tolist()
                    high = [n + 1 for n in low]
                    self.check_shards(spec, out[row][None, None, None], low, high, deadline)
            except StoreError as error:
                errors[row] = block_error(self.location, level, zyx[row], error)
        return out, errors

    def _read_chunks(
        self,
        chunked: ChunkedArray,
        level: int,
        zyx: np.ndarray,
        order: np.ndarray,
        out: np.ndarray,
        deadline: Deadline,
        batch: int = _BATCH_BLOCKS,
    ) -> BlockErrors:
        """Fills the rows `order` of `out` in batches, reading the next batch meanwhile. Blocks of a
        batch that fails are read one by one, to find the bad ones; returns their errors.
        """
        array, files = chunked
        chunks = files.chunk_indices(self._time, zyx, array.shape[3:])
        errors = BlockErrors()
        pending: deque[tuple[np.ndarray, Any]] = deque()

        def finish_oldest() -> None:
            rows, future = pending.popleft()
            try:
                out[rows] = deadline.wait(future, self.location)
            except StoreError as error:
                if batch > 1:
                    errors.update(self._read_chunks(chunked, level, zyx, rows, out, deadline, 1))
                else:
                    out[rows] = 0
                    errors[int(rows[0])] = block_error(self.location, level, zyx[rows[0]], error)

        try:
            for start in range(0, len(order), batch):
                rows = order[start : start + batch]
                z, y, x = zyx[rows].T
                needed_chunks = None if chunks is None else chunks[rows]
                pending.append((rows, begin_read(array[z, y, x], files, needed_chunks)))
                if len(pending) * batch >= _BLOCKS_AHEAD:
                    finish_oldest()
            while pending:
                finish_oldest()
        finally:
            for _, future in pending:
                future.cancel()
        return errors

    def _fill_unstored(
        self, level: int, block_index: np.ndarray, block: np.ndarray, deadline: Deadline
    ) -> None:
        """Fills a block that was read as all zeros, so may not be stored, with its values from
        cells or pyramid; raises StoreError if it should have been stored.
        """
        low = block_index * (self._layout.block // CELL)
        high = np.minimum(low + self._layout.block // CELL, self._layout.grid(level, CELL))
        cells = self.read_cells(level, low.tolist(), high.tolist(), deadline)
        if (cells == cells[:1, :1, :1, :1]).all():
            block[:] = cells[0, 0, 0, 0]
            return
        low = block_index * self._layout.block - BORDER
        values = self._levels.read(level, low.tolist(), (low + len(block)).tolist(), deadline)
        if needed_cells(cells, self._layout.threshold).any() and (
            level == 0 or values.any() or cells[..., 2, :].any()
        ):
            raise StoreError("missing chunk")
        block[..., self._channels] = values

    def check_shards(
        self, spec: dict[str, Any], data: np.ndarray, low: Zyx, high: Zyx, deadline: Deadline
    ) -> None:
        """Raises StoreError if a shard of `data`, items `low` to `high` of an array, is not the one
        that was written, or if zeros come from a missing shard: these arrays are written in full,
        zeros included.
        """
        context, is_coarse = f"{self.location}/{spec['path']}", "coarse" in spec["path"]
        shape = spec["metadata"]["chunk_grid"]["configuration"]["chunk_shape"]
        time_index = (self._time,) if self._layout.times > 1 and not is_coarse else ()
        shape = shape[len(time_index) :]
        space_axis = len(shape) == 4  # c, z, y, x
        side = shape[space_axis]
        shard_indices = [*boxes.tile_indices(low, high, [side] * 3)]
        for shard_index in () if is_coarse else shard_indices:
            self._checksums.check(spec, shard_index, deadline)
        for shard_index in shard_indices:
            key = (spec["path"], *shard_index)
            corner = np.multiply(shard_index, side) - low
            if key in self._known_shards or data[boxes.index(corner.clip(0), corner + side)].any():
                continue
            name = shard_path(spec, (*time_index, *shard_index))
            if read_key(self.location, self._root, name, deadline, slice(0, 1)) is None:
                raise StoreError(f"{context}: shard {shard_index} z y x: missing chunk")
            self._known_shards.add(key)


def cut_blocks(
    levels: LevelReader,
    location: str,
    level: int,
    zyx: np.ndarray,
    layout: StoreLayout,
    deadline: Deadline,
) -> tuple[np.ndarray, BlockErrors]:
    """Reads blocks as `Store.read_blocks` does, of an image that has none: cuts them out of region
    reads; neighbours share a read if that reads less.
    """
    block, side = layout.block, layout.bordered_side
    out = np.zeros((len(zyx), side, side, side, levels.width), layout.dtype)
    errors = BlockErrors()

    def read(rows: np.ndarray) -> None:
        low = zyx[rows].min(0) * block - BORDER
        high = zyx[rows].max(0) * block + block + BORDER
        try:
            data = levels.read(level, low.tolist(), high.tolist(), deadline)
        except StoreError as error:
            if len(rows) == 1:
                errors[int(rows[0])] = block_error(location, level, zyx[rows[0]], error)
            for i in rows if len(rows) > 1 else ():
                read(np.array([i]))
            return
        for i in rows:
            corner = zyx[i] * block - BORDER - low
            out[i] = data[boxes.index(corner, corner + side)]

    with ThreadPoolExecutor(_READER_THREADS) as threads:
        for _ in threads.map(read, _group_blocks(zyx, side)):
            pass
    return out, errors


def block_error(location: str, level: int, block_index: np.ndarray, error: Exception) -> str:
    """Returns the message on a block that can't be read."""
    z, y, x = block_index.tolist()
    text = str(error).removeprefix(f"{location}: ")
    return f"{location}: block ({z}, {y}, {x}) z y x of level {level}: {text}"


def wait_for_array(
    location: str, spec: dict[str, Any], future: Any, deadline: Deadline
) -> ChunkedArray:
    """Waits for an array to open; raises ValueError if its shape or dtype is not its spec's."""
    context, expected = f"{location}/{spec['path']}", spec["metadata"]
    array = deadline.wait(future, context)
    if list(array.shape) != expected["shape"] or array.dtype.name != expected["data_type"]:
        raise ValueError(f"{context}: damaged: {array.shape} {array.dtype.name}")
    return array, files_of(context, array)


def needed_cells(cells: np.ndarray, threshold: float | None) -> np.ndarray:
    """Returns (z, y, x) bool: which of the cells (z, y, x, 3, c) are neither CONSTANT nor EMPTY."""
    low, high = cells[..., 0, :], cells[..., 1, :]
    needed = (low != high).any(-1)
    if threshold is not None:  # compared in float32, as in the tree
        needed &= (high.astype(np.float32) > np.float32(threshold)).any(-1)
    return needed


def _zero_rows(out: np.ndarray) -> list[int]:
    rows = out.reshape(len(out), -1)
    candidates = np.flatnonzero(~rows[:, :64].any(1)).tolist()
    return [row for row in candidates if not rows[row].any()]


def _group_blocks(zyx: np.ndarray, side: int) -> list[np.ndarray]:
    """Returns groups of indices of blocks, each to be read as one region."""
    groups = []
    for rows in group_rows(zyx // _GROUP_BLOCKS)[1]:
        extent = (np.ptp(zyx[rows], axis=0) + 1) * (side - 2 * BORDER) + 2 * BORDER
        is_dense = math.prod(extent.tolist()) <= 2 * len(rows) * side**3
        groups += [rows] if is_dense else [np.array([i]) for i in rows]
    return groups
