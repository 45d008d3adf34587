"""`Cache`: a node pool and a brick pool with their order of use; writes what was produced.

Slots change hands in one order, always: slots are taken from those this frame did not use, every
pointer to them is cleared, the new content is written, the nodes are linked to it. So no pointer
ever leads to a slot that holds something else.
Source: Crassin et al., "GigaVoxels", I3D 2009, section 5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..base.constants import (
    ABSENT,
    REQUEST_LOAD,
    REQUEST_PENDING_SHIFT,
    REQUEST_SUBDIVIDE,
    TERMINAL,
)
from ..base.volume import movable
from ..ops import lacking, link, link_bricks, link_tiles, unlink
from ..pool import BrickPool, N3Tree, NodePool
from ..pool.staging import Part, Voxels, joined, on_device, wide_rows
from .lru import LRU
from .requests import Listed, Requests, Wishes, collect


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


class Cache:
    """Two pools, several trees. The first slots belong to the roots and are never given away.

    Attributes:
        nodes: The node pool.
        bricks: The brick pool.
        lru: For REQUEST_SUBDIVIDE the order of tiles, for REQUEST_LOAD that of bricks.
        frame: Number of the last picture; what is written counts as used in it.
    """

    def __init__(self, nodes: NodePool, bricks: BrickPool, roots: int) -> None:
        """Locks the first `roots` tiles and bricks."""
        self.nodes, self.bricks, self.frame = nodes, bricks, 0
        device = nodes.child_tn.device
        self.lru = {
            REQUEST_SUBDIVIDE: LRU(nodes.capacity, roots, device),
            REQUEST_LOAD: LRU(bricks.capacity, roots, device),
        }

    def memory(self) -> dict[str, int]:
        """Returns bytes: what the pools hold, and the bookkeeping apart."""
        nodes, bricks = self.nodes, self.bricks
        content = (
            *(nodes.child_tn, nodes.brick_tn),
            *(*nodes.constants.values(), *nodes.ranges.values()),
        )
        node_bytes = sum(tensor.nbytes for tensor in content)
        brick_bytes = sum(tensor.nbytes for tensor in bricks.bricks.values())
        order = sum(lru.order.nbytes for lru in self.lru.values())
        return {
            "node_pool": node_bytes,
            "brick_pool": brick_bytes,
            "bookkeeping": nodes.nbytes + bricks.nbytes - node_bytes - brick_bytes + order,
        }

    def requests(self, capacity: int) -> Listed:
        """Takes the frame's wishes out of the node pool."""
        return collect(self.nodes, capacity)

    def sort_by_use(self, frame: Tensor) -> Tensor:
        """Orders tiles and bricks by use in `frame` (1,); nobody waits for the device.

        Returns:
            (4,) int64 tiles unused and used, bricks unused and used; `make_room` is told the unused
            ones, once the host knows them.
        """
        counts = []
        for kind, stamp in (
            (REQUEST_SUBDIVIDE, self.nodes.stamp_t),
            (REQUEST_LOAD, self.bricks.stamp_b),
        ):
            lru = self.lru[kind]
            unused, size = lru.sort(stamp, frame), len(lru.order)
            locked = (stamp[: len(stamp) - size] == frame).sum()
            counts += [unused, locked + size - unused]
        return torch.cat(counts)

    def make_room(self, tiles: int, bricks: int) -> None:
        """Lets as many slots be taken as the last frame did not use."""
        self.lru[REQUEST_SUBDIVIDE].unused, self.lru[REQUEST_LOAD].unused = tiles, bricks

    def room(self) -> dict[int, int]:
        """For each kind, the slots that may be taken."""
        return {kind: lru.unused for kind, lru in self.lru.items()}

    def stand_ins(self, wishes: Wishes, room: dict[int, int]) -> Wishes:
        """Where slots are too few for all wishes: asks for coarser bricks in their place, so that
        what is not served is drawn from a near ancestor and not from the root.

        Wishes are moved up the tree, the deepest first, until there are at most as many nodes as
        slots. Where those nodes have bricks already, the wishes stay as they are.

        Args:
            wishes: All wishes of the frame.
            room: For each kind, how many slots are free to take.

        Returns:
            `wishes`, or their subdivisions and the loads of the coarser nodes.
        """
        nodes, most = self.nodes, room[REQUEST_LOAD]
        node, subdivide = wishes[REQUEST_LOAD].node, wishes[REQUEST_SUBDIVIDE]
        if len(subdivide) > room[REQUEST_SUBDIVIDE]:
            node = torch.cat((node, subdivide.node)).unique()  # too deep for the pool
        while len(node) > most:
            tile = node // nodes.nodes_per_tile
            depth = nodes.loc_t4[tile, 3]
            deepest = depth.max()
            if most == 0 or deepest == 0:
                return wishes
            parent = nodes.parent_t[tile].to(torch.int64)
            node = torch.where(depth == deepest, parent, node).unique()
            node = node[node >= 0]  # a shared tile whose owner is gone knows no way up
        words = nodes.brick_tn.view(-1)[node]
        pending = nodes.request_tn.view(-1)[node] & REQUEST_LOAD << REQUEST_PENDING_SHIFT
        node = node[(words == ABSENT) & (pending == 0)]
        if not len(node):
            return wishes
        coarser = Requests(
            node=node,
            depth=nodes.loc_t4[node // nodes.nodes_per_tile, 3].to(torch.int64),
            priority=torch.zeros_like(node, dtype=torch.int32),
        )
        return {REQUEST_LOAD: coarser, REQUEST_SUBDIVIDE: subdivide}

    def mark_pending(self, node: Tensor, kind: int, pending: bool | Tensor = True) -> None:
        """Marks that answers are on their way: the wishes are not listed again.

        Args:
            node: (k,) int64 nodes, each once.
            kind: REQUEST_LOAD or REQUEST_SUBDIVIDE.
            pending: False clears the marks; a (k,) bool tensor sets those where it is true.
        """
        words, bit = self.nodes.request_tn.view(-1), kind << REQUEST_PENDING_SHIFT
        if isinstance(pending, Tensor):
            words[node] = words[node] | torch.where(pending, bit, 0).to(torch.int32)
        else:
            words[node] = words[node] | bit if pending else words[node] & ~bit

    def wanted(self, tree: N3Tree, node: Tensor, loc: Tensor, kind: int) -> Tensor:
        """(k,) bool: the node still stands for the place, and still lacks what was asked for."""
        pool = self.nodes
        words = pool.brick_tn if kind == REQUEST_LOAD else pool.child_tn
        tiles = pool.loc_t4, pool.parent_t, pool.tree_t, pool.shared_t
        return lacking(words, *tiles, node, loc, tree.number, tree.root, tree.branching)

    def write_tiles(self, tree: N3Tree, node: Tensor, loc: Tensor, children: Children) -> Written:
        """Gives nodes their children.

        Args:
            tree: Whose nodes they are.
            node: (k,) int64 nodes to subdivide, each once.
            loc: (k, 4) their places.
            children: What the (k, n) children hold.
        """
        lru, pool, per_tile = self.lru[REQUEST_SUBDIVIDE], self.nodes, self.nodes.nodes_per_tile
        wanted = self.wanted(tree, node, loc, REQUEST_SUBDIVIDE)
        first = wanted & (wanted.cumsum(0) <= lru.unused)
        tile_k = lru.order[: min(len(node), lru.unused)]
        # An answer that is late may be for nodes that are in no use any more: where their own tile
        # is among those given away, they have to wait.
        leaving = torch.zeros(pool.capacity, dtype=torch.bool, device=node.device)
        leaving[tile_k.to(torch.int64)] = _among_first(tile_k, first.sum())
        fit = first & ~leaving[node // per_tile]
        used = (pool.parent_t[tile_k.to(torch.int64)] >= 0) & _among_first(tile_k, fit.sum())
        counts = torch.stack([rows.sum() for rows in (wanted, first, fit, used)]).tolist()
        lasting, taken, items, evicted = counts
        done = Written(items=items, evicted=evicted)
        done.stale, done.unplaced = len(node) - lasting, lasting - taken
        done.lost = wanted & ~fit if items < lasting else None
        tile_k = lru.take(taken)[:items]
        if not items:
            return done
        fits = _places(fit, items)
        tile = tile_k.to(torch.int64)
        unlink(pool.child_tn, tile_k, pool.capacity)
        unlink(pool.parent_t, tile_k, pool.capacity, per_tile)
        unlink(self.bricks.owner_b, tile_k, pool.capacity, per_tile)

        width = children.child.shape[1]
        for held, values in (
            (pool.constants, children.constants),
            (pool.ranges, children.ranges),
        ):
            for name, tensor in values.items():
                movable(held[name])[tile, :width] = movable(tensor)[fits]
        words = (pool.child_tn, pool.brick_tn, pool.request_tn)
        tiles = (pool.loc_t4, pool.parent_t, pool.tree_t, pool.stamp_t, pool.shared_t)
        made = (children.child.contiguous(), children.brick.contiguous(), node, loc)
        link_tiles(*words, *tiles, *made, fits, tile_k, tree.number, self.frame)
        if children.alias is not None:
            self._share_children(tree, tile, children, fits)
        return done

    def _share_children(self, tree: N3Tree, tile: Tensor, children: Children, fits: Tensor) -> None:
        """Points aliased children to the tiles and bricks of the nodes they are the same as."""
        assert children.alias is not None
        row, child = children.is_alias[fits].nonzero().unbind(1)
        target = tree.find(children.alias[fits][row, child])
        node = tile[row] * self.nodes.nodes_per_tile + child
        known = target >= 0
        self.share(node[known], target[known])

    def share(self, node: Tensor, target: Tensor) -> None:
        """Makes nodes the same as others: they point to the same tile and brick.

        Args:
            node: (k,) int64 nodes that own neither.
            target: (k,) int64 nodes.
        """
        pool = self.nodes
        child, brick = pool.child_tn.view(-1), pool.brick_tn.view(-1)
        child[node], brick[node] = child[target], brick[target]
        for words in (*pool.constants.values(), *pool.ranges.values()):
            flat = movable(words).flatten(0, 1)
            flat[node] = flat[target]
        tiles, slots = child[node], brick[node]
        pool.shared_t[tiles[tiles >= 0].to(torch.int64)] = True
        self.bricks.shared_b[slots[slots >= 0].to(torch.int64)] = True

    def write_bricks(
        self, tree: N3Tree, node: Tensor, loc: Tensor, data: Voxels | Sequence[Part]
    ) -> Written:
        """Gives nodes their bricks.

        Args:
            tree: Whose nodes they are.
            node: (k,) int64 nodes, each once.
            loc: (k, 4) their places.
            data: For each channel (k, z, y, x, c), or what is on its way to the device.
        """
        lru = self.lru[REQUEST_LOAD]
        wanted = self.wanted(tree, node, loc, REQUEST_LOAD)
        slot = lru.order[: min(len(node), lru.unused)].to(torch.int64)
        used = (self.bricks.owner_b[slot] >= 0) & _among_first(slot, wanted.sum())
        lasting, evicted = torch.stack((wanted.sum(), used.sum())).tolist()
        items = min(lasting, lru.unused)
        done = Written(items=items, evicted=evicted)
        done.stale, done.unplaced = len(node) - lasting, lasting - items
        if items < lasting:
            done.lost = wanted & (wanted.cumsum(0) > items)
        if not items:
            return done
        slot_k = lru.take(items)
        if items == len(node):
            done.nbytes = self.put_bricks(slot_k, node, data)
        else:
            fits = _places(wanted, lasting)[:items]
            whole = joined(data, node.device)
            some = {name: movable(rows)[fits].view(rows.dtype) for name, rows in whole.items()}
            done.nbytes = self.put_bricks(slot_k, node[fits], some)
        return done

    def write_uniform(
        self, tree: N3Tree, node: Tensor, loc: Tensor, word: Tensor, constants: Mapping[str, Tensor]
    ) -> Written:
        """Tells nodes that they need no bricks.

        Args:
            tree: Whose nodes they are.
            node: (k,) int64 nodes, each once.
            loc: (k, 4) their places.
            word: (k,) int32 EMPTY or CONSTANT.
            constants: For each channel (k, c); of channels that are left out it is 0.
        """
        wanted = self.wanted(tree, node, loc, REQUEST_LOAD)
        lasting = int(wanted.sum())
        done = Written(constant=lasting, stale=len(node) - lasting)
        if not lasting:
            return done
        rows = _places(wanted, lasting)
        node, word = node[rows], word[rows]
        for name, words in self.nodes.constants.items():
            flat = movable(words).flatten(0, 1)
            if name in constants:
                flat[node] = movable(constants[name])[rows]
            else:
                flat.index_fill_(0, node, 0)
        self._link_bricks(node, word)
        child = self.nodes.child_tn.view(-1)
        below = child[node]
        child[node] = torch.where(below == ABSENT, TERMINAL, below)
        return done

    def share_bricks(self, tree: N3Tree, node: Tensor, loc: Tensor, target: Tensor) -> None:
        """Gives nodes the bricks of others, whatever they are, voxels, EMPTY or CONSTANT.

        Args:
            tree: Whose nodes they are.
            node: (k,) int64 nodes without a brick.
            loc: (k, 4) their places; nodes that are gone or served already are left alone.
            target: (k,) int64 nodes whose bricks they share.
        """
        wanted = self.wanted(tree, node, loc, REQUEST_LOAD)
        node, target = node[wanted], target[wanted]
        word = self.nodes.brick_tn.view(-1)[target]
        self.bricks.shared_b[word[word >= 0].to(torch.int64)] = True
        for words in self.nodes.constants.values():
            flat = movable(words).flatten(0, 1)
            flat[node] = flat[target]
        self._link_bricks(node, word)

    def put_bricks(self, slot_k: Tensor, node: Tensor, data: Voxels | Sequence[Part]) -> int:
        """Writes voxels into slots, which lose what they held, and links nodes to them.

        Args:
            slot_k: (k,) int32 slots, each once.
            node: (k,) int64 nodes.
            data: For each channel (k, z, y, x, c), or what is on its way to the device.

        Returns:
            Bytes moved.
        """
        pool, slot = self.bricks, slot_k.to(torch.int64)
        unlink(self.nodes.brick_tn, slot_k, pool.capacity)
        nbytes = 0
        if isinstance(data, Mapping):
            there = {name: on_device(rows, slot.device) for name, rows in data.items()}
            nbytes += self._fill_slots(slot, there)
        else:
            for part in data:
                with part as landed:
                    nbytes += self._fill_slots(slot[part.begin : part.end], landed)
        words = (self.nodes.brick_tn, self.nodes.request_tn)
        slots = (pool.owner_b, pool.stamp_b, pool.born_b, pool.shared_b)
        link_bricks(*words, *slots, node, slot_k, self.frame)
        return nbytes

    def _fill_slots(self, slot: Tensor, data: Mapping[str, Tensor]) -> int:
        """Writes voxels that are on the device; returns how many bytes they are."""
        for name, bricks in self.bricks.bricks.items():
            if name in data:
                to, rows = wide_rows(bricks, data[name])
                to.index_copy_(0, slot, rows)
            else:
                wide_rows(bricks)[0].index_fill_(0, slot, 0)  # a tree without this channel
        return sum(rows.nbytes for name, rows in data.items() if name in self.bricks.bricks)

    def _link_bricks(self, node: Tensor, word: Tensor) -> None:
        node_k, word_k = node.to(torch.int32), word.to(torch.int32)
        link(self.nodes.brick_tn, self.nodes.request_tn, node_k, word_k, REQUEST_LOAD)

    def validate(self) -> None:
        """Raises ValueError unless every slot is where the order, its owner and all pointers say.

        Pointers that lead nowhere are found by `N3Tree.validate`.
        """
        nodes, bricks = self.nodes, self.bricks
        for kind, capacity in (
            (REQUEST_SUBDIVIDE, nodes.capacity),
            (REQUEST_LOAD, bricks.capacity),
        ):
            order = self.lru[kind].order.sort().values
            locked = capacity - len(order)
            if not torch.equal(order, torch.arange(locked, capacity).to(order)):
                raise ValueError("Cache: the order of use is no permutation of the slots")
        for what, owner, pointer, shared in (
            ("brick", bricks.owner_b, nodes.brick_tn.view(-1), bricks.shared_b),
            ("tile", nodes.parent_t, nodes.child_tn.view(-1), nodes.shared_t),
        ):
            slot = (owner >= 0).nonzero()[:, 0]
            if bool((pointer[owner[slot].to(torch.int64)] != slot).any()):
                raise ValueError(f"Cache: a {what}'s owner does not point to it")
            named = pointer[pointer >= 0].to(torch.int64)
            if bool(((owner[named] < 0) & ~shared[named]).any()):
                raise ValueError(f"Cache: a pointer leads to a {what} that nobody owns")


def _places(keep: Tensor, count: int) -> Tensor:
    """(count,) int64 where `keep` is true; the host knows how often that is."""
    return torch.nonzero_static(keep, size=count)[:, 0]


def _among_first(rows: Tensor, count: Tensor) -> Tensor:
    """(k,) bool: whether a row is one of the first `count`, a number on the device."""
    return torch.arange(len(rows), device=rows.device) < count


@dataclass(frozen=True, kw_only=True)
class Children:
    """The words of k tiles' children, made from a producer's answer."""

    child: Tensor  # (k, n) int32 ABSENT or TERMINAL
    brick: Tensor  # (k, n) int32 ABSENT, EMPTY or CONSTANT
    constants: Mapping[str, Tensor]  # (k, n, c)
    ranges: Mapping[str, Tensor]  # (k, n, 2, c)
    is_alias: Tensor  # (k, n) bool
    alias: Tensor | None  # (k, n, 4) loc
