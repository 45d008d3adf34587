"""The levels of volumes, and what the nodes of each level hold: what a tree is built from.

Every level is made from the level below as it is stored, rounded to its dtype, so a level can also
be made part by part, out of core, with the same bits; see downsample.py for the filters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ..base.stage import Progress, no_progress
from ..base.volume import Volume
from .downsample import by_node, pool_directional, pool_max, pool_mean, pool_min


@dataclass(frozen=True)
class NodeSummary:
    """What nodes hold in one channel of c components; `...` is any shape, one entry a node."""

    low: Tensor  # (..., c) float32 smallest finest-level value in reach of the brick, with border
    high: Tensor  # (..., c) float32 largest
    mean: Tensor  # (..., c) float32 mean of the node's own voxels, as its level stores them

    @property
    def is_constant(self) -> Tensor:
        """(...) bool, whether all finest values in reach are equal."""
        return (self.low == self.high).all(-1)

    def is_empty(self, threshold: float | None) -> Tensor:
        """Returns (...) bool, whether no finest value in reach is above the threshold."""
        if threshold is None:
            return torch.zeros(self.high.shape[:-1], dtype=torch.bool)
        return (self.high <= threshold).all(-1)

    def constants(self, dtype: torch.dtype) -> Tensor:
        """Returns (..., c) the value of CONSTANT nodes, the mean of others."""
        return round_to(torch.where(self.is_constant[..., None], self.low, self.mean), dtype)

    def ranges(self, dtype: torch.dtype) -> Tensor:
        """Returns (..., 2, c) smallest and largest value."""
        return round_to(torch.stack((self.low, self.high), -2), dtype)


@dataclass(frozen=True)
class Level:
    """One level of one channel."""

    values: Tensor  # (z, y, x, c) voxels, in the channel's dtype
    nodes: NodeSummary  # (gz, gy, gx, c) of the level's nodes, g = ceil(n / brick_size)

    @property
    def grid(self) -> tuple[int, int, int]:
        """Nodes along z, y, x."""
        z, y, x, _ = self.nodes.low.shape
        return (z, y, x)


def volume_levels(
    volume: Volume, count: int, *, branching: int, brick_size: int, border: int
) -> Iterator[Level]:
    """Yields the first `count` levels of a volume, finest first.

    A level is what the volume's filter (`Volume.filter`) makes of the level below as stored: its
    mean, rounded to the dtype (ties to even), or what is seen of it along six directions.
    """
    dtype = volume.data.dtype
    # NumPy has no bfloat16: float32 holds its values, rounded again after every mean.
    data = volume.data.float() if dtype == torch.bfloat16 else volume.data
    z, y, x = (side / min(volume.spacing) for side in reversed(volume.spacing))
    values = low = high = data.numpy()
    for level in range(count):
        if level > 0:
            if volume.filter == "directional":
                scale = branching ** (level - 1)
                values = pool_directional(values, branching, (z * scale, y * scale, x * scale))
            else:
                values = pool_mean(values, branching)
            if dtype == torch.bfloat16:
                values = torch.from_numpy(values).to(dtype).float().numpy()
            low, high = pool_min(low, branching), pool_max(high, branching)
        summary = NodeSummary(
            low=torch.from_numpy(by_node(low, "min", brick_size, border)),
            high=torch.from_numpy(by_node(high, "max", brick_size, border)),
            mean=torch.from_numpy(by_node(values, "mean", brick_size, 0)),
        )
        stored = volume.data if level == 0 else torch.from_numpy(values).to(dtype)
        yield Level(values=stored, nodes=summary)


def levels_by_depth(
    volumes: Mapping[str, Volume],
    depth: int,
    branching: int,
    brick_size: int,
    border: int,
    progress: Progress = no_progress,
) -> dict[str, list[Level]]:
    """Returns all levels of each channel, the root's first: `levels[channel][depth]`."""
    result: dict[str, list[Level]] = {}
    sizes = {"branching": branching, "brick_size": brick_size, "border": border}
    for name, volume in volumes.items():
        levels = result[name] = []
        for level in volume_levels(volume, depth + 1, **sizes):
            levels.insert(0, level)
            progress("levels", len(levels), depth + 1)
    return result


def tree_depth(extent: tuple[int, int, int], brick_size: int, branching: int) -> int:
    """Returns the depth of the finest level: the smallest at which bricks cover the extent."""
    depth = 0
    while brick_size * branching**depth < max(extent):
        depth += 1
    return depth


def round_to(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Converts float32 values to a channel's dtype: to nearest for integers, ties to even."""
    if dtype == torch.uint16:
        return torch.round(values).to(torch.int32).to(torch.uint16)
    return values.to(dtype) if dtype.is_floating_point else torch.round(values).to(dtype)
