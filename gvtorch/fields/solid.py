"""`Solid`: what a distance field fills, as voxels hold it: density, or colour and normal."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..base import check
from .distance import Distance
from .field import Field, Interval, length

_DEEP = 4.0  # voxels below the surface from which on nothing but its colour is told


class Solid(Field):
    """The inside of a shape. A voxel holds the share of it that lies inside, as if the surface were
    a plane across it: clamp(1/2 - distance / side), the exact share where the plane faces an axis,
    and right to 0.09 in every direction. So all levels are antialiased, at one evaluation a voxel.
    """

    prefiltered = True
    dtypes: Mapping[str, torch.dtype] = {"rgba": torch.float16, "normal": torch.int8}

    def __init__(self, shape: Distance, *, colors: bool = True) -> None:
        """Takes the shape.

        Args:
            shape: Its signed distance.
            colors: Channels are "rgba", premultiplied linear colour and opacity, and "normal";
                else "density" alone.
        """
        super().__init__()
        self.shape = check.instance("Solid", "shape", shape, Distance)
        self.colors = colors
        self.threshold = {"rgba" if colors else "density": 0.0}

    def forward(self, points: Tensor) -> Mapping[str, Tensor]:
        """The values of voxels of no size: 1 inside, 0 outside."""
        return self.filtered(points, torch.full_like(points[..., :1], 1e-30))

    def filtered(self, points: Tensor, size: Tensor) -> Mapping[str, Tensor]:
        """Returns the channels of voxels with sides (..., 3); the largest counts."""
        side = size.amax(-1).to(points)
        if not self.colors and self.shape.exact:
            return {"density": share(self.shape(points), side)}
        value, color, gradient = self.shape.surface_and_gradient(points)
        steep = length(gradient).clamp(min=1e-6)
        away = value if self.shape.exact else value / steep
        if not self.colors:
            return {"density": share(away, side)}
        alpha = share(away, side)[..., None]
        near = (away.abs() < _DEEP * side)[..., None]
        return {
            "rgba": torch.cat((color * alpha, alpha), -1),
            "normal": torch.where(near, gradient / steep[..., None], 0.0),
        }

    def filtered_bounds(self, center: Tensor, half: Tensor, size: Tensor) -> Mapping[str, Interval]:
        """Returns intervals for voxels of `size` (k, 3) and all smaller ones: where the surface is
        at least half a voxel away, it is further than that for smaller voxels as well.
        """
        low, high = self.shape.bounds(center, half)
        side = size.amax(-1)
        if not self.shape.exact:
            steep = self.shape.slope(center, half)
            side = side * steep.clamp(min=1e-6)
        most = torch.where(low > 0, share(low, side), 1.0)
        least = torch.where(high < 0, share(high, side), 0.0)
        if not self.colors:
            return {"density": (least, most)}
        dark, bright = self.shape.colors(center, half)
        one = torch.ones_like(most)[:, None]
        deep = torch.maximum(low, -high) >= _DEEP * side
        turned = torch.where(deep, 0.0, 1.0).to(low)[:, None].expand(-1, 3)
        return {
            "rgba": (
                least[:, None] * torch.cat((dark, one), 1),
                most[:, None] * torch.cat((bright, one), 1),
            ),
            "normal": (-turned, turned),
        }

    def box(self) -> Tensor | None:
        return self.shape.box()


def share(distance: Tensor, side: Tensor) -> Tensor:
    """Returns which share of a voxel, 0 to 1, lies behind a surface at a signed distance."""
    return (0.5 - distance / side).clamp(0, 1)
