"""Orbits of escape-time fractals: of points, and of balls of points, for any step. The ops of
`ops/orbits.py` are compiled for two steps, `power` and `fold`. Points are (3, k) here, so that each
coordinate is one row.

Sources: White, Nylander, "The Mandelbulb", 2009 (z^n in spherical coordinates); Lowe, "Mandelbox",
    2010; Hart, Sandin, Kauffman, "Ray tracing deterministic 3-D fractals", SIGGRAPH 1989 (distance
    estimates of escape-time fractals).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from .exact import clamp, divide, larger, log_exact, smaller, sqrt_exact

#: A step of an orbit: z (3, k) to f(z) (3, k), and the factor (k,) by which it stretches distances
#: between neighbours.
Step = Callable[[Tensor], tuple[Tensor, Tensor]]
#: For balls around z (3, k) of radii (k,): a bound of the factor by which a step stretches
#: distances in the ball, and the smallest and largest of the factors of `Step`, (k,) each.
Ranges = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]

INSIDE = 1.0  # minus this, in units of the points, is the distance inside: no estimate is known
FAR = 1e3  # a ball of orbits that grows to this radius is given up: nothing is known of it


def spherical_power(z: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """`Step` to z^n in spherical coordinates: |z|^n, both angles times n. Uses two complex powers:
    of z + i rho, whose angle is that from the axis, and of the direction (x + i y) / rho, where rho
    is the distance from the axis.
    """
    x, y, up = z.unbind(0)
    away = sqrt_exact(_at_least(x * x + y * y, 1e-30))
    radius = sqrt_exact(away * away + up * up)
    cosine, sine = _turned(x / away, y / away, n)
    height, width = _turned(up, away, n)
    raised = torch.stack((width * cosine, width * sine, height))
    return raised, n * _product(radius, n - 1)


def power_ranges(z: Tensor, reach: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """`Ranges` of `spherical_power`. It stretches by n r^(n-1) along radius and meridian, and along
    the circle of latitude by |sin(n angle) / sin(angle)|, at most n, times as much. The angle from
    the axis changes by at most asin(reach / r) in a ball; asin(s) <= s + (pi / 2 - 1) s^3, since
    all terms of its series are positive and those beyond the first add up to pi / 2 - 1 at s = 1.
    """
    x, y, up = z.unbind(0)
    away, radius = sqrt_exact(x * x + y * y), sqrt_exact(_squared(z))
    least, most = _at_least(radius - reach, 0.0), radius + reach
    safe = _at_least(radius, 1e-30)
    part = smaller(reach / safe, torch.ones_like(reach))
    change = part + (math.pi / 2 - 1) * (part * part * part)
    _, sine = _turned(up / safe, away / safe, n)
    turned = larger(sine, -sine) + n * change
    own = _at_least(_at_least(away - reach, 0.0) / _at_least(most, 1e-30), 1 / n)
    turn = clamp(smaller(turned, torch.ones_like(turned)) / own, 1.0, n)
    low, high = n * _product(least, n - 1), n * _product(most, n - 1)
    return high * turn, low, high


def fold(z: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """The Mandelbox's `Step`: folds coordinates beyond 1 back, inverts short vectors in balls of
    radius 1/2 and 1, and scales.
    """
    folded = 2 * clamp(z, -1.0, 1.0) - z
    grown = divide(1.0, clamp(_squared(folded), 0.25, 1.0), z[0])
    return folded * (grown * scale), grown * abs(scale)


def fold_ranges(z: Tensor, reach: Tensor, scale: float) -> tuple[Tensor, Tensor, Tensor]:
    """`Ranges` of `fold`: the fold stretches nothing, inversion at most by 1 / r^2."""
    radius = sqrt_exact(_squared(2 * clamp(z, -1.0, 1.0) - z))
    near, far = clamp(radius - reach, 0.5, 1.0), clamp(radius + reach, 0.5, 1.0)
    high = divide(abs(scale), near * near, reach)
    return high, divide(abs(scale), far * far, reach), high


class Way(NamedTuple):
    """The iteration of orbits, and when they end."""

    step: Step
    ranges: Ranges
    constant_3: Tensor | None  # added in each step; None: the point that the orbit started at
    bailout_1: Tensor  # orbits escape beyond this distance from the origin
    iterations: int  # largest number of steps
    logarithmic: bool  # |z| grows as a power; else by a factor


def orbits(point_p3: Tensor, way: Way) -> Tensor:
    """Iterates points until they escape; see `ops.orbits`."""
    z, bailout = point_p3.mT, way.bailout_1
    constant, add = (z, 1.0) if way.constant_3 is None else (way.constant_3[:, None], 0.0)
    radius = sqrt_exact(_squared(z))
    apart, near, plane = torch.ones_like(radius), radius, _from_planes(z)
    for _ in range(way.iterations):
        alive = radius <= bailout
        after, grown = way.step(z)
        z = torch.where(alive, after + constant, z)
        apart = torch.where(alive, grown * apart + add, apart)
        radius = sqrt_exact(_squared(z))
        near, plane = smaller(near, radius), smaller(plane, _from_planes(z))
    value = torch.where(radius <= bailout, -INSIDE, _estimate(radius, apart, way))
    return torch.stack((value, near, plane))


def orbit_bounds(center_k3: Tensor, reach_k: Tensor, way: Way) -> Tensor:
    """Iterates the centres of balls, and for each a radius within which the orbits of all points of
    the ball are; see `ops.orbit_bounds`.
    """
    z, reach, bailout = center_k3.mT, reach_k, way.bailout_1
    constant, push, add = z, reach, 1.0
    if way.constant_3 is not None:
        constant, push, add = way.constant_3[:, None], torch.zeros_like(reach), 0.0
    low_apart = high_apart = torch.ones_like(reach)
    low, high = torch.full_like(reach, math.inf), torch.full_like(reach, -math.inf)
    inside = torch.ones_like(reach, dtype=torch.bool)  # some point may not have escaped yet
    lost = ~inside
    for turn in range(way.iterations + 1):
        radius = sqrt_exact(_squared(z))
        least, most = _at_least(radius - reach, 0.0), radius + reach
        escaping = inside & (most > bailout)
        first = _estimate(larger(least, bailout), high_apart, way)
        last = _estimate(most, low_apart, way)
        low = torch.where(escaping, smaller(low, first), low)
        high = torch.where(escaping, larger(high, last), high)
        lost = lost | (inside & ~(reach < FAR))
        inside = inside & (least <= bailout) & ~lost
        if turn == way.iterations:
            break
        stretch, slow, fast = way.ranges(z, reach)
        after, _ = way.step(z)
        z = torch.where(inside, after + constant, z)
        reach = torch.where(inside, stretch * reach + push, reach)
        low_apart = torch.where(inside, slow * low_apart + add, low_apart)
        high_apart = torch.where(inside, fast * high_apart + add, high_apart)
    deep = torch.full_like(low, -INSIDE)
    low = torch.where(inside, smaller(low, deep), low)
    high = torch.where(inside, larger(high, deep), high)
    return torch.stack((torch.where(lost, deep, low), torch.where(lost, math.inf, high)))


def _estimate(radius: Tensor, apart: Tensor, way: Way) -> Tensor:
    """Returns distance estimates of orbits at `radius`; `apart`: their neighbours' stretch."""
    return 0.5 * radius * log_exact(radius) / apart if way.logarithmic else radius / apart


def _squared(z: Tensor) -> Tensor:
    """Returns (k,) squared lengths of (3, k) vectors."""
    x, y, up = z.unbind(0)
    return x * x + y * y + up * up


def _from_planes(z: Tensor) -> Tensor:
    """Returns (k,) distances from the nearest of the three coordinate planes."""
    x, y, up = larger(z, -z).unbind(0)
    return smaller(smaller(x, y), up)


def _at_least(value: Tensor, low: float) -> Tensor:
    return larger(value, torch.full_like(value, low))


def _product(value: Tensor, n: int) -> Tensor:
    """Returns value^n, n >= 1, by squares and products."""
    if n == 1:
        return value
    root = _product(value, n // 2)
    return root * root * value if n % 2 else root * root


def _turned(real: Tensor, imaginary: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Returns the n-th power of complex numbers, by squares and products."""
    if n == 1:
        return real, imaginary
    a, b = _turned(real, imaginary, n // 2)
    a, b = (a - b) * (a + b), 2 * a * b
    return (a * real - b * imaginary, a * imaginary + b * real) if n % 2 else (a, b)
