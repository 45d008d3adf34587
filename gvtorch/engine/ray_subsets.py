"""Which rays are traced next: `RaySubsets` of a converging picture, `scouts` of the next frame.

A ray that missed nothing is done; the others are traced again. At first these are scouts, one of
4 x 4 pixels: a brick is wider than that on the screen, so they miss almost all that the others
would, for a sixteenth of the work. Then come all that are not done. Where the pools are full of
what these rays use and none of them gets done, fewer are traced, which frees what the others used:
half as many each time nothing moves, twice as many after a subset is done. Source: the original
engine suspends rays and takes several passes for quality; Crassin, PhD thesis 2011.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .stats import FrameStats

_STRIDE = 4  # pixels from scout to scout


class RaySubsets:
    """The state of a picture's `count` rays.

    Attributes:
        done: Number of rays that need no more passes.
        next: (count,) bool, to be traced next.
        over: Nothing is left to trace, or tracing does not help.
        crowded: The pools were too small for all rays at once.
    """

    def __init__(self, count: int, width: int, device: torch.device) -> None:
        """Starts with all rays, so that each has a colour; `width` is a row's, in pixels."""
        self.count = count
        self._scouts = _grid(count, width, device)
        self._open = torch.ones(count, dtype=torch.bool, device=device)
        self._size = count
        self.next = self._open.clone()
        self.over = self.crowded = self._given_up = False
        self.done = 0

    @property
    def whole(self) -> bool:
        """Every ray got all that could be served."""
        return not self._given_up and self.done == self.count

    def update(self, missed: Tensor, stats: FrameStats, failed: int) -> None:
        """Chooses the next subset, given what the last pass cost, which rays `missed` (count,)
        something in it, and how many nodes had `failed` before it. Waits for the device.
        """
        # Where nothing could be served, what is missing has failed: these rays are as good as ever.
        finished = self.next if stats.converged else self.next & ~missed
        self._open &= ~finished
        left = self.next & self._open
        sums = torch.stack([rays.sum() for rays in (finished, left, self._open)])
        just_done, remaining, unfinished = sums.tolist()
        moved = sum(stats.produced.values()) + stats.stale > 0 or stats.failed > failed
        self.done = self.count - unfinished
        if not (moved or just_done or stats.pending):
            if not stats.capacity_exceeded:
                self.over = True
                return
            self.crowded = True
            self._size = remaining // 2
            if self._size == 0:  # one ray alone does not fit
                self._given_up = True
                self._open &= ~left
                self.done += remaining
                self._size, remaining = 1, 0
        elif not remaining:
            self._size = min(self.count, 2 * self._size)
        group = left if remaining else self._open
        ahead = group & self._scouts
        first = torch.where(ahead.any(), ahead, group)
        self.next = first & (first.cumsum(0) <= self._size)
        self.over = self.done == self.count

    def trace_all(self) -> None:
        """Lets all rays that are not done be traced next: it is the last pass."""
        self.next = self._open.clone()


def scouts(missed: Tensor, width: int) -> Tensor:
    """Returns which rays are sent ahead of the next picture, whose rows have `width` pixels: all
    that `missed` (r,) something where these are at most a sixteenth, else one of 4 x 4 pixels.
    """
    few = missed.sum() * _STRIDE**2 <= len(missed)
    return missed & (few | _grid(len(missed), width, missed.device))


def _grid(count: int, width: int, device: torch.device) -> Tensor:
    """(count,) bool, one of 4 x 4 pixels."""
    pixel = torch.arange(count, device=device)
    return (pixel % width % _STRIDE == 0) & (pixel // width % _STRIDE == 0)
