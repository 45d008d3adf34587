"""Clips of every kind, and which positions they keep, computed directly from the definition."""

from __future__ import annotations

import math

import numpy as np
import torch

import gvtorch as gv


def turned_box(degrees: float, size: float, centre: tuple[float, float, float]) -> torch.Tensor:
    """Returns the matrix of a cube that is turned about z and then about x."""
    angle = math.radians(degrees)
    about_z = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    )
    about_x = torch.tensor(
        [[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]]
    )
    axes = size * (about_x @ about_z).double()
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = axes
    matrix[:3, 3] = torch.tensor(centre, dtype=torch.float64) - axes.sum(1) / 2
    return matrix


def inside(box, positions: np.ndarray) -> np.ndarray:
    """Returns which (k, 3) positions lie in a box, directly from its definition."""
    if len(box) == 2:
        low, high = np.array(box)
        return ((positions >= low) & (positions <= high)).all(1)
    local = (positions - box[:3, 3].numpy()) @ np.linalg.inv(box[:3, :3].numpy()).T
    return ((local >= 0) & (local <= 1)).all(1)


CLIPS = {
    "plane": gv.Clip(planes=[(-1, 0, 0, 30.0)]),
    "box": gv.Clip(boxes=[((9.0, 1.0, 8.0), (33.0, 14.0, 50.0))]),
    "turned": gv.Clip(boxes=[turned_box(35, 24.0, (27, 8, 29))]),
    "cut": gv.Clip(without=[((17.0, 2.0, 3.0), (30.0, 16.0, 60.0))]),
    "union": gv.Clip(boxes=[((0, -9, 0), (18, 30, 60)), ((30, -9, 0), (60, 30, 60))]),
    "all": gv.Clip(
        planes=[(0, 1, 0, -1.0)],
        boxes=[((0, -9, 0), (26, 30, 60)), turned_box(20, 22.0, (40, 8, 30))],
        without=[((9, 0, 0), (14, 11, 60)), ((35, 4, 20), (44, 10, 40))],
    ),
}


def is_kept(clip: gv.Clip, positions: np.ndarray) -> np.ndarray:
    """Returns which (k, 3) positions are kept."""
    kept = np.ones(len(positions), dtype=bool)
    for *normal, offset in clip.planes:
        kept &= positions @ np.array(normal) + offset >= 0
    if len(clip.boxes):
        kept &= np.any([inside(box, positions) for box in clip.boxes], axis=0)
    for box in clip.without:
        kept &= ~inside(box, positions)
    return kept
