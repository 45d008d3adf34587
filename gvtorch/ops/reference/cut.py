"""The torch twin of `cut_bricks`, right by definition."""

from __future__ import annotations

import torch
from torch import Tensor

from ...base.volume import movable


def cut_bricks(values_zyxc: Tensor, place_k3: Tensor, brick_size: int, border: int) -> Tensor:
    """Twin of `torch.ops.gvtorch.cut_bricks`."""
    reach = torch.arange(-border, brick_size + border, device=place_k3.device)
    corner = place_k3[:, :, None] * brick_size + reach  # (k, 3, s)
    z, y, x = (corner[:, axis].clamp(0, values_zyxc.shape[axis] - 1) for axis in range(3))
    index = (z[:, :, None, None], y[:, None, :, None], x[:, None, None, :])
    return movable(values_zyxc)[index].view(values_zyxc.dtype)
