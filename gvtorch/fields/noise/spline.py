"""`SplineSum`: octaves by level in which nothing is computed twice and nothing is lost.

What a child takes over of gradient noise is interpolated, and so never quite right (`levels.py`).
Splines are: a quadratic B-spline over the voxels of a level is one over the voxels of the next
finer level as well, and its new coefficients are the old ones, interpolated linearly at the centres
of the new voxels (Chaikin: 3/4 of the nearer, 1/4 of the other, along each axis). So an octave is a
spline whose coefficients are random numbers, one a voxel of the first level that can hold it, and
voxels hold the sum of all coefficients so far:

    sum of a level = sum of the level above, interpolated + gain^octave * random numbers

A voxel's sum depends neither on the brick that it is in nor on who computed the level above, in
every bit, so it is also the direct sum's, and bricks agree where they meet. As levels go on, the
numbers in the voxels become the spline itself; a level holds it up to what finer octaves add.

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
from .fractal import Octave, Tally, octaves_of

_APART = 1e-6  # relative, by which a level's voxels may differ from an octave's cells


class SplineSum(Tally):
    """A sum of octaves in bricks of any level: each is added in the level whose voxels are its
    cells, in float32. Levels halve their voxels (N = 2).

    Attributes:
        octaves: All of them.
        made: Random numbers that were made so far.
        wanted: Those that the same bricks would have taken without parents.
    """

    def __init__(
        self, *, frequency: float = 1.0, octaves: int = 12, gain: float = 0.5, seed: int = 0
    ) -> None:
        """Takes the sum.

        Args:
            frequency: Cells of the first octave a world unit; each next one has twice as many.
            octaves: How many, 1 to 64.
            gain: Of an octave's amplitude to the one before.
            seed: Of the first octave; each has its own.

        Raises:
            ValueError: A number is out of its range.
        """
        where = "noise.SplineSum"
        self.octaves = octaves_of(where, octaves, 2.0, gain, seed, frequency)

    def held(self, side: float) -> list[Octave]:
        """Returns the octaves that voxels of a side, in world units, can hold."""
        return [one for one in self.octaves if side * one.frequency <= 1 + _APART]

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
        """Returns the sum in k bricks of a level, twice, (k, z, y, x) float32. Arguments are those
        of `OctaveSum.bricks`; places begin at a corner of the grids of all levels, such as the low
        corner of the box.

        Raises:
            ValueError: No octave's cells are as wide as the level's voxels, or N is not 2.
        """
        where = "noise.SplineSum"
        check.halves(where, branching, "sums of splines")
        steps = math.log2(side * self.octaves[0].frequency)
        if abs(steps - round(steps)) > _APART:
            raise ValueError(
                f"{where}: voxels must be 2^n times as wide as the first octave's cells, "
                f"{1 / self.octaves[0].frequency:g}, got {side:g}"
            )
        low = [(axis[:, 0] / side).floor().to(torch.int64) for axis in axes]
        size = axes[0].shape[1]
        if parents is None or child is None:
            found = self._alone(low, size, side)
        else:
            inner = size - 2 * border
            above = [(one + border) // inner // 2 * inner - border for one in low]
            found = self._added(_finer(parents, above, low, size), low, side)
        self._count(wanted=len(found) * self._numbers(size, side))
        return found, found

    def _alone(self, low: Sequence[Tensor], size: int, side: float) -> Tensor:
        """The sum in k cubes of voxels, from the coarsest octave on."""
        if not self.held(2 * side):
            none = torch.zeros((len(low[0]), size, size, size), device=low[0].device)
            return self._added(none, low, side)
        above = [(one - 1) // 2 for one in low]
        coarse = self._alone(above, size // 2 + 2, 2 * side)
        return self._added(_finer(coarse, above, low, size), low, side)

    def _added(self, values: Tensor, low: Sequence[Tensor], side: float) -> Tensor:
        """Values with the octave of the level, if it has one."""
        for one in self.octaves:
            if abs(side * one.frequency - 1) < 2 * _APART:
                reach = torch.arange(values.shape[1], device=values.device)
                x, y, z = (
                    twin.scramble((at[:, None] + reach).to(torch.int32), salt)
                    for at, salt in zip(low, twin.salts(one.seed), strict=True)
                )
                bits = twin.join(x[:, None], y[:, :, None])
                bits = twin.join(bits[:, None], z[:, :, None, None])
                values = values + bits.to(values.dtype) * (one.amplitude * 2.0**-31)
                self._count(made=values.numel())
        return values

    def _numbers(self, size: int, side: float) -> int:
        """How many random numbers a brick takes without parents."""
        count = 0
        while held := self.held(side):
            count += size**3 if abs(side * held[-1].frequency - 1) < 2 * _APART else 0
            size, side = size // 2 + 2, 2 * side
        return count


def _finer(values: Tensor, above: Sequence[Tensor], low: Sequence[Tensor], size: int) -> Tensor:
    """(k, z, y, x) size^3 voxels from `low` on, x y z (k,) each, out of those of the level above
    from `above` on. The same products and sums for a voxel, wherever it lies.
    """
    reach = torch.arange(size, device=values.device)
    for axis in range(3):
        voxel, dim = low[axis][:, None] + reach, 3 - axis
        near = voxel // 2 - above[axis][:, None]
        shape = [1, 1, 1]
        shape[dim - 1] = size
        wide = [*values.shape]
        wide[dim] = size
        parts = [
            values.gather(dim, place.view(-1, *shape).expand(wide))
            for place in (near, near + 2 * (voxel % 2) - 1)
        ]
        values = 0.75 * parts[0] + 0.25 * parts[1]
    return values
