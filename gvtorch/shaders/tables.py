"""Tables of colour and alpha, as the kernels read them: rows at even distances of the value, once
for each length of interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..ops.shading import Triple, pack

_MOST_BYTES = 64 * 2**20  # of a table in float32
_KEPT = 4


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How rays are cut into intervals; in which dtype, and on which device they are traced."""

    smallest_spacing: float  # world units; opacity's reference length where none was given
    step: float  # world length of the shortest interval
    levels: int  # lengths of intervals, each twice the one before
    dtype: torch.dtype
    device: torch.device

    def fitting(self, rows: int) -> int:
        """Returns for how many lengths a table is made, where each takes this many rows: fewer than
        `levels` where the table would take more than 64 MB.
        """
        return max(1, min(self.levels, _MOST_BYTES // (16 * rows)))


@dataclass(frozen=True, kw_only=True)
class ColorTable:
    """Colour and alpha by value, as the kernels read them; linear between rows."""

    table_lm4: Tensor  # (l, m, 4) linear RGB, alpha of an interval of step * 2^l; or (l, m, m, 4)
    domain_2: Tensor  # (2,) value of the first row, of the last row
    opaque_m: Tensor  # (m,) int32, how many rows up to this one have an opacity

    @classmethod
    def of(
        cls, table: np.ndarray, domain: tuple[float, float], seen_m: np.ndarray, sampling: Sampling
    ) -> ColorTable:
        """Moves a table that was made in float64 to where rays are traced."""
        dtype, device = sampling.dtype, sampling.device
        return cls(
            table_lm4=torch.tensor(table, dtype=dtype, device=device),
            domain_2=torch.tensor(domain, dtype=dtype, device=device),
            opaque_m=torch.tensor(np.cumsum(seen_m), dtype=torch.int32, device=device),
        )


class TableCache:
    """The last few tables, by what they were made of."""

    def __init__(self) -> None:
        """Starts empty."""
        self._tables: dict[Any, ColorTable] = {}

    def get(self, key: Any, make: Callable[[], ColorTable]) -> ColorTable:
        """Returns the table of a key, made now if it is not kept."""
        if key not in self._tables:
            table = make()
            if len(self._tables) == _KEPT:
                self._tables.pop(next(iter(self._tables)))
            self._tables[key] = table
        return self._tables[key]


def one_color(color: Triple, sampling: Sampling) -> ColorTable:
    """Returns the table of one opaque colour, linear RGB."""
    row = pack((color, 1.0), sampling.dtype, sampling.device)
    return ColorTable(
        table_lm4=row.expand(sampling.levels, 2, 4).contiguous(),
        domain_2=pack((0.0, 1.0), sampling.dtype, sampling.device),
        opaque_m=torch.arange(1, 3, dtype=torch.int32, device=sampling.device),
    )


def interval_levels(root_voxel: float, step: float) -> int:
    """Returns how many lengths of intervals a tree needs: up to that of a voxel of its root."""
    return max(1, math.ceil(math.log2(root_voxel / step)) + 1)
