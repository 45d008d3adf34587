"""Label volumes for tests, and the labels that they encode."""

from __future__ import annotations

import numpy as np
import torch

import gvtorch as gv

WIDE = 2**24 + 1  # float32 rounds it to 2^24
SPACING = (1.0, 0.8, 1.3)


def numbers(*shape: int, count: int = 5, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, count, shape)


def cells(shape, count: int, seed: int = 0, dtype=np.int64) -> np.ndarray:
    """Returns for each voxel the index of the nearest of `count` points: connected labels."""
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    positions = np.random.default_rng(seed).random((count, 3)) * shape
    return ((grid[..., None, :] - positions) ** 2).sum(-1).argmin(-1).astype(dtype)


def kept(volume: gv.Volume) -> np.ndarray:
    """Returns the labels that a volume encodes."""
    data = volume.data[..., 0].to(torch.int64)
    return (data if volume.label_values is None else volume.label_values[data]).numpy()
