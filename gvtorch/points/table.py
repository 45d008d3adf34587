"""`Table`: rows that are appended and then read, in memory or in mapped files; `Runs`: sorted runs
of rows, merged on reading; `grouped`: rows of equal codes, reduced in one pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from ..base.whole_file import name_in_errors

Rows = dict[str, np.ndarray]  # columns of equal length; "code" is int64
Fold = Callable[[np.ndarray, np.ndarray], np.ndarray]  # a reduction such as `np.add.reduceat`


class Table:
    """Columns by name. In a folder, each column is a raw binary file, `NAME.COLUMN`."""

    def __init__(self, folder: Path | None, name: str) -> None:
        """Creates an empty table; in memory if `folder` is None."""
        self.folder, self.name = folder, name
        self.kinds: dict[str, tuple[str, tuple[int, ...]]] = {}  # dtype, and shape of a row
        self._count = 0
        self._parts: list[Rows] = []
        self._rows: Rows | None = None

    @classmethod
    def mapped(
        cls, folder: Path, name: str, count: int, kinds: dict[str, tuple[str, tuple[int, ...]]]
    ) -> Table:
        """Opens a table in a folder; ValueError if a file is missing or has the wrong size."""
        table = cls(folder, name)
        table._count, table.kinds = count, kinds
        for column, (dtype, sizes) in kinds.items():
            file = table.file(column)
            expected_bytes = count * int(np.prod(sizes, initial=1)) * np.dtype(dtype).itemsize
            size = file.stat().st_size if file.is_file() else -1
            if size != expected_bytes:
                problem = "is not there" if size < 0 else f"has {size}"
                raise ValueError(
                    f"{file}: sorted points take {expected_bytes} bytes, the file {problem}"
                )
        return table

    def file(self, column: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{self.name}.{column}"

    def append(self, rows: Rows) -> None:
        self._rows = None
        self._count += len(rows["code"])
        if self.folder is None:
            self._parts.append(rows)
            return
        for column, values in rows.items():
            self.kinds[column] = (values.dtype.str, values.shape[1:])
            with name_in_errors(self.file(column)), self.file(column).open("ab") as file:
                file.write(np.ascontiguousarray(values).data)  # see `write_npy`

    @property
    def rows(self) -> Rows:
        """All rows; those in files are memory-mapped."""
        if self._rows is not None:
            return self._rows
        if self.folder is None:
            names = self._parts[0] if self._parts else {}
            joined = {name: np.concatenate([part[name] for part in self._parts]) for name in names}
            self._parts = [joined] if joined else []
            self._rows = joined or {"code": np.empty(0, np.int64)}
        elif not self._count:
            self._rows = {"code": np.empty(0, np.int64)}
        else:
            # As plain arrays: slicing a memmap takes ten times as long.
            self._rows = {
                column: np.asarray(
                    np.memmap(self.file(column), np.dtype(dtype), "r", 0, (self._count, *sizes))
                )
                for column, (dtype, sizes) in self.kinds.items()
            }
        return self._rows

    def __len__(self) -> int:
        return self._count

    def blocks(self, count: int) -> Iterator[Rows]:
        """Yields all rows, `count` at a time."""
        for start in range(0, self._count, count):
            yield {name: values[start : start + count] for name, values in self.rows.items()}

    def remove(self) -> None:
        self._rows = None
        for column in self.kinds:
            self.file(column).unlink(missing_ok=True)


class Runs(Table):
    """Rows that are appended in any order, and read sorted by code: blocks are sorted one by one,
    and merged on reading. Rows of equal codes keep their order within a block.
    """

    def __init__(self, folder: Path | None, name: str, block: int) -> None:
        """Creates an empty table; see `Table`. `block`: rows to read at a time."""
        super().__init__(folder, name)
        self._block, self._run_ends = block, [0]

    def append(self, rows: Rows) -> None:
        """Adds a block of rows as a sorted run."""
        if not len(rows["code"]):
            return
        order = np.argsort(rows["code"], kind="stable")
        super().append({name: values[order] for name, values in rows.items()})
        self._run_ends.append(len(self))

    def sorted(self) -> Iterator[Rows]:
        """Yields all rows by increasing codes, a block at a time."""
        rows, starts, ends = self.rows, self._run_ends[:-1], self._run_ends[1:]
        if len(starts) == 1:
            yield from self.blocks(self._block)
            return
        while live := [run for run in range(len(starts)) if starts[run] < ends[run]]:
            step = max(1, self._block // len(live))
            read_ends = {run: min(starts[run] + step, ends[run]) for run in live}
            codes = {run: np.asarray(rows["code"][starts[run] : read_ends[run]]) for run in live}
            # Up to this code, all runs have been read.
            limit = min((codes[r][-1] for r in live if read_ends[r] < ends[r]), default=None)
            parts = []
            for run in live:
                count = len(codes[run])
                if limit is not None:
                    count = int(np.searchsorted(codes[run], limit, side="right"))
                taken = slice(starts[run], starts[run] + count)
                parts.append({name: values[taken] for name, values in rows.items()})
                starts[run] += count
            block = {name: np.concatenate([part[name] for part in parts]) for name in rows}
            order = np.argsort(block["code"], kind="stable")
            yield {name: values[order] for name, values in block.items()}


def grouped(blocks: Iterable[Rows], folds: Mapping[str, Fold], divide: int = 1) -> Iterator[Rows]:
    """Groups sorted blocks of rows by code // divide, and yields blocks with one row for each
    group: each column reduced by its fold. Columns without a fold are left out.
    """
    carried: Rows | None = None
    for rows in blocks:
        if not len(rows["code"]):
            continue
        block = {"code": rows["code"] // divide, **{name: rows[name] for name in folds}}
        if carried is not None:
            block = {name: np.concatenate((carried[name], block[name])) for name in block}
        code = block["code"]
        first = np.concatenate(([0], np.flatnonzero(code[1:] != code[:-1]) + 1))
        reduced = {name: fold(block[name], first) for name, fold in folds.items()}
        reduced["code"] = code[first]
        carried = {name: values[-1:] for name, values in reduced.items()}  # its group may continue
        yield {name: values[:-1] for name, values in reduced.items()}
    if carried is not None:
        yield carried
