"""The levels of a volume: mean-filtered values, and per-node minimum and maximum.

A coarse voxel is the mean of the N^3 voxels below it (a box filter). With it a level holds, for
every voxel, the average of just the space the voxel covers: a cone as wide as a voxel reads its
own footprint, and sums over a region do not change from level to level, so neither does how much
light a thin medium absorbs. Wider kernels blur more and need more border; maximum filters keep
thin shells opaque but let them grow. A volume that is seen from six directions (`Volume.filter`)
has a filter for each of them, `pool_directional`: what hides what is not forgotten.

Every level is made from the level below as it is stored, so that a volume of any size can be
converted part by part: the functions here work on any part of an array whose corner is a multiple
of the factor, and give the same bits as on the whole.
Source: Crassin et al., I3D 2009, section 3 (mip-mapped bricks); Williams, "Pyramidal parametrics",
    1983; Crassin et al., "Interactive indirect illumination using voxel cone tracing", CGF 2011
    (anisotropic voxels).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base.volume import DIRECTIONS, Volume

_SLAB = 1 << 22  # voxels pooled at a time: what lies in between stays in a core's cache


@dataclass(frozen=True)
class Level:
    """One level of one channel; level 0 is the finest."""

    values: Tensor  # (z, y, x, c)
    low: Tensor  # (gz, gy, gx, c) smallest finest-level value in reach of a node's brick, float32
    high: Tensor  # (gz, gy, gx, c) largest
    mean: Tensor  # (gz, gy, gx, c) mean of the node's own voxels as stored, float32


def volume_levels(
    volume: Volume, count: int, *, branching: int, brick_size: int, border: int
) -> Iterator[Level]:
    """Yields the levels of a volume by its own filter, see `build_levels`."""
    sizes = {"branching": branching, "brick_size": brick_size, "border": border}
    z, y, x = (side / min(volume.spacing) for side in reversed(volume.spacing))
    sides = (z, y, x) if volume.filter == "directional" else None
    return build_levels(volume.data, count, sides_zyx=sides, **sizes)


def build_levels(
    data_zyxc: Tensor,
    count: int,
    *,
    branching: int,
    brick_size: int,
    border: int,
    sides_zyx: tuple[float, float, float] | None = None,
) -> Iterator[Level]:
    """Yields `count` levels, finest first. Only one level's arrays are alive at a time, beside the
    data.

    A level is the mean of the level below as stored, rounded to the dtype (ties to even). Where
    `sides_zyx` gives the sides of a finest voxel in reference lengths, it is what
    `pool_directional` makes of the level below.
    """
    dtype = data_zyxc.dtype
    # NumPy has no bfloat16: float32 holds its values, rounded again after every mean.
    shown = data_zyxc.float() if dtype == torch.bfloat16 else data_zyxc
    values = low = high = shown.numpy()
    for level in range(count):
        if level > 0:
            if sides_zyx is None:
                values = pool_mean(values, branching)
            else:
                z, y, x = (side * branching ** (level - 1) for side in sides_zyx)
                values = pool_directional(values, branching, (z, y, x))
            if dtype == torch.bfloat16:
                values = torch.from_numpy(values).to(dtype).float().numpy()
            low, high = pool_min(low, branching), pool_max(high, branching)
        reach = {"size": brick_size + 2 * border, "step": brick_size}
        yield Level(
            values=data_zyxc if level == 0 else torch.from_numpy(values).to(dtype),
            low=_by_node(low, "min", border, **reach),
            high=_by_node(high, "max", border, **reach),
            mean=_by_node(values, "mean", 0, size=brick_size, step=brick_size),
        )


def round_to(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Converts float32 means to a channel's dtype: to nearest for integers, ties to even."""
    if dtype == torch.uint16:
        return torch.round(values).to(torch.int32).to(torch.uint16)
    return values.to(dtype) if dtype.is_floating_point else torch.round(values).to(dtype)


