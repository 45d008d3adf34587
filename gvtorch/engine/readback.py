"""`Arrivals`: what traced frames count, on its way to the host, which does not wait for it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from torch import Tensor

from ..base.records import Counts, FrameStats, add
from ..cache import KINDS, Listed

_AHEAD = 3  # most frames that the host may be ahead of the device


class Numbers(NamedTuple):
    """What the host is told of a frame."""

    listed: int  # nodes
    found: int
    misses: int
    load: int  # wishes of each kind
    subdivide: int
    tiles_unused: int
    tiles_used: int
    bricks_unused: int
    bricks_used: int
    samples: int

    def wishes(self) -> dict[str, int]:
        """Returns the wishes by kind."""
        return {name: getattr(self, name) for name in KINDS}


@dataclass(eq=False)
class Traced:
    """A traced frame whose counts are on their way."""

    stats: FrameStats
    listed: Listed
    counts: Counts
    late: int  # answers that were on their way while it was traced

    @cached_property
    def numbers(self) -> Numbers:
        """The counts; waits until they are here."""
        return Numbers(*self.counts.read())

    def arrive(self) -> None:
        """Completes the statistics."""
        stats, numbers = self.stats, self.numbers
        add(stats.requests, numbers.wishes())
        stats.misses, stats.overflow = numbers.misses, numbers.found - numbers.listed
        stats.tiles_used, stats.bricks_used = numbers.tiles_used, numbers.bricks_used
        stats.samples = numbers.samples
        stats.converged = not (numbers.found or self.late)


class Arrivals:
    """The frames whose counts are on their way, oldest first."""

    def __init__(self) -> None:
        """Starts with none."""
        self._traced: deque[Traced] = deque()
        self._steady = False

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._traced)

    def send(self, stats: FrameStats, listed: Listed, numbers: Tensor) -> None:
        """Sends the counts (10,) int64 of a frame off; its statistics are complete when they
        come.
        """
        traced = Traced(stats, listed, Counts(numbers), stats.pending)
        stats.later(traced.arrive)
        self._traced.append(traced)

    def take(self) -> Traced:
        """Takes the oldest frame; waits until its counts are here."""
        traced = self._traced.popleft()
        self._steady = traced.stats.converged
        return traced

    def catch_up(self, wait: bool) -> Traced | None:
        """Takes all frames whose counts are here, and waits for those of the others if `wait` is
        true, if a frame is known to have missed something, or if there are too many; returns the
        last one taken.
        """
        last = None
        while self._traced and (
            self._traced[0].counts.here
            or (wait or self.crowded)
            or (last is not None and last.numbers.listed > 0)
        ):
            last = self.take()
        return last

    @property
    def crowded(self) -> bool:
        """Whether the host is too far ahead of the device."""
        return len(self._traced) > _AHEAD

    @property
    def steady(self) -> bool:
        """Whether the last frame whose counts are here missed nothing; nobody waits."""
        for traced in self._traced:
            if traced.counts.here:
                self._steady = traced.stats.converged
        return self._steady
