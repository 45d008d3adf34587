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

_CELL_VOXELS = 4  # voxels along a cell's side at most, unless cubes are large: see `_cells`
_RADIUS_MARGIN = 1.001  # factor on a point's radius that covers rounding errors


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
    codes_per_voxel: int  # how many codes of the table a voxel has

    def distinct(self) -> tuple[_Cells, np.ndarray]:
        """Returns the distinct cells, and (s,) the index of each cell among these."""
        _, first, inverse = np.unique(self.code, return_index=True, return_inverse=True)
        fields = {name: getattr(self, name)[first] for name in self._fields[:5]}
        return self._replace(**fields), inverse

    def rows_before(self) -> np.ndarray:
        """Returns (s,) the number of rows in all cells before each cell."""
        return np.cumsum(self.rows) - self.rows

    def all_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns (m,) the rows of all cells, and (m,) the cell of each row."""
        cell = np.repeat(np.arange(len(self.rows)), self.rows)
        return (self.start - self.rows_before())[cell] + np.arange(len(cell)), cell

    def voxels(self, curve: Codes, code: np.ndarray, cell: np.ndarray) -> np.ndarray:
        """Returns (m, 3) the voxels x, y, z of codes (m,), which lie in cells `cell` (m,)."""
        offset = code - self.code[cell]
        if self.codes_per_voxel > 1:
            offset //= self.codes_per_voxel
        return self.first_s3[cell] + curve.positions(self.size)[offset]


#: (m,) rows of a table in cubes, and (m,) their cubes, increasing; equal codes are adjacent.
_CubeRows = tuple[np.ndarray, np.ndarray]


def values(points: SortedPoints, cubes: Cubes, *, narrow: bool = True) -> np.ndarray:
    """Returns (k, z, y, x, c) float64 the mean sum per finest voxel in each voxel; unless `narrow`,
    without points that are narrower than a finest voxel.
    """
    edge = np.stack(points.grid.edges(cubes.low_k3, cubes.side, cubes.level), 1)
    low = np.ascontiguousarray(cubes.low_k3, np.int64)
    lists = (*_narrow_lists(points, cubes, narrow), *_wide_lists(points, cubes))
    sums = splat(*(torch.from_numpy(array) for array in (edge, low, *lists)))
    scale = points.grid.branching ** (3 * cubes.level)
    return sums.div_(scale).numpy() if scale > 1 else sums.numpy()


def ranges(
    points: SortedPoints, cubes: Cubes, *, narrow: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (k,) whether cubes hold any points, and (k, c) lower and upper bounds of the values
    of their voxels, at this level and all finer ones; 0 lies between the bounds.
    """
    k = len(cubes.low_k3)
    nonempty, low = np.zeros(k, bool), np.zeros((k, points.width))
    high = np.zeros_like(low)
    rows, level = _source_rows(points, cubes.level, narrow)
    cube_rows = _in_cubes(points, rows["code"], level, cubes)
    if len(cube_rows[0]):
        _widen(rows, cube_rows, nonempty, low, high)
    for rows, (row, cube) in _reaching(points, cubes):
        fraction = peak(rows["radius"][row].astype(np.float64), points.grid.spacing_3)
        value = fraction[:, None] * rows["value"][row]
        first = _cube_starts(cube)
        nonempty[cube[first]] = True
        low[cube[first]] += np.add.reduceat(np.minimum(value, 0), first)
        high[cube[first]] += np.add.reduceat(np.maximum(value, 0), first)
    return nonempty, low, high


def region(points: SortedPoints, low: tuple[int, ...], high: tuple[int, ...]) -> np.ndarray:
    """Returns (z, y, x, c) float64 sums in the finest voxels of a box `low` to `high`, z y x."""
    side = 32
    shape = [b - a for a, b in zip(low, high, strict=True)]
    out = np.empty((*shape, points.width))
    for corner in itertools.product(*(range(a, b, side) for a, b in zip(low, high, strict=True))):
        cube = values(points, Cubes(np.array([corner[::-1]]), side, 0))[0]
        start = [c - a for c, a in zip(corner, low, strict=True)]
        window = tuple(slice(a, a + side) for a in start)
        z, y, x = out[window].shape[:3]
        out[window] = cube[:z, :y, :x]
    return out


