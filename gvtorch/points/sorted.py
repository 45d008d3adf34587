"""`SortedPoints`: points in the order of a space-filling curve, and their sums in voxels of coarser
levels; in memory, or in a folder of mapped files. `sort_points` makes them in bounded memory.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..base import check
from ..base.stage import Progress, no_progress
from ..base.whole_file import durable_file
from .grid import Codes, PointGrid, peak, point_shares
from .points import Points
from .table import Fold, Rows, Runs, Table, grouped

_META = "points.json"
_VERSION = 1
_ROWS_WORTH_STORING = 512  # a level's sums are stored if a voxel of it adds up more rows
_BLOCK_COPIES = 8  # copies of a block of rows in memory while it is sorted
_VALUE_SUMS: Mapping[str, Fold] = {"value": np.add.reduceat}
_SUMS_AND_BOUNDS: Mapping[str, Fold] = {
    **_VALUE_SUMS,
    "low": np.minimum.reduceat,
    "high": np.maximum.reduceat,
}
_ALL_SUMS: Mapping[str, Fold] = dict.fromkeys(("value", "low", "high"), np.add.reduceat)


@runtime_checkable
class PointSource(Protocol):
    """A source of points: `Points`, or a file that is read in parts."""

    def __len__(self) -> int: ...

    def blocks(self, count: int, /) -> Iterator[Points]:
        """Yields all points, `count` at a time; may be called again."""


class SortedPoints:
    """Points by level and code.

    Attributes:
        grid: The voxels.
        codes: The codes of voxels.
        width: How many numbers a point's value has.
        points: By level, the points whose radius needs its voxels (see
            `PointGrid.level_of_radius`; level 0 has all narrower ones): code of the finest voxel,
            position, value, and radius if any.
        sums: By level, only where worth storing: code of each voxel that holds points, its sum, and
            the smallest and largest sum of a finest voxel in it.
        folder: The folder of its files; None: in memory.
    """

    def __init__(
        self,
        grid: PointGrid,
        width: int,
        points: dict[int, Table],
        sums: dict[int, Table],
        folder: Path | None = None,
    ) -> None:
        """Takes the tables; see `sort_points`."""
        self.grid, self.width, self.points, self.sums = grid, width, points, sums
        self.codes = Codes(grid.branching, max(grid.extent))
        self.folder = folder

    @classmethod
    def open(cls, folder: str | Path) -> SortedPoints:
        """Opens a folder that `sort_points` wrote.

        Raises:
            FileNotFoundError, ValueError: It does not exist, or is damaged.
        """
        folder = Path(folder)
        meta = check.json_file("sorted points", folder / _META)
        try:
            if meta["version"] != _VERSION:
                raise ValueError(f"version {meta['version']!r}, this reads {_VERSION}")
            fields = meta["grid"]
            box = (fields["low"], fields["high"])
            grid = PointGrid.around("grid", (), fields["extent"], box, fields["branching"])
            width = check.integer("a value", "width", meta["width"], low=1)
            tables = {
                table_kind: {
                    int(level): Table.mapped(
                        folder,
                        f"{table_kind}_{int(level)}",
                        check.integer("rows", "count", table_fields["count"], low=1),
                        _checked_kinds(table_kind, table_fields["kinds"], width),
                    )
                    for level, table_fields in meta[table_kind].items()
                }
                for table_kind in ("points", "sums")
            }
            return cls(grid, width, tables["points"], tables["sums"], folder)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{folder}: no sorted points: {error}") from None

    def __len__(self) -> int:
        return sum(len(table) for table in self.points.values())

    def __repr__(self) -> str:
        x, y, z = self.grid.extent
        place = "in memory" if self.folder is None else str(self.folder)
        return f"SortedPoints({len(self)}, values of {self.width}, {x}x{y}x{z} (x, y, z), {place})"

    def save(self) -> None:
        """Writes the metadata that `open` reads, the last step of writing the folder."""
        assert self.folder is not None
        tables_by_kind = {
            kind: {
                level: {"count": len(table), "kinds": table.kinds}
                for level, table in tables.items()
            }
            for kind, tables in (("points", self.points), ("sums", self.sums))
        }
        grid = dataclasses.asdict(self.grid)
        meta = {"version": _VERSION, "width": self.width, "grid": grid, **tables_by_kind}
        with durable_file(self.folder / _META) as file:
            file.write(json.dumps(meta).encode())


def sort_points(
    points: PointSource,
    extent: int | Sequence[int] = 1024,
    *,
    box: Sequence[Sequence[float]] | None = None,
    branching: int = 2,
    folder: str | Path | None = None,
    memory: int | str = "1 GB",
    progress: Progress = no_progress,
) -> SortedPoints:
    """Sorts points along a curve through a grid of voxels, once, and sums them in its levels.

    Args:
        points: `Points`, or a `PointFile`, which is read part by part (twice, unless
            there is a box).
        extent: Voxels of the finest level, (x, y, z), or along the longest side of the box.
        box: World corners ((x, y, z), (x, y, z)); points outside are left out. Around all points
            with their radii, if left out.
        branching: N.
        folder: Folder to create; it appears when complete. In memory if left out.
        memory: Approximate bytes of memory for sorting, if there is a folder.
        progress: Called with ("sorting", done, total), then ("adding up", levels done, levels).

    Raises:
        ValueError: A number is out of its range or not finite, or no point lies in the box.
        FileExistsError: The folder exists.
        OSError: The disk is full.
    """
    context, target = "sort_points", None if folder is None else Path(folder)
    if not isinstance(points, PointSource):
        kind = type(points).__name__
        raise ValueError(f"{context}: points must be Points or a PointFile, got a {kind}")
    if target is not None and target.exists():
        raise FileExistsError(f"{target}: is there already; remove it or choose a new name")
    first = next(iter(points.blocks(1)))
    row_bytes = 8 + sum(column[:1].nbytes for column in _columns(first).values())
    block_rows = len(points)
    if target is not None:
        nbytes = check.nbytes(context, "memory", memory)
        block_rows = max(4096, nbytes // (_BLOCK_COPIES * row_bytes))
    grid = PointGrid.around(context, points.blocks(block_rows), extent, box, branching)
    draft = None if target is None else target.with_name(f".{target.name}.draft")
    if draft is not None:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
    try:
        sorter = _Sorter(grid, draft, block_rows, progress)
        sorter.read(context, points)
        sorter.add_up()
        sorted_points = SortedPoints(grid, first.width, sorter.points, sorter.sums, draft)
        if draft is None or target is None:
            return sorted_points
        sorted_points.save()
        draft.replace(target)
        return SortedPoints.open(target)
    except BaseException:
        if draft is not None:
            shutil.rmtree(draft, ignore_errors=True)
        raise


def _checked_kinds(
    table_kind: str, kinds: Any, width: int
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Returns dtypes and row shapes of the columns of a folder's table; ValueError unless they are
    such as `sort_points` writes.
    """
    shapes: dict[str, tuple[int, ...]] = {"code": (), "position": (3,), "radius": ()}
    shapes |= dict.fromkeys(("value", "low", "high"), (width,))
    needed = {"code", "value"} | ({"position"} if table_kind == "points" else {"low", "high"})
    if missing := sorted(needed - kinds.keys()):
        raise ValueError(f"there is no column {missing[0]!r}")
    for name, (dtype, sizes) in kinds.items():
        dtypes = (np.int64,) if name == "code" else (np.float32, np.float64)
        if dtype not in [np.dtype(known).str for known in dtypes] or shapes[name] != tuple(sizes):
            raise ValueError(f"column {name!r} holds {sizes} {dtype}")
    return {name: (dtype, tuple(sizes)) for name, (dtype, sizes) in kinds.items()}


