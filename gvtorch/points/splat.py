"""What cubes of voxels hold of sorted points, and between which values all lies that is in them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from .codes import peak, shares
from .sorted import SortedPoints
from .table import Rows

_CELL = 4  # voxels along a side of what is looked up at least
_SHARES = 1 << 21  # numbers of wide points that are worked on together


class Cubes(NamedTuple):
    """k cubes of `side` voxels of a level, from voxels x, y, z (k, 3) on, in the box or not."""

    low_k3: np.ndarray
    side: int
    level: int


class _Found(NamedTuple):
    """Rows of a table in cubes: those of a cube stand together."""

    row: np.ndarray  # (m,) in the table
    cube: np.ndarray  # (m,) rising
    cell: np.ndarray  # (m,) number of the cell, by which rows of equal codes stand together
    voxel_m3: np.ndarray  # of the cubes' level, from the cube's first on


def values(points: SortedPoints, cubes: Cubes, *, narrow: bool = True) -> np.ndarray:
    """Returns (k, z, y, x, c) float64 the sums in voxels, per finest voxel.

    Args:
        points: The points.
        cubes: The voxels.
        narrow: Whether points count that are narrower than a finest voxel.
    """
    k, side, width = len(cubes.low_k3), cubes.side, points.width
    total = np.zeros((k * side**3, width))
    if narrow and (table := _finer(points, cubes.level)) is not None:
        rows, level = table
        found = _in_cubes(points, rows["code"], level, cubes)
        x, y, z = found.voxel_m3.T
        at = ((found.cube * side + z) * side + y) * side + x
        value = rows["value"][found.row]
        for number in range(width):
            total[:, number] = np.bincount(at, value[:, number], len(total))
    total /= points.grid.branching ** (3 * cubes.level)
    out = total.reshape(k, side, side, side, width)
    _add_wide(points, cubes, out)
    return out


def ranges(
    points: SortedPoints, cubes: Cubes, *, narrow: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (k,) whether cubes hold anything, and (k, c) each two numbers between which lie all
    voxels in them, of this level and of those below; 0 is between them.
    """
    k = len(cubes.low_k3)
    some, low = np.zeros(k, bool), np.zeros((k, points.width))
    high = np.zeros_like(low)
    if narrow and (table := _finer(points, cubes.level)) is not None:
        rows, level = table
        found = _in_cubes(points, rows["code"], level, cubes)
        if len(found.row):
            _widen(rows, found, some, low, high)
    for level, cube, row in _wide(points, cubes):
        rows = points.points[level].rows
        most = peak(rows["radius"][row].astype(np.float64), points.grid.spacing_3)
        value = most[:, None] * rows["value"][row]
        first = _begins(cube)
        some[cube[first]] = True
        low[cube[first]] += np.add.reduceat(np.minimum(value, 0), first)
        high[cube[first]] += np.add.reduceat(np.maximum(value, 0), first)
    return some, low, high


def region(points: SortedPoints, low: tuple[int, ...], high: tuple[int, ...]) -> np.ndarray:
    """Returns (z, y, x, c) float64 sums in the finest voxels of a box `low` to `high`, z y x."""
    side = 32
    shape = [b - a for a, b in zip(low, high, strict=True)]
    out = np.empty((*shape, points.width))
    for corner in itertools.product(*(range(a, b, side) for a, b in zip(low, high, strict=True))):
        cube = values(points, Cubes(np.array([corner[::-1]]), side, 0))[0]
        at = [c - a for c, a in zip(corner, low, strict=True)]
        part = tuple(slice(a, a + side) for a in at)
        z, y, x = out[part].shape[:3]
        out[part] = cube[:z, :y, :x]
    return out


def _begins(cube: np.ndarray) -> np.ndarray:
    """Where rows of another cube begin."""
    return np.flatnonzero(np.diff(cube, prepend=-1))


def _finer(points: SortedPoints, level: int) -> tuple[Rows, int] | None:
    """The rows, and their level, that a level's sums are made of."""
    if kept := [one for one in points.sums if one <= level]:
        return points.sums[kept[-1]].rows, kept[-1]
    return (points.points[0].rows, 0) if 0 in points.points else None


