"""Gradient noise on grids of points, such as the voxels of bricks, for a tenth of the work: corners
of the lattice are hashed once each, not eight times a point, and ramps are interpolated an axis
after the other.

In a cell, noise is the sum over corners of fx fy fz (gx dx + gy dy + gz dz), with fade f and offset
d of each axis, so along an axis it needs f and f * d alone. They are 0 at all corners but the ends
of a point's cell, and adding these zeros is cheaper than looking up which corners they are.

Source: Perlin, "Improving noise", SIGGRAPH 2002; the order of the sums is our own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ...base import check
from . import lattice
from .lattice import Period

#: Numbers that are worked on together on the CPU, about 2 MB.
_CHUNK = 1 << 18


def perlin_grid(
    x: Tensor,
    y: Tensor,
    z: Tensor,
    *,
    seed: int = 0,
    period: Period = None,
    cells: int | None = None,
) -> Tensor:
    """The noise of `perlin` on k grids, at all combinations of coordinates along their axes.

    Args:
        x: (k, sx) float32 or float64, rising along each row.
        y: (k, sy), the same.
        z: (k, sz), the same.
        seed, period: As in `perlin`.
        cells: Most cells of the lattice from which a row takes points; points of more cells than
            that are wrong. None: it is looked up, so the host waits for the device.

    Returns:
        (k, sz, sy, sx), equal to `perlin` up to rounding: 2^-20 for offsets of float32.

    Raises:
        ValueError: An argument is not that.
    """
    axes = (x, y, z)
    kinds = {(one.dtype, one.dim(), one.shape[:1]) for one in axes}
    if len(kinds) > 1 or x.dim() != 2 or x.dtype not in (torch.float32, torch.float64):
        got = ", ".join(check.describe(one) for one in axes)
        raise ValueError(f"noise.perlin_grid: axes must be (k, s) floats of one dtype, got {got}")
    every = lattice.periods("noise.perlin_grid", period, 3)
    if cells is None:
        cells = most_cells(axes)
    check.whole("noise.perlin_grid", "cells", cells, low=1)
    sides = [one.shape[1] for one in axes]
    if x.device.type != "cpu" or torch.compiler.is_compiling():
        return _evaluate(axes, seed, every, cells + 1).movedim(-1, 0)
    out = torch.empty((len(x), *sides[::-1]), dtype=x.dtype)
    some = max(1, _CHUNK // max(math.prod(sides), (cells + 1) ** 3))
    for begin in range(0, len(x), some):
        part = [one[begin : begin + some] for one in axes]
        out[begin : begin + some] = _evaluate(part, seed, every, cells + 1).movedim(-1, 0)
    return out


def most_cells(axes: Sequence[Tensor]) -> int:
    """Returns the most cells of the lattice from which a row of coordinates takes points."""
    spans = [one.floor()[:, -1] - one.floor()[:, 0] for one in axes]
    return int(max(float(span.max()) for span in spans)) + 1


def _evaluate(axes: Sequence[Tensor], seed: int, period: Sequence[int | None], m: int) -> Tensor:
    """Returns (z, y, x, k) noise out of m lattice points along each axis. Grids are last, so that
    inner loops are long.
    """
    fades, ramps, hashes = [], [], []
    for axis, (places, every) in enumerate(zip(axes, period, strict=True)):
        place = places.T.contiguous()  # (s, k)
        floor = place.floor()
        first, offset = floor[:1], place - floor
        fade, low = lattice.fade(offset), floor - first
        lattice_mk = torch.arange(m, device=place.device, dtype=torch.int32)[:, None]
        own = [(low == at).to(place.dtype) for at in range(m)]  # 1 where it is the low end, else 0
        none = torch.zeros_like(low)
        pairs = [*zip(own, [none, *own], strict=False)]  # where it is the low, or the high end
        fades.append([is_low * (1 - fade) + is_high * fade for is_low, is_high in pairs])
        ramps.append(
            [
                is_low * ((1 - fade) * offset) + is_high * (fade * (offset - 1))
                for is_low, is_high in pairs
            ]
        )
        points = lattice.wrapped(first.to(torch.int32) + lattice_mk, every)
        hashes.append(lattice.scramble(points, seed, axis))
    bits = lattice.join(hashes[0], hashes[1][:, None])
    bits = lattice.join(bits, hashes[2][:, None, None])  # (z, y, x, k) of corners
    slopes = lattice.gradient(bits, axes[0].dtype)
    # What is to be multiplied by the offset along x, by that along y, and by none.
    by_x, by_y = (_along(0, fades[2], one) for one in slopes[:2])
    plain = _along(0, ramps[2], slopes[2])
    by_x, plain = _along(1, fades[1], by_x), _along(1, fades[1], plain, ramps[1], by_y)
    return _along(2, fades[0], plain, ramps[0], by_x)


def _along(dim: int, *pairs: Any) -> Tensor:
    """Returns sums over the corners along a dimension of values (z, y, x, k): of weights, m times
    (s, k), times values, weights, values, ...
    """
    total: Tensor | None = None
    for weights, values in zip(pairs[::2], pairs[1::2], strict=True):
        for weight, part in zip(weights, values.unbind(dim), strict=True):
            shape = [1, 1, 1, weight.shape[1]]
            shape[dim] = weight.shape[0]
            product = weight.view(shape) * part.unsqueeze(dim)
            total = product if total is None else total.add_(product)
    assert total is not None
    return total
