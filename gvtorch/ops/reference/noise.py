"""The twin of `noise`: gradient, value, simplex and cellular noise of points, in plain torch.

Integers wrap at 32 bits, so hashes are equal on every device, and floats are made by + - * and
square roots alone, in one order. No shape and no branch depends on values.

Sources: Perlin, "Improving noise", SIGGRAPH 2002 (fade, the twelve gradients); Perlin, "Noise
    hardware", SIGGRAPH course notes 2001, and Gustavson, "Simplex noise demystified", 2005 (simplex
    noise); Gustavson, McEwan, "Tiling simplex noise and flow noise in two and three dimensions",
    JCGT 2022 (the possible periods of simplices); Worley, "A cellular texture basis function",
    SIGGRAPH 1996 (here each cell has one point, not a Poisson distributed number of them). The hash
    is ours: products with odd numbers, and shifts; the tests measure its avalanche.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...base.check import is_recorded
from .exact import sqrt_exact

#: Points evaluated together on the CPU: their temporaries then stay in its caches.
CHUNK = 1 << 16
#: Coordinates from here on count as 0: cell numbers must fit into 32 bits, also skewed ones.
_MAX_COORDINATE = 2.0**29
#: In the order of `NoiseKind` in csrc/noise/noise.h.
KINDS = ("perlin", "value", "simplex", "F1", "F2", "F2-F1")

_FIRST_FACTOR, _SECOND_FACTOR = 0x2C1B3C6D, 0x297A2D39  # odd, about half of their bits set
_AXIS = (0x632BE59B, 0x4F1BBCDD, 0x1E3779B9)
_THIRD = 2796203  # 2^23 / 3
_TOP_BIT = {torch.float32: -(2**31), torch.float64: -(2**63)}
_ONE_BITS = {torch.float32: 0x3F800000, torch.float64: 0x3FF0000000000000}  # the bits of 1.0
#: Simplex noise times this lies in -1 to 1, by dimensions; see `bounds`.
_SIMPLEX_SCALE = {2: 70.148, 3: 76.880}
_SKEW = {2: (math.sqrt(3) - 1) / 2, 3: 1 / 3}
_UNSKEW = {2: (3 - math.sqrt(3)) / 6, 3: 1 / 6}


class NoiseArguments(NamedTuple):
    """The parameters of a noise."""

    salt: tuple[int, int, int]  # int32
    period: tuple[int, int, int]  # 0: none
    jitter: float
    reach: int


class Cell(NamedTuple):
    """Along one axis: the points' offsets in their cells, and the hashes of the cells' two ends."""

    offset: Tensor  # from the cell's low end, 0 to 1
    low: Tensor  # int32
    high: Tensor  # int32


def noise(point_pn: Tensor, kind: int, arguments: NoiseArguments) -> Tensor:
    """See `ops.noise`."""
    function: Callable[..., Tensor] = (_perlin, _value, _simplex, _cellular)[min(kind, 3)]

    def evaluate(*axes: Tensor) -> Tensor:
        return function(axes, arguments) if kind < 3 else function(axes, arguments, KINDS[kind])

    bounded = torch.where(point_pn.detach().abs() >= _MAX_COORDINATE, 0.0, point_pn)
    return in_chunks(evaluate, bounded.unbind(1))


def _perlin(axes: Sequence[Tensor], arguments: NoiseArguments) -> Tensor:
    axis_cells = cells(axes, arguments)
    ends = [(cell.offset, cell.offset - 1) for cell in axis_cells]
    ramps = []
    for number, bits in enumerate(corners(axis_cells)):
        away = [end[number >> axis & 1] for axis, end in enumerate(ends)]
        ramps.append(ramp(bits, away))
    return blend(ramps, [fade(cell.offset) for cell in axis_cells])


def _value(axes: Sequence[Tensor], arguments: NoiseArguments) -> Tensor:
    axis_cells = cells(axes, arguments)
    values = [bits.to(axes[0].dtype) * 2.0**-31 for bits in corners(axis_cells)]
    return blend(values, [fade(cell.offset) for cell in axis_cells])


def _simplex(axes: Sequence[Tensor], arguments: NoiseArguments) -> Tensor:
    """Evaluates simplex noise. Ramps fade by (1/2 - r^2)^4, which is 0 before the next corner's
    cell begins; with the 0.6 that is often used in space it is not, and such noise jumps.
    """
    n = len(axes)
    skew = sum(axes[1:], axes[0]).detach() * _SKEW[n]
    floors = [(coordinate.detach() + skew).floor() for coordinate in axes]
    unskew = sum(floors[1:], floors[0]) * _UNSKEW[n]
    pairs = zip(axes, floors, strict=True)
    offsets = [coordinate - (floor - unskew) for coordinate, floor in pairs]
    lattice = [floor.to(torch.int32) for floor in floors]
    rank, total = _ranks(offsets), torch.zeros_like(axes[0])
    for corner in range(n + 1):
        # 1 along the `corner` axes of the largest offsets
        steps = [(axis_rank + corner >= n).to(torch.int32) for axis_rank in rank]
        moves = zip(offsets, steps, strict=True)
        away = [offset - step + corner * _UNSKEW[n] for offset, step in moves]
        square = away[0] * away[0]
        for distance in away[1:]:
            square = square + distance * distance
        falloff = (0.5 - square).clamp_min(0)
        bits = _simplex_hash([a + b for a, b in zip(lattice, steps, strict=True)], arguments)
        total = total + falloff * falloff * (falloff * falloff) * ramp(bits, away)
    return total * _SIMPLEX_SCALE[n]


def _cellular(axes: Sequence[Tensor], arguments: NoiseArguments, feature: str) -> Tensor:
    first = second = torch.full_like(axes[0], float(arguments.reach) ** 2)
    for bits, away in _neighbours(axes, arguments):
        square = torch.zeros_like(first)
        for axis, low in enumerate(away):
            random_offset = ((bits >> (2 + 10 * axis)) & 1023).to(low.dtype)
            distance = random_offset * (arguments.jitter / 1023) + low
            square = square + distance * distance
        second = torch.minimum(second, torch.maximum(first, square))
        first = torch.minimum(first, square)
    if feature == "F1":
        return sqrt_exact(first)
    return sqrt_exact(second) if feature == "F2" else sqrt_exact(second) - sqrt_exact(first)


def _ranks(offsets: list[Tensor]) -> list[Tensor]:
    """Returns int32 how many other offsets are smaller; of equal ones the first ranks higher."""
    ranks = [torch.zeros_like(offsets[0], dtype=torch.int32) for _ in offsets]
    for first in range(len(offsets)):
        for second in range(first + 1, len(offsets)):
            above = (offsets[first] >= offsets[second]).to(torch.int32)
            ranks[first] = ranks[first] + above
            ranks[second] = ranks[second] + (1 - above)
    return ranks


def _simplex_hash(lattice: list[Tensor], arguments: NoiseArguments) -> Tensor:
    """Returns int32 hashes of corners from their int32 skewed coordinates.

    In space, 6 times the unskewed coordinates are integers, and a period wraps those.
    """
    if len(lattice) == 3:
        total = sum(lattice[1:], lattice[0])
        pairs = zip(lattice, arguments.period, strict=True)
        lattice = [wrapped(6 * coordinate - total, 6 * period) for coordinate, period in pairs]
    bits = scramble(lattice[0], arguments.salt[0])
    for coordinate, salt in zip(lattice[1:], arguments.salt[1:], strict=False):
        bits = join(bits, scramble(coordinate, salt))
    return bits


def _neighbours(
    axes: Sequence[Tensor], arguments: NoiseArguments
) -> list[tuple[Tensor, list[Tensor]]]:
    """Returns for each cell in reach its int32 hashes, and along each axis the offset from the
    evaluated point to the lowest position that the cell's point can have.
    """
    steps, hashes, lows = range(-arguments.reach, arguments.reach + 1), [], []
    for coordinate, salt, period in zip(axes, arguments.salt, arguments.period, strict=False):
        floor = coordinate.detach().floor()
        lattice, least = floor.to(torch.int32), 0.5 * (1 - arguments.jitter) - (coordinate - floor)
        ends = [wrapped(lattice + step, period) for step in steps]
        hashes.append([scramble(end, salt) for end in ends])
        lows.append([least + step for step in steps])
    neighbours = []
    for row in itertools.product(range(len(steps)), repeat=len(axes) - 1):  # z, y
        row_hash = hashes[-1][row[0]]
        for axis, index in zip(range(len(axes) - 2, 0, -1), row[1:], strict=True):
            row_hash = join(row_hash, hashes[axis][index])
        for index in range(len(steps)):
            cell = (index, *reversed(row))
            away = [low[step] for low, step in zip(lows, cell, strict=True)]
            neighbours.append((join(row_hash, hashes[0][index]), away))
    return neighbours


def salts(seed: int) -> tuple[int, int, int]:
    """Returns int32 salts for x, y and z, derived from a seed."""
    x, y, z = (_salt(seed, axis) for axis in range(3))
    return x, y, z


def _salt(seed: int, axis: int) -> int:
    bits = ((seed + (seed >> 32) * 0x61C88647) * 0x9E3779B1 + _AXIS[axis]) & 0xFFFFFFFF
    for factor in (_FIRST_FACTOR, _SECOND_FACTOR):
        bits ^= bits >> 16
        bits = bits * factor & 0xFFFFFFFF
    bits ^= bits >> 15
    return bits - 2**32 if bits >= 2**31 else bits


def scramble(lattice: Tensor, salt: int) -> Tensor:
    """Returns int32 hashes of int32 coordinates along an axis, given the axis' salt."""
    bits = lattice.bitwise_xor(salt).mul_(_FIRST_FACTOR)
    bits = bits.bitwise_xor_(bits >> 15).mul_(_SECOND_FACTOR)
    return bits.bitwise_xor_(bits >> 13)