def _cube_starts(cube: np.ndarray) -> np.ndarray:
    """Returns the indices at which a new cube begins."""
    return np.flatnonzero(np.diff(cube, prepend=-1))


def _source_rows(points: SortedPoints, level: int, narrow: bool) -> tuple[Rows, int]:
    """Returns the rows from which a level's sums are computed, and their level; none if not
    `narrow`.
    """
    stored_levels = [stored for stored in points.sums if stored <= level]
    if narrow and stored_levels:
        return points.sums[stored_levels[-1]].rows, stored_levels[-1]
    if narrow and 0 in points.points:
        return points.points[0].rows, 0
    return {"code": np.empty(0, np.int64), "value": np.empty((0, points.width))}, 0


def _widen(
    rows: Rows, cube_rows: _CubeRows, nonempty: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    """Updates bounds of cubes in place by the rows found in them."""
    row, cube = cube_rows
    if "low" in rows:
        smallest, largest = rows["low"][row], rows["high"][row]
    else:  # points: add them up by finest voxel
        code = rows["code"][row]
        is_first = (code[1:] != code[:-1]) | (cube[1:] != cube[:-1])
        first = np.concatenate(([0], np.flatnonzero(is_first) + 1))
        cube = cube[first]
        total = np.add.reduceat(rows["value"][row].astype(np.float64), first)
        smallest, largest = np.minimum(total, 0), np.maximum(total, 0)
    first = _cube_starts(cube)
    touched = cube[first]
    nonempty[touched] = True
    low[touched] = np.minimum.reduceat(smallest, first)
    high[touched] = np.maximum.reduceat(largest, first)


def _in_cubes(points: SortedPoints, codes: np.ndarray, level: int, cubes: Cubes) -> _CubeRows:
    """Returns the rows of a table that lie in cubes; its level is the cubes' or a finer one."""
    cells = _cells(points, codes, level, cubes)
    row, cell = cells.all_rows()
    cube = cells.cube[cell]
    voxel = cells.voxels(points.codes, codes[row], cell) - cubes.low_k3[cube]
    x, y, z = ((voxel >= 0) & (voxel < cubes.side)).T
    inside = x & y & z
    return row[inside], cube[inside]


def _cells(
    points: SortedPoints,
    codes: np.ndarray,
    level: int,
    cubes: Cubes,
    *,
    min_size: int = _CELL_VOXELS,
) -> _Cells:
    """Returns the cells that cover the cubes and hold rows of a table, whose level is the cubes' or
    a finer one. A cell's side is N, or the largest power of N up to max(least, side // 8).
    """
    grid, curve = points.grid, points.codes
    n = grid.branching
    size = n
    while size * n <= max(min_size, cubes.side // 8):
        size *= n
    cells_per_side = (cubes.side + size - 2) // size + 1
    step = np.indices((cells_per_side,) * 3).reshape(3, -1).T[:, ::-1]
    cell = (cubes.low_k3 // size)[:, None] + step  # (k, m, 3)
    first = cell * size
    scale = n**cubes.level
    inside = (first + size > 0) & (first * scale < np.array(grid.extent))
    inside &= first < (cubes.low_k3 + cubes.side)[:, None]
    cube, cell_index = np.nonzero(inside.all(2))
    # How many codes of the table a cell covers.
    codes_per_voxel = n ** (3 * (cubes.level - level))
    codes_covered = min(size**3 * codes_per_voxel, n ** (3 * max(0, curve.digits - level)))
    code = curve.of(cell[cube, cell_index]) * (size**3 * codes_per_voxel)
    start = np.searchsorted(codes, code)
    count = np.searchsorted(codes, code + codes_covered) - start
    nonempty = np.flatnonzero(count)
    arrays = (cube, cell_index, code, start, count)
    cube, cell_index, code, start, count = (array[nonempty] for array in arrays)
    return _Cells(cube, first[cube, cell_index], code, start, count, size, codes_per_voxel)


def _wide_points(points: SortedPoints, cubes: Cubes) -> Iterator[tuple[Rows, _Cells]]:
    """Yields for each level coarser than the cubes' its points, and the cells that hold all points
    that may reach into the cubes.
    """
    grid = points.grid
    for level, table in points.points.items():
        if level <= cubes.level or "radius" not in table.rows:
            continue
        # Radii are at most a voxel of their level; only those of the coarsest level are unbounded.
        scale = grid.branching ** (level - cubes.level)
        margin = 1
        if level == grid.levels - 1:
            margin = int(max(grid.extent)) // grid.branching**level + 1
        low = cubes.low_k3 // scale - margin
        widened = Cubes(low, (cubes.side + scale - 2) // scale + 1 + 2 * margin, level)
        yield table.rows, _cells(points, table.rows["code"], 0, widened, min_size=1)


def _reaching(points: SortedPoints, cubes: Cubes) -> Iterator[tuple[Rows, _CubeRows]]:
    """Yields for each level coarser than the cubes' the points that reach into them, or nearly."""
    grid = points.grid
    half_size = 0.5 * cubes.side * grid.spacing_3 * grid.branching**cubes.level
    middle = grid.low + (2 / cubes.side * cubes.low_k3 + 1) * half_size
    for rows, cells in _wide_points(points, cubes):
        row, cell = cells.all_rows()
        cube = cells.cube[cell]
        for axis in range(3):
            distance = np.abs(rows["position"][row, axis] - middle[cube, axis])
            radius = rows["radius"][row].astype(np.float64)
            reaches = distance < _RADIUS_MARGIN * radius + half_size[axis]
            row, cube = row[reaches], cube[reaches]
        if len(row):
            yield rows, (row, cube)


def _narrow_lists(points: SortedPoints, cubes: Cubes, narrow: bool) -> tuple[np.ndarray, ...]:
    """Returns the arguments of `ops.splat` for narrow rows: lists of cubes, voxels, values."""
    rows, level = _source_rows(points, cubes.level, narrow)
    cells = _cells(points, rows["code"], level, cubes)
    distinct, inverse = cells.distinct()
    row, cell = distinct.all_rows()
    voxel = distinct.voxels(points.codes, rows["code"][row], cell)
    value = rows["value"][row].astype(np.float64, copy=False)
    return (*_lists(cubes, cells.cube, _runs(distinct, inverse)), voxel, value)


def _wide_lists(points: SortedPoints, cubes: Cubes) -> tuple[np.ndarray, ...]:
    """Returns the arguments of `ops.splat` for points wider than the cubes' voxels, those of finer
    levels first: lists of cubes, positions, radii, values.
    """
    cube, run = [np.empty(0, np.int64)], [np.empty((0, 2), np.int64)]
    no_points = np.empty((0, 3)), np.empty(0), np.empty((0, points.width))
    parts: list[tuple[np.ndarray, ...]] = [no_points]
    rows_before = 0
    for rows, cells in _wide_points(points, cubes):
        distinct, inverse = cells.distinct()
        row, _ = distinct.all_rows()
        cube.append(cells.cube)
        run.append(rows_before + _runs(distinct, inverse))
        columns = (rows[name][row] for name in ("position", "radius", "value"))
        parts.append(tuple(column.astype(np.float64) for column in columns))
        rows_before += len(row)
    joined = (np.concatenate(column) for column in zip(*parts, strict=True))
    return (*_lists(cubes, np.concatenate(cube), np.concatenate(run)), *joined)


def _runs(distinct: _Cells, inverse: np.ndarray) -> np.ndarray:
    """Returns (s, 2) begin and end of each cell's rows in a table of the distinct cells' rows."""
    begin = distinct.rows_before()
    return np.stack((begin, begin + distinct.rows), 1)[inverse]


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
    first, last = (np.floor((center - grid.low + sign * reach) / size) for sign in (-1, 1))
    limit = math.ceil(max(grid.extent) / grid.branching**level)
    low, high = (np.clip(corner, -1, limit).astype(np.int64) for corner in (first, last))
    cubes = Cubes(low[None], int((high - low).max()) + 1, level)
    return _in_cubes(points, points.points[0].rows["code"], 0, cubes)[0]
