"""`DeviceFrame`: recorded frames whose producers answer on the device and are recorded as well, so
that the host takes no part. A batch that is not full is padded with the root, whose answers are
discarded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..base.branches import in_branches
from ..base.constants import ABSENT, REQUEST_LOAD, REQUEST_PRIORITY, REQUEST_SUBDIVIDE
from ..cache.requests import below, levels_wanted
from ..cache.write import Put, Targets, put_bricks, put_rows_of, put_tiles, put_uniform
from ..producers import Region
from ..producers.answer import checked_bricks, checked_regions
from .parents import first_ones, parent_bricks, ready
from .production import Production
from .recorded import RecordedFrame
from .request_batch import ProducedTree, RequestBatch, brick_words, children_of
from .stats import FrameStats, Readbacks


class Unchecked(NamedTuple):
    """A producer's answer to a batch, not checked yet."""

    node: Tensor  # (batch,) int64 nodes that were asked for, -1 for none
    batch: RequestBatch
    given: Any


class DeviceFrame(RecordedFrame):
    """Frames of an engine whose producers all answer on the device (`Producer.on_device`)."""

    def __init__(self, production: Production, batch: int, fit: bool) -> None:
        super().__init__(production, batch, fit)
        # (batch, 2) nodes made last that are to be subdivided in turn, and their priorities.
        self._below = self._unused.new_zeros((batch, 2)) - 1
        self.serve()  # warm-up before recording; there are no requests yet
        self.deepen()

    def begin(self, stale: bool, steady: bool, stats: FrameStats) -> bool:
        """Returns, before a frame, whether the listed requests are to be served. `stale`: another
        frame was rendered since this graph's last one; `steady`: the newest frame that was read
        back missed nothing, and the last replay did not look ahead.
        """
        if stale:
            self._requests.zero_()  # the listed requests are out of date: the rays ask again
        return not steady

    def serve(self) -> None:
        """Serves the requests of the last frame that rank first. Producers fill and classify at the
        same time; their answers are written after that.
        """
        loads, subdivisions = self.choose()
        bricks, regions = in_branches(
            partial(self._answers, REQUEST_LOAD, loads.node),
            partial(self._answers, REQUEST_SUBDIVIDE, subdivisions.node),
        )
        self._load(bricks)
        self._subdivide(regions, *subdivisions)

    def deepen(self) -> None:
        """Subdivides nodes that `serve` or the previous `deepen` has just made, where the priority
        of the parent shows that rays will want finer ones, so that no ray has to ask for them.
        """
        chosen, priority = self._below.unbind(1)
        self._subdivide(self._answers(REQUEST_SUBDIVIDE, chosen), chosen, priority)

    def deeper(self, readbacks: Readbacks) -> int:
        """Returns how many more levels the last readback wanted on average; 0 if `by_level`."""
        return 0 if self._production.by_level else readbacks.deeper

    def _levels(self) -> Tensor:
        word = self._requests[:, 1].flatten()
        wide = torch.where((word & REQUEST_SUBDIVIDE) != 0, word & REQUEST_PRIORITY, -1)
        branching = max(source.layout.branching for source in self.trees)
        return levels_wanted(wide, branching)

    def _answers(self, kind: int, chosen: Tensor) -> list[Unchecked]:
        """Asks each tree's producer for those of the nodes (batch,) that belong to its tree."""
        number, answers = self.tree_of(chosen), []
        for source in self.trees:
            node = torch.where(number == source.tree.number, chosen, -1)
            if kind == REQUEST_LOAD and source.producer.needs_parent:
                node = first_ones(ready(self.cache, node, source.layout.depth))
            batch = self._asked(source, kind, node)
            answers.append(Unchecked(node, batch, batch.ask()))
        return answers

    def _load(self, answers: Sequence[Unchecked]) -> None:
        """Writes bricks."""
        free = self._unused[1:]
        for answer in answers:
            put, bare, failed = self._fill(answer, free)
            free -= put[1:2]
            self._made[1:2] += put[1:2]
            self._made[2:3] += bare
            self._made[4:5] += put[2:]
            self._made[5:] += failed

    def _subdivide(self, answers: Sequence[Unchecked], chosen: Tensor, priority: Tensor) -> None:
        """Subdivides nodes (batch,), and lists the children to subdivide next, in order."""
        free = self._unused[:1]
        slot, wide = torch.full_like(chosen, -1), torch.zeros_like(chosen)
        for answer in answers:
            mine, source = answer.node >= 0, answer.batch.source
            put, failed = self._classify(answer, free)
            free -= put.counts[1:2]
            self._made[:1] += put.counts[1:2]
            self._made[3:4] += put.counts[2:]
            self._made[5:] += failed
            slot = torch.where(mine, put.slot, slot)
            wide = torch.where(mine, priority // source.layout.branching, wide)
        node, split = below(self.cache, slot, wide, free)
        rank = split.flatten().cumsum(0)
        rows = torch.stack((node, wide[:, None].expand_as(node)), 2).flatten(0, 1)
        self._below.fill_(-1)
        taken = split.flatten() & (rank <= self.batch)
        put_rows_of(self._below, torch.where(taken, rank - 1, -1), rows)

    def _fill(self, answer: Unchecked, free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Loads nodes (k,). Returns `Put.counts`, how many need no brick (1,), and failed (1,)."""
        node, batch, given = answer
        bricks = checked_bricks(given, batch.nodes, batch.source.producer, look=False)
        good = _finite([bricks.data, bricks.constants], len(node), node.device)
        data, constant = good, torch.zeros_like(node[:1])
        if bricks.kind is not None:
            data = (bricks.kind == Region.DATA) | (bricks.kind == Region.DATA_MAX_DEPTH)
            word = brick_words(bricks.kind)
            bare = word != ABSENT
            good, data, bare = good & (data | bare), good & data, good & bare
            targets = _only(batch.targets, node, bare)
            constant = put_uniform(self.cache, targets, word, bricks.constants).view(1)
        put = put_bricks(self.cache, _only(batch.targets, node, data), bricks.data, free)
        return put.counts, constant, ((node >= 0) & ~good).sum().view(1)

    def _classify(self, answer: Unchecked, free: Tensor) -> tuple[Put, Tensor]:
        """Subdivides nodes (k,); returns the outcome, and how many failed (1,)."""
        node, batch, given = answer
        regions = checked_regions(given, batch.nodes, batch.source.producer, look=False)
        count = len(regions.kind)
        good = _finite([regions.constants, regions.ranges], count, node.device)
        good = good & (regions.kind >= Region.EMPTY) & (regions.kind <= Region.DATA_MAX_DEPTH)
        good = good.view(len(node), -1).all(1)
        children = children_of(batch, regions, self.cache)
        put = put_tiles(self.cache, _only(batch.targets, node, good), children, free)
        return put, ((node >= 0) & ~good).sum().view(1)

    def _asked(self, source: ProducedTree, kind: int, node: Tensor) -> RequestBatch:
        """Returns the request batch of nodes (k,), with the root where the index is -1."""
        there = torch.where(node >= 0, node, source.tree.root)
        batch = RequestBatch(source, kind, Targets(source.tree, there, source.tree.loc(there)))
        if kind == REQUEST_LOAD and source.producer.needs_parent:
            return replace(batch, parents=parent_bricks(self.cache, source, there))
        return batch


def _only(targets: Targets, node: Tensor, which: Tensor) -> Targets:
    """Returns the targets with node -1 for padding and wherever `which` (k,) is false."""
    return replace(targets, node=torch.where(which, node, -1))


def _finite(answers: Sequence[Mapping[str, Any]], count: int, device: torch.device) -> Tensor:
    """Returns (k,) bool, which items hold neither NaN nor infinite values."""
    good = torch.ones(count, dtype=torch.bool, device=device)
    for by_channel in answers:
        for values in by_channel.values():
            if values.is_floating_point():
                good = good & torch.isfinite(values).flatten(1).all(1)
    return good
