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
    axis_distance = sqrt_exact(_at_least(x * x + y * y, 1e-30))
    radius = sqrt_exact(axis_distance * axis_distance + up * up)
    cosine, sine = _complex_power(x / axis_distance, y / axis_distance, n)
    height, width = _complex_power(up, axis_distance, n)
    raised = torch.stack((width * cosine, width * sine, height))
    return raised, n * _product(radius, n - 1)


def power_ranges(z: Tensor, reach: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """`Ranges` of `spherical_power`. It stretches by n r^(n-1) along radius and meridian, and along
    the circle of latitude by |sin(n angle) / sin(angle)|, at most n, times as much. The angle from
    the axis changes by at most asin(reach / r) in a ball; asin(s) <= s + (pi / 2 - 1) s^3, since
    all terms of its series are positive and those beyond the first add up to pi / 2 - 1 at s = 1.
    """
    x, y, up = z.unbind(0)
    axis_distance, radius = sqrt_exact(x * x + y * y), sqrt_exact(_squared(z))
    inner_radius, outer_radius = _at_least(radius - reach, 0.0), radius + reach
    safe_radius = _at_least(radius, 1e-30)
    ratio = smaller(reach / safe_radius, torch.ones_like(reach))
    angle_change = ratio + (math.pi / 2 - 1) * (ratio * ratio * ratio)
    _, sine = _complex_power(up / safe_radius, axis_distance / safe_radius, n)
    sine_bound = larger(sine, -sine) + n * angle_change
    least_ratio = _at_least(axis_distance - reach, 0.0) / _at_least(outer_radius, 1e-30)
    least_sine = _at_least(least_ratio, 1 / n)
    around = clamp(smaller(sine_bound, torch.ones_like(sine_bound)) / least_sine, 1.0, n)
    low, high = n * _product(inner_radius, n - 1), n * _product(outer_radius, n - 1)
    return high * around, low, high


def fold(z: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """The Mandelbox's `Step`: folds coordinates beyond 1 back, inverts short vectors in balls of
    radius 1/2 and 1, and scales.
    """
    folded = 2 * clamp(z, -1.0, 1.0) - z
    inverted = divide(1.0, clamp(_squared(folded), 0.25, 1.0), z[0])
    return folded * (inverted * scale), inverted * abs(scale)


def fold_ranges(z: Tensor, reach: Tensor, scale: float) -> tuple[Tensor, Tensor, Tensor]:
    """`Ranges` of `fold`: the fold stretches nothing, inversion at most by 1 / r^2."""
    radius = sqrt_exact(_squared(2 * clamp(z, -1.0, 1.0) - z))
    near, far = clamp(radius - reach, 0.5, 1.0), clamp(radius + reach, 0.5, 1.0)
    high = divide(abs(scale), near * near, reach)
    return high, divide(abs(scale), far * far, reach), high


class TwinOrbit(NamedTuple):
    """The iteration of orbits, and when they end."""

    step: Step
    ranges: Ranges
    constant_3: Tensor | None  # added in each step; None: the point that the orbit started at
    bailout_1: Tensor  # orbits escape beyond this distance from the origin
    iterations: int  # largest number of steps
    logarithmic: bool  # |z| grows as a power; else by a factor


def orbits(point_p3: Tensor, orbit: TwinOrbit) -> Tensor:
    """Iterates points until they escape; see `ops.orbits`."""
    z, bailout = point_p3.mT, orbit.bailout_1
    constant, added_separation = (
        (z, 1.0) if orbit.constant_3 is None else (orbit.constant_3[:, None], 0.0)
    )
    radius = sqrt_exact(_squared(z))
    separation, least_radius, plane = torch.ones_like(radius), radius, _from_planes(z)
    for _ in range(orbit.iterations):
        alive = radius <= bailout
        stepped, factor = orbit.step(z)
        z = torch.where(alive, stepped + constant, z)
        separation = torch.where(alive, factor * separation + added_separation, separation)
        radius = sqrt_exact(_squared(z))
        least_radius, plane = smaller(least_radius, radius), smaller(plane, _from_planes(z))
    value = torch.where(radius <= bailout, -INSIDE, _estimate(radius, separation, orbit))
    return torch.stack((value, least_radius, plane))


def orbit_bounds(center_k3: Tensor, reach_k: Tensor, orbit: TwinOrbit) -> Tensor:
    """Iterates centres of balls, and radii that hold the orbits of all their points; see
    `ops.orbit_bounds`.
    """
    z, reach, bailout = center_k3.mT, reach_k, orbit.bailout_1
    constant, added_reach, added_separation = z, reach, 1.0
    if orbit.constant_3 is not None:
        constant, added_reach = orbit.constant_3[:, None], torch.zeros_like(reach)
        added_separation = 0.0
    low_separation = high_separation = torch.ones_like(reach)
    low, high = torch.full_like(reach, math.inf), torch.full_like(reach, -math.inf)
    inside = torch.ones_like(reach, dtype=torch.bool)  # some point may not have escaped yet
    diverged = ~inside
    for iteration in range(orbit.iterations + 1):
        radius = sqrt_exact(_squared(z))
        inner_radius, outer_radius = _at_least(radius - reach, 0.0), radius + reach
        escaping = inside & (outer_radius > bailout)
        low_estimate = _estimate(larger(inner_radius, bailout), high_separation, orbit)
        high_estimate = _estimate(outer_radius, low_separation, orbit)
        low = torch.where(escaping, smaller(low, low_estimate), low)
        high = torch.where(escaping, larger(high, high_estimate), high)
        diverged = diverged | (inside & ~(reach < FAR))
        inside = inside & (inner_radius <= bailout) & ~diverged
        if iteration == orbit.iterations:
            break
        stretch, low_factor, high_factor = orbit.ranges(z, reach)
        stepped, _ = orbit.step(z)
        z = torch.where(inside, stepped + constant, z)
        reach = torch.where(inside, stretch * reach + added_reach, reach)
        low_next = low_factor * low_separation + added_separation
        high_next = high_factor * high_separation + added_separation
        low_separation = torch.where(inside, low_next, low_separation)
        high_separation = torch.where(inside, high_next, high_separation)
    deep = torch.full_like(low, -INSIDE)
    low = torch.where(inside, smaller(low, deep), low)
    high = torch.where(inside, larger(high, deep), high)
    return torch.stack((torch.where(diverged, deep, low), torch.where(diverged, math.inf, high)))


def _estimate(radius: Tensor, separation: Tensor, orbit: TwinOrbit) -> Tensor:
    """Returns distance estimates of orbits at `radius`; `separation`: their neighbours' stretch."""
    length = 0.5 * radius * log_exact(radius) if orbit.logarithmic else radius
    return length / separation


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


def _complex_power(real: Tensor, imaginary: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Returns the n-th power of complex numbers, by squares and products."""
    if n == 1:
        return real, imaginary
    a, b = _complex_power(real, imaginary, n // 2)
    a, b = (a - b) * (a + b), 2 * a * b
    return (a * real - b * imaginary, a * imaginary + b * real) if n % 2 else (a, b)
