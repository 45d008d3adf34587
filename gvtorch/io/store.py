"""`Store`: a volume on disk or behind a URL, read block by block, region by region.

Opens what `convert` writes (see layout.py) and any other OME-Zarr image (NGFF on Zarr v2 or v3).
The latter has no bordered blocks and no cells: its blocks are cut out of region reads, slower but
right. Writing is in convert.py.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..base import check
from . import ngff
from .level_reader import Deadline, LevelReader, StoreError, clamp_box
from .multiscale import find_image, open_arrays
from .store_layout import (
    BLOCKS,
    BORDER,
    CELL,
    DTYPES,
    StoreLayout,
    child,
    context,
    kvstore,
    level_count,
    level_shape,
    opened,
    value_dtype,
)

_OPEN_TIMEOUT = 20.0  # seconds
_BATCH = 256  # blocks read at once; more only makes memory travel
_AHEAD = 2  # batches on their way
_GROUP = 4  # blocks along a side of a group that may be read as one region
_READERS = 4  # threads that read such groups


class Store:
    """A volume that is read in parts. Safe to use from several threads.

    Attributes:
        location: Path or URL.
        name: The image's name.
        extent: (x, y, z) voxels of the finest level.
        spacing: (x, y, z) world size of a finest voxel.
        origin: (x, y, z) world place of the centre of voxel 0.
        unit: Unit of length, or None.
        dtype: torch dtype of the values.
        width: Number of channels.
        levels: Number of tree levels; the last one is at most 8 voxels wide.
        block: Voxels along a side of a block, without border.
        border: Voxels around a block.
        cell: Voxels along a side of a cell.
        has_blocks: Whether blocks are stored with their border, and cells are there.
        value_range: [low, high] of each channel, or None where the store does not tell.
        threshold: What EMPTY was decided by, or None.
    """

    def __init__(
        self,
        location: str,
        levels: LevelReader,
        count: int,
        image: ngff.MultiscaleImage,
        own: dict[str, Any] | None,
        channels: slice | list[int],
    ) -> None:
        """Takes what `open` found."""
        self.location, self.name, self.unit = location, image.name, image.unit
        self.extent, self.width = levels.extent, levels.width
        z, y, x = image.scales[0].scale
        self.spacing = (x, y, z)
        z, y, x = image.scales[0].translation
        self.origin = (x, y, z)
        self.levels, self.border, self.cell = count, BORDER, CELL
        self.dtype: torch.dtype = getattr(torch, levels.dtype.name)
        self.has_blocks = own is not None
        self.block: int = own["block"] if own else BLOCKS[0]
        self.threshold: float | None = own["threshold"] if own else None
        self.value_range: list[tuple[float, float]] | None = None
        self._levels, self._channels = levels, channels
        self._blocks: list[Any] = []
        self._cells: list[Any] = []
        self._root = kvstore(location)
        self._seen: set[tuple[Any, ...]] = set()
        if own is not None:
            ranges = [(float(low), float(high)) for low, high in own["value_range"]]
            picked = [ranges[c] for c in channels] if isinstance(channels, list) else ranges
            self.value_range = picked
            self._layout = StoreLayout(
                extent=self.extent, dtype=own["dtype"], width=own["channels"], block=self.block
            )

    @classmethod
    def open(
        cls,
        location: str | Path,
        *,
        image: str | None = None,
        time: int = 0,
        channels: Sequence[int] | None = None,
    ) -> Store:
        """Opens a store of ours or any OME-Zarr multiscale image.

        Args:
            location: A folder, or a URL (file://, http(s)://, s3://, gs://).
            image: Name, number or folder of the image, where the store has several.
            time: Which time point.
            channels: Which channels, in which order; None takes all.

        Raises:
            ValueError: It is no store, half-written, damaged, too large, of a dtype that has no
                place in a brick, or has no such image, time or channel.
            OSError: It can't be read.
        """
        where = str(location)
        root = kvstore(location)
        deadline = Deadline(_OPEN_TIMEOUT)
        root, found, own = find_image(where, root, image, deadline)
        stored, chosen = open_arrays(where, root, found, time, channels, deadline)
        dtype = value_dtype(stored[0].array.dtype.numpy_dtype)
        if dtype not in DTYPES:
            raise ValueError(f"{where}: dtype {dtype} is unknown; known: {', '.join(DTYPES)}")
        extent = tuple(stored[0].size(axis) for axis in "xyz")
        count = level_count(extent)
        levels = LevelReader(stored, count, np.dtype(dtype))
        if own and (list(extent) != own["extent"] or dtype != own["dtype"]):
            raise ValueError(f"{where}: damaged: metadata and level 0 differ in extent or dtype")
        self = cls(where, levels, count, found, own, chosen)
        if own:
            self._open_own(deadline)
        return self

    def _open_own(self, deadline: Deadline) -> None:
        """Opens blocks and cells of all levels, and compares them with what they must be."""
        specs = [self._layout.blocks(level) for level in range(self.levels)]
        specs += [self._layout.cells(level) for level in range(self.levels)]
        for spec, future in [(spec, opened(self._root, spec)) for spec in specs]:
            where = f"{self.location}/{spec['path']}"
            array = deadline.wait(future, where)
            wanted = spec["metadata"]
            if list(array.shape) != wanted["shape"] or array.dtype.name != wanted["data_type"]:
                raise ValueError(f"{where}: damaged: {array.shape} {array.dtype.name}")
            (self._blocks if "blocks" in spec["path"] else self._cells).append(array)

    def __repr__(self) -> str:
        """Shows location, extent, dtype, channels and levels."""
        extent = "x".join(str(n) for n in self.extent)
        dtype = str(self.dtype).removeprefix("torch.")
        kind = f"blocks of {self.block}^3+{self.border}" if self.has_blocks else "no blocks"
        return (
            f"Store({self.location!r}, {extent} (x, y, z), {dtype}x{self.width}, "
            f"{self.levels} levels, {kind})"
        )

    def describe(self) -> dict[str, Any]:
        """Returns extent, dtype, place, levels, range and size on disk as plain values."""
        folder = Path(self.location)
        files = (file for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else ()
        return {
            "name": self.name,
            "extent": list(self.extent),
            "channels": self.width,
            "dtype": str(self.dtype).removeprefix("torch."),
            "spacing": list(self.spacing),
            "origin": list(self.origin),
            "unit": self.unit,
            "levels": self.levels,
            "level extents": [list(self.level_extent(level)) for level in range(self.levels)],
            "blocks": f"{self.block}^3+{self.border}" if self.has_blocks else "none",
            "threshold": self.threshold,
            "range": [list(pair) for pair in self.value_range] if self.value_range else None,
            "disk bytes": sum(file.stat().st_size for file in files),
        }

    def level_extent(self, level: int) -> tuple[int, int, int]:
        """(x, y, z) voxels of a level, 0 the finest."""
        z, y, x = level_shape(self.extent, self._checked(level))
        return (x, y, z)

    def block_grid(self, level: int) -> tuple[int, int, int]:
        """(z, y, x) number of blocks of a level."""
        z, y, x = (-(-n // self.block) for n in level_shape(self.extent, self._checked(level)))
        return (z, y, x)

    def cell_grid(self, level: int) -> tuple[int, int, int]:
        """(z, y, x) number of cells of a level."""
        z, y, x = (-(-n // CELL) for n in level_shape(self.extent, self._checked(level)))
        return (z, y, x)

    def read_region(
        self, level: int, low: Sequence[int], high: Sequence[int], *, timeout: float = 60.0
    ) -> np.ndarray:
        """Reads a box of voxels of a level.

        Args:
            level: 0 is the finest.
            low: (z, y, x) first voxel; may lie outside, where the outermost voxels repeat.
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
        data = self._levels.read(self._checked(level), low, high, deadline)
        if self.has_blocks:
            start, stop = clamp_box(low, high, level_shape(self.extent, level))
            box = data[tuple(slice(max(0, a - b), None) for a, b in zip(start, low, strict=True))]
            self._check_shards(self._layout.plain(level), box, start, stop, 1, deadline)
        return data

    def read_cells(
        self, level: int, low: Sequence[int], high: Sequence[int], *, timeout: float = 60.0
    ) -> np.ndarray:
        """Reads smallest, largest and mean value of a box of cells, of our own stores only.

        Args:
            level: 0 is the finest.
            low: (z, y, x) first cell, inside `cell_grid(level)`.
            high: (z, y, x) one past the last cell.
            timeout: Seconds.

        Returns:
            (z, y, x, 3, c) of the store's dtype: low and high over the finest voxels in reach (one
            voxel of this level around the cell included), mean of the cell's own voxels.

        Raises:
            ValueError: The store has no cells, or the box leaves the grid.
            TimeoutError: It took longer.
            OSError: A chunk is damaged, missing or can't be read.
        """
        if not self.has_blocks:
            raise ValueError(f"{self.location}: has no cells; gvtorch convert makes a store of it")
        _check_box(low, high)
        grid = self.cell_grid(level)
        if min(low) < 0 or any(b > n for b, n in zip(high, grid, strict=True)):
            raise ValueError(f"read_cells: {low} to {high} leaves the grid {grid} of level {level}")
        deadline = Deadline(timeout)
        where = f"{self.location}: cells of level {level}"
        place = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        data = deadline.wait(self._cells[level][place].read(order="C"), where)
        spec = self._layout.cells(level)
        self._check_shards(spec, data, low, high, CELL, deadline)
        return data[..., self._channels]

    def read_blocks(
        self, level: int, zyx: np.ndarray, *, timeout: float = 60.0
    ) -> tuple[np.ndarray, dict[int, str]]:
        """Reads many blocks with their borders, in bulk.

        Args:
            level: 0 is the finest.
            zyx: (k, 3) whole numbers, places inside `block_grid(level)`.
            timeout: Seconds, for all of them.

        Returns:
            (k, s, s, s, c) with s = block + 2 * border, and for each place in `zyx` that could not
            be read what was wrong. Rows of those are zero.

        Raises:
            ValueError: A place lies outside the grid.
            TimeoutError: It took longer.
        """
        zyx = np.asarray(zyx, np.int64).reshape(-1, 3)
        grid = self.block_grid(level)
        if zyx.size and (zyx.min() < 0 or (zyx >= grid).any()):
            raise ValueError(f"read_blocks: a place leaves the grid {grid} of level {level}")
        deadline = Deadline(timeout)
        side = self.block + 2 * self.border
        kind = self._levels.dtype
        if not self.has_blocks:
            out = np.zeros((len(zyx), *[side] * 3, self.width), kind)
            return out, self._cut_blocks(level, zyx, out, deadline)
        out = np.empty((len(zyx), *[side] * 3, self._layout.width), kind)
        errors = self._bulk(level, zyx, out, deadline)
        for index in _blank(out):
            if int(index) not in errors:
                text = self._fill_in(level, zyx[index], out[index], deadline)
                if text:
                    errors[int(index)] = self._name(level, zyx[index], text)
        return out[..., self._channels], errors

    def _bulk(
        self, level: int, zyx: np.ndarray, out: np.ndarray, deadline: Deadline
    ) -> dict[int, str]:
        """Fills `out` in batches of neighbouring blocks, one batch ahead of the other."""
        array, errors = self._blocks[level], dict[int, str]()
        shard = zyx // (self._layout.shard // self.block)
        order = np.lexsort((*zyx.T[::-1], *shard.T[::-1]))
        running: deque[tuple[np.ndarray, Any]] = deque()

        def finish() -> None:
            index, future = running.popleft()
            try:
                out[index] = deadline.wait(future, self.location)
            except StoreError:
                errors.update(self._one_by_one(level, zyx, index, out, deadline))

        try:
            for start in range(0, len(order), _BATCH):
                index = order[start : start + _BATCH]
                z, y, x = zyx[index].T
                running.append((index, array[z, y, x].read(order="C")))
                if len(running) == _AHEAD:
                    finish()
            while running:
                finish()
        finally:
            for _, future in running:
                future.cancel()
        return errors

    def _one_by_one(
        self, level: int, zyx: np.ndarray, index: np.ndarray, out: np.ndarray, deadline: Deadline
    ) -> dict[int, str]:
        """Reads a batch that failed block by block, to tell the good from the bad."""
        errors = {}
        array = self._blocks[level]
        futures = [(int(i), array[tuple(map(int, zyx[i]))].read(order="C")) for i in index]
        for i, future in futures:
            try:
                out[i] = deadline.wait(future, self._name(level, zyx[i]))
            except StoreError as error:
                errors[i] = str(error)
                out[i] = 0
        return errors

    def _fill_in(self, level: int, at: np.ndarray, out: np.ndarray, deadline: Deadline) -> str:
        """Gives a block that came back as all zeros the values that it should have; returns what
        is wrong, if it should have been stored.
        """
        per = self.block // CELL
        low = at * per
        high = np.minimum(low + per, self.cell_grid(level))
        place = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
        try:
            where = self._name(level, at)
            cells = deadline.wait(self._cells[level][place].read(order="C"), where)
            spec = self._layout.cells(level)
            self._check_shards(spec, cells, low.tolist(), high.tolist(), CELL, deadline)
            if (cells == cells[:1, :1, :1, :1]).all():
                out[:] = cells[0, 0, 0, 0]
                return ""
            start = at * self.block - self.border
            box = start.tolist(), (start + self.block + 2 * self.border).tolist()
            found = self._levels.read(level, *box, deadline)
        except StoreError as error:
            return str(error)
        if needed_cells(cells, self.threshold).any() and (
            level == 0 or found.any() or cells[..., 2, :].any()
        ):
            return "missing chunk"
        out[..., self._channels] = found
        return ""

    def _check_shards(
        self,
        spec: dict[str, Any],
        data: np.ndarray,
        low: Sequence[int],
        high: Sequence[int],
        unit: int,
        deadline: Deadline,
    ) -> None:
        """Raises StoreError if zeros that were read come from a shard that is not there. Zeros of
        these arrays are written, so they are no reason for it.

        Args:
            spec: Of the array that was read.
            data: What was read, from `low` on.
            low: (z, y, x) first item.
            high: (z, y, x) one past the last item.
            unit: Voxels along a side of an item.
            deadline: Of the read.
        """
        import tensorstore as ts

        per = self._layout.shard // unit
        spans = [range(a // per, (b - 1) // per + 1) for a, b in zip(low, high, strict=True)]
        for place in itertools.product(*spans):
            key = (spec["path"], *place)
            part = tuple(
                slice(max(0, at * per - a), (at + 1) * per - a)
                for at, a in zip(place, low, strict=True)
            )
            if key in self._seen or data[part].any():
                continue
            where = f"{self.location}/{spec['path']}: shard {place} z y x"
            folder = child(self._root, spec["path"])
            store = deadline.wait(ts.KvStore.open(folder, context=context()), where)
            rank = len(spec["metadata"]["shape"])
            before = ["0"] if rank == 4 else []  # (c, z, y, x)
            name = "/".join(["c", *before, *map(str, place), *["0"] * (rank - 3 - len(before))])
            if deadline.wait(store.read(name, byte_range=slice(0, 1)), where).state != "value":
                raise StoreError(f"{where}: missing chunk")
            self._seen.add(key)

    def _cut_blocks(
        self, level: int, zyx: np.ndarray, out: np.ndarray, deadline: Deadline
    ) -> dict[int, str]:
        """Cuts blocks out of region reads; neighbours share one where that reads less."""
        errors = dict[int, str]()
        side = self.block + 2 * self.border

        def read(index: np.ndarray) -> None:
            low = zyx[index].min(0) * self.block - self.border
            high = zyx[index].max(0) * self.block + self.block + self.border
            try:
                data = self._levels.read(level, low.tolist(), high.tolist(), deadline)
            except StoreError as error:
                if len(index) == 1:
                    errors[int(index[0])] = self._name(level, zyx[index[0]], str(error))
                    return
                for i in index:
                    read(np.array([i]))
                return
            for i in index:
                z, y, x = zyx[i] * self.block - self.border - low
                out[i] = data[z : z + side, y : y + side, x : x + side]

        with ThreadPoolExecutor(_READERS) as threads:
            for _ in threads.map(read, _groups(zyx, side)):
                pass
        return errors

    def _name(self, level: int, at: np.ndarray, text: str = "") -> str:
        z, y, x = (int(n) for n in at)
        text = text.removeprefix(f"{self.location}: ")
        return f"{self.location}: block ({z}, {y}, {x}) z y x of level {level}" + (
            f": {text}" if text else ""
        )

    def _checked(self, level: int) -> int:
        return check.whole(self.location, "level", level, low=0, high=self.levels - 1)


def needed_cells(cells: np.ndarray, threshold: float | None) -> np.ndarray:
    """(z, y, x, 3, c) -> (z, y, x) bool: neither CONSTANT nor EMPTY."""
    low, high = cells[..., 0, :], cells[..., 1, :]
    needed = (low != high).any(-1)
    if threshold is not None:  # in float32, as the tree compares
        needed &= (high.astype(np.float32) > np.float32(threshold)).any(-1)
    return needed


def _blank(out: np.ndarray) -> np.ndarray:
    """Rows that are all zero."""
    rows = out.reshape(len(out), -1)
    likely = np.flatnonzero(~rows[:, :64].any(1))
    return np.array([i for i in likely if not rows[i].any()], np.int64)


def _groups(zyx: np.ndarray, side: int) -> list[np.ndarray]:
    """Indices of blocks to be read together."""
    groups = []
    _, which = np.unique(zyx // _GROUP, axis=0, return_inverse=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    for index in np.split(order, np.flatnonzero(np.diff(which.reshape(-1)[order])) + 1):
        if not len(index):
            continue
        span = (zyx[index].max(0) - zyx[index].min(0) + 1) * (side - 2 * BORDER) + 2 * BORDER
        if math.prod(span.tolist()) <= 2 * len(index) * side**3:
            groups.append(index)
        else:
            groups += [np.array([i]) for i in index]
    return groups


def _check_box(low: Sequence[int], high: Sequence[int]) -> None:
    fits = len(low) == len(high) == 3 and all(a < b for a, b in zip(low, high, strict=True))
    if not fits:
        raise ValueError(f"low and high must be (z, y, x) with low < high, got {low} and {high}")
