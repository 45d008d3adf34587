"""What a tree is built from: the levels of volumes, summaries of each level's nodes, and, for a
resident tree, the plan of its nodes.

Every level is made from the level below as it is stored, rounded to its dtype, so a level can also
be made part by part, out of core, with the same bits; see base/downsample.py for the filters.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from ..base.constants import CONSTANT, EMPTY, TERMINAL
from ..base.downsample import (
    Grid,
    as_grid,
    by_node,
    from_grid,
    pool_directional,
    pool_majority,
    pool_max,
    pool_mean,
    pool_min,
)
from ..base.labels import background
from ..base.stage import Progress, no_progress
from ..base.volume import Volume, movable
from ..ops import cut_bricks
from .pools import BrickPool, NodePool

_BATCH_BRICKS = {"cpu": 4096, "cuda": 1 << 15}  # bricks cut from a level at a time
_PEAK_MEMORY_FACTOR = 8  # times a volume's bytes: itself, its levels, temporaries, and all bricks


@dataclass(frozen=True)
class NodeSummary:
    """What nodes hold in one channel of c components; `...` is any shape, one entry per node."""

    low: Tensor  # (..., c) float32 smallest finest-level value in reach of the brick, with border
    high: Tensor  # (..., c) float32 largest
    mean: Tensor  # (..., c) float32 mean of the node's own voxels, as its level stores them; of
    # labels the smallest

    @property
    def is_constant(self) -> Tensor:
        """(...) bool, whether all finest values in reach are equal."""
        return (self.low == self.high).all(-1)

    def is_empty(self, threshold: float | None) -> Tensor:
        """Returns (...) bool, whether no finest value in reach is above the threshold."""
        if threshold is None:
            return torch.zeros_like(self.high[..., 0], dtype=torch.bool)
        return (self.high <= threshold).all(-1)

    def constants(self, dtype: torch.dtype) -> Tensor:
        """Returns (..., c) the value of CONSTANT nodes, the mean of others."""
        return round_to(torch.where(self.is_constant[..., None], self.low, self.mean), dtype)

    def ranges(self, dtype: torch.dtype) -> Tensor:
        """Returns (..., 2, c) smallest and largest value."""
        return round_to(torch.stack((self.low, self.high), -2), dtype)


def constant_and_empty(
    summaries: Iterable[NodeSummary], threshold: float | None
) -> tuple[Tensor, Tensor]:
    """Returns (...) bool, given summaries of all channels: whether each is constant; and whether
    each is empty, which counts even if the other is true.
    """
    nodes = [*summaries]
    constant = torch.stack([summary.is_constant for summary in nodes]).all(0)
    return constant, torch.stack([summary.is_empty(threshold) for summary in nodes]).all(0)


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
    mean, rounded to the dtype (ties to even), its most frequent label, or what is seen of it along
    six directions.
    """
    dtype, device, how = volume.data.dtype, volume.data.device, volume.filter
    label_table = volume.label_values
    empty = background(None if label_table is None else label_table.numpy())
    values = low = high = as_grid(volume.data)
    for level in range(count):
        if level > 0:
            values = coarser(values, how, branching, dtype, volume.spacing, level, empty=empty)
            low, high = pool_min(low, branching), pool_max(high, branching)
        summary = NodeSummary(
            low=torch.as_tensor(by_node(low, "min", brick_size, border), device=device),
            high=torch.as_tensor(by_node(high, "max", brick_size, border), device=device),
            mean=torch.as_tensor(
                by_node(values, node_reduction(how), brick_size, 0), device=device
            ),
        )
        stored = volume.data if level == 0 else from_grid(values, dtype)
        yield Level(values=stored, nodes=summary)


def node_reduction(how: str) -> Literal["mean", "min"]:
    """Returns which reduction represents a node: a mean of labels may be no label."""
    return "min" if how == "majority" else "mean"


def coarser(
    values: Grid,
    how: str,
    branching: int,
    dtype: torch.dtype,
    spacing: tuple[float, float, float],
    level: int,
    *,
    empty: float | None = None,
) -> Grid:
    """Returns a level made from the next finer one.

    Args:
        values: The finer level, (z, y, x, c), or a part of it that begins at a multiple of
            `branching`; an array where the filter is not the mean.
        how: The volume's filter.
        branching: N.
        dtype: The channel's.
        spacing: The volume's.
        level: Number of the level that is made, from 1.
        empty: The value of the background, for labels.
    """
    coarse: Any = values
    if how == "mean":
        coarse = pool_mean(coarse, branching)
    elif how == "majority":
        coarse = pool_majority(coarse, branching, empty)
    else:
        scale = branching ** (level - 1)
        x, y, z = (side / min(spacing) * scale for side in spacing)
        coarse = pool_directional(coarse, branching, (z, y, x))
    return as_grid(from_grid(coarse, dtype)) if dtype == torch.bfloat16 else coarse


def levels_by_depth(
    volumes: Mapping[str, Volume],
    depth: int,
    branching: int,
    brick_size: int,
    border: int,
    progress: Progress = no_progress,
) -> dict[str, list[Level]]:
    """Returns all levels of each channel, the root's first: `levels[channel][depth]`."""
    result: dict[str, list[Level]] = {name: [] for name in volumes}
    sizes = {"branching": branching, "brick_size": brick_size, "border": border}
    for name, volume in volumes.items():
        for level in volume_levels(volume, depth + 1, **sizes):
            result[name].insert(0, level)
            progress("levels", len(result[name]), depth + 1)
    return result


