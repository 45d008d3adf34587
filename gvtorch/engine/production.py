"""`Production`: asks producers for what is wanted, and takes their answers, at once or later.

It joins producers, which know places, and the cache, which knows slots. An item that fails is
counted and named, is not asked for again, and takes nobody with it: its ancestors go on standing in
for it. Bricks in host memory go to a CUDA device through `Staging`: those that come later are sent
by the thread that answers, and those that find no room are held back until the next frame.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..base.constants import ABSENT, CONSTANT, EMPTY, REQUEST_LOAD
from ..base.records import FrameStats
from ..cache import KINDS, Cache, Scheduler, Written
from ..pool import Staging
from ..pool.staging import Shipment, upload
from ..producers import Bricks, Region, Regions
from .jobs import Answer, Job, Plant, Sent, by_kind, children_of, select, send_ahead, shipped

_KEPT_FAILURES = 1000  # named; all are counted
_MOST_RAISES = 256  # calls in one frame that may raise before whole batches are given up
_LONGEST = 1e6  # seconds


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
        x, y, z, depth = self.loc
        return (
            f"tree {self.tree!r}, depth {depth}, node ({x}, {y}, {z}), {self.kind}: {self.message}"
        )


@dataclass(frozen=True, eq=False)
class _Waiting:
    job: Job
    asked: Future  # the producer's
    future: Future  # of its answer, which may be on its way to the device already
    since: float  # time.monotonic()


class Production:
    """What is on its way, and what failed.

    Attributes:
        failures: The last failures, by name.
        strict: A failure raises `ProductionError` at the end of its frame.
        staging: The way of bricks from the host to a CUDA device; None where they are there.
    """

    def __init__(self, cache: Cache, scheduler: Scheduler, patience: float, strict: bool) -> None:
        """Waits for nothing yet."""
        self.cache, self.scheduler = cache, scheduler
        self.patience, self.strict = patience, strict
        self.failures: deque[Failure] = deque(maxlen=_KEPT_FAILURES)
        self._failed: set[tuple[Any, ...]] = set()  # tree, kind, x, y, z, depth
        self._raised = self._skipped = 0
        self._waiting: list[_Waiting] = []
        self._held: list[tuple[Job, Bricks]] = []  # the staging ring had no room
        self.staging: Staging | None = None
        pool = cache.bricks
        if pool.stamp_b.device.type == "cuda":
            brick = sum(bricks[:1].nbytes for bricks in pool.bricks.values())
            most = scheduler.most[REQUEST_LOAD] * brick
            self.staging = Staging(most, brick, pool.stamp_b.device)
        self._first: tuple[Failure, BaseException | None] | None = None

    @property
    def failed(self) -> int:
        """Number of nodes that failed."""
        return len(self._failed)

    @property
    def due(self) -> bool:
        """Whether an answer has come, or waits for room on the way, or its patience has ended."""
        now = time.monotonic()
        return bool(self._held) or any(
            item.future.done() or now - item.since > self._patience(item.job)
            for item in self._waiting
        )

    @property
    def pending(self) -> dict[int, int]:
        """For each kind, the items whose answers are on their way."""
        jobs = self._under_way()
        return {kind: sum(len(j) for j in jobs if j.kind == kind) for kind in KINDS.values()}

    def late(self) -> list[tuple[Job, Answer]]:
        """Returns the answers that came since the last call; gives up those that do not come."""
        done: list[tuple[Job, Answer]] = [*self._held]
        self._held.clear()
        for item in list(self._waiting):
            if item.future.done():
                seconds = time.monotonic() - item.since
                self.scheduler.learn(item.job.kind, len(item.job), 1e3 * seconds)
                self._settle(item.job, item.future.result, done)
                self._waiting.remove(item)
            elif time.monotonic() - item.since > self._patience(item.job):
                self._waiting.remove(item)
                item.asked.cancel()
                self._fail(item.job, f"no answer within {self._patience(item.job):g} s")
        return done

    def ask(self, plants: list[Plant], chosen: Mapping[int, Tensor]) -> list[tuple[Job, Answer]]:
        """Asks for what was chosen; returns the answers that are here at once.

        Args:
            plants: All trees.
            chosen: For each kind the (k,) int64 nodes.
        """
        self._raised = 0
        done: list[tuple[Job, Answer]] = []
        for kind, nodes in chosen.items():
            self.scheduler.spent[kind] += len(nodes)
            for plant, node in self._by_plant(plants, nodes):
                job = self._without_failed(Job(plant, kind, node, plant.tree.loc(node)))
                if len(job):
                    self._submit(job, done)
        return done

    def _by_plant(self, plants: list[Plant], node: Tensor) -> list[tuple[Plant, Tensor]]:
        """The nodes of each tree, of those that have any."""
        if not len(node):
            return []
        if len(plants) == 1:
            return [(plants[0], node)]
        tree = self.cache.nodes.tree_t[node // self.cache.nodes.nodes_per_tile]
        masks = tree == torch.arange(len(plants), device=tree.device)[:, None]
        return [
            (plant, node[torch.nonzero_static(mask, size=count)[:, 0]])
            for plant, mask, count in zip(plants, masks, masks.sum(1).tolist(), strict=True)
            if count
        ]

    def _without_failed(self, job: Job) -> Job:
        """Leaves out what failed before its tile was given away: it is marked again."""
        if not self._failed:
            return job
        name, kind = job.plant.name, job.kind
        bad = [(name, kind, *loc) in self._failed for loc in job.loc.tolist()]
        failed = torch.tensor(bad, dtype=torch.bool, device=job.node.device)
        if any(bad):
            self._mark(job[failed])
            self._skipped += sum(bad)
        return job[~failed]

    def write(self, answers: list[tuple[Job, Answer]], stats: FrameStats) -> None:
        """Writes answers into the pools and adds up what they did."""
        stats.stale, self._skipped = stats.stale + self._skipped, 0
        queue = deque(answers)
        while queue:
            job, answer = queue.popleft()
            if isinstance(answer, Regions):
                written = self._write_tiles(job, answer)
            else:
                written = self._write_bricks(job, answer, queue)
            name = "bricks" if job.kind == REQUEST_LOAD else "tiles"
            stats.produced[name] += written.items
            stats.produced["constant"] += written.constant
            stats.evicted[name] += written.evicted
            stats.stale += written.stale
            stats.bytes_uploaded += written.nbytes
            stats.capacity_exceeded |= written.unplaced > 0
            if written.lost is not None:
                self.cache.mark_pending(job.node[written.lost], job.kind, False)
        stats.pending, stats.failed = sum(self.pending.values()), self.failed

    def wait(self, more: float = 0.0, limit: float = _LONGEST) -> None:
        """Waits until an answer is here, or until patience ends, at most `limit` seconds; then up
        to `more` seconds for the others.
        """
        if self._waiting and not self._held:
            ends = min(item.since + self._patience(item.job) for item in self._waiting)
            left = min(limit, max(0.0, ends - time.monotonic()) + 1e-3)
            futures = [item.future for item in self._waiting]
            wait_for(futures, timeout=left, return_when=FIRST_COMPLETED)
            wait_for(futures, timeout=more)

    def _patience(self, job: Job) -> float:
        own = job.plant.producer.patience
        return self.patience if own is None else own

    def raise_if_strict(self) -> None:
        """Raises `ProductionError` for the first failure since the last call, if strict: at the end
        of a frame, when the pools are in order.
        """
        first, self._first = self._first, None
        if self.strict and first is not None:
            failure, cause = first
            raise ProductionError(str(failure)) from cause

    def forget_failures(self) -> None:
        """Lets what failed be asked for again."""
        self.failures.clear()
        self._failed.clear()
        self.mark_anew()

    def mark_anew(self) -> None:
        """Marks as pending what is on its way and nothing else: after a frame that was broken off,
        or to forget failures.
        """
        for kind in KINDS.values():
            everything = torch.arange(
                self.cache.nodes.request_tn.numel(), device=self.cache.nodes.request_tn.device
            )
            self.cache.mark_pending(everything, kind, False)
            for job in self._under_way():
                if job.kind == kind:
                    self._mark(job)

    def close(self) -> None:
        """Forgets what is on its way."""
        for item in self._waiting:
            item.asked.cancel()
        self._waiting.clear()
        self._held.clear()

    def _under_way(self) -> list[Job]:
        return [item.job for item in self._waiting] + [job for job, _ in self._held]

    def _submit(self, job: Job, done: list[tuple[Job, Answer]]) -> None:
        start = time.perf_counter()
        later: list[Future] = []

        def ask() -> Any:
            answer = job.ask()
            if isinstance(answer, Future) and not answer.done():
                later.append(answer)
                return None
            return answer.result() if isinstance(answer, Future) else answer

        self._settle(job, ask, done, later)
        if later:
            self._mark(job)
            future = self._sent_ahead(job, later[0])
            self._waiting.append(_Waiting(job, later[0], future, time.monotonic()))
        else:
            self.scheduler.learn(job.kind, len(job), 1e3 * (time.perf_counter() - start))

    def _sent_ahead(self, job: Job, asked: Future) -> Future:
        """A future that is done once bricks from the host are checked and on their way: all that is
        left to the frame is to write them.
        """
        staging = self.staging
        if staging is None or job.kind != REQUEST_LOAD:
            return asked
        ahead: Future = Future()

        def go(asked: Future) -> None:
            try:
                ahead.set_result(send_ahead(job, asked.result(), staging))
            except BaseException as error:
                ahead.set_exception(error)

        asked.add_done_callback(go)
        return ahead

    def _settle(
        self,
        job: Job,
        result: Callable[[], Any],
        done: list[tuple[Job, Answer]],
        later: list[Future] | None = None,
    ) -> None:
        """Takes an answer. A producer that raises is asked again for each half of the batch, so
        that one bad item does not take the others with it.
        """
        try:
            answer = result()
        except Exception as error:
            self._raised += 1
            if len(job) == 1 or self._raised > _MOST_RAISES:
                self._fail(job, f"{type(error).__name__}: {error}", error)
                return
            half = len(job) // 2
            self._submit(job[:half], done)
            self._submit(job[half:], done)
            return
        if later:
            return
        try:
            checked = job.check(answer)
        except ValueError as error:
            self._fail(job, str(error), error)
            return
        bad = sorted(checked.errors)
        if bad:
            per_item = 1 if job.kind == REQUEST_LOAD else len(job.children) // len(job)
            named: dict[int, str] = {}
            for index in bad:
                named.setdefault(index // per_item, checked.errors[index])
            for item, message in named.items():
                self._fail(job[item : item + 1], message)
            keep = torch.ones(len(job), dtype=torch.bool)
            keep[list(named)] = False
            rows = keep.repeat_interleave(per_item).nonzero()[:, 0]
            job, checked = job[keep.nonzero()[:, 0]], select(checked, rows)
        if len(job):
            done.append((job, shipped(job, checked, self.staging)))

    def _mark(self, job: Job) -> None:
        wanted = self.cache.wanted(job.plant.tree, job.node, job.loc, job.kind)
        self.cache.mark_pending(job.node, job.kind, wanted)

    def _fail(self, job: Job, message: str, cause: BaseException | None = None) -> None:
        """Counts and names a job's items; they stay marked as pending, so nobody asks again."""
        self._mark(job)
        kind = next(name for name, value in KINDS.items() if value == job.kind)
        text = " ".join(message.split())
        for loc in job.loc.tolist():
            failure = Failure(tree=job.plant.name, kind=kind, loc=tuple(loc), message=text)
            self.failures.append(failure)
            self._failed.add((job.plant.name, job.kind, *loc))
        self._first = self._first or (self.failures[-1], cause)

    def _write_tiles(self, job: Job, answer: Regions) -> Written:
        return self.cache.write_tiles(
            job.plant.tree, job.node, job.loc, children_of(job, answer, self.cache)
        )

    def _write_bricks(
        self, job: Job, answer: Bricks | Sent, queue: deque[tuple[Job, Answer]]
    ) -> Written:
        tree, device = job.plant.tree, job.node.device
        if isinstance(answer, Bricks):
            groups = by_kind(job, answer)
            if len(groups) > 1:
                queue.extendleft((one, part) for _, one, part in groups)  # aliases come first
                return Written()
            what = groups[0][0]
            if what is Region.ALIAS:
                assert answer.alias is not None
                self._write_aliases(job, upload(answer.alias, device), queue)
                return Written()
            if what is Region.CONSTANT:
                assert answer.kind is not None
                word = torch.where(answer.kind == Region.CONSTANT, CONSTANT, EMPTY)
                word = upload(word.to(torch.int32), device)
                values = {name: upload(rows, device) for name, rows in answer.constants.items()}
                return self.cache.write_uniform(tree, job.node, job.loc, word, values)
            answer = shipped(job, answer, self.staging)
            if isinstance(answer, Bricks):
                return self.cache.write_bricks(tree, job.node, job.loc, answer.data)
        shipment = answer.shipment
        sent = shipment.sent
        if sent == len(job):
            return self.cache.write_bricks(tree, job.node, job.loc, shipment.parts)
        rest = job[sent:]
        self._mark(rest)
        self._held.append((rest, Bricks(data=shipment.rest)))
        if sent:
            queue.appendleft((job[:sent], Sent(Shipment(shipment.parts, sent, {}))))
        return Written()

    def _write_aliases(self, job: Job, same: Tensor, queue: deque[tuple[Job, Answer]]) -> None:
        """Shares the bricks of the nodes that others are the same as; where such a node is not
        here, its brick is made for the other alone.
        """
        tree = job.plant.tree
        target = tree.find(same)
        words = self.cache.nodes.brick_tn.view(-1)
        there = (target >= 0) & (words[target.clamp(min=0)] != ABSENT)
        self.cache.share_bricks(tree, job.node[there], job.loc[there], target[there])
        if bool(there.all()):
            return
        if job.same is not None:
            self._fail(job[~there], "an ALIAS of an ALIAS whose brick is not here")
            return
        done: list[tuple[Job, Answer]] = []
        alone = job[~there]
        self._submit(Job(alone.plant, alone.kind, alone.node, alone.loc, same[~there]), done)
        queue.extend(done)
