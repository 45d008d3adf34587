"""What all noises stand on: points, the cells of the integer lattice that they lie in, a hash of
lattice points by integer arithmetic, and gradients out of its bits.

Integers wrap at 32 bits, so hashes are equal on every device, and floats are made by + - * alone.
Nothing depends on values but numbers: no shape, no branch, so torch.compile takes all of it.

Source: Perlin, "Improving noise", SIGGRAPH 2002 (fade, the twelve gradients); the hash is our own:
    products with odd numbers and shifts, its avalanche measured in the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...base import check

#: Points (..., n), or n coordinates that broadcast to one shape.
Points = Tensor | Sequence[Tensor]
#: A whole period for each axis, or one for all; None: not periodic.
Period = int | Sequence[int] | None

#: Points evaluated together on the CPU: their temporaries then stay in its caches.
CHUNK = 1 << 16

_FIRST, _SECOND = 0x2C1B3C6D, 0x297A2D39  # odd, about half of their bits set
_AXIS = (0x632BE59B, 0x4F1BBCDD, 0x1E3779B9)
_THIRD = 2796203  # 2^23 / 3
_WORD = {torch.float32: torch.int32, torch.float64: torch.int64}
_TOP = {torch.float32: -(2**31), torch.float64: -(2**63)}
_ONE = {torch.float32: 0x3F800000, torch.float64: 0x3FF0000000000000}  # the bits of 1.0


class Cell(NamedTuple):
    """Along one axis: where points lie in their cell, and the hashes of the cell's two ends."""

    offset: Tensor  # from the cell's low end, 0 to 1
    low: Tensor  # int32
    high: Tensor  # int32


def coordinates(where: str, points: Points) -> tuple[Tensor, ...]:
    """Returns the 2 or 3 coordinates of points, floats of one shape.

    Raises:
        ValueError: They are not that.
    """
    axes = points.unbind(-1) if isinstance(points, Tensor) and points.dim() else tuple(points)
    if not 2 <= len(axes) <= 3 or not all(isinstance(one, Tensor) for one in axes):
        got = check.describe(points) if isinstance(points, Tensor) else f"{len(axes)} items"
        raise ValueError(f"{where}: points must be (..., n) or n tensors, n = 2 or 3, got {got}")
    kinds = {one.dtype for one in axes}
    if len(kinds) > 1 or not kinds <= set(_WORD):
        got = ", ".join(sorted(str(kind).removeprefix("torch.") for kind in kinds))
        raise ValueError(f"{where}: points must be float32 or float64, got {got}")
    return tuple(torch.broadcast_tensors(*axes))


def periods(where: str, period: Period, n: int, multiple: int = 1) -> tuple[int | None, ...]:
    """Returns the period along each of n axes.

    Raises:
        ValueError: One is no positive multiple of `multiple`.
    """
    if period is None:
        return (None,) * n
    each = (period,) * n if isinstance(period, int) else tuple(period)
    if len(each) != n:
        raise ValueError(f"{where}: period must be an int or {n} of them, got {period!r}")
    for one in each:
        check.whole(where, "period", one, low=1, high=2**28)
        if one % multiple:
            raise ValueError(f"{where}: period must be a multiple of {multiple}, got {period!r}")
    return each


def salt(seed: int, axis: int) -> int:
    """Returns an int32 that stands for a seed and an axis."""
    bits = ((seed + (seed >> 32) * 0x61C88647) * 0x9E3779B1 + _AXIS[axis]) & 0xFFFFFFFF
    for factor in (_FIRST, _SECOND):
        bits ^= bits >> 16
        bits = bits * factor & 0xFFFFFFFF
    bits ^= bits >> 15
    return bits - 2**32 if bits >= 2**31 else bits


def scramble(lattice: Tensor, seed: int, axis: int) -> Tensor:
    """Returns int32 hashes of int32 coordinates along an axis."""
    bits = lattice.bitwise_xor(salt(seed, axis)).mul_(_FIRST)
    bits = bits.bitwise_xor_(bits >> 15).mul_(_SECOND)
    return bits.bitwise_xor_(bits >> 13)


