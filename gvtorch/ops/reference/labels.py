"""Part of the torch twin: nearest voxels, for labels, as in csrc/shaders/labels.h."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .exact import clamp, larger, smaller
from .rays import INF, Beam
from .tree import ChannelBricks, Holder

_MOST_REACH = 3  # voxels


@dataclass
class Nearest:
    """The voxel whose cube contains a position; a face shared by two belongs to the upper one."""

    value: Tensor  # (r,) the node's constant where it has no brick, 0 where there is no node
    cell: Tensor  # (r, 3) int64 x y z, counted with the border
    place: Tensor  # (r, 3) the position from the voxel's centre, -0.5 to 0.5


class LabelBricks(ChannelBricks):
    """One component of a channel of labels."""

    def nearest(self, holder: Holder, beam: Beam, t: Tensor) -> Nearest:
        """Returns the voxels at distances t (r,)."""
        real, side = t.dtype, self.bricks_bzyxc.shape[1]
        at = self.places(holder, beam, t)
        low, high = self.border, side - 1 - self.border
        place = clamp(at + 0.5, low, high + 1)
        cell = smaller(torch.floor(place), torch.full_like(place, high))
        beside = clamp(at - cell, -0.5, 0.5)
        cell = cell.to(torch.int64)
        constant = self.constant(holder, real)
        value = torch.where(holder.brick >= 0, self.voxel(holder, cell, real), constant)
        return Nearest(value, cell, beside)

    def voxel(self, holder: Holder, cell: Tensor, real: torch.dtype) -> Tensor:
        """Returns (r,) values of voxels (r, 3); undefined where there is no brick."""
        x, y, z = cell.unbind(1)
        if self.bricks_bzyxc.shape[0] == 0:
            return torch.zeros_like(x, dtype=real)
        brick = holder.brick.clamp(min=0)
        return self.bricks_bzyxc[brick, z, y, x, self.component].to(real)

    def away(self, holder: Holder, here: Nearest) -> Tensor:
        """Returns (r, 3) vectors, in voxels and of any length, towards the surrounding voxels of
        other labels: the sum of the offsets to these, each weighted by a tent around the position,
        which ends half a voxel beyond the reach: as many voxels as the border is wide, 1 to 3.
        """
        value, last = here.value, self.bricks_bzyxc.shape[1] - 1
        reach = max(1, min(_MOST_REACH, self.border))
        around = range(-reach, reach + 1)
        offsets = [k - here.place for k in around]
        shares = [clamp(reach + 0.5 - larger(one, -one), 0, INF).unbind(1) for one in offsets]
        ways = [
            tuple(weight * column for weight, column in zip(share, one.unbind(1), strict=True))
            for share, one in zip(shares, offsets, strict=True)
        ]
        zero = torch.zeros_like(value)
        x, y, z = zero, zero, zero
        for k in around:
            plane, along_x, along_y = zero, zero, zero
            for j in around:
                row, along = zero, zero
                for i in around:
                    other = (here.cell + torch.tensor((i, j, k)).to(here.cell)).clamp(0, last)
                    found = self.voxel(holder, other, value.dtype)
                    differs = (found != value).to(value)
                    row = row + shares[i + reach][0] * differs
                    along = along + ways[i + reach][0] * differs
                plane = plane + shares[j + reach][1] * row
                along_x = along_x + shares[j + reach][1] * along
                along_y = along_y + ways[j + reach][1] * row
            x = x + shares[k + reach][2] * along_x
            y = y + shares[k + reach][2] * along_y
            z = z + ways[k + reach][2] * plane
        return torch.stack((x, y, z), 1)
