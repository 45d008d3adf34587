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
from ..producers.producer import ChangeTest, changed_nodes
from .request_batch import ProducedTree, RequestBatch, children_of
from .setup import fill_root


def renew_tree(cache: Cache, source: ProducedTree, changes: Sequence[ChangeTest] | None) -> None:
    """Remakes a tree's root. Nodes for which one of `changes` is true are classified again and lose
    their bricks; those that no longer have children lose the subtree below them. The whole tree is
    dropped if `changes` is None (not known), if bricks are made from their parents' bricks, if
    there are aliases, or if the producer can't classify one of these nodes.
    """
    nodes, root = cache.nodes, source.tree.number
    drops_all = changes is None or source.producer.needs_parent or len(cache.aliases) > 0
    if drops_all or not _renew_parts(cache, source, changes or []):
        _drop_all(cache, root)
    root_child = nodes.child_tn[root, 0].clone()
    nodes.child_tn[root], nodes.brick_tn[root], nodes.request_tn[root] = TERMINAL, EMPTY, 0
    cache.bricks.owner_b[root] = ABSENT
    try:
        fill_root(cache, source)
    finally:
        is_leaf = bool(nodes.child_tn[root, 0] == TERMINAL)
        nodes.child_tn[root, 0] = root_child.clamp(min=ABSENT)
        if is_leaf:
            _drop_all(cache, root)
            nodes.child_tn[root, 0] = TERMINAL


def _renew_parts(cache: Cache, source: ProducedTree, changes: Sequence[ChangeTest]) -> bool:
    """Classifies the changed nodes again, all but the root, and drops their bricks. Returns False
    if the producer fails to classify one, or answers with aliases; then only requests are cleared.
    """
    nodes, n = cache.nodes, source.layout.branching**3
    tile = ((nodes.tree_t == source.tree.number) & (nodes.parent_t >= 0)).nonzero()[:, 0]
    nodes.request_tn[tile] = 0
    node = tile[:, None] * nodes.nodes_per_tile + torch.arange(n, device=tile.device)
    candidates = Nodes(source.tree.loc(node.flatten()), source.layout)
    changed = changed_nodes(changes, candidates).view(-1, n)
    changed_tiles = changed.any(1).nonzero()[:, 0]
    if not len(changed_tiles):
        return True
    changed, parent = changed[changed_tiles], nodes.parent_t[tile[changed_tiles]].to(torch.int64)
    targets = Targets(source.tree, parent, source.tree.loc(parent))
    batch = RequestBatch(source, REQUEST_SUBDIVIDE, targets)
    try:
        answer = source.wait(batch.ask())
        regions = checked_regions(answer, batch.nodes, source.producer)
    except Exception:  # the tree is dropped; its requests then report failures by node
        return False
    if regions.errors or regions.alias is not None:
        return False
    contents, node = children_of(batch, regions, cache), node[changed_tiles][changed]
    new_word, old_word = contents.child[changed], nodes.child_tn.view(-1)[node]
    keeps_subtree = (new_word == ABSENT) & (old_word >= 0)
    dropped_levels = [old_word[(old_word >= 0) & ~keeps_subtree].to(torch.int64)]
    while len(dropped_levels[-1]):
        children = nodes.child_tn[dropped_levels[-1]]
        dropped_levels.append(children[children >= 0].to(torch.int64))
    dropped_tiles = torch.cat(dropped_levels)
    words = torch.cat((nodes.brick_tn.view(-1)[node], nodes.brick_tn[dropped_tiles].flatten()))
    _drop(cache, dropped_tiles, words[words >= 0].to(torch.int64))
    nodes.child_tn.view(-1)[node] = torch.where(keeps_subtree, old_word, new_word)
    nodes.brick_tn.view(-1)[node] = contents.brick[changed]
    for pool, values in ((nodes.constants, contents.constants), (nodes.ranges, contents.ranges)):
        for name, rows in values.items():
            movable(pool[name]).flatten(0, 1)[node] = movable(rows)[changed]
    return True


def _drop_all(cache: Cache, tree_number: int) -> None:
    """Frees all tiles and bricks of a tree except those of its root."""
    nodes, bricks = cache.nodes, cache.bricks
    cache.aliases.clear(tree_number)
    in_tree = nodes.tree_t == tree_number
    in_tree[tree_number] = False
    tile = (in_tree & (nodes.parent_t >= 0)).nonzero()[:, 0]
    owner = bricks.owner_b.clamp(min=0) // nodes.nodes_per_tile
    _drop(cache, tile, ((bricks.owner_b >= 0) & in_tree[owner]).nonzero()[:, 0])


def _drop(cache: Cache, tile: Tensor, slot: Tensor) -> None:
    """Frees tiles (t,) and bricks (b,)."""
    nodes, bricks = cache.nodes, cache.bricks
    unlink(nodes.child_tn, nodes.parent_t, nodes.shared_t, tile.to(torch.int32))
    unlink(nodes.brick_tn, bricks.owner_b, bricks.shared_b, slot.to(torch.int32))
    nodes.child_tn[tile], nodes.brick_tn[tile], nodes.request_tn[tile] = ABSENT, ABSENT, 0
    nodes.stamp_t[tile], nodes.shared_t[tile] = -1, False
    bricks.stamp_b[slot], bricks.shared_b[slot] = -1, False
