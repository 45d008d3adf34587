"""Sums of octaves of a noise, and points displaced by noise.

Source: Perlin, "An image synthesizer", SIGGRAPH 1985 (turbulence); Musgrave, in Ebert et al.,
    "Texturing and modeling: a procedural approach", 3rd edition 2003, chapter 16 (fractal sums,
    lacunarity, ridges whose detail gathers on the crests); Quilez, "Domain warping", 2002.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Iterable, Iterator
from typing import NamedTuple, TypedDict, Unpack

import torch
from torch import Tensor

from ...base import check
from .basis import Basis, Bounds, Period, Points, as_points, bounds, periods, perlin

#: Differences between the seeds of a sum's octaves, and between those of a warp's components.
_NEXT_OCTAVE, _NEXT_AXIS = 0x10001, 0x3000007
MOST_SEED = 2**62  # so that the seeds of all octaves fit into 64 bits
_LARGEST_LOG = 700.0  # natural logarithm of the largest amplitude or frequency; float64 ends at 709


class SumSettings(TypedDict, total=False):
    """Settings of a sum of octaves; see `fbm`."""

    octaves: int
    lacunarity: float
    gain: float
    basis: Basis
    seed: int
    period: Period


class Octave(NamedTuple):
    """One octave of a sum."""

    amplitude: float
    frequency: float
    seed: int


class EvaluationCounter:
    """Counts evaluations, in a unit that the subclass defines.

    Nothing is counted while torch compiles: it treats attributes as constants, and would recompile
    a function that changes one at each call.

    Attributes:
        evaluations: Units that were evaluated so far.
        plain_evaluations: Units that were asked for, whether they had to be evaluated or not.
    """

    evaluations = plain_evaluations = 0

    def _count(self, evaluations: int = 0, plain_evaluations: int = 0) -> None:
        if not torch.compiler.is_compiling():
            self.evaluations += evaluations
            self.plain_evaluations += plain_evaluations


def octaves_of(
    context: str, octaves: int, lacunarity: float, gain: float, seed: int, frequency: float = 1.0
) -> list[Octave]:
    """Returns the octaves of a sum: amplitudes 1, gain, gain^2, ..., frequencies `frequency` times
    1, lacunarity, ...

    Raises:
        ValueError: There are none, more than 64, or a number is not positive, or grows too large.
    """
    check.number(context, "frequency", frequency, low=0, open_low=True)
    check.integer(context, "octaves", octaves, low=1, high=64)
    check.number(context, "lacunarity", lacunarity, low=0, open_low=True)
    check.number(context, "gain", gain, low=0, open_low=True)
    check.integer(context, "seed", seed, low=-MOST_SEED, high=MOST_SEED)
    largest = math.log(max(frequency, 1)) + (octaves - 1) * math.log(max(lacunarity, gain))
    if largest > _LARGEST_LOG:
        raise ValueError(
            f"{context}: {octaves} octaves of lacunarity {lacunarity:g} and gain {gain:g} exceed "
            "the largest number"
        )
    return [
        Octave(gain**index, lacunarity**index * frequency, seed + index * _NEXT_OCTAVE)
        for index in range(octaves)
    ]


def fbm(points: Points, **settings: Unpack[SumSettings]) -> Tensor:
    """Fractal sum (fractional Brownian motion): octaves of a noise, each `lacunarity` times as fine
    as the one before and `gain` times as strong.

    Args:
        points: As in `perlin`.
        **settings: octaves: how many, 1 to 64; 6 if left out. lacunarity, 2, and gain, 0.5: ratios
            of an octave's frequency and amplitude to those of the one before. basis: the noise that
            is summed: `perlin`, the default, `value`, `simplex`, `cellular`, or your own function
            of points, `seed` and `period`. seed: of the first octave, 0; each has its own. period:
            of the first octave, in its cells; the lacunarity must then be a whole number.

    Returns:
        (...) of the points' dtype, within `fbm_bounds`.

    Raises:
        ValueError: An argument is invalid.
    """
    context = "noise.fbm"
    layers = _layers(context, points, **settings)
    return _sum(context, (amplitude * noise for amplitude, noise in layers))


def turbulence(points: Points, **settings: Unpack[SumSettings]) -> Tensor:
    """The sum of the absolute values of octaves: it has creases where they pass 0, as in flames and
    marble. Arguments, result and errors are those of `fbm`.
    """
    context = "noise.turbulence"
    layers = _layers(context, points, **settings)
    return _sum(context, (amplitude * noise.abs() for amplitude, noise in layers))


def ridged(points: Points, *, sharpness: float = 2.0, **settings: Unpack[SumSettings]) -> Tensor:
    """Ridges: octaves of (1 - |noise|)^2, each weighted by the one before, so that valleys stay
    smooth and detail gathers on the crests.

    Args:
        points: As in `perlin`.
        sharpness: An octave's weight is the octave before times this, at most 1.
        **settings: As in `fbm`; the noise must be within -1 to 1.

    Returns:
        (...) of the points' dtype, from 0 to the sum of the amplitudes.

    Raises:
        ValueError: An argument is invalid.
    """
    context = "noise.ridged"
    check.number(context, "sharpness", sharpness, low=0)

    def crests() -> Iterator[Tensor]:
        weight: Tensor | None = None
        for amplitude, noise in _layers(context, points, **settings):
            crest = (1 - noise.abs()) * (1 - noise.abs())
            crest = crest if weight is None else crest * weight
            weight = (crest * sharpness).clamp(0, 1)
            yield amplitude * crest

    return _sum(context, crests())


def warp(points: Points, *, amplitude: float = 1.0, **settings: Unpack[SumSettings]) -> Tensor:
    """Domain warp: points displaced by a vector of noise, as arguments of another function.

    Args:
        points: As in `perlin`.
        amplitude: The noises, one for each axis, are multiplied by this.
        **settings: As in `fbm`, but octaves is 1 if left out.

    Returns:
        (..., n) points. A function of slope s, evaluated at these points, has a slope of at most
        s * (1 + amplitude * sqrt(n) * slope of the noise).

    Raises:
        ValueError: An argument is invalid.
    """
    position = as_points("noise.warp", points)
    check.number("noise.warp", "amplitude", amplitude)
    most = MOST_SEED - 3 * _NEXT_AXIS
    seed = check.integer("noise.warp", "seed", settings.get("seed", 0), low=-MOST_SEED, high=most)
    shifts = []
    for axis in range(position.shape[-1]):
        axis_seed = seed + (axis + 1) * _NEXT_AXIS
        axis_settings: SumSettings = {"octaves": 1, **settings, "seed": axis_seed}
        shifts.append(fbm(position, **axis_settings))
    return position + amplitude * torch.stack(shifts, -1)


def fbm_bounds(
    *,
    octaves: int = 6,
    lacunarity: float = 2.0,
    gain: float = 0.5,
    basis: Basis = perlin,
    n: int = 3,
) -> Bounds:
    """Returns the bounds of `fbm` in n dimensions: the sum of its octaves' bounds.

    Raises:
        ValueError: An argument is invalid, or the bounds of the noise are unknown.
    """
    basis_bounds = bounds(basis, n)
    series = octaves_of("noise.fbm_bounds", octaves, lacunarity, gain, 0)
    high = sum(octave.amplitude for octave in series)
    slope = sum(octave.amplitude * octave.frequency for octave in series)
    return Bounds(basis_bounds.low * high, basis_bounds.high * high, basis_bounds.slope * slope)


def _sum(context: str, parts: Iterable[Tensor]) -> Tensor:
    """Adds up octaves, one after another; raises ValueError if the basis returned no tensors."""
    return check.instance(context, "basis", functools.reduce(operator.add, parts), Tensor)


def _layers(
    context: str,
    points: Points,
    *,
    octaves: int = 6,
    lacunarity: float = 2.0,
    gain: float = 0.5,
    basis: Basis = perlin,
    seed: int = 0,
    period: Period = None,
) -> Iterator[tuple[float, Tensor]]:
    """Yields amplitude and noise of each octave."""
    position = as_points(context, points)
    if not callable(basis):
        raise ValueError(f"{context}: basis must be a function such as noise.perlin, got {basis!r}")
    axis_periods = periods(context, period, position.shape[-1])
    series = octaves_of(context, octaves, lacunarity, gain, seed)
    if period is not None and lacunarity != int(lacunarity):
        raise ValueError(f"{context}: with a period lacunarity must be whole, got {lacunarity!r}")
    for octave in series:
        octave_period = None
        if period is not None:
            octave_period = [cells * int(octave.frequency) for cells in axis_periods]
        yield (
            octave.amplitude,
            basis(position * octave.frequency, seed=octave.seed, period=octave_period),
        )
