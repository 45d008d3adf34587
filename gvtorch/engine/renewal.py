"""`renew_tree`: drops the bricks and subtrees of a tree that its producer says have changed."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..base.constants import ABSENT, EMPTY, REQUEST_SUBDIVIDE, TERMINAL
from ..base.volume import movable
from ..cache import Cache
from ..cache.write import Targets
from ..ops import unlink
from ..producers import Nodes
from ..producers.answer import checked_regions
from ..producers.producer import Where, touched
from .request_batch import ProducedTree, RequestBatch, children_of
from .setup import fill_root


def renew_tree(cache: Cache, made: ProducedTree, changes: Sequence[Where] | None) -> None:
    """Remakes a tree's root. Nodes for which one of `changes` is true are classified again and lose
    their bricks; those that no longer have children lose the subtree below them. The whole tree is
    dropped if `changes` is None (not known), if bricks are made from their parents' bricks, if
    there are aliases, or if the producer can't classify one of these nodes.
    """
    nodes, root = cache.nodes, made.tree.number
    whole = changes is None or made.producer.needs_parent or len(cache.aliases) > 0
    if whole or not _renew_parts(cache, made, changes or []):
        _drop_all(cache, root)
    below = nodes.child_tn[root, 0].clone()
    nodes.child_tn[root], nodes.brick_tn[root], nodes.request_tn[root] = TERMINAL, EMPTY, 0
    cache.bricks.owner_b[root] = ABSENT
    try:
        fill_root(cache, made)
    finally:
        ends = bool(nodes.child_tn[root, 0] == TERMINAL)
        nodes.child_tn[root, 0] = below.clamp(min=ABSENT)
        if ends:
            _drop_all(cache, root)
            nodes.child_tn[root, 0] = TERMINAL


def _renew_parts(cache: Cache, made: ProducedTree, changes: Sequence[Where]) -> bool:
    """Classifies the changed nodes again, all but the root, and drops their bricks. Returns False
    if the producer fails to classify one, or answers with aliases; then only requests are cleared.
    """
    nodes, n = cache.nodes, made.layout.branching**3
    tile = ((nodes.tree_t == made.tree.number) & (nodes.parent_t >= 0)).nonzero()[:, 0]
    nodes.request_tn[tile] = 0
    node = tile[:, None] * nodes.nodes_per_tile + torch.arange(n, device=tile.device)
    place = Nodes(made.tree.loc(node.flatten()), made.layout)
    stale = touched(changes, place).view(-1, n)
    some = stale.any(1).nonzero()[:, 0]
    if not len(some):
        return True
    stale, parent = stale[some], nodes.parent_t[tile[some]].to(torch.int64)
    targets = Targets(made.tree, parent, made.tree.loc(parent))
    batch = RequestBatch(made, REQUEST_SUBDIVIDE, targets)
    try:
        answer = made.wait(batch.ask())
        regions = checked_regions(answer, batch.nodes, made.producer)
    except Exception:  # the tree is dropped; its requests then report failures by node
        return False
    if regions.errors or regions.alias is not None:
        return False
    children, node = children_of(batch, regions, cache), node[some][stale]
    word, held = children.child[stale], nodes.child_tn.view(-1)[node]
    stays = (word == ABSENT) & (held >= 0)
    lost = [held[(held >= 0) & ~stays].to(torch.int64)]
    while len(lost[-1]):
        below = nodes.child_tn[lost[-1]]
        lost.append(below[below >= 0].to(torch.int64))
    gone = torch.cat(lost)
    named = torch.cat((nodes.brick_tn.view(-1)[node], nodes.brick_tn[gone].flatten()))
    _drop(cache, gone, named[named >= 0].to(torch.int64))
    nodes.child_tn.view(-1)[node] = torch.where(stays, held, word)
    nodes.brick_tn.view(-1)[node] = children.brick[stale]
    for pool, told in ((nodes.constants, children.constants), (nodes.ranges, children.ranges)):
        for name, rows in told.items():
            movable(pool[name]).flatten(0, 1)[node] = movable(rows)[stale]
    return True


def _drop_all(cache: Cache, number: int) -> None:
    """Frees all tiles and bricks of a tree except those of its root."""
    nodes, bricks = cache.nodes, cache.bricks
    cache.aliases.clear(number)
    own = nodes.tree_t == number
    own[number] = False
    tile = (own & (nodes.parent_t >= 0)).nonzero()[:, 0]
    owner = bricks.owner_b.clamp(min=0) // nodes.nodes_per_tile
    _drop(cache, tile, ((bricks.owner_b >= 0) & own[owner]).nonzero()[:, 0])


def _drop(cache: Cache, tile: Tensor, slot: Tensor) -> None:
    """Frees tiles (t,) and bricks (b,)."""
    nodes, bricks = cache.nodes, cache.bricks
    unlink(nodes.child_tn, nodes.parent_t, nodes.shared_t, tile.to(torch.int32))
    unlink(nodes.brick_tn, bricks.owner_b, bricks.shared_b, slot.to(torch.int32))
    nodes.child_tn[tile], nodes.brick_tn[tile], nodes.request_tn[tile] = ABSENT, ABSENT, 0
    nodes.stamp_t[tile], nodes.shared_t[tile] = -1, False
    bricks.stamp_b[slot], bricks.shared_b[slot] = -1, False
