"""`Asker`: asks producers for request batches, and knows those whose answers are on their way. Its
subclasses say where answers go: `Production` into the pools, `HostFrame` to a recorded frame.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import torch

from ..base.messages import reason, with_type
from ..pool.staging import SentBricks
from ..producers import Bricks, Regions
from .request_batch import ProducedTree, RequestBatch

_MAX_RAISING_CALLS = 256  # for a batch and its parts, which are then given up whole

Answer = Regions | Bricks | SentBricks  # checked, without items that failed


@dataclass(frozen=True, eq=False)
class PendingBatch:
    """A batch whose answer is on its way."""

    batch: RequestBatch
    producer_future: Future  # what the producer returned
    answer_future: Future  # of the same answer, after bricks on the host were checked and sent
    asked_at: float  # time.monotonic()

    @property
    def seconds_left(self) -> float:
        """Seconds until it is given up."""
        return self.asked_at + self.batch.source.patience - time.monotonic()


class Asker(ABC):
    """Takes request batches from the call of their producer to the checked answer. If a producer
    raises, it is called again for each half of the batch. Any thread may use it.

    Attributes:
        generation: Batches whose own differs are dropped.
    """

    generation: int | None = None

    def __init__(self) -> None:
        self._lock = threading.Lock()  # held to read or change the list
        self._waiting: list[PendingBatch] = []

    @abstractmethod
    def _on_future(self, batch: RequestBatch, future: Future) -> None:
        """Takes a batch whose answer is on its way, and calls `_wait_for`."""

    @abstractmethod
    def _on_answer(self, batch: RequestBatch, answer: Answer) -> None:
        """Takes an answer, in the thread that settles its batch."""

    @abstractmethod
    def _fail(self, batch: RequestBatch, message: str, cause: BaseException | None) -> None:
        """Records a batch as failed, with the error if the producer raised one; its nodes stay
        pending, so that no ray asks again.
        """

    def _submit(self, batch: RequestBatch) -> bool:
        """Asks for a batch, and settles it if its answer comes at once; returns whether it does."""
        if batch.generation != self.generation:
            return False
        answer, raised = _try_call(batch.ask)
        if isinstance(answer, Future):
            if not answer.done():
                self._on_future(batch, answer)
                return False
            answer, raised = _try_call(answer.result)
        self._settle(batch, answer, raised)
        return True

    def _wait_for(self, batch: RequestBatch, producer: Future, answer: Future) -> PendingBatch:
        """Lists a batch as waiting; see `PendingBatch`."""
        item = PendingBatch(batch, producer, answer, time.monotonic())
        with self._lock:
            if batch.generation == self.generation:
                self._waiting.append(item)
        return item

    def _take(self, test: Callable[[PendingBatch], bool]) -> list[PendingBatch]:
        """Removes the batches that pass a test from those that wait, so that each is taken by one
        thread only; returns them, the oldest first.
        """
        with self._lock:
            taken = [item for item in self._waiting if test(item)]
            for item in taken:
                self._waiting.remove(item)
        return taken

    def _settle_late(self, item: PendingBatch) -> None:
        """Settles a batch that was taken once its answer had arrived."""
        self._settle(item.batch, *_try_call(item.answer_future.result))

    def _settle(self, batch: RequestBatch, answer: Any, raised: Exception | None) -> None:
        """Checks an answer; if the producer raised, asks it again for each half of the batch."""
        if raised is None:
            self._check(batch, answer)
        elif next(batch.raised) > _MAX_RAISING_CALLS or len(batch) == 1:
            self._fail(batch, with_type(raised), raised)
        else:  # asked separately, a bad node fails alone
            middle = len(batch) // 2
            for half in (batch[:middle], batch[middle:]):
                self._submit(half)

    def _check(self, batch: RequestBatch, answer: Any) -> None:
        """Passes on the valid part of an answer. A node fails with the first error among its items,
        and the whole batch if the answer has the wrong form.
        """
        if isinstance(answer, SentBricks):  # checked before they were sent
            self._on_answer(batch, answer)
            return
        try:
            checked = batch.check(answer)
        except Exception as error:  # a user's answer may hold anything
            self._fail(batch, reason(error), error)
            return
        if checked.errors:
            reasons: dict[int, str] = {}  # by index in the batch
            for item in sorted(checked.errors):
                reasons.setdefault(item // batch.per_node, checked.errors[item])
            for index, message in reasons.items():
                self._fail(batch[index : index + 1], message, None)
            kept = torch.ones(len(batch), dtype=torch.bool, device="cpu")
            kept[list(reasons)] = False
            items = kept.repeat_interleave(batch.per_node).nonzero()[:, 0]
            batch, checked = batch[kept.nonzero()[:, 0]], checked.rows(items)
        if len(batch):
            self._on_answer(batch, checked)

    def _give_up_overdue(self) -> None:
        """Fails the batches whose answers have not come in time."""
        for item in self._take(lambda item: item.seconds_left < 0):
            item.producer_future.cancel()
            self._fail(item.batch, item.batch.source.no_answer, None)

    def _cancel(self, source: ProducedTree | None = None) -> None:
        """Drops the answers that are on their way to a tree; None: all."""
        for item in self._take(lambda item: source in (None, item.batch.source)):
            item.producer_future.cancel()


def _try_call(call: Callable[[], Any]) -> tuple[Any, Exception | None]:
    """Calls a producer; returns its answer and None, or None and the error that it raised."""
    try:
        return call(), None
    except Exception as error:
        return None, error
