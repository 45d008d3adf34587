"""`StoredProducer`: bricks from a store on disk or at a URL, read while the engine continues. A
block of the store holds many bricks, so blocks are kept in a bounded host cache. Cells (smallest,
largest and mean value of 8^3 voxels) show which nodes need no bricks before any voxel is read.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided

from ..base import check
from ..base.boxes import group_rows
from ..base.stage import stage
from ..io.stores.store import Store
from ..pool import Channel
from ..pool.pyramid import NodeSummary
from ..shaders.filtered import Filtered
from .answer import regions_of
from .nodes import Layout, Nodes
from .producer import Bricks, Producer, Region, Regions

_TILE_CELLS = 32  # cells along a side of the cubes in which cells are read
_GROUP_BYTES = 32 * 10**6  # of cubes that are held at a time in addition to the cache
_VALUE_CHANNEL = "value"


Key = tuple[Any, ...]
ArrayOrMessage = np.ndarray | str  # an array, or why it can't be read
ReadArrays = Callable[[list[Key]], dict[Key, ArrayOrMessage]]


class HostCache:
    """Arrays by key; beyond `limit` bytes the least recently used are dropped. If several threads
    ask for a key at the same time, one of them reads it.
    """

    def __init__(self, limit: int) -> None:
        self.limit, self.nbytes = limit, 0
        self._arrays: OrderedDict[Key, np.ndarray] = OrderedDict()
        self._reading: dict[Key, Future[ArrayOrMessage]] = {}
        self._lock = threading.Lock()

    def get(self, keys: Sequence[Key], read: ReadArrays) -> list[ArrayOrMessage]:
        """Returns an array for each of the (distinct) keys, or an error message. `read` is called
        with the keys that are neither cached nor being read; messages are not cached.
        """
        results: dict[Key, ArrayOrMessage] = {}
        missing: list[Key] = []
        awaited: dict[Key, Future[ArrayOrMessage]] = {}
        with self._lock:
            for key in keys:
                if key in self._arrays:
                    self._arrays.move_to_end(key)
                    results[key] = self._arrays[key]
                elif key in self._reading:
                    awaited[key] = self._reading[key]
                else:
                    missing.append(key)
                    self._reading[key] = Future()
        try:
            results |= read(missing) if missing else {}
        finally:
            with self._lock:
                for key in missing:
                    value = results.get(key, "the read was broken off")
                    self._reading.pop(key).set_result(value)
                    if isinstance(value, np.ndarray) and value.nbytes <= self.limit:
                        self._arrays[key] = value
                        self.nbytes += value.nbytes
                while self.nbytes > self.limit:
                    _, dropped = self._arrays.popitem(last=False)
                    self.nbytes -= dropped.nbytes
        for key, future in awaited.items():
            results[key] = future.result()
        return [results[key] for key in keys]


@dataclass(frozen=True)
class _Cubes:
    """The cubes of voxels that the host cache keeps and bricks are cut from: the store's blocks if
    bricks with their border fit into them, else regions of about that size.
    """

    are_blocks: bool  # whether cubes are the store's blocks
    brick_size: int  # voxels along a side of a brick
    bricks_per_side: int  # bricks along a side of a cube
    border: int  # voxels around a cube

    @classmethod
    def of(cls, store: Store, layout: Layout) -> _Cubes:
        size = layout.brick_size
        if store.block % size == 0 and layout.border <= store.border:
            return cls(True, size, store.block // size, store.border)
        return cls(False, size, max(1, 2 * store.block // size), layout.border)

    @property
    def side(self) -> int:
        """Voxels along a side of a cube, without its border."""
        return self.bricks_per_side * self.brick_size


def _coarse_channel(store: Store, filtered: Filtered) -> dict[str, Channel]:
    """Returns the channel of a shader's filtered colours; ValueError if the store lacks them."""
    check.instance("StoredProducer", "filtered", filtered, Filtered)
    if not store.all_channels:
        raise ValueError(
            f"{store.location}: filtered colours are of all channels: leave channels out"
        )
    name = str(filtered.other)
    stored = store.coarse.get(name)
    if stored is None or stored.made_of != filtered.made_of:
        problem = "were made with another function or component" if stored else "are not there"
        raise ValueError(
            f"{store.location}: filtered colours {name!r} {problem}; "
            "gvtorch filter (Filtered.add_to) makes them"
        )
    return {name: Channel(torch.float16, stored.width, coarse=True)}


