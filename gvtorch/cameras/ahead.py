"""Where a moving camera will be: the motion between two frames, continued."""

from __future__ import annotations

import torch
from torch import Tensor

_CUT = 0.1  # radians from frame to frame; what turns by more is taken to have jumped


def continued(now: Tensor, before: Tensor, frames: float, moving: int, axes: slice) -> Tensor:
    """Returns the numbers of cameras, or of rays, some frames on; does not wait for the device.

    Args:
        now: (n, c) float64; of the rest of the columns nothing is changed.
        before: (n, c) the same, a frame ago.
        frames: How far the motion is continued.
        moving: How many columns, the first, move.
        axes: Columns of unit vectors among these, three each; where one of them turned by more than
            0.1 radian, that row stays as it is now.
    """
    motion = (now - before)[:, :moving]
    turned = motion[:, axes].unflatten(1, (-1, 3)).square().sum(2).amax(1, keepdim=True)
    way = torch.where(turned <= _CUT * _CUT, frames * motion, 0.0)
    return torch.cat((now[:, :moving] + way, now[:, moving:]), 1)
