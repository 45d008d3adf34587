"""`Production`: asks producers for what was requested, and writes their answers, at once or later.

It joins producers, which know places, and the cache, which knows slots. A node that fails is
counted and named, is not asked for again, and takes no other with it: its ancestors stand in for
it. Bricks in host memory go to a CUDA device through `Staging`: those that come later are sent by
the thread that answers, and those that find no room are held back until the next frame.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..base.constants import ABSENT, CONSTANT, EMPTY, REQUEST_LOAD
from ..cache import KINDS, Cache, Scheduler, write
from ..cache.write import Targets, Written
from ..pool import Staging
from ..pool.staging import upload
from ..producers import Bricks, Region, Regions
from .failures import Failures
from .request_batch import (
    Answered,
    ProducedTree,
    RequestBatch,
    Sent,
    by_kind,
    children_of,
    select,
    send_ahead,
    shipped,
)
from .stats import FrameStats

_MOST_RAISES = 256  # calls in one frame that may raise before whole batches are given up
_LONGEST = 1e6  # seconds


@dataclass(frozen=True, eq=False)
class _Raised:
    """What a producer raised instead of an answer."""

    error: Exception


def _outcome(call: Callable[[], Any]) -> Any:
    """Returns what a call to a producer gave: `_Raised`, a `Future`, or the answer itself."""
    try:
        return call()
    except Exception as error:
        return _Raised(error)


@dataclass(frozen=True, eq=False)
class _Waiting:
    """A batch whose answer is on its way."""

    batch: RequestBatch
    asked: Future  # the producer's
    future: Future  # of its answer, which may have been sent to the device already
    patience: float  # seconds
    since: float  # time.monotonic()

    @property
    def left(self) -> float:
        """Seconds until it is given up."""
        return self.since + self.patience - time.monotonic()


class Production:
    """What is on its way from the producers into the pools.

    Attributes:
        failures: What failed.
        staging: The way of bricks from the host to a CUDA device; None where they are there.
    """

    def __init__(self, cache: Cache, scheduler: Scheduler, patience: float, strict: bool) -> None:
        """Waits for nothing yet."""
        self.cache, self.scheduler = cache, scheduler
        self.patience = patience
        self.failures = Failures(strict)
        self._raised = self._skipped = 0
        self._waiting: list[_Waiting] = []
        self._held: list[Answered] = []  # the staging ring had no room
        self.staging: Staging | None = None
        pool = cache.bricks
        if pool.stamp_b.device.type == "cuda":
            brick = sum(bricks[:1].nbytes for bricks in pool.bricks.values())
            most = scheduler.most[REQUEST_LOAD] * brick
            self.staging = Staging(most, brick, pool.stamp_b.device)

    @property
    def due(self) -> bool:
        """Whether an answer has come, or waits for room on the way, or its patience has ended."""
        return bool(self._held) or any(
            item.future.done() or item.left < 0 for item in self._waiting
        )

    @property
    def pending(self) -> dict[int, int]:
        """For each kind, the number of nodes whose answers are on their way."""
        batches = self._under_way()
        return {kind: sum(len(b) for b in batches if b.kind == kind) for kind in KINDS.values()}

    def ask(self, trees: Sequence[ProducedTree], chosen: Mapping[int, Tensor]) -> list[Answered]:
        """Asks for what was chosen; returns the answers that are here at once.

        Args:
            trees: All trees.
            chosen: For each kind the (k,) int64 nodes.
        """
        self._raised = 0
        answered: list[Answered] = []
        for kind, nodes in chosen.items():
            self.scheduler.spent[kind] += len(nodes)
            for source, node in self._by_tree(trees, nodes):
                targets = Targets(source.tree, node, source.tree.loc(node))
                batch = self._without_failed(RequestBatch(source, kind, targets))
                if len(batch):
                    answered += self._submit(batch)
        return answered

    def late(self) -> list[Answered]:
        """Returns the answers that came since the last call; gives up those that do not come."""
        answered = [*self._held]
        self._held.clear()
        for item in list(self._waiting):
            if item.future.done():
                seconds = time.monotonic() - item.since
                self.scheduler.learn(item.batch.kind, len(item.batch), 1e3 * seconds)
                answered += self._settle(item.batch, _outcome(item.future.result))
                self._waiting.remove(item)
            elif item.left < 0:
                self._waiting.remove(item)
                item.asked.cancel()
                self._fail(item.batch, f"no answer within {item.patience:g} s")
        return answered

    def write(self, answers: Sequence[Answered], stats: FrameStats) -> None:
        """Writes answers into the pools and adds up what they did."""
        stats.stale, self._skipped = stats.stale + self._skipped, 0
        queue = deque(answers)
        while queue:
            batch, answer = queue.popleft()
            if isinstance(answer, Regions):
                children = children_of(batch, answer, self.cache)
                self._add_up(batch, write.tiles(self.cache, batch.targets, children), stats)
            elif isinstance(answer, Sent):
                self._write_sent(batch, answer, stats)
            else:
                for kind, part in by_kind(batch, answer).items():
                    queue += self._write_bricks(kind, *part, stats)
        stats.pending, stats.failed = sum(self.pending.values()), len(self.failures)

    def wait(self, more: float = 0.0, limit: float = _LONGEST) -> None:
        """Waits until an answer is here, or until patience ends, at most `limit` seconds; then up
        to `more` seconds for the others.
        """
        if self._waiting and not self._held:
            left = min(item.left for item in self._waiting)
            futures = [item.future for item in self._waiting]
            longest = min(limit, max(0.0, left) + 1e-3)
            wait_for(futures, timeout=longest, return_when=FIRST_COMPLETED)
            wait_for(futures, timeout=more)

    def forget_failures(self) -> None:
        """Lets what failed be asked for again."""
        self.failures.forget()
        self.restore_pending()

    def restore_pending(self) -> None:
        """Marks as pending what is on its way and nothing else: after a frame that was broken off,
        or to forget failures.
        """
        words = self.cache.nodes.request_tn
        everything = torch.arange(words.numel(), device=words.device)
        for kind in KINDS.values():
            self.cache.mark_pending(everything, kind, False)
        for batch in self._under_way():
            self._mark(batch)

    def close(self) -> None:
        """Forgets what is on its way."""
        for item in self._waiting:
            item.asked.cancel()
        self._waiting.clear()
        self._held.clear()

    def __repr__(self) -> str:
        pending = sum(self.pending.values())
        return f"Production({pending} nodes on their way, {len(self.failures)} failed)"

    def _by_tree(
        self, trees: Sequence[ProducedTree], node: Tensor
    ) -> list[tuple[ProducedTree, Tensor]]:
        """The nodes of each tree, of those that have any."""
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

    def _without_failed(self, batch: RequestBatch) -> RequestBatch:
        """Leaves out what failed before its tile was given away: it is marked again."""
        failed = self.failures.among(batch)
        if failed is None:
            return batch
        again = batch[failed]
        self._mark(again)
        self._skipped += len(again)
        return batch[~failed]

    def _submit(self, batch: RequestBatch) -> list[Answered]:
        """Asks for a batch; returns what is answered at once."""
        start = time.perf_counter()
        outcome = _outcome(batch.ask)
        if isinstance(outcome, Future):
            if not outcome.done():
                self._wait_for(batch, outcome)
                return []
            outcome = _outcome(outcome.result)
        answered = self._settle(batch, outcome)
        self.scheduler.learn(batch.kind, len(batch), 1e3 * (time.perf_counter() - start))
        return answered

    def _wait_for(self, batch: RequestBatch, asked: Future) -> None:
        """Remembers that an answer comes later."""
        self._mark(batch)
        own = batch.source.producer.patience
        patience = self.patience if own is None else own
        future = self._sent_ahead(batch, asked)
        self._waiting.append(_Waiting(batch, asked, future, patience, time.monotonic()))

    def _sent_ahead(self, batch: RequestBatch, asked: Future) -> Future:
        """A future that is done once bricks from the host are checked and on their way: all that is
        left to the frame is to write them.
        """
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

    def _settle(self, batch: RequestBatch, outcome: Any) -> list[Answered]:
        """Checks an answer, or deals with an error. A producer that raised is asked again for each
        half of the batch, so that one bad node does not take the others with it.
        """
        if isinstance(outcome, _Raised):
            self._raised += 1
            if len(batch) == 1 or self._raised > _MOST_RAISES:
                error = outcome.error
                self._fail(batch, f"{type(error).__name__}: {error}", error)
                return []
            half = len(batch) // 2
            return [*self._submit(batch[:half]), *self._submit(batch[half:])]
        try:
            checked = batch.check(outcome)
        except ValueError as error:
            self._fail(batch, str(error), error)
            return []
        if checked.errors:
            per_node = 1 if batch.kind == REQUEST_LOAD else len(batch.children) // len(batch)
            named: dict[int, str] = {}
            for index in sorted(checked.errors):
                named.setdefault(index // per_node, checked.errors[index])
            for node, message in named.items():
                self._fail(batch[node : node + 1], message)
            keep = torch.ones(len(batch), dtype=torch.bool)
            keep[list(named)] = False
            rows = keep.repeat_interleave(per_node).nonzero()[:, 0]
            batch, checked = batch[keep.nonzero()[:, 0]], select(checked, rows)
        return [Answered(batch, shipped(batch, checked, self.staging))] if len(batch) else []

    def _write_bricks(
        self, kind: Region, batch: RequestBatch, answer: Any, stats: FrameStats
    ) -> list[Answered]:
        """Writes bricks of one kind; returns further answers: bricks made for aliases whose target
        is not here.
        """
        if kind is Region.ALIAS:
            return self._write_aliases(batch, upload(answer.alias, batch.targets.node.device))
        if kind is Region.CONSTANT:
            device = batch.targets.node.device
            word = torch.where(answer.kind == Region.CONSTANT, CONSTANT, EMPTY).to(torch.int32)
            constants = {name: upload(rows, device) for name, rows in answer.constants.items()}
            word = upload(word, device)
            written = write.uniform(self.cache, batch.targets, word, constants)
            self._add_up(batch, written, stats)
            return []
        answer = shipped(batch, answer, self.staging)
        if isinstance(answer, Sent):
            self._write_sent(batch, answer, stats)
        else:
            written = write.bricks(self.cache, batch.targets, answer.data)
            self._add_up(batch, written, stats)
        return []

    def _write_sent(self, batch: RequestBatch, answer: Sent, stats: FrameStats) -> None:
        """Writes voxels that are on their way to the device; holds back those that found no room
        there.
        """
        shipment = answer.shipment
        sent, rest = batch[: shipment.sent], batch[shipment.sent :]
        if len(rest):
            self._mark(rest)
            self._held.append(Answered(rest, Bricks(data=shipment.rest)))
        if len(sent):
            self._add_up(sent, write.bricks(self.cache, sent.targets, shipment.chunks), stats)

    def _write_aliases(self, batch: RequestBatch, alias: Tensor) -> list[Answered]:
        """Shares the bricks of alias targets (k, 4); where such a brick is not here, it is made for
        the alias alone.
        """
        tree, targets = batch.source.tree, batch.targets
        other = tree.find(alias)
        words = self.cache.nodes.brick_tn.view(-1)
        there = (other >= 0) & (words[other.clamp(min=0)] != ABSENT)
        write.share_bricks(self.cache, targets[there], other[there])
        if bool(there.all()):
            return []
        alone = batch[~there]
        if batch.fill_loc is not None:
            self._fail(alone, "an ALIAS of an ALIAS whose brick is not here")
            return []
        return self._submit(RequestBatch(batch.source, batch.kind, alone.targets, alias[~there]))

    def _add_up(self, batch: RequestBatch, written: Written, stats: FrameStats) -> None:
        """Adds what a write did to a frame's statistics; what found no slot may be asked for
        again.
        """
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
        """Counts and names a batch's nodes; they stay marked as pending: no ray asks again."""
        self._mark(batch)
        self.failures.add(batch, message, cause)
