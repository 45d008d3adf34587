"""`splat`: what cubes of voxels hold of points. Its body is its twin, see `op`: points are added
one after the other, each to all voxels, those of all cubes side by side.

Source: the M4 kernel of Monaghan, Lattanzio, "A refined particle method for astrophysical
    problems", 1985, along each axis, and integrated.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from ..base import check
from .reference.exact import clamp, divide, larger
from .registry import Backend, Doubles, Longs, op

MOST_VOXELS = (1 << 20) - 1  # along a side of a cube
SMALLEST = 2.0**-1000  # of radii that are divided by


def _check_sizes(*, edge_k3e: Tensor, narrow_b: Tensor, value_nc: Tensor, **_: Any) -> None:
    cubes, edges = len(edge_k3e), edge_k3e.shape[2]
    check.tensor("splat", "narrow_b", narrow_b, (cubes + 1,), torch.int64, narrow_b.device)
    numbers = value_nc.shape[1]
    if not 2 <= edges <= MOST_VOXELS + 1 or not numbers:
        got = f"{edges - 1} and {numbers}"
        raise ValueError(f"splat: 1 to {MOST_VOXELS} voxels and a number are needed, got {got}")


@op(_check_sizes)
def splat(
    edge_k3e: Doubles,  # rising edges of e - 1 voxels along x, y and z; world units
    low_k3: Longs,  # x, y, z of the cubes' first voxels
    narrow_b: Longs,  # k + 1: a cube's runs of narrow points are those from its number up to the
    # next. What is said to be where no run or row is, is left out
    narrow_s2: Longs,  # the rows of a run are those from the first number up to the second
    voxel_n3: Longs,  # x, y, z of the voxel; points in no voxel of the cube are left out
    value_nc: Doubles,  # numbers that are added up
    wide_b: Longs,  # as `narrow_b`, of wide points
    wide_t2: Longs,  # as `narrow_s2`
    center_m3: Doubles,  # x, y, z, world units
    radius_m: Doubles,  # how far a point reaches along each axis. 0: it is wholly in one voxel
    value_mc: Doubles,  # numbers that are added up
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Adds up what each voxel of k cubes holds of points, in the order of their lists: first those
    that lie wholly in a voxel (narrow), then those that reach over several (wide), whose densities
    are products of cubic splines and are integrated in closed form.

    Points stand in a table of either kind, and a cube's list of them is runs of its rows, as many
    as wanted. On all backends and devices every bit is the same, if values are finite. Nothing
    waits for the host, but in the twin.

    Returns:
        (k, z, y, x, c) float64.
    """
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
    """Yields each cube's first row, then its second, ...: which cubes have one, and the rows."""
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
