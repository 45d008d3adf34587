"""Reading back what a traced frame counted. On CUDA the numbers come by a copy to pinned memory,
and the host goes on meanwhile: a frame's requests are served once its `Readback` has arrived.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..base.records import add
from ..cache import KINDS, RequestList
from .stats import FrameStats

_AHEAD = 3  # most frames that the host may be ahead of the device


class Counts(NamedTuple):
    """What the host is told of a frame."""

    listed: int  # nodes with a request, as far as the list has places
    found: int  # nodes with a request
    misses: int  # and those whose answer is pending
    load: int  # requests of each kind
    subdivide: int
    tiles_unused: int
    tiles_used: int
    bricks_unused: int
    bricks_used: int
    samples: int

    def by_kind(self) -> dict[str, int]:
        """Returns the number of requests by the name of their kind."""
        return {name: getattr(self, name) for name in KINDS}


@dataclass(frozen=True, eq=False, repr=False)
class Collected:
    """What a traced frame leaves on the device."""

    requests: RequestList
    numbers: Tensor  # (10,) int64 `Counts`

    def read(self) -> Counts:
        """Returns the counts; waits for the device."""
        return Counts(*self.numbers.tolist())


class Readback:
    """A frame whose counts are on their way to the host.

    Attributes:
        stats: Of the frame; completed when the counts are here.
        requests: Of the frame, on the device.
    """

    def __init__(self, stats: FrameStats, collected: Collected) -> None:
        """Starts the copy."""
        self.stats, self.requests = stats, collected.requests
        self._pending = stats.pending > 0  # answers were on their way while it was traced
        self._numbers, self._event = collected.numbers, None
        self._counts: Counts | None = None
        if collected.numbers.is_cuda:
            like = collected.numbers
            self._numbers = torch.empty(like.shape, dtype=like.dtype, pin_memory=True)
            self._numbers.copy_(like, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(like.device))
        stats.later(self._complete)

    @property
    def arrived(self) -> bool:
        """Whether the counts are here."""
        return self._event is None or self._event.query()

    def wait(self) -> Counts:
        """Returns the counts; waits until they are here."""
        if self._counts is None:
            if self._event is not None:
                self._event.synchronize()
            self._counts = Counts(*self._numbers.tolist())
        return self._counts

    def converged(self) -> bool:
        """Whether nothing that could be served was missing; waits until the counts are here."""
        return not (self.wait().found or self._pending)

    def _complete(self) -> None:
        """Sets what `FrameStats` waits for."""
        stats, counts = self.stats, self.wait()
        add(stats.requests, counts.by_kind())
        stats.misses, stats.overflow = counts.misses, counts.found - counts.listed
        stats.tiles_used, stats.bricks_used = counts.tiles_used, counts.bricks_used
        stats.samples, stats.converged = counts.samples, self.converged()


class Readbacks:
    """The frames whose counts are on their way, oldest first."""

    def __init__(self) -> None:
        """Starts with none."""
        self._queue: deque[Readback] = deque()
        self._steady = False

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._queue)

    def start(self, stats: FrameStats, collected: Collected) -> None:
        """Starts reading back a frame."""
        self._queue.append(Readback(stats, collected))

    def catch_up(self, wait: bool) -> Readback | None:
        """Takes all frames whose counts are here. Waits for those of the others if `wait` is true,
        if a frame is known to have requests, or if the host is too far ahead.

        Returns:
            The newest frame taken.
        """
        newest = None
        while self._queue and (
            self._queue[0].arrived
            or (wait or self._too_many)
            or (newest is not None and newest.wait().listed > 0)
        ):
            newest = self._take()
        return newest

    def hold_back(self) -> None:
        """Waits for the oldest frames while the host is too far ahead of the device."""
        while self._too_many:
            self._take()

    @property
    def steady(self) -> bool:
        """True if the newest frame read back had converged; does not block."""
        for readback in self._queue:
            if readback.arrived:
                self._steady = readback.converged()
        return self._steady

    @property
    def _too_many(self) -> bool:
        return len(self._queue) > _AHEAD

    def _take(self) -> Readback:
        readback = self._queue.popleft()
        self._steady = readback.converged()
        readback.stats.settle()
        return readback
