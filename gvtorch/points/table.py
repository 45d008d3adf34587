"""`Table`: rows that are appended and then read, in memory or in files that are mapped; sorted runs
of rows, and what is made of them in one pass: merged, and added up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from ..base.whole_file import told_of

Rows = dict[str, np.ndarray]  # columns of equal length; "code" is int64
Fold = Callable[[np.ndarray, np.ndarray], np.ndarray]  # as `np.add.reduceat`


class Table:
    """Columns by name. In a folder each is a file of numbers, `NAME.COLUMN`."""

    def __init__(self, folder: Path | None, name: str) -> None:
        """Is empty; in memory if there is no folder."""
        self.folder, self.name = folder, name
        self.kinds: dict[str, tuple[str, tuple[int, ...]]] = {}  # dtype, and sizes of a row
        self._count = 0
        self._parts: list[Rows] = []
        self._rows: Rows | None = None

    @classmethod
    def mapped(
        cls, folder: Path, name: str, count: int, kinds: dict[str, tuple[str, tuple[int, ...]]]
    ) -> Table:
        """Returns one that lies in a folder; ValueError if a file is missing or cut short."""
        table = cls(folder, name)
        table._count, table.kinds = count, kinds
        for column, (dtype, sizes) in kinds.items():
            file = table.file(column)
            wanted = count * int(np.prod(sizes, initial=1)) * np.dtype(dtype).itemsize
            size = file.stat().st_size if file.is_file() else -1
            if size != wanted:
                found = "is not there" if size < 0 else f"has {size}"
                raise ValueError(f"{file}: sorted points take {wanted} bytes, the file {found}")
        return table

    def file(self, column: str) -> Path:
        """Where a column lies."""
        assert self.folder is not None
        return self.folder / f"{self.name}.{column}"

    def append(self, rows: Rows) -> None:
        """Adds rows."""
        self._rows = None
        self._count += len(rows["code"])
        if self.folder is None:
            self._parts.append(rows)
            return
        for column, values in rows.items():
            self.kinds[column] = (values.dtype.str, values.shape[1:])
            with told_of(self.file(column)), self.file(column).open("ab") as file:
                file.write(np.ascontiguousarray(values).data)  # see `write_npy`

    @property
    def rows(self) -> Rows:
        """All rows, mapped where they lie in files."""
        if self._rows is not None:
            return self._rows
        if self.folder is None:
            names = self._parts[0] if self._parts else {}
            joined = {name: np.concatenate([one[name] for one in self._parts]) for name in names}
            self._parts = [joined] if joined else []
            self._rows = joined or {"code": np.empty(0, np.int64)}
        elif not self._count:
            self._rows = {"code": np.empty(0, np.int64)}
        else:
            # As plain arrays: cutting a memmap into parts takes ten times as long.
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
        """Yields all rows, so many at a time."""
        for start in range(0, self._count, count):
            yield {name: values[start : start + count] for name, values in self.rows.items()}

    def remove(self) -> None:
        """Removes the files."""
        self._rows = None
        for column in self.kinds:
            self.file(column).unlink(missing_ok=True)


class Runs(Table):
    """Rows that come in any order, and leave sorted by code: sorted a block at a time, and merged.
    Rows of equal codes keep their order within a block.
    """

    def __init__(self, folder: Path | None, name: str, block: int) -> None:
        """Is empty; see `Table`."""
        super().__init__(folder, name)
        self._block, self._ends = block, [0]

    def append(self, rows: Rows) -> None:
        """Adds a block of rows."""
        if not len(rows["code"]):
            return
        order = np.argsort(rows["code"], kind="stable")
        super().append({name: values[order] for name, values in rows.items()})
        self._ends.append(len(self))

    def sorted(self) -> Iterator[Rows]:
        """Yields all rows by rising codes, a block at a time."""
        rows, at, ends = self.rows, self._ends[:-1], self._ends[1:]
        if len(at) == 1:
            yield from self.blocks(self._block)
            return
        while live := [run for run in range(len(at)) if at[run] < ends[run]]:
            step = max(1, self._block // len(live))
            read = {run: min(at[run] + step, ends[run]) for run in live}
            codes = {run: np.asarray(rows["code"][at[run] : read[run]]) for run in live}
            # Codes up to which all runs have been read.
            limit = min((codes[r][-1] for r in live if read[r] < ends[r]), default=None)
            parts = []
            for run in live:
                count = len(codes[run])
                if limit is not None:
                    count = int(np.searchsorted(codes[run], limit, side="right"))
                parts.append({n: values[at[run] : at[run] + count] for n, values in rows.items()})
                at[run] += count
            block = {name: np.concatenate([part[name] for part in parts]) for name in rows}
            order = np.argsort(block["code"], kind="stable")
            yield {name: values[order] for name, values in block.items()}


def grouped(blocks: Iterable[Rows], folds: Mapping[str, Fold], divide: int = 1) -> Iterator[Rows]:
    """Yields a row for each code, divided by a number, of sorted blocks of rows: each column folded
    over the rows that share it. Columns without a fold are left out.
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
        made = {name: fold(block[name], first) for name, fold in folds.items()}
        made["code"] = code[first]
        carried = {name: values[-1:] for name, values in made.items()}  # may go on
        yield {name: values[:-1] for name, values in made.items()}
    if carried is not None:
        yield carried