def choose_build_device(volumes: Iterable[Volume], device: torch.device) -> torch.device:
    """Returns the device that makes the levels of volumes, given the device of the pools."""
    host, size = torch.device("cpu"), 0
    for volume in volumes:
        if volume.filter != "mean":
            return host
        size += volume.data.nbytes
    if device.type != "cuda" or _PEAK_MEMORY_FACTOR * size > torch.cuda.mem_get_info(device)[0]:
        return host
    return device


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


class TreePlan:
    """Which nodes of a resident tree exist, and their words, computed before any pool is made, so
    that pools get exactly the size they need. A node has a brick and, above the finest level,
    children unless it is CONSTANT or EMPTY; a child exists if its parent has children.

    Attributes:
        levels: For each channel its levels, the root's first.
        exists: For each depth (gz, gy, gx) bool, whether there is such a node.
        brick: For each depth (gz, gy, gx) int32 `brick_tn` word: slot, CONSTANT or EMPTY.
        child: For each depth (gz, gy, gx) int32 `child_tn` word: tile of the children or TERMINAL.
        tiles: Number of tiles; tile 0 holds the root.
        bricks: Number of bricks.
    """

    def __init__(
        self, levels: Mapping[str, Sequence[Level]], branching: int, threshold: float | None
    ) -> None:
        """Numbers tiles and bricks, depth after depth, in the order z, y, x. Nodes without a value
        above `threshold` in any channel are EMPTY; None: none is.
        """
        self.levels, self.branching = levels, branching
        self.exists: list[Tensor] = []
        self.brick: list[Tensor] = []
        self.child: list[Tensor] = []
        self.tiles, self.bricks = 1, 0
        for depth, channels in enumerate(zip(*levels.values(), strict=True)):
            constant, empty = constant_and_empty((level.nodes for level in channels), threshold)
            exists = torch.ones_like(empty)
            if depth > 0:
                parent = (torch.arange(n, device=empty.device) // branching for n in empty.shape)
                exists = (self.child[-1] >= 0)[torch.meshgrid(*parent, indexing="ij")]
            data = exists & ~(constant | empty)
            rank = torch.arange(int(data.sum()), dtype=torch.int32, device=empty.device)
            brick = torch.where(empty, EMPTY, CONSTANT).to(torch.int32)
            brick[data] = self.bricks + rank
            child = torch.full_like(brick, TERMINAL)
            if depth + 1 < len(next(iter(levels.values()))):
                child[data] = self.tiles + rank
                self.tiles += len(rank)
            self.bricks += len(rank)
            self.exists.append(exists)
            self.brick.append(brick)
            self.child.append(child)

    def write_nodes(self, nodes: NodePool, bricks: BrickPool) -> None:
        """Writes the whole node pool, and the owner of each brick."""
        device = nodes.child_tn.device
        nodes.child_tn[:], nodes.brick_tn[:] = TERMINAL, EMPTY  # also of nodes beyond the extent
        for depth, exists in enumerate(self.exists):
            zyx = exists.nonzero()
            zyx_index = tuple(zyx.T)
            node = self._node_index(depth, zyx, nodes.nodes_per_tile).to(device)
            child, brick = self.child[depth][zyx_index], self.brick[depth][zyx_index]
            nodes.child_tn.view(-1)[node] = child.to(device)
            nodes.brick_tn.view(-1)[node] = brick.to(device)
            has_brick, has_children = brick >= 0, child >= 0
            bricks.owner_b[brick[has_brick].to(device, torch.int64)] = node[has_brick].int()
            tile = child[has_children].to(device, torch.int64)
            nodes.parent_t[tile] = node[has_children].int()
            nodes.loc_t4[tile, :3] = zyx[has_children].flip(1).to(device, torch.int32)
            nodes.loc_t4[tile, 3] = depth + 1
            for name, levels in self.levels.items():
                summary = levels[depth].nodes
                for stored, values in (
                    (nodes.constants[name], summary.constants),
                    (nodes.ranges[name], summary.ranges),
                ):
                    rows = movable(values(stored.dtype))[zyx_index]
                    movable(stored).flatten(0, 1)[node] = rows.to(device)

    def write_bricks(self, pool: BrickPool, channel: str, depth: int) -> None:
        """Cuts the bricks of a depth out of their level, into consecutive slots."""
        has_brick = self.brick[depth] >= 0
        zyx, slots = has_brick.nonzero(), self.brick[depth][has_brick]
        values = self.levels[channel][depth].values
        batch = _BATCH_BRICKS[values.device.type]
        for part, slot in zip(zyx.split(batch), slots[::batch].tolist(), strict=False):
            cut = cut_bricks(values, part, pool.brick_size, pool.border)
            pool.bricks[channel][slot : slot + len(part)] = cut

    def _node_index(self, depth: int, zyx: Tensor, nodes_per_tile: int) -> Tensor:
        """Returns (k,) int64 node indices of positions (k, 3) z, y, x at a depth."""
        n = self.branching
        if depth == 0:
            return zyx.new_zeros(len(zyx))
        tile = self.child[depth - 1][tuple((zyx // n).T)].to(torch.int64)
        z, y, x = (zyx % n).unbind(1)
        return tile * nodes_per_tile + (z * n + y) * n + x
