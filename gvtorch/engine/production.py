"""`Production`: chooses among the requests of a frame, asks producers for these nodes, and writes
their answers into the slots of the cache, at once or later. A node that fails is counted and named,
and not asked for again; its ancestors stand in for it, and other nodes are not affected.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..base.constants import REQUEST_LOAD, REQUEST_PENDING_SHIFT, REQUEST_SUBDIVIDE
from ..base.stage import stage
from ..cache import KINDS, Cache, RequestList, Scheduler, write
from ..cache.requests import Requests, coarser_requests, deeper, levels_wanted, requests_below
from ..cache.write import Targets, Written
from ..pool import Staging
from ..pool.staging import Shipment, upload
from ..producers import Bricks, Region, Regions
from . import parents
from .request_batch import (
    Answered,
    ProducedTree,
    RequestBatch,
    brick_words,
    by_kind,
    children_of,
    send_ahead,
    shipped,
)
from .stats import Counts, FrameStats

_MOST_RAISES = 256  # calls in one frame that may raise before whole batches are given up
_LONGEST = 1e6  # seconds
_KEPT = 1000  # most failures kept by name; all are counted


class ProductionError(RuntimeError):
    """A producer failed, and the engine is strict."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A node that could not be produced."""

    tree: str
    kind: str  # load or subdivide
    loc: tuple[int, ...]  # x, y, z, depth
    message: str

    def __str__(self) -> str:
        """Names tree, level, node and reason in one line."""
        *xyz, depth = self.loc
        return f"tree {self.tree!r}, depth {depth}, node {tuple(xyz)}, {self.kind}: {self.message}"


class Failures:
    """All nodes that failed, by loc, because a node's tile may be given away and come back."""

    def __init__(self, strict: bool) -> None:
        self.strict = strict
        self.newest: deque[Failure] = deque(maxlen=_KEPT)
        self._places: set[tuple[str, int, tuple[int, ...]]] = set()  # tree, kind, loc
        self._first: tuple[Failure, BaseException | None] | None = None
        self._known = 0

    def __len__(self) -> int:
        return len(self._places)

    def changed(self) -> bool:
        """Returns whether their number has changed since the last call."""
        before, self._known = self._known, len(self)
        return before != self._known

    def add(self, batch: RequestBatch, message: str, cause: BaseException | None) -> None:
        """Records the nodes of a batch as failed."""
        tree, text = batch.source.name, " ".join(message.split())
        kind = next(name for name, kind in KINDS.items() if kind == batch.kind)
        for loc in map(tuple, batch.targets.loc.tolist()):
            self.newest.append(Failure(tree=tree, kind=kind, loc=loc, message=text))
            self._places.add((tree, batch.kind, loc))
        self._first = self._first or (self.newest[-1], cause)

    def among(self, batch: RequestBatch) -> Tensor | None:
        """Returns (k,) bool, which nodes of a batch failed before; None if none did."""
        if not self._places:
            return None
        name, kind = batch.source.name, batch.kind
        failed = [(name, kind, tuple(loc)) in self._places for loc in batch.targets.loc.tolist()]
        return torch.tensor(failed, device=batch.targets.node.device) if any(failed) else None

    def raise_if_strict(self) -> None:
        """Raises `ProductionError` for the first failure since the last call, if strict: at the end
        of a frame, when the pools are consistent.
        """
        first, self._first = self._first, None
        if self.strict and first is not None:
            failure, cause = first
            raise ProductionError(str(failure)) from cause

    def forget(self, tree: str | None = None) -> None:
        """Forgets the failures of a tree, or all."""
        kept = [one for one in self.newest if tree not in (None, one.tree)]
        self.newest.clear()
        self.newest.extend(kept)
        self._places = {place for place in self._places if tree not in (None, place[0])}


@dataclass(frozen=True, eq=False)
class _Waiting:
    """A batch whose answer is on its way."""

    batch: RequestBatch
    asked: Future  # what the producer returned
    future: Future  # of the same answer, after bricks on the host were checked and sent
    patience: float  # seconds
    since: float  # time.monotonic()

    @property
    def left(self) -> float:
        """Seconds until it is given up."""
        return self.since + self.patience - time.monotonic()


def _outcome(call: Callable[[], Any]) -> tuple[Any, Exception | None]:
    """Calls a producer; returns its answer and None, or None and the error that it raised."""
    try:
        return call(), None
    except Exception as error:
        return None, error


