"""`DeviceFrame`: a frame of which the host knows nothing: requests chosen, answered and written in
batches of fixed size, rays traced, requests and use collected, all on the device. Every shape is
known beforehand, so that one CUDA graph holds it.

A batch that is not full is padded with the root, whose answers are left out (node index -1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..base.constants import CONSTANT, EMPTY, REQUEST_LOAD, REQUEST_PRIORITY, REQUEST_SUBDIVIDE
from ..base.records import Hits
from ..cache import Cache, RequestList, Scheduler
from ..cache.write import Targets, put_bricks, put_tiles, put_uniform
from ..producers import Region
from ..producers.answer import checked_bricks, checked_regions
from .request_batch import ProducedTree, RequestBatch, children_of
from .stats import Collected

_MOST_LISTED = 1 << 15  # nodes whose requests are sorted
_LAST = 1 << 40  # the rank of what is not asked for


class DeviceFrame:
    """Frames of an engine whose producers all answer on the device (`Producer.on_device`).

    Attributes:
        batch: Most bricks, and most node tiles, that a frame makes for each tree.
    """

    def __init__(
        self, cache: Cache, trees: Sequence[ProducedTree], scheduler: Scheduler, batch: int
    ) -> None:
        """Takes the memory of the requests that a frame leaves to the next one."""
        self.cache, self.trees, self.batch = cache, trees, batch
        self._coarse_first = scheduler.order == "coarse"
        words, device = cache.nodes.request_tn, cache.frame_1.device
        self._most = min(_MOST_LISTED, words.numel())
        self._node, self._word = torch.zeros((2, self._most), dtype=torch.int32, device=device)
        self._unused = torch.zeros(2, dtype=torch.int64, device=device)  # tiles, bricks

    def forget(self) -> None:
        """Leaves no request to the next frame: what it would serve is out of date."""
        self._word.zero_()

    def run(self, trace: Callable[[], Hits]) -> tuple[Hits, Collected]:
        """Serves what the last frame asked for, traces, and collects what is asked for now."""
        served = self.serve()
        self.cache.frame_1.add_(1)
        hits = trace()
        requests = RequestList.collect(self.cache.nodes, self._most)
        use = self.cache.sort_by_use()
        self._node.copy_(requests.node)
        self._word.copy_(requests.word)
        self._unused.copy_(use[0:4:2])
        samples = hits.samples.sum(dtype=torch.int64).view(1)
        return hits, Collected(requests, torch.cat((requests.count, use, samples, served)))

    def serve(self) -> Tensor:
        """Answers the most wanted requests of the last frame.

        Returns:
            (6,) int64 tiles and bricks that were made, nodes that need none, tiles and bricks that
            were replaced, and nodes that failed.
        """
        made = {kind: self._unused.new_zeros(2) for kind in (REQUEST_SUBDIVIDE, REQUEST_LOAD)}
        constant, failed = self._unused.new_zeros(2).split(1)
        for kind, ask in ((REQUEST_LOAD, self._fill), (REQUEST_SUBDIVIDE, self._subdivide)):
            chosen, free = self._choose(kind), self._unused[int(kind == REQUEST_LOAD)].view(1)
            number = self.cache.nodes.tree_t[chosen.clamp(min=0) // self.cache.nodes.nodes_per_tile]
            for source in self.trees:
                node = torch.where(number == source.tree.number, chosen, -1)
                counts, bare, bad = ask(source, node, free)
                made[kind], free = made[kind] + counts, free - counts[:1]
                constant, failed = constant + bare, failed + bad
        tiles, bricks = made.values()
        return torch.cat((tiles[:1], bricks[:1], constant, tiles[1:], bricks[1:], failed))

    def _choose(self, kind: int) -> Tensor:
        """(batch,) int64 nodes that are served first, as `Scheduler.choose` takes them; -1 behind
        the last.
        """
        nodes = self.cache.nodes
        asked = (self._word & kind) != 0
        node = self._node.clamp(min=0).to(torch.int64)
        depth = nodes.loc_t4[node // nodes.nodes_per_tile, 3].to(torch.int64)
        level = depth if self._coarse_first else -depth
        small = REQUEST_PRIORITY - (self._word & REQUEST_PRIORITY).to(torch.int64)
        rank = torch.where(asked, level * (REQUEST_PRIORITY + 1) + small, _LAST)
        row = rank.argsort(stable=True)[: self.batch]
        return torch.where(asked[row], node[row], -1)

    def _fill(
        self, source: ProducedTree, node: Tensor, free: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Loads nodes (k,): how many got bricks and how many of these replaced others (2,), how
        many need none (1,), how many failed (1,).
        """
        batch = self._asked(source, REQUEST_LOAD, node)
        bricks = checked_bricks(batch.ask(), batch.nodes, source.producer, look=False)
        good = _finite([bricks.data, bricks.constants], len(node), node.device)
        data, constant = good, torch.zeros_like(node[:1])
        if bricks.kind is not None:
            data = (bricks.kind == Region.DATA) | (bricks.kind == Region.DATA_MAX_DEPTH)
            bare = (bricks.kind == Region.EMPTY) | (bricks.kind == Region.CONSTANT)
            good, data, bare = good & (data | bare), good & data, good & bare
            word = torch.where(bricks.kind == Region.CONSTANT, CONSTANT, EMPTY).to(torch.int32)
            targets = _only(batch.targets, node, bare)
            constant = put_uniform(self.cache, targets, word, bricks.constants).view(1)
        put = put_bricks(self.cache, _only(batch.targets, node, data), bricks.data, free)
        return put.counts[1:], constant, ((node >= 0) & ~good).sum().view(1)

    def _subdivide(
        self, source: ProducedTree, node: Tensor, free: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Subdivides nodes (k,); see `_fill`."""
        batch = self._asked(source, REQUEST_SUBDIVIDE, node)
        regions = checked_regions(batch.ask(), batch.nodes, source.producer, look=False)
        count = len(regions.kind)
        good = _finite([regions.constants, regions.ranges], count, node.device)
        good = good & (regions.kind >= Region.EMPTY) & (regions.kind <= Region.DATA_MAX_DEPTH)
        good = good.view(len(node), -1).all(1)
        children = children_of(batch, regions, self.cache)
        put = put_tiles(self.cache, _only(batch.targets, node, good), children, free)
        return put.counts[1:], torch.zeros_like(node[:1]), ((node >= 0) & ~good).sum().view(1)

    def _asked(self, source: ProducedTree, kind: int, node: Tensor) -> RequestBatch:
        """What a producer is asked of nodes (k,); the root where the index is -1."""
        there = torch.where(node >= 0, node, source.tree.root)
        return RequestBatch(source, kind, Targets(source.tree, there, source.tree.loc(there)))


def _only(targets: Targets, node: Tensor, which: Tensor) -> Targets:
    """The targets, without the padding and without those that are not among `which` (k,)."""
    return replace(targets, node=torch.where(which, node, -1))


def _finite(answers: Sequence[Mapping[str, Any]], count: int, device: torch.device) -> Tensor:
    """(k,) bool, which items hold neither NaN nor infinite values."""
    good = torch.ones(count, dtype=torch.bool, device=device)
    for by_channel in answers:
        for values in by_channel.values():
            if values.is_floating_point():
                good = good & torch.isfinite(values).flatten(1).all(1)
    return good


def can_serve(trees: Sequence[ProducedTree]) -> bool:
    """Whether all producers answer on the device, and none has coarse channels."""
    return all(
        one.producer.on_device and not any(c.coarse for c in one.producer.channels.values())
        for one in trees
    )
