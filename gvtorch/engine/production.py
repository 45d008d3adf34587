"""`Production`: chooses among the requests of a frame, asks producers for these nodes, and writes
their answers into the slots of the cache, at once or later. A node that fails is counted and named,
and not asked for again; its ancestors stand in for it, and other nodes are not affected.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..base.constants import REQUEST_LOAD, REQUEST_PENDING_SHIFT, REQUEST_SUBDIVIDE
from ..base.lasting import lasting
from ..base.messages import one_line
from ..base.stage import stage
from ..cache import KINDS, Cache, RequestList, Scheduler, write
from ..cache.requests import Requests, coarser_requests, extra_levels, levels_wanted, requests_below
from ..cache.write import Targets, Written
from ..pool.staging import SentBricks, Staging, upload
from ..producers import Bricks, Region, Regions
from . import parents
from .asker import Answer, Asker
from .request_batch import (
    ProducedTree,
    RequestBatch,
    brick_words,
    by_kind,
    check_and_send,
    children_of,
    send_voxels,
)
from .stats import Counts, FrameStats

_MAX_WAIT_SECONDS = 1e6  # seconds
_MAX_NAMED_FAILURES = 1000  # most failures kept by name; all are counted


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
        *xyz, depth = self.loc
        return f"tree {self.tree!r}, depth {depth}, node {tuple(xyz)}, {self.kind}: {self.message}"


class Failures:
    """All nodes that failed, by loc, because a node's tile may be given away and come back. Any
    thread in which an answer arrives may add some.
    """

    def __init__(self, strict: bool) -> None:
        self.strict = strict
        self.newest: deque[Failure] = deque(maxlen=_MAX_NAMED_FAILURES)
        self._failed: set[tuple[str, int, tuple[int, ...]]] = set()  # tree, kind, loc
        self._first_failure: tuple[Failure, BaseException | None] | None = None
        self._last_count = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._failed)

    def changed(self) -> bool:
        """Returns whether their number has changed since the last call."""
        last_count, self._last_count = self._last_count, len(self)
        return last_count != self._last_count

    def add(self, batch: RequestBatch, message: str, cause: BaseException | None) -> None:
        """Records the nodes of a batch as failed."""
        tree, text = batch.source.name, one_line(message or "no reason given")
        kind = next(name for name, kind in KINDS.items() if kind == batch.kind)
        with self._lock:
            for loc in map(tuple, batch.targets.loc.tolist()):
                self.newest.append(Failure(tree=tree, kind=kind, loc=loc, message=text))
                self._failed.add((tree, batch.kind, loc))
            self._first_failure = self._first_failure or (self.newest[-1], cause)

    def among(self, batch: RequestBatch) -> Tensor | None:
        """Returns (k,) bool, which nodes of a batch failed before; None if none did."""
        if not self._failed:
            return None
        name, kind = batch.source.name, batch.kind
        failed = [(name, kind, tuple(loc)) in self._failed for loc in batch.targets.loc.tolist()]
        return torch.tensor(failed, device=batch.targets.node.device) if any(failed) else None

    def raise_if_strict(self) -> None:
        """Raises `ProductionError` for the first failure since the last call, if strict: at the end
        of a frame, when the pools are consistent.
        """
        with self._lock:
            first_failure, self._first_failure = self._first_failure, None
        if self.strict and first_failure is not None:
            failure, cause = first_failure
            raise ProductionError(str(failure)) from cause

    def forget(self, tree: str | None = None) -> None:
        """Forgets the failures of a tree, or all."""
        with self._lock:
            kept_failures = [failure for failure in self.newest if tree not in (None, failure.tree)]
            self.newest.clear()
            self.newest.extend(kept_failures)
            self._failed = {node for node in self._failed if tree not in (None, node[0])}


class Answered(NamedTuple):
    """A batch and its answer."""

    batch: RequestBatch
    answer: Answer


class Production(Asker):
    """Asks producers for requested nodes, and writes their answers into the pools.

    Attributes:
        trees: Trees and their producers, by name.
        by_level: Whether each level needs its bricks before it is subdivided.
        failures: The nodes that failed.
        staging: Sends bricks from the host to a CUDA device; None where the pools are on the host.
    """

    def __init__(self, cache: Cache, scheduler: Scheduler, by_level: bool, strict: bool) -> None:
        super().__init__()
        self.cache, self.scheduler, self.by_level = cache, scheduler, by_level
        self.trees: dict[str, ProducedTree] = {}
        self.failures = Failures(strict)
        self._skipped_count = 0
        self._answered: list[Answered] = []  # since the last call of `_take_answers`
        self._held_back: list[Answered] = []  # found no room in the staging ring
        self.staging: Staging | None = None
        pool = cache.bricks
        if pool.stamp_b.device.type == "cuda":
            brick_nbytes = sum(bricks[:1].nbytes for bricks in pool.bricks.values())
            max_nbytes = scheduler.most[REQUEST_LOAD] * brick_nbytes
            self.staging = Staging(max_nbytes, brick_nbytes, pool.stamp_b.device)

    @property
    def due(self) -> bool:
        """Whether an answer has come, waits for room in the staging ring, or is overdue."""
        return bool(self._held_back) or any(
            item.answer_future.done() or item.seconds_left < 0 for item in self._waiting
        )

    @property
    def pending(self) -> dict[int, int]:
        """For each kind, the number of nodes whose answers are on their way."""
        batches = self._pending_batches()
        return {kind: sum(len(b) for b in batches if b.kind == kind) for kind in KINDS.values()}

    def room(self) -> dict[int, list[int]]:
        """Returns for each kind how many slots no pending answer needs; see `Cache.room`."""
        room, batches = self.cache.room(), self._pending_batches()
        for kind, free in room.items():
            for coarse in range(len(free)):
                pending = (b for b in batches if b.kind == kind and b.coarse == coarse)
                free[coarse] = max(0, free[coarse] - sum(map(len, pending)))
        return room

    @lasting
    def serve(self, request_list: RequestList, counts: Counts, stats: FrameStats) -> None:
        """Makes unused slots available, chooses requests, asks the producers, and writes the
        answers that come at once. Recorded frames choose on the device (`RecordedFrame`).
        """
        cache, scheduler = self.cache, self.scheduler
        cache.make_room(counts.tiles_unused, counts.bricks_unused, counts.coarse_unused)
        if not counts.listed:
            return
        with stage("schedule"):
            requests = request_list.by_kind(cache, counts.by_kind())
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

    def _deepen(self, subdivisions: Requests, stats: FrameStats) -> None:
        """Subdivides the nodes that were just made, too, where rays will want finer ones, before
        rays ask for these: by as many levels as the subdivisions want on average.
        """
        branching = max(source.layout.branching for source in self.trees.values())
        for _ in range(extra_levels(levels_wanted(subdivisions.priority, branching).tolist())):
            with stage("schedule"):
                requests = requests_below(self.cache, subdivisions, branching)
                subdivisions = requests[REQUEST_SUBDIVIDE]
                nodes = self.scheduler.choose(requests, self.room()).nodes
            if not any(map(len, nodes.values())):
                break
            self._produce(nodes, stats)

    def ask(self, chosen: Mapping[int, Tensor]) -> list[Answered]:
        """Asks for the chosen (k,) nodes of each kind; returns answers that are here at once."""
        for kind, nodes in chosen.items():
            self.scheduler.spent[kind] += len(nodes)
            for source, node in self._by_tree(nodes):
                targets = Targets(source.tree, node, source.tree.loc(node))
                batch = RequestBatch(source, kind, targets)
                if kind == REQUEST_LOAD and source.producer.needs_parent:
                    batch = self._with_parents(batch)
                failed = self.failures.among(batch)
                if failed is not None:  # their marks are gone, as when tiles change hands
                    failed_before, batch = batch[failed], batch[~failed]
                    self._mark(failed_before)
                    self._skipped_count += len(failed_before)
                for part in batch.by_slots():
                    self._submit(part)
        return self._take_answers()

    def late_answers(self) -> list[Answered]:
        """Returns the answers that came since the last call; gives up those that are overdue."""
        self._answered, self._held_back = self._held_back, []
        for item in self._take(lambda item: item.answer_future.done()):
            seconds = time.monotonic() - item.asked_at
            self.scheduler.learn(item.batch.kind, len(item.batch), 1e3 * seconds)
            self._settle_late(item)
        self._give_up_overdue()
        return self._take_answers()

    def write(self, answers: Sequence[Answered], stats: FrameStats) -> None:
        """Writes answers into the pools and adds them to `stats`."""
        stats.stale, self._skipped_count = stats.stale + self._skipped_count, 0
        for batch, answer in answers:
            if isinstance(answer, Regions):
                children = children_of(batch, answer, self.cache)
                self._count_written(batch, write.tiles(self.cache, batch.targets, children), stats)
            elif isinstance(answer, SentBricks):
                self._write_sent(batch, answer, stats)
            else:
                for kind, part in by_kind(batch, answer).items():
                    self._write_bricks(kind, *part, stats)
        if answers or self.failures.changed():
            self.cache.aliases.update()
        stats.pending, stats.failed = sum(self.pending.values()), len(self.failures)

    def wait(self, extra: float = 0.0, limit: float = _MAX_WAIT_SECONDS) -> None:
        """Waits for an answer, at most its patience or `limit` seconds; then `extra` for others."""
        if self._waiting and not self._held_back:
            shortest_patience = min(item.seconds_left for item in self._waiting)
            futures = [item.answer_future for item in self._waiting]
            timeout = min(limit, max(0.0, shortest_patience) + 1e-3)
            wait_for(futures, timeout=timeout, return_when=FIRST_COMPLETED)
            wait_for(futures, timeout=extra)

    def restore_pending(self) -> None:
        """Marks the nodes whose answers are on their way as pending, and no others."""
        self._answered.clear()  # of a frame that was broken off
        request_words = self.cache.nodes.request_tn
        all_nodes = torch.arange(request_words.numel(), device=request_words.device)
        for kind in KINDS.values():
            self.cache.mark_pending(all_nodes, kind, False)
        for batch in self._pending_batches():
            self._mark(batch)

    def forget(self, source: ProducedTree) -> None:
        """Drops the answers that are on their way to a tree, and forgets its failures."""
        self._cancel(source)
        self._held_back = [item for item in self._held_back if item.batch.source is not source]
        self.failures.forget(source.name)

    def close(self) -> None:
        """Drops all answers that are on their way."""
        self._cancel()
        self._held_back.clear()

    def __repr__(self) -> str:
        pending = sum(self.pending.values())
        return f"Production({pending} nodes on their way, {len(self.failures)} failed)"

    def _by_tree(self, node: Tensor) -> list[tuple[ProducedTree, Tensor]]:
        """Groups nodes by tree; trees without any are left out."""
        sources = [*self.trees.values()]
        if not len(node):
            return []
        if len(sources) == 1:
            return [(sources[0], node)]
        tree_number = self.cache.nodes.tree_t[node // self.cache.nodes.nodes_per_tile]
        masks = tree_number == torch.arange(len(sources), device=tree_number.device)[:, None]
        return [
            (source, node[torch.nonzero_static(mask, size=count)[:, 0]])
            for source, mask, count in zip(sources, masks, masks.sum(1).tolist(), strict=True)
            if count
        ]

    def _with_parents(self, batch: RequestBatch) -> RequestBatch:
        """Returns the batch with the bricks of its nodes' parents. Nodes whose parents have no
        brick wait until they have: ancestors take their place in the batch.
        """
        cache, source = self.cache, batch.source
        batch = batch[parents.unlink_alias_only(cache, batch.targets.node).nonzero()[:, 0]]
        node = parents.nearest_loadable(cache, batch.targets.node, source.layout.depth)
        words, bit = cache.nodes.request_tn.view(-1), REQUEST_LOAD << REQUEST_PENDING_SHIFT
        pending = (words[node] & bit) != 0
        ancestors = replace(batch, targets=Targets(source.tree, node, source.tree.loc(node)))
        failed = self.failures.among(ancestors)
        if failed is not None:
            unfillable = (failed & (node != batch.targets.node)).nonzero()[:, 0]
            if len(unfillable):
                self._fail(batch[unfillable], "the brick of its parent can't be made", None)
        to_load = parents.without_repeats(torch.where(pending, -1, node))
        load_batch = ancestors[(to_load >= 0).nonzero()[:, 0]]
        bricks = parents.parent_bricks(cache, source, load_batch.targets.node)
        return replace(load_batch, parents=bricks)

    def _submit(self, batch: RequestBatch) -> bool:
        """See `Asker`; the scheduler learns what an answer that comes at once costs."""
        start = time.perf_counter()
        at_once = super()._submit(batch)
        if at_once:
            self.scheduler.learn(batch.kind, len(batch), 1e3 * (time.perf_counter() - start))
        return at_once

    def _on_future(self, batch: RequestBatch, future: Future) -> None:
        self._mark(batch)
        self._wait_for(batch, future, self._send_on_arrival(batch, future))

    def _on_answer(self, batch: RequestBatch, answer: Answer) -> None:
        self._answered.append(Answered(batch, send_voxels(batch, answer, self.staging)))

    def _take_answers(self) -> list[Answered]:
        """Returns the answers that have come, each once."""
        answered, self._answered = self._answered, []
        return answered

    def _send_on_arrival(self, batch: RequestBatch, producer_future: Future) -> Future:
        """Returns a future of the answer, after sending bricks on the host to the device."""
        staging = self.staging
        if staging is None or batch.kind != REQUEST_LOAD:
            return producer_future
        answer_future: Future = Future()

        def send(done_future: Future) -> None:
            try:
                answer_future.set_result(check_and_send(batch, done_future.result(), staging))
            except BaseException as error:
                answer_future.set_exception(error)

        producer_future.add_done_callback(send)
        return answer_future

    def _write_bricks(
        self, kind: Region, batch: RequestBatch, answer: Any, stats: FrameStats
    ) -> None:
        """Writes an answer to loads whose items are written alike; see `by_kind`."""
        targets, device = batch.targets, batch.targets.node.device
        if kind is Region.ALIAS:
            goal = upload(answer.alias, device)
            written = write.aliases(self.cache, targets, goal, batch.alias_tree(answer))
        elif kind is Region.EMPTY:
            brick_word = upload(brick_words(answer.kind), device)
            constants = {name: upload(rows, device) for name, rows in answer.constants.items()}
            written = write.uniform(self.cache, targets, brick_word, constants)
        else:
            sent = send_voxels(batch, answer, self.staging)
            if isinstance(sent, SentBricks):
                self._write_sent(batch, sent, stats)
                return
            written = write.bricks(self.cache, targets, answer.data)
        self._count_written(batch, written, stats)

    def _write_sent(self, batch: RequestBatch, bricks: SentBricks, stats: FrameStats) -> None:
        """Writes the bricks that are being sent to the device; holds back those without room."""
        sent, held_back = batch[: bricks.sent], batch[bricks.sent :]
        if len(held_back):
            self._mark(held_back)
            self._held_back.append(Answered(held_back, Bricks(data=bricks.rest)))
        if len(sent):
            self._count_written(sent, write.bricks(self.cache, sent.targets, bricks.chunks), stats)

    def _count_written(self, batch: RequestBatch, written: Written, stats: FrameStats) -> None:
        """Adds a write to `stats`; nodes that found no slot may be requested again."""
        item_name = "bricks" if batch.kind == REQUEST_LOAD else "tiles"
        stats.produced[item_name] += written.items
        stats.produced["constant"] += written.constant
        stats.evicted[item_name] += written.evicted
        stats.stale += written.stale
        stats.bytes_uploaded += written.nbytes
        stats.capacity_exceeded |= written.unplaced > 0
        if written.retry is not None:
            self.cache.mark_pending(batch.targets.node[written.retry], batch.kind, False)

    def _pending_batches(self) -> list[RequestBatch]:
        return [item.batch for item in self._waiting] + [item.batch for item in self._held_back]

    def _mark(self, batch: RequestBatch) -> None:
        """Marks a batch as pending, where its nodes still lack what was asked for."""
        lacking = batch.targets.lacking(self.cache, batch.kind)
        self.cache.mark_pending(batch.targets.node, batch.kind, lacking)

    def _fail(self, batch: RequestBatch, message: str, cause: BaseException | None) -> None:
        self._mark(batch)
        self.failures.add(batch, message, cause)
