"""`RecordedFrame`: base of frames that are recorded as CUDA graphs. Requests are chosen and answers
written in batches of fixed size, so that every shape is known beforehand; unused rows hold node -1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..base.branches import in_branches
from ..base.constants import REQUEST_KINDS, REQUEST_PENDING_SHIFT
from ..base.records import Hits
from ..cache import RequestList
from ..cache.requests import DEEPER
from ..cache.write import put_rows_of
from ..cameras.camera import CONE
from ..ops import choose_requests
from ..tracing.pixels import View
from .production import Production
from .stats import COARSER_UNIT, Collected, Readbacks

_MOST_LISTED = 1 << 14  # most nodes whose requests are listed, unless a batch holds more
_WIDEN, _NARROW = 1.2, 0.97  # most by which a frame widens cones, and by which it narrows them
_WIDEST = 64.0
_ROOMY = 0.85  # share of a pool: if less is used, cones become narrower


class Chosen(NamedTuple):
    """The nodes that are served first."""

    node: Tensor  # (batch,) int64, -1 after the last
    priority: Tensor  # (batch,) int32 width of one of its voxels on the screen, 1/16 pixel


class RecordedFrame:
    """What `DeviceFrame` and `HostFrame` share. A frame is `draw`, then `look` where its camera
    moves, then `finish`.

    Attributes:
        batch: Most bricks, and most node tiles, that are chosen in a frame.
        host_needed: Whether an answer came that only `Engine.frame` can handle.
    """

    host_needed = False

    def __init__(self, production: Production, batch: int, fit: bool) -> None:
        """Allocates what a frame leaves to the next one. `fit`: see `Engine.capture`."""
        self._production, self.batch = production, batch
        self.trees = [*production.trees.values()]
        self.cache = cache = production.cache
        self._most = min(max(_MOST_LISTED, batch), cache.nodes.request_tn.numel())
        device = cache.frame_1.device
        # Requests of the last picture, and of the look-ahead: nodes and their words.
        self._requests = torch.zeros((2, 2, self._most), dtype=torch.int32, device=device)
        self._unused = torch.zeros(2, dtype=torch.int64, device=device)  # tiles, bricks
        # Counts since the last frame: tiles and bricks made, nodes that need none, tiles and bricks
        # replaced, nodes failed.
        self._made = self._unused.new_zeros(6)
        self._none = self._unused.new_zeros(1)
        self._fit = fit
        # Factor by which cones are wider than the camera's, so that a view fits the pools.
        self._coarser = torch.ones(1, dtype=torch.float64, device=device)

    def draw(self, view: View, ahead: bool = False) -> Hits:
        """Traces the picture, and lists its requests. `ahead`: `look` may follow."""
        self.cache.frame_1.add_(1)
        if self._fit:
            view.numbers[:, CONE].mul_(self._coarser)
        hits = view.hits()
        self._seen, self._ahead = self._list(0), ahead
        if ahead:
            self._requests[1].zero_()
            self._used = self.cache.used()
        return hits

    def look(self, trace: Callable[[], Hits]) -> None:
        """Traces the look-ahead rays; what they alone request is listed separately."""
        words, node = self.cache.nodes.request_tn.view(-1, 1), self._seen.node.to(torch.int64)
        before = words[node.clamp(min=0)]
        listed = (self._seen.word & REQUEST_KINDS) << REQUEST_PENDING_SHIFT
        put_rows_of(words, node, before | listed[:, None])  # else these would be listed again
        trace()
        self._list(1)
        put_rows_of(words, node, before)

    def _list(self, which: int) -> RequestList:
        """Lists the requests of the picture (0) or of the look-ahead (1)."""
        listed = RequestList.collect(self.cache, self._most)
        torch.stack((listed.node, listed.word), out=self._requests[which])
        return listed

    def deeper(self, readbacks: Readbacks) -> int:
        """Returns how many times `DeviceFrame.deepen` is to follow `serve`."""
        return 0

    def finish(self, hits: Hits) -> Collected:
        """Sorts slots by use and counts; those used are the picture's, without those of `look`."""
        use, samples = in_branches(
            self.cache.sort_by_use, lambda: hits.samples.sum(dtype=torch.int64).view(1)
        )
        ahead = self._none
        self._unused.copy_(use[0:4:2])
        if self._ahead:
            use[1:4:2] = self._used
            ahead = (self._requests[1, 1] & REQUEST_KINDS).count_nonzero().view(1)
        told = (self._seen.count, use, samples, self._made, ahead, self._levels())
        numbers = torch.cat((*told, (self._coarser * COARSER_UNIT).to(torch.int64)))
        if self._fit:
            self._widen_cones(use, self._seen.count)
        self._made.zero_()
        return Collected(self._seen, numbers)

    def _widen_cones(self, use: Tensor, count: Tensor) -> None:
        """Widens the next frame's cones if the pools can't hold what this one used and requested,
        and narrows them again, down to the camera's, if there is room. A surface needs bricks in
        proportion to the inverse square of the cones' width. `use` is from `Cache.sort_by_use`,
        `count` from `compact_requests`: every requested node, pending or not, may need a brick.
        """
        nodes, bricks = self.cache.nodes.capacity, self.cache.bricks.capacity
        taken = torch.stack(((use[3] + count[2]) / bricks, (use[1] + count[4]) / nodes)).amax()
        wider = self._coarser * torch.where(taken > 1, taken.sqrt().clamp(max=_WIDEN), 1.0)
        narrower = torch.where(taken < _ROOMY, self._coarser * _NARROW, wider)
        self._coarser.copy_(narrower.clamp(1.0, _WIDEST))

    def _levels(self) -> Tensor:
        """Returns `levels_wanted` of the requests; 0 where frames deepen by one level only."""
        return self._none.expand(1 + DEEPER)

    def choose(self) -> tuple[Chosen, Chosen]:
        """Returns the loads and the subdivisions to serve first, in the order of
        `Scheduler.choose`: the picture's requests before those of the look-ahead, and at most as
        many as there are unused slots.
        """
        nodes = self.cache.nodes
        node, priority = choose_requests(
            self._requests,
            nodes.loc_t4,
            self._unused,
            nodes.nodes_per_tile,
            self.batch,
            self._production.scheduler.order == "coarse",
        )
        return Chosen(node[0], priority[0]), Chosen(node[1], priority[1])

    def tree_of(self, node: Tensor) -> Tensor:
        """Returns (k,) int32 tree numbers of nodes (k,); any number where the index is -1."""
        nodes = self.cache.nodes
        return nodes.tree_t[node.clamp(min=0) // nodes.nodes_per_tile]
