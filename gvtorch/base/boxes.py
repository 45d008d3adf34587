"""Boxes of voxels, `low` to `high` in z, y, x: indexing them and padding them beyond a grid; and
limits on their sizes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .constants import MAX_VOXELS

Zyx = Sequence[int]


def index(low: Any, high: Any) -> tuple[slice, ...]:
    """Returns the NumPy index of a box."""
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))


def box_of(index: tuple[slice, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Returns the low and the high end of the box that an index selects."""
    return tuple(span.start for span in index), tuple(span.stop for span in index)


def clamped_box(low: Zyx, high: Zyx, shape: Zyx) -> tuple[list[int], list[int]]:
    """Returns the part of a box inside a grid, else the nearest voxels; one a side at least."""
    start = [min(max(a, 0), n - 1) for a, n in zip(low, shape, strict=True)]
    stop = [max(min(b, n), a + 1) for a, b, n in zip(start, high, shape, strict=True)]
    return start, stop


def repeat_edges(data: np.ndarray, start: Zyx, low: Zyx, high: Zyx) -> np.ndarray:
    """Returns (z, y, x, c) voxels that begin at `start`, extended to a box by edge voxels."""
    shape = [b - a for a, b in zip(low, high, strict=True)]
    if list(data.shape[:3]) == shape and list(start) == list(low):
        return data
    used: list[slice] = []  # of the voxels
    filled: list[slice] = []  # of the box, with these voxels
    for first, a, size, count in zip(start, low, data.shape, shape, strict=False):
        begin, before = min(max(a - first, 0), size - 1), min(max(first - a, 0), count - 1)
        width = max(min(size - begin, count - before), 1)
        used.append(slice(begin, begin + width))
        filled.append(slice(before, before + width))
    out = np.empty((*shape, *data.shape[3:]), data.dtype)
    out[tuple(filled)] = data[tuple(used)]
    for axis, inside in enumerate(filled):
        planes = np.moveaxis(out, axis, 0)
        planes[: inside.start] = planes[inside.start]
        planes[inside.stop :] = planes[inside.stop - 1]
    return out


def to_zyxc(data: np.ndarray, axes: str, order: str = "zyxc") -> np.ndarray:
    """Returns an array whose axes are `axes` transposed to `order`, which holds all of them; axes
    that the array lacks get size 1. Axes -, of size 1, are dropped.
    """
    data = data.squeeze(tuple(i for i, axis in enumerate(axes) if axis == "-"))
    axes = axes.replace("-", "")
    missing = "".join(axis for axis in order if axis not in axes)
    all_axes = missing + axes
    return data[(None,) * len(missing)].transpose([all_axes.index(axis) for axis in order])


def tile_indices(low: Zyx, high: Zyx, sides: Zyx) -> Iterator[tuple[int, ...]]:
    """Yields the index of each tile of `sides` voxels that overlaps a box."""
    spans = zip(low, high, sides, strict=True)
    return itertools.product(*(range(a // n, -(-b // n)) for a, b, n in spans))


def paste(out: np.ndarray, low: Zyx, tile: np.ndarray, corner: Zyx) -> None:
    """Copies the part of a tile that begins at `corner` into `out`, a box that begins at `low`."""
    begin, size = np.maximum(low, corner), len(low)
    end = np.minimum(np.add(low, out.shape[:size]), np.add(corner, tile.shape[:size]))
    end = np.maximum(begin, end)
    out[index(begin - low, end - low)] = tile[index(begin - corner, end - corner)]


def group_rows(positions: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns the distinct places (m, n) of (k, n), sorted, and the row indices of each."""
    order = np.lexsort(positions.T[::-1])
    positions = positions[order]
    later_starts = np.flatnonzero((positions[1:] != positions[:-1]).any(1)) + 1
    starts = np.append(0, later_starts)[: len(order)]
    return positions[starts], np.split(order, later_starts)[: len(order)]


def check_extent(
    context: str, shape: Sequence[int], *, what: str = "extent", max_values: int = MAX_VOXELS
) -> None:
    """Raises ValueError unless all sizes are positive and their product is at most `max_values`.

    Readers call it with the sizes in a file's header, before they allocate memory.
    """
    sizes = " x ".join(str(size) for size in shape)
    if any(size < 1 for size in shape):
        raise ValueError(f"{context}: {what} must be at least 1 in every direction, got {sizes}")
    voxels = math.prod(int(size) for size in shape)
    if voxels > max_values:
        destination = "in memory at once" if max_values == MAX_VOXELS else "into a store"
        raise ValueError(
            f"{context}: {what} {sizes} is {voxels} voxels, "
            f"more than the {max_values} that fit {destination}"
        )
