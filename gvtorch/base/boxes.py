"""Boxes of voxels, `low` to `high` in z, y, x: their index, and what lies beyond a grid; how many
voxels a box of the world has.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from . import check

Zyx = Sequence[int]


def index(low: Any, high: Any) -> tuple[slice, ...]:
    """The NumPy index of a box."""
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))


def clamped_box(low: Zyx, high: Zyx, shape: Zyx) -> tuple[list[int], list[int]]:
    """The part of a box that lies in a grid, or what is next to it: at least one voxel a side."""
    start = [min(max(a, 0), n - 1) for a, n in zip(low, shape, strict=True)]
    stop = [max(min(b, n), a + 1) for a, b, n in zip(start, high, shape, strict=True)]
    return start, stop


def repeat_edges(data: np.ndarray, start: Zyx, low: Zyx, high: Zyx) -> np.ndarray:
    """Extends (z, y, x, c) voxels, which begin at `start`, to a box; the outermost repeat."""
    for axis, (at, a, b) in enumerate(zip(start, low, high, strict=True)):
        size = data.shape[axis]
        if (at, at + size) != (a, b):
            data = data.take(np.arange(a - at, b - at).clip(0, size - 1), axis)
    return data


def to_zyxc(data: np.ndarray, axes: str, order: str = "zyxc") -> np.ndarray:
    """Returns an array whose axes are `axes` as (z, y, x, c), or as another order of the same and
    more; those that it lacks have size 1. Axes -, of size 1, are dropped.
    """
    data = data.squeeze(tuple(at for at, axis in enumerate(axes) if axis == "-"))
    axes = axes.replace("-", "")
    missing = "".join(axis for axis in order if axis not in axes)
    letters = missing + axes
    return data[(None,) * len(missing)].transpose([letters.index(axis) for axis in order])


def rows_by_place(places: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns the different ones (m, n) of places (k, n), in order, and the rows of each."""
    order = np.lexsort(places.T[::-1])
    places = places[order]
    others = np.flatnonzero((places[1:] != places[:-1]).any(1)) + 1
    first = np.append(0, others)[: len(order)]
    return places[first], np.split(order, others)[: len(order)]


def extent_in(
    where: str, extent: int | Sequence[int], box: Sequence[Sequence[float]]
) -> Sequence[int]:
    """Returns an extent along x, y, z as it is; a number is that of the box's longest side, and
    voxels are cubes then, or nearly so.
    """
    if not isinstance(extent, int):
        return extent
    low, high = check.box(where, box)
    check.whole(where, "extent", extent, low=1, high=2**40)
    sides = [b - a for a, b in zip(low, high, strict=True)]
    return [max(1, round(extent * side / max(sides))) for side in sides]
