"""Cellular noise: distances to points that are scattered one a cell.

Source: Worley, "A cellular texture basis function", SIGGRAPH 1996. Here each cell has one point,
    not a Poisson distributed number of them.
"""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from ...base import check
from .lattice import Period, Points, at_points

Feature = Literal["F1", "F2", "F2-F1"]
FEATURES: tuple[Feature, ...] = ("F1", "F2", "F2-F1")


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
        jitter: How far points stray in their cells: 0 leaves them in the middle, 1 lets them stray
            all over the cell.
        reach: How many cells around its own are searched. All points nearer than `reach` are found,
            so distances are taken as `reach` where they are more. That makes them continuous. With
            2 the nearest and the second nearest are the true ones, and 5^n cells are looked at
            instead of 3^n.

    Returns:
        (...) of the points' dtype, in cells.

    Raises:
        ValueError: An argument is not that.
    """
    where = "noise.cellular"
    check.number(where, "jitter", jitter, low=0, high=1)
    check.whole(where, "reach", reach, low=1, high=2)
    if feature not in FEATURES:
        raise ValueError(f"{where}: feature must be one of {FEATURES}, got {feature!r}")
    return at_points(where, feature, points, seed, period, jitter=jitter, reach=reach)
