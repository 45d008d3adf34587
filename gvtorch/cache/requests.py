"""Requests: what rays asked for in one frame, as a list."""

from __future__ import annotations

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


def collect(nodes: NodePool, capacity: int) -> Requests:
    """Takes the wishes out of a pool's request words.

    Args:
        nodes: The pool; its request words are cleared but for what is pending.
        capacity: Most nodes listed.
    """
    node_k, word_k, count = compact_requests(nodes.request_tn, capacity)
    kept, found, misses = count.tolist()
    node, word = node_k[:kept].to(torch.int64), word_k[:kept]
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