def join(first: Tensor, second: Tensor) -> Tensor:
    """Returns int32 hashes of pairs of hashes; their high bits are the best mixed.

    The shift is arithmetic, so a word and its complement get the same hash. That costs one bit of
    32 and saves the mask that a logical shift needs.
    """
    bits = first.bitwise_xor(second).mul_(_FIRST_FACTOR)
    return bits.bitwise_xor_(bits >> 15).mul_(_SECOND_FACTOR)


def cells(axes: Sequence[Tensor], arguments: NoiseArguments) -> list[Cell]:
    """Returns for each axis the cells of the integer lattice that contain the points."""
    axis_cells = []
    for coordinate, salt, period in zip(axes, arguments.salt, arguments.period, strict=False):
        floor = coordinate.detach().floor()
        low = floor.to(torch.int32)
        ends = wrapped(low, period), wrapped(low + 1, period)
        axis_cells.append(Cell(coordinate - floor, *(scramble(end, salt) for end in ends)))
    return axis_cells


def wrapped(lattice: Tensor, period: int) -> Tensor:
    """Returns lattice coordinates wrapped into the first period; unchanged if the period is 0."""
    return lattice.remainder(period) if period else lattice


def corners(axis_cells: Sequence[Cell]) -> list[Tensor]:
    """Returns the int32 hashes of a cell's 2^n corners, x running fastest."""
    x, y = axis_cells[0], axis_cells[1]
    hashes = [join(a, b) for b in (y.low, y.high) for a in (x.low, x.high)]
    if len(axis_cells) == 2:
        return hashes
    return [join(a, b) for b in (axis_cells[2].low, axis_cells[2].high) for a in hashes]


