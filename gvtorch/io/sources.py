"""`Source`: a volume file read region by region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Source:
    path: str
    shape: tuple[int, ...]
    dtype: str
    offset: int = 0

    def read(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        data = np.load(self.path, mmap_mode="r")
        out = np.array(data[tuple(slice(a, b) for a, b in zip(low, high))])
        return out if out.ndim == 4 else out[..., None]
