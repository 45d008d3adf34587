"""What is known of noises beforehand: between which values they lie, and how steep they are.

Perlin and simplex noise: each corner's gradient is chosen apart from the others, so the largest
value at a place is the sum over corners of weight * largest ramp, and the steepest slope along u
that of gradient . (weight * u + (derivative of weight along u) * offset), each by the best of the
twelve gradients. The largest sums over all places and directions were searched numerically (40,000
starts, 60 rounds of narrowing, float64), and are rounded up. The steepest gradient noise is at a
cell's centre along an axis, where the sum is 11/4 in the plane and 15/4 in space. Gradients that
reach the sums occur, as all combinations do, so no smaller bounds hold. The steepest value noise
rises by 2 from one side of a cell to the other, and in the middle 15/8 as fast as a line.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from torch import Tensor

from .basis import perlin, simplex, value
from .cellular import cellular

#: The mean of gradient noise over a cube follows the noise in its middle by
#: exp(-LOST * (side / cell)^2): fitted to within 0.03 for cubes of up to 1.5 cells.
LOST = 0.82
#: Mean square of gradient noise in space.
VARIANCE = 0.0728

#: A noise of one frequency: points, seed and period to values.
Basis = Callable[..., Tensor]


class Bounds(NamedTuple):
    """Of a function of place: its least and largest value, and the most that it changes over a
    distance of 1 (its Lipschitz constant).
    """

    low: float
    high: float
    slope: float


_KNOWN = {
    (perlin, 2): Bounds(-1.0, 1.0, 2.75),
    (perlin, 3): Bounds(-1.03636, 1.03636, 3.75),
    (value, 2): Bounds(-1.0, 1.0, 3.75),
    (value, 3): Bounds(-1.0, 1.0, 3.75),
    (simplex, 2): Bounds(-1.0, 1.0, 7.35),
    (simplex, 3): Bounds(-1.0, 1.0, 6.97),
}


def bounds(basis: Basis, n: int = 3) -> Bounds:
    """Returns the bounds of a noise in n = 2 or 3 dimensions: of `perlin`, `value`, `simplex`,
    `cellular`, or one of them with arguments by `functools.partial`. Rounding may pass them by
    2^-20.

    Raises:
        ValueError: Nothing is known of the noise.
    """
    options: dict[str, Any] = {}
    while isinstance(basis, partial):
        options, basis = basis.keywords | options, basis.func
    if basis is cellular:
        steep = 2.0 if options.get("feature", "F1") == "F2-F1" else 1.0
        return Bounds(0.0, float(options.get("reach", 1)), steep)
    if (basis, n) not in _KNOWN:
        name = getattr(basis, "__name__", repr(basis))
        raise ValueError(f"noise.bounds: nothing is known of {name!r} in {n} dimensions")
    return _KNOWN[basis, n]
