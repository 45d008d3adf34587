"""Distinct rows of a matrix of integers."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def distinct_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Returns what `rows.unique(dim=0, return_inverse=True)` returns for int64 rows (n, m): the
    distinct rows (k, m) in ascending order, and for each row the index of its equal (n,). Rows are
    numbered first, because sorting numbers is up to 50 times as fast as sorting rows.
    """
    if not len(rows):
        return rows, rows.new_zeros(0)
    low = rows.amin(0)
    sizes = (rows.amax(0) - low + 1).tolist()
    if math.prod(sizes) >= 1 << 63:  # far apart in a deep tree
        return rows.unique(dim=0, return_inverse=True)
    number = rows.new_zeros(len(rows))
    for column, size in zip((rows - low).unbind(1), sizes, strict=True):
        number = number * size + column
    distinct, inverse = number.unique(return_inverse=True)
    row_of = torch.empty_like(distinct)
    row_of[inverse] = torch.arange(len(rows), device=rows.device)
    return rows[row_of], inverse
