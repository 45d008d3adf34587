"""`DeviceFrame`: recorded frames whose producers answer on the device and are recorded, too; the
host has no part in them. A batch that is not full is padded with the root, whose answers are left
out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..base.constants import CONSTANT, EMPTY, REQUEST_LOAD, REQUEST_SUBDIVIDE
from ..cache import Cache, Scheduler
from ..cache.write import Targets, put_bricks, put_tiles, put_uniform
from ..producers import Region
from ..producers.answer import checked_bricks, checked_regions
from .parents import once, parent_bricks, ready
from .recorded import RecordedFrame
from .request_batch import ProducedTree, RequestBatch, children_of
from .stats import FrameStats


class DeviceFrame(RecordedFrame):
    """Frames of an engine whose producers all answer on the device (`Producer.on_device`)."""

    def __init__(
        self, cache: Cache, trees: Sequence[ProducedTree], scheduler: Scheduler, batch: int
    ) -> None:
        """See `RecordedFrame`."""
        super().__init__(cache, trees, scheduler, batch)
        self.serve()  # loads what is loaded at first use; nothing is asked for

    def begin(self, stale: bool, steady: bool, stats: FrameStats) -> bool:
        """Returns, before a frame, whether its requests are to be served. `stale`: another frame
        was rendered since the last of these; `steady`: the newest that the host knows missed
        nothing.
        """
        if stale:
            self._requests.zero_()  # what would be served is out of date: the rays ask again
        return not steady

    def serve(self) -> None:
        """Answers the most wanted requests of the last frame."""
        made = {kind: self._unused.new_zeros(2) for kind in (REQUEST_SUBDIVIDE, REQUEST_LOAD)}
        constant, failed = self._unused.new_zeros(2).split(1)
        for kind, ask in ((REQUEST_LOAD, self._fill), (REQUEST_SUBDIVIDE, self._subdivide)):
            chosen = self.choose(kind)
            number, free = self.tree_of(chosen), self._unused[int(kind == REQUEST_LOAD)].view(1)
            for source in self.trees:
                node = torch.where(number == source.tree.number, chosen, -1)
                if kind == REQUEST_LOAD and source.producer.needs_parent:
                    node = once(ready(self.cache, node, source.layout.depth))
                counts, bare, bad = ask(source, node, free)
                made[kind], free = made[kind] + counts, free - counts[:1]
                constant, failed = constant + bare, failed + bad
        tiles, bricks = made.values()
        self._made += torch.cat((tiles[:1], bricks[:1], constant, tiles[1:], bricks[1:], failed))

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
        batch = RequestBatch(source, kind, Targets(source.tree, there, source.tree.loc(there)))
        if kind == REQUEST_LOAD and source.producer.needs_parent:
            return replace(batch, parents=parent_bricks(self.cache, source, there))
        return batch


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
