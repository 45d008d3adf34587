"""Coarse channels of a store: values of its coarse voxels in addition to their means, such as the
colours of a `Filtered` shader. They are written into an existing store.

    STORE.zarr/gvtorch/coarse/zarr.json        lists the channels; written when one is complete
    STORE.zarr/gvtorch/coarse/NAME.0/1 ...     (gz, gy, gx, s, s, s, c) float16 bordered blocks of
                                               a level, cut like the store's; all are written
"""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...base import boxes
from ...base.stage import Progress, no_progress
from ...base.whole_file import name_in_errors
from ..resources import amount
from .ngff import read_json_file
from .shard import begin_write, bordered, finish_write
from .store import Store
from .store_layout import BORDER, WORK, CoarseChannel, is_name
from .tensorstores import open_array
from .unfinished import group_metadata, locked, write_json

_CUBE_SIDE = 128  # voxels along a side of the cubes that are written at once


def make_channel(
    store: Store,
    name: str,
    channel: CoarseChannel,
    fill_width: int,
    fill: Callable[[Sequence[np.ndarray]], None],
    to_values: Callable[[np.ndarray], np.ndarray],
    progress: Progress = no_progress,
) -> None:
    """Writes a coarse channel. An existing one of the same name is replaced when the new one is
    complete, and stays as it is if the work is interrupted.

    Args:
        store: A store that `convert` made, in a folder.
        name: Letters, digits, "-" and "_"; not "value".
        channel: Its metadata.
        fill_width: How many numbers a voxel has that `fill` writes.
        fill: Fills the arrays that it is given, (z, y, x, fill_width) float16, mapped from files,
            one for each coarse level, the finest of them first.
        to_values: Turns boxes (z, y, x, fill_width) of these arrays into the channel's values,
            (z, y, x, c).
        progress: Called with ("writing", voxels done, voxels in all), after `fill`.

    Raises:
        ValueError: The store was not made by `convert`, or name or channel are invalid.
        OSError: It can't be written, or another process makes a channel of this store.
    """
    target = Path(store.location)
    if not store.has_blocks or not store.all_channels or not target.is_dir():
        raise ValueError(
            f"{store.location}: coarse channels are written into whole folders that gvtorch "
            "convert made"
        )
    if not is_name(name) or name == "value":
        raise ValueError(
            f"{name!r}: a coarse channel's name is made of letters, digits, - and _, not 'value'"
        )
    try:
        json.dumps(channel.attributes(), allow_nan=False)
    except ValueError:
        raise ValueError(f"{store.location}: what {name!r} is made of is not finite") from None
    folder = target / store.coarse_folder
    folder.mkdir(parents=True, exist_ok=True)
    if store.times > 1 and not (folder.parent / "zarr.json").exists():
        write_json(folder.parent / "zarr.json", group_metadata({}))
    busy_message = f"{folder}: another process makes a coarse channel"
    with locked(folder / ".lock", busy_message), _levels_in_files(store, fill_width) as levels:
        fill(levels)
        file = folder / "zarr.json"
        attributes = read_json_file(file).get("attributes") if file.exists() else {"channels": {}}
        channels = CoarseChannel.parse(str(file), attributes)
        previous = channels.get(name)
        new_channel = replace(channel, generation=previous.generation + 1 if previous else 0)
        channel_folder = new_channel.folder(name)
        _write_blocks(store, channel_folder, new_channel.width, levels, to_values, progress)
        channels[name] = new_channel
        entries = {key: entry.attributes() for key, entry in channels.items()}
        write_json(file, group_metadata({"channels": entries}))
        store.coarse = channels
        if previous is not None:
            shutil.rmtree(folder / previous.folder(name), ignore_errors=True)


@contextmanager
def _levels_in_files(store: Store, fill_width: int) -> Iterator[Sequence[np.ndarray]]:
    """Yields an array for each coarse level, mapped from temporary files."""
    folder = Path(store.location) / store.coarse_folder / WORK
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    levels = range(1, store.levels)
    try:
        yield [_map_level_file(store, folder, level, fill_width) for level in levels]
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _map_level_file(store: Store, folder: Path, level: int, fill_width: int) -> np.ndarray:
    shape, file = (*store.level_extent(level)[::-1], fill_width), folder / f"{level}.npy"
    with name_in_errors(file):
        mapped = np.lib.format.open_memmap(file, mode="w+", dtype=np.float16, shape=shape)
    with file.open("r+b") as handle:  # reserve the disk space: a full disk would kill the process
        try:
            os.posix_fallocate(handle.fileno(), 0, file.stat().st_size)
        except OSError as error:
            sizes = [math.prod(store.level_extent(other)) for other in range(1, store.levels)]
            needed = amount(2 * fill_width * sum(sizes))
            reason = f"{error.strerror}: while it is made, files take {needed}"
            raise OSError(error.errno, reason, store.location) from None
    return mapped


def _write_blocks(
    store: Store,
    folder: str,
    width: int,
    levels: Sequence[np.ndarray],
    to_values: Callable[[np.ndarray], np.ndarray],
    progress: Progress,
) -> None:
    channel_folder = Path(store.location) / store.coarse_folder / folder
    shutil.rmtree(channel_folder, ignore_errors=True)  # left by interrupted work
    channel_folder.mkdir()
    block = store.layout.block
    done, total = 0, sum(math.prod(values.shape[:3]) for values in levels)
    for level, values in enumerate(levels, 1):
        spec = store.layout.coarse(level, f"{store.coarse_folder}/{folder}", width)
        open_array(store.root, spec, "create")
        for low in itertools.product(*(range(0, n, _CUBE_SIDE) for n in values.shape[:3])):
            size = [min(_CUBE_SIDE, n - a) for a, n in zip(low, values.shape, strict=False)]
            padded_size = np.multiply(-(-np.array(size) // block), block)
            begin, end = np.subtract(low, BORDER).tolist(), (low + padded_size + BORDER).tolist()
            start, stop = boxes.clamped_box(begin, end, values.shape[:3])
            inside = to_values(values[boxes.index(start, stop)])
            blocks = bordered(store.layout, boxes.repeat_edges(inside, start, begin, end))
            first_block = [a // block for a in low]
            future = begin_write(store.root, spec, first_block, np.ascontiguousarray(blocks))
            finish_write(future, store.location, "make it again")
            done += math.prod(size)
            progress("writing", done, total)
    write_json(channel_folder / "zarr.json", group_metadata({}))
