"""The table of a pre-integrated transfer function: what an interval shows whose values run linearly
from one number in front to another behind.

Source: Engel, Kraus, Ertl, "High-quality pre-integrated volume rendering using hardware-accelerated
pixel shading", Graphics Hardware 2001.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view

from .transfer_function import Table, TransferFunction, corner_cells

_CELLS = 128, 256  # of a table's side: fewest, most
_FEWEST_PARTS, _MOST_PARTS = 8, 4096  # a cell is integrated in
_MOST_BYTES = 64 * 2**20  # of a table in float32


def integrated_table(
    transfer: TransferFunction,
    length: float,
    levels: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Table:
    """Integrates a transfer function over pairs of values, in float64.

    Args:
        transfer: The function. A cell of the table is the mean of the function over it, so a peak
            thinner than a cell keeps its opacity.
        length: Of the shortest interval, in reference lengths.
        levels: How many lengths of intervals, each twice the one before; fewer where tables would
            take more than 64 MB.
        dtype: Of table and domain.
        device: Where they lie.

    Returns:
        (l, m, m, 4): premultiplied colour and alpha by the value in front and behind.
    """
    low, high, cells, gap = corner_cells(transfer, *_CELLS)
    parts = min(_MOST_PARTS, max(_FEWEST_PARTS, math.ceil(4 / (gap * cells))))
    middles = (np.arange(cells * parts) + 0.5) / (cells * parts)
    inside = transfer(low + (high - low) * middles).reshape(cells, parts, 4)
    density = -np.log1p(-np.minimum(inside[..., 3], 1 - 1e-16))  # per reference length
    thickness = density.mean(1)
    weight = density / np.maximum(density.sum(1, keepdims=True), 1e-300)
    color = (weight[..., None] * inside[..., :3]).sum(1)
    rows = transfer(low + (high - low) * np.arange(cells + 1) / cells)
    levels = max(1, min(levels, _MOST_BYTES // (16 * len(rows) ** 2)))
    table = np.stack(
        [_pairs(rows, thickness, color, length * 2.0**level) for level in range(levels)]
    )
    seen = rows[:, 3] > 0
    seen[1:] |= thickness > 0
    seen[:-1] |= thickness > 0
    return Table(
        table_lm4=torch.tensor(table, dtype=dtype, device=device),
        domain_2=torch.tensor([low, high], dtype=dtype, device=device),
        opaque_m=torch.tensor(np.cumsum(seen), dtype=torch.int32, device=device),
    )


def _pairs(rows: np.ndarray, thickness: np.ndarray, color: np.ndarray, length: float) -> np.ndarray:
    """(m, m, 4) of intervals of one length."""
    count = len(rows)
    out = np.zeros((count, count, 4))
    same = np.arange(count)
    with np.errstate(divide="ignore"):
        alpha = -np.expm1(length * np.log1p(-rows[:, 3]))
    out[same, same] = np.concatenate((rows[:, :3] * alpha[:, None], alpha[:, None]), 1)
    for apart in range(1, count):
        kept = np.exp(-thickness * (length / apart))  # of one cell on the way
        shown = np.concatenate((color, np.ones((len(color), 1))), 1) * (1 - kept)[:, None]
        low = np.arange(count - apart)
        for turned in (False, True):
            step = -1 if turned else 1
            kept_w = sliding_window_view(kept, apart)[:, ::step]
            shown_w = sliding_window_view(shown, apart, axis=0)[:, :, ::step]  # (w, 4, apart)
            clear = np.ones_like(kept_w)
            np.cumprod(kept_w[:, :-1], axis=1, out=clear[:, 1:])
            found = np.matmul(shown_w, clear[:, :, None])[:, :, 0]
            out[(low + apart, low) if turned else (low, low + apart)] = found
    return out
