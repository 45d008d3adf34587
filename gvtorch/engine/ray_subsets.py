"""Chooses the rays to trace next: `RaySubsets` in a converging picture, `scouts` before a frame.

A ray that missed nothing is done; the others are traced again. The first passes trace scouts alone:
one ray per 16 x 16 pixels while the tree is coarse, then per 4 x 4. A brick is wider than that on
the screen, so scouts miss almost all that the others would, for a sixteenth of the work. Then all
rays that are not done follow. If the pools are full and no ray gets done, half as many are traced,
and the slots of what the others used become free; after a subset is done, twice as many. Source:
the original engine suspends rays and takes several passes for quality; Crassin, PhD thesis 2011.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .stats import FrameStats

_STRIDES = (16, 4)  # pixels between scouts
_FEW_DIVISOR = 16  # if at most one scout in this many misses something, more rays are traced


class RaySubsets:
    """The state of a picture's `count` rays.

    Attributes:
        done: Number of rays that need no more passes.
        next: (count,) bool, which rays to trace next.
        over: True if no ray is left to trace, or tracing does not help.
        crowded: True if the pools were too small for all rays at once.
    """

    def __init__(self, count: int, width: int, device: torch.device, *, scouts_first: bool) -> None:
        """Starts with scouts if `scouts_first` is true, because something will be missing, else
        with all rays; `width` is the number of pixels in a row.
        """
        self.count = count
        self._grids = [_grid(count, width, stride, device) for stride in _STRIDES]
        self._grid_sizes = [int(grid.sum()) for grid in self._grids]
        self._unfinished = torch.ones(count, dtype=torch.bool, device=device)
        self._subset_size = count
        self.next, self._scout_count = self._unfinished.clone(), 0
        if scouts_first:
            self._choose(self._unfinished, self._grid_sizes)
        self.over = self.crowded = self._given_up = False
        self.done = 0

    @property
    def complete(self) -> bool:
        """True if every ray got all that could be served."""
        return not self._given_up and self.done == self.count

    def update(self, missed: Tensor, stats: FrameStats, failed: int) -> None:
        """Chooses the next subset, given the last pass: its `stats`, which rays `missed` (count,)
        something, and how many nodes had `failed` before it. Waits for the device.
        """
        # A converged pass can't be improved: what its rays still miss has failed.
        finished = self.next if stats.converged else self.next & ~missed
        self._unfinished &= ~finished
        remaining = self.next & self._unfinished
        masks = [finished, remaining, self._unfinished]
        masks += [group & grid for group in (remaining, self._unfinished) for grid in self._grids]
        sums = torch.stack([rays.sum() for rays in masks]).tolist()
        finished_count, remaining_count, unfinished_count, *grid_counts = sums
        of_remaining, of_unfinished = grid_counts[: len(_STRIDES)], grid_counts[len(_STRIDES) :]
        progressed = sum(stats.produced.values()) + stats.stale > 0 or stats.failed > failed
        self.done = self.count - unfinished_count
        if not (progressed or finished_count or stats.pending):
            if not stats.capacity_exceeded:
                self.over = remaining_count == unfinished_count
                self.trace_all()  # the rays that waited for scouts
                return
            self.crowded = True
            self._subset_size = remaining_count // 2
            if self._subset_size == 0:  # one ray alone does not fit
                self._given_up = True
                self._unfinished &= ~remaining
                self.done += remaining_count
                self._subset_size, remaining_count = 1, 0
        elif not remaining_count:
            self._subset_size = min(self.count, 2 * self._subset_size)
        if remaining_count * _FEW_DIVISOR <= self._scout_count:
            self._choose(self._unfinished, of_unfinished)
        else:
            self._choose(remaining, of_remaining)
        self.next &= self.next.cumsum(0) <= self._subset_size
        self.over = self.done == self.count

    def _choose(self, group: Tensor, in_grids: Sequence[int]) -> None:
        """Sets the next pass to the group's rays on one grid: the coarsest that has more than 1/16
        of its rays in the group. If none has, to the whole group. `in_grids` is the number of the
        group's rays on each grid.
        """
        for grid, size, in_grid in zip(self._grids, self._grid_sizes, in_grids, strict=True):
            if in_grid * _FEW_DIVISOR > size:
                self.next, self._scout_count = group & grid, size
                return
        self.next, self._scout_count = group.clone(), 0

    def trace_all(self) -> None:
        """Sets the next pass to all rays that are not done."""
        self.next, self._scout_count = self._unfinished.clone(), 0


def scouts(missed: Tensor, width: int) -> Tensor:
    """Returns (r,) bool, the rays to trace before the next picture, whose rows have `width` pixels:
    all that `missed` (r,) something if these are at most a sixteenth, else one of 4 x 4 pixels.
    """
    few = missed.sum() * _STRIDES[-1] ** 2 <= len(missed)
    return missed & (few | _grid(len(missed), width, _STRIDES[-1], missed.device))


def _grid(count: int, width: int, stride: int, device: torch.device) -> Tensor:
    """Returns (count,) bool, true for one of stride x stride pixels."""
    pixel = torch.arange(count, device=device)
    return (pixel % width % stride == 0) & (pixel // width % stride == 0)