class StoredProducer(Producer):
    """Streams a `gvtorch convert` store, or any OME-Zarr image. Its channel is "value". Unpickling
    it, as in another process, opens the store again."""

    patience = float("inf")  # reads end by themselves, after `timeout`
    on_host = True

    def __init__(
        self,
        store: Store | str | Path,
        *,
        host_cache: int | str = "512 MB",
        timeout: float = 30.0,
        workers: int | None = None,
        image: str | None = None,
        time: int = 0,
        channels: Sequence[int] | None = None,
        filtered: Filtered | None = None,
    ) -> None:
        """Opens the store and starts the threads.

        Args:
            store: An open store, a folder or a URL.
            host_cache: Most bytes of decoded blocks and cells kept in host memory; each reading
                thread holds up to 64 MB more.
            timeout: Seconds after which a read counts as failed.
            workers: Number of reading threads; left out, 1 for a folder and 4 for a URL. One thread
                reads many chunks at once; several compete for Python's interpreter lock, and slow
                down frames.
            image: Which image, see `Store.open`.
            time: Which time point.
            channels: Which channels, as components of "value"; None reads all.
            filtered: A `Filtered` shader whose colours the store holds (`Filtered.stored`): coarse
                bricks include them; render with this shader.

        Raises:
            ValueError: A number is out of its range, the store has no such colours, or see
                `Store.open`.
            OSError: The store can't be read.
        """
        limit = check.nbytes("StoredProducer", "host_cache", host_cache)
        if workers is not None:
            check.integer("StoredProducer", "workers", workers, low=1, high=64)
        seconds = check.number("StoredProducer", "timeout", timeout, low=0, open_low=True)
        if not isinstance(store, Store):
            store = Store.open(store, image=image, time=time, channels=channels)
        if store.info.labels and store.dtype.is_floating_point and not store.has_blocks:
            raise ValueError(
                f"{store.location}: labels of {store.stored} must be indexed first: "
                f"gvtorch convert {store.location} STORE.zarr"
            )
        value_range = {}
        if store.value_range is not None:
            lows, highs = zip(*store.value_range, strict=True)
            value_range[_VALUE_CHANNEL] = (min(lows), max(highs))
        coarse = {} if filtered is None else _coarse_channel(store, filtered)
        super().__init__(
            store.extent,
            channels={_VALUE_CHANNEL: Channel(store.dtype, store.width), **coarse},
            spacing=store.spacing,
            origin=store.origin,
            value_range=value_range,
            labels={_VALUE_CHANNEL: store.label_values} if store.info.labels else None,
        )
        self.store, self.timeout = store, seconds
        self.made_of = {name: store.coarse[name].made_of for name in coarse}
        self.host_bytes, self.workers = limit, workers or (4 if store.is_remote else 1)
        self._start_threads()

    def _start_threads(self) -> None:
        """Creates the parts that processes don't share: cache and threads."""
        self._cache, self._closed = HostCache(self.host_bytes), threading.Event()
        self._threads = ThreadPoolExecutor(self.workers, thread_name_prefix="gvtorch-store")
        self._process = os.getpid()

    def _submit(self, work: Callable[[Nodes], Any], nodes: Nodes) -> Future:
        """Runs `work` in a thread. After a fork, creates new threads first: the child has none."""
        if os.getpid() != self._process:
            self._start_threads()

        def read() -> Any:
            with stage("read"):
                return work(nodes)

        return self._threads.submit(read)

    def __getstate__(self) -> dict[str, Any]:
        unshared = ("_cache", "_closed", "_threads", "_process")
        state = super().__getstate__()
        return {name: value for name, value in state.items() if name not in unshared}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Opens the store again, with a new cache and new threads."""
        super().__setstate__(state)
        self._start_threads()

    def prepare(self, layout: Layout) -> None:
        """Checks that bricks can be cut out of blocks, if there are coarse channels; starts the
        threads again if the producer was closed.
        """
        if self._closed.is_set():
            self._start_threads()
        can_cut = _Cubes.of(self.store, layout).are_blocks and layout.depth < self.store.levels
        if len(self.channels) > 1 and not can_cut:
            sizes = [n for n in (8, 16, 32, 64) if self.store.block % n == 0]
            raise ValueError(
                f"{self.store.location}: filtered colours are stored for bricks of "
                f"{', '.join(map(str, sizes))} voxels with a border of at most 1, got bricks of "
                f"{layout.brick_size} with {layout.border}"
            )

    def classify(self, nodes: Nodes) -> Regions | Future:
        """Returns a future of the regions by the cells; all DATA at once if the store has none."""
        if not self.store.has_blocks:
            return Regions(kind=torch.full((len(nodes),), Region.DATA, device="cpu"))
        return self._submit(self._classify, nodes)

    def fill(self, nodes: Nodes) -> Future:
        """Returns a future of bricks, which are read and cut in a thread."""
        return self._submit(self._fill, nodes)

    def close(self) -> None:
        """Stops the threads without waiting for reads in progress."""
        self._closed.set()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _classify(self, nodes: Nodes) -> Regions:
        """Combines the cells that each node's brick, border included, reaches into."""
        layout, store = nodes.layout, self.store
        loc = nodes.loc.cpu().numpy()
        node_level, zyx = layout.depth - loc[:, 3], loc[:, 2::-1]
        beyond = max(0, layout.border - store.border)  # cells include `store.border` voxels around
        first = (zyx * layout.brick_size - beyond) // store.cell
        last = -(-((zyx + 1) * layout.brick_size + beyond) // store.cell)
        low, high, mean = np.zeros((3, len(loc), store.width), np.float32)
        if store.info.labels:
            mean[:] = np.inf  # of labels, the smallest is used instead of the mean
        low[:], high[:] = self.channels[_VALUE_CHANNEL].limits
        count = np.zeros((len(loc), 1), np.float32)
        errors: dict[int, str] = {}
        for level in np.unique(node_level[node_level < store.levels]).tolist():
            grid = np.array(store.cell_grid(level))
            rows = np.flatnonzero((node_level == level) & (first < grid).all(1))
            begin, end = first[rows].clip(0), np.minimum(last[rows], grid)
            low[rows], high[rows] = np.inf, -np.inf
            for offset in np.ndindex(*(end - begin).max(0, initial=0)):
                cell = begin + np.array(offset)
                in_range = (cell < end).all(1)
                targets = rows[in_range]
                cells, cell_errors = self._cells(level, cell[in_range])
                errors |= {int(targets[n]): message for n, message in cell_errors.items()}
                low[targets] = np.minimum(low[targets], cells[:, 0])
                high[targets] = np.maximum(high[targets], cells[:, 1])
                if store.info.labels:
                    mean[targets] = np.minimum(mean[targets], cells[:, 2])
                else:
                    mean[targets] += cells[:, 2]
                    count[targets] += 1
        mean = np.where(np.isfinite(mean), mean / np.maximum(count, 1), low)
        summary = NodeSummary(*(torch.from_numpy(values) for values in (low, high, mean)))
        regions = regions_of({_VALUE_CHANNEL: summary}, self.channels, store.threshold)
        return replace(regions, errors=errors)

    def _cells(self, level: int, cells: np.ndarray) -> tuple[np.ndarray, dict[int, str]]:
        """Returns (k, 3, c) float32 low, high, mean of `cells` (k, 3) z y x; errors by row."""
        store, grid = self.store, self.store.cell_grid(level)
        out = np.zeros((len(cells), 3, store.width), np.float32)
        errors: dict[int, str] = {}
        tile_positions, tile_rows = group_rows(cells // _TILE_CELLS)
        keys: list[Key] = [("cells", level, *tile) for tile in tile_positions.tolist()]

        def read(missing: list[Key]) -> dict[Key, ArrayOrMessage]:
            results: dict[Key, ArrayOrMessage] = {}
            for key in missing:
                low = [index * _TILE_CELLS for index in key[2:]]
                high = [min(start + _TILE_CELLS, n) for start, n in zip(low, grid, strict=True)]
                try:
                    results[key] = store.read_cells(level, low, high, timeout=self.timeout)
                except (OSError, ValueError) as error:
                    results[key] = str(error)
            return results

        for rows, tile in zip(tile_rows, self._cache.get(keys, read), strict=True):
            if isinstance(tile, str):
                errors.update(dict.fromkeys(rows.tolist(), tile))
            else:
                out[rows] = tile[tuple((cells[rows] % _TILE_CELLS).T)]
        return out, errors

    def _fill(self, nodes: Nodes) -> Bricks:
        layout, store = nodes.layout, self.store
        loc = nodes.loc.cpu().numpy()
        node_level = layout.depth - loc[:, 3]
        by_channel: dict[str, torch.Tensor] = {}
        errors: dict[int, str] = {}
        for name, channel in self.channels.items():
            if channel.coarse and not nodes.coarse:
                continue
            shape = (len(loc), *(layout.side,) * 3, channel.width)
            out = torch.zeros(shape, dtype=channel.dtype, device="cpu").numpy()
            for level in np.unique(node_level).tolist():
                rows = np.flatnonzero(node_level == level)
                if level < store.levels:
                    errors |= self._fill_level(out, rows, loc[rows, 2::-1], name, level, layout)
                else:
                    errors |= self._fill_coarser(out, rows, loc[rows, 2::-1], level, layout)
            by_channel[name] = torch.from_numpy(out)
        if store.has_blocks:
            return Bricks(data=by_channel, errors=errors)
        data, out = by_channel[_VALUE_CHANNEL], by_channel[_VALUE_CHANNEL].numpy()
        # Without cells, only the voxels show which nodes of the finest level are uniform.
        uniform = (out == out[:, :1, :1, :1]).all((1, 2, 3, 4)) & (node_level == 0)
        kind = torch.where(torch.from_numpy(uniform), Region.CONSTANT, Region.DATA)
        constants = {_VALUE_CHANNEL: data[:, 0, 0, 0]}
        return Bricks(data={_VALUE_CHANNEL: data}, kind=kind, constants=constants, errors=errors)

    def _fill_level(
        self,
        out: np.ndarray,
        rows: np.ndarray,
        zyx: np.ndarray,
        channel: str,
        level: int,
        layout: Layout,
    ) -> dict[int, str]:
        """Cuts bricks at (m, 3) z y x of a channel and level from cubes, one group after the other,
        and writes them to rows (m,) of `out`; returns errors by row. After a timeout nothing more
        is read.
        """
        cubes = _Cubes.of(self.store, layout)
        cube_positions, cube_rows = group_rows(zyx // cubes.bricks_per_side)
        corner = zyx % cubes.bricks_per_side * cubes.brick_size + cubes.border - layout.border
        errors: dict[int, str] = {}
        timeout_message = ""

        def read(missing: list[Key]) -> dict[Key, ArrayOrMessage]:
            nonlocal timeout_message
            if self._closed.is_set() or timeout_message:
                return dict.fromkeys(missing, timeout_message or f"{self.store.location}: closed")
            try:
                cubes_read = self._read_cubes(cubes, channel, level, [key[3:] for key in missing])
            except (OSError, ValueError) as error:
                timeout_message = str(error) if isinstance(error, TimeoutError) else ""
                return dict.fromkeys(missing, str(error))
            return dict(zip(missing, cubes_read, strict=True))

        nbytes = (cubes.side + 2 * cubes.border) ** 3 * out.shape[4] * out.itemsize
        group_size = max(1, _GROUP_BYTES // nbytes)
        for begin in range(0, len(cube_positions), group_size):
            group_positions = cube_positions[begin : begin + group_size].tolist()
            keys: list[Key] = [(channel, cubes, level, *position) for position in group_positions]
            for brick_rows, cube in zip(
                cube_rows[begin : begin + group_size], self._cache.get(keys, read), strict=True
            ):
                if isinstance(cube, str):
                    errors.update(dict.fromkeys(rows[brick_rows].tolist(), cube))
                    continue
                starts = tuple(n - layout.side + 1 for n in cube.shape[:3])
                shape, strides = (*starts, *out.shape[1:]), (*cube.strides[:3], *cube.strides)
                windows = as_strided(cube, shape, strides)
                out[rows[brick_rows]] = windows[tuple(corner[brick_rows].T)]
        return errors

    def _read_cubes(
        self, cubes: _Cubes, channel: str, level: int, positions: list[Key]
    ) -> list[ArrayOrMessage]:
        """Reads cubes at (z, y, x) of a channel and level, borders included. A cube that fails
        becomes an error message; raises TimeoutError.
        """
        store, zyx = self.store, np.array(positions, np.int64)
        if cubes.are_blocks:
            if channel == _VALUE_CHANNEL:
                data, errors = store.read_blocks(level, zyx, timeout=self.timeout)
            else:
                data, errors = store.read_coarse(channel, level, zyx, timeout=self.timeout)
            return [errors.get(index) or block.copy() for index, block in enumerate(data)]
        arrays: list[ArrayOrMessage] = []
        for position in positions:
            low = [index * cubes.side - cubes.border for index in position]
            high = [start + cubes.side + 2 * cubes.border for start in low]
            try:
                arrays.append(store.read_region(level, low, high, timeout=self.timeout))
            except TimeoutError:
                raise
            except (OSError, ValueError) as error:
                arrays.append(str(error))
        return arrays

    def _fill_coarser(
        self, out: np.ndarray, rows: np.ndarray, zyx: np.ndarray, level: int, layout: Layout
    ) -> dict[int, str]:
        """Makes bricks of a level coarser than the store's coarsest, which is a few voxels wide."""
        last = self.store.levels - 1
        shape = self.store.level_extent(last)[::-1]
        try:
            values = self.store.read_region(last, (0, 0, 0), shape, timeout=self.timeout)
        except (OSError, ValueError) as error:
            return dict.fromkeys(rows.tolist(), str(error))
        for _ in range(level - last):
            values = self.store.pool(values, 2)
        offsets = np.arange(layout.side) - layout.border
        coordinates = zyx[:, :, None] * layout.brick_size + offsets
        z, y, x = (coordinates[:, axis].clip(0, values.shape[axis] - 1) for axis in range(3))
        out[rows] = values[z[:, :, None, None], y[:, None, :, None], x[:, None, None, :]]
        return {}