class Production:
    """Asks producers for requested nodes, and writes their answers into the pools.

    Attributes:
        trees: Trees and their producers, by name.
        by_level: Whether each level needs its bricks before it is subdivided.
        failures: The nodes that failed.
        staging: Sends bricks from the host to a CUDA device; None where the pools are on the host.
    """

    def __init__(self, cache: Cache, scheduler: Scheduler, by_level: bool, strict: bool) -> None:
        self.cache, self.scheduler, self.by_level = cache, scheduler, by_level
        self.trees: dict[str, ProducedTree] = {}
        self.failures = Failures(strict)
        self._raised = self._skipped = 0
        self._waiting: list[_Waiting] = []
        self._held: list[Answered] = []  # found no room in the staging ring
        self.staging: Staging | None = None
        pool = cache.bricks
        if pool.stamp_b.device.type == "cuda":
            brick = sum(bricks[:1].nbytes for bricks in pool.bricks.values())
            most = scheduler.most[REQUEST_LOAD] * brick
            self.staging = Staging(most, brick, pool.stamp_b.device)

    @property
    def due(self) -> bool:
        """Whether an answer has come, waits for room in the staging ring, or is overdue."""
        return bool(self._held) or any(
            item.future.done() or item.left < 0 for item in self._waiting
        )

    @property
    def pending(self) -> dict[int, int]:
        """For each kind, the number of nodes whose answers are on their way."""
        batches = self._under_way()
        return {kind: sum(len(b) for b in batches if b.kind == kind) for kind in KINDS.values()}

    def room(self) -> dict[int, list[int]]:
        """Returns for each kind how many slots no pending answer needs; see `Cache.room`."""
        room, batches = self.cache.room(), self._under_way()
        for kind, free in room.items():
            for number in range(len(free)):
                known = (b for b in batches if b.kind == kind and b.coarse == number)
                free[number] = max(0, free[number] - sum(map(len, known)))
        return room

    def serve(self, listed: RequestList, counts: Counts, stats: FrameStats) -> None:
        """Makes unused slots available, chooses requests, asks the producers, and writes the
        answers that come at once. Recorded frames choose on the device (`RecordedFrame`).
        """
        cache, scheduler = self.cache, self.scheduler
        cache.make_room(counts.tiles_unused, counts.bricks_unused, counts.coarse_unused)
        if not counts.listed:
            return
        with stage("schedule"):
            requests = listed.by_kind(cache, counts.by_kind())
            room = self.room()
            nodes, deferred, exceeded = scheduler.choose(requests, room)
            if exceeded:
                coarser = coarser_requests(cache, requests, room)
                nodes, deferred, _ = scheduler.choose(coarser, room)
            stats.deferred += deferred
            stats.capacity_exceeded |= exceeded
        self._produce(nodes, stats)
        if counts.subdivide and not (exceeded or self.by_level):
            self._deepen(requests[REQUEST_SUBDIVIDE], stats)

    def _produce(self, nodes: Mapping[int, Tensor], stats: FrameStats) -> None:
        with stage("produce"):
            answers = self.ask(nodes)
        with stage("write"):
            self.write(answers, stats)

    def _deepen(self, asked: Requests, stats: FrameStats) -> None:
        """Subdivides the nodes just made as well, where rays will want finer ones, before they ask:
        by as many levels as the subdivisions want on average.
        """
        branching = max(source.layout.branching for source in self.trees.values())
        for _ in range(deeper(levels_wanted(asked.priority, branching).tolist())):
            with stage("schedule"):
                requests = requests_below(self.cache, asked, branching)
                asked = requests[REQUEST_SUBDIVIDE]
                nodes = self.scheduler.choose(requests, self.room()).nodes
            if not any(map(len, nodes.values())):
                break
            self._produce(nodes, stats)

    def ask(self, chosen: Mapping[int, Tensor]) -> list[Answered]:
        """Asks for the chosen (k,) nodes of each kind; returns answers that are here at once."""
        self._raised = 0
        answered: list[Answered] = []
        for kind, nodes in chosen.items():
            self.scheduler.spent[kind] += len(nodes)
            for source, node in self._by_tree(nodes):
                targets = Targets(source.tree, node, source.tree.loc(node))
                batch = RequestBatch(source, kind, targets)
                if kind == REQUEST_LOAD and source.producer.needs_parent:
                    batch = self._with_parents(batch)
                failed = self.failures.among(batch)
                if failed is not None:  # before its tile was given away: mark it again
                    again, batch = batch[failed], batch[~failed]
                    self._mark(again)
                    self._skipped += len(again)
                for part in batch.by_slots():
                    answered += self._submit(part)
        return answered

    def late(self) -> list[Answered]:
        """Returns the answers that came since the last call; gives up those that are overdue."""
        answered = [*self._held]
        self._held.clear()
        for item in list(self._waiting):
            if item.future.done():
                seconds = time.monotonic() - item.since
                self.scheduler.learn(item.batch.kind, len(item.batch), 1e3 * seconds)
                answered += self._settle(item.batch, *_outcome(item.future.result))
                self._waiting.remove(item)
            elif item.left < 0:
                self._waiting.remove(item)
                item.asked.cancel()
                self._fail(item.batch, f"no answer within {item.patience:g} s")
        return answered

    def write(self, answers: Sequence[Answered], stats: FrameStats) -> None:
        """Writes answers into the pools and adds them to `stats`."""
        stats.stale, self._skipped = stats.stale + self._skipped, 0
        for batch, answer in answers:
            if isinstance(answer, Regions):
                children = children_of(batch, answer, self.cache)
                self._add_up(batch, write.tiles(self.cache, batch.targets, children), stats)
            elif isinstance(answer, Shipment):
                self._write_shipment(batch, answer, stats)
            else:
                for kind, part in by_kind(batch, answer).items():
                    self._write_bricks(kind, *part, stats)
        if answers or self.failures.changed():
            self.cache.aliases.update()
        stats.pending, stats.failed = sum(self.pending.values()), len(self.failures)

    def wait(self, more: float = 0.0, limit: float = _LONGEST) -> None:
        """Waits for one answer, at most for patience or `limit` seconds; then `more` for others."""
        if self._waiting and not self._held:
            left = min(item.left for item in self._waiting)
            futures = [item.future for item in self._waiting]
            longest = min(limit, max(0.0, left) + 1e-3)
            wait_for(futures, timeout=longest, return_when=FIRST_COMPLETED)
            wait_for(futures, timeout=more)

    def restore_pending(self) -> None:
        """Marks the nodes whose answers are on their way as pending, and no others."""
        words = self.cache.nodes.request_tn
        everything = torch.arange(words.numel(), device=words.device)
        for kind in KINDS.values():
            self.cache.mark_pending(everything, kind, False)
        for batch in self._under_way():
            self._mark(batch)

    def forget(self, source: ProducedTree) -> None:
        """Drops the answers that are on their way to a tree, and forgets its failures."""
        for item in [item for item in self._waiting if item.batch.source is source]:
            item.asked.cancel()
            self._waiting.remove(item)
        self._held = [one for one in self._held if one.batch.source is not source]
        self.failures.forget(source.name)

    def close(self) -> None:
        """Drops all answers that are on their way."""
        for item in self._waiting:
            item.asked.cancel()
        self._waiting.clear()
        self._held.clear()

    def __repr__(self) -> str:
        pending = sum(self.pending.values())
        return f"Production({pending} nodes on their way, {len(self.failures)} failed)"

    def _by_tree(self, node: Tensor) -> list[tuple[ProducedTree, Tensor]]:
        """Groups nodes by tree; trees without any are left out."""
        trees = [*self.trees.values()]
        if not len(node):
            return []
        if len(trees) == 1:
            return [(trees[0], node)]
        number = self.cache.nodes.tree_t[node // self.cache.nodes.nodes_per_tile]
        masks = number == torch.arange(len(trees), device=number.device)[:, None]
        return [
            (tree, node[torch.nonzero_static(mask, size=count)[:, 0]])
            for tree, mask, count in zip(trees, masks, masks.sum(1).tolist(), strict=True)
            if count
        ]

    def _with_parents(self, batch: RequestBatch) -> RequestBatch:
        """Returns the batch with the bricks of its nodes' parents. Nodes whose parents have no
        brick wait until they have: ancestors take their place in the batch.
        """
        cache, source = self.cache, batch.source
        batch = batch[parents.unlink_lost(cache, batch.targets.node).nonzero()[:, 0]]
        node = parents.ready(cache, batch.targets.node, source.layout.depth)
        words, bit = cache.nodes.request_tn.view(-1), REQUEST_LOAD << REQUEST_PENDING_SHIFT
        pending = (words[node] & bit) != 0
        above = replace(batch, targets=Targets(source.tree, node, source.tree.loc(node)))
        failed = self.failures.among(above)
        if failed is not None:
            lost = (failed & (node != batch.targets.node)).nonzero()[:, 0]
            if len(lost):
                self._fail(batch[lost], "the brick of its parent can't be made")
        first = parents.first_ones(torch.where(pending, -1, node))
        asked = above[(first >= 0).nonzero()[:, 0]]
        bricks = parents.parent_bricks(cache, source, asked.targets.node)
        return replace(asked, parents=bricks)

    def _submit(self, batch: RequestBatch) -> list[Answered]:
        """Asks for a batch; returns the answers that come at once."""
        start = time.perf_counter()
        answer, raised = _outcome(batch.ask)
        if isinstance(answer, Future):
            if not answer.done():
                self._mark(batch)
                ahead, patience = self._sent_ahead(batch, answer), batch.source.patience
                self._waiting.append(_Waiting(batch, answer, ahead, patience, time.monotonic()))
                return []
            answer, raised = _outcome(answer.result)
        answered = self._settle(batch, answer, raised)
        self.scheduler.learn(batch.kind, len(batch), 1e3 * (time.perf_counter() - start))
        return answered

    def _sent_ahead(self, batch: RequestBatch, asked: Future) -> Future:
        """Returns a future of the answer, after sending bricks on the host to the device."""
        staging = self.staging
        if staging is None or batch.kind != REQUEST_LOAD:
            return asked
        ahead: Future = Future()

        def send(asked: Future) -> None:
            try:
                ahead.set_result(send_ahead(batch, asked.result(), staging))
            except BaseException as error:
                ahead.set_exception(error)

        asked.add_done_callback(send)
        return ahead

    def _settle(self, batch: RequestBatch, answer: Any, raised: Exception | None) -> list[Answered]:
        """Checks an answer; if the producer raised, asks it again for each half of the batch."""
        if raised is not None:
            self._raised += 1
            if len(batch) == 1 or self._raised > _MOST_RAISES:
                self._fail(batch, f"{type(raised).__name__}: {raised}", raised)
                return []
            return [one for half in batch.halves() for one in self._submit(half)]
        if isinstance(answer, Shipment):
            return [Answered(batch, answer)]
        try:
            checked = batch.check(answer)
        except ValueError as error:
            self._fail(batch, str(error), error)
            return []
        if checked.errors:
            failed, keep = batch.failed(checked)
            for node, message in failed.items():
                self._fail(batch[node : node + 1], message)
            rows = keep.repeat_interleave(batch.per_node).nonzero()[:, 0]
            batch, checked = batch[keep.nonzero()[:, 0]], checked.rows(rows)
        return [Answered(batch, shipped(batch, checked, self.staging))] if len(batch) else []

    def _write_bricks(
        self, kind: Region, batch: RequestBatch, answer: Any, stats: FrameStats
    ) -> None:
        """Writes an answer to loads whose items are written alike; see `by_kind`."""
        if kind is Region.ALIAS:
            goal = upload(answer.alias, batch.targets.node.device)
            written = write.aliases(self.cache, batch.targets, goal, batch.alias_tree(answer))
            self._add_up(batch, written, stats)
            return
        if kind is Region.EMPTY:
            device = batch.targets.node.device
            word = upload(brick_words(answer.kind), device)
            constants = {name: upload(rows, device) for name, rows in answer.constants.items()}
            written = write.uniform(self.cache, batch.targets, word, constants)
            self._add_up(batch, written, stats)
            return
        sent = shipped(batch, answer, self.staging)
        if isinstance(sent, Shipment):
            self._write_shipment(batch, sent, stats)
        else:
            self._add_up(batch, write.bricks(self.cache, batch.targets, answer.data), stats)

    def _write_shipment(self, batch: RequestBatch, shipment: Shipment, stats: FrameStats) -> None:
        """Writes the bricks that are being sent to the device; holds back those without room."""
        sent, rest = batch[: shipment.sent], batch[shipment.sent :]
        if len(rest):
            self._mark(rest)
            self._held.append(Answered(rest, Bricks(data=shipment.rest)))
        if len(sent):
            self._add_up(sent, write.bricks(self.cache, sent.targets, shipment.chunks), stats)

    def _add_up(self, batch: RequestBatch, written: Written, stats: FrameStats) -> None:
        """Adds a write to `stats`; nodes that found no slot may be requested again."""
        name = "bricks" if batch.kind == REQUEST_LOAD else "tiles"
        stats.produced[name] += written.items
        stats.produced["constant"] += written.constant
        stats.evicted[name] += written.evicted
        stats.stale += written.stale
        stats.bytes_uploaded += written.nbytes
        stats.capacity_exceeded |= written.unplaced > 0
        if written.lost is not None:
            self.cache.mark_pending(batch.targets.node[written.lost], batch.kind, False)

    def _under_way(self) -> list[RequestBatch]:
        return [item.batch for item in self._waiting] + [one.batch for one in self._held]

    def _mark(self, batch: RequestBatch) -> None:
        """Marks a batch as pending, where its nodes still lack what was asked for."""
        lacking = batch.targets.lacking(self.cache, batch.kind)
        self.cache.mark_pending(batch.targets.node, batch.kind, lacking)

    def _fail(self, batch: RequestBatch, message: str, cause: Exception | None = None) -> None:
        """Records a batch as failed; its nodes stay pending, so that no ray asks again."""
        self._mark(batch)
        self.failures.add(batch, message, cause)
