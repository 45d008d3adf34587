"""Cellular noise: distances to points that are scattered one a cell.

Source: Worley, "A cellular texture basis function", SIGGRAPH 1996. Here each cell has one point,
    not a Poisson distributed number of them.
"""

from __future__ import annotations

import itertools
from typing import Literal

import torch
from torch import Tensor

from ...base import check
from . import lattice
from .lattice import Period, Points

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
    axes = lattice.coordinates("noise.cellular", points)
    every = lattice.periods("noise.cellular", period, len(axes))
    jitter = check.number("noise.cellular", "jitter", jitter, low=0, high=1)
    reach = check.whole("noise.cellular", "reach", reach, low=1, high=2)
    if feature not in FEATURES:
        raise ValueError(f"noise.cellular: feature must be one of {FEATURES}, got {feature!r}")

    def evaluate(*axes: Tensor) -> Tensor:
        first = second = torch.full_like(axes[0], float(reach) ** 2)
        for bits, away in _neighbours(axes, seed, every, reach, jitter):
            square = torch.zeros_like(first)
            for axis, low in enumerate(away):
                stray = ((bits >> (2 + 10 * axis)) & 1023).to(low.dtype)
                distance = stray * (jitter / 1023) + low
                square = square + distance * distance
            second = torch.minimum(second, torch.maximum(first, square))
            first = torch.minimum(first, square)
        if feature == "F1":
            return first.sqrt()
        return second.sqrt() if feature == "F2" else second.sqrt() - first.sqrt()

    return lattice.in_chunks(evaluate, axes)


def _neighbours(
    axes: tuple[Tensor, ...],
    seed: int,
    period: tuple[int | None, ...],
    reach: int,
    jitter: float,
) -> list[tuple[Tensor, list[Tensor]]]:
    """Returns for each cell in reach its int32 hashes, and along each axis how far the least place
    of its point is from where we are.
    """
    steps, hashes, lows = range(-reach, reach + 1), [], []
    for axis, (place, every) in enumerate(zip(axes, period, strict=True)):
        floor = place.detach().floor()
        own, least = floor.to(torch.int32), 0.5 * (1 - jitter) - (place - floor)
        ends = [lattice.wrapped(own + step, every) for step in steps]
        hashes.append([lattice.scramble(end, seed, axis) for end in ends])
        lows.append([least + step for step in steps])
    found = []
    for row in itertools.product(range(len(steps)), repeat=len(axes) - 1):  # z, y
        part = hashes[-1][row[0]]
        for axis, at in zip(range(len(axes) - 2, 0, -1), row[1:], strict=True):
            part = lattice.join(part, hashes[axis][at])
        for at in range(len(steps)):
            where = (at, *reversed(row))
            away = [low[step] for low, step in zip(lows, where, strict=True)]
            found.append((lattice.join(part, hashes[0][at]), away))
    return found
