"""Noises of one frequency: gradient, value and simplex noise. Each is a function of points alone,
the same on every device and in every run.

Source: Perlin, "Improving noise", SIGGRAPH 2002; Perlin, "Noise hardware", SIGGRAPH course notes
    2001, and Gustavson, "Simplex noise demystified", 2005 (simplex noise); Gustavson, McEwan,
    "Tiling simplex noise and flow noise in two and three dimensions", JCGT 2022 (which periods
    simplices have).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from . import lattice
from .lattice import Period, Points

#: Simplex noise times this lies in -1 to 1, by dimensions; see `bounds`.
_SIMPLEX_SCALE = {2: 70.148, 3: 76.880}
_SKEW = {2: (math.sqrt(3) - 1) / 2, 3: 1 / 3}
_UNSKEW = {2: (3 - math.sqrt(3)) / 6, 3: 1 / 6}


def perlin(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Gradient noise: 0 on the integer lattice, twice continuously differentiable, mean 0.

    Args:
        points: (..., 2) or (..., 3) float32 or float64, or 2 or 3 tensors x, y (, z) that
            broadcast. Beyond 2^31 nothing is defined; float32 has no fractions beyond 2^23.
        seed: Another noise for each.
        period: After how many cells the noise repeats, one for all axes or one for each.

    Returns:
        (...) of the same dtype, within `bounds(perlin, n)`. The plane z = 0 of space is no noise of
        the plane's seed: points of two coordinates have lattices of their own.

    Raises:
        ValueError: Points or period are not that.
    """
    axes = lattice.coordinates("noise.perlin", points)
    every = lattice.periods("noise.perlin", period, len(axes))

    def evaluate(*axes: Tensor) -> Tensor:
        found = lattice.cells(axes, seed, every)
        ends = [(cell.offset, cell.offset - 1) for cell in found]
        ramps = []
        for number, bits in enumerate(lattice.corners(found)):
            away = [end[number >> axis & 1] for axis, end in enumerate(ends)]
            ramps.append(lattice.ramp(bits, away))
        return lattice.blend(ramps, [lattice.fade(cell.offset) for cell in found])

    return lattice.in_chunks(evaluate, axes)


def value(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Value noise: random values from -1 to 1 on the integer lattice, interpolated as `perlin`
    interpolates ramps. Arguments, result and errors are those of `perlin`.
    """
    axes = lattice.coordinates("noise.value", points)
    every = lattice.periods("noise.value", period, len(axes))

    def evaluate(*axes: Tensor) -> Tensor:
        found = lattice.cells(axes, seed, every)
        values = [bits.to(axes[0].dtype) * 2.0**-31 for bits in lattice.corners(found)]
        return lattice.blend(values, [lattice.fade(cell.offset) for cell in found])

    return lattice.in_chunks(evaluate, axes)


def simplex(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Simplex noise: ramps at the corners of triangles or tetrahedra, each fading out over its own
    neighbourhood; fewer corners than `perlin` has, and no axes that the eye finds.

    Ramps fade by (1/2 - r^2)^4, which is 0 before the next corner's cell begins. The 0.6 that is
    often used in space is not, and such noise jumps.

    Args:
        points, seed: As in `perlin`.
        period: As in `perlin`, in space alone, and multiples of 3: it takes three steps along an
            axis to bring the simplices onto themselves. In the plane no number of steps does.

    Returns:
        (...) of the same dtype, within -1 to 1.

    Raises:
        ValueError: Points or period are not that.
    """
    axes = lattice.coordinates("noise.simplex", points)
    n = len(axes)
    if n == 2 and period is not None:
        raise ValueError("noise.simplex: in the plane there is no period; perlin has one")
    every = lattice.periods("noise.simplex", period, n, multiple=3)

    def evaluate(*axes: Tensor) -> Tensor:
        skew = sum(axes[1:], axes[0]).detach() * _SKEW[n]
        floors = [(one.detach() + skew).floor() for one in axes]
        back = sum(floors[1:], floors[0]) * _UNSKEW[n]
        offsets = [one - (floor - back) for one, floor in zip(axes, floors, strict=True)]
        places = [floor.to(torch.int32) for floor in floors]
        rank, total = _ranks(offsets), torch.zeros_like(axes[0])
        for corner in range(n + 1):
            steps = [(one + corner >= n).to(torch.int32) for one in rank]  # the `corner` largest
            away = [
                offset - step + corner * _UNSKEW[n]
                for offset, step in zip(offsets, steps, strict=True)
            ]
            square = away[0] * away[0]
            for one in away[1:]:
                square = square + one * one
            near = (0.5 - square).clamp_min(0)
            bits = _simplex_hash([a + b for a, b in zip(places, steps, strict=True)], seed, every)
            total = total + near * near * (near * near) * lattice.ramp(bits, away)
        return total * _SIMPLEX_SCALE[n]

    return lattice.in_chunks(evaluate, axes)


def _ranks(offsets: list[Tensor]) -> list[Tensor]:
    """Returns int32 how many other offsets are smaller; of equal ones the first ranks higher."""
    ranks = [torch.zeros_like(offsets[0], dtype=torch.int32) for _ in offsets]
    for first in range(len(offsets)):
        for second in range(first + 1, len(offsets)):
            above = (offsets[first] >= offsets[second]).to(torch.int32)
            ranks[first] = ranks[first] + above
            ranks[second] = ranks[second] + (1 - above)
    return ranks


def _simplex_hash(places: list[Tensor], seed: int, period: tuple[int | None, ...]) -> Tensor:
    """Returns int32 hashes of corners by their int32 skewed coordinates.

    In space, 6 times the coordinates without skew are whole numbers, and a period wraps those.
    """
    if len(places) == 3:
        total = sum(places[1:], places[0])
        places = [
            lattice.wrapped(6 * place - total, None if every is None else 6 * every)
            for place, every in zip(places, period, strict=True)
        ]
    bits = lattice.scramble(places[0], seed, 0)
    for axis, place in enumerate(places[1:], 1):
        bits = lattice.join(bits, lattice.scramble(place, seed, axis))
    return bits
