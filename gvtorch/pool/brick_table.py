"""`BrickTable`: bricks that lie ready in host memory; and how bricks by channel are looked at and
moved, whether they are tensors or rows of a table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ..base import check

_WORDS = {8: torch.int64, 4: torch.int32, 2: torch.int16, 1: torch.uint8}


class BrickTable:
    """Bricks that lie ready in host memory. A producer answers with `table[row]`: the bricks are
    gathered once, on their way to the device.
    """

    def __init__(self, bricks: Tensor) -> None:
        """Takes over (n, z, y, x, c) bricks on the CPU, borders included.

        Raises:
            ValueError: They are no contiguous tensor on the CPU, or hold NaN or infinite values.
        """
        if bricks.dim() != 5 or bricks.device.type != "cpu" or not bricks.is_contiguous():
            raise ValueError(
                "BrickTable: bricks must be contiguous (n, z, y, x, c) on the CPU, "
                f"got {check.describe(bricks)}"
            )
        if bricks.is_floating_point() and not torch.isfinite(bricks.sum(dtype=torch.float64)):
            raise ValueError("BrickTable: bricks hold NaN or infinite values")
        self.bricks = bricks

    def __len__(self) -> int:
        return len(self.bricks)

    def __getitem__(self, row: Tensor) -> TableRows:
        """Names bricks by their (k,) int64 rows; ValueError if one is outside the table."""
        row = row.to(device="cpu", dtype=torch.int64)
        if len(row) and (int(row.min()) < 0 or int(row.max()) >= len(self)):
            raise ValueError(f"BrickTable: rows must be 0 to {len(self) - 1}")
        return TableRows(self.bricks, row)

    def __repr__(self) -> str:
        return f"BrickTable({check.describe(self.bricks)}, {self.bricks.nbytes / 1e6:.1f} MB)"


class TableRows:
    """Some bricks of a table, not gathered yet: like a tensor (k, z, y, x, c) on the CPU."""

    def __init__(self, table: Tensor, row: Tensor) -> None:
        """Names rows (k,) int64 of a table (n, z, y, x, c)."""
        self.table, self.row = table, row

    def __len__(self) -> int:
        return len(self.row)

    def __getitem__(self, index: slice | Tensor) -> TableRows:
        return TableRows(self.table, self.row[index.cpu() if isinstance(index, Tensor) else index])

    @property
    def shape(self) -> tuple[int, ...]:
        """(k, z, y, x, c)."""
        return (len(self.row), *self.table.shape[1:])

    @property
    def dtype(self) -> torch.dtype:
        """The table's dtype."""
        return self.table.dtype

    def gather(self, out: Tensor | None = None) -> Tensor:
        """Returns the bricks, in `out` if that is given."""
        out = torch.empty(self.shape, dtype=self.dtype) if out is None else out
        table, rows = wide_rows(self.table, out)
        torch.index_select(table, 0, self.row, out=rows)
        return out


Voxels = Mapping[str, Tensor | TableRows]  # for each channel (k, z, y, x, c)


def wide_rows(*tensors: Tensor) -> list[Tensor]:
    """Returns (k, w) views of contiguous tensors in the widest integers that fit all of their rows:
    fewer elements move, and uint16, which torch can't index, becomes int16.
    """
    widest = 8
    for tensor in tensors:
        row = math.prod(tensor.shape[1:]) * tensor.itemsize
        widest = math.gcd(widest, row, tensor.storage_offset() * tensor.itemsize)
        widest = math.gcd(widest, tensor.data_ptr())
    word = _WORDS[widest]
    return [t.view(len(t), math.prod(t.shape[1:])).view(word) for t in tensors]


def on_host(data: Voxels) -> bool:
    """Returns whether any channel lies in host memory."""
    return any(isinstance(rows, TableRows) or rows.device.type == "cpu" for rows in data.values())


def on_device(rows: Tensor | TableRows, device: torch.device) -> Tensor:
    """Returns contiguous bricks on the device; the host waits for the copy."""
    gathered = rows.gather() if isinstance(rows, TableRows) else rows
    return gathered.to(device).contiguous()
