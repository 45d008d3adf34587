"""`solid_table`: a surface as the matter that a wide cone meets.

A cone wider than a voxel reads means. A mean tells which share of the cone the surface fills, if
one knows how fast the value changes there: a ramp around the level, the wider the longer the
interval is. So a surface that is a yes or no to thin rays casts soft shadows.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..ops.shading import pack
from .transfer_function import Table

_ROWS = 1025
_RAMP = 3.0  # width of a ramp in intervals; penumbras agree best so


def solid_table(
    value_1: Tensor,
    slope_1: Tensor,
    most_1: Tensor,
    color: object,
    *,
    above: bool,
    step: float,
    levels: int,
) -> Table:
    """Returns the table of a surface, made on the device of its level.

    Args:
        value_1: (1,) the level, whose dtype is that of the table.
        slope_1: (1,) change of the value by world unit at the surface.
        most_1: (1,) half of a ramp is at most so wide, in data units: what is farther from the
            level can be skipped.
        color: Linear RGB, three numbers or (3,).
        above: Matter is where the value is above the level, else where it is below.
        step: World length of the shortest interval.
        levels: How many lengths of intervals, each twice the one before.
    """
    dtype, device = value_1.dtype, value_1.device
    most_1 = torch.maximum(most_1, 1e-5 * value_1.abs().clamp(min=1))  # else no ramp but a jump
    length_l = step * 2 ** torch.arange(levels, dtype=dtype, device=device)
    half_l = torch.minimum((_RAMP / 2 * slope_1 * length_l).clamp(min=1e-30), most_1)
    away_m = most_1 * torch.linspace(-1, 1, _ROWS, dtype=dtype, device=device)
    away_m = away_m if above else -away_m
    table = pack((color, 0.0), dtype, device).expand(levels, _ROWS, 4).clone()
    share_lm = (0.5 + away_m / (2 * half_l[:, None])).clamp(0, 1)
    # A cone that grazes a surface meets it in several intervals: each takes the fourth root.
    table[:, :, 3] = 1 - (1 - share_lm).sqrt().sqrt()
    seen_m = (table[:, :, 3] > 0).any(0)
    return Table(
        table_lm4=table,
        domain_2=torch.cat((value_1 - most_1, value_1 + most_1)),
        opaque_m=seen_m.cumsum(0, dtype=torch.int32),
    )
