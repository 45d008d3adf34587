"""The levels of a volume: mean-filtered values, and per-node minimum and maximum.

A coarse voxel is the mean of the N^3 voxels below it (a box filter). With it a level holds, for
every voxel, the average of just the space the voxel covers: a cone as wide as a voxel reads its
own footprint, and sums over a region do not change from level to level, so neither does how much
light a thin medium absorbs. Wider kernels blur more and need more border; maximum filters keep
thin shells opaque but let them grow.
Source: Crassin et al., I3D 2009, section 3 (mip-mapped bricks); Williams, "Pyramidal parametrics",
    1983.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Level:
    """One level of one channel; level 0 is the finest."""

    values: Tensor  # (z, y, x, c)
    low: Tensor  # (gz, gy, gx, c) smallest finest-level value in reach of a node's brick, float32
    high: Tensor  # (gz, gy, gx, c) largest
    mean: Tensor  # (gz, gy, gx, c) mean of the node's own voxels, float32


def build_levels(
    data_zyxc: Tensor, count: int, *, branching: int, brick_size: int, border: int
) -> Iterator[Level]:
    """Yields `count` levels, finest first. Only one level's arrays are alive at a time, beside the
    data.

    Means are taken in float32 from the level below, unrounded; stored values are rounded to the
    dtype.
    """
    dtype = data_zyxc.dtype
    values = data_zyxc
    low = high = data_zyxc
    for level in range(count):
        if level > 0:
            values = _pool(values, branching, "mean")
            low, high = _pool(low, branching, "min"), _pool(high, branching, "max")
        reach = {"size": brick_size + 2 * border, "border": border, "step": brick_size}
        yield Level(
            values=values if values.dtype == dtype else round_to(values, dtype),
            low=_windows(low, "min", **reach),
            high=_windows(high, "max", **reach),
            mean=_windows(values, "mean", size=brick_size, border=0, step=brick_size),
        )


def round_to(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Converts float32 means to a channel's dtype: to nearest for integers."""
    if dtype == torch.uint16:
        return torch.round(values).to(torch.int32).to(torch.uint16)
    return values.to(dtype) if dtype.is_floating_point else torch.round(values).to(dtype)


def comparable(values: Tensor) -> Tensor:
    """uint16 has neither comparisons nor sums in torch: int32 holds the same values."""
    return values.to(torch.int32) if values.dtype == torch.uint16 else values


def _reduce(values: Tensor, how: str, dim: int) -> Tensor:
    if how == "mean":
        return comparable(values).mean(dim, dtype=torch.float32)
    return comparable(values).amin(dim) if how == "min" else comparable(values).amax(dim)


def _pool(values: Tensor, branching: int, how: str) -> Tensor:
    """Reduces blocks of N^3 voxels; a last block that is not full repeats its last voxel."""
    for axis in range(3):
        values = _extend(values, axis, 0, -values.shape[axis] % branching)
        shape = list(values.shape)
        shape[axis : axis + 1] = [shape[axis] // branching, branching]
        values = _reduce(values.reshape(shape), how, axis + 1)
    return values


def _windows(values: Tensor, how: str, *, size: int, border: int, step: int) -> Tensor:
    """Reduces the window of every brick: `size` voxels from `border` before its first voxel."""
    for axis in range(3):
        extra = -values.shape[axis] % step
        values = _reduce(
            _extend(values, axis, border, extra + border).unfold(axis, size, step), how, -1
        )
    return values.to(torch.float32)


def _extend(values: Tensor, axis: int, before: int, after: int) -> Tensor:
    """Repeats the outermost voxels along an axis."""
    if before == after == 0:
        return values
    length = values.shape[axis]
    index = torch.arange(-before, length + after, device=values.device).clamp(0, length - 1)
    return values.index_select(axis, index)
