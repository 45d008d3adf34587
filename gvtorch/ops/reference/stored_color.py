"""Part of the torch twin: shaders that read colours of voxels, stored or filtered, as in
csrc/shaders/stored_color.h and, lit, in shaders.h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ...base.constants import EMPTY
from ..shading import COLOR_WIDTH, LIT_COLOR_WIDTH, FilteredNumbers, StoredColorNumbers
from .exact import clamp, sqrt_exact, stretch, unit
from .lit import Lit
from .march import Piece, Probe, a_little_above
from .tree import ChannelBricks, Holder


class ColorBricks(ChannelBricks):
    """A channel of red, green, blue, opacity, once or for six directions; ranges are opacity's."""

    def value_range(self, node: Tensor, real: torch.dtype) -> tuple[Tensor, Tensor]:
        low, high = self.range_n2c[node, :, 3::COLOR_WIDTH].to(real).unbind(1)
        return low.amin(1), high.amax(1)


class StoredColor(Lit):
    """Colour and opacity of each voxel."""

    bricks = ColorBricks

    @property
    def numbers(self) -> StoredColorNumbers:
        return self.light.parameters.own_as(StoredColorNumbers)

    def hides(self, ray_index: Tensor, low: Tensor, high: Tensor) -> Tensor:
        return ~(a_little_above(high) > 0)

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        numbers = self.numbers
        opacity = self.opacity(piece, probe, self.light.direction)
        shown = mask & (opacity > 0)
        components = [
            self.seen_number(probe, i, piece.middle, self.light.direction) for i in range(3)
        ]
        color = torch.stack(components, 1) * numbers.scale
        divisor = torch.where((numbers.premultiplied > 0) & shown, opacity, 1.0)
        alpha = stretch(opacity, piece.length / numbers.reference)
        rgba = torch.cat((color / divisor[:, None], alpha[:, None]), 1)
        if numbers.lit > 0:
            self.lit(rgba, piece, probe, shown)
        else:
            self.sum.add(rgba, piece, shown)

    def alpha(self, piece: Piece, probe: Probe, direction: Tensor) -> Tensor:
        return stretch(self.opacity(piece, probe, direction), piece.length / self.numbers.reference)

    def opacity(self, piece: Piece, probe: Probe, direction: Tensor) -> Tensor:
        """Returns (r,) opacity per reference length."""
        return clamp(self.seen_number(probe, 3, piece.middle, direction) * self.numbers.scale, 0, 1)

    def seen_number(self, probe: Probe, number: int, t: Tensor, direction: Tensor) -> Tensor:
        """Returns (r,) one of the four numbers as seen along rays (r, 3), for which three of the
        directions are mixed where the channel holds six.
        """

        def read(component: int) -> Tensor:
            return probe.number(replace(self.channel, component=component), t)

        width = self.channel.bricks_bzyxc.shape[4]
        return _by_direction(direction, width, number, read, COLOR_WIDTH)


