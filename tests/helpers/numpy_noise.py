"""Noise, point by point in plain NumPy and float64: the reference for tests of `gv.noise`."""

from __future__ import annotations

import itertools
import math

import numpy as np

FIRST, SECOND = 0x2C1B3C6D, 0x297A2D39
AXIS = (0x632BE59B, 0x4F1BBCDD, 0x1E3779B9)
WORD = 0xFFFFFFFF


def signed_shift(word: int, bits: int) -> int:
    """Returns the arithmetic right shift of a 32-bit word."""
    value = word - 2**32 if word >= 2**31 else word
    return (value >> bits) & WORD


def salt(seed: int, axis: int) -> int:
    word = (seed + (seed >> 32) * 0x61C88647) & WORD
    word = (word * 0x9E3779B1 + AXIS[axis]) & WORD
    word = (word ^ word >> 16) * FIRST & WORD
    word = (word ^ word >> 16) * SECOND & WORD
    return word ^ word >> 15


def scramble(coordinate: int, seed: int, axis: int) -> int:
    word = ((coordinate & WORD) ^ salt(seed, axis)) * FIRST & WORD
    word = (word ^ signed_shift(word, 15)) * SECOND & WORD
    return word ^ signed_shift(word, 13)


def join(first: int, second: int) -> int:
    word = (first ^ second) * FIRST & WORD
    return (word ^ signed_shift(word, 15)) * SECOND & WORD


def lattice_hash(point, seed, period=None) -> int:
    """Returns the hash of a lattice point (x, y) or (x, y, z)."""
    periods = period or (None,) * len(point)
    point = [c if p is None else c % p for c, p in zip(point, periods, strict=True)]
    hashes = [scramble(c, seed, axis) for axis, c in enumerate(point)]
    result = hashes[0]
    for other in hashes[1:]:
        result = join(result, other)
    return result


def edge(word: int) -> tuple[float, float, float]:
    """Returns the middle of the cube's edge that a hash chooses."""
    first = -1.0 if word >> 6 & 1 else 1.0
    second = -1.0 if word >> 7 & 1 else 1.0
    part = signed_shift(word, 8)
    part = part - 2**32 if part >= 2**31 else part
    if part + 2796203 < 0:  # the first third
        return (0.0, first, second)
    if 2796203 - part < 0:  # the last third
        return (first, second, 0.0)
    return (first, 0.0, second)


def fade(t: float) -> float:
    return 6 * t**5 - 15 * t**4 + 10 * t**3


def _on_lattice(point, corner_value) -> float:
    cell = [math.floor(c) for c in point]
    total = 0.0
    for corner_offset in itertools.product((0, 1), repeat=len(point)):
        corner = [a + b for a, b in zip(cell, corner_offset, strict=True)]
        offset = [a - b for a, b in zip(point, corner, strict=True)]
        weight = math.prod(fade(1 - abs(c)) for c in offset)
        total += weight * corner_value(corner, offset)
    return total


def perlin(point, seed=0, period=None) -> float:
    def ramp(corner, offset):
        return float(np.dot(edge(lattice_hash(corner, seed, period))[: len(offset)], offset))

    return _on_lattice(point, ramp)


def value(point, seed=0, period=None) -> float:
    def random(corner, _):
        word = lattice_hash(corner, seed, period)
        return (word - 2**32 if word >= 2**31 else word) / 2**31

    return _on_lattice(point, random)


def simplex(point, seed=0, period=None) -> float:
    """Sums over all corners near the point, not only those of the simplex that contains it."""
    n = len(point)
    skew, back = ((3**0.5 - 1) / 2, (3 - 3**0.5) / 6) if n == 2 else (1 / 3, 1 / 6)
    middle = [round(c + skew * sum(point)) for c in point]
    total = 0.0
    for corner_offset in itertools.product(range(-3, 4), repeat=n):
        corner = [a + b for a, b in zip(middle, corner_offset, strict=True)]
        offset = np.subtract(point, np.subtract(corner, back * sum(corner)))
        falloff = 0.5 - float(offset @ offset)
        if falloff <= 0:
            continue
        lattice, periods = corner, period
        if n == 3:
            lattice = [6 * c - sum(corner) for c in corner]
            periods = period and [6 * c for c in period]
        total += falloff**4 * float(np.dot(edge(lattice_hash(lattice, seed, periods))[:n], offset))
    return total * (70.148 if n == 2 else 76.88)


def cellular(point, feature="F1", jitter=1.0, reach=1, seed=0, period=None) -> float:
    """Returns F1, F2 or F2-F1 of the points of all cells nearby, distances clamped to `reach`."""
    cell = [math.floor(c) for c in point]
    distances = []
    for cell_offset in itertools.product(range(-3, 4), repeat=len(point)):
        corner = [a + b for a, b in zip(cell, cell_offset, strict=True)]
        periods = period or (None,) * len(point)
        wrapped = [c if p is None else c % p for c, p in zip(corner, periods, strict=True)]
        hashes = [scramble(c, seed, axis) for axis, c in enumerate(wrapped)]
        word = hashes[-1]
        for other in hashes[-2::-1]:
            word = join(word, other)
        fractions = [(word >> 2 + 10 * axis & 1023) / 1023 for axis in range(len(point))]
        spot = [c + 0.5 * (1 - jitter) + jitter * s for c, s in zip(corner, fractions, strict=True)]
        distances.append(math.dist(spot, point))
    first, second = (min(d, reach) for d in sorted(distances)[:2])
    return {"F1": first, "F2": second, "F2-F1": second - first}[feature]


NEXT_OCTAVE, NEXT_AXIS = 0x10001, 0x3000007


def layers(point, octaves, lacunarity, gain, seed) -> list[tuple[float, float]]:
    """Returns amplitude and noise of each octave."""
    parts = []
    for octave in range(octaves):
        scaled = [c * lacunarity**octave for c in point]
        parts.append((gain**octave, perlin(scaled, seed + octave * NEXT_OCTAVE)))
    return parts


def fbm(point, octaves=6, lacunarity=2.0, gain=0.5, seed=0) -> float:
    return sum(a * noise for a, noise in layers(point, octaves, lacunarity, gain, seed))


def turbulence(point, octaves=6, lacunarity=2.0, gain=0.5, seed=0) -> float:
    return sum(a * abs(noise) for a, noise in layers(point, octaves, lacunarity, gain, seed))


def ridged(point, octaves=6, lacunarity=2.0, gain=0.5, sharpness=2.0, seed=0) -> float:
    """Musgrave's: a signal's weight is the one before, times `sharpness` and clamped to [0, 1]."""
    total, weight = 0.0, 1.0
    for amplitude, noise in layers(point, octaves, lacunarity, gain, seed):
        signal = weight * (1 - abs(noise)) ** 2
        weight = min(max(sharpness * signal, 0.0), 1.0)
        total += amplitude * signal
    return total


def warp(point, amplitude=1.0, octaves=1, lacunarity=2.0, gain=0.5, seed=0) -> list[float]:
    warped = []
    for axis, c in enumerate(point):
        parts = layers(point, octaves, lacunarity, gain, seed + (axis + 1) * NEXT_AXIS)
        warped.append(c + amplitude * sum(a * noise for a, noise in parts))
    return warped
