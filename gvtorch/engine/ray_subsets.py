"""Which rays are traced next: `RaySubsets` of a converging picture, `scouts` of the next frame.

A ray that missed nothing is done; the others are traced again. At first these are scouts: one of
16 x 16 pixels while the tree is coarse, then one of 4 x 4: a brick is wider than that on the
screen, so they miss almost all that the others would, for a sixteenth of the work. Then come all
that are not done. Where the pools are full of what these rays use and none of them gets done, fewer
are traced, which frees what the others used: half as many each time nothing moves, twice as many
after a subset is done. Source: the original engine suspends rays and takes several passes for
quality; Crassin, PhD thesis 2011.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .stats import FrameStats

_STRIDES = (16, 4)  # pixels from scout to scout
_FEW = 16  # if no more than one ray of so many misses something, the next ones are not kept waiting


class RaySubsets:
    """The state of a picture's `count` rays.

    Attributes:
        done: Number of rays that need no more passes.
        next: (count,) bool, to be traced next.
        over: Nothing is left to trace, or tracing does not help.
        crowded: The pools were too small for all rays at once.
    """

    def __init__(self, count: int, width: int, device: torch.device, *, ahead: bool) -> None:
        """Starts with the scouts if `ahead` is true, as something will be missing, else with all
        rays; `width` is a row's, in pixels.
        """
        self.count = count
        self._grids = [_grid(count, width, stride, device) for stride in _STRIDES]
        self._sizes = [int(grid.sum()) for grid in self._grids]
        self._open = torch.ones(count, dtype=torch.bool, device=device)
        self._size = count
        self.next, self._scouts = self._open.clone(), 0
        if ahead:
            self._choose(self._open, self._sizes)
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
        counted = [finished, left, self._open]
        counted += [group & grid for group in (left, self._open) for grid in self._grids]
        sums = torch.stack([rays.sum() for rays in counted]).tolist()
        just_done, remaining, unfinished, *scouts = sums
        of_left, of_open = scouts[: len(_STRIDES)], scouts[len(_STRIDES) :]
        moved = sum(stats.produced.values()) + stats.stale > 0 or stats.failed > failed
        self.done = self.count - unfinished
        if not (moved or just_done or stats.pending):
            if not stats.capacity_exceeded:
                self.over = remaining == unfinished
                self.trace_all()  # those that waited for scouts
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
        if remaining * _FEW <= self._scouts:
            self._choose(self._open, of_open)
        else:
            self._choose(left, of_left)
        self.next &= self.next.cumsum(0) <= self._size
        self.over = self.done == self.count

    def _choose(self, group: Tensor, in_grids: Sequence[int]) -> None:
        """Lets a group's scouts be traced next, all of the group where they are few; `in_grids`
        tells how many of the group lie on each grid.
        """
        for grid, size, here in zip(self._grids, self._sizes, in_grids, strict=True):
            if here * _FEW > size:
                self.next, self._scouts = group & grid, size
                return
        self.next, self._scouts = group.clone(), 0

    def trace_all(self) -> None:
        """Lets all rays that are not done be traced next: it is the last pass."""
        self.next, self._scouts = self._open.clone(), 0


def scouts(missed: Tensor, width: int) -> Tensor:
    """Returns which rays are sent ahead of the next picture, whose rows have `width` pixels: all
    that `missed` (r,) something where these are at most a sixteenth, else one of 4 x 4 pixels.
    """
    few = missed.sum() * _STRIDES[-1] ** 2 <= len(missed)
    return missed & (few | _grid(len(missed), width, _STRIDES[-1], missed.device))


def _grid(count: int, width: int, stride: int, device: torch.device) -> Tensor:
    """(count,) bool, one of stride x stride pixels."""
    pixel = torch.arange(count, device=device)
    return (pixel % width % stride == 0) & (pixel // width % stride == 0)
