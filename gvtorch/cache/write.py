"""Writes what was produced into the pools.

Slots change hands in one order, always: slots are taken from those that the last picture did not
use, every pointer to them is cleared, the new content is written, the nodes are linked to it. So no
pointer ever leads to a slot that holds something else.
Source: Crassin et al., "GigaVoxels", I3D 2009, section 5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..base.constants import ABSENT, REQUEST_LOAD, REQUEST_SUBDIVIDE, TERMINAL
from ..base.volume import movable
from ..ops import lacking, link, link_bricks, link_tiles, unlink
from ..pool import N3Tree
from ..pool.staging import Chunk, Voxels, joined, on_device, wide_rows
from .cache import Cache


@dataclass(frozen=True, eq=False, repr=False)
class Targets:
    """Nodes to be written, and the places that they stood for when they were asked for: an answer
    that comes late may find that a node's tile was given away or moved.
    """

    tree: N3Tree
    node: Tensor  # (k,) int64, each once
    loc: Tensor  # (k, 4) places

    def __len__(self) -> int:
        """Number of nodes."""
        return len(self.node)

    def __getitem__(self, index: slice | Tensor) -> Targets:
        """Some of the nodes."""
        return Targets(self.tree, self.node[index], self.loc[index])

    def lacking(self, cache: Cache, kind: int) -> Tensor:
        """(k,) bool: the node still stands for its place, and still lacks its children
        (REQUEST_SUBDIVIDE) or its brick (REQUEST_LOAD).
        """
        pool, tree = cache.nodes, self.tree
        words = pool.brick_tn if kind == REQUEST_LOAD else pool.child_tn
        places = pool.loc_t4, pool.parent_t, pool.tree_t, pool.shared_t
        return lacking(words, *places, self.node, self.loc, tree.number, tree.root, tree.branching)


@dataclass
class Written:
    """What one write did."""

    items: int = 0  # tiles, or bricks
    evicted: int = 0  # of them in slots that held something
    constant: int = 0  # nodes that turned out to need no brick
    stale: int = 0  # answers whose node is gone, or served already
    unplaced: int = 0  # answers for which no slot was free
    nbytes: int = 0  # voxels moved into the pool
    lost: Tensor | None = field(default=None, repr=False)  # (k,) bool, to be asked for again


@dataclass(frozen=True, kw_only=True, repr=False)
class Children:
    """The words of k tiles' children, made from a producer's answer."""

    child: Tensor  # (k, n) int32 ABSENT or TERMINAL
    brick: Tensor  # (k, n) int32 ABSENT, EMPTY or CONSTANT
    constants: Mapping[str, Tensor]  # (k, n, c)
    ranges: Mapping[str, Tensor]  # (k, n, 2, c)
    is_alias: Tensor  # (k, n) bool
    alias: Tensor | None  # (k, n, 4) loc of alias targets


def tiles(cache: Cache, targets: Targets, children: Children) -> Written:
    """Gives nodes their children: takes tiles, unlinks, writes and links them."""
    (lru,), pool, per_tile = cache.lru[REQUEST_SUBDIVIDE], cache.nodes, cache.nodes.nodes_per_tile
    tree, node = targets.tree, targets.node
    wanted = targets.lacking(cache, REQUEST_SUBDIVIDE)
    first = wanted & (wanted.cumsum(0) <= lru.unused)
    tile_k = lru.order[: min(len(node), lru.unused)]
    # A late answer may be for nodes that are no longer used: those whose own tile is among the ones
    # given away have to wait.
    leaving = torch.zeros(pool.capacity, dtype=torch.bool, device=node.device)
    leaving[tile_k.to(torch.int64)] = _among_first(tile_k, first.sum())
    fit = first & ~leaving[node // per_tile]
    used = (pool.parent_t[tile_k.to(torch.int64)] >= 0) & _among_first(tile_k, fit.sum())
    counts = torch.stack([rows.sum() for rows in (wanted, first, fit, used)]).tolist()
    lasting, taken, items, evicted = counts
    stale, unplaced = len(node) - lasting, lasting - taken
    done = Written(items=items, evicted=evicted, stale=stale, unplaced=unplaced)
    done.lost = wanted & ~fit if items < lasting else None
    tile_k = lru.take(taken)[:items]
    if not items:
        return done
    unlink(pool.child_tn, tile_k, pool.capacity)
    unlink(pool.parent_t, tile_k, pool.capacity, per_tile)
    unlink(cache.bricks.owner_b, tile_k, pool.capacity, per_tile)
    rows, tile = torch.nonzero_static(fit, size=items)[:, 0], tile_k.to(torch.int64)
    width = children.child.shape[1]
    for held, values in ((pool.constants, children.constants), (pool.ranges, children.ranges)):
        for name, tensor in values.items():
            movable(held[name])[tile, :width] = movable(tensor)[rows]
    words = (pool.child_tn, pool.brick_tn, pool.request_tn)
    places = (pool.loc_t4, pool.parent_t, pool.tree_t, pool.stamp_t, pool.shared_t)
    made = (children.child.contiguous(), children.brick.contiguous(), node, targets.loc)
    link_tiles(*words, *places, *made, rows, tile_k, tree.number, cache.frame)
    if children.alias is not None:
        row, child = children.is_alias[rows].nonzero().unbind(1)
        target = tree.find(children.alias[rows][row, child])
        known = target >= 0
        pool.shared_t[tree.number] = True
        _alias(cache, (tile[row] * per_tile + child)[known], target[known])
    return done


def _alias(cache: Cache, node: Tensor, target: Tensor) -> None:
    """Points (k,) nodes, which own neither, to the tiles and bricks of their alias targets (k,)."""
    pool = cache.nodes
    child, brick = pool.child_tn.view(-1), pool.brick_tn.view(-1)
    child[node], brick[node] = child[target], brick[target]
    for words in (*pool.constants.values(), *pool.ranges.values()):
        _copy_rows(words, node, target)
    for shared, pointer in ((pool.shared_t, child), (cache.bricks.shared_b, brick)):
        slot = pointer[node]
        shared[slot[slot >= 0].to(torch.int64)] = True


def bricks(cache: Cache, targets: Targets, data: Voxels | Sequence[Chunk]) -> Written:
    """Gives (k,) nodes their bricks: takes slots, unlinks, writes and links them. `data` is for
    each channel (k, z, y, x, c), or what is on its way to the device; with a coarse channel they
    get coarse slots.
    """
    first = data if isinstance(data, Mapping) else data[0].channels
    coarse = any(cache.bricks.channels[name].coarse for name in first)
    lru, node = cache.lru[REQUEST_LOAD][coarse], targets.node
    wanted = targets.lacking(cache, REQUEST_LOAD)
    slot = lru.order[: min(len(node), lru.unused)].to(torch.int64)
    used = (cache.bricks.owner_b[slot] >= 0) & _among_first(slot, wanted.sum())
    lasting, evicted = torch.stack((wanted.sum(), used.sum())).tolist()
    items = min(lasting, lru.unused)
    stale, unplaced = len(node) - lasting, lasting - items
    done = Written(items=items, evicted=evicted, stale=stale, unplaced=unplaced)
    done.lost = wanted & (wanted.cumsum(0) > items) if unplaced else None
    if not items:
        return done
    slot_k = lru.take(items)
    if items < len(node):
        rows = torch.nonzero_static(wanted, size=lasting)[:items, 0]
        whole = joined(data, node.device)
        data = {name: movable(some)[rows].view(some.dtype) for name, some in whole.items()}
        node = node[rows]
    done.nbytes = put_bricks(cache, slot_k, node, data)
    return done


def put_bricks(cache: Cache, slot_k: Tensor, node: Tensor, data: Voxels | Sequence[Chunk]) -> int:
    """Writes voxels (see `bricks`) into (k,) int32 slots, each once, which lose what they held, and
    links (k,) int64 nodes to them; returns bytes moved.
    """
    nodes, pool, slot = cache.nodes, cache.bricks, slot_k.to(torch.int64)
    unlink(nodes.brick_tn, slot_k, pool.capacity)
    with pool.writing():
        if isinstance(data, Mapping):
            there = {name: on_device(rows, slot.device) for name, rows in data.items()}
            nbytes = _fill_slots(cache, slot, there)
        else:
            nbytes = 0
            for chunk in data:
                with chunk as arrived:
                    nbytes += _fill_slots(cache, slot[chunk.begin : chunk.end], arrived)
    slots = (pool.owner_b, pool.stamp_b, pool.born_b, pool.shared_b)
    link_bricks(nodes.brick_tn, nodes.request_tn, *slots, node, slot_k, cache.frame)
    return nbytes


def _fill_slots(cache: Cache, slot: Tensor, data: Mapping[str, Tensor]) -> int:
    """Writes voxels that are on the device; returns how many bytes they are."""
    nbytes = 0
    for name, held in cache.bricks.bricks.items():
        if name in data:
            to, rows = wide_rows(held, data[name])
            to.index_copy_(0, slot, rows)
            nbytes += rows.nbytes
        elif not cache.bricks.channels[name].coarse:
            wide_rows(held)[0].index_fill_(0, slot, 0)  # a tree without this channel
    return nbytes


def uniform(
    cache: Cache, targets: Targets, word: Tensor, constants: Mapping[str, Tensor]
) -> Written:
    """Marks (k,) nodes as EMPTY or CONSTANT, as `word` (k,) int32 tells: they need no bricks.
    `constants` are (k, c) for each channel; 0 for channels that are left out.
    """
    wanted = targets.lacking(cache, REQUEST_LOAD)
    lasting = int(wanted.sum())
    done = Written(constant=lasting, stale=len(targets) - lasting)
    if not lasting:
        return done
    rows = torch.nonzero_static(wanted, size=lasting)[:, 0]
    node, pool = targets.node[rows], cache.nodes
    for name, words in pool.constants.items():
        flat = movable(words).flatten(0, 1)
        if name in constants:
            flat[node] = movable(constants[name])[rows]
        else:
            flat.index_fill_(0, node, 0)
    link(pool.brick_tn, pool.request_tn, node.to(torch.int32), word[rows], REQUEST_LOAD)
    child = pool.child_tn.view(-1)
    below = child[node]
    child[node] = torch.where(below == ABSENT, TERMINAL, below)
    return done


def share_bricks(cache: Cache, targets: Targets, other: Tensor) -> None:
    """Points (k,) nodes to the bricks of their alias targets `other` (k,) int64, be they voxels,
    EMPTY or CONSTANT; nodes that are gone or served already are left alone.
    """
    wanted, pool = targets.lacking(cache, REQUEST_LOAD), cache.nodes
    node, other = targets.node[wanted], other[wanted]
    word = pool.brick_tn.view(-1)[other]
    cache.bricks.shared_b[word[word >= 0].to(torch.int64)] = True
    for words in pool.constants.values():
        _copy_rows(words, node, other)
    link(pool.brick_tn, pool.request_tn, node.to(torch.int32), word, REQUEST_LOAD)


def _copy_rows(words: Tensor, to: Tensor, source: Tensor) -> None:
    """Copies the rows of some nodes to others; words are (t, n, ...)."""
    flat = movable(words).flatten(0, 1)
    flat[to] = flat[source]


def _among_first(rows: Tensor, count: Tensor) -> Tensor:
    """(k,) bool: whether a row is one of the first `count`, a number on the device."""
    return torch.arange(len(rows), device=rows.device) < count