def fade(offset: Tensor) -> Tensor:
    """Returns 6 t^5 - 15 t^4 + 10 t^3, whose first two derivatives are 0 at 0 and 1."""
    return offset * offset * offset * ((offset * 6 - 15) * offset + 10)


def blend(values: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    """Returns 2^n values interpolated along x, then y, then z, by the weights of high ends."""
    for weight in weights:
        pairs = zip(values[::2], values[1::2], strict=True)
        values = [low + weight * (high - low) for low, high in pairs]
    return values[0]


def gradient(bits: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Returns x, y, z of the gradient that int32 hashes select: from a cube's centre to the middle
    of one of its twelve edges, so two of them are 1 or -1 and one is 0.

    Bits 6 and 7 are the signs, and the third in which the upper 24 bits lie selects the 0. Floats
    are assembled from bits, since `torch.where` takes 20 times as long as an addition on the CPU.
    """
    third = bits >> 8
    not_x, not_z = (third + _THIRD) >> 31, (_THIRD - third) >> 31  # -1 where that one is 0, else 0
    wide_bits = bits
    if dtype == torch.float64:
        wide_bits, not_x, not_z = (word.to(torch.int64) for word in (bits, not_x, not_z))
    top_bit = 31 if dtype == torch.float32 else 63
    # Each is 1.0 or -1.0.
    first = ((wide_bits << (top_bit - 6)) & _TOP_BIT[dtype]).bitwise_or_(_ONE_BITS[dtype])
    second = ((wide_bits << (top_bit - 7)) & _TOP_BIT[dtype]).bitwise_or_(_ONE_BITS[dtype])
    in_x, in_z = first & not_x.bitwise_not_(), second & not_z.bitwise_not_()
    in_y = first.bitwise_xor_(in_x).bitwise_or_(second.bitwise_xor_(in_z))
    return in_x.view(dtype), in_y.view(dtype), in_z.view(dtype)


def ramp(bits: Tensor, away: Sequence[Tensor]) -> Tensor:
    """Returns the dot product of the gradient that hashes select and (x, y) or (x, y, z). In 2D it
    equals that in space with z = 0.
    """
    slope = gradient(bits, away[0].dtype)
    total = slope[0] * away[0] + slope[1] * away[1]
    return total if len(away) == 2 else total + slope[2] * away[2]


def in_chunks(evaluate: Callable[..., Tensor], axes: Sequence[Tensor]) -> Tensor:
    """Returns `evaluate(*axes)`, an elementwise function of coordinates of one shape. It runs in
    chunks on the CPU, unless gradients are recorded or torch.compile fuses the operations.
    """
    first = axes[0]
    at_once = first.device.type != "cpu" or torch.compiler.is_compiling()
    needs_gradient = any(map(is_recorded, axes))
    if at_once or needs_gradient or first.numel() <= CHUNK:
        return evaluate(*axes)
    flat = [coordinate.reshape(-1) for coordinate in axes]
    out = torch.empty(first.numel(), dtype=first.dtype, device=first.device)
    for begin in range(0, len(out), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        out[chunk] = evaluate(*(coordinate[chunk] for coordinate in flat))
    return out.view(first.shape)
