"""Noises of one frequency: gradient, value and simplex noise. Each is a function of points alone,
the same on every device and in every run.

Source: Perlin, "Improving noise", SIGGRAPH 2002; Perlin, "Noise hardware", SIGGRAPH course notes
    2001, and Gustavson, "Simplex noise demystified", 2005 (simplex noise); Gustavson, McEwan,
    "Tiling simplex noise and flow noise in two and three dimensions", JCGT 2022 (which periods
    simplices have).
"""

from __future__ import annotations

from torch import Tensor

from .lattice import Period, Points, as_points, at_points


def perlin(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Gradient noise: 0 on the integer lattice, twice continuously differentiable, mean 0.

    Args:
        points: (..., 2) or (..., 3) float32 or float64, or 2 or 3 tensors x, y (, z) that
            broadcast. Coordinates beyond 2^29 count as 0; float32 has no fractions beyond 2^23.
        seed: Another noise for each.
        period: After how many cells the noise repeats, one for all axes or one for each.

    Returns:
        (...) of the same dtype, within `bounds(perlin, n)`. The plane z = 0 of space is no noise of
        the plane's seed: points of two coordinates have lattices of their own.

    Raises:
        ValueError: Points or period are not that.
    """
    return at_points("noise.perlin", "perlin", points, seed, period)


def value(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Value noise: random values from -1 to 1 on the integer lattice, interpolated as `perlin`
    interpolates ramps. Arguments, result and errors are those of `perlin`.
    """
    return at_points("noise.value", "value", points, seed, period)


def simplex(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Simplex noise: ramps at the corners of triangles or tetrahedra, each fading out over its own
    neighbourhood; fewer corners than `perlin` has, and no axes that the eye finds.

    Args:
        points, seed: As in `perlin`.
        period: As in `perlin`, in space alone, and multiples of 3: it takes three steps along an
            axis to bring the simplices onto themselves. In the plane no number of steps does.

    Returns:
        (...) of the same dtype, within -1 to 1.

    Raises:
        ValueError: Points or period are not that.
    """
    place = as_points("noise.simplex", points)
    if place.shape[-1] == 2 and period is not None:
        raise ValueError("noise.simplex: in the plane there is no period; perlin has one")
    return at_points("noise.simplex", "simplex", place, seed, period)
