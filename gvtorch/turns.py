"""`Turns`: which rays of a converging picture are traced next.

A ray that missed nothing is done. The others are traced again, all of them while that helps. Where
the pools are full of what these rays use and none comes to its end, fewer are traced, so that what
the others used makes room: half as many each time nothing moves, twice as many after a group is
done. Source: the original engine suspends rays and takes several passes for quality; Crassin, PhD
thesis 2011.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .frame import FrameStats


class Turns:
    """The state of a picture's rays.

    Attributes:
        count: Number of rays.
        now: (count,) bool, to be traced next.
        over: Nothing is left to trace, or tracing does not help.
        stuck: The last pass moved nothing.
        crowded: Rays had to take turns.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        """Starts with all rays."""
        self.count = count
        self._open = torch.ones(count, dtype=torch.bool, device=device)
        self._size = count
        self.now = self._open.clone()
        self.over = self.stuck = self.crowded = False
        self._given_up = 0

    @property
    def done(self) -> int:
        """Rays that need no more passes."""
        return self.count - int(self._open.sum())

    @property
    def whole(self) -> bool:
        """Every ray got all that could be served."""
        return not self._given_up and not bool(self._open.any())

    def take(self, missed: Tensor, stats: FrameStats, failed: int) -> None:
        """Learns what a pass did.

        Args:
            missed: (count,) bool, of the rays that were traced.
            stats: What the pass cost.
            failed: Nodes that had failed before it.
        """
        # Where nothing could be served, what is missing has failed: these rays are as good as ever.
        finished = self.now if stats.converged else self.now & ~missed
        self._open &= ~finished
        moved = sum(stats.produced.values()) + stats.stale > 0 or stats.failed > failed
        self.stuck = not moved and not bool(finished.any())
        left = self.now & self._open
        if self.stuck and not stats.pending:
            if not stats.capacity_exceeded:
                self.over = True
                return
            self.crowded = True
            self._size = int(left.sum()) // 2
            if self._size == 0:  # one ray alone does not fit
                self._given_up += 1
                self._open &= ~left
                self._size = 1
                left = torch.zeros_like(left)
        elif not left.any():
            self._size = min(self.count, 2 * self._size)
        source = left if left.any() else self._open
        self.now = source & (source.cumsum(0) <= self._size)
        self.over = not bool(self._open.any())
