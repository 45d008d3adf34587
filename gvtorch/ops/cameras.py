"""`pinhole_rays`: rays through pixels. Its body is its twin, see `op`."""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor

from .reference.exact import sqrt_exact
from .registry import Backend, Doubles, op

_END = 2**31
Count = Annotated[int, range(_END)]


def _check_rows(*, camera_nc: Tensor, first: int, rows: int, width: int, height: int) -> None:
    cameras, columns = camera_nc.shape
    if columns < 20:
        raise ValueError(f"pinhole_rays: camera_nc must have 20 columns or more, got {columns}")
    if height < 1 or first + rows > cameras * height:
        available = f"{cameras} cameras of {height} rows"
        raise ValueError(f"pinhole_rays: no rows {first} to {first + rows} in {available}")
    if max(first + rows, rows * width) >= _END:
        raise ValueError(f"pinhole_rays: {rows} rows of {width} are too many at once")


@op(_check_rows)
def pinhole_rays(
    camera_nc: Doubles,  # from column 0: rotation (3, 3), world to camera; 9: position; 12: focal
    # lengths; 14: principal point, pixel centres at integers; 16: cone; 18: range
    first: Count,  # row, counted through the batch
    rows: Count,
    width: Count,  # pixels of a row
    height: Count,  # rows of a camera
    *,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Makes the rays through the pixels of whole rows. Their directions are (x, y, 1) with
    x = (column - cx) / fx and y = (row - cy) / fy, rotated into the world and normalised.

    Returns:
        origin_r3, direction_r3, cone_r2 and range_r2, float64, as in `Rays`; r = rows * width.
    """
    row = torch.arange(first, first + rows, device=camera_nc.device)
    column = torch.arange(width, dtype=torch.float64, device=camera_nc.device)
    camera = camera_nc[row // height]  # of each row
    fx, fy, cx, cy = (number[:, None] for number in camera[:, 12:16].unbind(1))
    x, y = (column - cx) / fx, ((row % height)[:, None] - cy) / fy
    rotation = camera[:, :9].unflatten(1, (3, 3))
    length = sqrt_exact(x * x + (y * y + 1))
    across, down = x[..., None] * rotation[:, None, 0], y * rotation[:, 1] + rotation[:, 2]
    direction = (across + down[:, None]) / length[..., None]

    def per_pixel(first_column: int, count: int) -> Tensor:
        numbers = camera[:, None, first_column : first_column + count]
        return numbers.expand(rows, width, count).reshape(-1, count)

    return per_pixel(9, 3), direction.view(-1, 3), per_pixel(16, 2), per_pixel(18, 2)
