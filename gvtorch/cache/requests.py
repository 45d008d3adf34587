"""Requests: the nodes that the rays of a frame wanted subdivided or loaded.

Rays write them into the node pool's request words. `RequestList` is what one pass over these words
leaves on the device; `Requests` are its rows of one kind, once the host knows how many there are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ..base.constants import (
    ABSENT,
    REQUEST_LOAD,
    REQUEST_PENDING_SHIFT,
    REQUEST_PRIORITY,
    REQUEST_SUBDIVIDE,
)
from ..ops import compact_requests
from ..pool import NodePool

#: The kinds of request by the names that statistics show.
KINDS = {"load": REQUEST_LOAD, "subdivide": REQUEST_SUBDIVIDE}


@dataclass(frozen=True, kw_only=True, repr=False)
class Requests:
    """Requests of one kind, one row a node."""

    node: Tensor  # (k,) int64
    depth: Tensor  # (k,) int64 of the node
    priority: Tensor  # (k,) int32 width of one of its voxels on the screen, 1/16 pixel

    def __len__(self) -> int:
        """Number of requests."""
        return self.node.shape[0]


#: `Requests` for each of REQUEST_LOAD and REQUEST_SUBDIVIDE.
RequestsByKind = Mapping[int, Requests]


@dataclass(frozen=True, kw_only=True, repr=False)
class RequestList:
    """Nodes with a request, as `ops.compact_requests` leaves them on the device."""

    node: Tensor  # (capacity,) int32 node indices, -1 behind the last
    word: Tensor  # (capacity,) int32 kinds and priority, 0 behind the last
    count: Tensor  # (5,) int64: see `compact_requests`, then requests of each kind

    @classmethod
    def collect(cls, nodes: NodePool, capacity: int) -> RequestList:
        """Takes the requests out of a pool's request words; the host does not wait.

        Args:
            nodes: The pool; its request words are cleared, their pending bits excepted.
            capacity: Most nodes listed.
        """
        node, word, count = compact_requests(nodes.request_tn, capacity)
        kinds = [(word & kind).ne(0).sum().view(1) for kind in KINDS.values()]
        return cls(node=node, word=word, count=torch.cat((count, *kinds)))

    def by_kind(self, nodes: NodePool, counts: Mapping[str, int]) -> dict[int, Requests]:
        """Returns the requests of each kind; the host does not wait.

        Args:
            nodes: The pool.
            counts: How many there are of each kind, by name; the host has read them back.
        """
        requests = {}
        for name, kind in KINDS.items():
            row = torch.nonzero_static((self.word & kind).ne(0), size=counts[name])[:, 0]
            node = self.node[row].to(torch.int64)
            depth = nodes.loc_t4[node // nodes.nodes_per_tile, 3].to(torch.int64)
            priority = self.word[row] & REQUEST_PRIORITY
            requests[kind] = Requests(node=node, depth=depth, priority=priority)
        return requests


def coarser_requests(
    nodes: NodePool, requests: RequestsByKind, room: Mapping[int, int]
) -> RequestsByKind:
    """Asks for coarser bricks where slots are too few for all requests, so that what gets no slot
    is drawn from a near ancestor and not from the root.

    Requests are moved up the tree, the deepest first, until they name at most as many nodes as
    there are slots.

    Args:
        nodes: The node pool.
        requests: All requests of a frame.
        room: For each kind, how many slots may be taken.

    Returns:
        The subdivisions as they are, and loads of the coarser nodes; or all of `requests` where
        those nodes have bricks already.
    """
    most = room[REQUEST_LOAD]
    node, subdivide = requests[REQUEST_LOAD].node, requests[REQUEST_SUBDIVIDE]
    if len(subdivide) > room[REQUEST_SUBDIVIDE]:
        node = torch.cat((node, subdivide.node)).unique()  # too deep for the pool
    while len(node) > most:
        tile = node // nodes.nodes_per_tile
        depth = nodes.loc_t4[tile, 3]
        deepest = depth.max()
        if most == 0 or deepest == 0:
            return requests
        parent = nodes.parent_t[tile].to(torch.int64)
        node = torch.where(depth == deepest, parent, node).unique()
        node = node[node >= 0]  # a shared tile whose owner is gone knows no way up
    words = nodes.brick_tn.view(-1)[node]
    pending = nodes.request_tn.view(-1)[node] & REQUEST_LOAD << REQUEST_PENDING_SHIFT
    node = node[(words == ABSENT) & (pending == 0)]
    if not len(node):
        return requests
    loads = Requests(
        node=node,
        depth=nodes.loc_t4[node // nodes.nodes_per_tile, 3].to(torch.int64),
        priority=torch.zeros_like(node, dtype=torch.int32),
    )
    return {REQUEST_LOAD: loads, REQUEST_SUBDIVIDE: subdivide}
