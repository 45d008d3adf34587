"""`Store`: a volume on disk or behind a URL, read block by block or region by region.

Opens what `convert` writes (see store_layout.py) and any other OME-Zarr image (NGFF on Zarr v2 or
v3). The latter has no bordered blocks and no cells: its blocks are cut out of region reads, which
is slower. Writing is in conversion.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...base import boxes, check
from ...base.boxes import Zyx
from ...base.labels import counted
from .block_reader import BlockReader, cut_blocks, wait_for_array
from .checksums import json_checksum
from .chunk_files import begin_read
from .level_reader import LevelReader, open_arrays, pool_of
from .ngff import find_image, read_json
from .store_layout import BORDER, CELL, DTYPES, CoarseChannel, StoreLayout, value_dtype
from .tensorstores import Deadline, begin_open, child, kvstore

_OPEN_TIMEOUT = 20.0  # seconds


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
        root, pyramid = find_image(context, root, image, deadline)
        own_layout = pyramid.layout
        # A channel of a store of several: its folder is a store, too.
        if own_layout and root != parent:
            context = root if isinstance(root, str) else root["path"].rstrip("/")
        arrays, channel_index, times = open_arrays(context, root, pyramid, time, channels, deadline)
        dtype = value_dtype(arrays[0].array.dtype.numpy_dtype)
        if dtype not in DTYPES:
            raise ValueError(f"{context}: dtype {dtype} is unknown; known: {', '.join(DTYPES)}")
        x, y, z, width = (arrays[0].size(axis) for axis in "xyzc")
        self.time, self.times = time, times
        self.layout = layout = own_layout or StoreLayout(extent=(x, y, z), dtype=dtype, width=width)
        differs = (layout.extent, layout.dtype) != ((x, y, z), dtype)
        if differs or (own_layout and own_layout.times != self.times):
            raise ValueError(f"{context}: damaged: metadata and level 0 differ in extent or dtype")
        label_values = _read_labels(context, root, layout, deadline)
        self.label_values = None if label_values is None else torch.from_numpy(label_values)
        self.pool = pool_of(pyramid.info, label_values)
        self._levels = LevelReader(arrays, layout, self.pool)
        self.location, self.root = context, kvstore(context)
        self.has_blocks = own_layout is not None
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
        self._blocks: BlockReader | None = None
        if own_layout:
            place = context, self.root, layout, time
            self._blocks = BlockReader(*place, self._levels, channel_index, deadline)
            folder, name = child(self.root, self.coarse_folder), f"{context}/{self.coarse_folder}"
            if (metadata := read_json(name, folder, "zarr.json", deadline)) is not None:
                self.coarse = CoarseChannel.parse(context, metadata.get("attributes"))
            checksum = json_checksum(pyramid.store_json)
            if pyramid.store_json.get("checksum", checksum) != checksum:
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
        if self._blocks is not None:
            start, stop = boxes.clamped_box(low, high, self.layout.shape(level))
            inside = data[boxes.index(np.subtract(start, low).clip(0), data.shape[:3])]
            self._blocks.check_shards(self.layout.pyramid(level), inside, start, stop, deadline)
        return data

    @property
    def is_remote(self) -> bool:
        """Whether it is read over a network."""
        return isinstance(self.root, str)

    @property
    def stored(self) -> str:
        """NumPy dtype that `read_stored` returns: the array's, before it is narrowed."""
        if self.label_values is not None:
            return "int64"
        return str(self._levels.finest.array.dtype.numpy_dtype.str)

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
        if self._blocks is None:
            raise ValueError(f"{self.location}: has no cells; gvtorch convert makes a store of it")
        _check_box(low, high)
        grid = self.cell_grid(level)
        if min(low) < 0 or any(b > n for b, n in zip(high, grid, strict=True)):
            raise ValueError(
                f"read_cells: {low} to {high} lies outside the grid {grid} of level {level}"
            )
        return self._blocks.read_cells(level, low, high, Deadline(timeout))[..., self._channels]

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
        zyx = self._checked_positions("read_blocks", level, zyx)
        deadline = Deadline(timeout)
        if self._blocks is None:
            return cut_blocks(self._levels, self.location, level, zyx, self.layout, deadline)
        return self._blocks.read_blocks(level, zyx, deadline)

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
        channel = self.coarse[name]
        zyx = self._checked_positions("read_coarse", level, zyx, finest=1)
        assert self._blocks is not None  # only stores with blocks have coarse channels
        folder = f"{self.coarse_folder}/{channel.folder(name)}"
        spec = self.layout.coarse(level, folder, channel.width)
        return self._blocks.read_coarse(spec, level, zyx, Deadline(timeout))

    def _checked_positions(
        self, caller: str, level: int, zyx: np.ndarray, finest: int = 0
    ) -> np.ndarray:
        zyx, grid = np.asarray(zyx, np.int64).reshape(-1, 3), self.block_grid(level)
        if level < finest or (zyx.size and (zyx.min() < 0 or (zyx >= grid).any())):
            raise ValueError(f"{caller}: a position lies outside the grid {grid} of level {level}")
        return zyx

    def _checked_level(self, level: int) -> int:
        return check.integer(self.location, "level", level, low=0, high=self.levels - 1)


def _read_labels(
    location: str, root: Any, layout: StoreLayout, deadline: Deadline
) -> np.ndarray | None:
    """Returns (k,) int64 the table of indexed labels; None if labels are not indexed."""
    if layout.label_count is None:
        return None
    spec = layout.labels()
    context = f"{location}/{spec['path']}"
    chunked = wait_for_array(location, spec, begin_open(root, spec), deadline)
    labels: np.ndarray = deadline.wait(begin_read(*chunked), context)
    if not (labels[1:] > labels[:-1]).all():
        raise ValueError(f"{context}: damaged: labels must be ascending")
    return labels


def _check_box(low: Zyx, high: Zyx) -> None:
    if not len(low) == len(high) == 3 or any(a >= b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"low and high must be (z, y, x) with low < high, got {low} and {high}")
