"""`Channel`: what a voxel holds."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..base import check
from ..base.volume import CHANNEL_DTYPES


@dataclass(frozen=True)
class Channel:
    """What a voxel of a channel holds: `width` numbers of `dtype`."""

    dtype: torch.dtype = torch.float32
    width: int = 1

    def __post_init__(self) -> None:
        """Checks dtype and width."""
        if self.dtype not in CHANNEL_DTYPES:
            names = ", ".join(str(dtype).removeprefix("torch.") for dtype in CHANNEL_DTYPES)
            raise ValueError(f"Channel: dtype must be one of {names}, got {self.dtype}")
        check.whole("Channel", "width", self.width, low=1)

    @property
    def nbytes(self) -> int:
        """Memory of one voxel."""
        return self.dtype.itemsize * self.width

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest number that fits."""
        known = torch.finfo if self.dtype.is_floating_point else torch.iinfo
        return (known(self.dtype).min, known(self.dtype).max)
