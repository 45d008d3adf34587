"""`splat`: adds points to cubes of voxels. The body is the op's twin, see `op`: a cube's points are
added one after the other, each to all of its voxels, and all cubes advance in lockstep.

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

MAX_CUBE_SIDE = (1 << 20) - 1  # along a side of a cube
SMALLEST = 2.0**-1000  # smallest divisor: smaller radii count as this


def _check_sizes(*, edge_k3e: Tensor, narrow_b: Tensor, value_nc: Tensor, **_: Any) -> None:
    cubes, edges = len(edge_k3e), edge_k3e.shape[2]
    check.tensor("splat", "narrow_b", narrow_b, (cubes + 1,), torch.int64, narrow_b.device)
    width = value_nc.shape[1]
    if not 2 <= edges <= MAX_CUBE_SIDE + 1 or not width:
        got = f"{edges - 1} and {width}"
        raise ValueError(f"splat: 1 to {MAX_CUBE_SIDE} voxels and a number are needed, got {got}")


def _fake_sums(*, edge_k3e: Tensor, value_nc: Tensor, **_: Any) -> Tensor:
    side = edge_k3e.shape[2] - 1
    return edge_k3e.new_empty((edge_k3e.shape[0], side, side, side, value_nc.shape[1]))


@op(_check_sizes, fake=_fake_sums, gradients=False)
def splat(
    edge_k3e: Doubles,  # rising edges of e - 1 voxels along x, y and z; world units
    low_k3: Longs,  # x, y, z of the cubes' first voxels
    narrow_b: Longs,  # (k + 1,) cube i has the runs from narrow_b[i] up to narrow_b[i + 1] of
    # narrow points. Runs and rows that do not exist are left out
    narrow_s2: Longs,  # a run's rows of the next two tables: from the first up to the second
    voxel_n3: Longs,  # x, y, z of the point's voxel; points outside the cube are left out
    value_nc: Doubles,  # numbers to add
    wide_b: Longs,  # as `narrow_b`, for wide points
    wide_t2: Longs,  # as `narrow_s2`
    center_m3: Doubles,  # x, y, z, world units
    radius_m: Doubles,  # of the point along each axis, world units; 0: it is wholly in one voxel
    value_mc: Doubles,  # numbers to add
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Sums the values of points in each voxel of k cubes, in the order of the cubes' lists: first
    points that lie wholly in a voxel (narrow), then those that spread over several (wide), whose
    densities are products of cubic splines and are integrated in closed form.

    Narrow and wide points have a table each; a cube's list is any number of runs of its rows. On
    all backends and devices every bit is the same, if values are finite. Only the twin blocks.

    Returns:
        (k, z, y, x, c) float64.
    """
    cubes, side = len(edge_k3e), edge_k3e.shape[2] - 1
    total = edge_k3e.new_zeros((cubes, side, side, side, value_nc.shape[1]))
    for cube, row in _rows_by_turn(narrow_b, narrow_s2, len(voxel_n3)):
        voxel = voxel_n3[row] - low_k3[cube]
        inside = ((voxel >= 0) & (voxel < side)).all(1)
        x, y, z = voxel[inside].unbind(1)
        total[cube[inside], z, y, x] += value_nc[row[inside]]
    for cube, row in _rows_by_turn(wide_b, wide_t2, len(radius_m)):
        x, y, z = (
            shares(edge_k3e[cube, axis], center_m3[row, axis], radius_m[row]) for axis in range(3)
        )
        plane = z[:, :, None] * y[:, None, :]
        line = x[:, :, None] * value_mc[row][:, None, :]
        total[cube] += plane[:, :, :, None, None] * line[:, None, None]
    return total


def shares(edge_ke: Tensor, center_k: Tensor, radius_k: Tensor) -> Tensor:
    """Returns the shares (k, m) of points that fall between rising edges (k, m + 1); they add up to
    1 where the edges enclose the point. A point of radius 0 is wholly in one interval, the upper
    one where it lies on an edge.

    A point's density is a product of cubic splines along x, y and z, so its share in a box is the
    product of three such integrals, and shares of the parts of a box add up to that of the box.
    """
    offset = edge_ke - center_k[:, None]
    outermost_knot = torch.where(offset > 0, 2.0, -2.0).to(offset)
    scale = divide(2.0, larger(radius_k, torch.full_like(radius_k, SMALLEST)), radius_k)
    knots = clamp(offset * scale[:, None], -2.0, 2.0)  # the spline's knots are integers
    offset = torch.where(radius_k[:, None] > 0, knots, outermost_knot)
    distance = larger(offset, -offset)
    rest = 2 - distance
    square = rest * rest
    inner = 0.5 - distance * (2 / 3 - distance * distance * (1 / 3 - distance * 0.125))
    # The integral beyond `distance`.
    tail = torch.where(distance > 1, square * square * (1 / 24), inner)
    below = torch.where(offset < 0, tail, 1 - tail)
    return below[:, 1:] - below[:, :-1]


def _rows_by_turn(begin_b: Tensor, run_s2: Tensor, rows: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yields all cubes' first rows, then their second, ...: the cubes that have one, the rows."""
    run_span_k2 = torch.stack((begin_b[:-1], begin_b[1:]), 1).clamp(0, len(run_s2))
    runs, cube_of_run = _expand_spans(run_span_k2)
    row, run_of_row = _expand_spans(run_s2.clamp(0, rows)[runs])
    count = torch.bincount(cube_of_run[run_of_row], minlength=len(begin_b) - 1)
    begin = count.cumsum(0) - count
    for turn in range(int(count.amax()) if len(count) else 0):
        (cube,) = (count > turn).nonzero(as_tuple=True)
        yield cube, row[begin[cube] + turn]


def _expand_spans(span_k2: Tensor) -> tuple[Tensor, Tensor]:
    """Returns all integers in half-open spans, and the index of the span that each is in."""
    begin, end = span_k2.unbind(1)
    count = (end - begin).clamp(min=0)
    span_index = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    first = count.cumsum(0) - count
    offset = torch.arange(len(span_index), device=count.device) - first[span_index]
    return begin[span_index] + offset, span_index
