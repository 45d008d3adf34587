"""Part of the torch twin: the nearest voxels of bricks that hold labels, as csrc/shaders/labels.h."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .exact import clamp, smaller
from .rays import Beam
from .tree import Bricks, Holder


@dataclass
class Nearest:
    """The voxel of a node in whose cube a place lies. A face that two voxels share belongs to the
    upper one.
    """

    value: Tensor  # (r,) the node's constant where it has no brick, 0 where there is no node
    cell: Tensor  # (r, 3) int64 x y z, counted with the border
    place: Tensor  # (r, 3) from the voxel's centre, -0.5 to 0.5


class LabelBricks(Bricks):
    """One component of a channel of labels."""

    def nearest(self, holder: Holder, beam: Beam, t: Tensor) -> Nearest:
        """The voxels at distances t (r,)."""
        real, side = t.dtype, self.bricks_bzyxc.shape[1]
        at = self.places(holder, beam, t)
        low, high = self.border, side - 1 - self.border
        place = clamp(at + 0.5, low, high + 1)
        cell = smaller(torch.floor(place), torch.full_like(place, high))
        beside = clamp(at - cell, -0.5, 0.5)
        cell = cell.to(torch.int64)
        constant = self.constant_nc[holder.node.clamp(min=0), self.component].to(real)
        constant = torch.where(holder.node >= 0, constant, 0.0)
        value = torch.where(holder.brick >= 0, self.voxel(holder, *cell.unbind(1), real), constant)
        return Nearest(value, cell, beside)

    def voxel(
        self, holder: Holder, x: Tensor, y: Tensor, z: Tensor, real: torch.dtype
    ) -> Tensor:
        """(r,) values of voxels; anything where there is no brick."""
        if self.bricks_bzyxc.shape[0] == 0:
            return torch.zeros_like(x, dtype=real)
        brick = holder.brick.clamp(min=0)
        return self.bricks_bzyxc[brick, z, y, x, self.component].to(real)

    def slope(self, holder: Holder, found: Nearest) -> Tensor:
        """(r, 3) how "the same label as here" grows along x, y, z, a voxel: 1 in voxels of this
        label and 0 in others, smoothed by a quadratic B-spline.
        """
        value, last = found.value, self.bricks_bzyxc.shape[1] - 1
        below, above = 0.5 - found.place, 0.5 + found.place
        middle = 0.75 - found.place * found.place
        shares = (0.5 * (below * below), middle, 0.5 * (above * above))
        slopes = (-below, -(found.place + found.place), above)
        share, slope = ([one.unbind(1) for one in three] for three in (shares, slopes))
        zero = torch.zeros_like(value)
        nx, ny, nz = zero, zero, zero
        for k in range(3):
            plane, along_x, along_y = zero, zero, zero
            for j in range(3):
                row, rise = zero, zero
                for i in range(3):
                    offset = torch.tensor((i - 1, j - 1, k - 1)).to(found.cell)
                    other = (found.cell + offset).clamp(0, last)
                    same = (self.voxel(holder, *other.unbind(1), value.dtype) == value).to(value)
                    row = row + share[i][0] * same
                    rise = rise + slope[i][0] * same
                plane = plane + share[j][1] * row
                along_x = along_x + share[j][1] * rise
                along_y = along_y + slope[j][1] * row
            nx = nx + share[k][2] * along_x
            ny = ny + share[k][2] * along_y
            nz = nz + slope[k][2] * plane
        return torch.stack((nx, ny, nz), 1)
