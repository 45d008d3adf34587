"""`Production`: asks producers for what is wanted, and takes their answers, at once or later.

It joins producers, which know places, and the cache, which knows slots. An item that fails is
counted and named, is not asked for again, and takes nobody with it: its ancestors go on standing in
for it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .cache import KINDS, Cache, Children, Requests, Scheduler, Written
from .config import (
    ABSENT,
    CONSTANT,
    EMPTY,
    REQUEST_LOAD,
    TERMINAL,
)
from .frame import FrameStats
from .pool import N3Tree
from .producers import Bricks, Layout, Nodes, Producer, Region, Regions
from .producers.answer import checked_bricks, checked_regions
from .volume import movable

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
class Plant:
    """A tree and what makes it grow."""

    name: str
    tree: N3Tree
    producer: Producer
    layout: Layout


@dataclass(frozen=True, eq=False)
class Job:
    """Items asked for together."""

    plant: Plant
    kind: int
    node: Tensor  # (k,) int64: nodes to fill, or to subdivide
    loc: Tensor  # (k, 4) their places
    same: Tensor | None = None  # (k, 4) places that are filled in their stead: they are aliases

    def __len__(self) -> int:
        return len(self.node)

    def __getitem__(self, index: slice | Tensor) -> Job:
        same = None if self.same is None else self.same[index]
        return Job(self.plant, self.kind, self.node[index], self.loc[index], same)

    @property
    def bricks(self) -> Nodes:
        """What a producer is asked to fill."""
        return Nodes(self.loc if self.same is None else self.same, self.plant.layout)

    def ask(self) -> Any:
        """Calls the producer."""
        if self.kind == REQUEST_LOAD:
            return self.plant.producer.fill(self.bricks)
        return self.plant.producer.classify(self.children())

    def children(self) -> Nodes:
        """All children of all nodes, node after node."""
        n = self.plant.layout.branching
        child = torch.arange(n**3, device=self.loc.device)
        digits = torch.stack((child % n, child // n % n, child // n**2, torch.ones_like(child)), 1)
        factor = torch.tensor([n, n, n, 1], device=self.loc.device)
        return Nodes(((self.loc * factor)[:, None] + digits).flatten(0, 1), self.plant.layout)

    def check(self, answer: Any) -> Regions | Bricks:
        """Checks an answer; see producers/answer.py."""
        if self.kind == REQUEST_LOAD:
            return checked_bricks(answer, self.bricks, self.plant.producer)
        return checked_regions(answer, self.children(), self.plant.producer)


@dataclass(frozen=True, eq=False)
class _Waiting:
    job: Job
    future: Future
    since: float  # time.monotonic()


class Production:
    """What is on its way, and what failed.

    Attributes:
        failures: The last failures, by name.
        strict: A failure raises `ProductionError` at the end of its frame.
    """

    def __init__(self, cache: Cache, scheduler: Scheduler, patience: float, strict: bool) -> None:
        """Waits for nothing yet."""
        self.cache, self.scheduler = cache, scheduler
        self.patience, self.strict = patience, strict
        self.failures: deque[Failure] = deque(maxlen=_KEPT_FAILURES)
        self._failed: set[tuple[Any, ...]] = set()  # tree, kind, x, y, z, depth
        self._raised = self._skipped = 0
        self._waiting: list[_Waiting] = []
        self._first: tuple[Failure, BaseException | None] | None = None

    @property
    def failed(self) -> int:
        """Number of nodes that failed."""
        return len(self._failed)

    @property
    def due(self) -> bool:
        """Whether an answer has come, or its patience has ended."""
        now = time.monotonic()
        return any(
            item.future.done() or now - item.since > self._patience(item.job)
            for item in self._waiting
        )

    @property
    def pending(self) -> dict[int, int]:
        """For each kind, the items whose answers are on their way."""
        return {
            kind: sum(len(w.job) for w in self._waiting if w.job.kind == kind)
            for kind in KINDS.values()
        }

    def late(self) -> list[tuple[Job, Regions | Bricks]]:
        """Returns the answers that came since the last call; gives up those that do not come."""
        done: list[tuple[Job, Regions | Bricks]] = []
        for item in list(self._waiting):
            if item.future.done():
                seconds = time.monotonic() - item.since
                self.scheduler.learn(item.job.kind, len(item.job), 1e3 * seconds)
                self._settle(item.job, item.future.result, done)
                self._waiting.remove(item)
            elif time.monotonic() - item.since > self._patience(item.job):
                self._waiting.remove(item)
                item.future.cancel()
                self._fail(item.job, f"no answer within {self._patience(item.job):g} s")
        return done

    def ask(self, plants: list[Plant], chosen: Requests) -> list[tuple[Job, Regions | Bricks]]:
        """Asks for what was chosen; returns the answers that are here at once."""
        self._raised = 0
        done: list[tuple[Job, Regions | Bricks]] = []
        tree = self.cache.nodes.tree_t[chosen.node // self.cache.nodes.nodes_per_tile]
        for kind in KINDS.values():
            for number, plant in enumerate(plants):
                node = chosen.node[(chosen.kind == kind) & (tree == number)]
                job = self._without_failed(Job(plant, kind, node, plant.tree.loc(node)))
                if len(job):
                    self._submit(job, done)
        return done

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

    def write(self, answers: list[tuple[Job, Regions | Bricks]], stats: FrameStats) -> None:
        """Writes answers into the pools and adds up what they did."""
        stats.stale, self._skipped = stats.stale + self._skipped, 0
        queue = deque(answers)
        while queue:
            job, answer = queue.popleft()
            if isinstance(answer, Bricks):
                written = self._write_bricks(job, answer, queue)
            else:
                written = self._write_tiles(job, answer)
            name = "bricks" if job.kind == REQUEST_LOAD else "tiles"
            stats.produced[name] += written.items
            stats.produced["constant"] += written.constant
            stats.evicted[name] += written.evicted
            stats.stale += written.stale
            stats.bytes_uploaded += written.nbytes
            stats.capacity_exceeded |= written.unplaced > 0
            if written.lost is not None and bool(written.lost.any()):
                self.cache.mark_pending(job.node[written.lost], job.kind, False)

    def wait(self, more: float = 0.0, limit: float = _LONGEST) -> None:
        """Waits until an answer is here, or until patience ends, at most `limit` seconds; then up
        to `more` seconds for the others.
        """
        if self._waiting:
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
            for item in self._waiting:
                if item.job.kind == kind:
                    self._mark(item.job)

    def close(self) -> None:
        """Forgets what is on its way."""
        for item in self._waiting:
            item.future.cancel()
        self._waiting.clear()

    def _submit(self, job: Job, done: list[tuple[Job, Regions | Bricks]]) -> None:
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
            self._waiting.append(_Waiting(job, later[0], time.monotonic()))
        else:
            self.scheduler.learn(job.kind, len(job), 1e3 * (time.perf_counter() - start))

    def _settle(
        self,
        job: Job,
        result: Callable[[], Any],
        done: list[tuple[Job, Regions | Bricks]],
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
            per_item = 1 if job.kind == REQUEST_LOAD else len(job.children()) // len(job)
            named: dict[int, str] = {}
            for index in bad:
                named.setdefault(index // per_item, checked.errors[index])
            for item, message in named.items():
                self._fail(job[item : item + 1], message)
            keep = torch.ones(len(job), dtype=torch.bool, device=job.node.device)
            keep[list(named)] = False
            job, checked = job[keep], _select(checked, keep.repeat_interleave(per_item))
        if len(job):
            done.append((job, checked))

    def _mark(self, job: Job) -> None:
        wanted = self.cache.wanted(job.plant.tree, job.node, job.loc, job.kind)
        self.cache.mark_pending(job.node[wanted], job.kind)

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
        self, job: Job, answer: Bricks, queue: deque[tuple[Job, Regions | Bricks]]
    ) -> Written:
        tree, kind = job.plant.tree, answer.kind
        assert kind is not None
        alias = kind == Region.ALIAS
        if answer.alias is not None:
            self._write_aliases(job[alias], answer.alias[alias], queue)
            job, answer, kind = job[~alias], _select(answer, ~alias), kind[~alias]
        word = torch.zeros_like(kind, dtype=torch.int32)
        word[kind == Region.CONSTANT], word[kind == Region.EMPTY] = CONSTANT, EMPTY
        return self.cache.write_bricks(tree, job.node, job.loc, word, answer.data, answer.constants)

    def _write_aliases(
        self, job: Job, same: Tensor, queue: deque[tuple[Job, Regions | Bricks]]
    ) -> None:
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
        done: list[tuple[Job, Regions | Bricks]] = []
        alone = job[~there]
        self._submit(Job(alone.plant, alone.kind, alone.node, alone.loc, same[~there]), done)
        queue.extend(done)


def children_of(job: Job, answer: Regions, cache: Cache) -> Children:
    """Turns a producer's regions into the words of tiles."""
    layout, count = job.plant.layout, len(job)
    nodes = job.children()
    kind = answer.kind
    step = nodes.scale * layout.brick_size
    low = nodes.loc[:, :3] * step[:, None]
    extent = torch.tensor(layout.extent, dtype=torch.float64, device=low.device)
    kind = torch.where((low >= extent).any(1), Region.EMPTY, kind)
    leaf = (kind == Region.EMPTY) | (kind == Region.CONSTANT) | (kind == Region.DATA_MAX_DEPTH)
    leaf |= nodes.depth >= layout.depth
    child = torch.where(leaf, TERMINAL, ABSENT).to(torch.int32)
    brick = torch.full_like(child, ABSENT)
    brick[kind == Region.EMPTY], brick[kind == Region.CONSTANT] = EMPTY, CONSTANT

    def by_tile(values: Tensor) -> Tensor:
        return values.unflatten(0, (count, -1))

    constants = dict(answer.constants)
    for name, words in cache.nodes.constants.items():  # also what another tree left in these tiles
        if name not in constants:
            constants[name] = words.new_zeros((len(kind), words.shape[-1]))
    ranges = dict(answer.ranges)
    for name in cache.nodes.ranges:
        if name in ranges:
            continue
        ranges[name] = unknown_range(cache, name, len(kind))
        if name in answer.constants:
            ends = movable(answer.constants[name])[:, None].expand(-1, 2, -1)
            uniform = (kind == Region.CONSTANT)[:, None, None]
            merged = torch.where(uniform, ends, movable(ranges[name]))
            ranges[name] = merged.view(ranges[name].dtype)
    return Children(
        child=by_tile(child),
        brick=by_tile(brick),
        constants={name: by_tile(values) for name, values in constants.items()},
        ranges={name: by_tile(values) for name, values in ranges.items()},
        is_alias=by_tile(kind == Region.ALIAS),
        alias=None if answer.alias is None else by_tile(answer.alias),
    )


def unknown_range(cache: Cache, name: str, count: int) -> Tensor:
    """(k, 2, c) all that a channel can hold."""
    channel = cache.bricks.channels[name]
    ends = torch.tensor(channel.limits, dtype=torch.float64).to(channel.dtype)
    device = cache.nodes.child_tn.device
    return ends.to(device)[None, :, None].expand(count, 2, channel.width)


def _select(answer: Any, keep: Tensor) -> Any:
    """The items of an answer that `keep` names, errors left out."""

    def rows(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value[keep]
        if isinstance(value, dict):
            return {name: tensor[keep] for name, tensor in value.items()}
        return value

    fields = {name: rows(value) for name, value in vars(answer).items() if name != "errors"}
    return type(answer)(**fields, errors={})