def round_array(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """`round_to` for arrays."""
    return values.astype(dtype) if dtype.kind == "f" else np.rint(values).astype(dtype)


def pool_mean(values: np.ndarray, factor: int | Sequence[int]) -> np.ndarray:
    """Averages blocks of voxels.

    Sums are exact for integers and float64 for float32, always in the same order, so a part of an
    array gives the bits of the whole.

    Args:
        values: (z, y, x, c) integers of at most 16 bits, float16 or float32.
        factor: Voxels along a block's side, or (z, y, x) of them. A last block that is not full
            repeats its last voxel.

    Returns:
        (ceil(z / factor), ..., c) of the same dtype, rounded to nearest, ties to even.
    """
    factors = _factors(factor)
    voxels = int(np.prod(factors))
    return _pool(values, factors, lambda part: _narrow(_sum(part, factors), voxels, values.dtype))


def pool_min(values: np.ndarray, factor: int | Sequence[int]) -> np.ndarray:
    """Takes the smallest of blocks of voxels, see `pool_mean`."""
    return _pool_extreme(values, factor, np.minimum)


def pool_max(values: np.ndarray, factor: int | Sequence[int]) -> np.ndarray:
    """Takes the largest of blocks of voxels, see `pool_mean`."""
    return _pool_extreme(values, factor, np.maximum)


def pool_directional(
    values: np.ndarray, factor: int, sides_zyx: tuple[float, float, float]
) -> np.ndarray:
    """Makes one voxel of factor^3, for each of six directions what is seen along it: in each of the
    factor^2 columns that run that way, voxels are composited front to back; the mean of the columns
    is stored.

    Opacity is stored per reference length at every level, as that of a homogeneous voxel which lets
    as much light through. So a homogeneous medium stays as it is, and so does opacity 1. Sums are
    float64.

    Args:
        values: (z, y, x, 24) as `Volume.directional` lays them.
        factor: Voxels along a block's side. A last block that is not full repeats its last voxel.
        sides_zyx: Sides of a voxel in reference lengths.

    Returns:
        (ceil(z / factor), ..., 24) of the same dtype.
    """
    factors = _factors(factor)

    def reduce(part: np.ndarray) -> np.ndarray:
        seen = []
        for number in range(len(DIRECTIONS)):
            axis = 2 - number // 2
            rgba = part[..., 4 * number : 4 * number + 4].astype(np.float64)
            columns = list(range(factor))[:: 1 if number % 2 == 0 else -1]
            rgba = _of_length(rgba, sides_zyx[axis])
            total = _every(rgba, axis, factor, columns[0])
            for k in columns[1:]:
                total = total + (1 - total[..., 3:]) * _every(rgba, axis, factor, k)
            across = [1 if a == axis else factor for a in range(3)]
            mean = _sum(total, _factors(across)) / factor**2
            seen.append(_of_length(mean, 1 / (factor * sides_zyx[axis])))
        return np.concatenate(seen, -1)

    return _pool(values, factors, reduce)


def _of_length(rgba: np.ndarray, lengths: float) -> np.ndarray:
    """Premultiplied colour and alpha of a homogeneous medium over another length."""
    alpha = rgba[..., 3:]
    with np.errstate(divide="ignore"):  # log 0: opaque
        changed = -np.expm1(np.log1p(-alpha) * lengths)
    scale = np.divide(changed, alpha, out=np.zeros_like(alpha), where=alpha > 0)
    return np.concatenate((rgba[..., :3] * scale, changed), -1)


def window(values: np.ndarray, how: str, *, size: int, step: int) -> np.ndarray:
    """Reduces windows of size^3 voxels, `step` apart, the first at the array's corner.

    Args:
        values: (z, y, x, c), borders included.
        how: "min", "max" or "mean".
        size: Voxels along a window's side.
        step: Voxels from one window to the next.

    Returns:
        (gz, gy, gx, c), g = (n - size) // step + 1: dtype kept for min and max, float32 for mean.
    """
    counts = [(n - size) // step + 1 for n in values.shape[:3]]
    for axis in range(3):
        values = _window_axis(values, axis, how, counts[axis], size, step)
    return (values / size**3).astype(np.float32) if how == "mean" else values


def extend(values: np.ndarray, axis: int, before: int, after: int) -> np.ndarray:
    """Repeats the outermost voxels along an axis."""
    if before == after == 0:
        return values
    index = np.arange(-before, values.shape[axis] + after).clip(0, values.shape[axis] - 1)
    return values.take(index, axis)


def _by_node(values: np.ndarray, how: str, border: int, *, size: int, step: int) -> Tensor:
    """Reduces the window of every brick: `size` voxels from `border` before its first voxel."""
    counts = [-(-n // step) for n in values.shape[:3]]
    for axis in range(3):  # axis by axis: only what is already small is extended as a whole
        extra = -values.shape[axis] % step
        values = extend(values, axis, border, extra + border)
        values = _window_axis(values, axis, how, counts[axis], size, step)
    return torch.from_numpy((values / size**3 if how == "mean" else values).astype(np.float32))


def _window_axis(
    values: np.ndarray, axis: int, how: str, count: int, size: int, step: int
) -> np.ndarray:
    def offset(k: int) -> np.ndarray:
        place = [slice(None)] * values.ndim
        place[axis] = slice(k, k + step * (count - 1) + 1, step)
        return values[tuple(place)]

    if how == "mean":
        total = offset(0).astype(_wide(values.dtype, size))
        for k in range(1, size):
            total += offset(k)
        return total
    combine = np.minimum if how == "min" else np.maximum
    found = offset(0).copy()
    for k in range(1, size):
        combine(found, offset(k), out=found)
    return found


def _factors(factor: int | Sequence[int]) -> tuple[int, int, int]:
    z, y, x = (factor,) * 3 if isinstance(factor, int) else factor
    return (int(z), int(y), int(x))


def _pool(values: np.ndarray, factors: tuple[int, int, int], reduce: Any) -> np.ndarray:
    """Runs `reduce` over slabs of whole blocks."""
    shape = [-(-n // f) for n, f in zip(values.shape[:3], factors, strict=True)]
    out = np.empty((*shape, values.shape[3]), values.dtype)
    rows = max(1, _SLAB // max(1, int(np.prod(values.shape[1:])) * factors[0]))
    for start in range(0, shape[0], rows):
        part = values[start * factors[0] : (start + rows) * factors[0]]
        for axis in range(3):
            part = extend(part, axis, 0, -part.shape[axis] % factors[axis])
        out[start : start + rows] = reduce(part)
    return out


def _pool_extreme(values: np.ndarray, factor: int | Sequence[int], combine: Any) -> np.ndarray:
    factors = _factors(factor)

    def reduce(part: np.ndarray) -> np.ndarray:
        for axis, f in enumerate(factors):
            found = _every(part, axis, f, 0)
            for k in range(1, f):
                found = combine(found, _every(part, axis, f, k))
            part = found
        return part

    return _pool(values, factors, reduce)


def _sum(part: np.ndarray, factors: tuple[int, int, int]) -> np.ndarray:
    wide = _wide(part.dtype, int(np.prod(factors)))
    for axis, f in enumerate(factors):
        total = _every(part, axis, f, 0)
        for k in range(1, f):
            total = np.add(total, _every(part, axis, f, k), dtype=wide)
        part = total
    return part.astype(wide, copy=False)


def _every(values: np.ndarray, axis: int, step: int, first: int) -> np.ndarray:
    place = [slice(None)] * axis + [slice(first, None, step)]
    return values[tuple(place)]


def _wide(dtype: np.dtype, terms: int) -> np.dtype:
    """A dtype that holds the sum of so many terms."""
    if dtype.kind == "f":
        return np.dtype(np.float32 if dtype.itemsize == 2 else np.float64)
    if dtype.itemsize > 4:
        return np.dtype(np.int64)
    info = np.iinfo(dtype)
    most = max(-int(info.min), int(info.max)) * terms
    return next(np.dtype(f"int{bits}") for bits in (16, 32, 64) if most < 2 ** (bits - 1))


def _narrow(total: np.ndarray, voxels: int, dtype: np.dtype) -> np.ndarray:
    """Sums to means, ties to even."""
    if dtype.kind == "f":
        return (total / total.dtype.type(voxels)).astype(dtype)
    if voxels & (voxels - 1) == 0:  # a shift: floor, plus one above a half or at an odd half
        if voxels == 1:
            return total.astype(dtype)
        shift = voxels.bit_length() - 1
        odd = total >> shift
        odd &= 1
        odd += total
        odd += voxels // 2 - 1
        odd >>= shift
        return odd.astype(dtype)
    whole, rest = np.divmod(total, voxels)
    up = (2 * rest > voxels) | ((2 * rest == voxels) & (whole & 1 == 1))
    return (whole + up).astype(dtype)
