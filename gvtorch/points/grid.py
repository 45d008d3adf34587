"""`PointGrid`: the voxels that points are laid into."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..base import check
from ..base.boxes import extent_in
from .points import Points


@dataclass(frozen=True)
class PointGrid:
    """A box of finest voxels; voxels of level l are N^l of them wide."""

    extent: tuple[int, int, int]  # finest voxels along x, y, z
    low: tuple[float, float, float]  # world corners
    high: tuple[float, float, float]
    branching: int = 2

    @classmethod
    def around(
        cls,
        where: str,
        blocks: Iterable[Points],
        extent: int | Sequence[int],
        box: Sequence[Sequence[float]] | None,
        branching: int,
    ) -> PointGrid:
        """Returns the grid of a user's extent and box, around all points if there is none."""
        check.whole(where, "branching", branching, low=2, high=16)
        low, high = check.box(where, _bounds(blocks) if box is None else box)
        extent = extent_in(where, extent, (low, high))
        if len(extent) != 3:
            raise ValueError(f"{where}: extent must be a number or (x, y, z), got {extent!r}")
        x, y, z = (check.whole(where, "extent", size, low=1, high=2**40) for size in extent)
        return cls((x, y, z), low, high, branching)

    @property
    def spacing_3(self) -> np.ndarray:
        """(3,) world size of a finest voxel."""
        return (np.array(self.high) - np.array(self.low)) / self.extent

    @property
    def origin(self) -> tuple[float, float, float]:
        """World place of the centre of voxel 0."""
        x, y, z = (np.array(self.low) + 0.5 * self.spacing_3).tolist()
        return (x, y, z)

    @property
    def levels(self) -> int:
        """Levels up to that of one voxel."""
        side, levels = max(self.extent), 1
        while self.branching ** (levels - 1) < side:
            levels += 1
        return levels

    def voxel(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the finest voxels (k, 3) that positions (k, 3) are in, and which are inside."""
        with np.errstate(over="ignore", invalid="ignore"):
            place = np.floor((positions.astype(np.float64) - self.low) / self.spacing_3)
            inside = ((place >= 0) & (place < self.extent)).all(1)
        return place[inside].astype(np.int64), inside

    def edges(self, voxel_k3: np.ndarray, count: int, level: int) -> list[np.ndarray]:
        """Returns for each axis (k, count + 1) world places of the edges of `count` voxels of a
        level, from voxels on; none is outside of the box.
        """
        size = self.spacing_3 * self.branching**level
        at = np.arange(count + 1)
        return [
            np.clip(
                self.low[axis] + (voxel_k3[:, axis, None] + at) * size[axis],
                self.low[axis],
                self.high[axis],
            )
            for axis in range(3)
        ]

    def own_level(self, radius: np.ndarray) -> np.ndarray:
        """Returns the first level whose voxels are as wide as points with radii (k,) reach: there a
        point is in at most 3^3 of them.
        """
        own = np.zeros(len(radius), np.int64)
        for level in range(self.levels - 1):
            own += radius > self.spacing_3.min() * self.branching**level
        return own


@np.errstate(over="ignore")  # a box that is not finite is refused
def _bounds(blocks: Iterable[Points]) -> list[list[float]]:
    """A box around all points, as far as they reach, and a little more."""
    low, high = np.full(3, math.inf), np.full(3, -math.inf)
    for block in blocks:
        reach = 0.0 if block.radius is None else block.radius[:, None]
        low = np.minimum(low, (block.positions - reach).min(0))
        high = np.maximum(high, (block.positions + reach).max(0))
    middle = 0.5 * (low + high)
    longest = float((high - low).max())
    smallest = max(1e-6 * longest, 1e-9 * float(np.abs(middle).max())) or 1.0
    half = 0.5 * np.maximum(high - low, smallest) * 1.001
    return [(middle - half).tolist(), (middle + half).tolist()]
