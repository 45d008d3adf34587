"""`Cache`: a node pool and a brick pool with their order of use and requests.

What is written into the pools, and in which order, is in `write.py`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..base.constants import REQUEST_LOAD, REQUEST_PENDING_SHIFT, REQUEST_SUBDIVIDE
from ..pool import BrickPool, NodePool
from .lru import LRU
from .requests import RequestList


class Cache:
    """The pools of several trees. The first slots belong to the roots and are never given away.

    Attributes:
        nodes: The node pool.
        bricks: The brick pool.
        lru: The order of use of tiles (REQUEST_SUBDIVIDE) and of bricks (REQUEST_LOAD).
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
        words = (nodes.child_tn, nodes.brick_tn)
        content = (*words, *nodes.constants.values(), *nodes.ranges.values())
        node_bytes = sum(tensor.nbytes for tensor in content)
        brick_bytes = sum(tensor.nbytes for tensor in bricks.bricks.values())
        order = sum(lru.order.nbytes for lru in self.lru.values())
        return {
            "node_pool": node_bytes,
            "brick_pool": brick_bytes,
            "bookkeeping": nodes.nbytes + bricks.nbytes - node_bytes - brick_bytes + order,
        }

    def collect_requests(self, capacity: int) -> RequestList:
        """Takes the frame's requests out of the node pool, at most `capacity` nodes."""
        return RequestList.collect(self.nodes, capacity)

    def sort_by_use(self, frame: Tensor) -> Tensor:
        """Orders tiles and bricks by use in `frame` (1,); the host does not wait.

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
        """Sets how many slots may be taken: those that the last picture did not use."""
        self.lru[REQUEST_SUBDIVIDE].unused, self.lru[REQUEST_LOAD].unused = tiles, bricks

    def room(self) -> dict[int, int]:
        """For each kind, how many slots may be taken."""
        return {kind: lru.unused for kind, lru in self.lru.items()}

    def mark_pending(self, node: Tensor, kind: int, pending: bool | Tensor = True) -> None:
        """Marks that answers are on their way: these requests are not listed again.

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
                raise ValueError(f"Cache: a pointer leads to a {what} without an owner")

    def __repr__(self) -> str:
        tiles, bricks = self.nodes.capacity, self.bricks.capacity
        return f"Cache({tiles} tiles and {bricks} bricks, {self.frame} frames)"
