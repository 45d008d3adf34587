"""Requests, the nodes that the rays of a frame wanted subdivided or loaded, and which are served.

Rays write them into the node pool's request words. One pass over these words leaves a `RequestList`
on the device; `Requests` are its rows of one kind, once the host knows their number; and
`Scheduler` chooses among these by priority and within budgets, one of which is time (`CallCost`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

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
from .cache import Cache

#: The kinds of request by the names that statistics show.
KINDS = {"load": REQUEST_LOAD, "subdivide": REQUEST_SUBDIVIDE}
#: Most levels beyond the first by which a tree deepens in a frame.
MAX_EXTRA_LEVELS = 2
_PIXEL_PRIORITY = 16  # of a node whose voxels are a pixel wide: wider ones are to be subdivided
_NEWEST_WEIGHT = 0.3  # of the newest call
_MIN_SPREAD = 0.1  # relative spread of batch sizes from which both parts of a cost are fitted
_PROBE_FACTOR = 1.25  # times as many items are tried if all sizes were alike
_MIN_ITEM_FRACTION = 0.02  # least share of a call's time that is attributed to its items
_MIN_LEARNED_ITEMS = 64  # items: the time of smaller batches is more overhead than throughput


@dataclass(frozen=True, kw_only=True, repr=False)
class Requests:
    """Requests of one kind, one row per node."""

    node: Tensor  # (k,) int64
    depth: Tensor  # (k,) int64 of the node
    priority: Tensor  # (k,) int32 width of one of its voxels on the screen, 1/16 pixel
    coarse: Tensor | None = None  # (k,) bool, whether it needs a coarse slot; None: none does

    @classmethod
    def of(cls, cache: Cache, kind: int, node: Tensor, priority: Tensor) -> Requests:
        """Returns requests of (k,) nodes of a cache."""
        nodes = cache.nodes
        depth = nodes.loc_t4[node // nodes.nodes_per_tile, 3].to(torch.int64)
        coarse = cache.needs_coarse(node) if kind == REQUEST_LOAD else None
        return cls(node=node, depth=depth, priority=priority, coarse=coarse)

    def __len__(self) -> int:
        return self.node.shape[0]

    def fitting(self, rank: Tensor, room: Sequence[int]) -> Tensor:
        """Returns those rows of `rank` (k,), the most wanted first, that find a slot; `room` is the
        number of slots that are not coarse, and of those that are.
        """
        if self.coarse is None:
            return rank[: sum(room)]
        coarse = self.coarse[rank]
        fits_fine, fits_coarse = (
            mask & (mask.cumsum(0) <= n) for mask, n in zip((~coarse, coarse), room, strict=True)
        )
        return rank[fits_fine | fits_coarse]


def levels_wanted(priority: Tensor, branching: int) -> Tensor:
    """Counts requests to subdivide, whose priorities are (k,), -1 where there is none. Returns
    (MAX_EXTRA_LEVELS + 1,) int64: all; those that want at least one more level; at least two. See
    `extra_levels`.
    """
    widths = [0, *(_PIXEL_PRIORITY * branching**level for level in range(1, MAX_EXTRA_LEVELS + 1))]
    return torch.stack([priority >= width for width in widths]).sum(1)


def extra_levels(wanted: Sequence[int]) -> int:
    """Returns by how many levels beyond the first a frame deepens a tree: the mean of what its
    subdivisions want. `wanted` is from `levels_wanted`.
    """
    count, *more = wanted
    return round(sum(more) / max(1, count))


def nodes_to_subdivide(
    cache: Cache, tile: Tensor, priority: Tensor, free: Tensor | int
) -> tuple[Tensor, Tensor]:
    """Chooses nodes of tiles (k,), -1 for none, that rays will want subdivided: those that hold
    data and, by the `priority` (k,) of their tile, have voxels wider than a pixel. Chooses none if
    they would take more than half of the `free` tiles: scarce room is left to what rays request.

    Returns:
        (k, n) int64 nodes, and (k, n) bool, which of them are chosen.
    """
    pool, valid_tile = cache.nodes, tile.clamp(min=0)
    child = torch.arange(pool.nodes_per_tile, device=tile.device)
    wide = (tile >= 0) & (priority >= _PIXEL_PRIORITY)
    node = valid_tile[:, None] * pool.nodes_per_tile + child
    split = wide[:, None] & (pool.child_tn[valid_tile] == ABSENT)
    return node, split & (2 * split.sum() <= free)


#: `Requests` for each of REQUEST_LOAD and REQUEST_SUBDIVIDE.
RequestsByKind = Mapping[int, Requests]


@dataclass(frozen=True, kw_only=True, repr=False)
class RequestList:
    """Nodes with a request, as `ops.compact_requests` leaves them on the device."""

    node: Tensor  # (capacity,) int32 node indices, -1 after the last
    word: Tensor  # (capacity,) int32 kinds and priority, 0 after the last
    count: Tensor  # (5,) int64: see `compact_requests`

    @classmethod
    def collect(cls, cache: Cache, capacity: int) -> RequestList:
        """Lists the requests of at most `capacity` nodes and clears the pool's request words,
        except their pending bits; the host does not wait.
        """
        node, word, count = compact_requests(cache.requests(), capacity)
        return cls(node=node, word=word, count=count)

    def by_kind(self, cache: Cache, counts: Mapping[str, int]) -> dict[int, Requests]:
        """Returns the requests of each kind, with aliases replaced by their targets. `counts` are
        the numbers of requests by the name of their kind, already on the host, so that it waits
        only if there are aliases.
        """
        requests, words = {}, self.word[: sum(counts.values())]  # or fewer: a node may request both
        for name, kind in KINDS.items():
            row = torch.nonzero_static((words & kind).ne(0), size=counts[name])[:, 0]
            node, priority = self.node[row].to(torch.int64), self.word[row] & REQUEST_PRIORITY
            requests[kind] = node, priority
        return _requests_of_targets(cache, requests)


def requests_below(cache: Cache, subdivisions: Requests, branching: int) -> RequestsByKind:
    """Returns subdivisions of the nodes that `subdivisions` (k,) have just made, where rays will
    want them; see `nodes_to_subdivide`. There are no loads.
    """
    tile = cache.nodes.child_tn.view(-1)[subdivisions.node].to(torch.int64)
    priority = subdivisions.priority // branching
    free = sum(lru.unused for lru in cache.lru[REQUEST_SUBDIVIDE])
    node, split = nodes_to_subdivide(cache, tile, priority, free)
    node, priority = node[split], priority[:, None].expand_as(split)[split]
    requests = {REQUEST_LOAD: (node[:0], priority[:0]), REQUEST_SUBDIVIDE: (node, priority)}
    return _requests_of_targets(cache, requests)


def _requests_of_targets(
    cache: Cache, requests: dict[int, tuple[Tensor, Tensor]]
) -> dict[int, Requests]:
    """Returns requests of nodes (k,), given with priorities by kind; targets replace aliases."""
    requests = cache.aliases.by_target(requests) if len(cache.aliases) else requests
    return {kind: Requests.of(cache, kind, *rows) for kind, rows in requests.items()}


def coarser_requests(
    cache: Cache, requests: RequestsByKind, room: Mapping[int, Sequence[int]]
) -> RequestsByKind:
    """Replaces requests by coarser ones where slots are too few for all, so that what gets no slot
    is drawn from a near ancestor and not from the root.

    All requests of a frame are moved up the tree, the deepest first, until they name at most as
    many nodes as there are slots; `room` is from `Cache.room`.

    Returns:
        The subdivisions as they are, and loads of the coarser nodes; or `requests` unchanged if
        there are no slots, or if none of those nodes is left to load.
    """
    nodes, load_room = cache.nodes, room[REQUEST_LOAD]
    node, subdivide = requests[REQUEST_LOAD].node, requests[REQUEST_SUBDIVIDE]
    if len(subdivide) > sum(room[REQUEST_SUBDIVIDE]):
        node = torch.cat((node, subdivide.node)).unique()  # no room for their children: load these
    while bool((crowded := _crowded(cache, node, load_room)).any()):
        tile = node // nodes.nodes_per_tile
        depth = torch.where(crowded, nodes.loc_t4[tile, 3], 0)
        deepest = depth.max()
        if sum(load_room) == 0 or deepest == 0:
            return requests
        parent = nodes.parent_t[tile].to(torch.int64)
        node = torch.where(depth == deepest, parent, node).unique()
        node = node[node >= 0]  # a shared tile without its owner has no known parent
    words = nodes.brick_tn.view(-1)[node]
    pending = nodes.request_tn.view(-1)[node] & REQUEST_LOAD << REQUEST_PENDING_SHIFT
    node = node[(words == ABSENT) & (pending == 0)]
    if not len(node):
        return requests
    loads = Requests.of(cache, REQUEST_LOAD, node, torch.zeros_like(node, dtype=torch.int32))
    return {REQUEST_LOAD: loads, REQUEST_SUBDIVIDE: subdivide}


def _crowded(cache: Cache, node: Tensor, room: Sequence[int]) -> Tensor:
    """Returns (k,) bool, for which nodes there are too few slots of the kind that they need."""
    coarse = cache.needs_coarse(node)
    if coarse is None:
        return torch.full_like(node, len(node) > sum(room), dtype=torch.bool)
    is_crowded = [mask.sum() > n for mask, n in zip((~coarse, coarse), room, strict=True)]
    return torch.where(coarse, is_crowded[1], is_crowded[0])


class CallCost:
    """Running estimate of the time of a producer call with n items as a line, overhead + n *
    per_item, fitted to the last calls; older ones weigh less. The first call, which may include
    one-time work, is dropped at the second.

    Attributes:
        largest: About the largest number of items in recent calls.
    """

    def __init__(self) -> None:
        self.largest, self._calls = 0.0, 0
        self._sums = [0.0] * 5  # of weights; and of items, time, items^2, items * time, by weight

    def learn(self, items: int, milliseconds: float) -> None:
        """Adds one call to the running estimate."""
        self._calls += 1
        if self._calls == 2:
            self._sums = [0.0] * 5
        new = (1, items, milliseconds, items * items, items * milliseconds)
        self._sums = [a + _NEWEST_WEIGHT * (b - a) for a, b in zip(self._sums, new, strict=True)]
        self.largest = max(float(items), (1 - _NEWEST_WEIGHT) * self.largest)

    def fitting(self, milliseconds: float, default: int) -> int:
        """Returns how many items fit into a call of this duration, at least 1, and at most twice as
        many as were tried lately; `default` if there was no call yet.

        If the overhead of a call takes most of that time, items still get half of it, because many
        small calls would take longer. If all calls had about the same number of items, a few more
        are tried: the line cannot be fitted otherwise.
        """
        weight, items, *_ = self._sums
        if not weight:
            return default
        overhead, per_item, is_fitted = self._fitted_line()
        fitting = max(1.0, max(milliseconds - overhead, 0.5 * milliseconds) / per_item)
        mean = items / weight
        if not is_fitted and abs(fitting - mean) <= _MIN_SPREAD * mean:
            fitting = max(fitting + 1, _PROBE_FACTOR * fitting)
        return int(min(fitting, max(2 * self.largest, 2.0)))

    def _fitted_line(self) -> tuple[float, float, bool]:
        """Returns the time of a call itself and of each item, and whether both could be fitted."""
        weight, *sums = self._sums
        items, time, squares, products = (value / weight for value in sums)
        spread = squares - items * items
        is_fitted = spread > (_MIN_SPREAD * items) ** 2
        max_per_item = time / items
        if not is_fitted:
            return 0.0, max_per_item, is_fitted
        slope = (products - items * time) / spread
        per_item = min(max(slope, _MIN_ITEM_FRACTION * max_per_item), max_per_item)
        return time - per_item * items, per_item, is_fitted


class Choice(NamedTuple):
    """Which requests are served."""

    nodes: dict[int, Tensor]  # for each kind (k,) int64, most wanted first
    deferred: int  # requests that the budgets put off
    exceeded: bool  # whether slots were too few


class Scheduler:
    """Orders requests and trims them to budgets.

    Attributes:
        most: For each kind, most items in a frame.
        cost: For each kind, the time of production, as learned so far.
        spent: For each kind, items already asked for in this frame; they count against its budget.
    """

    def __init__(
        self,
        *,
        order: Literal["coarse", "fine"] = "coarse",
        loads: int = 4096,
        subdivisions: int = 4096,
        milliseconds: float | None = None,
    ) -> None:
        """Sets the budgets of a frame.

        Args:
            order: Coarse levels first, which shows something everywhere soon, or fine ones; then
                by size on the screen.
            loads: Most bricks in a frame.
            subdivisions: Most node tiles in a frame.
            milliseconds: Most time in a frame for production, shared by both kinds; None: no limit.
        """
        self.order, self.milliseconds = order, milliseconds
        self.most = {REQUEST_LOAD: loads, REQUEST_SUBDIVIDE: subdivisions}
        self.cost = {kind: CallCost() for kind in self.most}
        self._budget = dict(self.most)
        self.begin()

    def begin(self) -> None:
        """Starts a frame, with full budgets."""
        self.spent = dict.fromkeys(self.most, 0)

    def choose(self, requests: RequestsByKind, room: Mapping[int, Sequence[int]]) -> Choice:
        """Returns which of a frame's requests are served; `room` is for each kind how many slots
        may be taken, coarse ones separately: see `Cache.room`.
        """
        nodes: dict[int, Tensor] = {}
        deferred, exceeded = 0, False
        for kind, limit in self.most.items():
            candidates = requests[kind]
            self._budget[kind] = min(limit, self._items_in_time(kind))
            budget = max(0, self._budget[kind] - self.spent[kind])
            fitting = candidates.fitting(self._rank(candidates), room[kind])
            deferred += max(0, len(fitting) - budget)
            exceeded |= len(candidates) > len(fitting)
            nodes[kind] = candidates.node[fitting[:budget]]
        return Choice(nodes, deferred, exceeded)

    def learn(self, kind: int, items: int, milliseconds: float) -> None:
        """Learns from a batch that took `milliseconds`. Small ones are ignored as mostly overhead,
        unless the budget itself made them small.
        """
        if items >= min(_MIN_LEARNED_ITEMS, self._budget[kind]) and milliseconds > 0:
            self.cost[kind].learn(items, milliseconds)

    def _rank(self, requests: Requests) -> Tensor:
        """Returns (k,) int64 rows by level, then size on the screen, then node: a fixed order."""
        level = requests.depth if self.order == "coarse" else -requests.depth
        small = REQUEST_PRIORITY - requests.priority.to(torch.int64)
        return (level * (REQUEST_PRIORITY + 1) + small).argsort(stable=True)

    def _items_in_time(self, kind: int) -> int:
        """Returns how many items fit into half of the time budget."""
        if self.milliseconds is None:
            return self.most[kind]
        return self.cost[kind].fitting(0.5 * self.milliseconds, _MIN_LEARNED_ITEMS)

    def __repr__(self) -> str:
        loads, tiles = self.most[REQUEST_LOAD], self.most[REQUEST_SUBDIVIDE]
        time = "" if self.milliseconds is None else f", {self.milliseconds:g} ms"
        return f"Scheduler({self.order} first, at most {loads} bricks, {tiles} tiles{time} a frame)"
