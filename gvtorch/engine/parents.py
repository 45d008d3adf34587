"""Bricks of parents, for producers that need them (`Producer.needs_parent`): a node whose parent
has no brick waits, and its nearest ancestor whose parent has one is loaded first.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..base.constants import ABSENT
from ..base.volume import movable
from ..cache import Cache
from ..ops import unlink
from .request_batch import ProducedTree


def nearest_loadable(cache: Cache, node: Tensor, depth: int) -> Tensor:
    """Returns for each of (k,) int64 nodes, -1 for none, its nearest ancestor, itself included,
    whose parent has a brick or needs none. `depth` is that of the tree. The host does not wait.
    """
    words = cache.nodes.brick_tn.view(-1)
    for _ in range(depth):
        parent = _parent(cache, node)
        lacks_brick = (parent >= 0) & (words[parent.clamp(min=0)] == ABSENT)
        node = torch.where(lacks_brick, parent, node)
    return node


def without_repeats(node: Tensor) -> Tensor:
    """Returns nodes (k,) with -1 in place of every repetition. The host does not wait."""
    sorted_node, order = node.sort(stable=True)
    repeated = torch.zeros_like(sorted_node, dtype=torch.bool)
    repeated[1:] = sorted_node[1:] == sorted_node[:-1]
    return torch.where(torch.zeros_like(repeated).scatter(0, order, repeated), -1, node)


def parent_bricks(cache: Cache, source: ProducedTree, node: Tensor) -> dict[str, Tensor]:
    """Returns for each channel that is not coarse the bricks (k, z, y, x, c) of the parents of (k,)
    nodes, of a root its own; all of these have a brick or are EMPTY or CONSTANT. The host does not
    wait.
    """
    parent = _parent(cache, node)
    parent = torch.where(parent >= 0, parent, node)
    word, bricks = cache.nodes.brick_tn.view(-1)[parent], {}
    for name, channel in source.producer.channels.items():
        if channel.coarse:
            continue
        pool, constants = cache.bricks.bricks[name].detach(), cache.nodes.constants[name]
        rows = movable(pool)[word.clamp(min=0).to(torch.int64)]
        constant = movable(constants).flatten(0, 1)[parent][:, None, None, None]
        uniform = (word < ABSENT)[:, None, None, None, None]  # EMPTY, CONSTANT
        rows = torch.where(uniform, constant, rows)
        bricks[name] = rows.view(pool.dtype)
    return bricks


def unlink_alias_only(cache: Cache, node: Tensor) -> Tensor:
    """Unlinks those tiles of (k,) nodes that are reached through aliases only: they have no known
    parent, and rays ask for them again where they belong. Returns (k,) bool: which nodes lie in
    other tiles.
    """
    tile = node // cache.nodes.nodes_per_tile
    has_parent = (cache.nodes.parent_t[tile] >= 0) | (tile < len(cache.aliases.trees))
    alias_only = tile[~has_parent].unique().to(torch.int32)
    unlink(cache.nodes.child_tn, cache.nodes.parent_t, cache.nodes.shared_t, alias_only)
    return has_parent


def _parent(cache: Cache, node: Tensor) -> Tensor:
    """Returns (k,) int64 parents of nodes, -1 for a root and for -1."""
    tile = node.clamp(min=0) // cache.nodes.nodes_per_tile
    return torch.where(node >= 0, cache.nodes.parent_t[tile].to(torch.int64), -1)
