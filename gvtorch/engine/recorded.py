"""`RecordedFrame`: base of frames that are recorded as CUDA graphs. Requests are chosen and answers
written in batches of fixed size, so that every shape is known beforehand; unused rows hold node -1.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..base.branches import in_branches
from ..base.constants import REQUEST_KINDS, REQUEST_PENDING_SHIFT
from ..base.records import Hits
from ..cache import RequestList
from ..cache.requests import MAX_EXTRA_LEVELS
from ..cache.write import WriteOutcome, write_rows
from ..ops import choose_requests
from ..tracing.pixels import View
from .production import Production
from .stats import COARSER_UNIT, Collected, FrameStats, Readbacks

_MIN_LIST = 1 << 14  # how many nodes' requests are listed, unless a batch holds more
_MAX_WIDENING = 1.2  # largest factor by which cones become wider in a frame
_NARROWING = 0.97  # factor by which they become narrower in a frame, if there is room
_ROOMY_FRACTION = 0.85  # share of a pool: if less is needed, there is room
_MAX_CONE_FACTOR = 64.0  # largest factor by which cones are wider than the camera's


class Chosen(NamedTuple):
    """The nodes that are served first."""

    node: Tensor  # (batch,) int64, -1 after the last
    priority: Tensor  # (batch,) int32 width of one of its voxels on the screen, 1/16 pixel


class SlotCounts(NamedTuple):
    """Counts of tiles or of bricks, each (1,) int64 on the device, part of a longer tensor."""

    unused: Tensor  # slots that may be taken
    made: Tensor  # slots written since the last frame
    evicted: Tensor  # of these, the slots that held something else

    def add(self, outcome: WriteOutcome) -> None:
        _, placed, evicted = outcome.counts
        self.unused.sub_(placed)
        self.made.add_(placed)
        self.evicted.add_(evicted)


class RecordedFrame(ABC):
    """What `DeviceFrame` and `HostFrame` share. A frame calls `begin`; `serve`, if `begin` returned
    true; `draw`; `look_ahead`, while the camera moves; and `finish`.

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
        self._list_capacity = min(max(_MIN_LIST, batch), cache.nodes.request_tn.numel())
        device = cache.frame_1.device
        # Requests of the last picture, and of the look-ahead: nodes and their words.
        self._requests = torch.zeros((2, 2, self._list_capacity), dtype=torch.int32, device=device)
        self._unused_slots = torch.zeros(2, dtype=torch.int64, device=device)  # tiles, bricks
        # Counts since the last frame, from `tiles` to `failed` in the order of `Counts`.
        self._outcomes = self._unused_slots.new_zeros(6)
        made, self._uniform_nodes, evicted, self._failed_nodes = self._outcomes.split((2, 1, 2, 1))
        pairs = (self._unused_slots, made, evicted)  # tiles, bricks
        self._tiles, self._bricks = map(SlotCounts, *(pair.split(1) for pair in pairs))
        self._zero = self._unused_slots.new_zeros(1)
        self._fit = fit
        # Factor by which cones are wider than the camera's, so that a view fits the pools.
        self._cone_factor = torch.ones(1, dtype=torch.float64, device=device)

    @abstractmethod
    def begin(self, stale: bool, steady: bool, stats: FrameStats) -> bool:
        """Returns, before a frame, whether `serve` is to run.

        Args:
            stale: Another frame was rendered since this graph's last one.
            steady: The newest frame that was read back missed nothing, and the last replay did not
                look ahead.
            stats: Of this frame.
        """

    @abstractmethod
    def serve(self) -> None:
        """Writes the bricks and node tiles that earlier frames requested."""

    def take_host_needed(self, readbacks: Readbacks) -> bool:
        """Returns whether `Engine.frame` must render the next frame: because a node failed, which
        it names, or for aliases, whose targets it requests. Resets `host_needed`.
        """
        needed = readbacks.failed or self.host_needed or len(self.cache.aliases) > 0
        self.host_needed = False
        return needed

    def draw(self, view: View, looks_ahead: bool = False) -> Hits:
        """Traces the picture, and lists its requests. `looks_ahead`: `look_ahead` may follow."""
        self.cache.frame_1.add_(1)
        if self._fit:
            view.numbers[:, view.camera.columns.CONE].mul_(self._cone_factor)
        hits = view.hits()
        self._listed, self._looks_ahead = self._list_requests(0), looks_ahead
        if looks_ahead:
            self._requests[1].zero_()
            self._picture_use = self.cache.used()
        return hits

    def look_ahead(self, trace: Callable[[], Hits]) -> None:
        """Traces the look-ahead rays; what they alone request is listed separately."""
        words, node = self.cache.nodes.request_tn.view(-1, 1), self._listed.node.to(torch.int64)
        before = words[node.clamp(min=0)]
        pending_bits = (self._listed.word & REQUEST_KINDS) << REQUEST_PENDING_SHIFT
        write_rows(words, node, before | pending_bits[:, None])  # else these would be listed again
        trace()
        self._list_requests(1)
        write_rows(words, node, before)

    def _list_requests(self, list_index: int) -> RequestList:
        """Lists the requests of the picture (0) or of the look-ahead (1)."""
        listed = RequestList.collect(self.cache, self._list_capacity)
        torch.stack((listed.node, listed.word), out=self._requests[list_index])
        return listed

    def finish(self, hits: Hits) -> Collected:
        """Sorts slots by use and counts; those used are the picture's, without `look_ahead`'s."""
        use, samples = in_branches(
            self.cache.sort_by_use, lambda: hits.samples.sum(dtype=torch.int64).view(1)
        )
        unused, used = use[:4].view(2, 2).unbind(1)  # of tiles and bricks
        ahead_count = self._zero
        self._unused_slots.copy_(unused)
        if self._looks_ahead:
            used.copy_(self._picture_use)
            ahead_count = (self._requests[1, 1] & REQUEST_KINDS).count_nonzero().view(1)
        coarser = (self._cone_factor * COARSER_UNIT).to(torch.int64)
        counts = (self._listed.count, use, samples, self._outcomes)  # in the order of `Counts`
        numbers = torch.cat((*counts, ahead_count, self._count_levels(), coarser))
        if self._fit:
            self._widen_cones(used, self._listed.count)
        self._outcomes.zero_()
        return Collected(self._listed, numbers)

    def to_read_back(self, collected: Collected) -> Collected:
        """Returns what `finish` left, and what the host is to call once it has been read back."""
        return collected

    def _widen_cones(self, used: Tensor, request_counts: Tensor) -> None:
        """Widens the next frame's cones if the pools can't hold what this one used and requested,
        and narrows them again, down to the camera's, if there is room. A surface needs bricks in
        proportion to the inverse square of the cones' width. `used` (2,) counts tiles and bricks,
        `request_counts` is from `compact_requests`: every requested node, pending or not, may need
        a brick.
        """
        tiles_used, bricks_used = used
        _, _, missed_nodes, _, subdivisions = request_counts
        needed_bricks = (bricks_used + missed_nodes) / self.cache.bricks.capacity
        needed_tiles = (tiles_used + subdivisions) / self.cache.nodes.capacity
        needed = torch.stack((needed_bricks, needed_tiles)).amax()
        wider = self._cone_factor * needed.sqrt().clamp(1.0, _MAX_WIDENING)
        narrower = torch.where(needed < _ROOMY_FRACTION, self._cone_factor * _NARROWING, wider)
        self._cone_factor.copy_(narrower.clamp(1.0, _MAX_CONE_FACTOR))

    def _count_levels(self) -> Tensor:
        """Returns `levels_wanted` of the requests; zeros where frames deepen by one level only."""
        return self._zero.expand(1 + MAX_EXTRA_LEVELS)

    def choose(self) -> tuple[Chosen, Chosen]:
        """Returns the loads and the subdivisions to serve first, in the order of
        `Scheduler.choose`: the picture's requests before those of the look-ahead, and at most as
        many as there are unused slots.
        """
        nodes = self.cache.nodes
        node, priority = choose_requests(
            self._requests,
            nodes.loc_t4,
            self._unused_slots,
            nodes.nodes_per_tile,
            self.batch,
            self._production.scheduler.order == "coarse",
        )
        return Chosen(node[0], priority[0]), Chosen(node[1], priority[1])

    def tree_of(self, node: Tensor) -> Tensor:
        """Returns (k,) int32 tree numbers of nodes (k,); any number where the index is -1."""
        nodes = self.cache.nodes
        return nodes.tree_t[node.clamp(min=0) // nodes.nodes_per_tile]
