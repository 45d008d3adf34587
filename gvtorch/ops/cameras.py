"""`pinhole_rays`: rays through pixels. Its body is its twin, see `op`."""

from __future__ import annotations

from torch import Tensor

from .reference.exact import sqrt_exact
from .registry import Backend, Doubles, op


def _check_planes(*, x_kw: Tensor, y_h: Tensor, camera_kc: Tensor) -> None:
    planes, rows, columns = len(x_kw), len(y_h), camera_kc.shape[1]
    if planes not in (1, rows):
        raise ValueError(f"pinhole_rays: x_kw must have a row, or {rows}, got {planes}")
    if columns < 20:
        raise ValueError(f"pinhole_rays: camera_kc must have 20 columns or more, got {columns}")


@op(_check_planes)
def pinhole_rays(
    x_kw: Doubles,  # places of columns on the image plane; k is 1 where all rows are one camera's
    y_h: Doubles,  # and of rows
    camera_kc: Doubles,  # from column 0: rotation (3, 3), world to camera; 9: position; 16: cone,
    # 18: range
    *,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Makes the rays of all pixels, row by row: their directions are (x, y, 1), turned into the
    world, of unit length.

    Returns:
        origin_r3, direction_r3, cone_r2 and range_r2, float64, as `Rays` has them; r = h * w.
    """
    rows, width = len(y_h), x_kw.shape[1]
    rotation = camera_kc[:, :9].unflatten(1, (3, 3))
    length = sqrt_exact(x_kw * x_kw + (y_h * y_h + 1)[:, None])
    across = x_kw[..., None] * rotation[:, None, 0]
    down = y_h[:, None] * rotation[:, 1] + rotation[:, 2]
    direction = (across + down[:, None]) / length[..., None]

    def spread(first: int, count: int) -> Tensor:
        part = camera_kc[:, None, first : first + count]
        return part.expand(rows, width, count).reshape(-1, count).contiguous()

    return spread(9, 3), direction.view(-1, 3), spread(16, 2), spread(18, 2)
