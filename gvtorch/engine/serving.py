"""`Serving`: the requests of a frame are chosen, and producers asked for what was chosen."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from ..base.constants import REQUEST_SUBDIVIDE
from ..base.stage import stage
from ..cache import Cache, RequestList, Scheduler
from ..cache.requests import (
    Requests,
    coarser_requests,
    deeper,
    levels_wanted,
    requests_below,
)
from .production import Production
from .request_batch import ProducedTree
from .stats import Counts, FrameStats


class Serving:
    """Serves requests by `Engine.frame`; frames that are recorded have `RecordedFrame`."""

    def __init__(
        self,
        cache: Cache,
        scheduler: Scheduler,
        production: Production,
        trees: Mapping[str, ProducedTree],
        by_level: bool,
    ) -> None:
        """Keeps what it works with. `by_level`: each level needs its bricks before it is
        subdivided.
        """
        self._cache, self._scheduler, self._production = cache, scheduler, production
        self._trees, self._by_level = trees, by_level

    def serve(self, listed: RequestList, counts: Counts, stats: FrameStats) -> None:
        """Lets slots be taken again, chooses requests, asks the producers, and writes the answers
        that are here at once.
        """
        cache, scheduler = self._cache, self._scheduler
        cache.make_room(counts.tiles_unused, counts.bricks_unused, counts.coarse_unused)
        if not counts.listed:
            return
        with stage("schedule"):
            requests = listed.by_kind(cache, counts.by_kind())
            room = self._production.room()
            nodes, deferred, exceeded = scheduler.choose(requests, room)
            if exceeded:
                coarser = coarser_requests(cache, requests, room)
                nodes, deferred, _ = scheduler.choose(coarser, room)
            stats.deferred += deferred
            stats.capacity_exceeded |= exceeded
        self._produce(nodes, stats)
        if counts.subdivide and not (exceeded or self._by_level):
            self._deepen(requests[REQUEST_SUBDIVIDE], stats)

    def _produce(self, nodes: Mapping[int, Tensor], stats: FrameStats) -> None:
        """Asks the producers for the chosen nodes of each kind, and writes the answers that are
        here at once.
        """
        with stage("produce"):
            answers = self._production.ask([*self._trees.values()], nodes)
        with stage("write"):
            self._production.write(answers, stats)

    def _deepen(self, asked: Requests, stats: FrameStats) -> None:
        """Subdivides what has come of subdivisions, too, where rays will want it, before they ask:
        by as many levels as the subdivisions want in the mean.
        """
        branching = max(source.layout.branching for source in self._trees.values())
        for _ in range(deeper(levels_wanted(asked.priority, branching).tolist())):
            with stage("schedule"):
                requests = requests_below(self._cache, asked, branching)
                asked = requests[REQUEST_SUBDIVIDE]
                nodes = self._scheduler.choose(requests, self._production.room()).nodes
            if not any(map(len, nodes.values())):
                break
            self._produce(nodes, stats)
