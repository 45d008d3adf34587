"""`SplineSum`: sums of octaves in which levels inherit exactly, and no octave is evaluated twice.

Gradient noise inherited from a parent's brick is interpolated, and so only approximate
(`levels.py`). Splines are inherited exactly: a quadratic B-spline over the voxels of a level is
also one over the voxels of the next finer level, whose coefficients are the old ones, interpolated
linearly at the centres of the new voxels (Chaikin: 3/4 of the nearer, 1/4 of the other, along each
axis). So an octave is a spline whose coefficients are random numbers, one for each voxel of the
first level that can represent it, and voxels hold the sum of all coefficients so far:

    sum of a level = sum of the level above, interpolated + gain^octave * random numbers

A voxel's sum depends neither on its brick nor on how the level above was computed: it is bit for
bit that of a direct summation, and bricks agree where they meet. With finer levels the coefficients
converge to the spline itself; a level's sum lacks only what finer octaves add.

Sources: Chaikin, "An algorithm for high speed curve generation", 1974; Lane, Riesenfeld, "A
    theoretical development for the computer generation and display of piecewise polynomial
    surfaces", PAMI 1980 (splines by subdivision); Fournier, Fussell, Carpenter, "Computer rendering
    of stochastic models", CACM 1982 (detail added level by level).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...base import check
from ...ops.reference import noise as twin
from .fractal import EvaluationCounter, Octave, octaves_of

_TOLERANCE = 1e-6  # relative, of the side of a level's voxels to that of an octave's cells


class SplineSum(EvaluationCounter):
    """A sum of octaves in bricks of any level, in float32: each octave is added in the level whose
    voxels are as wide as its cells. Levels halve their voxels (N = 2).

    Attributes:
        octaves: All of them.
        evaluations: Random numbers that were made so far.
        plain_evaluations: Random numbers that the same bricks would have needed without parents.
    """

    def __init__(
        self, *, frequency: float = 1.0, octaves: int = 12, gain: float = 0.5, seed: int = 0
    ) -> None:
        """Sets the octaves.

        Args:
            frequency: Cells of the first octave per world unit; each next one has twice as many.
            octaves: How many, 1 to 64.
            gain: Ratio of an octave's amplitude to that of the one before.
            seed: Of the first octave; each has its own.

        Raises:
            ValueError: A number is out of its range.
        """
        self.octaves = octaves_of("noise.SplineSum", octaves, 2.0, gain, seed, frequency)

    def held(self, side: float) -> list[Octave]:
        """Returns the octaves that voxels of a side, in world units, can represent."""
        return [octave for octave in self.octaves if side * octave.frequency <= 1 + _TOLERANCE]

    def bricks(
        self,
        axes: Sequence[Tensor],
        side: float,
        parents: Tensor | None = None,
        child: Tensor | None = None,
        *,
        border: int = 1,
        branching: int = 2,
    ) -> tuple[Tensor, Tensor]:
        """Returns the sum in k bricks of a level, (k, z, y, x) float32, twice: children inherit the
        sum itself. Arguments are those of `OctaveSum.bricks`; coordinates are relative to a common
        corner of the grids of all levels, such as the low corner of the box.

        Raises:
            ValueError: No octave's cells are as wide as the level's voxels, or N is not 2.
        """
        context = "noise.SplineSum"
        check.branching_two(context, branching, "sums of splines")
        check.number(context, "side", side, low=0, open_low=True)
        steps = math.log2(side * self.octaves[0].frequency)
        if abs(steps - round(steps)) > _TOLERANCE:
            raise ValueError(
                f"{context}: voxels must be 2^n times as wide as the first octave's cells, "
                f"{1 / self.octaves[0].frequency:g}, got {side:g}"
            )
        low = [(axis[:, 0] / side).floor().to(torch.int64) for axis in axes]
        size = axes[0].shape[1]
        if parents is None or child is None:
            values = self._sum_from_coarsest(low, size, side)
        else:
            inner = size - 2 * border
            parent_low = [(start + border) // inner // 2 * inner - border for start in low]
            values = self._add_octave(_refine(parents, parent_low, low, size), low, side)
        self._count(plain_evaluations=len(values) * self._random_count(size, side))
        return values, values

    def _sum_from_coarsest(self, low: Sequence[Tensor], size: int, side: float) -> Tensor:
        """Returns the sum in k cubes of voxels, from the coarsest octave on, without parents."""
        if not self.held(2 * side):
            shape = (len(low[0]), size, size, size)
            zeros = torch.zeros(shape, dtype=torch.float32, device=low[0].device)
            return self._add_octave(zeros, low, side)
        parent_low = [(coordinate - 1) // 2 for coordinate in low]
        coarse = self._sum_from_coarsest(parent_low, size // 2 + 2, 2 * side)
        return self._add_octave(_refine(coarse, parent_low, low, size), low, side)

    def _add_octave(self, values: Tensor, low: Sequence[Tensor], side: float) -> Tensor:
        """Returns the values plus the octave that begins at this level, if there is one."""
        for octave in self.octaves:
            if abs(side * octave.frequency - 1) < 2 * _TOLERANCE:
                offsets = torch.arange(values.shape[1], device=values.device)
                x, y, z = (
                    twin.scramble((axis_low[:, None] + offsets).to(torch.int32), salt)
                    for axis_low, salt in zip(low, twin.salts(octave.seed), strict=True)
                )
                bits = twin.join(x[:, None], y[:, :, None])
                bits = twin.join(bits[:, None], z[:, :, None, None])
                values = values + bits.to(values.dtype) * (octave.amplitude * 2.0**-31)
                self._count(evaluations=values.numel())
        return values

    def _random_count(self, size: int, side: float) -> int:
        """Returns how many random numbers a brick needs without parents."""
        count = 0
        while octaves := self.held(side):
            count += size**3 if abs(side * octaves[-1].frequency - 1) < 2 * _TOLERANCE else 0
            size, side = size // 2 + 2, 2 * side
        return count


def _refine(
    values: Tensor, parent_low: Sequence[Tensor], low: Sequence[Tensor], size: int
) -> Tensor:
    """Returns (k, z, y, x): size^3 voxels from corner `low` (x, y, z: (k,) each), interpolated from
    those of the level above, from corner `parent_low`. The operations for a voxel do not depend on
    its brick.
    """
    offsets = torch.arange(size, device=values.device)
    for axis in range(3):
        voxel, dim = low[axis][:, None] + offsets, 3 - axis
        parent_voxel = voxel // 2 - parent_low[axis][:, None]
        shape = [1, 1, 1]
        shape[dim - 1] = size
        expanded_shape = [*values.shape]
        expanded_shape[dim] = size
        parts = [
            values.gather(dim, index.view(-1, *shape).expand(expanded_shape))
            for index in (parent_voxel, parent_voxel + 2 * (voxel % 2) - 1)
        ]
        values = 0.75 * parts[0] + 0.25 * parts[1]
    return values
