"""`Codes`: numbers of voxels along a curve that fills a node before it leaves it, and the kernel by
which a point that is wider than a voxel is shared among several, as arrays.
"""

from __future__ import annotations

import numpy as np
import torch

from ..ops.splat import shares

_MOST = 2**62  # codes of an int64


class Codes:
    """The digits of x, y and z to base N, in turn (Morton's order for N = 2). So the voxels of a
    node, at any level, have codes without a gap: those of its first voxel's code, divided by N^3
    for each level up.

    Source: Morton, "A computer oriented geodetic data base", 1966.
    """

    def __init__(self, branching: int, side: int) -> None:
        """Lays the curve through a cube of at least `side` voxels; ValueError if it is too long."""
        self.branching, self.digits = branching, 1
        while branching**self.digits < side:
            self.digits += 1
        if branching ** (3 * self.digits) > _MOST:
            raise ValueError(
                f"points: an extent of {side} has more voxels than a 64-bit number tells apart; "
                "take a smaller one"
            )
        self._places: dict[int, np.ndarray] = {}  # by side; a producer asks for one or two
        self._low = branching ** -(-self.digits // 2)
        at = np.arange(self._low)
        self._spread = np.zeros(self._low, np.int64)
        for digit in range(-(-self.digits // 2)):
            self._spread += at // branching**digit % branching * branching ** (3 * digit)

    def of(self, voxel_k3: np.ndarray) -> np.ndarray:
        """Returns (k,) int64 codes of voxels x, y, z, inside the cube of any level."""
        code = np.zeros(len(voxel_k3), np.int64)
        for axis in (2, 1, 0):
            high, low = np.divmod(voxel_k3[:, axis], self._low)
            code *= self.branching
            code += self._spread[low]
            code += self._spread[high] * self._low**3
        return code

    def places(self, side: int) -> np.ndarray:
        """Returns (side^3, 3) x, y, z of the codes from 0 on; `side` is a power of N."""
        if side not in self._places:
            at = np.indices((side,) * 3).reshape(3, -1).T
            found = np.empty_like(at)
            found[self.of(at)] = at
            self._places[side] = found
        return self._places[side]


def point_shares(edge: np.ndarray, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Returns what each interval between edges (k, m + 1), rising, holds of points at (k,) that
    reach as far as (k,): (k, m), float64. See `shares`.
    """
    given = (torch.from_numpy(np.asarray(one, np.float64)) for one in (edge, center, radius))
    return shares(*given).numpy()


def peak(radius: np.ndarray, size_3: np.ndarray) -> np.ndarray:
    """Returns (k,) the most that a box of a size holds of points with radii (k,)."""
    safe = np.maximum(radius, np.finfo(np.float64).tiny)
    share = np.minimum(1, 4 / 3 * size_3 / safe[:, None])
    return share[:, 0] * share[:, 1] * share[:, 2]
