"""Points whose voxels are known in closed form."""

from __future__ import annotations

import math

import numpy as np


def share_below(edges: np.ndarray, center: float | np.ndarray, reach: float) -> np.ndarray:
    """Returns the share of a point's kernel below positions on an axis. The kernel is the density
    of a sum of four uniform numbers (Irwin, Hall), `reach` to either side; a step if that is 0.
    """
    if reach == 0:
        return (edges > center).astype(float)
    x = np.clip(2 * (edges - center) / reach + 2, 0, 4)
    terms = [(-1) ** k * math.comb(4, k) * np.maximum(x - k, 0) ** 4 for k in range(5)]
    return np.sum(terms, 0) / 24
