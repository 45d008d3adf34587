"""`Solid`: the inside of a distance field, as voxels: density, or colour and normal."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..base import check
from .distance import Distance, OfShape
from .field import Interval, length

_POINT_SIDE = 1e-30  # side of voxels of no size
_DEEP_VOXELS = 4.0  # voxels from the surface beyond which normals by derivatives are 0


class Solid(OfShape):
    """The inside of a shape. A voxel holds the share of it that is inside, with the surface taken
    as a plane: clamp(1/2 - distance / side), which is exact for planes that face an axis, and
    within 0.09 for others. So all levels are antialiased, with one evaluation a voxel.
    """

    prefiltered = True
    dtypes: Mapping[str, torch.dtype] = {"rgba": torch.float16, "normal": torch.int8}

    def __init__(
        self,
        shape: Distance,
        *,
        colors: bool = True,
        normals: bool | None = None,
        differences: bool | None = None,
    ) -> None:
        """Takes the shape.

        Args:
            shape: Its signed distance.
            colors: True: a channel "rgba", premultiplied linear colour and opacity; False: a
                channel "density".
            normals: Whether there is a channel "normal"; left out: as `colors`. Without it shaders
                compute normals from differences of the opacity.
            differences: Whether normals are computed from the distances of neighbouring voxels,
                which smooths them, instead of by derivatives; left out: if the shape is not smooth.
        """
        super().__init__()
        self.shape = check.instance("Solid", "shape", shape, Distance)
        self.colors, self.normals = colors, colors if normals is None else normals
        self.exact = shape.exact  # also for the shapes that `near` returns, so no bit changes
        rough = not shape.smooth if differences is None else differences
        self.margin = int(self.normals and rough)
        self.threshold = {"rgba" if colors else "density": 0.0}

    def forward(self, points: Tensor) -> Mapping[str, Tensor]:
        """Returns infinitely small voxels: 1 inside, 0 outside; normals by derivatives."""
        size = torch.full_like(points[..., 0], _POINT_SIDE)
        return self._voxels(points, size, differences=False)

    def filtered(self, points: Tensor, size: Tensor) -> Mapping[str, Tensor]:
        """Returns the channels of voxels with sides (..., 3), of which the largest is used. With a
        margin, "normal" holds distances, from which `finish` computes normals.
        """
        return self._voxels(points, size.amax(-1).to(points), differences=self.margin > 0)

    def _voxels(self, points: Tensor, side: Tensor, differences: bool) -> dict[str, Tensor]:
        """Returns channels of voxels with sides (...,); for `differences` see `filtered`."""
        shape, channels = self.shape, {}
        if differences or (self.exact and not self.normals):
            value, color = shape.surface(points) if self.colors else (shape(points), None)
            normal = value.clamp(-2 * side, 2 * side)[..., None].expand_as(points)
        else:
            value, color, gradient = shape.surface_and_gradient(points)
            steepness = length(gradient).clamp(min=1e-6)
            value = value if self.exact else value / steepness
            deep = (value.abs() >= _DEEP_VOXELS * side)[..., None]
            normal = torch.where(deep, 0.0, gradient / steepness[..., None])
        alpha = coverage(value, side)[..., None]
        if color is not None and self.colors:
            channels["rgba"] = torch.cat((color * alpha, alpha), -1)
        else:
            channels["density"] = alpha
        return {**channels, "normal": normal} if self.normals else channels

    def finish(self, values: Mapping[str, Tensor], size: Tensor) -> Mapping[str, Tensor]:
        """Computes normals from central differences of the distance; 0 where all neighbours are at
        least two voxels away from the surface.
        """
        distance, inner = values["normal"][..., 0], slice(1, -1)
        differences = (
            distance[:, inner, inner, 2:] - distance[:, inner, inner, :-2],
            distance[:, inner, 2:, inner] - distance[:, inner, :-2, inner],
            distance[:, 2:, inner, inner] - distance[:, :-2, inner, inner],
        )
        gradient = torch.stack(differences, -1) / size.to(distance)[:, None, None, None]
        norm = length(gradient)[..., None].clamp(min=1e-30)
        inner_values = {name: channel[:, inner, inner, inner] for name, channel in values.items()}
        return {**inner_values, "normal": gradient / norm}

    def bounds(self, center: Tensor, half: Tensor) -> Mapping[str, Interval]:
        """Returns intervals for infinitely small voxels."""
        return self.filtered_bounds(center, half, torch.full_like(center, _POINT_SIDE))

    def filtered_bounds(self, center: Tensor, half: Tensor, size: Tensor) -> Mapping[str, Interval]:
        """Returns intervals for voxels of `size` (k, 3) and all smaller ones: a surface that is at
        least half a voxel away is also at least half a smaller voxel away.
        """
        low, high = self.shape.bounds(center, half)
        side = size.amax(-1)
        if not self.exact:
            slope = self.shape.slope(center, half)
            side = side * slope.clamp(min=1e-6)
        max_alpha = torch.where(low > 0, coverage(low, side), 1.0)
        min_alpha = torch.where(high < 0, coverage(high, side), 0.0)
        intervals: dict[str, Interval] = {"density": (min_alpha, max_alpha)}
        if self.colors:
            dark, bright = self.shape.colors(center, half)
            ones = torch.ones_like(max_alpha)[:, None]
            low_4, high_4 = torch.cat((dark, ones), 1), torch.cat((bright, ones), 1)
            intervals = {"rgba": (min_alpha[:, None] * low_4, max_alpha[:, None] * high_4)}
        if self.normals:
            deep = (torch.maximum(low, -high) >= _DEEP_VOXELS * side) & (self.margin == 0)
            normal_limit = torch.where(deep, 0.0, 1.0).to(low)[:, None].expand(-1, 3)
            intervals["normal"] = (-normal_limit, normal_limit)
        return intervals

    def box(self) -> Tensor | None:
        return self.shape.box()


def coverage(distance: Tensor, side: Tensor) -> Tensor:
    """Returns the share of a voxel, 0 to 1, that is inside, given its centre's signed distance."""
    return (0.5 - distance / side).clamp(0, 1)
