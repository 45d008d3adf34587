"""Coarse channels of a store: what its coarse voxels hold beside their means, such as the colours
of a `Filtered` shader. They are written into a store that is there already.

    STORE.zarr/gvtorch/coarse/zarr.json    tells of each channel; written when it is whole
    STORE.zarr/gvtorch/coarse/NAME/1 ...   (gz, gy, gx, s, s, s, c) float16 bordered blocks of a
                                           level, cut as the store's own; all are written
"""

from __future__ import annotations

import errno
import itertools
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..base.stage import Progress, no_progress
from . import boxes
from .resources import amount
from .shard import finish, write
from .store import Store
from .store_layout import BORDER, WORK, CoarseChannel, Deadline, StoreLayout, opened
from .unfinished import group, write_json

_OPEN_TIMEOUT = 60.0  # seconds
_CUBE = 128  # voxels along a side of what is written at once


@contextmanager
def temporary_levels(store: Store, width: int) -> Iterator[Sequence[np.ndarray]]:
    """Gives an array (z, y, x, width) float16 in a file for each coarse level, the finest of them
    first; the files lie in the store's folder, and go when the block ends.
    """
    folder = _folder(store) / WORK
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        arrays = []
        for level in range(1, store.levels):
            shape = (*store.level_extent(level)[::-1], width)
            file = folder / f"{level}.npy"
            mapped = np.lib.format.open_memmap(file, mode="w+", dtype=np.float16, shape=shape)
            with file.open("r+b") as opened_file:  # writing to what has no place on disk would kill
                os.posix_fallocate(opened_file.fileno(), 0, file.stat().st_size)
            arrays.append(mapped)
        yield arrays
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        size = 2 * width * sum(_voxels(store.level_extent(n)) for n in range(1, store.levels))
        text = f"the disk is full: while it is made, files take {amount(size)}"
        raise OSError(errno.ENOSPC, text, store.location) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_channel(
    store: Store,
    name: str,
    channel: CoarseChannel,
    read: Callable[[int, Sequence[int], Sequence[int]], np.ndarray],
    progress: Progress = no_progress,
) -> None:
    """Writes a coarse channel; one of the same name is replaced.

    Args:
        store: A store that `convert` made, in a folder.
        name: Letters, digits, "-" and "_".
        channel: What it is.
        read: Gives a box (z, y, x, c) float16 of a level: level, low and high inside the level.
        progress: Told ("writing", voxels done, voxels in all).

    Raises:
        ValueError: The store is not of ours, or the name does not do.
        OSError: It can't be written.
    """
    layout, folder = store.layout, _folder(store) / "gvtorch" / "coarse"
    if not re.fullmatch(r"[\w-]{1,64}", name, re.ASCII):
        raise ValueError(f"{name!r}: a channel's name is made of letters, digits, - and _")
    known = {n: c.attributes() for n, c in store.coarse.items() if n != name}
    folder.mkdir(exist_ok=True)
    write_json(folder / "zarr.json", group({"channels": known}))
    shutil.rmtree(folder / name, ignore_errors=True)
    shapes = {level: layout.shape(level) for level in range(1, store.levels)}
    done, total = 0, sum(map(_voxels, shapes.values()))
    for level, shape in shapes.items():
        spec = layout.coarse(level, name, channel.width)
        root = store.root
        Deadline(_OPEN_TIMEOUT).wait(opened(root, spec, "create"), spec["path"])
        for low in itertools.product(*(range(0, n, _CUBE) for n in shape)):
            high = [min(a + _CUBE, n) for a, n in zip(low, shape, strict=True)]
            blocks = _blocks(layout, level, low, high, read)
            at = [a // layout.block for a in low]
            finish(write(root, spec, at, blocks), store.location, "make it anew")
            done += _voxels(np.subtract(high, low))
            progress("writing", done, total)
    (folder / name).mkdir(exist_ok=True)  # of a store of one level
    write_json(folder / name / "zarr.json", group({}))
    known[name] = channel.attributes()
    write_json(folder / "zarr.json", group({"channels": known}))


def _blocks(
    layout: StoreLayout, level: int, low: Sequence[int], high: Sequence[int], read: Any
) -> np.ndarray:
    """(gz, gy, gx, s, s, s, c) blocks of a cube of a level, borders included."""
    shape, block = layout.shape(level), layout.block
    counts = [-(-(b - a) // block) for a, b in zip(low, high, strict=True)]
    begin = [a - BORDER for a in low]
    end = [a + n * block + BORDER for a, n in zip(low, counts, strict=True)]
    start, stop = boxes.clamp(begin, end, shape)
    values = boxes.repeat_edges(read(level, start, stop), start, begin, end)
    side = layout.stored
    view = sliding_window_view(values, (side, side, side), (0, 1, 2))[::block, ::block, ::block]
    return np.ascontiguousarray(np.moveaxis(view, 3, 6))


def _folder(store: Store) -> Path:
    folder = Path(store.location)
    if not store.has_blocks or not folder.is_dir():
        raise ValueError(
            f"{store.location}: coarse channels are written into folders that gvtorch convert made"
        )
    return folder


def _voxels(size: Any) -> int:
    return int(np.prod(size, dtype=np.int64))
