"""The twin of `splat`: what cubes of voxels hold of points, in plain torch. The points of a cube
come one after the other, those of all cubes side by side, and each is added to all voxels.

Source: the M4 kernel of Monaghan, Lattanzio, "A refined particle method for astrophysical
    problems", 1985, along each axis, and integrated.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from .exact import clamp, divide, larger

SMALLEST = 2.0**-1000  # of radii that are divided by


def splat(
    edge_k3e: Tensor,
    low_k3: Tensor,
    narrow_b: Tensor,
    narrow_s2: Tensor,
    voxel_n3: Tensor,
    value_nc: Tensor,
    wide_b: Tensor,
    wide_t2: Tensor,
    center_m3: Tensor,
    radius_m: Tensor,
    value_mc: Tensor,
) -> Tensor:
    """See `ops.splat`."""
    cubes, side = len(edge_k3e), edge_k3e.shape[2] - 1
    total = edge_k3e.new_zeros((cubes, side, side, side, value_nc.shape[1]))
    for cube, row in _in_turn(narrow_b, narrow_s2, len(voxel_n3)):
        voxel = voxel_n3[row] - low_k3[cube]
        inside = ((voxel >= 0) & (voxel < side)).all(1)
        x, y, z = voxel[inside].unbind(1)
        total[cube[inside], z, y, x] += value_nc[row[inside]]
    for cube, row in _in_turn(wide_b, wide_t2, len(radius_m)):
        x, y, z = (
            shares(edge_k3e[cube, axis], center_m3[row, axis], radius_m[row]) for axis in range(3)
        )
        plane = z[:, :, None] * y[:, None, :]
        line = x[:, :, None] * value_mc[row][:, None, :]
        total[cube] += plane[:, :, :, None, None] * line[:, None, None]
    return total


def shares(edge_ke: Tensor, center_k: Tensor, radius_k: Tensor) -> Tensor:
    """Returns what each interval between edges (k, m + 1), rising, holds of points at (k,) that
    reach as far as (k,): (k, m), which adds up to 1 where the edges enclose the point. Where the
    radius is 0, the point is wholly in one, in the upper one at an edge.

    A point's density is a product of cubic splines along x, y and z, and its share of a box the
    product of these integrals. So the shares of the boxes in a box add up to that box's share.
    """
    away = edge_ke - center_k[:, None]
    most = torch.where(away > 0, 2.0, -2.0).to(away)
    scale = divide(2.0, larger(radius_k, torch.full_like(radius_k, SMALLEST)), radius_k)
    knots = clamp(away * scale[:, None], -2.0, 2.0)  # at whole numbers
    away = torch.where(radius_k[:, None] > 0, knots, most)
    far = larger(away, -away)
    rest = 2 - far
    square = rest * rest
    inner = 0.5 - far * (2 / 3 - far * far * (1 / 3 - far * 0.125))
    tail = torch.where(far > 1, square * square * (1 / 24), inner)  # beyond it
    below = torch.where(away < 0, tail, 1 - tail)
    return below[:, 1:] - below[:, :-1]


def _in_turn(begin_b: Tensor, run_s2: Tensor, rows: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yields the first row of each cube's list, then the second, and so on: which cubes have one,
    and where it is in the table.
    """
    runs, of_run = _expanded(torch.stack((begin_b[:-1], begin_b[1:]), 1).clamp(0, len(run_s2)))
    row, of_row = _expanded(run_s2.clamp(0, rows)[runs])
    count = torch.bincount(of_run[of_row], minlength=len(begin_b) - 1)
    begin = count.cumsum(0) - count
    for turn in range(int(count.amax()) if len(count) else 0):
        (cube,) = (count > turn).nonzero(as_tuple=True)
        yield cube, row[begin[cube] + turn]


def _expanded(span_k2: Tensor) -> tuple[Tensor, Tensor]:
    """Returns all numbers in spans, from the first up to the second, and of which span each is."""
    begin, end = span_k2.unbind(1)
    count = (end - begin).clamp(min=0)
    each = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    within = torch.arange(len(each), device=count.device) - (count.cumsum(0) - count)[each]
    return begin[each] + within, each
