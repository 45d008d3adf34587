"""`DeviceFrame` and `HostFrame`: frames that are recorded as one CUDA graph. Requests are chosen
and answers written in batches of fixed size, so that every shape is known beforehand.

Producers on the device are recorded as well, and the host has no part in a frame. Those on the host
get a frame's list with its counts, answer while the device goes on, and the frame after writes what
has come; the host waits for nothing. Rows that are not taken hold node -1.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..base.constants import (
    CONSTANT,
    EMPTY,
    REQUEST_LOAD,
    REQUEST_PENDING_SHIFT,
    REQUEST_PRIORITY,
    REQUEST_SUBDIVIDE,
)
from ..base.records import Hits
from ..cache import KINDS, Cache, RequestList, Scheduler
from ..cache.write import Put, Targets, put_bricks, put_rows_of, put_tiles, put_uniform
from ..pool.staging import Shipment, upload
from ..producers import Bricks, Region, Regions
from ..producers.answer import checked_bricks, checked_regions
from .production import Production
from .request_batch import ProducedTree, RequestBatch, by_kind, children_of, shipped
from .stats import Collected, FrameStats

_MOST_LISTED = 1 << 15  # nodes whose requests are sorted
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

    def collect(self, hits: Hits) -> tuple[RequestList, Tensor]:
        """Lists requests, brings slots into the order of use, and counts both and the samples."""
        requests = RequestList.collect(self.cache.nodes, self._most)
        use = self.cache.sort_by_use()
        self._unused.copy_(use[0:4:2])
        samples = hits.samples.sum(dtype=torch.int64).view(1)
        return requests, torch.cat((requests.count, use, samples))

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


class DeviceFrame(RecordedFrame):
    """Frames of an engine whose producers all answer on the device (`Producer.on_device`)."""

    def __init__(
        self, cache: Cache, trees: Sequence[ProducedTree], scheduler: Scheduler, batch: int
    ) -> None:
        """See `RecordedFrame`."""
        super().__init__(cache, trees, scheduler, batch)
        self._requests = torch.zeros((2, self._most), dtype=torch.int32, device=self._unused.device)
        self.serve()  # loads what is loaded at first use; nothing is asked for

    def begin(self, stale: bool, stats: FrameStats) -> None:
        """Is called before a frame; `stale`: another one was rendered since the last of these."""
        if stale:
            self._requests.zero_()  # what would be served is out of date: the rays ask again

    def run(self, trace: Callable[[], Hits]) -> tuple[Hits, Collected]:
        """Serves what the last frame asked for, traces, and collects what is asked for now."""
        served = self.serve()
        self.cache.frame_1.add_(1)
        hits = trace()
        requests, numbers = self.collect(hits)
        self._requests.copy_(torch.stack((requests.node, requests.word)))
        return hits, Collected(requests, torch.cat((numbers, served)))

    def serve(self) -> Tensor:
        """Answers the most wanted requests of the last frame.

        Returns:
            (6,) int64 tiles and bricks that were made, nodes that need none, tiles and bricks that
            were replaced, and nodes that failed.
        """
        made = {kind: self._unused.new_zeros(2) for kind in (REQUEST_SUBDIVIDE, REQUEST_LOAD)}
        constant, failed = self._unused.new_zeros(2).split(1)
        for kind, ask in ((REQUEST_LOAD, self._fill), (REQUEST_SUBDIVIDE, self._subdivide)):
            chosen = self.choose(kind, *self._requests)
            number, free = self.tree_of(chosen), self._unused[int(kind == REQUEST_LOAD)].view(1)
            for source in self.trees:
                node = torch.where(number == source.tree.number, chosen, -1)
                counts, bare, bad = ask(source, node, free)
                made[kind], free = made[kind] + counts, free - counts[:1]
                constant, failed = constant + bare, failed + bad
        tiles, bricks = made.values()
        return torch.cat((tiles[:1], bricks[:1], constant, tiles[1:], bricks[1:], failed))

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


class HostFrame(RecordedFrame):
    """Frames of an engine whose producers all answer from the host (`Producer.on_host`)."""

    def __init__(
        self,
        cache: Cache,
        trees: Sequence[ProducedTree],
        scheduler: Scheduler,
        batch: int,
        production: Production,
    ) -> None:
        """See `RecordedFrame`; `production` asks, and knows what is on its way."""
        super().__init__(cache, trees, scheduler, batch)
        self._production = production
        self._made = self._unused.new_zeros(6)  # since the last frame: see `DeviceFrame.serve`

    def begin(self, stale: bool, stats: FrameStats) -> None:
        """Writes what has come, before a frame; `stale`: another one was rendered since the last
        of these, which tells no more which slots are unused.
        """
        if stale:
            self._unused.zero_()
        queue = deque(self._production.late())
        while queue:
            batch, answer = queue.popleft()
            if isinstance(answer, Regions):
                self._write_tiles(batch, answer)
            elif isinstance(answer, Shipment):
                sent = self._production.hold_rest(batch, answer)
                self._write_bricks(sent, answer.chunks)
            else:
                for kind, part in by_kind(batch, answer).items():
                    self._write(kind, *part)
        stats.pending = sum(self._production.pending.values())
        stats.failed = len(self._production.failures)

    def run(self, trace: Callable[[], Hits]) -> tuple[Hits, Collected]:
        """Traces, collects, and chooses what the host is asked for; marks it as pending."""
        self.cache.frame_1.add_(1)
        hits = trace()
        requests, numbers = self.collect(hits)
        chosen, words = [], self.cache.nodes.request_tn.view(-1)
        for kind in KINDS.values():
            node = self.choose(kind, requests.node, requests.word)
            marked = words[node.clamp(min=0)] | kind << REQUEST_PENDING_SHIFT
            put_rows_of(words[:, None], node, marked[:, None])
            number = self.tree_of(node)
            loc = self.trees[0].tree.loc(node)
            for source in self.trees[1:]:  # N may differ
                mine = (number == source.tree.number)[:, None]
                loc = torch.where(mine, source.tree.loc(node), loc)
            chosen.append(torch.cat((node[:, None], number[:, None].to(torch.int64), loc), 1))
        asked = torch.stack(chosen).flatten()
        numbers = torch.cat((numbers, self._made, asked))
        self._made.zero_()
        return hits, Collected(requests, numbers, self._ask)

    def _ask(self, asked: Tensor) -> int:
        """Asks producers for the nodes that a frame chose: (2 * batch * 6,) int64 on the host, of
        each kind rows of node, tree and place.
        """
        total = 0
        for kind, listed in zip(KINDS.values(), asked.view(2, -1, 6), strict=True):
            rows = listed[listed[:, 0] >= 0]
            total += len(rows)
            for source in self.trees:
                mine = rows[rows[:, 1] == source.tree.number]
                if len(mine):
                    targets = Targets(source.tree, mine[:, 0].clone(), mine[:, 2:].clone())
                    batch = RequestBatch(source, kind, targets, on_host=True)
                    self._production.ask_ahead(batch)
        return total

    def _write(self, kind: Region, batch: RequestBatch, answer: Bricks) -> None:
        """Writes bricks of one kind."""
        if kind is Region.ALIAS:
            self._leave_to_host(batch)
        elif kind is Region.EMPTY:
            device = self._unused.device
            assert answer.kind is not None
            word = torch.where(answer.kind == Region.CONSTANT, CONSTANT, EMPTY).to(torch.int32)
            constants = {name: upload(rows, device) for name, rows in answer.constants.items()}
            targets = batch.on_device().targets
            bare = put_uniform(self.cache, targets, upload(word, device), constants)
            self._made[2] += bare
        else:
            sent = shipped(batch, answer, self._production.staging)
            if isinstance(sent, Shipment):
                self._write_bricks(self._production.hold_rest(batch, sent), sent.chunks)
            else:
                self._write_bricks(batch, answer.data)

    def _write_bricks(self, batch: RequestBatch, data: Any) -> None:
        if len(batch):
            there = batch.on_device()
            put = put_bricks(self.cache, there.targets, data, self._unused[1:])
            self._count(there, put, 1)

    def _write_tiles(self, batch: RequestBatch, answer: Regions) -> None:
        if answer.alias is not None:
            self._leave_to_host(batch)
            return
        children, there = children_of(batch, answer, self.cache), batch.on_device()
        put = put_tiles(self.cache, there.targets, children, self._unused[:1])
        self._count(there, put, 0)

    def _count(self, batch: RequestBatch, put: Put, which: int) -> None:
        """Counts what was made; what found no slot may be asked for again."""
        _, given, held = put.counts
        self._unused[which] -= given
        self._made[which] += given
        self._made[3 + which] += held
        self._ask_again(batch, put.wanted & (put.slot < 0))

    def _leave_to_host(self, batch: RequestBatch) -> None:
        """Lets `Engine.frame` ask again, which can look up what an alias stands for."""
        self.host_needed = True
        there = batch.on_device()
        self._ask_again(there, torch.ones_like(there.targets.node, dtype=torch.bool))

    def _ask_again(self, batch: RequestBatch, which: Tensor) -> None:
        words, node = self.cache.nodes.request_tn.view(-1), batch.targets.node
        bit = batch.kind << REQUEST_PENDING_SHIFT
        words[node] &= ~torch.where(which, bit, 0).to(torch.int32)


def recorded_frame(
    cache: Cache,
    trees: Sequence[ProducedTree],
    scheduler: Scheduler,
    batch: int,
    production: Production,
) -> DeviceFrame | HostFrame | None:
    """Returns what serves a captured frame; None where producers answer neither all on the device
    nor all from the host, or have coarse channels.
    """
    producers = [one.producer for one in trees]
    if any(channel.coarse for one in producers for channel in one.channels.values()):
        return None
    if all(one.on_device for one in producers):
        return DeviceFrame(cache, trees, scheduler, batch)
    if all(one.on_host for one in producers):
        return HostFrame(cache, trees, scheduler, batch, production)
    return None


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
