"""Clips of every kind, and which positions they keep, computed directly from the definition."""

from __future__ import annotations

import math

import numpy as np
import torch

import gvtorch as gv


def turned(degrees: float, size: float, centre: tuple[float, float, float]) -> torch.Tensor:
    """Returns the matrix of a cube that is turned about z and then about x."""
    a = math.radians(degrees)
    about_z = torch.tensor(
        [[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]]
    )
    about_x = torch.tensor(
        [[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]]
    )
    axes = size * (about_x @ about_z).double()
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = axes
    matrix[:3, 3] = torch.tensor(centre, dtype=torch.float64) - axes.sum(1) / 2
    return matrix


def inside(box, places: np.ndarray) -> np.ndarray:
    """Returns which (k, 3) positions lie in a box, directly from its definition."""
    if len(box) == 2:
        low, high = np.array(box)
        return ((places >= low) & (places <= high)).all(1)
    own = (places - box[:3, 3].numpy()) @ np.linalg.inv(box[:3, :3].numpy()).T
    return ((own >= 0) & (own <= 1)).all(1)


CLIPS = {
    "plane": gv.Clip(planes=[(-1, 0, 0, 30.0)]),
    "box": gv.Clip(boxes=[((9.0, 1.0, 8.0), (33.0, 14.0, 50.0))]),
    "turned": gv.Clip(boxes=[turned(35, 24.0, (27, 8, 29))]),
    "cut": gv.Clip(without=[((17.0, 2.0, 3.0), (30.0, 16.0, 60.0))]),
    "union": gv.Clip(boxes=[((0, -9, 0), (18, 30, 60)), ((30, -9, 0), (60, 30, 60))]),
    "all": gv.Clip(
        planes=[(0, 1, 0, -1.0)],
        boxes=[((0, -9, 0), (26, 30, 60)), turned(20, 22.0, (40, 8, 30))],
        without=[((9, 0, 0), (14, 11, 60)), ((35, 4, 20), (44, 10, 40))],
    ),
}


def shown(clip: gv.Clip, places: np.ndarray) -> np.ndarray:
    """Returns which (k, 3) positions are kept."""
    seen = np.ones(len(places), dtype=bool)
    for *normal, offset in clip.planes:
        seen &= places @ np.array(normal) + offset >= 0
    if len(clip.boxes):
        seen &= np.any([inside(box, places) for box in clip.boxes], axis=0)
    for box in clip.without:
        seen &= ~inside(box, places)
    return seen
