"""`Hierarchy`: boxes around triangles, level by level, as the op `voxelize` goes down them.

Source: Karras, "Maximizing parallelism in the construction of BVHs", HPG 2012 (triangles sorted
    along a Morton curve; here every box holds eight of the level below, so no pointers are needed).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..ops.voxelize import ARITY

_BITS = 20  # of a Morton code, along an axis


class Hierarchy:
    """The boxes of triangles, sorted so that neighbours in memory are neighbours in space.

    Attributes:
        order: (f,) int64 the triangle at each place of the lowest level.
        box: (n, 6) float64 low and high corners of all boxes, those of the triangles first.
        first: Of each level, lowest first, its first box; and their number. Box i of a level holds
            boxes 8 i to 8 i + 7 of the level below.
    """

    def __init__(self, corner_f33: Tensor) -> None:
        """Sorts (f, 3, 3) float64 triangles and makes all levels."""
        low, high = corner_f33.amin(1), corner_f33.amax(1)
        self.order = _morton(0.5 * (low + high)).argsort(stable=True)
        levels = [torch.cat((low[self.order], high[self.order]), 1)]
        while len(levels[-1]) > ARITY:
            below = padded(levels[-1]).view(-1, ARITY, 6)
            levels.append(torch.cat((below[..., :3].amin(1), below[..., 3:].amax(1)), 1))
        self.box = torch.cat(levels)
        self.first = [0]
        for level in levels:
            self.first.append(self.first[-1] + len(level))


def padded(level: Tensor) -> Tensor:
    """Returns (n, ...) with its last row repeated, until boxes of the level above are full."""
    return torch.cat((level, level[-1:].expand(-len(level) % ARITY, *level.shape[1:])))


def _morton(place_f3: Tensor) -> Tensor:
    """Returns (f,) int64 codes: places that are close have close codes."""
    low, high = place_f3.amin(0), place_f3.amax(0)
    size = (high - low).max().clamp(min=torch.finfo(place_f3.dtype).tiny)
    cell = ((place_f3 - low) / size * (2**_BITS - 1)).to(torch.int64)
    code = torch.zeros_like(cell[:, 0])
    for bit in range(_BITS):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return code
