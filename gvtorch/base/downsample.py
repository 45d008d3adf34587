"""Reductions of voxels, from which coarse levels and summaries of nodes are made: of arrays on the
host, and, with the same bits, of tensors on a device.

`pool_mean` is the filter of a level (docs/design.md, section 2, explains why), `pool_majority` that
of labels, `pool_directional` that of volumes with six directions, see `Volume.directional`.

All functions take (z, y, x, c) grids. Each gives the same bits on any part of an array whose corner
is a multiple of the factor as on the whole, so volumes can also be converted part by part.
The worker processes of a conversion import this file: it imports torch only for tensors.
Source: Crassin et al., "GigaVoxels", I3D 2009, section 3 (mip-mapped bricks); Williams, "Pyramidal
    parametrics", 1983; Crassin et al., "Interactive indirect illumination using voxel cone
    tracing", CGF 2011 (anisotropic voxels).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Factors = Sequence[int]  # z y x
Reduction = Literal["min", "max", "mean"]
#: Arrays; or tensors of a dtype that torch can compare and add up: not uint16, nor bfloat16.
Grid = TypeVar("Grid", np.ndarray, "Tensor")

#: Voxels reduced at a time, so that intermediate arrays stay in a core's cache.
_SLAB_VOXELS = 1 << 22
_DEVICE_SLAB_VOXELS = 1 << 27  # the same on a device: more would take more memory and no less time


def as_grid(values: Tensor) -> Any:
    """Returns voxels as a `Grid`: an array of those on the host, a tensor of others."""
    import torch

    from .volume import to_numpy

    if values.device.type == "cpu":
        return to_numpy(values)
    wider = {torch.uint16: torch.int32, torch.bfloat16: torch.float32}
    return values.to(wider.get(values.dtype, values.dtype))


def from_grid(values: np.ndarray | Tensor, dtype: torch.dtype) -> Tensor:
    """Converts a grid back into a tensor of the dtype that `as_grid` took."""
    import torch

    tensor = values if isinstance(values, torch.Tensor) else torch.from_numpy(values)
    return tensor.to(dtype)


def round_array(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Converts means to a dtype: to nearest for integers, ties to even."""
    return values.astype(dtype) if dtype.kind == "f" else np.rint(values).astype(dtype)


def pool_mean(values: Grid, factor: int | Sequence[int]) -> Grid:
    """Averages blocks of voxels, (z, y, x, c) integers of at most 16 bits, float16 or float32.

    Sums are exact for integers and float64 for float32, always in the same order. `factor` is the
    voxels along a block's side, one number or (z, y, x); a last block that is not full repeats its
    last voxel.

    Returns:
        (ceil(z / factor), ..., c) of the same dtype, rounded to nearest, ties to even.
    """

    def reduce(part: Grid, factors: Factors) -> Grid:
        sums = _reduce_blocks(part, factors, "mean")
        return _rounded_mean(sums, math.prod(factors), _dtype_name(values))

    return _reduce_slabs(values, factor, reduce)


def pool_min(values: Grid, factor: int | Sequence[int]) -> Grid:
    """Returns the minimum of each block; arguments as for `pool_mean`."""
    return _reduce_slabs(values, factor, partial(_reduce_blocks, how="min"))


def pool_max(values: Grid, factor: int | Sequence[int]) -> Grid:
    """Returns the maximum of each block; arguments as for `pool_mean`."""
    return _reduce_slabs(values, factor, partial(_reduce_blocks, how="max"))


