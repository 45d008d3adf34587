"""`TreePlan`: the nodes of a resident tree, worked out from the levels of its volumes before any
pool is made, so that pools get exactly the size they need.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ..base.constants import CONSTANT, EMPTY, TERMINAL
from ..base.volume import movable
from ..ops import cut_bricks
from .brick_pool import BrickPool
from .node_pool import NodePool
from .pyramid import Level

_BATCH = 4096  # bricks cut from a level at a time


class TreePlan:
    """Which nodes exist, and their words. A node has a brick and, above the finest level, children
    unless it is CONSTANT or EMPTY; a child exists if its parent has children.

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
        """Numbers tiles and bricks, depth after depth, in the order z, y, x.

        Args:
            levels: For each channel its levels, the root's first.
            branching: N.
            threshold: Nodes without a value above it in any channel are EMPTY; None: none is.
        """
        self.levels, self.branching = levels, branching
        self.exists: list[Tensor] = []
        self.brick: list[Tensor] = []
        self.child: list[Tensor] = []
        self.tiles, self.bricks = 1, 0
        for depth, channels in enumerate(zip(*levels.values(), strict=True)):
            nodes = [level.nodes for level in channels]
            constant = torch.stack([node.is_constant for node in nodes]).all(0)
            empty = torch.stack([node.is_empty(threshold) for node in nodes]).all(0)
            exists = torch.ones_like(empty)
            if depth > 0:
                parent = (torch.arange(size) // branching for size in exists.shape)
                exists = (self.child[-1] >= 0)[torch.meshgrid(*parent, indexing="ij")]
            data = exists & ~(constant | empty)
            rank = torch.arange(int(data.sum()), dtype=torch.int32)
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
        """Writes all of the node pool, and which node owns each brick."""
        device = nodes.child_tn.device
        nodes.child_tn[:], nodes.brick_tn[:] = TERMINAL, EMPTY  # also of nodes beyond the extent
        for depth, exists in enumerate(self.exists):
            zyx = exists.nonzero()
            here = tuple(zyx.T)
            node = self._node_index(depth, zyx, nodes.nodes_per_tile).to(device)
            child, brick = self.child[depth][here], self.brick[depth][here]
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
                for words, values in (
                    (nodes.constants[name], summary.constants),
                    (nodes.ranges[name], summary.ranges),
                ):
                    rows = movable(values(words.dtype))[here]
                    movable(words).flatten(0, 1)[node] = rows.to(device)

    def write_bricks(self, pool: BrickPool, channel: str, depth: int) -> None:
        """Cuts the bricks of a depth out of their level; their slots follow one another."""
        has_brick = self.brick[depth] >= 0
        place, slots = has_brick.nonzero(), self.brick[depth][has_brick]
        values = self.levels[channel][depth].values
        for part, slot in zip(place.split(_BATCH), slots[::_BATCH].tolist(), strict=False):
            cut = cut_bricks(values, part, pool.brick_size, pool.border)
            pool.bricks[channel][slot : slot + len(part)] = cut

    def _node_index(self, depth: int, zyx: Tensor, nodes_per_tile: int) -> Tensor:
        """Returns (k,) int64 node indices of places (k, 3) z, y, x at a depth."""
        n = self.branching
        if depth == 0:
            return torch.zeros(len(zyx), dtype=torch.int64)
        tile = self.child[depth - 1][tuple((zyx // n).T)].to(torch.int64)
        z, y, x = (zyx % n).unbind(1)
        return tile * nodes_per_tile + (z * n + y) * n + x
