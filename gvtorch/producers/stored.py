"""`StoredProducer`: bricks from a store on disk or behind a URL, read while the engine goes on.

Reading threads answer in batches. Blocks are kept in a bounded host cache, since one block holds
many bricks; a block that several batches want is read once. What a block's cells tell (smallest and
largest value) decides which nodes are CONSTANT or EMPTY, and which a transfer function does not
show, before any voxel is read.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided

from ..base import check
from ..io.store import Store
from ..pool import Channel
from ..pool.downsample import pool_mean
from ..pool.pyramid import round_to
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions

_TILE = 32  # cells along a side of what is read at once
_GROUP_BYTES = 32 * 10**6  # of blocks held at a time beside the cache
_CHANNEL = "value"

Key = tuple[str, int, int, int, int, int]  # what, level, z, y, x, border


class StoredProducer(Producer):
    """Streams a `gvtorch convert` store, or any OME-Zarr image. Its channel is "value"."""

    patience = float("inf")  # reads end by themselves, by `timeout`

    def __init__(
        self,
        store: Store | str | Path,
        *,
        host_cache: int | str = "512 MB",
        timeout: float = 30.0,
        workers: int = 4,
        image: str | None = None,
        time: int = 0,
        channels: Sequence[int] | None = None,
    ) -> None:
        """Opens the store.

        Args:
            store: An open store, a folder or a URL.
            host_cache: Bytes of decoded blocks and cells kept in host memory; reads that run hold
                up to 64 MB more in each thread.
            timeout: Seconds until a read is given up.
            workers: Threads that read.
            image: Which image, see `Store.open`.
            time: Which time point.
            channels: Which channels, as components of "value"; None takes all.

        Raises:
            ValueError: A number is out of its range, or see `Store.open`.
            OSError: The store can't be read.
        """
        limit = check.nbytes("StoredProducer", "host_cache", host_cache)
        check.whole("StoredProducer", "workers", workers, low=1, high=64)
        self_timeout = check.number("StoredProducer", "timeout", timeout, low=0, open_low=True)
        if not isinstance(store, Store):
            store = Store.open(store, image=image, time=time, channels=channels)
        ranges = store.value_range
        super().__init__(
            store.extent,
            channels={_CHANNEL: Channel(store.dtype, store.width)},
            spacing=store.spacing,
            origin=store.origin,
            value_range=None
            if ranges is None
            else {_CHANNEL: (min(low for low, _ in ranges), max(high for _, high in ranges))},
        )
        self.store, self.timeout = store, self_timeout
        self._cache = HostCache(limit)
        self._closed = threading.Event()
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="gvtorch-store")

    def classify(self, nodes: Nodes) -> Regions | Future:
        """CONSTANT and EMPTY as the cells tell, later; all DATA where the store has none."""
        if not self.store.has_blocks:
            return Regions(kind=torch.full((len(nodes),), Region.DATA))
        return self._threads.submit(self._classify, nodes)

    def fill(self, nodes: Nodes) -> Future:
        """Reads and cuts bricks, later."""
        return self._threads.submit(self._fill, nodes)

    def close(self) -> None:
        """Ends the threads; reads that run are not waited for."""
        self._closed.set()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _classify(self, nodes: Nodes) -> Regions:
        """Joins the cells that a node's brick and border reach into."""
        layout, store = nodes.layout, self.store
        loc = nodes.loc.cpu().numpy()
        level = layout.depth - loc[:, 3]
        known = level < store.levels
        low = np.zeros((len(loc), store.width), np.float32)
        high, mean = low.copy(), low.copy()
        count = np.zeros((len(loc), 1), np.float32)
        errors: dict[int, str] = {}
        reach = layout.border - store.border if layout.border > store.border else 0
        first = (loc[:, 2::-1] * layout.brick_size - reach) // store.cell
        last = -(-((loc[:, 2::-1] + 1) * layout.brick_size + reach) // store.cell)
        for here in np.unique(level[known]):
            rows = np.flatnonzero(level == here)
            grid = np.array(store.cell_grid(int(here)))
            inside = (first[rows] < grid).all(1)
            rows = rows[inside]
            if not len(rows):
                continue
            begin, end = first[rows].clip(0), np.minimum(last[rows], grid)
            for offset in np.ndindex(*(end - begin).max(0)):
                at = begin + np.array(offset)
                some = (at < end).all(1)
                cells, wrong = self._cells(int(here), at[some])
                to = rows[some]
                errors.update({int(to[index]): text for index, text in wrong.items()})
                fresh = count[to] == 0
                low[to] = np.where(fresh, cells[:, 0], np.minimum(low[to], cells[:, 0]))
                high[to] = np.where(fresh, cells[:, 1], np.maximum(high[to], cells[:, 1]))
                mean[to] += cells[:, 2]
                count[to] += 1
        mean /= np.maximum(count, 1)
        flat = (low == high).all(1) & (count[:, 0] > 0)
        kind = torch.where(torch.from_numpy(flat), Region.CONSTANT, Region.DATA)
        if store.threshold is not None:
            empty = (high <= store.threshold).all(1) & (count[:, 0] > 0)
            kind = torch.where(torch.from_numpy(empty), Region.EMPTY, kind)
        value = np.where(flat[:, None], low, mean)
        ends = np.stack((low, high), 1)
        smallest, largest = self.channels[_CHANNEL].limits
        unknown = count[:, 0] == 0  # coarser than the store's levels, or outside the volume
        ends[unknown] = np.array([smallest, largest], np.float32)[:, None]
        return Regions(
            kind=kind,
            constants={_CHANNEL: round_to(torch.from_numpy(value), store.dtype)},
            ranges={_CHANNEL: round_to(torch.from_numpy(ends), store.dtype)},
            errors=errors,
        )

    def _cells(self, level: int, at: np.ndarray) -> tuple[np.ndarray, dict[int, str]]:
        """(k, 3, c) float32 low, high, mean of cells (k, 3) z y x; errors by row."""
        store, grid = self.store, self.store.cell_grid(level)
        out = np.zeros((len(at), 3, store.width), np.float32)
        errors: dict[int, str] = {}
        tiles, which = np.unique(at // _TILE, axis=0, return_inverse=True)

        def read(missing: list[Key]) -> dict[Key, np.ndarray | str]:
            found: dict[Key, np.ndarray | str] = {}
            for key in missing:
                begin = np.array(key[2:5]) * _TILE
                end = np.minimum(begin + _TILE, grid)
                try:
                    found[key] = store.read_cells(
                        level, begin.tolist(), end.tolist(), timeout=self.timeout
                    )
                except (OSError, ValueError) as error:
                    found[key] = str(error)
            return found

        keys: list[Key] = [("cells", level, *tile, 0) for tile in tiles.tolist()]
        for number, tile in enumerate(self._cache.get(keys, read)):
            rows = np.flatnonzero(which.reshape(-1) == number)
            if isinstance(tile, str):
                errors.update(dict.fromkeys(rows.tolist(), tile))
                continue
            z, y, x = (at[rows] % _TILE).T
            out[rows] = tile[z, y, x]
        return out, errors

    def _fill(self, nodes: Nodes) -> Bricks:
        layout, store = nodes.layout, self.store
        side = layout.brick_size + 2 * layout.border
        loc = nodes.loc.cpu().numpy()
        level = layout.depth - loc[:, 3]
        dtype = np.dtype(str(store.dtype).removeprefix("torch."))
        out = np.zeros((len(loc), side, side, side, store.width), dtype)
        errors: dict[int, str] = {}
        cuts = self._cuts(layout)
        for here in np.unique(level):
            rows = np.flatnonzero(level == here)
            if here < store.levels:
                self._cut(out, rows, loc[rows, 2::-1], int(here), cuts, errors)
            else:
                self._fill_beyond(out, rows, loc[rows, 2::-1], int(here), layout, errors)
        data = torch.from_numpy(out)
        if store.has_blocks:
            return Bricks(data={_CHANNEL: data}, errors=errors)
        # No cells: what the finest level shows to be uniform is found here.
        flat = (out == out[:, :1, :1, :1]).all((1, 2, 3, 4)) & (level == 0)
        kind = torch.where(torch.from_numpy(flat), Region.CONSTANT, Region.DATA)
        constants = {_CHANNEL: data[:, 0, 0, 0]}
        return Bricks(data={_CHANNEL: data}, kind=kind, constants=constants, errors=errors)

    def _cuts(self, layout: Layout) -> _Cuts:
        """Bricks are cut out of the store's blocks where they fit in with their border, else out of
        regions of about that size.
        """
        store, size = self.store, layout.brick_size
        if store.block % size == 0 and layout.border <= store.border:
            return _Cuts("block", size, store.block // size, store.border - layout.border)
        return _Cuts("region", size, max(1, 2 * store.block // size), 0)

    def _read(self, level: int, side: int, keys: list[Key]) -> dict[Key, np.ndarray | str]:
        """Blocks, or regions of `side` voxels whose border is part of them."""
        store, places = self.store, np.array([key[2:5] for key in keys], np.int64)
        if keys[0][0] == "block":
            data, wrong = store.read_blocks(level, places, timeout=self.timeout)
            return {key: wrong.get(i) or data[i].copy() for i, key in enumerate(keys)}
        border, found = keys[0][5], dict[Key, np.ndarray | str]()
        for key, place in zip(keys, places, strict=True):
            low = place * side - border
            high = (low + side + 2 * border).tolist()
            try:
                found[key] = store.read_region(level, low.tolist(), high, timeout=self.timeout)
            except TimeoutError:
                raise
            except (OSError, ValueError) as error:
                found[key] = str(error)
        return found

    def _cut(
        self,
        out: np.ndarray,
        rows: np.ndarray,
        zyx: np.ndarray,
        level: int,
        cuts: _Cuts,
        errors: dict[int, str],
    ) -> None:
        """Cuts bricks of one level out of larger cubes, a group of cubes at a time. After a read
        that does not come in time, the others of this batch are not waited for.
        """
        cubes, which = np.unique(zyx // cuts.bricks, axis=0, return_inverse=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        starts = np.searchsorted(which.reshape(-1)[order], np.arange(len(cubes) + 1))
        corner = zyx % cuts.bricks * cuts.size + cuts.offset
        side, late = out.shape[1], ""
        border = (side - cuts.size) // 2 + cuts.offset

        def read(missing: list[Key]) -> dict[Key, np.ndarray | str]:
            nonlocal late
            if self._closed.is_set() or late:
                return dict.fromkeys(missing, late or f"{self.store.location}: closed")
            try:
                return self._read(level, cuts.bricks * cuts.size, missing)
            except TimeoutError as error:
                late = str(error)
                return dict.fromkeys(missing, late)
            except (OSError, ValueError) as error:
                return dict.fromkeys(missing, str(error))

        cube_side = cuts.bricks * cuts.size + 2 * border
        group = max(1, _GROUP_BYTES // (cube_side**3 * self.store.width * out.itemsize))
        for begin in range(0, len(cubes), group):
            part = cubes[begin : begin + group].tolist()
            found = self._cache.get([(cuts.what, level, *at, border) for at in part], read)
            for number, cube in enumerate(found, begin):
                here = order[starts[number] : starts[number + 1]]
                if isinstance(cube, str):
                    errors.update(dict.fromkeys(rows[here].tolist(), cube))
                    continue
                last = tuple(n - side + 1 for n in cube.shape[:3])
                shape, strides = (*last, *out.shape[1:]), (*cube.strides[:3], *cube.strides)
                out[rows[here]] = as_strided(cube, shape, strides)[tuple(corner[here].T)]

    def _fill_beyond(
        self,
        out: np.ndarray,
        rows: np.ndarray,
        zyx: np.ndarray,
        level: int,
        layout: Layout,
        errors: dict[int, str],
    ) -> None:
        """Makes bricks of levels coarser than the store's out of its last one, a few voxels."""
        last = self.store.levels - 1
        shape = self.store.level_extent(last)[::-1]
        try:
            values = self.store.read_region(last, (0, 0, 0), shape, timeout=self.timeout)
        except (OSError, ValueError) as error:
            errors.update(dict.fromkeys(rows.tolist(), str(error)))
            return
        for _ in range(level - last):
            values = pool_mean(values, 2)
        reach = np.arange(out.shape[1]) - layout.border
        for row, place in zip(rows, zyx, strict=True):
            z, y, x = (
                (at * layout.brick_size + reach).clip(0, n - 1)
                for at, n in zip(place, values.shape, strict=False)
            )
            out[row] = values[np.ix_(z, y, x)]


@dataclass(frozen=True)
class _Cuts:
    """How bricks lie in the cubes that they are cut from."""

    what: str  # block, or region
    size: int  # voxels along a side of a brick
    bricks: int  # along a side of a cube
    offset: int  # voxels from a cube's stored corner to its first brick's


class HostCache:
    """Arrays by key, the least recently used dropped beyond a number of bytes. What several threads
    miss at once is read by one of them.
    """

    def __init__(self, limit: int) -> None:
        """Holds nothing yet."""
        self.limit, self.nbytes = limit, 0
        self._kept: OrderedDict[Hashable, np.ndarray] = OrderedDict()
        self._reading: dict[Hashable, Future] = {}
        self._lock = threading.Lock()

    def get(
        self,
        keys: Sequence[Key],
        read: Callable[[list[Key]], dict[Key, np.ndarray | str]],
    ) -> list[np.ndarray | str]:
        """Returns an array for each key, or why there is none.

        Args:
            keys: Each once.
            read: Called with the keys that nobody has or reads; texts are errors, and not kept.
        """
        found: dict[Key, np.ndarray | str] = {}
        mine: list[Key] = []
        others: dict[Key, Future] = {}
        with self._lock:
            for key in keys:
                if key in self._kept:
                    self._kept.move_to_end(key)
                    found[key] = self._kept[key]
                elif key in self._reading:
                    others[key] = self._reading[key]
                else:
                    mine.append(key)
                    self._reading[key] = Future()
        if mine:
            found.update(self._read(mine, read))
        for key, future in others.items():
            found[key] = future.result()
        return [found[key] for key in keys]

    def _read(
        self, mine: list[Key], read: Callable[[list[Key]], dict[Key, np.ndarray | str]]
    ) -> dict[Key, np.ndarray | str]:
        arrived: dict[Key, np.ndarray | str] = {}
        try:
            arrived = read(mine)
        finally:
            with self._lock:
                for key in mine:
                    value = arrived.get(key, "the read was broken off")
                    self._reading.pop(key).set_result(value)
                    if isinstance(value, np.ndarray) and value.nbytes <= self.limit:
                        self._kept[key] = value
                        self.nbytes += value.nbytes
                while self.nbytes > self.limit:
                    _, dropped = self._kept.popitem(last=False)
                    self.nbytes -= dropped.nbytes
        return arrived
