"""The sums of sorted points in cubes of voxels, and bounds of these sums."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from ..ops.splat import splat
from .grid import Codes, peak
from .sorted import SortedPoints
from .table import Rows

_CELL = 4  # voxels along a cell's side at most, unless cubes are large: see `_cells`
_NEARLY = 1.001  # factor on a point's radius that covers rounding errors


class Cubes(NamedTuple):
    """k cubes of `side`^3 voxels of a level, from voxels (k, 3) x, y, z on; may leave the box."""

    low_k3: np.ndarray
    side: int
    level: int


class _Cells(NamedTuple):
    """Cells of cubes that hold rows of a table, ordered by cube."""

    cube: np.ndarray  # (s,) the cell's cube, increasing
    first_s3: np.ndarray  # first voxel x, y, z, at the cubes' level
    code: np.ndarray  # (s,) code of the first voxel, at the table's level
    start: np.ndarray  # (s,) first row in the table
    rows: np.ndarray  # (s,) number of rows
    size: int  # voxels along a side
    below: int  # how many codes of the table a voxel has

    def once(self) -> tuple[_Cells, np.ndarray]:
        """Returns the distinct cells, and (s,) the index of each cell among these."""
        _, one, same = np.unique(self.code, return_index=True, return_inverse=True)
        return self._replace(**{n: getattr(self, n)[one] for n in self._fields[:5]}), same

    def ahead(self) -> np.ndarray:
        """Returns (s,) the number of rows in all cells before each cell."""
        return np.cumsum(self.rows) - self.rows

    def listed(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns (m,) the rows of all cells, and (m,) the cell of each row."""
        own = np.repeat(np.arange(len(self.rows)), self.rows)
        return (self.start - self.ahead())[own] + np.arange(len(own)), own

    def voxels(self, curve: Codes, code: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Returns (m, 3) the voxels x, y, z of codes (m,), which lie in cells `own` (m,)."""
        within = code - self.code[own]
        if self.below > 1:
            within //= self.below
        return self.first_s3[own] + curve.places(self.size)[within]


#: (m,) rows of a table in cubes, and (m,) their cubes, increasing; equal codes are adjacent.
_Found = tuple[np.ndarray, np.ndarray]


def values(points: SortedPoints, cubes: Cubes, *, narrow: bool = True) -> np.ndarray:
    """Returns (k, z, y, x, c) float64 the mean sum per finest voxel in each voxel; unless `narrow`,
    without points that are narrower than a finest voxel.
    """
    table = _finer(points, cubes.level) if narrow else None
    edge = np.stack(points.grid.edges(cubes.low_k3, cubes.side, cubes.level), 1)
    low = np.ascontiguousarray(cubes.low_k3, np.int64)
    lists = (*_narrow_lists(points, cubes, table), *_wide_lists(points, cubes))
    held = splat(*(torch.from_numpy(one) for one in (edge, low, *lists)))
    scale = points.grid.branching ** (3 * cubes.level)
    return held.div_(scale).numpy() if scale > 1 else held.numpy()


def ranges(
    points: SortedPoints, cubes: Cubes, *, narrow: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (k,) whether cubes hold any points, and (k, c) lower and upper bounds of the values
    of their voxels, at this level and all finer ones; 0 lies between the bounds.
    """
    k = len(cubes.low_k3)
    some, low = np.zeros(k, bool), np.zeros((k, points.width))
    high = np.zeros_like(low)
    if narrow and (table := _finer(points, cubes.level)) is not None:
        rows, level = table
        found = _in_cubes(points, rows["code"], level, cubes)
        if len(found[0]):
            _widen(rows, found, some, low, high)
    for rows, (row, cube) in _reaching(points, cubes):
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
    """Returns the indices at which a new cube begins."""
    return np.flatnonzero(np.diff(cube, prepend=-1))


def _finer(points: SortedPoints, level: int) -> tuple[Rows, int] | None:
    """Returns the rows from which a level's sums are computed, and their level, if any."""
    if kept := [one for one in points.sums if one <= level]:
        return points.sums[kept[-1]].rows, kept[-1]
    return (points.points[0].rows, 0) if 0 in points.points else None


def _widen(rows: Rows, found: _Found, some: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Updates bounds of cubes in place by the rows found in them."""
    row, cube = found
    if "low" in rows:
        least, most = rows["low"][row], rows["high"][row]
    else:  # points: add them up by finest voxel
        code = rows["code"][row]
        new = (code[1:] != code[:-1]) | (cube[1:] != cube[:-1])
        first = np.concatenate(([0], np.flatnonzero(new) + 1))
        cube = cube[first]
        total = np.add.reduceat(rows["value"][row].astype(np.float64), first)
        least, most = np.minimum(total, 0), np.maximum(total, 0)
    first = _begins(cube)
    here = cube[first]
    some[here] = True
    low[here] = np.minimum.reduceat(least, first)
    high[here] = np.maximum.reduceat(most, first)


def _in_cubes(points: SortedPoints, codes: np.ndarray, level: int, cubes: Cubes) -> _Found:
    """Returns the rows of a table that lie in cubes; its level is the cubes' or a finer one."""
    cells = _cells(points, codes, level, cubes)
    row, own = cells.listed()
    cube = cells.cube[own]
    voxel = cells.voxels(points.codes, codes[row], own) - cubes.low_k3[cube]
    x, y, z = ((voxel >= 0) & (voxel < cubes.side)).T
    keep = x & y & z
    return row[keep], cube[keep]


def _cells(
    points: SortedPoints, codes: np.ndarray, level: int, cubes: Cubes, *, least: int = _CELL
) -> _Cells:
    """Returns the cells that cover the cubes and hold rows of a table, whose level is the cubes' or
    a finer one. A cell's side is N, or the largest power of N up to max(least, side // 8).
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
    # How many codes of the table a cell covers.
    below = n ** (3 * (cubes.level - level))
    covers = min(size**3 * below, n ** (3 * max(0, curve.digits - level)))
    code = curve.of(cell[cube, which]) * (size**3 * below)
    start = np.searchsorted(codes, code)
    count = np.searchsorted(codes, code + covers) - start
    some = np.flatnonzero(count)
    cube, which, code, start, count = (one[some] for one in (cube, which, code, start, count))
    return _Cells(cube, first[cube, which], code, start, count, size, below)


def _wide(points: SortedPoints, cubes: Cubes) -> Iterator[tuple[Rows, _Cells]]:
    """Yields for each level coarser than the cubes' its points, and the cells that hold all points
    that may reach into the cubes.
    """
    grid = points.grid
    for level, table in points.points.items():
        if level <= cubes.level or "radius" not in table.rows:
            continue
        # Radii are at most a voxel of their level; only those of the coarsest level are unbounded.
        up = grid.branching ** (level - cubes.level)
        reach = 1
        if level == grid.levels - 1:
            reach = int(max(grid.extent)) // grid.branching**level + 1
        low = cubes.low_k3 // up - reach
        around = Cubes(low, (cubes.side + up - 2) // up + 1 + 2 * reach, level)
        yield table.rows, _cells(points, table.rows["code"], 0, around, least=1)


def _reaching(points: SortedPoints, cubes: Cubes) -> Iterator[tuple[Rows, _Found]]:
    """Yields for each level coarser than the cubes' the points that reach into them, or nearly."""
    grid = points.grid
    half = 0.5 * cubes.side * grid.spacing_3 * grid.branching**cubes.level
    middle = grid.low + (2 / cubes.side * cubes.low_k3 + 1) * half
    for rows, cells in _wide(points, cubes):
        row, own = cells.listed()
        cube = cells.cube[own]
        for axis in range(3):
            away = np.abs(rows["position"][row, axis] - middle[cube, axis])
            radius = rows["radius"][row].astype(np.float64)
            near = away < _NEARLY * radius + half[axis]
            row, cube = row[near], cube[near]
        if len(row):
            yield rows, (row, cube)


def _narrow_lists(
    points: SortedPoints, cubes: Cubes, table: tuple[Rows, int] | None
) -> tuple[np.ndarray, ...]:
    """Returns the arguments of `ops.splat` for narrow rows: lists of cubes, voxels, values."""
    if table is None:
        none = (np.empty((0, 3), np.int64), np.empty((0, points.width)))
        return (*_lists(cubes, np.empty(0, np.int64), np.empty((0, 2), np.int64)), *none)
    rows, level = table
    cells = _cells(points, rows["code"], level, cubes)
    once, same = cells.once()
    row, own = once.listed()
    voxel = once.voxels(points.codes, rows["code"][row], own)
    value = rows["value"][row].astype(np.float64, copy=False)
    return (*_lists(cubes, cells.cube, _runs(once, same)), voxel, value)


def _wide_lists(points: SortedPoints, cubes: Cubes) -> tuple[np.ndarray, ...]:
    """Returns the arguments of `ops.splat` for points wider than the cubes' voxels, those of finer
    levels first: lists of cubes, positions, radii, values.
    """
    cube, run = [np.empty(0, np.int64)], [np.empty((0, 2), np.int64)]
    parts = [(np.empty((0, 3)), np.empty(0), np.empty((0, points.width)))]
    ahead = 0
    for rows, cells in _wide(points, cubes):
        once, same = cells.once()
        row, _ = once.listed()
        place, radius, value = (
            rows[name][row].astype(np.float64) for name in ("position", "radius", "value")
        )
        cube.append(cells.cube)
        run.append(ahead + _runs(once, same))
        parts.append((place, radius, value))
        ahead += len(row)
    columns = (np.concatenate(one) for one in zip(*parts, strict=True))
    return (*_lists(cubes, np.concatenate(cube), np.concatenate(run)), *columns)


def _runs(once: _Cells, same: np.ndarray) -> np.ndarray:
    """Returns (s, 2) begin and end of each cell's rows in a table of the distinct cells' rows."""
    begin = once.ahead()
    return np.stack((begin, begin + once.rows), 1)[same]


def _lists(cubes: Cubes, cube_s: np.ndarray, run_s2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the index at which each cube's runs begin, and all runs sorted by cube."""
    order = np.argsort(cube_s, kind="stable")
    return np.searchsorted(cube_s[order], np.arange(len(cubes.low_k3) + 1)), run_s2[order]


def narrow_near(points: SortedPoints, center: np.ndarray, reach: float) -> np.ndarray:
    """Returns as rows (m,) of `points.points[0].rows` points narrower than a finest voxel: all that
    lie within `reach` of `center` along each axis, and some others nearby.
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
    return _in_cubes(points, points.points[0].rows["code"], 0, cubes)[0]