def pool_majority(
    values: np.ndarray, factor: int | Sequence[int], background: float | None
) -> np.ndarray:
    """Returns the most frequent value of each block; of equally frequent ones the smallest, and the
    background last, so that a sheet one voxel thick does not vanish. Arguments as for `pool_mean`.
    """

    def reduce(part: np.ndarray, factors: Factors) -> np.ndarray:
        low, high = _reduce_blocks(part, factors, "min"), _reduce_blocks(part, factors, "max")
        mixed = (low != high).nonzero()
        if len(mixed[0]):
            z, y, x = (n // f for n, f in zip(part.shape, factors, strict=False))
            blocks = part.reshape(z, factors[0], y, factors[1], x, factors[2], part.shape[3])
            rows = blocks.transpose(0, 2, 4, 6, 1, 3, 5)[mixed].reshape(len(mixed[0]), -1)
            low[mixed] = _most_frequent(rows, background)
        return low

    return _reduce_slabs(values, factor, reduce)


def _most_frequent(rows: np.ndarray, background: float | None) -> np.ndarray:
    """Returns (k,) the most frequent values of rows (k, m); see `pool_majority`."""
    columns = np.sort(rows, 1).T
    run = np.ones(len(rows), np.int32)
    best, best_run = columns[0].copy(), run.copy()
    for before, value in itertools.pairwise(columns):
        run = np.where(value == before, run + 1, 1)
        better = run > best_run
        if background is not None:
            better |= (run == best_run) & (best == background)
        best[better], best_run[better] = value[better], run[better]
    return best


def pool_directional(
    values: np.ndarray, factor: int, sides_zyx: tuple[float, float, float]
) -> np.ndarray:
    """Reduces blocks of factor^3 voxels of premultiplied colour and opacity, as seen along each of
    six directions.

    For a direction, each of the block's factor^2 columns along it is composited front to back; the
    mean of the columns is stored. Opacity is stored per reference length at every level: that of a
    homogeneous voxel with the same transmittance. So a homogeneous medium keeps its values, and so
    does opacity 1. Sums are float64.

    Args:
        values: (z, y, x, 24) as `Volume.directional` lays them out.
        factor: As for `pool_mean`, one number.
        sides_zyx: Sides of a voxel of `values`, in reference lengths.
    """

    def reduce(part: np.ndarray, factors: Factors) -> np.ndarray:
        views = []
        for direction in range(values.shape[-1] // 4):
            axis = 2 - direction // 2
            rgba = part[..., 4 * direction : 4 * direction + 4].astype(np.float64)
            columns = list(range(factor))[:: 1 if direction % 2 == 0 else -1]
            rgba = _change_length(rgba, sides_zyx[axis])
            total = _strided(rgba, axis, columns[0], factor)
            for k in columns[1:]:
                total = total + (1 - total[..., 3:]) * _strided(rgba, axis, k, factor)
            cross_factors = [1 if a == axis else f for a, f in enumerate(factors)]
            mean = _reduce_blocks(total, cross_factors, "mean") / factor**2
            views.append(_change_length(mean, 1 / (factor * sides_zyx[axis])))
        return np.concatenate(views, -1)

    return _reduce_slabs(values, factor, reduce)


def _change_length(rgba: np.ndarray, lengths: float) -> np.ndarray:
    """Converts premultiplied colour and alpha of a homogeneous medium to other lengths."""
    alpha = rgba[..., 3:]
    with np.errstate(divide="ignore"):  # log 0: opaque
        changed = -np.expm1(np.log1p(-alpha) * lengths)
    scale = np.divide(changed, alpha, out=np.zeros_like(alpha), where=alpha > 0)
    return np.concatenate((rgba[..., :3] * scale, changed), -1)


def reduce_windows(values: Grid, how: Reduction, *, size: int, step: int) -> Grid:
    """Reduces windows of size^3 voxels, `step` apart, by "min", "max" or "mean"; the first lies at
    the corner of the array (z, y, x, c).

    Returns:
        (gz, gy, gx, c), g = (n - size) // step + 1; of the same dtype for min and max, float32 for
        mean.
    """
    for axis in range(3):
        values = _reduce_axis(values, axis, how, size, step)
    return _cast(_divide(values, size**3), "float32") if how == "mean" else values


def extend(values: Grid, axis: int, before: int, after: int) -> Grid:
    """Repeats the outermost voxels along an axis, `before` and `after` times."""
    if before == after == 0:
        return values
    index = np.arange(-before, values.shape[axis] + after).clip(0, values.shape[axis] - 1)
    if isinstance(values, np.ndarray):
        return values.take(index, axis)
    import torch

    return values.index_select(axis, torch.from_numpy(index).to(values.device))


def by_node(values: Grid, how: Reduction, brick_size: int, border: int) -> Grid:
    """Reduces a level's voxels (z, y, x, c) by "min", "max" or "mean" to one per node: those of its
    brick and of `border` voxels around, repeated at the level's faces.

    Returns:
        (gz, gy, gx, c) float32, g = ceil(n / brick_size).
    """
    size = brick_size + 2 * border
    for axis in range(3):  # one after the other: only the first extends an array of full size
        count = -(-values.shape[axis] // brick_size)
        extra = count * brick_size - values.shape[axis]
        values = extend(values, axis, border, extra + border)
        values = _reduce_axis(values, axis, how, size, brick_size)
    return _cast(_divide(values, size**3) if how == "mean" else values, "float32")


def _reduce_axis(
    values: Grid, axis: int, how: Reduction, size: int, step: int, sum_dtype: str | None = None
) -> Grid:
    """Reduces windows, `step` apart, along one axis; sums have `sum_dtype`, or one wide enough."""
    if how == "mean" and sum_dtype is None:
        sum_dtype = _sum_dtype(_dtype_name(values), size)
    count = (values.shape[axis] - size) // step + 1
    first = _strided(values, axis, 0, step, count)
    result = _cast(first, sum_dtype or _dtype_name(values), copy=True)
    combine = _combine(values, how)
    for k in range(1, size):
        combine(result, _strided(values, axis, k, step, count), out=result)
    return result


def _combine(values: Grid, how: Reduction) -> Any:
    """Returns the function of two grids, and of `out`, that reduces them."""
    if isinstance(values, np.ndarray):
        return {"min": np.minimum, "max": np.maximum, "mean": np.add}[how]
    import torch

    return {"min": torch.minimum, "max": torch.maximum, "mean": torch.add}[how]


def _reduce_slabs(
    values: Grid, factor: int | Sequence[int], reduce: Callable[[Grid, Factors], Grid]
) -> Grid:
    """Runs `reduce`, which turns whole blocks into one voxel each, over slabs of a grid."""
    factors = [factor] * 3 if isinstance(factor, int) else list(factor)
    shape = [-(-n // f) for n, f in zip(values.shape[:3], factors, strict=True)]
    shape.append(values.shape[3])
    if isinstance(values, np.ndarray):
        out, slab = np.empty(shape, values.dtype), _SLAB_VOXELS
    else:
        out, slab = values.new_empty(shape), _DEVICE_SLAB_VOXELS
    rows = max(1, slab // max(1, math.prod(values.shape[1:]) * factors[0]))
    for start in range(0, shape[0], rows):
        part = values[start * factors[0] : (start + rows) * factors[0]]
        for axis in range(3):
            part = extend(part, axis, 0, -part.shape[axis] % factors[axis])
        out[start : start + rows] = reduce(part, factors)
    return out


def _reduce_blocks(part: Grid, factors: Factors, how: Reduction) -> Grid:
    """Reduces whole blocks to one voxel each, axis after axis."""
    sum_dtype = _sum_dtype(_dtype_name(part), math.prod(factors)) if how == "mean" else None
    for axis, factor in enumerate(factors):
        part = _reduce_axis(part, axis, how, factor, factor, sum_dtype)
    return part


def _strided(values: Grid, axis: int, first: int, step: int, count: int | None = None) -> Grid:
    """Returns every `step`-th slice along an axis, `count` of them."""
    stop = None if count is None else first + step * (count - 1) + 1
    return values[(slice(None),) * axis + (slice(first, stop, step),)]


def _dtype_name(values: Grid) -> str:
    """Returns the name of a grid's dtype, which NumPy and torch share."""
    return str(values.dtype).removeprefix("torch.")


def _cast(values: Grid, name: str, *, copy: bool = False) -> Grid:
    """Returns a grid in the dtype of a name."""
    if isinstance(values, np.ndarray):
        return values.astype(name, copy=copy)
    import torch

    return values.to(getattr(torch, name), copy=copy)


def _divide(total: Grid, count: int) -> Grid:
    """Divides sums by a count, integers in float64. A tensor is divided by a tensor: torch turns
    division by a plain number into a product with the reciprocal, which rounds differently.
    """
    if "int" in _dtype_name(total):
        total = _cast(total, "float64")
    if isinstance(total, np.ndarray):
        return total / total.dtype.type(count)
    return total / total.new_full((), count)


def _sum_dtype(name: str, terms: int) -> str:
    """Returns a dtype that holds the sum of this many terms of a dtype."""
    dtype = np.dtype(name)
    if dtype.kind == "f":
        return "float32" if dtype.itemsize == 2 else "float64"
    if dtype.itemsize > 4:
        return "int64"
    info = np.iinfo(dtype)
    largest = max(-int(info.min), int(info.max)) * terms
    return next(f"int{bits}" for bits in (16, 32, 64) if largest < 2 ** (bits - 1))


def _rounded_mean(total: Grid, voxels: int, name: str) -> Grid:
    """Divides sums by the number of voxels; integers are rounded to nearest, ties to even."""
    if voxels == 1:
        return _cast(total, name)
    if "float" in name:
        return _cast(_divide(total, voxels), name)
    if voxels & (voxels - 1) == 0:  # a shift: floor, plus one above a half or at an odd half
        shift = voxels.bit_length() - 1
        rounded = total >> shift
        rounded &= 1
        rounded += total
        rounded += voxels // 2 - 1
        rounded >>= shift
        return _cast(rounded, name)
    quotient = total // voxels
    remainder = total - quotient * voxels
    rounds_up = (2 * remainder > voxels) | ((2 * remainder == voxels) & (quotient & 1 == 1))
    return _cast(quotient + rounds_up, name)
