"""Noises of one frequency: gradient, value, simplex and cellular noise, their arguments, and their
bounds. Each is a function of points alone, the same on every device and in every run.

Bounds of gradient and simplex noise: corners' gradients are chosen independently, so the largest
value at a point is the sum over corners of weight * largest ramp, and the steepest slope along u
is that of gradient . (weight * u + (derivative of weight along u) * offset), each with the best of
the twelve gradients. The largest sums over all points and directions were searched numerically
(40,000 starts, 60 rounds of narrowing, float64), and are rounded up. Gradient noise is steepest at
a cell's centre along an axis, where the sum is 11/4 in the plane and 15/4 in space. All
combinations of gradients occur, so the sums are reached, and no smaller bounds hold. The steepest
value noise rises by 2 from one side of a cell to the other, in the middle 15/8 as fast as a line.

Sources: Perlin, "Improving noise", SIGGRAPH 2002; Perlin, "Noise hardware", SIGGRAPH course notes
    2001, and Gustavson, "Simplex noise demystified", 2005 (simplex noise); Gustavson, McEwan,
    "Tiling simplex noise and flow noise in two and three dimensions", JCGT 2022 (which periods
    simplices have); Worley, "A cellular texture basis function", SIGGRAPH 1996 (cellular noise;
    here each cell has one point, not a Poisson distributed number of them).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from ...base import check
from ...ops.noise import noise

#: Points (..., n), or n coordinates that broadcast to one shape.
Points = Tensor | Sequence[Tensor]
#: An integer period for each axis, or one for all; None: not periodic.
Period = int | Sequence[int] | None
Feature = Literal["F1", "F2", "F2-F1"]
FEATURES: tuple[Feature, ...] = ("F1", "F2", "F2-F1")
#: The mean of gradient noise over a cube is about exp(-MEAN_DECAY * (side / cell)^2) times the
#: noise at its centre: fitted, within 0.03 for cubes of up to 1.5 cells.
MEAN_DECAY = 0.82
#: Mean square of gradient noise in 3D.
VARIANCE = 0.0728

#: A noise of one frequency: a function from points, seed and period to values.
Basis = Callable[..., Tensor]


def perlin(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Gradient noise: 0 on the integer lattice, twice continuously differentiable, mean 0.

    Args:
        points: (..., 2) or (..., 3) float32 or float64, or 2 or 3 tensors x, y (, z) that
            broadcast. Coordinates beyond 2^29 count as 0; float32 has no fractions beyond 2^23.
        seed: Each seed gives another noise.
        period: Number of cells after which the noise repeats, one for all axes or one for each.

    Returns:
        (...) of the same dtype, within `bounds(perlin, n)`. Points of two coordinates have another
        lattice, so 2D noise is not the plane z = 0 of 3D noise of the same seed.

    Raises:
        ValueError: Points or period are invalid.
    """
    return at_points("noise.perlin", "perlin", points, seed, period)


