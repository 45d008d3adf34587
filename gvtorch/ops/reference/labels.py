"""Part of the torch twin: labels, read from the nearest voxel, as in csrc/shaders/labels.h."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ..shading import Number
from .exact import clamp, dot, larger, smaller, stretch, unit
from .lit import Lit
from .march import Interval, Probe
from .rays import INF
from .tree import ChannelBricks, Holder

_MAX_REACH = 3  # voxels


@dataclass
class Nearest:
    """The voxel whose cube contains a position; a face shared by two belongs to the upper one."""

    value: Tensor  # (r,) the node's constant where it has no brick, 0 where there is no node
    cell: Tensor  # (r, 3) int64 x y z, counted with the border
    from_center: Tensor  # (r, 3) the position from the voxel's centre, -0.5 to 0.5


class LabelBricks(ChannelBricks):
    """One component of a channel of labels."""

    def nearest(self, holder: Holder, t: Tensor) -> Nearest:
        """Returns the voxels at distances t (r,)."""
        real, side = t.dtype, self.bricks_bzyxc.shape[1]
        position = holder.at(t)
        low, high = self.border, side - 1 - self.border
        clamped = clamp(position + 0.5, low, high + 1)
        cell = smaller(torch.floor(clamped), torch.full_like(clamped, high))
        from_center = clamp(position - cell, -0.5, 0.5)
        cell = cell.to(torch.int64)
        value = self.constants(holder, real)[:, self.component]
        if len(self.bricks_bzyxc):
            brick, (x, y, z) = holder.brick.clamp(min=0), cell.unbind(1)
            stored = self.bricks_bzyxc[brick, z, y, x, self.component].to(real)
            value = torch.where(holder.brick >= 0, stored, value)
        return Nearest(value, cell, from_center)

    def toward_others(self, holder: Holder, nearest: Nearest) -> Tensor:
        """Returns (r, 3) vectors, in voxels and of any length, towards the surrounding voxels of
        other labels: the sum of the offsets to these, each weighted by a tent around the position,
        which ends half a voxel beyond the reach: as many voxels as the border is wide, 1 to 3.
        """
        reach, last = max(1, min(_MAX_REACH, self.border)), self.bricks_bzyxc.shape[1] - 1
        if self.bricks_bzyxc.shape[0] == 0:
            return torch.zeros_like(nearest.from_center)
        steps = torch.arange(-reach, reach + 1, device=nearest.cell.device)
        x, y, z = (nearest.cell[:, :, None] + steps).clamp(0, last).unbind(1)  # (r, step) each
        voxels = (z[:, :, None, None], y[:, None, :, None], x[:, None, None, :])
        brick = holder.brick.clamp(min=0)[:, None, None, None]
        label_rzyx = self.bricks_bzyxc[(brick, *voxels, self.component)].to(nearest.value)
        differs = (label_rzyx != nearest.value[:, None, None, None]).to(nearest.value)

        offset = steps - nearest.from_center[:, :, None]  # (r, axis, step)
        weight = clamp(reach + 0.5 - larger(offset, -offset), 0, INF)
        (wx, wy, wz), (mx, my, mz) = weight.unbind(1), (weight * offset).unbind(1)
        row, row_x = _weighted(differs, wx), _weighted(differs, mx)  # (r, z, y)
        plane, plane_x, plane_y = _weighted(row, wy), _weighted(row_x, wy), _weighted(row, my)
        sums = _weighted(plane_x, wz), _weighted(plane_y, wz), _weighted(plane, mz)
        return torch.stack(sums, 1)


def _weighted(values: Tensor, weight: Tensor) -> Tensor:
    """Returns (r, ...) the sums of values (r, ..., step) times weights (r, step), one by one."""
    total = torch.zeros_like(values[..., 0])
    for value, column in zip(values.unbind(-1), weight.unbind(1), strict=True):
        total = total + column.view(-1, *[1] * (total.dim() - 1)) * value
    return total


class LabelNumbers(NamedTuple):
    """The number specific to labels."""

    lit: Number  # above 0: labels are lit


class Labels(Lit):
    """The label of the nearest voxel."""

    bricks = LabelBricks
    channel: LabelBricks
    feature_count = 1

    def transparent(self, low: Tensor, high: Tensor) -> Tensor:
        first, last = self.row_of(low), self.row_of(high)
        before = self.transfer.opaque_m[(first - 1).clamp(min=0)]
        return self.transfer.opaque_m[last] == torch.where(first > 0, before, 0)

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        fine, coarse = probe.nodes.fine, probe.nodes.coarse
        blended = probe.blend(interval.middle, partial(self.contribution, interval))
        color, alpha, normal = blended.split((3, 1, 3), 1)
        hidden = ~(self.contribution(interval, fine)[:, 3] > 0)
        holder = fine.index_put((hidden.nonzero()[:, 0],), coarse[hidden])
        label = self.row_of(self.channel.nearest(holder, interval.middle).value)
        clear, hit_clear = self.sum.clear, self.sum.hit_clear
        clear_after = clear * (1 - alpha[:, 0])
        hit = mask & (clear_after < hit_clear) & (clear >= hit_clear)
        self.features = torch.where(hit[:, None], (1 + label)[:, None].to(alpha), self.features)
        shown = mask & (alpha[:, 0] > 0)
        self.add_normal(clear[:, None] * normal, shown)
        self.sum.add_light(clear[:, None] * color, shown)
        self.sum.absorb(alpha[:, 0], interval, shown)

    def row_of(self, label: Tensor) -> Tensor:
        """Returns (r,) int64 table rows of labels."""
        low, last = self.transfer.domain_2[0], len(self.transfer.opaque_m) - 1
        return clamp(label - low, 0, last).to(torch.int64)

    def contribution(self, interval: Interval, holder: Holder) -> Tensor:
        """Returns (r, 7) what a node shows: premultiplied colours, alphas, normals times alpha."""
        t, table = interval.middle, self.transfer.table_lm4
        nearest = self.channel.nearest(holder, t)
        level = torch.where(interval.odd, 0, interval.level)
        color, alpha = table[level, self.row_of(nearest.value)].split((3, 1), 1)
        stretched = stretch(alpha[:, 0], interval.lengths)[:, None]
        alpha = torch.where((interval.odd & (alpha[:, 0] > 0))[:, None], stretched, alpha)
        normal = torch.zeros_like(color)
        if self.light.parameters.own_as(LabelNumbers).lit > 0:
            voxels = self.channel.toward_others(holder, nearest)
            vector = voxels * (holder.scale[:, None] / self.light.cube)
            normal = unit(torch.where((holder.brick >= 0)[:, None], vector, 0.0))
            faces_away = dot(normal, self.light.direction) > 0
            normal = torch.where(faces_away[:, None], -normal, normal)
            color = self.light.shade(color, normal, t)
        shown = alpha > 0
        contribution = torch.cat((color * alpha, alpha, normal * alpha), 1)
        return torch.where(shown, contribution, 0.0)
