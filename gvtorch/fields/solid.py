"""`Solid`: the inside of a distance field, as voxels: density, or colour and normal."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..base import check
from .distance import Distance, OfShape
from .field import Interval, length

_POINT = 1e-30  # side of voxels of no size
_DEEP = 4.0  # voxels from the surface beyond which normals by derivatives are 0


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
        size = torch.full_like(points[..., 0], _POINT)
        return self._voxels(points, size, differences=False)

    def filtered(self, points: Tensor, size: Tensor) -> Mapping[str, Tensor]:
        """Returns the channels of voxels with sides (..., 3), of which the largest is used. With a
        margin, "normal" holds distances, from which `finish` computes normals.
        """
        return self._voxels(points, size.amax(-1).to(points), differences=self.margin > 0)

    def _voxels(self, points: Tensor, side: Tensor, differences: bool) -> dict[str, Tensor]:
        """Returns channels of voxels with sides (...,); for `differences` see `filtered`."""
        shape, found = self.shape, {}
        if differences or (self.exact and not self.normals):
            value, color = shape.surface(points) if self.colors else (shape(points), None)
            near = value.clamp(-2 * side, 2 * side)[..., None].expand_as(points)
        else:
            value, color, gradient = shape.surface_and_gradient(points)
            steep = length(gradient).clamp(min=1e-6)
            value = value if self.exact else value / steep
            deep = (value.abs() >= _DEEP * side)[..., None]
            near = torch.where(deep, 0.0, gradient / steep[..., None])
        alpha = share(value, side)[..., None]
        if color is not None and self.colors:
            found["rgba"] = torch.cat((color * alpha, alpha), -1)
        else:
            found["density"] = alpha
        return {**found, "normal": near} if self.normals else found

    def finish(self, values: Mapping[str, Tensor], size: Tensor) -> Mapping[str, Tensor]:
        """Computes normals from central differences of the distance; 0 where all neighbours are at
        least two voxels away from the surface.
        """
        near, inner = values["normal"][..., 0], slice(1, -1)
        across = (
            near[:, inner, inner, 2:] - near[:, inner, inner, :-2],
            near[:, inner, 2:, inner] - near[:, inner, :-2, inner],
            near[:, 2:, inner, inner] - near[:, :-2, inner, inner],
        )
        ways = torch.stack(across, -1) / size.to(near)[:, None, None, None]
        longest = length(ways)[..., None].clamp(min=1e-30)
        whole = {name: rows[:, inner, inner, inner] for name, rows in values.items()}
        return {**whole, "normal": ways / longest}

    def bounds(self, center: Tensor, half: Tensor) -> Mapping[str, Interval]:
        """Returns intervals for infinitely small voxels."""
        return self.filtered_bounds(center, half, torch.full_like(center, _POINT))

    def filtered_bounds(self, center: Tensor, half: Tensor, size: Tensor) -> Mapping[str, Interval]:
        """Returns intervals for voxels of `size` (k, 3) and all smaller ones: a surface that is at
        least half a voxel away is also at least half a smaller voxel away.
        """
        low, high = self.shape.bounds(center, half)
        side = size.amax(-1)
        if not self.exact:
            steep = self.shape.slope(center, half)
            side = side * steep.clamp(min=1e-6)
        most = torch.where(low > 0, share(low, side), 1.0)
        least = torch.where(high < 0, share(high, side), 0.0)
        known: dict[str, Interval] = {"density": (least, most)}
        if self.colors:
            dark, bright = self.shape.colors(center, half)
            one = torch.ones_like(most)[:, None]
            low_4, high_4 = torch.cat((dark, one), 1), torch.cat((bright, one), 1)
            known = {"rgba": (least[:, None] * low_4, most[:, None] * high_4)}
        if self.normals:
            deep = (torch.maximum(low, -high) >= _DEEP * side) & (self.margin == 0)
            turned = torch.where(deep, 0.0, 1.0).to(low)[:, None].expand(-1, 3)
            known["normal"] = (-turned, turned)
        return known

    def box(self) -> Tensor | None:
        return self.shape.box()


def share(distance: Tensor, side: Tensor) -> Tensor:
    """Returns the share of a voxel, 0 to 1, that is inside, given its centre's signed distance."""
    return (0.5 - distance / side).clamp(0, 1)