def value(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Value noise: random values from -1 to 1 on the integer lattice, interpolated as `perlin`
    interpolates ramps. Arguments, result and errors are those of `perlin`.
    """
    return at_points("noise.value", "value", points, seed, period)


def simplex(points: Points, *, seed: int = 0, period: Period = None) -> Tensor:
    """Simplex noise: ramps at the corners of triangles or tetrahedra, each fading out over its own
    neighbourhood; it has fewer corners than `perlin`, and no visible alignment with axes.

    Args:
        points, seed: As in `perlin`.
        period: As in `perlin`, but only in 3D, and multiples of 3: three steps along an axis map
            the simplices onto themselves. In 2D no number of steps does.

    Returns:
        (...) of the same dtype, within -1 to 1.

    Raises:
        ValueError: Points or period are invalid.
    """
    position = as_points("noise.simplex", points)
    if position.shape[-1] == 2 and period is not None:
        raise ValueError("noise.simplex: in the plane there is no period; perlin has one")
    return at_points("noise.simplex", "simplex", position, seed, period)


def cellular(
    points: Points,
    *,
    feature: Feature = "F1",
    jitter: float = 1.0,
    reach: int = 1,
    seed: int = 0,
    period: Period = None,
) -> Tensor:
    """Cellular noise.

    Args:
        points, seed, period: As in `perlin`.
        feature: "F1", the distance to the nearest point; "F2", to the second nearest; "F2-F1",
            which is 0 on the walls between the neighbourhoods of points.
        jitter: 0 puts each point in the middle of its cell, 1 anywhere in the cell.
        reach: How many cells to each side of a point's own are searched. All points nearer than
            `reach` are found, and larger distances are replaced by `reach`, which makes the result
            continuous. With 2 the nearest and the second nearest are always the true ones, and 5^n
            cells are searched instead of 3^n.

    Returns:
        (...) of the points' dtype, in cells.

    Raises:
        ValueError: An argument is invalid.
    """
    context = "noise.cellular"
    check.number(context, "jitter", jitter, low=0, high=1)
    check.integer(context, "reach", reach, low=1, high=2)
    check.one_of(context, "feature", feature, FEATURES)
    return at_points(context, feature, points, seed, period, jitter=jitter, reach=reach)


def as_points(context: str, points: Points) -> Tensor:
    """Returns points as one tensor (..., n) of floats, n = 2 or 3.

    Raises:
        ValueError: They have another shape or dtype.
    """
    axes = (points,) if isinstance(points, Tensor) or not isinstance(points, Sequence) else points
    n = len(axes)
    if isinstance(points, Tensor):
        n = points.shape[-1] if points.dim() else 0
    if not 2 <= n <= 3 or not all(isinstance(coordinate, Tensor) for coordinate in axes):
        got = check.describe(points) if isinstance(points, Tensor) else f"{n} items"
        raise ValueError(f"{context}: points must be (..., n) or n tensors, n = 2 or 3, got {got}")
    kinds = {coordinate.dtype for coordinate in axes}
    if len(kinds) > 1 or not kinds <= {torch.float32, torch.float64}:
        got = ", ".join(sorted(str(kind).removeprefix("torch.") for kind in kinds))
        raise ValueError(f"{context}: points must be float32 or float64, got {got}")
    return points if isinstance(points, Tensor) else torch.stack(torch.broadcast_tensors(*axes), -1)


def periods(context: str, period: Period, n: int, multiple: int = 1) -> tuple[int, ...]:
    """Returns the period along each of n axes; 0: none.

    Raises:
        ValueError: It is not one or n positive multiples of `multiple`, at most 2^28.
    """
    if period is None:
        return (0,) * n
    axis_periods = tuple(period) if isinstance(period, Sequence) else (period,) * n
    if len(axis_periods) != n:
        raise ValueError(f"{context}: period must be an int or {n} of them, got {period!r}")
    for axis_period in axis_periods:
        check.integer(context, "period", axis_period, low=1, high=2**28)
        if axis_period % multiple:
            raise ValueError(f"{context}: period must be a multiple of {multiple}, got {period!r}")
    return axis_periods


def at_points(
    context: str, kind: str, points: Points, seed: int, period: Period, **options: Any
) -> Tensor:
    """Returns noise (...) of a kind at points (..., n); `options` are those of `ops.noise`."""
    position = as_points(context, points)
    n = position.shape[-1]
    axis_periods = periods(context, period, n, multiple=3 if kind == "simplex" else 1)
    values = noise(position.reshape(-1, n), kind, seed=seed, period=axis_periods, **options)
    return values.view(position.shape[:-1])


class Bounds(NamedTuple):
    """Bounds of a function of position: its smallest and largest value, and the most that it
    changes over a distance of 1 (its Lipschitz constant).
    """

    low: float
    high: float
    slope: float


_BOUNDS = {
    (perlin, 2): Bounds(-1.0, 1.0, 2.75),
    (perlin, 3): Bounds(-1.03636, 1.03636, 3.75),
    (value, 2): Bounds(-1.0, 1.0, 3.75),
    (value, 3): Bounds(-1.0, 1.0, 3.75),
    (simplex, 2): Bounds(-1.0, 1.0, 7.35),
    (simplex, 3): Bounds(-1.0, 1.0, 6.97),
}


def bounds(basis: Basis, n: int = 3) -> Bounds:
    """Returns the bounds of a noise in n = 2 or 3 dimensions: of `perlin`, `value`, `simplex`,
    `cellular`, or one of them with arguments by `functools.partial`. Rounded values may exceed them
    by 2^-20.

    Raises:
        ValueError: The noise is another function, or n another number: bounds are unknown.
    """
    options: dict[str, Any] = {}
    while isinstance(basis, partial):
        options, basis = basis.keywords | options, basis.func
    if basis is cellular and n in (2, 3):
        slope = 2.0 if options.get("feature", "F1") == "F2-F1" else 1.0
        return Bounds(0.0, float(options.get("reach", 1)), slope)
    if (basis, n) not in _BOUNDS:
        name = getattr(basis, "__name__", repr(basis))
        raise ValueError(f"noise.bounds: nothing is known of {name!r} in {n} dimensions")
    return _BOUNDS[basis, n]