def join(first: Tensor, second: Tensor) -> Tensor:
    """Returns int32 hashes of pairs of hashes; their high bits are the best ones.

    The shift is arithmetic, so that a word and its complement become one. That costs one bit of 32
    and saves the mask that a logical shift needs.
    """
    bits = first.bitwise_xor(second).mul_(_FIRST)
    return bits.bitwise_xor_(bits >> 15).mul_(_SECOND)


def cells(axes: Sequence[Tensor], seed: int, period: Sequence[int | None]) -> list[Cell]:
    """Returns for each axis where points lie in the cells of the integer lattice."""
    found = []
    for axis, (place, every) in enumerate(zip(axes, period, strict=True)):
        floor = place.detach().floor()
        low = floor.to(torch.int32)
        ends = wrapped(low, every), wrapped(low + 1, every)
        found.append(Cell(place - floor, *(scramble(end, seed, axis) for end in ends)))
    return found


def wrapped(lattice: Tensor, period: int | None) -> Tensor:
    """Returns lattice coordinates in the first period."""
    return lattice if period is None else lattice.remainder(period)


def corners(found: Sequence[Cell]) -> list[Tensor]:
    """Returns the int32 hashes of a cell's 2^n corners, x running fastest."""
    x, y = found[0], found[1]
    hashes = [join(a, b) for b in (y.low, y.high) for a in (x.low, x.high)]
    if len(found) == 2:
        return hashes
    return [join(a, b) for b in (found[2].low, found[2].high) for a in hashes]


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
    """Returns x, y, z of the gradient that int32 hashes choose: from a cube's centre to the middle
    of one of its twelve edges, so two of them are 1 or -1 and one is 0.

    Signs are bits 6 and 7, and the upper 24 bits, in thirds, tell which is 0. They are floats made
    bit by bit, since a choice by `torch.where` takes 20 times as long as an addition on the CPU.
    """
    third = bits >> 8
    not_x, not_z = (third + _THIRD) >> 31, (_THIRD - third) >> 31  # -1 where that one is 0, else 0
    wide = bits
    if dtype == torch.float64:
        wide, not_x, not_z = (one.to(torch.int64) for one in (bits, not_x, not_z))
    size = 31 if dtype == torch.float32 else 63
    first = ((wide << (size - 6)) & _TOP[dtype]).bitwise_or_(_ONE[dtype])  # 1.0 or -1.0
    second = ((wide << (size - 7)) & _TOP[dtype]).bitwise_or_(_ONE[dtype])
    in_x, in_z = first & not_x.bitwise_not_(), second & not_z.bitwise_not_()
    in_y = first.bitwise_xor_(in_x).bitwise_or_(second.bitwise_xor_(in_z))
    return in_x.view(dtype), in_y.view(dtype), in_z.view(dtype)


def ramp(bits: Tensor, away: Sequence[Tensor]) -> Tensor:
    """Returns the scalar product of the gradient that hashes choose and (x, y) or (x, y, z). In the
    plane it is that of the plane z = 0 in space.
    """
    own = gradient(bits, away[0].dtype)
    total = own[0] * away[0] + own[1] * away[1]
    return total if len(away) == 2 else total + own[2] * away[2]


def in_chunks(evaluate: Callable[..., Tensor], axes: Sequence[Tensor]) -> Tensor:
    """Returns `evaluate(*axes)`, an elementwise function of coordinates of one shape. In chunks on
    the CPU, unless gradients are recorded or torch.compile fuses the operations.
    """
    first = axes[0]
    whole = first.device.type != "cpu" or torch.compiler.is_compiling()
    learns = torch.is_grad_enabled() and any(one.requires_grad for one in axes)
    if whole or learns or first.numel() <= CHUNK:
        return evaluate(*axes)
    flat = [one.reshape(-1) for one in axes]
    out = torch.empty(first.numel(), dtype=first.dtype)
    for begin in range(0, len(out), CHUNK):
        part = slice(begin, begin + CHUNK)
        out[part] = evaluate(*(one[part] for one in flat))
    return out.view(first.shape)
