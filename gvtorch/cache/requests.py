"""Requests: what rays asked for in one frame. `Listed` is on the device, `Requests` for the host,
once it knows how many there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..config import REQUEST_LOAD, REQUEST_PRIORITY, REQUEST_SUBDIVIDE
from ..ops import compact_requests
from ..pool import NodePool

#: Names of the kinds, as statistics show them.
KINDS = {"load": REQUEST_LOAD, "subdivide": REQUEST_SUBDIVIDE}


@dataclass(frozen=True, kw_only=True)
class Requests:
    """Wishes of one frame, one row a node and kind."""

    node: Tensor  # (k,) int64
    kind: Tensor  # (k,) int32, REQUEST_LOAD or REQUEST_SUBDIVIDE
    depth: Tensor  # (k,) int64 of the node
    priority: Tensor  # (k,) int32 width of one of its voxels on the screen, 1/16 pixel
    misses: int  # nodes with a wish, those that are pending counted too
    overflow: int  # nodes with a wish for which the list had no place

    def __len__(self) -> int:
        """Number of wishes."""
        return self.node.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Requests:
        """Some of the wishes."""
        rows = {n: getattr(self, n)[index] for n in ("node", "kind", "depth", "priority")}
        return Requests(**rows, misses=self.misses, overflow=self.overflow)


@dataclass(frozen=True, kw_only=True)
class Listed:
    """Nodes with a wish, as `ops.compact_requests` leaves them on the device."""

    node: Tensor  # (capacity,) int32 node indices, -1 behind the last
    word: Tensor  # (capacity,) int32 kinds and priority, 0 behind the last
    count: Tensor  # (5,) int64 nodes listed, that could be listed, with a wish; wishes of each kind

    def read(self, nodes: NodePool, count: Sequence[int]) -> Requests:
        """Returns the wishes, given the pool and the (5,) counts as the host has got them."""
        kept, found, misses, *_ = count
        node, word = self.node[:kept].to(torch.int64), self.word[:kept]
        rows = [(word & kind).nonzero()[:, 0] for kind in KINDS.values()]
        which = torch.cat(rows)
        kind = torch.cat(
            [
                torch.full_like(row, k, dtype=torch.int32)
                for row, k in zip(rows, KINDS.values(), strict=True)
            ]
        )
        node = node[which]
        return Requests(
            node=node,
            kind=kind,
            depth=nodes.loc_t4[node // nodes.nodes_per_tile, 3].to(torch.int64),
            priority=word[which] & REQUEST_PRIORITY,
            misses=misses,
            overflow=found - kept,
        )


def collect(nodes: NodePool, capacity: int) -> Listed:
    """Takes the wishes out of a pool's request words; nobody waits for the device.

    Args:
        nodes: The pool; its request words are cleared but for what is pending.
        capacity: Most nodes listed.
    """
    node, word, count = compact_requests(nodes.request_tn, capacity)
    kinds = [(word & kind).ne(0).sum().view(1) for kind in KINDS.values()]
    return Listed(node=node, word=word, count=torch.cat((count, *kinds)))
