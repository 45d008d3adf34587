"""`PointGrid`: the grid of voxels for points; `Codes`: numbers of voxels along a curve that visits
all voxels of a node before it leaves the node; and the kernel that distributes a point that is
wider than a voxel over several.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..base import check
from ..base.check import extent_in
from ..base.constants import MAX_BRANCHING
from ..ops.splat import shares
from .points import Points

_MAX_CODES = 2**62  # most codes, which are int64


class Codes:
    """Codes that interleave the base-N digits of x, y and z (Morton order for N = 2). So the voxels
    of a node, at any level, have consecutive codes, and a voxel's code divided by N^3 is that of
    the voxel one level up.

    Source: Morton, "A computer oriented geodetic data base", 1966.
    """

    def __init__(self, branching: int, side: int) -> None:
        """Covers a cube of at least `side`^3 voxels; ValueError if that is too many for int64."""
        self.branching, self.digits = branching, 1
        while branching**self.digits < side:
            self.digits += 1
        if branching ** (3 * self.digits) > _MAX_CODES:
            raise ValueError(
                f"points: an extent of {side} has more voxels than a 64-bit number tells apart; "
                "take a smaller one"
            )
        self._positions: dict[int, np.ndarray] = {}  # by side; a producer uses one or two
        self._table_size = branching ** -(-self.digits // 2)
        index = np.arange(self._table_size)
        self._spread = np.zeros(self._table_size, np.int64)
        for digit in range(-(-self.digits // 2)):
            self._spread += index // branching**digit % branching * branching ** (3 * digit)

    def of(self, voxel_k3: np.ndarray) -> np.ndarray:
        """Returns (k,) int64 codes of voxels (k, 3) x, y, z of any level, inside the cube."""
        code = np.zeros(len(voxel_k3), np.int64)
        for axis in (2, 1, 0):
            high, low = np.divmod(voxel_k3[:, axis], self._table_size)
            code *= self.branching
            code += self._spread[low]
            code += self._spread[high] * self._table_size**3
        return code

    def positions(self, side: int) -> np.ndarray:
        """Returns (side^3, 3) x, y, z of the codes 0, 1, ...; `side` is a power of N."""
        if side not in self._positions:
            voxels = np.indices((side,) * 3).reshape(3, -1).T
            positions = np.empty_like(voxels)
            positions[self.of(voxels)] = voxels
            self._positions[side] = positions
        return self._positions[side]


@dataclass(frozen=True)
class PointGrid:
    """A box of finest voxels; a voxel of level l is N^l finest voxels wide."""

    extent: tuple[int, int, int]  # finest voxels along x, y, z
    low: tuple[float, float, float]  # world corners
    high: tuple[float, float, float]
    branching: int = 2

    @classmethod
    def around(
        cls,
        context: str,
        blocks: Iterable[Points],
        extent: int | Sequence[int],
        box: Sequence[Sequence[float]] | None,
        branching: int,
    ) -> PointGrid:
        """Returns the grid of a user's extent and box; without a box, one around all points."""
        check.integer(context, "branching", branching, low=2, high=MAX_BRANCHING)
        low, high = check.box(context, _bounds(blocks) if box is None else box)
        return cls(extent_in(context, extent, (low, high)), low, high, branching)

    @property
    def spacing_3(self) -> np.ndarray:
        """(3,) world size of a finest voxel."""
        return (np.array(self.high) - np.array(self.low)) / self.extent

    @property
    def origin(self) -> tuple[float, float, float]:
        """World position of the centre of voxel 0."""
        x, y, z = (np.array(self.low) + 0.5 * self.spacing_3).tolist()
        return (x, y, z)

    @property
    def levels(self) -> int:
        """Number of levels; the last one is one voxel."""
        side, levels = max(self.extent), 1
        while self.branching ** (levels - 1) < side:
            levels += 1
        return levels

    def voxel(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns (m, 3) the finest voxels of those positions (k, 3) in the box, (k,) which are."""
        with np.errstate(over="ignore", invalid="ignore"):
            voxel = np.floor((positions.astype(np.float64) - self.low) / self.spacing_3)
            inside = ((voxel >= 0) & (voxel < self.extent)).all(1)
        return voxel[inside].astype(np.int64), inside

    def edges(self, voxel_k3: np.ndarray, count: int, level: int) -> list[np.ndarray]:
        """Returns for each axis (k, count + 1) world coordinates of the edges of `count` voxels of
        a level, beginning at voxels (k, 3), clamped to the box.
        """
        size = self.spacing_3 * self.branching**level
        index = np.arange(count + 1)
        return [
            np.clip(low + (voxel[:, None] + index) * step, low, high)
            for voxel, step, low, high in zip(voxel_k3.T, size, self.low, self.high, strict=True)
        ]

    def level_of_radius(self, radius: np.ndarray) -> np.ndarray:
        """Returns (k,) the finest level whose voxels are at least as wide as the radii (k,) of
        points, else the coarsest: there, a point overlaps at most 3^3 voxels.
        """
        levels = np.zeros(len(radius), np.int64)
        for level in range(self.levels - 1):
            levels += radius > self.spacing_3.min() * self.branching**level
        return levels


@np.errstate(over="ignore")  # a box that is not finite is an error later
def _bounds(blocks: Iterable[Points]) -> list[list[float]]:
    """Returns a box around all points with their radii, and a small margin."""
    low, high = np.full(3, math.inf), np.full(3, -math.inf)
    for block in blocks:
        radius = 0.0 if block.radius is None else block.radius[:, None]
        low = np.minimum(low, (block.positions - radius).min(0))
        high = np.maximum(high, (block.positions + radius).max(0))
    middle = 0.5 * (low + high)
    longest = float((high - low).max())
    smallest = max(1e-6 * longest, 1e-9 * float(np.abs(middle).max())) or 1.0
    half_size = 0.5 * np.maximum(high - low, smallest) * 1.001
    return [(middle - half_size).tolist(), (middle + half_size).tolist()]


def point_shares(edge: np.ndarray, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Returns (k, m) float64 the share of each point, with centre (k,) and radius (k,), in each of
    its intervals, which lie between increasing edges (k, m + 1). See `shares`.
    """
    arrays = (torch.from_numpy(np.asarray(array, np.float64)) for array in (edge, center, radius))
    return shares(*arrays).numpy()


def peak(radius: np.ndarray, size_3: np.ndarray) -> np.ndarray:
    """Returns (k,) upper bounds of the share of points with radii (k,) in any box of a size."""
    safe = np.maximum(radius, np.finfo(np.float64).tiny)
    fractions = np.minimum(1, 4 / 3 * size_3 / safe[:, None])
    return fractions[:, 0] * fractions[:, 1] * fractions[:, 2]
