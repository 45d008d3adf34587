"""`Store`: a volume on disk or behind a URL, read block by block or region by region.

Opens what `convert` writes (see store_layout.py) and any other OME-Zarr image (NGFF on Zarr v2 or
v3). The latter has no bordered blocks and no cells: its blocks are cut out of region reads, which
is slower. Writing is in conversion.py.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...base import boxes, check
from ...base.boxes import Zyx, group_rows
from ...base.labels import background, counted
from ...pool.downsample import pool_majority, pool_mean
from .checksums import Checksums, json_checksum, shard_path
from .chunk_files import ChunkFiles, begin_read, files_of
from .level_reader import LevelReader, Pool, keep_channels, open_arrays
from .ngff import find_image, read_json
from .store_layout import (
    BORDER,
    CELL,
    DTYPES,
    CoarseChannel,
    Deadline,
    StoreError,
    StoreLayout,
    begin_open,
    child,
    kvstore,
    read_key,
    value_dtype,
)

_OPEN_TIMEOUT = 20.0  # seconds
_BATCH_BLOCKS = 256  # blocks read at once; larger batches only cost memory traffic
_BLOCKS_AHEAD = 2 * _BATCH_BLOCKS  # blocks being read at a time
_GROUP_BLOCKS = 4  # blocks along a side of a group that may be read as one region
_READER_THREADS = 4  # threads that read such groups
ChunkedArray = tuple[Any, ChunkFiles]  # one of tensorstore's arrays, and its files


class Store:
    """A volume that is read in parts. Safe to use from several threads. Can be pickled: unpickling
    opens it again. A process that was forked after a store was opened can't read any store.

    Attributes:
        location: Path or URL.
        name: The image's name.
        extent: (x, y, z) voxels of the finest level.
        spacing: (x, y, z) world size of a finest voxel.
        origin: (x, y, z) world position of the centre of voxel 0.
        info: Unit, names and colours of channels, time step, ...
        dropped: Phrases on metadata that is not kept.
        times: Number of time points.
        time: The time point that is read.
        dtype: torch dtype of the values.
        width: Number of channels.
        levels: Number of tree levels; the last one is at most 8 voxels wide.
        block: Voxels along a side of a block, without border.
        border: Voxels around a block.
        cell: Voxels along a side of a cell.
        has_blocks: Whether bordered blocks and cells are stored, so whether `convert` made it.
        value_range: [low, high] of each channel, or None if the store does not have it.
        threshold: Regions with no value above it are EMPTY; None: no region is.
        all_channels: Whether it was opened with all of its channels, in their stored order.
        coarse: Its coarse channels by name; see coarse.py.
        label_values: (k,) int64, where labels are indexed: value i is the label label_values[i].
            None: values are the labels.
        pool: Reduces voxels to coarser ones: to the mean, or to the most frequent label.
        layout: The store's parameters and the arrays that follow from them.
        root: tensorstore's spec of its folder.
    """

    def __init__(
        self,
        location: str | Path,
        *,
        image: str | None = None,
        time: int = 0,
        channels: Sequence[int] | None = None,
    ) -> None:
        """See `open`."""
        arguments = {"image": image, "time": time, "channels": channels}
        self._arguments: dict[str, Any] = {"location": location, **arguments}
        context, root, deadline = str(location), kvstore(location), Deadline(_OPEN_TIMEOUT)
        check.text(context, "image", image)
        parent = root
        root, pyramid, own_layout = find_image(context, root, image, deadline)
        # A channel of a store of several: its folder is a store, too.
        if own_layout and root != parent:
            context = root if isinstance(root, str) else root["path"].rstrip("/")
        arrays, channel_index, sizes = open_arrays(context, root, pyramid, time, channels, deadline)
        dtype = value_dtype(arrays[0].array.dtype.numpy_dtype)
        if dtype not in DTYPES:
            raise ValueError(f"{context}: dtype {dtype} is unknown; known: {', '.join(DTYPES)}")
        x, y, z, width = (arrays[0].size(axis) for axis in "xyzc")
        self.time, self.times = time, sizes.get("t", 1)
        self.layout = layout = own_layout or StoreLayout(extent=(x, y, z), dtype=dtype, width=width)
        differs = (layout.extent, layout.dtype) != ((x, y, z), dtype)
        if differs or (own_layout and own_layout.times != self.times):
            raise ValueError(f"{context}: damaged: metadata and level 0 differ in extent or dtype")
        label_values = (
            None if layout.label_count is None else _read_labels(context, root, layout, deadline)
        )
        self.label_values = None if label_values is None else torch.from_numpy(label_values)
        self.pool: Pool = pool_mean
        if pyramid.info.labels:
            self.pool = partial(pool_majority, background=background(label_values))
        self._levels = LevelReader(arrays, layout, self.pool)
        keep_channels(pyramid, sizes, channel_index)
        self.location, self.root, self.has_blocks = (
            context,
            kvstore(context),
            own_layout is not None,
        )
        self.name, self.info, self.dropped = pyramid.name, pyramid.info, tuple(pyramid.dropped)
        spacing, origin = pyramid.scales[0].scale[::-1], pyramid.scales[0].translation[::-1]
        self.spacing, self.origin = check.grid_placement(context, spacing, origin, layout.extent)
        self.extent, self.levels, self.block = layout.extent, layout.levels, layout.block
        self.border, self.cell, self.threshold = BORDER, CELL, layout.threshold
        self.dtype: torch.dtype = getattr(torch, dtype)
        self.width, self._channels = self._levels.width, channel_index
        self.all_channels = isinstance(channel_index, slice)
        self.value_range: list[tuple[float, float]] | None = None
        if layout.value_range is not None:
            ranges = [(float(low), float(high)) for low, high in layout.value_range]
            self.value_range = [ranges[c] for c in np.arange(layout.width)[channel_index]]
        self.coarse: dict[str, CoarseChannel] = {}
        self._blocks: list[ChunkedArray] = []
        self._cells: list[ChunkedArray] = []
        self._known_shards: set[tuple[Any, ...]] = set()
        self._checksums = Checksums(context, self.root, layout, time)
        if own_layout:
            self._open_blocks_and_cells(deadline)
            if (
                pyramid.store_json.get("checksum", (computed := json_checksum(pyramid.store_json)))
                != computed
            ):
                raise ValueError(f"{context}: damaged: gvtorch's metadata is not what was written")

    @classmethod
    def open(
        cls,
        location: str | Path,
        *,
        image: str | None = None,
        time: int = 0,
        channels: Sequence[int] | None = None,
    ) -> Store:
        """Opens a store that `convert` wrote, or any OME-Zarr multiscale image.

        Args:
            location: A folder, or a URL (file://, http(s)://, s3://, gs://).
            image: Name, number or folder of the image, if the store has several.
            time: Index of the time point.
            channels: Indices of the channels to read, in this order; None reads all.

        Raises:
            ValueError: It is not a store, is half-written, damaged or too large, has a dtype that
                bricks can't hold, or has no such image, time or channel.
            OSError: It can't be read.
        """
        return cls(location, image=image, time=time, channels=channels)

    def at_time(self, time: int) -> Store:
        """Opens the store again at another time point; raises as `open`."""
        return Store.open(**{**self._arguments, "time": time})

    def __reduce__(self) -> Any:
        return partial(Store.open, **self._arguments), ()

    def _open_blocks_and_cells(self, deadline: Deadline) -> None:
        """Opens blocks and cells of all levels and checks their shapes and dtypes."""
        spec_makers = (self.layout.blocks, self._blocks), (self.layout.cells, self._cells)
        specs = [
            (make_spec(level), arrays)
            for make_spec, arrays in spec_makers
            for level in range(self.levels)
        ]
        for spec, arrays, future in [(*pair, begin_open(self.root, pair[0])) for pair in specs]:
            array, files = _wait_for_array(self.location, spec, future, deadline)
            arrays.append((self.layout.at_time(array, self.time), files))
        folder = child(self.root, self.coarse_folder)
        metadata = read_json(self.location, folder, "zarr.json", deadline)
        if metadata is not None:
            self.coarse = CoarseChannel.parse(self.location, metadata.get("attributes"))

    def __repr__(self) -> str:
        extent = "x".join(str(n) for n in self.extent)
        dtype = str(self.dtype).removeprefix("torch.")
        kind = f"blocks of {self.block}^3+{self.border}" if self.has_blocks else "no blocks"
        return (
            f"Store({self.location!r}, {extent} (x, y, z), {dtype}x{self.width}, "
            f"{self.levels} levels, {kind})"
        )

    @property
    def coarse_folder(self) -> str:
        """Path of its coarse channels inside the store."""
        return self.layout.coarse_folder(self.time)

    def describe(self) -> dict[str, Any]:
        """Returns extent, dtype, position, levels, range, size on disk etc. as plain values."""
        times = {"times": self.times, "time": self.time} if self.times > 1 else {}
        folder = Path(self.location)
        files = (file for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else ()
        return {
            "name": self.name,
            "extent": list(self.extent),
            "channels": self.width,
            "dtype": str(self.dtype).removeprefix("torch."),
            "spacing": list(self.spacing),
            "origin": list(self.origin),
            "unit": None,
            **self.info.describe(),
            **times,
            **({} if self.label_values is None else {"labels": counted(self.label_values)}),
            "levels": self.levels,
            "level extents": [list(self.level_extent(level)) for level in range(self.levels)],
            "blocks": f"{self.block}^3+{self.border}" if self.has_blocks else "none",
            "threshold": self.threshold,
            "range": [list(pair) for pair in self.value_range] if self.value_range else None,
            "coarse channels": ", ".join(self.coarse) or "none",
            "disk bytes": sum(file.stat().st_size for file in files),
            **({"not kept": list(self.dropped)} if self.dropped else {}),
        }

    def level_extent(self, level: int) -> tuple[int, int, int]:
        """(x, y, z) voxels of a level, 0 the finest."""
        return self.layout.shape(self._checked_level(level))[::-1]

    def stored_level(self, level: int) -> int:
        """Returns the coarsest level up to `level` that is stored, not averaged on reading."""
        return self._levels.coarsest(self._checked_level(level))

    def block_grid(self, level: int) -> tuple[int, int, int]:
        """(z, y, x) number of blocks of a level."""
        return self.layout.grid(self._checked_level(level), self.block)

    def cell_grid(self, level: int) -> tuple[int, int, int]:
        """(z, y, x) number of cells of a level."""
        return self.layout.grid(self._checked_level(level), CELL)

    def read_region(self, level: int, low: Zyx, high: Zyx, *, timeout: float = 60.0) -> np.ndarray:
        """Reads a box of voxels of a level.

        Args:
            level: 0 is the finest.
            low: (z, y, x) first voxel; beyond the volume, edge voxels repeat.
            high: (z, y, x) one past the last voxel.
            timeout: Seconds.

        Returns:
            (z, y, x, c) of the store's dtype.

        Raises:
            TimeoutError: It took longer.
            OSError: A chunk is damaged or can't be read.
        """
        _check_box(low, high)
        deadline = Deadline(timeout)
        data = self._levels.read(self._checked_level(level), low, high, deadline)
        if self.has_blocks:
            start, stop = boxes.clamped_box(low, high, self.layout.shape(level))
            inside = data[boxes.index(np.subtract(start, low).clip(0), data.shape[:3])]
            self._check_shards(self.layout.pyramid(level), inside, start, stop, deadline)
        return data

    @property
    def is_remote(self) -> bool:
        """Whether it is read over a network."""
        return isinstance(self.root, str)

    @property
    def stored(self) -> str:
        """NumPy dtype that `read_stored` returns: the array's, before it is narrowed."""
        return (
            "int64"
            if self.label_values is not None
            else self._levels.finest.array.dtype.numpy_dtype.str
        )

    def read_stored(self, low: Zyx, high: Zyx, *, timeout: float = 60.0) -> np.ndarray:
        """Reads a box of finest voxels, (z, y, x, c), in the stored dtype; indexed labels are
        returned as labels. Box and errors as for `read_region`; the box lies inside the volume.
        """
        if not self.has_blocks:
            return self._levels.finest.read(low, high, Deadline(timeout))
        data = self.read_region(0, low, high, timeout=timeout)
        if self.label_values is None:
            return data
        return self.label_values.numpy()[data.astype(np.int64)]

    def read_cells(self, level: int, low: Zyx, high: Zyx, *, timeout: float = 60.0) -> np.ndarray:
        """Reads smallest, largest and mean value of a box of cells, if `convert` made the store.

        `low` and `high` are (z, y, x) cells inside `cell_grid(level)`.

        Returns:
            (z, y, x, 3, c) of the store's dtype: low and high over the finest voxels in the cell
            and in one voxel of this level around it; mean of the cell's voxels alone.

        Raises:
            ValueError: The store has no cells, or the box leaves the grid.
            TimeoutError, OSError: As `read_region`; also for a missing chunk.
        """
        if not self.has_blocks:
            raise ValueError(f"{self.location}: has no cells; gvtorch convert makes a store of it")
        _check_box(low, high)
        grid = self.cell_grid(level)
        if min(low) < 0 or any(b > n for b, n in zip(high, grid, strict=True)):
            raise ValueError(
                f"read_cells: {low} to {high} lies outside the grid {grid} of level {level}"
            )
        return self._read_cells(level, low, high, Deadline(timeout))[..., self._channels]

    def _read_cells(self, level: int, low: Zyx, high: Zyx, deadline: Deadline) -> np.ndarray:
        array, files = self._cells[level]
        future = begin_read(array[boxes.index(low, high)], files)
        data = deadline.wait(future, f"{self.location}: cells of level {level}")
        self._check_shards(self.layout.cells(level), data, low, high, deadline)
        return data

    def read_blocks(
        self, level: int, zyx: np.ndarray, *, timeout: float = 60.0
    ) -> tuple[np.ndarray, dict[int, str]]:
        """Reads many blocks with their borders, in bulk: (k, 3) z, y, x inside `block_grid(level)`.

        Returns:
            (k, s, s, s, c) with s = block + 2 * border, and an error message for each row of `zyx`
            that could not be read; these rows are zero.

        Raises:
            ValueError: A block lies outside the grid.
            TimeoutError: Reading all of them took longer.
        """
        zyx = np.asarray(zyx, np.int64).reshape(-1, 3)
        grid = self.block_grid(level)
        if zyx.size and (zyx.min() < 0 or (zyx >= grid).any()):
            raise ValueError(
                f"read_blocks: a position lies outside the grid {grid} of level {level}"
            )
        deadline, layout = Deadline(timeout), self.layout
        shape = (len(zyx), *[layout.bordered_side] * 3)
        if not self.has_blocks:
            out = np.zeros((*shape, self.width), layout.dtype)
            return out, self._cut_blocks(level, zyx, out, deadline)
        out = np.empty((*shape, layout.width), layout.dtype)
        shard = zyx // (layout.shard // self.block)
        order = np.lexsort((*zyx.T[::-1], *shard.T[::-1]))
        errors = self._read_chunks(self._blocks[level], level, zyx, order, out, deadline)
        for shard_index in np.unique(shard, axis=0):
            try:
                self._checksums.check(layout.blocks(level), tuple(shard_index.tolist()), deadline)
            except (StoreError, ValueError) as error:
                for row in np.flatnonzero((shard == shard_index).all(1)).tolist():
                    out[row] = 0
                    errors.setdefault(row, self._block_error(level, zyx[row], error))
        for row in _zero_rows(out):
            if row not in errors:
                try:
                    self._fill_unstored(level, zyx[row], out[row], deadline)
                except StoreError as error:
                    errors[row] = self._block_error(level, zyx[row], error)
        return out[..., self._channels], errors

    def read_coarse(
        self, name: str, level: int, zyx: np.ndarray, *, timeout: float = 60.0
    ) -> tuple[np.ndarray, dict[int, str]]:
        """Reads blocks of a coarse channel, at levels from 1 on, as `read_blocks` does.

        Returns:
            (k, s, s, s, c) float16, and an error message for each row that could not be read.

        Raises:
            KeyError: There is no such channel.
            ValueError, TimeoutError: As `read_blocks`.
        """
        channel, grid = self.coarse[name], self.block_grid(level)
        if level == 0 or (zyx.size and (zyx.min() < 0 or (zyx >= grid).any())):
            raise ValueError(
                f"read_coarse: a position lies outside the grid {grid} of level {level}"
            )
        deadline = Deadline(timeout)
        folder = f"{self.coarse_folder}/{channel.folder(name)}"
        spec = self.layout.coarse(level, folder, channel.width)
        chunked = _wait_for_array(self.location, spec, begin_open(self.root, spec), deadline)
        out = np.empty((len(zyx), *chunked[0].shape[3:]), np.float16)
        order = np.lexsort(zyx.T[::-1])
        errors = self._read_chunks(chunked, level, zyx, order, out, deadline)
        for row in _zero_rows(out):  # zeros are written, too: the shard of a zero block must exist
            try:
                if row not in errors:
                    low = zyx[row].tolist()
                    high = [n + 1 for n in low]
                    self._check_shards(spec, out[row][None, None, None], low, high, deadline)
            except StoreError as error:
                errors[row] = self._block_error(level, zyx[row], error)
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
    ) -> dict[int, str]:
        """Fills the rows `order` of `out` in batches, reading the next batch meanwhile. Blocks of a
        batch that fails are read one by one, to find the bad ones; returns their errors.
        """
        array, files = chunked
        chunks = files.chunk_indices(self.time, zyx, array.shape[3:])
        errors = dict[int, str]()
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
                    errors[int(rows[0])] = self._block_error(level, zyx[rows[0]], error)

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
        cells_per_block = self.block // CELL
        high = np.minimum((block_index + 1) * cells_per_block, self.cell_grid(level))
        cells = self._read_cells(
            level, (block_index * cells_per_block).tolist(), high.tolist(), deadline
        )
        if (cells == cells[:1, :1, :1, :1]).all():
            block[:] = cells[0, 0, 0, 0]
            return
        low = block_index * self.block - BORDER
        values = self._levels.read(level, low.tolist(), (low + len(block)).tolist(), deadline)
        if needed_cells(cells, self.threshold).any() and (
            level == 0 or values.any() or cells[..., 2, :].any()
        ):
            raise StoreError("missing chunk")
        block[..., self._channels] = values

    def _check_shards(
        self,
        spec: dict[str, Any],
        data: np.ndarray,
        low: Zyx,
        high: Zyx,
        deadline: Deadline,
    ) -> None:
        """Raises StoreError if a shard of `data`, items `low` to `high` of an array, is not the one
        that was written, or if zeros come from a missing shard: these arrays are written in full,
        zeros included.
        """
        context, is_coarse = f"{self.location}/{spec['path']}", "coarse" in spec["path"]
        shape = spec["metadata"]["chunk_grid"]["configuration"]["chunk_shape"]
        time_index = (self.time,) if self.times > 1 and not is_coarse else ()
        shape = shape[len(time_index) :]
        space_axis = len(shape) == 4  # c, z, y, x
        side = shape[space_axis]
        spans = [range(a // side, (b - 1) // side + 1) for a, b in zip(low, high, strict=True)]
        shard_indices = [*itertools.product(*spans)]
        for shard_index in () if is_coarse else shard_indices:
            self._checksums.check(spec, shard_index, deadline)
        for shard_index in shard_indices:
            key = (spec["path"], *shard_index)
            corner = np.multiply(shard_index, side) - low
            if key in self._known_shards or data[boxes.index(corner.clip(0), corner + side)].any():
                continue
            name = shard_path(spec, (*time_index, *shard_index))
            if read_key(self.location, self.root, name, deadline, slice(0, 1)) is None:
                raise StoreError(f"{context}: shard {shard_index} z y x: missing chunk")
            self._known_shards.add(key)

    def _cut_blocks(
        self, level: int, zyx: np.ndarray, out: np.ndarray, deadline: Deadline
    ) -> dict[int, str]:
        """Cuts blocks out of region reads; neighbours share a read if that reads less."""
        errors = dict[int, str]()
        side = self.layout.bordered_side

        def read(rows: np.ndarray) -> None:
            low = zyx[rows].min(0) * self.block - self.border
            high = zyx[rows].max(0) * self.block + self.block + self.border
            try:
                data = self._levels.read(level, low.tolist(), high.tolist(), deadline)
            except StoreError as error:
                if len(rows) == 1:
                    errors[int(rows[0])] = self._block_error(level, zyx[rows[0]], error)
                    return
                for i in rows:
                    read(np.array([i]))
                return
            for i in rows:
                z, y, x = zyx[i] * self.block - self.border - low
                out[i] = data[z : z + side, y : y + side, x : x + side]

        with ThreadPoolExecutor(_READER_THREADS) as threads:
            for _ in threads.map(read, _group_blocks(zyx, side)):
                pass
        return errors

    def _block_error(self, level: int, block_index: np.ndarray, error: Exception) -> str:
        z, y, x = block_index.tolist()
        text = str(error).removeprefix(f"{self.location}: ")
        return f"{self.location}: block ({z}, {y}, {x}) z y x of level {level}: {text}"

    def _checked_level(self, level: int) -> int:
        return check.integer(self.location, "level", level, low=0, high=self.levels - 1)


def _wait_for_array(
    location: str, spec: dict[str, Any], future: Any, deadline: Deadline
) -> ChunkedArray:
    """Waits for an array to open; raises ValueError if its shape or dtype is not its spec's."""
    context, expected = f"{location}/{spec['path']}", spec["metadata"]
    array = deadline.wait(future, context)
    if list(array.shape) != expected["shape"] or array.dtype.name != expected["data_type"]:
        raise ValueError(f"{context}: damaged: {array.shape} {array.dtype.name}")
    return array, files_of(context, array)


def _read_labels(location: str, root: Any, layout: StoreLayout, deadline: Deadline) -> np.ndarray:
    """Returns (k,) int64 the table of indexed labels."""
    spec = layout.labels()
    context = f"{location}/{spec['path']}"
    chunked = _wait_for_array(location, spec, begin_open(root, spec), deadline)
    labels: np.ndarray = deadline.wait(begin_read(*chunked), context)
    if not (labels[1:] > labels[:-1]).all():
        raise ValueError(f"{context}: damaged: labels must be ascending")
    return labels


def needed_cells(cells: np.ndarray, threshold: float | None) -> np.ndarray:
    """Returns (z, y, x) bool: which of the cells (z, y, x, 3, c) are neither CONSTANT nor EMPTY."""
    low, high = cells[..., 0, :], cells[..., 1, :]
    needed = (low != high).any(-1)
    if threshold is not None:  # compared in float32, as in the tree
        needed &= (high.astype(np.float32) > np.float32(threshold)).any(-1)
    return needed


def _zero_rows(out: np.ndarray) -> list[int]:
    """Returns the rows that are all zero."""
    rows = out.reshape(len(out), -1)
    candidates = np.flatnonzero(~rows[:, :64].any(1)).tolist()
    return [row for row in candidates if not rows[row].any()]


def _group_blocks(zyx: np.ndarray, side: int) -> list[np.ndarray]:
    """Returns groups of indices of blocks, each to be read as one region."""
    groups = []
    for rows in group_rows(zyx // _GROUP_BLOCKS)[1]:
        extent = (zyx[rows].max(0) - zyx[rows].min(0) + 1) * (side - 2 * BORDER) + 2 * BORDER
        if math.prod(extent.tolist()) <= 2 * len(rows) * side**3:
            groups.append(rows)
        else:
            groups += [np.array([i]) for i in rows]
    return groups


def _check_box(low: Zyx, high: Zyx) -> None:
    is_valid = len(low) == len(high) == 3 and all(a < b for a, b in zip(low, high, strict=True))
    if not is_valid:
        raise ValueError(f"low and high must be (z, y, x) with low < high, got {low} and {high}")
