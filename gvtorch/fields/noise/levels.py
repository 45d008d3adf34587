"""Octaves by level: the sum of the coarse octaves in a brick is interpolated from its parent's
brick, so that a level evaluates fine octaves only.

The centres of a child's voxels are never those of its parent's, so inherited values must be
interpolated. Gradient noise has two continuous derivatives, so the error falls with the third power
of (voxel / cell), whatever the order of interpolation. Errors for one octave of amplitude 1, by the
parent's voxels per cell, with 6 points along each axis, over 600 bricks:

    voxels a cell   2     4     8       16      32      64
    largest         1.3   0.09  5.3e-3  6.5e-4  6.0e-5  7.2e-6
    mean square     0.13  0.01  5.7e-4  5.4e-5  4.4e-6  4.6e-7

An octave inherited from the first level that represents it, at 2 voxels a cell, would be lost.
So each is evaluated until its cells are `settled` voxels wide, and inherited from then on: at 16,
with about the error of storing float16, to which each further level adds an eighth. A level then
evaluates 4 octaves, however many coarser ones there are.

Source: Lagrange's interpolation; the idea is from the original engine's example of noise that is
    inherited from the parent's brick.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...base import check
from .basis import as_points, perlin
from .fractal import EvaluationCounter, Octave, octaves_of

#: Voxels along each axis that a value is interpolated from.
POINTS = 6


def inherit(
    parents: Tensor, child: Tensor, *, border: int = 1, branching: int = 2, points: int = POINTS
) -> Tensor:
    """Interpolates values at the voxels of children, borders included, from their parents' bricks.

    Args:
        parents: (k, z, y, x) float32 or float64 cubic bricks with their borders.
        child: (k, 3) int64 index of each child in its parent, x y z, 0 to branching - 1.
        border: Voxels around a brick, 1 at least.
        branching: N.
        points: Voxels that a value is interpolated from along each axis.

    Returns:
        (k, z, y, x) of the same dtype: exact, except for rounding, if values are a polynomial of
        degree `points` - 1 along each axis; see above for noise.

    Raises:
        ValueError: Shapes do not fit, there is no border, or there are fewer voxels than `points`.
    """
    context = "noise.inherit"
    if parents.dim() != 4 or len(set(parents.shape[1:])) > 1 or not parents.is_floating_point():
        got = check.describe(parents)
        raise ValueError(f"{context}: parents must be (k, s, s, s) floats, got {got}")
    if child.shape != (len(parents), 3):
        shape = f"({len(parents)}, 3)"
        raise ValueError(f"{context}: child must be {shape} int64, got {check.describe(child)}")
    side = parents.shape[1]
    check.integer(context, "border", border, low=1, high=(side - 1) // 2)
    check.integer(context, "points", points, low=2, high=side)
    weights = _weights(side, border, branching, points, parents.dtype, parents.device)
    x, y, z = (weights[child[:, axis]] for axis in range(3))  # (k, s, s) each
    values = parents.flatten(1, 2) @ x.mT  # along x
    values = values.view(-1, side, side, side).transpose(2, 3).flatten(1, 2) @ y.mT
    values = values.view(-1, side, side, side).permute(0, 3, 2, 1).flatten(1, 2) @ z.mT  # (y, x, z)
    return values.view(-1, side, side, side).permute(0, 3, 1, 2)


class OctaveSum(EvaluationCounter):
    """The sum of `fbm` in bricks of any level, of the octaves that its voxels represent.

    Attributes:
        octaves: All of them.
        evaluations: Evaluations, octaves times voxels, so far.
        plain_evaluations: Evaluations that a plain sum would have needed.
    """

    def __init__(
        self,
        *,
        frequency: float = 1.0,
        octaves: int = 12,
        lacunarity: float = 2.0,
        gain: float = 0.5,
        seed: int = 0,
        hold: float = 2.0,
        settled: float = 16.0,
    ) -> None:
        """Sets the octaves.

        Args:
            frequency: Cells of the first octave per world unit.
            octaves, lacunarity, gain, seed: As in `fbm`.
            hold: Least width of an octave's cells, in voxels, for a level to include it.
            settled: Least width of its cells, in voxels, for children to inherit it; inf: never.

        Raises:
            ValueError: A number is out of its range.
        """
        context = "noise.OctaveSum"
        self.hold = check.number(context, "hold", hold, low=0, open_low=True)
        if settled != math.inf and check.number(context, "settled", settled) < self.hold:
            raise ValueError(f"{context}: settled must be >= hold, {hold:g}, got {settled!r}")
        self.settled = settled
        self.octaves = octaves_of(context, octaves, lacunarity, gain, seed, frequency)

    def held(self, side: float) -> list[Octave]:
        """Returns the octaves that voxels of a side, in world units, can represent."""
        return self._octaves_wider(side, self.hold)

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
        """Returns the sum in k bricks of a level, and the part of it that their children may
        inherit, (k, z, y, x) each.

        Args:
            axes: x, y, z: (k, s) float32 or float64 world coordinates of voxel centres, with
                borders.
            side: Of the level's voxels, world units.
            parents: (k, z, y, x) the second result for the parents' bricks; None: all octaves are
                evaluated here.
            child: (k, 3) index of each brick among its parent's children, see `inherit`.
            border, branching: As in `inherit`.
        """
        inherited = self._octaves_wider(side * branching, self.settled)
        settled_octaves = self._octaves_wider(side, self.settled)
        octaves = self.held(side)
        size = axes[0].shape[0] * axes[0].shape[1] * axes[1].shape[1] * axes[2].shape[1]
        self._count(plain_evaluations=size * len(octaves))
        if parents is None or child is None or not inherited:
            settled = self._evaluate(axes, settled_octaves)
        else:
            settled = inherit(parents, child, border=border, branching=branching)
            settled = settled + self._evaluate(axes, _without(settled_octaves, inherited))
        return settled + self._evaluate(axes, _without(octaves, settled_octaves)), settled

    def _octaves_wider(self, side: float, voxels: float) -> list[Octave]:
        """Returns the octaves whose cells are at least `voxels` voxels of a side wide."""
        return [octave for octave in self.octaves if side * octave.frequency * voxels <= 1 + 1e-9]

    def _evaluate(self, axes: Sequence[Tensor], octaves: Sequence[Octave]) -> Tensor:
        """Returns the sum of octaves, (k, z, y, x); zeros if there are none."""
        x, y, z = axes
        total = x.new_zeros((len(x), z.shape[1], y.shape[1], x.shape[1]))
        axes = (x[:, None, None, :], y[:, None, :, None], z[:, :, None, None])
        positions = as_points("noise.OctaveSum", axes)
        for octave in octaves:
            total += octave.amplitude * perlin(positions * octave.frequency, seed=octave.seed)
            self._count(evaluations=total.numel())
        return total


def _without(octaves: Sequence[Octave], others: Sequence[Octave]) -> list[Octave]:
    return [octave for octave in octaves if octave not in others]


@functools.cache
def _weights(
    side: int, border: int, branching: int, points: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Returns (N, s, s): by child and its voxel along an axis, the weights of parent voxels."""
    size = side - 2 * border
    children = []
    for child in range(branching):
        rows = []
        for voxel in range(-border, size + border):
            position = (child * size + voxel + 0.5) / branching - 0.5 + border  # in parent's voxels
            first = min(max(int(position) - points // 2 + 1, 0), side - points)
            row = [0.0] * side
            used = range(first, first + points)
            for n in used:
                row[n] = math.prod((position - other) / (n - other) for other in used if other != n)
            rows.append(row)
        children.append(rows)
    return torch.tensor(children, dtype=dtype, device=device)
