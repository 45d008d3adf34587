"""`LRU`: slots of a pool in order of use."""

from __future__ import annotations

import torch
from torch import Tensor

from ..ops import lru_partition


class LRU:
    """The order in which slots are given away: least recently used first.

    Attributes:
        order: (k,) int32 slots without the locked ones, changed in place: CUDA graphs read it.
        unused: How many at the front the last picture did not use; these may be taken.
    """

    def __init__(self, capacity: int, locked: int, device: torch.device) -> None:
        """Starts with slots `locked` to `capacity`, all free."""
        self.order = torch.arange(locked, capacity, dtype=torch.int32, device=device)
        self.unused = len(self.order)

    def sort(self, stamp: Tensor, frame: Tensor) -> Tensor:
        """Moves the slots that were not used in a frame to the front, each part in its old order.

        Args:
            stamp: (capacity,) int32 frame in which a slot was last used.
            frame: (1,) int32 the frame.

        Returns:
            (1,) int64 number of unused slots; `unused` is set once the host knows it.
        """
        order, unused = lru_partition(self.order, stamp, frame)
        self.order.copy_(order)
        return unused

    def take(self, count: int) -> Tensor:
        """Returns (count,) int32 slots from the front, and moves them to the back.

        Raises:
            ValueError: Fewer slots are unused.
        """
        if count > self.unused:
            raise ValueError(f"LRU: {count} slots wanted, {self.unused} are unused")
        taken = self.order[:count].clone()
        self.order.copy_(self.order.roll(-count))
        self.unused -= count
        return taken

    def __repr__(self) -> str:
        return f"LRU({len(self.order)} slots, {self.unused} may be taken)"
