"""`place_axes`: lays the voxel axes of medical images along the world's."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


def place_axes(
    path: str, affine: np.ndarray, shape: Sequence[int], component: int | None = None
) -> dict[str, Any]:
    """Permutes and flips voxel axes so that they run along x, y, z; oblique ones stay as they are.

    Args:
        path: For messages.
        affine: (4, 4) from voxel indices to the world.
        shape: Of the array.
        component: Which of its axes counts components, if any.

    Returns:
        The fields axes, flips, spacing and origin of a `VolumeSource`.
    """
    matrix, origin = affine[:3, :3], affine[:3, 3].astype(np.float64)
    lengths = np.linalg.norm(matrix, axis=0)
    if not np.isfinite(affine).all() or (lengths == 0).any():
        raise ValueError(f"{path}: the header's voxel axes are degenerate: {matrix.tolist()}")
    spatial = [axis for axis in range(len(shape)) if axis != component]
    world_axis = np.abs(matrix).argmax(axis=0)  # of each voxel axis
    along = np.abs(matrix[world_axis, [0, 1, 2]]) / lengths
    if sorted(world_axis.tolist()) != [0, 1, 2] or (along < 1 - 1e-4).any():
        warnings.warn(
            f"{Path(path).name}: voxel axes are oblique; the world's axes are taken along them",
            stacklevel=2,
        )
        order, spacing = np.arange(3), lengths
    else:
        order = np.argsort(world_axis)
        spacing = matrix[[0, 1, 2], order]
    letters = ["c"] * len(shape)
    for axis, letter in enumerate("xyz"):
        voxel_axis = spatial[order[axis]]
        letters[voxel_axis] = letter
        if spacing[axis] < 0:
            origin[axis] += spacing[axis] * (shape[voxel_axis] - 1)
    return {
        "axes": "".join(letters),
        "flips": "".join(letter for letter, step in zip("xyz", spacing, strict=True) if step < 0),
        "spacing": tuple(np.abs(spacing).tolist()),
        "origin": tuple(origin.tolist()),
    }