def _widen(rows: Rows, found: _Found, some: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Widens ranges of cubes by what was found in them."""
    cube = found.cube
    if "low" in rows:
        least, most = rows["low"][found.row], rows["high"][found.row]
    else:  # points: their sums in finest voxels
        code = rows["code"][found.row]
        new = (code[1:] != code[:-1]) | (cube[1:] != cube[:-1])
        first = np.concatenate(([0], np.flatnonzero(new) + 1))
        cube = cube[first]
        total = np.add.reduceat(rows["value"][found.row].astype(np.float64), first)
        least, most = np.minimum(total, 0), np.maximum(total, 0)
    first = _begins(cube)
    here = cube[first]
    some[here] = True
    low[here] = np.minimum.reduceat(least, first)
    high[here] = np.maximum.reduceat(most, first)


def _in_cubes(
    points: SortedPoints, codes: np.ndarray, level: int, cubes: Cubes, *, least: int = _CELL
) -> _Found:
    """The rows of a table, of codes of voxels of a level not above the cubes', that lie in them;
    looked up by cells of at least so many voxels along a side.
    """
    grid, curve = points.grid, points.codes
    n = grid.branching
    size = n
    while size * n <= max(least, cubes.side // 8):
        size *= n
    along = (cubes.side + size - 2) // size + 1
    step = np.indices((along,) * 3).reshape(3, -1).T[:, ::-1]
    cell = (cubes.low_k3 // size)[:, None] + step  # (k, m, 3)
    first = cell * size
    scale = n**cubes.level
    inside = (first + size > 0) & (first * scale < np.array(grid.extent))
    inside &= first < (cubes.low_k3 + cubes.side)[:, None]
    cube, which = np.nonzero(inside.all(2))
    # Codes that a cell covers, among those of the table.
    below = n ** (3 * (cubes.level - level))
    covers = min(size**3 * below, n ** (3 * max(0, curve.digits - level)))
    begin = curve.of(cell[cube, which]) * (size**3 * below)
    start = np.searchsorted(codes, begin)
    count = np.searchsorted(codes, begin + covers) - start
    some = np.flatnonzero(count)
    cube, which, start, count, begin = (one[some] for one in (cube, which, start, count, begin))
    ahead = np.cumsum(count) - count
    row = np.repeat(start - ahead, count) + np.arange(int(count.sum()))
    own = np.repeat(np.arange(len(some)), count)
    within = (codes[row] - begin[own]) // below
    corner = first[cube, which] - cubes.low_k3[cube]
    voxel = corner[own] + curve.places(size)[within]
    keep = ((voxel >= 0) & (voxel < cubes.side)).all(1)
    return _Found(row[keep], cube[own][keep], own[keep], voxel[keep])


def _wide(points: SortedPoints, cubes: Cubes) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yields the levels above the cubes' whose points reach into them, (m,) which cubes, rising,
    and which points.
    """
    grid = points.grid
    scale = grid.branching**cubes.level
    size = grid.spacing_3 * scale
    for level, table in points.points.items():
        if level <= cubes.level or "radius" not in table.rows:
            continue
        # Their centres are at most a voxel of their level away, of the widest as far as they reach.
        rows, up = table.rows, grid.branching ** (level - cubes.level)
        reach = 1
        if level == grid.levels - 1:
            reach = int(max(grid.extent)) // grid.branching**level + 1
        low = cubes.low_k3 // up - reach
        side = (cubes.side + up - 2) // up + 1 + 2 * reach
        found = _in_cubes(points, rows["code"], 0, Cubes(low, side, level), least=1)
        place = rows["position"][found.row].astype(np.float64)
        radius = rows["radius"][found.row].astype(np.float64)[:, None]
        corner = grid.low + cubes.low_k3[found.cube] * size
        near = (place + radius > corner) & (place - radius < corner + cubes.side * size)
        keep = near.all(1)
        if keep.any():
            yield level, found.cube[keep], found.row[keep]


def _add_wide(points: SortedPoints, cubes: Cubes, out: np.ndarray) -> None:
    """Adds the points that are wider than the cubes' voxels: for each cube the product of what its
    planes and its lines hold of them.
    """
    scale = points.grid.branching ** (3 * cubes.level)
    step = max(1, _SHARES // cubes.side**2)
    for level, cube, row in _wide(points, cubes):
        rows = points.points[level].rows
        for begin in range(0, len(row), step):
            here, own = row[begin : begin + step], cube[begin : begin + step]
            place = rows["position"][here].astype(np.float64)
            radius = rows["radius"][here].astype(np.float64)
            edges = points.grid.edges(cubes.low_k3[own], cubes.side, cubes.level)
            x, y, z = (shares(edge, place[:, axis], radius) for axis, edge in enumerate(edges))
            value = rows["value"][here].astype(np.float64) / scale
            plane = (z[:, :, None] * y[:, None, :]).reshape(len(here), -1)
            line = (x[:, :, None] * value[:, None, :]).reshape(len(here), -1)
            for start, stop in itertools.pairwise([*_begins(own).tolist(), len(own)]):
                held = plane[start:stop].T @ line[start:stop]
                out[own[start]] += held.reshape(out.shape[1:])


def narrow_near(points: SortedPoints, center: np.ndarray, reach: float) -> np.ndarray:
    """Returns which points (m,) that are narrower than a finest voxel are in a cube of the world,
    twice as wide as `reach`; their rows are `points.points[0].rows`.
    """
    if 0 not in points.points:
        return np.empty(0, np.int64)
    grid, level = points.grid, 0
    while level < grid.levels - 1 and grid.spacing_3.min() * grid.branching**level < reach / 4:
        level += 1
    size = grid.spacing_3 * grid.branching**level
    first, last = (np.floor((center - grid.low + way * reach) / size) for way in (-1, 1))
    most = math.ceil(max(grid.extent) / grid.branching**level)
    low, high = (np.clip(end, -1, most).astype(np.int64) for end in (first, last))
    cubes = Cubes(low[None], int((high - low).max()) + 1, level)
    return _in_cubes(points, points.points[0].rows["code"], 0, cubes).row
