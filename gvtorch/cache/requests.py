"""Requests: what rays asked for in one frame. `Listed` is on the device, `Requests` for the host,
once it knows how many there are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ..base.constants import REQUEST_LOAD, REQUEST_PRIORITY, REQUEST_SUBDIVIDE
from ..ops import compact_requests
from ..pool import NodePool

#: Names of the kinds, as statistics show them.
KINDS = {"load": REQUEST_LOAD, "subdivide": REQUEST_SUBDIVIDE}


@dataclass(frozen=True, kw_only=True)
class Requests:
    """Wishes of one kind, one row a node."""

    node: Tensor  # (k,) int64
    depth: Tensor  # (k,) int64 of the node
    priority: Tensor  # (k,) int32 width of one of its voxels on the screen, 1/16 pixel

    def __len__(self) -> int:
        """Number of wishes."""
        return self.node.shape[0]


Wishes = Mapping[int, Requests]  # by kind, REQUEST_LOAD and REQUEST_SUBDIVIDE


@dataclass(frozen=True, kw_only=True)
class Listed:
    """Nodes with a wish, as `ops.compact_requests` leaves them on the device."""

    node: Tensor  # (capacity,) int32 node indices, -1 behind the last
    word: Tensor  # (capacity,) int32 kinds and priority, 0 behind the last
    count: Tensor  # (5,) int64 nodes listed, that could be listed, with a wish; wishes of each kind

    def read(self, nodes: NodePool, wished: Mapping[str, int]) -> dict[int, Requests]:
        """Returns the wishes; nobody waits for the device.

        Args:
            nodes: The pool.
            wished: How many there are of each kind, by name, as the host has got them.
        """
        wishes = {}
        for name, kind in KINDS.items():
            row = torch.nonzero_static((self.word & kind).ne(0), size=wished[name])[:, 0]
            node = self.node[row].to(torch.int64)
            depth = nodes.loc_t4[node // nodes.nodes_per_tile, 3].to(torch.int64)
            priority = self.word[row] & REQUEST_PRIORITY
            wishes[kind] = Requests(node=node, depth=depth, priority=priority)
        return wishes


def collect(nodes: NodePool, capacity: int) -> Listed:
    """Takes the wishes out of a pool's request words; nobody waits for the device.

    Args:
        nodes: The pool; its request words are cleared but for what is pending.
        capacity: Most nodes listed.
    """
    node, word, count = compact_requests(nodes.request_tn, capacity)
    kinds = [(word & kind).ne(0).sum().view(1) for kind in KINDS.values()]
    return Listed(node=node, word=word, count=torch.cat((count, *kinds)))
