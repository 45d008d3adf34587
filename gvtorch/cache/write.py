"""Writes what was produced into the pools.

Slots change hands (eviction) in one order, always: slots are taken from those that the last picture
did not use, every pointer to them is cleared, the new content is written, the nodes are linked to
it. So no pointer ever leads to a slot that holds something else.
Source: Crassin et al., "GigaVoxels", I3D 2009, section 5.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from ..base.constants import ABSENT, REQUEST_LOAD, REQUEST_SUBDIVIDE, TERMINAL
from ..base.volume import movable
from ..ops import lacking, link, link_bricks, link_tiles, orphan, put_rows, unlink
from ..pool import N3Tree
from ..pool.staging import Chunk, Voxels, on_device, row_bytes
from .cache import LRU, Cache


@dataclass(frozen=True, eq=False, repr=False)
class Targets:
    """Nodes to be written, and the locs that they had when they were asked for: an answer that
    comes late may find that a node's tile was given away or reused.
    """

    tree: N3Tree
    node: Tensor  # (k,) int64, each once
    loc: Tensor  # (k, 4) x, y, z, depth

    def __len__(self) -> int:
        return len(self.node)

    def __getitem__(self, index: slice | Tensor) -> Targets:
        return Targets(self.tree, self.node[index], self.loc[index])

    def lacking(self, cache: Cache, kind: int) -> Tensor:
        """Returns (k,) bool, which nodes still have their loc, and still lack their children
        (REQUEST_SUBDIVIDE) or their brick (REQUEST_LOAD).
        """
        pool, tree = cache.nodes, self.tree
        words = pool.brick_tn if kind == REQUEST_LOAD else pool.child_tn
        tile_fields = pool.loc_t4, pool.parent_t, pool.tree_t, pool.shared_t
        tree_numbers = tree.number, tree.root, tree.branching
        return lacking(words, *tile_fields, self.node, self.loc, *tree_numbers)


@dataclass
class Written:
    """What one write did."""

    items: int = 0  # tiles, or bricks
    evicted: int = 0  # of these, those whose slots were occupied
    constant: int = 0  # nodes that turned out to need no brick
    stale: int = 0  # answers whose node is gone, or served already
    unplaced: int = 0  # answers for which no slot was free
    nbytes: int = 0  # bytes of voxels written into the pool
    retry: Tensor | None = field(default=None, repr=False)  # (k,) bool, may be requested again


@dataclass(frozen=True, kw_only=True, repr=False)
class Children:
    """The words of k tiles' children, made from a producer's answer."""

    child: Tensor  # (k, n) int32 ABSENT or TERMINAL
    brick: Tensor  # (k, n) int32 ABSENT, EMPTY or CONSTANT
    constants: Mapping[str, Tensor]  # (k, n, c)
    ranges: Mapping[str, Tensor]  # (k, n, 2, c)
    is_alias: Tensor  # (k, n) bool
    alias: Tensor | None  # (k, n, 4) loc of alias targets
    alias_tree: int  # number of their tree


def tiles(cache: Cache, targets: Targets, children: Children) -> Written:
    """Gives nodes their children; see `put_tiles`. The host waits for the outcome."""
    (lru,) = cache.lru[REQUEST_SUBDIVIDE]
    outcome = put_tiles(cache, targets, children, lru.free())
    written = _read_outcome(outcome, targets, lru)
    written.unplaced = max(0, written.unplaced - lru.unused)
    if written.items and children.alias is not None:
        row, child = (children.is_alias & (outcome.slot >= 0)[:, None]).nonzero().unbind(1)
        node, tree = outcome.slot[row] * cache.nodes.nodes_per_tile + child, targets.tree
        goal = children.alias[row, child]
        cache.aliases.add(node, tree.number, tree.loc(node), goal, children.alias_tree)
    return written


class WriteOutcome(NamedTuple):
    """The outcome of writing (k,) targets, on the device."""

    wanted: Tensor  # (k,) bool, which still lacked what was made for them
    slot: Tensor  # (k,) int64 slots that they got, or -1
    counts: Tensor  # (3,) int64 targets that lacked it, targets that got a slot, slots occupied

    @classmethod
    def of(cls, wanted: Tensor, slot: Tensor, owner: Tensor) -> WriteOutcome:
        """Adds the counts; `owner` (s,) is -1 for slots that were free before."""
        placed = slot >= 0
        evicted = placed & (owner[slot.clamp(min=0)] >= 0)
        return cls(wanted, slot, torch.stack((wanted, placed, evicted)).sum(1))


def _read_outcome(outcome: WriteOutcome, targets: Targets, lru: LRU) -> Written:
    """Returns the outcome on the host, which waits for it, and subtracts the slots that were taken
    from `lru.unused`.
    """
    wanted_count, items, evicted = outcome.counts.tolist()
    lru.unused -= items
    unplaced = wanted_count - items
    retry = outcome.wanted & (outcome.slot < 0) if unplaced else None
    stale = len(targets) - wanted_count
    return Written(items=items, evicted=evicted, stale=stale, unplaced=unplaced, retry=retry)


def put_tiles(cache: Cache, targets: Targets, children: Children, free: Tensor) -> WriteOutcome:
    """Gives nodes, index -1 left out, their children: takes at most `free` (1,) tiles, unlinks,
    writes and links them. The host does not wait: every shape follows from that of the targets.
    """
    (lru,), pool, per_tile = cache.lru[REQUEST_SUBDIVIDE], cache.nodes, cache.nodes.nodes_per_tile
    tree, node = targets.tree, targets.node
    wanted = targets.lacking(cache, REQUEST_SUBDIVIDE)
    # Nodes of a late answer may be out of use: those whose own tile is about to be given away get
    # no children.
    front = lru.order[: len(node)].to(torch.int64)
    limit = torch.minimum(wanted.sum(), free)
    leaving = torch.zeros(pool.capacity, dtype=torch.bool, device=node.device)
    leaving[front] = torch.arange(len(front), device=node.device) < limit
    staying = wanted & ~leaving[node.clamp(min=0) // per_tile]
    slot = lru.give(staying, limit)
    outcome = WriteOutcome.of(wanted, slot, pool.parent_t)
    tile_k = slot.to(torch.int32)
    unlink(pool.child_tn, pool.parent_t, pool.shared_t, tile_k)
    orphan(pool.child_tn, pool.parent_t, tile_k)
    orphan(pool.brick_tn, cache.bricks.owner_b, tile_k)
    for stored, values in ((pool.constants, children.constants), (pool.ranges, children.ranges)):
        for name, rows in values.items():
            write_rows(stored[name], slot, rows)
    words = (pool.child_tn, pool.brick_tn, pool.request_tn)
    tile_fields = (pool.loc_t4, pool.parent_t, pool.tree_t, pool.stamp_t, pool.shared_t)
    contents = (children.child.contiguous(), children.brick.contiguous(), node, targets.loc)
    row_index = torch.arange(len(node), device=node.device)
    link_tiles(*words, *tile_fields, *contents, row_index, tile_k, tree.number, cache.frame_1)
    return outcome


def write_rows(pool_rows: Tensor, slot: Tensor, rows: Tensor) -> None:
    """Writes rows (k, ...) into slots (k,) of a pool (s, ...), those of slot -1 left out; a row may
    be shorter than a slot.
    """
    target_bytes, source_bytes = _as_bytes(pool_rows), _as_bytes(rows.to(pool_rows.dtype))
    lacking_bytes = target_bytes.shape[1] - source_bytes.shape[1]
    if lacking_bytes > 0:
        source_bytes = torch.nn.functional.pad(source_bytes, (0, lacking_bytes))
    put_rows(target_bytes, slot, source_bytes)


def _as_bytes(rows: Tensor) -> Tensor:
    """Returns rows (k, ...) as (k, b) uint8."""
    rows = rows.detach().contiguous()
    return rows.view(len(rows), math.prod(rows.shape[1:])).view(torch.uint8)


def bricks(cache: Cache, targets: Targets, data: Voxels | Sequence[Chunk]) -> Written:
    """Gives (k,) nodes their bricks; see `put_bricks`. The host waits for the outcome."""
    first = data if isinstance(data, Mapping) else data[0].data
    coarse = any(cache.bricks.channels[name].coarse for name in first)
    lru = cache.lru[REQUEST_LOAD][coarse]
    outcome = put_bricks(cache, targets, data, lru.free(), coarse)
    written = _read_outcome(outcome, targets, lru)
    written.nbytes = written.items * sum(row_bytes(rows) for rows in first.values())
    return written


def put_bricks(
    cache: Cache,
    targets: Targets,
    data: Voxels | Sequence[Chunk],
    free: Tensor,
    coarse: bool = False,
) -> WriteOutcome:
    """Gives (k,) nodes, index -1 left out, their bricks: takes at most `free` (1,) slots, coarse
    ones if `coarse`, unlinks, writes and links them. `data` is for each channel (k, z, y, x, c), or
    chunks on their way to the device. The host does not wait.
    """
    wanted = targets.lacking(cache, REQUEST_LOAD)
    slot = cache.lru[REQUEST_LOAD][coarse].give(wanted, free)
    outcome = WriteOutcome.of(wanted, slot, cache.bricks.owner_b)
    write_slots(cache, slot, targets.node, data)
    return outcome


def write_slots(cache: Cache, slot: Tensor, node: Tensor, data: Voxels | Sequence[Chunk]) -> None:
    """Writes voxels (see `put_bricks`) into slots (k,), each listed once, -1 left out, in place of
    what they held, and links (k,) int64 nodes to them.
    """
    nodes, pool, slot_k = cache.nodes, cache.bricks, slot.to(torch.int32)
    unlink(nodes.brick_tn, pool.owner_b, pool.shared_b, slot_k)
    with pool.writing():
        if isinstance(data, Mapping):
            device_data = {n: on_device(r, slot.device) for n, r in data.items()}
            _fill_slots(cache, slot, device_data)
            _narrow_ranges(cache, slot, node, device_data)
        else:
            for chunk in data:
                with chunk as arrived:
                    part = slice(chunk.begin, chunk.end)
                    _fill_slots(cache, slot[part], arrived)
                    _narrow_ranges(cache, slot[part], node[part], arrived)
    slots = (pool.owner_b, pool.stamp_b, pool.born_b, pool.shared_b)
    link_bricks(nodes.brick_tn, nodes.request_tn, *slots, node, slot_k, cache.frame_1)


def _fill_slots(cache: Cache, slot: Tensor, data: Mapping[str, Tensor]) -> None:
    """Writes voxels that are on the device."""
    for name, stored in cache.bricks.bricks.items():
        if name in data:
            write_rows(stored, slot, data[name])
        elif not cache.bricks.channels[name].coarse:  # a tree without this channel
            write_rows(stored, slot, stored.new_zeros(1).expand(len(slot), *stored.shape[1:]))


def _narrow_ranges(cache: Cache, slot: Tensor, node: Tensor, data: Mapping[str, Tensor]) -> None:
    """Sets the ranges of nodes (k,) that have no finer level to those of their voxels, borders
    included, because `classify` may have given mere bounds. The voxels are read from the pool:
    `data` may lie in host memory, behind the bus.
    """
    nodes = cache.nodes
    finest = nodes.child_tn.view(-1)[node.clamp(min=0)] == TERMINAL
    index = torch.where(finest & (slot >= 0), node, -1)
    for name, ranges in nodes.ranges.items():
        if name in data and not cache.bricks.channels[name].coarse:
            pool_bricks = cache.bricks.bricks[name].detach()
            rows = movable(pool_bricks).flatten(1)
            word = torch.int64 if row_bytes(pool_bricks) % 8 == 0 else rows.dtype  # fewer to gather
            gathered = rows.view(word)[slot.clamp(min=0)]
            voxels = gathered.view(pool_bricks.dtype).view(len(slot), -1, pool_bricks.shape[-1])
            if voxels.dtype == torch.uint16:  # which torch can't compare
                voxels = voxels.to(torch.int32)
            extremes = torch.stack(torch.aminmax(voxels, dim=1), 1)
            write_rows(ranges.flatten(0, 1), index, extremes)


def uniform(
    cache: Cache, targets: Targets, word: Tensor, constants: Mapping[str, Tensor]
) -> Written:
    """Marks nodes as EMPTY or CONSTANT; see `put_uniform`. The host waits for the outcome."""
    lacking_count = int(put_uniform(cache, targets, word, constants))
    return Written(constant=lacking_count, stale=len(targets) - lacking_count)


def put_uniform(
    cache: Cache, targets: Targets, word: Tensor, constants: Mapping[str, Tensor]
) -> Tensor:
    """Marks (k,) nodes, index -1 left out, as EMPTY or CONSTANT by `word` (k,) int32: they need no
    bricks. `constants` are (k, c) for each channel; 0 for channels that are left out. The host does
    not wait.

    Returns:
        () int64 how many nodes still lacked a brick.
    """
    wanted = targets.lacking(cache, REQUEST_LOAD)
    node, pool = torch.where(wanted, targets.node, -1), cache.nodes
    for name, stored in pool.constants.items():
        flat = stored.flatten(0, 1)
        zeros = flat.new_zeros(1).expand(len(node), flat.shape[1])
        write_rows(flat, node, constants.get(name, zeros))
    link(pool.brick_tn, pool.request_tn, node.to(torch.int32), word, REQUEST_LOAD)
    child = pool.child_tn.view(-1, 1)
    child_word = child[node.clamp(min=0)]
    write_rows(child, node, torch.where(child_word == ABSENT, TERMINAL, child_word))
    return wanted.sum()


def aliases(cache: Cache, targets: Targets, goal: Tensor, goal_tree: int) -> Written:
    """Makes (k,) nodes aliases of the nodes with locs `goal` (k, 4) in tree number `goal_tree`;
    nodes that are gone or served already are left alone.
    """
    wanted = targets.lacking(cache, REQUEST_LOAD)
    chosen, tree = targets[wanted], targets.tree.number
    cache.aliases.add(chosen.node, tree, chosen.loc, goal[wanted], goal_tree)
    return Written(constant=len(chosen), stale=len(targets) - len(chosen))
