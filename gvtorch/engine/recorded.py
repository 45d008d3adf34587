"""`RecordedFrame`: what frames that are recorded as CUDA graphs share. Requests are chosen and
answers written in batches of fixed size, so that every shape is known beforehand; rows that are not
taken hold node -1.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..base.constants import REQUEST_LOAD, REQUEST_PRIORITY
from ..base.records import Hits
from ..cache import Cache, RequestList, Scheduler
from .request_batch import ProducedTree

_MOST_LISTED = 1 << 14  # nodes whose requests are sorted
_LAST = 1 << 40  # the rank of what is not asked for


class RecordedFrame:
    """What both kinds share.

    Attributes:
        batch: Most bricks, and most node tiles, that are chosen in a frame.
        host_needed: Whether something came that only `Engine.frame` can deal with.
    """

    host_needed = False

    def __init__(
        self, cache: Cache, trees: Sequence[ProducedTree], scheduler: Scheduler, batch: int
    ) -> None:
        """Takes the memory of what a frame leaves to the next one."""
        self.cache, self.trees, self.batch = cache, trees, batch
        self._coarse_first = scheduler.order == "coarse"
        self._most = min(_MOST_LISTED, cache.nodes.request_tn.numel())
        device = cache.frame_1.device
        self._unused = torch.zeros(2, dtype=torch.int64, device=device)  # tiles, bricks
        # Since the last frame: tiles and bricks that were made, nodes that need none, tiles and
        # bricks that were replaced, nodes that failed.
        self._made = self._unused.new_zeros(6)

    def collect(self, hits: Hits) -> tuple[RequestList, Tensor]:
        """Lists requests, brings slots into the order of use, and counts both and the samples."""
        requests = RequestList.collect(self.cache, self._most)
        use = self.cache.sort_by_use()
        self._unused.copy_(use[0:4:2])
        samples = hits.samples.sum(dtype=torch.int64).view(1)
        numbers = torch.cat((requests.count, use, samples, self._made))
        self._made.zero_()
        return requests, numbers

    def choose(self, kind: int, node_k: Tensor, word_k: Tensor) -> Tensor:
        """(batch,) int64 nodes of a list that are served first, as `Scheduler.choose` takes them,
        at most as many as there are slots; -1 behind the last.
        """
        nodes = self.cache.nodes
        asked = (word_k & kind) != 0
        node = node_k.clamp(min=0).to(torch.int64)
        depth = nodes.loc_t4[node // nodes.nodes_per_tile, 3].to(torch.int64)
        level = depth if self._coarse_first else -depth
        small = REQUEST_PRIORITY - (word_k & REQUEST_PRIORITY).to(torch.int64)
        rank = torch.where(asked, level * (REQUEST_PRIORITY + 1) + small, _LAST)
        row = rank.argsort(stable=True)[: self.batch]
        room = self._unused[int(kind == REQUEST_LOAD)]
        served = asked[row] & (torch.arange(len(row), device=row.device) < room)
        return torch.where(served, node[row], -1)

    def tree_of(self, node: Tensor) -> Tensor:
        """(k,) int32 numbers of the trees of nodes (k,); of any where the index is -1."""
        nodes = self.cache.nodes
        return nodes.tree_t[node.clamp(min=0) // nodes.nodes_per_tile]
