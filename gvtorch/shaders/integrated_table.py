"""The table of a pre-integrated transfer function: what an interval shows whose values run linearly
from one number in front to another behind.

Source: Engel, Kraus, Ertl, "High-quality pre-integrated volume rendering using hardware-accelerated
pixel shading", Graphics Hardware 2001.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .tables import ColorTable, Sampling, common_cells
from .transfer_function import TransferFunction

_FEWEST_CELLS, _MOST_CELLS = 128, 256  # of a table's side
_FEWEST_PARTS, _MOST_PARTS = 8, 4096  # a cell is integrated in


def integrated_table(transfer: TransferFunction, sampling: Sampling) -> ColorTable:
    """Integrates a transfer function over pairs of values, in float64. A cell of the table is the
    mean of the function over it, so a peak thinner than a cell keeps its opacity.

    Returns:
        (l, m, m, 4): premultiplied colour and alpha by the value in front and behind.
    """
    low, high, places = transfer.corners()
    exact = common_cells(places, _MOST_CELLS)
    cells = exact * math.ceil(_FEWEST_CELLS / exact) if exact else _MOST_CELLS
    gap = float(np.diff(places, append=2.0).min())
    parts = min(_MOST_PARTS, max(_FEWEST_PARTS, math.ceil(4 / (gap * cells))))
    middles = (np.arange(cells * parts) + 0.5) / (cells * parts)
    inside = transfer(low + (high - low) * middles).reshape(cells, parts, 4)
    density = -np.log1p(-np.minimum(inside[..., 3], 1 - 1e-16))  # per reference length
    thickness = density.mean(1)
    weight = density / np.maximum(density.sum(1, keepdims=True), 1e-300)
    color = (weight[..., None] * inside[..., :3]).sum(1)
    rows = transfer(low + (high - low) * np.arange(cells + 1) / cells)
    lengths = transfer.length(sampling) * 2.0 ** np.arange(sampling.fitting(len(rows) ** 2))
    table = np.stack([_pairs(rows, thickness, color, length) for length in lengths])
    seen = rows[:, 3] > 0
    seen[1:] |= thickness > 0
    seen[:-1] |= thickness > 0
    return ColorTable.of(table, (low, high), seen, sampling)


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
