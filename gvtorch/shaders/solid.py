"""`Solid`: a surface as the matter that a wide cone meets.

A cone wider than a voxel reads means. A mean tells which share of the cone the surface fills, if
one knows how fast the value changes there: a ramp around the level, the wider the longer the
interval is. So a surface that is a yes or no to thin rays casts soft shadows.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..ops.shading import Number, Triple, pack
from .shader import Shader
from .tables import ColorTable, Sampling

_ROWS = 1025
_RAMP = 3.0  # width of a ramp in intervals; penumbras agree best so
_WIDEST = 16  # voxels, of a distance field's ramp


class Solid(Shader):
    """An isosurface as wide cones meet it.

    Of a distance field, matter lies below the level and the value changes as places do. Else it
    lies above, and a value changes from half of the level to three halves over four voxels.
    """

    def __init__(self, surface: Shader, level: Number, color: Triple | None, *, distance: bool):
        """Takes what the surface reads, its level and its colour; None where its alpha alone
        counts.
        """
        self.kind = None if color is None else "Lit"
        self.channel, self.component = surface.channel, surface.component
        self.normals = surface.normals
        self.level, self.distance = level, distance
        self.color = (0.0, 0.0, 0.0) if color is None else color

    def table(self, sampling: Sampling) -> ColorTable:
        """See `Shader`; made on the device of the level."""
        voxel = sampling.smallest_spacing
        value_1 = pack((self.level,), sampling.dtype, sampling.device)
        if self.distance:
            most_1 = torch.full_like(value_1, _WIDEST / 2 * voxel)
            slope_1 = torch.ones_like(value_1)
        else:
            most_1 = value_1.abs() / 2
            slope_1 = most_1 / (2 * voxel)
        return self._ramps(value_1, slope_1, most_1, sampling)

    def _ramps(
        self, value_1: Tensor, slope_1: Tensor, most_1: Tensor, sampling: Sampling
    ) -> ColorTable:
        """The table, given the change of the value by world unit at the surface, and half of the
        widest ramp in data units: what is farther from the level can be skipped.
        """
        dtype, device = sampling.dtype, sampling.device
        most_1 = torch.maximum(most_1, 1e-5 * value_1.abs().clamp(min=1))  # else no ramp but a jump
        length_l = sampling.step * 2 ** torch.arange(sampling.levels, dtype=dtype, device=device)
        half_l = torch.minimum((_RAMP / 2 * slope_1 * length_l).clamp(min=1e-30), most_1)
        away_m = most_1 * torch.linspace(-1, 1, _ROWS, dtype=dtype, device=device)
        inside_m = -away_m if self.distance else away_m
        table = pack((self.color, 0.0), dtype, device).expand(sampling.levels, _ROWS, 4).clone()
        share_lm = (0.5 + inside_m / (2 * half_l[:, None])).clamp(0, 1)
        # A cone that grazes a surface meets it in several intervals: each takes the fourth root.
        table[:, :, 3] = 1 - (1 - share_lm).sqrt().sqrt()
        seen_m = (table[:, :, 3] > 0).any(0)
        return ColorTable(
            table_lm4=table,
            domain_2=torch.cat((value_1 - most_1, value_1 + most_1)),
            opaque_m=seen_m.cumsum(0, dtype=torch.int32),
        )
