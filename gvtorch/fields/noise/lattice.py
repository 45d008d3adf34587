"""What all noises take: points, and after how many cells of the integer lattice they repeat."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ...base import check
from ...ops import noise

#: Points (..., n), or n coordinates that broadcast to one shape.
Points = Tensor | Sequence[Tensor]
#: A whole period for each axis, or one for all; None: not periodic.
Period = int | Sequence[int] | None


def as_points(where: str, points: Points) -> Tensor:
    """Returns points (..., n) of 2 or 3 coordinates, floats.

    Raises:
        ValueError: They are not that.
    """
    axes = (points,) if isinstance(points, Tensor) else tuple(points)
    n = len(axes)
    if isinstance(points, Tensor):
        n = points.shape[-1] if points.dim() else 0
    if not 2 <= n <= 3 or not all(isinstance(one, Tensor) for one in axes):
        got = check.describe(points) if isinstance(points, Tensor) else f"{n} items"
        raise ValueError(f"{where}: points must be (..., n) or n tensors, n = 2 or 3, got {got}")
    kinds = {one.dtype for one in axes}
    if len(kinds) > 1 or not kinds <= {torch.float32, torch.float64}:
        got = ", ".join(sorted(str(kind).removeprefix("torch.") for kind in kinds))
        raise ValueError(f"{where}: points must be float32 or float64, got {got}")
    return points if isinstance(points, Tensor) else torch.stack(torch.broadcast_tensors(*axes), -1)


def periods(where: str, period: Period, n: int, multiple: int = 1) -> tuple[int, ...]:
    """Returns the period along each of n axes; 0: none.

    Raises:
        ValueError: One is no positive multiple of `multiple`.
    """
    if period is None:
        return (0,) * n
    each = tuple(period) if isinstance(period, Sequence) else (period,) * n
    if len(each) != n:
        raise ValueError(f"{where}: period must be an int or {n} of them, got {period!r}")
    for one in each:
        check.whole(where, "period", one, low=1, high=2**28)
        if one % multiple:
            raise ValueError(f"{where}: period must be a multiple of {multiple}, got {period!r}")
    return each


def at_points(
    where: str, kind: str, points: Points, seed: int, period: Period, **options: Any
) -> Tensor:
    """Returns (...) the noise of a kind at points (..., n); `options` are those of `ops.noise`."""
    place = as_points(where, points)
    n = place.shape[-1]
    every = periods(where, period, n, multiple=3 if kind == "simplex" else 1)
    found = noise(place.reshape(-1, n), kind, seed=seed, period=every, **options)
    return found.view(place.shape[:-1])
