"""`OwnDtypes`: for modules whose buffers have a meaning only in their own dtypes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor


class OwnDtypes(torch.nn.Module):
    """A module whose own buffers move with `.to`, but keep their dtypes, even if `half()`,
    `bfloat16()`, `float()` or `double()` is called on a net that contains it. Its parameters and
    submodules follow the net.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        buffers = self._buffers
        self._buffers = {}
        try:
            super()._apply(fn, recurse)
        finally:
            self._buffers = buffers
        for name, buffer in buffers.items():
            if buffer is not None:
                changed = fn(buffer)
                same = changed.dtype == buffer.dtype
                buffers[name] = changed if same else buffer.to(changed.device)
        return self
