"""`pinhole_rays`: rays through pixels. Its body is its twin, see `op`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .reference.exact import sqrt_exact
from .registry import Backend, Count, Doubles, op


class PinholeColumns:
    """Columns of `camera_nc`: the numbers of a camera that `pinhole_rays` reads."""

    POSE = slice(0, 12)  # the next two
    ROTATION = slice(0, 9)  # (3, 3), world to camera
    POSITION = slice(9, 12)  # world
    FOCAL = slice(12, 14)  # x, y; pixels
    CENTER = slice(14, 16)  # principal point x, y; pixels, whose centres are at integers
    CONE = slice(16, 18)  # as in `Rays`
    RANGE = slice(18, 20)


def _check_rows(*, camera_nc: Tensor, first: int, rows: int, width: int, height: int) -> None:
    cameras, columns = camera_nc.shape
    if columns < (fewest := PinholeColumns.RANGE.stop):
        wanted = f"{fewest} columns or more"
        raise ValueError(f"pinhole_rays: camera_nc must have {wanted}, got {columns}")
    if height < 1 or first + rows > cameras * height:
        available = f"{cameras} cameras of {height} rows"
        raise ValueError(f"pinhole_rays: no rows {first} to {first + rows} in {available}")
    if max(first + rows, rows * width) >= 2**31:
        raise ValueError(f"pinhole_rays: {rows} rows of {width} are too many at once")


def _fake_rays(*, camera_nc: Tensor, rows: int, width: int, **_: Any) -> tuple[Tensor, ...]:
    return tuple(camera_nc.new_empty((rows * width, numbers)) for numbers in (3, 3, 2, 2))


@op(_check_rows, fake=_fake_rays)
def pinhole_rays(
    camera_nc: Doubles,  # see `PinholeColumns`
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
    at = PinholeColumns
    fx, fy = camera[:, at.FOCAL].split(1, 1)
    cx, cy = camera[:, at.CENTER].split(1, 1)
    x, y = (column - cx) / fx, ((row % height)[:, None] - cy) / fy
    rotation = camera[:, at.ROTATION].unflatten(1, (3, 3))
    length = sqrt_exact(x * x + (y * y + 1))
    across, down = x[..., None] * rotation[:, None, 0], y * rotation[:, 1] + rotation[:, 2]
    direction = (across + down[:, None]) / length[..., None]

    def per_pixel(columns: slice) -> Tensor:
        return camera[:, None, columns].expand(-1, width, -1).flatten(0, 1)

    origin, cone, limits = (per_pixel(columns) for columns in (at.POSITION, at.CONE, at.RANGE))
    return origin, direction.view(-1, 3), cone, limits
