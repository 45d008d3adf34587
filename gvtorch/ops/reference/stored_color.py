"""Part of the torch twin: stored and filtered colours, as in csrc/shaders, stored_color.h and
shaders.h.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ...base.constants import EMPTY
from ..shading import COLOR_WIDTH, LIT_COLOR_WIDTH, Number
from .exact import clamp, sqrt_exact, stretch, unit
from .lit import Lit
from .march import Interval, Probe, a_little_above
from .tree import ChannelBricks, Holder


class ColorBricks(ChannelBricks):
    """A channel of red, green, blue, opacity, once or for six directions; ranges are opacity's."""

    def value_range(self, node: Tensor | slice, real: torch.dtype) -> tuple[Tensor, Tensor]:
        low, high = self.range_n2c[node, :, 3::COLOR_WIDTH].to(real).unbind(1)
        return low.amin(1), high.amax(1)


class StoredColorNumbers(NamedTuple):
    """The numbers specific to stored colours."""

    scale: Number  # factor that brings stored numbers to 0 to 1
    reference: Number  # world length for which opacity is given
    premultiplied: Number  # above 0: colours are stored times opacity
    lit: Number  # above 0: colours are lit


class StoredColor(Lit):
    """Colour and opacity of each voxel."""

    bricks = ColorBricks
    colored = True

    @property
    def numbers(self) -> StoredColorNumbers:
        return self.light.parameters.own_as(StoredColorNumbers)

    def transparent(self, low: Tensor, high: Tensor) -> Tensor:
        return ~(a_little_above(high) > 0)

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        numbers = self.numbers
        color, opacity = self.seen(interval, probe, self.light.direction)
        shown = mask & (opacity > 0)
        divisor = torch.where((numbers.premultiplied > 0) & shown, opacity, 1.0)
        alpha = stretch(opacity, interval.length / numbers.reference)
        rgba = torch.cat((color / divisor[:, None], alpha[:, None]), 1)
        if numbers.lit > 0:
            self.lit(rgba, interval, probe, shown)
        else:
            self.sum.add(rgba, interval, shown)

    def alpha(self, interval: Interval, probe: Probe, direction: Tensor) -> Tensor:
        _, opacity = self.seen(interval, probe, direction)
        return stretch(opacity, interval.length / self.numbers.reference)

    def seen(self, interval: Interval, probe: Probe, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Returns colours (r, 3) as stored, and opacities per reference length (r,), both scaled
        and as seen along rays `direction` (r, 3).
        """
        stored = probe.numbers(self.channel, interval.middle)
        rgba = _by_direction(direction, stored, COLOR_WIDTH) * self.numbers.scale
        return rgba[:, :3], clamp(rgba[:, 3], 0, 1)


class FilteredNumbers(NamedTuple):
    """The number specific to filtered colours."""

    side: Number  # smallest side of the root cube, world units


class Filtered(Lit):
    """The transfer function, and filtered colours where bricks have them (in coarse slots)."""

    filtered = COLOR_WIDTH

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        fine, coarse = probe.nodes.fine, probe.nodes.coarse
        has_colors = self.has_colors(fine) | self.has_colors(coarse)
        self.add_by_function(interval, probe, mask & ~has_colors)
        if not (mask & has_colors).any():
            return
        contribution = probe.blend(interval.middle, partial(self.contribution, interval, probe))
        self.add_contribution(contribution, interval, mask & has_colors)

    def add_by_function(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        """Adds an interval where no node has colours."""
        self.sum.add(self.rgba(interval, probe), interval, mask)

    def add_contribution(self, contribution: Tensor, interval: Interval, mask: Tensor) -> None:
        """Adds an interval, given the result of `contribution`."""
        self.sum.add_light(self.sum.clear[:, None] * contribution[:, :3], mask)
        self.sum.absorb(contribution[:, 3], interval, mask)

    def has_colors(self, holder: Holder) -> Tensor:
        """Returns (r,) bool: the node's brick has colours."""
        colored = 0 if self.other is None else len(self.other.bricks_bzyxc)
        return (holder.brick >= 0) & (holder.brick < colored)

    def contribution(self, interval: Interval, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 4) premultiplied colours and alphas of intervals, from one of the nodes."""
        row = self.function_row(interval, holder)
        row = torch.cat((row[:, :3] * row[:, 3:], row[:, 3:]), 1)
        color, alpha, scale = self.seen_colors(
            self.stored_numbers(interval, holder), interval, holder
        )
        colors = torch.cat((color[:, :3] * scale[:, None], alpha[:, None]), 1)
        colors = torch.where((scale > 0)[:, None], colors, 0.0)
        return torch.where(self.has_colors(holder)[:, None], colors, row)

    def function_row(self, interval: Interval, holder: Holder) -> Tensor:
        """Returns (r, 4) the transfer function's rows for one node's values."""
        return self.transfer.interval(self.channel.sample(holder, interval.middle), interval)

    def stored_numbers(self, interval: Interval, holder: Holder) -> Tensor:
        """Returns (r, c) all numbers of a node's filtered colours; 0 where it has none."""
        assert self.other is not None  # else no node has colours
        brick = torch.where(self.has_colors(holder), holder.brick, EMPTY)
        return self.other.samples(replace(holder, brick=brick), interval.middle)

    def seen_colors(
        self, stored: Tensor, interval: Interval, holder: Holder
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns colour and alpha (r, 4) of a node's voxels as rays see them; alphas (r,) of
        intervals; and their ratios to the voxels' alphas. `stored`: `stored_numbers`.
        """
        color = _by_direction(self.light.direction, stored, self.filtered)[:, :COLOR_WIDTH]
        stored_alpha = clamp(color[:, 3], 0, 1)
        side = self.light.parameters.own_as(FilteredNumbers).side
        alpha = stretch(stored_alpha, interval.length * holder.scale / side)
        scale = alpha / torch.where(stored_alpha > 0, stored_alpha, 1.0)
        return color, alpha, torch.where(stored_alpha > 0, scale, 0.0)


class FilteredLit(Filtered):
    """The lit transfer function, and filtered colours with moments of normals."""

    filtered = LIT_COLOR_WIDTH

    def add_by_function(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        self.lit(self.rgba(interval, probe), interval, probe, mask)

    def add_contribution(self, contribution: Tensor, interval: Interval, mask: Tensor) -> None:
        shown = mask & (contribution[:, 3] > 0)
        self.add_normal(self.sum.clear[:, None] * contribution[:, 4:], shown)
        super().add_contribution(contribution, interval, mask)

    def contribution(self, interval: Interval, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 7): the result of `Filtered.contribution`, lit, and normals times alpha."""
        t, light = interval.middle, self.light
        row = self.function_row(interval, holder)
        normal = light.to_eye(probe.slope(holder, t, light.cube))
        color, alpha = light.shade(row[:, :3], normal, t), row[:, 3:]
        by_function = torch.cat((color * alpha, alpha, normal * alpha), 1)
        by_function = torch.where(alpha > 0, by_function, 0.0)

        stored = self.stored_numbers(interval, holder)
        color_alpha, interval_alpha, scale = self.seen_colors(stored, interval, holder)
        shown, alpha = (scale > 0)[:, None], interval_alpha[:, None]
        stored_alpha = torch.where(scale > 0, clamp(color_alpha[:, 3], 0, 1), 1.0)[:, None]
        moments, front = self.moments(stored)
        front = None if front is None else front / stored_alpha
        base = color_alpha[:, :3] / stored_alpha
        color, normal = light.shade_rough(base, moments / stored_alpha, front, t)
        by_colors = torch.cat((color * alpha, alpha, unit(normal) * alpha), 1)
        by_colors = torch.where(shown, by_colors, 0.0)
        return torch.where(self.has_colors(holder)[:, None], by_colors, by_function)

    def moments(self, stored: Tensor) -> tuple[Tensor, Tensor | None]:
        """Returns (r, 6) moments of the normals that rays see, and, if six directions are stored,
        (r, 3) their mean, each normal turned to the side from which its direction sees it.
        """
        if stored.shape[1] == LIT_COLOR_WIDTH:
            return stored[:, COLOR_WIDTH:], None
        mean = front = torch.zeros_like(self.light.direction[:, :1])
        sides = _facing_sides(self.light.direction, stored, LIT_COLOR_WIDTH)
        for axis, d in enumerate(self.light.direction.unbind(1)):
            against, m = d < 0, sides[axis][:, COLOR_WIDTH:].unbind(1)
            column = [m[i] for i in ((0, 1, 2), (1, 3, 4), (2, 4, 5))[axis]]
            weight, total, axial = d * d, m[0] + m[3] + m[5], column[axis]
            valid = (total > 0) & (axial > 0)
            ratio = torch.where(valid, total, 0.0) / torch.where(valid, axial, 1.0)
            scale = sqrt_exact(ratio) * weight
            signed_scale = torch.where(against, scale, -scale)[:, None]
            mean = mean + weight[:, None] * torch.stack(m, 1)
            front = front + signed_scale * torch.stack(column, 1)
        return mean, front


def _by_direction(direction: Tensor, stored: Tensor, color_width: int) -> Tensor:
    """Returns (r, color_width) numbers of voxels as seen along rays (r, 3). Where voxels hold six
    times as many, those for three of the six directions are mixed.
    """
    if stored.shape[1] == color_width:
        return stored
    side = _facing_sides(direction, stored, color_width)
    x, y, _ = (direction * direction)[:, :, None].unbind(1)
    return side[2] + x * (side[0] - side[2]) + y * (side[1] - side[2])


def _facing_sides(direction: Tensor, stored: Tensor, color_width: int) -> tuple[Tensor, ...]:
    """Returns for x, y and z the numbers (r, color_width) of the direction, positive or negative,
    that a ray (r, 3) follows, of the six that voxels hold.
    """
    sides = stored.unflatten(1, (3, 2, color_width))
    negative = (direction < 0)[:, :, None]
    return torch.where(negative, sides[:, :, 1], sides[:, :, 0]).unbind(1)
