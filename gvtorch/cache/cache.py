"""`Cache`: a node pool and a brick pool with their orders of use. `write.py` writes into it."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from ..base.branches import in_branches
from ..base.constants import REQUEST_LOAD, REQUEST_PENDING_SHIFT, REQUEST_SUBDIVIDE
from ..ops import lru_partition
from ..pool import BrickPool, NodePool
from .aliases import Aliases


class LRU:
    """The order in which slots of a pool are given away: least recently used first.

    Attributes:
        order: (k,) int32 slots without the locked ones. On CUDA it is changed in place, because
            graphs read it; on the CPU it is a window of a slightly larger tensor, which moves on as
            slots are given.
        unused: How many slots at the front the last picture did not use; these may be taken.
        fresh: How many slots at the front have never held anything. A frame need not look at their
            stamps. 0 on CUDA, where the host does not know how many there are.
    """

    def __init__(self, capacity: int, locked: int, device: torch.device) -> None:
        """Starts with slots `locked` to `capacity`, all free."""
        size, on_host = capacity - locked, device.type == "cpu"
        self._memory = torch.empty(size + size // 512 * on_host, dtype=torch.int32, device=device)
        self.order = torch.arange(locked, capacity, out=self._memory[:size], device=device)
        self.unused = size
        self.fresh = size if on_host else 0

    def sort(self, stamp: Tensor, frame: Tensor) -> Tensor:
        """Moves the slots that `frame` (1,) int32 did not use to the front, each part in its old
        order; `stamp` (capacity,) int32 is the frame that last used each slot.

        Returns:
            (1,) int64 number of unused slots; `unused` is set once the host knows it.
        """
        given_out = self.order[self.fresh :]
        order, unused = lru_partition(given_out, stamp, frame)
        given_out.copy_(order)
        return unused + self.fresh if self.fresh else unused

    def free(self) -> Tensor:
        """Returns `unused` as a (1,) int64 tensor on the device."""
        return torch.full((1,), self.unused, device=self.order.device)

    def give(self, wanted: Tensor, limit: Tensor) -> Tensor:
        """Gives slots from the front, one each, to the first `limit` (1,) of the rows where
        `wanted` (k,) is true, and moves these slots to the back. The host does not wait; once it
        knows their number, the caller subtracts it from `unused`.

        Returns:
            (k,) int64 slots; -1 where a row gets none.
        """
        if not (len(self) and len(wanted)):
            return torch.full_like(wanted, -1, dtype=torch.int64)
        rank = wanted.cumsum(0)
        granted = wanted & (rank <= limit)
        slot = self.order[(rank - 1).clamp(0, len(self) - 1)].to(torch.int64)
        self._roll(torch.minimum(rank[-1:], limit).clamp(min=0))
        return torch.where(granted, slot, -1)

    def _roll(self, count: Tensor) -> None:
        if count.device.type != "cpu":
            source = torch.arange(len(self), device=count.device) + count
            self.order.copy_(self.order[source % len(self)])
            return
        taken, start, memory = int(count), self.order.storage_offset(), self._memory
        self.fresh = max(0, self.fresh - taken)
        end = start + taken + len(self)
        if end <= len(memory):
            memory[end - taken : end] = self.order[:taken]
            self.order = memory[start + taken : end]
        else:  # back to the beginning
            self.order = memory[: len(self)].copy_(self.order.roll(-taken))

    @property
    def nbytes(self) -> int:
        return self._memory.nbytes

    def __len__(self) -> int:
        return len(self.order)

    def __repr__(self) -> str:
        return f"LRU({len(self)} slots, {self.unused} may be taken)"


class Cache:
    """The pools of several trees. The first slots belong to the roots and are never given away.
    Only one thread may use it at a time: that of its engine, or the one that holds `Engine.lock`.

    Attributes:
        nodes, bricks: The pools.
        aliases: Nodes that share the content of others.
        lru: The orders of use of tiles (REQUEST_SUBDIVIDE) and of bricks (REQUEST_LOAD). Bricks
            have one; or, where the pool has coarse slots, one for the others and one for the coarse
            ones.
        finest: (trees,) int64 depth from which on a tree's bricks need no coarse slots; 0: none
            needs one.
        frame_1: (1,) int32 number of the last picture; what is written counts as used in it.
    """

    def __init__(self, nodes: NodePool, bricks: BrickPool, roots: int) -> None:
        """Locks the first `roots` tiles and bricks."""
        self.nodes, self.bricks = nodes, bricks
        self.aliases = Aliases(nodes, bricks)
        bricks.in_order()
        device = nodes.child_tn.device
        self.frame_1 = torch.zeros(1, dtype=torch.int32, device=device)
        loads = [LRU(bricks.capacity, max(roots, bricks.coarse), device)]
        if bricks.coarse:
            loads.append(LRU(bricks.coarse, roots, device))
        self.lru = {REQUEST_SUBDIVIDE: [LRU(nodes.capacity, roots, device)], REQUEST_LOAD: loads}
        self.finest = torch.zeros(roots, dtype=torch.int64, device=device)
        self._no_coarse = torch.zeros(1, dtype=torch.int64, device=device)

    def requests(self) -> Tensor:
        """Returns (t, n) request words of all tiles that ever held something; others are 0."""
        (lru,) = self.lru[REQUEST_SUBDIVIDE]
        return self.nodes.request_tn[: self.nodes.capacity - lru.fresh]

    def memory(self) -> dict[str, int]:
        """Returns bytes by name: content of each pool, and bookkeeping."""
        nodes, bricks = self.nodes, self.bricks
        content = (*nodes.constants.values(), *nodes.ranges.values())
        node_bytes = sum(tensor.nbytes for tensor in (nodes.child_tn, nodes.brick_tn, *content))
        brick_bytes = sum(tensor.nbytes for tensor in bricks.bricks.values())
        order = sum(lru.nbytes for group in self.lru.values() for lru in group)
        rest = nodes.nbytes + bricks.nbytes - node_bytes - brick_bytes + order
        return {"node_pool": node_bytes, "brick_pool": brick_bytes, "bookkeeping": rest}

    def sort_by_use(self) -> Tensor:
        """Orders tiles and bricks by use in the last picture; the host does not wait.

        Returns:
            (5,) int64 tiles unused and used, bricks unused and used, and how many of the unused
            bricks are coarse; once the host knows the unused ones, they are passed to `make_room`.
        """
        frame, stamps = self.frame_1, (self.nodes.stamp_t, self.bricks.stamp_b)
        self.aliases.keep(frame)

        def sort(group: list[LRU], stamp: Tensor) -> list[Tensor]:
            unused, size = [lru.sort(stamp, frame) for lru in group], sum(map(len, group))
            locked = (stamp[: len(stamp) - size] == frame).sum()
            unused_total = unused[0] + unused[1] if len(group) > 1 else unused[0]
            return [unused_total, locked + size - unused_total, *unused[1:]]

        tiles, bricks = in_branches(*map(partial, (sort, sort), self.lru.values(), stamps))
        return torch.cat((*tiles, *bricks, self._no_coarse)[:5])

    def used(self) -> Tensor:
        """Returns (2,) int64 tiles and bricks used in the last picture; the host does not wait."""
        stamps = (self.nodes.stamp_t, self.bricks.stamp_b)
        return torch.stack([(stamp == self.frame_1).sum() for stamp in stamps])

    def make_room(self, tiles: int, bricks: int, coarse: int = 0) -> None:
        """Sets how many slots may be taken: those that the last picture did not use. `coarse` of
        the `bricks` are coarse slots.
        """
        self.lru[REQUEST_SUBDIVIDE][0].unused = tiles
        for lru, unused in zip(self.lru[REQUEST_LOAD], (bricks - coarse, coarse), strict=False):
            lru.unused = unused

    def room(self) -> dict[int, list[int]]:
        """Returns for each kind how many slots of each of its orders of use may be taken."""
        return {kind: [lru.unused for lru in group] for kind, group in self.lru.items()}

    def needs_coarse(self, node: Tensor) -> Tensor | None:
        """Returns which of (k,) nodes need a coarse slot, (k,) bool; None if the pool has none."""
        if not self.bricks.coarse:
            return None
        tile, nodes = node // self.nodes.nodes_per_tile, self.nodes
        return nodes.loc_t4[tile, 3] < self.finest[nodes.tree_t[tile].to(torch.int64)]

    def mark_pending(self, node: Tensor, kind: int, pending: bool | Tensor = True) -> None:
        """Marks (k,) int64 nodes, each listed once, as pending, so that these requests are not
        listed again. A `pending` of False clears the marks, (k,) bool sets those where it is true.
        """
        words, bit = self.nodes.request_tn.view(-1), kind << REQUEST_PENDING_SHIFT
        if isinstance(pending, Tensor):
            words[node] = words[node] | torch.where(pending, bit, 0).to(words.dtype)
        else:
            words[node] = words[node] | bit if pending else words[node] & ~bit

    def validate(self) -> None:
        """Raises ValueError unless orders, owners and pointers agree about every slot.

        Pointers that lead nowhere are found by `N3Tree.validate`. Words of a tile that is linked to
        no tree are ignored: if memory runs out while a tile changes hands, it keeps its old words
        until it is given away again.
        """
        nodes, bricks = self.nodes, self.bricks
        sizes = (nodes.capacity, bricks.capacity)
        for group, capacity in zip(self.lru.values(), sizes, strict=True):
            order = torch.cat([lru.order for lru in group]).sort().values
            slots = torch.arange(capacity - len(order), capacity, device=order.device)
            if not torch.equal(order, slots.to(order)):
                raise ValueError("Cache: the order of use is no permutation of the slots")
        linked = (nodes.parent_t >= 0) | nodes.shared_t
        linked[: len(self.finest)] = True  # the roots
        for label, owner, words, shared in (
            ("brick", bricks.owner_b, nodes.brick_tn, bricks.shared_b),
            ("tile", nodes.parent_t, nodes.child_tn, nodes.shared_t),
        ):
            slot = (owner >= 0).nonzero()[:, 0]
            if bool((words.view(-1)[owner[slot].to(torch.int64)] != slot).any()):
                raise ValueError(f"Cache: a {label}'s owner does not point to it")
            pointers = words[linked]
            pointers = pointers[pointers >= 0].to(torch.int64)
            if bool(((owner[pointers] < 0) & ~shared[pointers]).any()):
                raise ValueError(f"Cache: a pointer leads to a {label} without an owner")

    def __repr__(self) -> str:
        tiles, bricks = self.nodes.capacity, self.bricks.capacity
        return f"Cache({tiles} tiles and {bricks} bricks)"