def _columns(points: Points) -> Rows:
    rows = {"position": points.positions, "value": points.values}
    return rows if points.radius is None else {**rows, "radius": points.radius}


class _Sorter:
    """The steps of `sort_points`, and its tables."""

    def __init__(
        self, grid: PointGrid, folder: Path | None, block: int, progress: Progress
    ) -> None:
        self.grid, self.folder, self.block = grid, folder, block
        self.codes = Codes(grid.branching, max(grid.extent))
        self.points: dict[int, Table] = {}
        self.sums: dict[int, Table] = {}
        self.progress = progress

    def read(self, context: str, source: PointSource) -> None:
        """Sorts the points by level and code."""
        runs: dict[int, Runs] = {}
        total, done = len(source), 0
        for part in source.blocks(self.block):
            self.progress("sorting", done, 2 * total)
            done += len(part)
            voxel, inside = self.grid.voxel(part.positions)
            rows = {name: column[inside] for name, column in _columns(part).items()}
            rows["code"] = self.codes.of(voxel)
            if part.radius is None:
                self._level_runs(runs, 0).append(rows)
                continue
            levels = self.grid.level_of_radius(rows["radius"])
            for level in np.unique(levels).tolist():
                at_level = levels == level
                level_rows = {name: column[at_level] for name, column in rows.items()}
                self._level_runs(runs, level).append(level_rows)
        runs = {level: level_runs for level, level_runs in sorted(runs.items()) if len(level_runs)}
        if not runs:
            raise ValueError(f"{context}: no point lies in the box")
        for level, unsorted in runs.items():
            self.points[level] = Table(self.folder, f"points_{level}")
            for rows in unsorted.sorted():
                self.points[level].append(rows)
                self.progress("sorting", total + sum(map(len, self.points.values())), 2 * total)
            unsorted.remove()

    def _level_runs(self, runs: dict[int, Runs], level: int) -> Runs:
        if level not in runs:
            runs[level] = Runs(self.folder, f"runs_{level}", self.block)
        return runs[level]

    def add_up(self) -> None:
        """Computes the sums level by level, each from the nearest stored sums below it."""
        for level in range(self.grid.levels):
            self.progress("adding up", level, self.grid.levels)
            wide_shares = self._wide_shares(level)
            sums_below, divide = self._nearest_sums(level)
            if wide_shares is None:
                sums, worth_storing = self._level_sums(f"sums_{level}", sums_below, divide)
                if worth_storing:
                    self.sums[level] = sums
                else:
                    sums.remove()
                continue
            merged = Runs(self.folder, f"both_{level}", self.block)
            for rows in grouped(sums_below, _SUMS_AND_BOUNDS, divide):
                merged.append(rows)
            for rows in wide_shares.sorted():
                merged.append(rows)
            wide_shares.remove()
            self.sums[level] = Table(self.folder, f"sums_{level}")
            for rows in grouped(merged.sorted(), _ALL_SUMS):
                self.sums[level].append(rows)
            merged.remove()
        self.progress("adding up", self.grid.levels, self.grid.levels)

    def _nearest_sums(self, level: int) -> tuple[Iterator[Rows], int]:
        """Returns the nearest sums below a level, and how many of their voxels make one of it."""
        n = self.grid.branching**3
        if stored_levels := [stored for stored in self.sums if stored < level]:
            return self.sums[stored_levels[-1]].blocks(self.block), n ** (level - stored_levels[-1])
        if 0 not in self.points or self._is_wide(0):
            return iter(()), n**level
        return finest_sums(self.points[0].blocks(self.block)), n**level

    def _is_wide(self, level: int) -> bool:
        return level in self.points and "radius" in self.points[level].rows

    def _level_sums(self, name: str, sums_below: Iterator[Rows], divide: int) -> tuple[Table, bool]:
        """Computes the sums of a level; returns them, and whether they are worth storing: they are
        at most half as many rows as below, or a voxel adds up more than `_ROWS_WORTH_STORING` rows.
        """
        rows_below, max_rows = 0, 0
        counted = ({"rows": np.ones(len(rows["code"]), np.int64), **rows} for rows in sums_below)
        table = Table(self.folder, name)
        for rows in grouped(counted, {**_SUMS_AND_BOUNDS, "rows": np.add.reduceat}, divide):
            count = rows.pop("rows")
            rows_below += int(count.sum())
            max_rows = max(max_rows, int(count.max(initial=0)))
            if len(count):
                table.append(rows)
        return table, 0 < 2 * len(table) <= rows_below or max_rows > _ROWS_WORTH_STORING

    def _wide_shares(self, level: int) -> Runs | None:
        """Returns the shares of a level's wide points in its voxels; None if there are none."""
        if not self._is_wide(level):
            return None
        runs = Runs(self.folder, f"own_{level}", self.block)
        for rows in self.points[level].blocks(max(1, self.block // 27)):
            runs.append(self._spread(rows, level))
        return runs

    def _spread(self, rows: Rows, level: int) -> Rows:
        """Returns rows with the shares of points (k,) in the voxels of their level."""
        n = self.grid.branching**level
        size = self.grid.spacing_3 * n
        position, radius = rows["position"].astype(np.float64), rows["radius"].astype(np.float64)
        voxel = np.floor((position - self.grid.low) / size).astype(np.int64)
        most = math.ceil(max(self.grid.extent) / n)
        radius_voxels = math.ceil(min(float(radius.max()), most * size.min()) / size.min())
        count = 2 * radius_voxels + 1
        first = voxel - radius_voxels
        narrow = radius == 0  # wholly in its voxel
        parts = []
        for axis, edge in enumerate(self.grid.edges(first, count, level)):
            fractions = point_shares(edge, position[:, axis], np.where(narrow, 1.0, radius))
            parts.append(np.where(narrow[:, None], np.arange(count) == radius_voxels, fractions))
        x, y, z = parts
        fraction = (z[:, :, None, None] * y[:, None, :, None] * x[:, None, None, :]).reshape(-1)
        step = np.indices((count,) * 3).reshape(3, -1).T[:, ::-1]
        target_voxel = (first[:, None] + step).reshape(-1, 3)
        row = np.repeat(np.arange(len(position)), count**3)
        nonzero = fraction > 0
        row, fraction = row[nonzero], fraction[nonzero]
        value = rows["value"][row].astype(np.float64)
        # A finest voxel holds the share itself (level 0), or at most that at the point's centre.
        largest_fraction = fraction if level == 0 else peak(radius, self.grid.spacing_3)[row]
        bounds = bounds_with_zero(largest_fraction[:, None] * value)
        code = self.codes.of(target_voxel[nonzero])
        return {"code": code, "value": fraction[:, None] * value, **bounds}


def finest_sums(blocks: Iterator[Rows]) -> Iterator[Rows]:
    """Yields the sums of points in finest voxels, from blocks of sorted points."""
    points = (
        {
            "code": rows["code"],
            "value": rows["value"].astype(np.float64),
            "rows": np.ones(len(rows["code"]), np.int64),
        }
        for rows in blocks
    )
    for rows in grouped(points, {**_VALUE_SUMS, "rows": np.add.reduceat}):
        yield rows | bounds_with_zero(rows["value"])


def bounds_with_zero(value: np.ndarray) -> Rows:
    """Returns as float32 the smaller and the larger of each value and 0."""
    with np.errstate(over="ignore"):
        single = value.astype(np.float32)
    return {"low": np.minimum(single, 0), "high": np.maximum(single, 0)}
