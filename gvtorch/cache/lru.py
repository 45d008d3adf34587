"""`LRU`: slots of a pool in order of use."""

from __future__ import annotations

import torch
from torch import Tensor

from ..ops import lru_partition


class LRU:
    """The order in which slots are given away: those that were not used for longest first.

    Attributes:
        order: (k,) int32 slots, locked ones not among them. Its memory stays the same.
        unused: How many at the front may be taken.
    """

    def __init__(self, capacity: int, locked: int, device: torch.device) -> None:
        """Starts with slots `locked` to `capacity`, all free."""
        self.order = torch.arange(locked, capacity, dtype=torch.int32, device=device)
        self.unused = len(self.order)

    def sort(self, stamp: Tensor, frame: Tensor) -> Tensor:
        """Brings what this frame did not use to the front, in order; see `ops.lru_partition`.

        Returns:
            (1,) int64 what `unused` is to be set to, once the host knows it.
        """
        order, unused = lru_partition(self.order, stamp, frame)
        self.order.copy_(order)
        return unused

    def take(self, count: int) -> Tensor:
        """Returns (count,) int32 slots from the front, which then stand last.

        Raises:
            ValueError: Fewer slots are unused.
        """
        if count > self.unused:
            raise ValueError(f"LRU: {count} slots wanted, {self.unused} are unused")
        taken = self.order[:count].clone()
        self.order.copy_(self.order.roll(-count))
        self.unused -= count
        return taken