class Filtered(Lit):
    """The transfer function, and filtered colours where bricks have them (in coarse slots)."""

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        fine, coarse = probe.nodes.fine, probe.nodes.coarse
        has_colors = self.has_colors(fine) | self.has_colors(coarse)
        self.add_by_function(piece, probe, mask & ~has_colors)
        if not (mask & has_colors).any():
            return
        contribution = probe.blend(
            piece.middle, lambda holder: self.contribution(piece, probe, holder)
        )
        self.add_contribution(contribution, piece, mask & has_colors)

    def add_by_function(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        """Adds an interval where no node has colours."""
        self.sum.add(self.rgba(piece, probe), piece, mask)

    def add_contribution(self, contribution: Tensor, piece: Piece, mask: Tensor) -> None:
        """Adds an interval, given the result of `contribution`."""
        self.sum.add_light(self.sum.clear[:, None] * contribution[:, :3], mask)
        self.sum.absorb(contribution[:, 3], piece, mask)

    def has_colors(self, holder: Holder) -> Tensor:
        """Returns (r,) bool: the node's brick has colours."""
        bricks = self.others[0].bricks_bzyxc if self.others else self.channel.bricks_bzyxc[:0]
        return (holder.brick >= 0) & (holder.brick < len(bricks))

    def contribution(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 4) premultiplied colours and alphas of intervals, from one of the nodes."""
        row = self.function_row(piece, probe, holder)
        row = torch.cat((row[:, :3] * row[:, 3:], row[:, 3:]), 1)
        read = self.reader(piece, probe, holder)
        color, alpha, scale = self.seen_colors(COLOR_WIDTH, read, piece, holder)
        colors = torch.stack([*(component * scale for component in color[:3]), alpha], 1)
        colors = torch.where((scale > 0)[:, None], colors, 0.0)
        return torch.where(self.has_colors(holder)[:, None], colors, row)

    def function_row(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 4) the transfer function's rows for one node's values."""
        value = self.channel.sample(holder, piece.middle)
        return self.transfer.interval(value, piece)

    def reader(self, piece: Piece, probe: Probe, holder: Holder) -> Callable[[int], Tensor]:
        """Returns a function that reads one number (r,) of a node's filtered colours."""
        brick = torch.where(self.has_colors(holder), holder.brick, EMPTY)
        colored = replace(holder, brick=brick)
        return lambda number: self.others[number].sample(colored, piece.middle)

    def seen_colors(
        self, color_width: int, read: Callable[[int], Tensor], piece: Piece, holder: Holder
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Returns colour and alpha (r,) of a node's voxels as rays see them; alphas (r,) of
        intervals; and their ratios to the voxels' alphas.
        """
        width = len(self.others)
        color = [_by_direction(self.light.direction, width, i, read, color_width) for i in range(4)]
        stored_alpha = clamp(color[3], 0, 1)
        side = self.light.parameters.own_as(FilteredNumbers).side
        alpha = stretch(stored_alpha, piece.length * holder.scale / side)
        scale = alpha / torch.where(stored_alpha > 0, stored_alpha, 1.0)
        return color, alpha, torch.where(stored_alpha > 0, scale, 0.0)


class FilteredLit(Filtered):
    """The lit transfer function, and filtered colours with moments of normals."""

    def add_by_function(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        self.lit(self.rgba(piece, probe), piece, probe, mask)

    def add_contribution(self, contribution: Tensor, piece: Piece, mask: Tensor) -> None:
        clear, shown = self.sum.clear[:, None], mask & (contribution[:, 3] > 0)
        normal = self.normal + clear * contribution[:, 4:]
        self.normal = torch.where(shown[:, None], normal, self.normal)
        super().add_contribution(contribution, piece, mask)

    def contribution(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 7): the result of `Filtered.contribution`, lit, and normals times alpha."""
        t, light = piece.middle, self.light
        row = self.function_row(piece, probe, holder)
        normal = light.to_eye(probe.slope(holder, t, light.cube))
        color, alpha = light.shade(row[:, :3], normal, t), row[:, 3:]
        by_function = torch.cat((color * alpha, alpha, normal * alpha), 1)
        by_function = torch.where(alpha > 0, by_function, 0.0)

        read = self.reader(piece, probe, holder)
        color_alpha, interval_alpha, scale = self.seen_colors(LIT_COLOR_WIDTH, read, piece, holder)
        shown, alpha = (scale > 0)[:, None], interval_alpha[:, None]
        stored_alpha = torch.where(scale > 0, clamp(color_alpha[3], 0, 1), 1.0)[:, None]
        moments, front = self.moments(read)
        front = None if front is None else front / stored_alpha
        base = torch.stack(color_alpha[:3], 1) / stored_alpha
        color, normal = light.shade_rough(base, moments / stored_alpha, front, t)
        by_colors = torch.cat((color * alpha, alpha, unit(normal) * alpha), 1)
        by_colors = torch.where(shown, by_colors, 0.0)
        return torch.where(self.has_colors(holder)[:, None], by_colors, by_function)

    def moments(self, read: Callable[[int], Tensor]) -> tuple[Tensor, Tensor | None]:
        """Returns (r, 6) moments of the normals that rays see, and, if six directions are stored,
        (r, 3) their mean, each normal turned to the side from which its direction sees it.
        """
        if len(self.others) == LIT_COLOR_WIDTH:
            return torch.stack([read(i) for i in range(COLOR_WIDTH, LIT_COLOR_WIDTH)], 1), None
        mean = front = torch.zeros_like(self.light.direction[:, :1])
        for axis, d in enumerate(self.light.direction.unbind(1)):
            against, first = d < 0, 2 * axis * LIT_COLOR_WIDTH
            m = [
                torch.where(against, read(first + LIT_COLOR_WIDTH + i), read(first + i))
                for i in range(COLOR_WIDTH, LIT_COLOR_WIDTH)
            ]
            column = [m[i] for i in ((0, 1, 2), (1, 3, 4), (2, 4, 5))[axis]]
            weight, total, axial = d * d, m[0] + m[3] + m[5], column[axis]
            valid = (total > 0) & (axial > 0)
            scale = (
                sqrt_exact(torch.where(valid, total, 0.0) / torch.where(valid, axial, 1.0)) * weight
            )
            signed_scale = torch.where(against, scale, -scale)[:, None]
            mean = mean + weight[:, None] * torch.stack(m, 1)
            front = front + signed_scale * torch.stack(column, 1)
        return mean, front


def _by_direction(
    direction: Tensor, width: int, number: int, read: Callable[[int], Tensor], color_width: int
) -> Tensor:
    """Returns (r,) one of the numbers of a voxel as seen along rays (r, 3); `read` reads one. Where
    a channel's `width` is six times that of a colour, three of the directions are mixed.
    """
    if width == color_width:
        return read(number)
    side = []
    for axis, d in enumerate(direction.unbind(1)):
        positive = 2 * axis * color_width + number
        side.append(torch.where(d < 0, read(positive + color_width), read(positive)))
    x, y, _ = (direction * direction).unbind(1)
    return side[2] + x * (side[0] - side[2]) + y * (side[1] - side[2])
