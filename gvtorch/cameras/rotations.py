"""Rotation matrices from and to unit quaternions w, x, y, z, in float64.

Source: Shepperd, "Quaternion from rotation matrix", 1978.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def quaternion_of(rotation: Tensor) -> list[float]:
    """Returns w >= 0, x, y, z of a rotation (3, 3)."""
    r = rotation
    trace = float(r.trace())
    squares = [1 + trace, *(1 + 2 * float(r[n, n]) - trace for n in range(3))]  # 4 w^2, 4 x^2, ...
    largest = max(range(4), key=squares.__getitem__)
    skew = [float(r[2, 1] - r[1, 2]), float(r[0, 2] - r[2, 0]), float(r[1, 0] - r[0, 1])]
    if largest == 0:
        q = [squares[0], *skew]
    else:
        i = largest - 1
        q = [skew[i], *(float(r[i, n] + r[n, i]) for n in range(3))]
        q[largest] = squares[largest]
    length = sum(n * n for n in q) ** 0.5 * (-1 if q[0] < 0 else 1)
    return [n / length for n in q]


def rotation_of(quaternion: Sequence[float]) -> Tensor:
    """Returns the rotation (3, 3) of w, x, y, z of any length but 0."""
    length = sum(n * n for n in quaternion) ** 0.5
    w, x, y, z = (n / length for n in quaternion)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64)
