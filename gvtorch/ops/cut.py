"""`cut_bricks`: bricks out of a level that is in memory, checked and sent to a backend."""

from __future__ import annotations

import torch
from torch import Tensor

from ..base import check
from ..base.volume import movable
from .op import Backend, choose_backend


def cut_bricks(
    values_zyxc: Tensor,
    place_k3: Tensor,
    brick_size: int,
    border: int,
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Cuts bricks out of a level, borders from the neighbours, clamped at the level's faces.

    Args:
        values_zyxc: (z, y, x, c) a whole level, of any dtype.
        place_k3: (k, 3) int64 brick indices, z y x.
        brick_size: Voxels along a side, without the border.
        border: Voxels around.
        backend: auto, reference, cpp or cuda.

    Returns:
        (k, s, s, s, c), s = brick_size + 2 * border.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, a number out of its range, or a
            level without voxels.
    """
    where = "cut_bricks"
    shape = ("z", "y", "x", "c")
    check.tensor(where, "values_zyxc", values_zyxc, shape, values_zyxc.dtype, place_k3.device)
    check.tensor(where, "place_k3", place_k3, ("k", 3), torch.int64, place_k3.device)
    check.whole(where, "brick_size", brick_size, low=1, high=2**10)
    check.whole(where, "border", border, low=0, high=2**10)
    if not values_zyxc.numel():
        raise ValueError(f"{where}: values_zyxc has no voxels, got {check.describe(values_zyxc)}")
    arguments = (values_zyxc.contiguous(), place_k3.contiguous(), brick_size, border)
    if choose_backend(backend, place_k3.device) == "reference":
        return _twin(*arguments)
    return torch.ops.gvtorch.cut_bricks(*arguments)


def _twin(values_zyxc: Tensor, place_k3: Tensor, brick_size: int, border: int) -> Tensor:
    """Right by definition, in plain torch."""
    reach = torch.arange(-border, brick_size + border, device=place_k3.device)
    corner = place_k3[:, :, None] * brick_size + reach  # (k, 3, s)
    z, y, x = (corner[:, axis].clamp(0, values_zyxc.shape[axis] - 1) for axis in range(3))
    index = (z[:, :, None, None], y[:, None, :, None], x[:, None, None, :])
    return movable(values_zyxc)[index].view(values_zyxc.dtype)
