"""The torch twin of `shade_rays`: the fused shaders, right by definition. csrc/shaders/shaders.h
describes each of them; light.py lights them, march.py walks the rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from ...base.constants import EMPTY
from ..arguments import RayArguments, ShadeArguments, TraceArguments
from ..shading import (
    SHADER_KINDS,
    FilteredNumbers,
    GradientMagnitudeNumbers,
    IsosurfaceNumbers,
    LabelNumbers,
    LightKind,
    ProjectionKind,
    ProjectionNumbers,
    ShadeParameters,
    StoredColorNumbers,
)
from .channels import AllNumbers, ChannelTable
from .exact import clamp, dot, larger, sqrt_exact, stretch, unit
from .labels import LabelBricks
from .light import Light, Shadows
from .march import Piece, Plain, Probe, Walk, a_little_above, a_little_below, mix
from .rays import INF
from .tree import ChannelBricks, Holder

_BISECTIONS = 4
PER_SIDE = 10  # numbers of a filtered colour with moments of normals, for each direction


@dataclass
class Lit(Plain):
    """The lit transfer function, and the base of all fused shaders."""

    light: Light
    others: tuple[ChannelBricks, ...]  # components of the second channel, or none
    other_component: int
    features: Tensor  # (r, c) sums
    shadows: Shadows | None
    bricks: ClassVar[type[ChannelBricks]] = ChannelBricks  # how it reads its channel

    def __post_init__(self) -> None:
        self.normal = torch.zeros_like(self.light.direction)  # (r, 3) sum

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """As `Visitor.same`; false for shadows, and for stored normals with a point light."""
        same = torch.ones_like(fine, dtype=torch.bool)
        for channel in (self.channel, *self.light.normals[:1], *self.others[:1]):
            numbers = channel.constant_nc
            same = same & (numbers[fine] == numbers[coarse]).all(1)
        varies = self.light.parameters.light_kind == LightKind.POINT and bool(self.light.normals)
        return (same | (fine == coarse)) & (self.shadows is None) & (not varies)

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        self.lit(self.rgba(piece, probe), piece, probe, mask)

    def lit(self, rgba: Tensor, piece: Piece, probe: Probe, mask: Tensor) -> None:
        """Lights an interval and adds it."""
        t, shown = piece.middle, mask & (rgba[:, 3] > 0)
        normal = self.light.normal_at(probe, t)
        is_headlight = self.light.parameters.light_kind == LightKind.HEADLIGHT
        shadow = None  # no shadows
        if self.shadows is not None and not is_headlight:
            shadow = partial(self.light_share, self.shadows, t, shown)
        color = self.light.shade(rgba[:, :3], normal, t, shadow)
        color = torch.where(shown[:, None], color, rgba[:, :3])
        weight = self.sum.clear * rgba[:, 3]
        self.normal = torch.where(
            shown[:, None], self.normal + weight[:, None] * normal, self.normal
        )
        self.sum.add(torch.cat((color, rgba[:, 3:]), 1), piece, mask)

    def light_share(self, shadows: Shadows, t: Tensor, shown: Tensor, facing: Tensor) -> Tensor:
        """Returns (r,) the share of light that reaches t (r,), where it is seen and faces it."""
        shader = replace(self, shadows=None)
        return shadows.light_share(shader, t, *self.light.towards(t), shown & facing, self.light)

    def done(self, walk: Walk) -> None:
        """Finishes after the last interval."""


class ColorBricks(ChannelBricks):
    """A channel of red, green, blue, opacity, once or for six directions; ranges are opacity's."""

    def value_range(self, node: Tensor, real: torch.dtype) -> tuple[Tensor, Tensor]:
        low, high = self.range_n2c[node, :, 3::4].to(real).unbind(1)
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

        return _by_direction(direction, self.channel.bricks_bzyxc.shape[4], number, read)


class PreIntegrated(Lit):
    """A table over the values at both ends of an interval, (l, m, m, 4)."""

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        lengths = torch.where(piece.odd, piece.lengths, 1.0)
        level = torch.where(piece.odd, 0, piece.level)
        end_values = probe.value(piece.start), probe.value(piece.end)
        low, high = self.transfer.domain_2
        front, back = (clamp(value, low, high) for value in end_values)
        row = self._between(front, back, level)
        inside = (front == back) | ((front == end_values[0]) & (back == end_values[1]))
        rise = end_values[1] - end_values[0]
        rate = lengths / torch.where(inside, 1.0, larger(rise, -rise))

        def with_change(rows: Tensor, rise: Tensor) -> Tensor:
            return _with_length(rows, rate * larger(rise, -rise))

        mixed = with_change(row, back - front)
        mixed = _over(with_change(self._between(front, front, level), front - end_values[0]), mixed)
        mixed = _over(mixed, with_change(self._between(back, back, level), end_values[1] - back))
        rgba = torch.where(inside[:, None], _with_length(row, lengths), mixed)
        self.sum.add_light(self.sum.clear[:, None] * rgba[:, :3], mask)
        self.sum.absorb(rgba[:, 3], piece, mask)

    def _between(self, front: Tensor, back: Tensor, level: Tensor) -> Tensor:
        """Returns (r, 4) table rows of intervals of a level's length, from one value to another."""
        table = self.transfer.table_lm4
        (row, row_weight), (column, weight) = self.transfer.cell(front), self.transfer.cell(back)
        near, far = (
            mix(table[level, r, column], table[level, r, column + 1], weight)
            for r in (row, row + 1)
        )
        return mix(near, far, row_weight)


class Isosurface(Lit):
    """The first point where the value crosses a level."""

    def __post_init__(self) -> None:
        super().__post_init__()
        zeros = torch.zeros_like(self.sum.clear)
        numbers = self.light.parameters.own_as(IsosurfaceNumbers)
        self.numbers, self.level, self.filled = (
            numbers,
            torch.as_tensor(numbers.level),
            numbers.filled,
        )
        self.is_hit = torch.zeros_like(zeros, dtype=torch.bool)
        self.last_value, self.last_end, self.share = zeros, zeros - INF, zeros

    def hides(self, ray_index: Tensor, low: Tensor, high: Tensor) -> Tensor:
        level, filled, hides = self.level, self.filled, torch.zeros_like(self.is_hit[ray_index])
        if filled >= 0:
            hides = hides | (a_little_above(high) < level)
        if filled <= 0:
            hides = hides | (a_little_below(low) >= level)
        return hides & ~self.is_hit[ray_index]

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        level = self.level
        front, back = probe.value(piece.start), probe.value(piece.end)
        below = front < level
        hits_start = (self.last_end == piece.start) & ((self.last_value < level) != below)
        if self.filled != 0:
            hits_start = hits_start | (~below if self.filled > 0 else below)
        hits_start = mask & hits_start
        # The ray starts inside: there is no surface and no normal.
        begins = hits_start & (self.last_end == -INF)
        crosses = mask & ~hits_start & (below != (back < level))
        self.last_value = torch.where(mask, back, self.last_value)
        self.last_end = torch.where(mask, piece.end, self.last_end)
        self.last_end = torch.where(begins, INF, self.last_end)
        if not (hits_start | crosses).any():
            return
        near, far, near_value, far_value = piece.start, piece.end, front, back
        for _ in range(_BISECTIONS):
            middle = near + (far - near) * 0.5
            value = probe.value(middle)
            same = (value < level) == below
            near, near_value = torch.where(same, middle, near), torch.where(same, value, near_value)
            far, far_value = torch.where(same, far, middle), torch.where(same, far_value, value)
        rise = torch.where(crosses, far_value - near_value, 1.0)
        t = near + clamp((level - near_value) / rise, 0, 1) * (far - near)
        hit = hits_start | crosses
        self.share = torch.where(hit, self.sum.clear, self.share)
        self.sum.clear = torch.where(hit, 0.0, self.sum.clear)
        self.sum.depth = torch.where(hit, torch.where(hits_start, piece.start, t), self.sum.depth)

    def done(self, walk: Walk) -> None:
        """Shades the surface points found; each looks its node up once more."""
        self.is_hit = self.sum.depth < INF
        t = torch.where(self.is_hit, self.sum.depth, 0.0)
        walk.look_up(self.is_hit.nonzero()[:, 0], t, self)
        probe = Probe(walk.intervals.beam, walk.visit, self.channel)
        normal = self.light.normal_at(probe, t)
        normal = torch.where((self.last_end < INF)[:, None], normal, 0.0)
        color = self.share[:, None] * self.light.shade(self.color_at(probe, t), normal, t)
        self.sum.color = torch.where(self.is_hit[:, None], color, 0.0)
        self.normal = torch.where(self.is_hit[:, None], normal, 0.0)

    def color_at(self, probe: Probe, t: Tensor) -> Tensor:
        """Returns (r, 3) base colours of the surface at distances t (r,)."""
        if self.numbers.scale > 0:
            components = [probe.number(self.others[i], t) for i in range(4)]
            rgba = torch.stack(components, 1) * self.numbers.scale
            has_opacity = (rgba[:, 3:] > 0) & (self.numbers.premultiplied > 0)
            return rgba[:, :3] / torch.where(has_opacity, rgba[:, 3:], 1.0)
        if self.others:
            return self.transfer.look_up(probe.number(self.others[self.other_component], t))[:, :3]
        return self.transfer.look_up(self.level.expand_as(t))[:, :3]


class Projection(Lit):
    """Maximum, minimum or mean of the value."""

    sees_empty = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.kind = self.light.parameters.own_as(ProjectionNumbers).kind
        self.value, self.length, self.value_t = (torch.zeros_like(self.sum.clear) for _ in range(3))

    def hides(self, ray_index: Tensor, low: Tensor, high: Tensor) -> Tensor:
        kind, value = self.kind, self.value[ray_index]
        no_gain = ((kind == ProjectionKind.MAXIMUM) & (a_little_above(high) <= value)) | (
            (kind == ProjectionKind.MINIMUM) & (a_little_below(low) >= value)
        )
        return no_gain & (self.length[ray_index] > 0)

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        kind, value = self.kind, probe.value(piece.middle)
        first = ~(self.length > 0)
        if kind == ProjectionKind.MEAN:
            self.value_t = torch.where(mask & first, piece.start, self.value_t)
            self.value = torch.where(mask, self.value + value * piece.length, self.value)
        else:
            better = value > self.value if kind == ProjectionKind.MAXIMUM else value < self.value
            better = mask & (first | better)
            self.value = torch.where(better, value, self.value)
            self.value_t = torch.where(better, piece.middle, self.value_t)
        self.length = torch.where(mask, self.length + piece.length, self.length)

    def done(self, walk: Walk) -> None:
        sampled = self.length > 0
        mean = self.value / torch.where(sampled, self.length, 1.0)
        value = mean if self.kind == ProjectionKind.MEAN else self.value
        row = self.transfer.look_up(value)
        color = self.sum.clear[:, None] * row[:, :3]
        self.sum.color = torch.where(sampled[:, None], color, 0.0)
        self.sum.clear = torch.where(sampled, 0.0, self.sum.clear)
        self.sum.depth = torch.where(sampled, self.value_t, INF)
        self.features = torch.where(sampled, value, 0.0)[:, None]


class Features(Lit):
    """All numbers of a second channel, composited with the transfer function's alpha."""

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        rgba = self.rgba(piece, probe)
        share = torch.where(mask, self.sum.clear * rgba[:, 3], 0.0)
        numbers = torch.stack([probe.number(channel, piece.middle) for channel in self.others], 1)
        self.features = self.features + share[:, None] * numbers
        self.sum.add(rgba, piece, mask)


class GradientMagnitude(Lit):
    """The transfer function, denser where the value changes faster."""

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        numbers = self.light.parameters.own_as(GradientMagnitudeNumbers)
        rgba = self.rgba(piece, probe)
        slope = probe.gradient(piece.middle, self.light.cube)
        fraction = clamp(sqrt_exact(dot(slope, slope)) / numbers.full, 0, 1)
        alpha = torch.where(fraction > 0, stretch(rgba[:, 3], fraction), 0.0)
        self.sum.add(torch.cat((rgba[:, :3], alpha[:, None]), 1), piece, mask)


class Labels(Lit):
    """The label of the nearest voxel."""

    bricks = LabelBricks
    channel: LabelBricks

    def hides(self, ray_index: Tensor, low: Tensor, high: Tensor) -> Tensor:
        first, last = self.row_of(low), self.row_of(high)
        before = self.transfer.opaque_m[(first - 1).clamp(min=0)]
        return self.transfer.opaque_m[last] == torch.where(first > 0, before, 0)

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        fine, coarse = probe.nodes.fine, probe.nodes.coarse
        blended = probe.blend(piece.middle, partial(self.contribution, piece, probe))
        color, alpha, normal = blended.split((3, 1, 3), 1)
        hidden = ~(self.contribution(piece, probe, fine)[:, 3] > 0)
        holder = fine.index_put((hidden.nonzero()[:, 0],), coarse[hidden])
        label = self.row_of(self.channel.nearest(holder, probe.beam, piece.middle).value)
        clear_after, clear, hit_clear = (
            self.sum.clear * (1 - alpha[:, 0]),
            self.sum.clear,
            self.sum.hit_clear,
        )
        hit = mask & (clear_after < hit_clear) & (clear >= hit_clear)
        self.features = torch.where(hit[:, None], (1 + label)[:, None].to(alpha), self.features)
        shown = mask & (alpha[:, 0] > 0)
        self.normal = torch.where(
            shown[:, None], self.normal + clear[:, None] * normal, self.normal
        )
        self.sum.add_light(clear[:, None] * color, shown)
        self.sum.absorb(alpha[:, 0], piece, shown)

    def row_of(self, label: Tensor) -> Tensor:
        """Returns (r,) int64 table rows of labels."""
        low, last = self.transfer.domain_2[0], len(self.transfer.opaque_m) - 1
        return clamp(label - low, 0, last).to(torch.int64)

    def contribution(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 7) what a node shows: premultiplied colours, alphas, normals times alpha."""
        t, table = piece.middle, self.transfer.table_lm4
        nearest = self.channel.nearest(holder, probe.beam, t)
        level = torch.where(piece.odd, 0, piece.level)
        color, alpha = table[level, self.row_of(nearest.value)].split((3, 1), 1)
        stretched = stretch(alpha[:, 0], piece.lengths)[:, None]
        alpha = torch.where((piece.odd & (alpha[:, 0] > 0))[:, None], stretched, alpha)
        normal = torch.zeros_like(color)
        if self.light.parameters.own_as(LabelNumbers).lit > 0:
            vector = self.channel.toward_others(holder, nearest) * (
                holder.scale[:, None] / self.light.cube
            )
            normal = unit(torch.where((holder.brick >= 0)[:, None], vector, 0.0))
            faces_away = dot(normal, self.light.direction) > 0
            normal = torch.where(faces_away[:, None], -normal, normal)
            color = self.light.shade(color, normal, t)
        shown = alpha > 0
        contribution = torch.cat((color * alpha, alpha, normal * alpha), 1)
        return torch.where(shown, contribution, 0.0)


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
        color, alpha, scale = self.seen_colors(4, read, piece, holder)
        colors = torch.stack([*(component * scale for component in color[:3]), alpha], 1)
        colors = torch.where((scale > 0)[:, None], colors, 0.0)
        return torch.where(self.has_colors(holder)[:, None], colors, row)

    def function_row(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 4) the transfer function's rows for one node's values."""
        value = self.channel.sample(holder, probe.beam, piece.middle)
        return self.transfer.interval(value, piece)

    def reader(self, piece: Piece, probe: Probe, holder: Holder) -> Callable[[int], Tensor]:
        """Returns a function that reads one number (r,) of a node's filtered colours."""
        brick = torch.where(self.has_colors(holder), holder.brick, EMPTY)
        colored = replace(holder, brick=brick)
        return lambda number: self.others[number].sample(colored, probe.beam, piece.middle)

    def seen_colors(
        self, per_side: int, read: Callable[[int], Tensor], piece: Piece, holder: Holder
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Returns colour and alpha (r,) of a node's voxels as rays see them, `per_side` numbers a
        direction; alphas (r,) of intervals; and their ratios to the voxels' alphas.
        """
        width = len(self.others)
        color = [_by_direction(self.light.direction, width, i, read, per_side) for i in range(4)]
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
        color_alpha, interval_alpha, scale = self.seen_colors(PER_SIDE, read, piece, holder)
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
        if len(self.others) == PER_SIDE:
            return torch.stack([read(i) for i in range(4, PER_SIDE)], 1), None
        mean = front = torch.zeros_like(self.light.direction[:, :1])
        for axis, d in enumerate(self.light.direction.unbind(1)):
            against, first = d < 0, 2 * axis * PER_SIDE
            m = [
                torch.where(against, read(first + PER_SIDE + i), read(first + i))
                for i in range(4, PER_SIDE)
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


class ChannelMix(Lit):
    """Several numbers of a voxel, each with its transfer function."""

    bricks = AllNumbers

    def __post_init__(self) -> None:
        super().__post_init__()
        self.table = ChannelTable(self.transfer)

    def hides(self, ray_index: Tensor, low: Tensor, high: Tensor) -> Tensor:
        return self.table.transparent(low, high)

    def add(self, piece: Piece, probe: Probe, mask: Tensor) -> None:
        rgba = self.table.interval(piece, probe)
        self.sum.add_light(self.sum.clear[:, None] * rgba[:, :3], mask)
        self.sum.absorb(rgba[:, 3], piece, mask)


def _by_direction(
    direction: Tensor, width: int, number: int, read: Callable[[int], Tensor], per_side: int = 4
) -> Tensor:
    """Returns (r,) one of the numbers of a voxel as seen along rays (r, 3); `read` reads one. Where
    a channel holds six times `per_side` numbers, three of the directions are mixed.
    """
    if width == per_side:
        return read(number)
    side = [
        torch.where(
            d < 0, read((2 * axis + 1) * per_side + number), read(2 * axis * per_side + number)
        )
        for axis, d in enumerate(direction.unbind(1))
    ]
    x, y, _ = (direction * direction).unbind(1)
    return side[2] + x * (side[0] - side[2]) + y * (side[1] - side[2])


#: Twins by the names of the C++ structs.
TWINS: dict[str, type[Lit]] = {
    "Lit": Lit,
    "PreIntegrated": PreIntegrated,
    "StoredColor": StoredColor,
    "Isosurface": Isosurface,
    "Projection": Projection,
    "Features": Features,
    "ShadowedLit": Lit,
    "ShadowedColor": StoredColor,
    "GradientMagnitude": GradientMagnitude,
    "Filtered": Filtered,
    "ChannelMix": ChannelMix,
    "Labels": Labels,
    "FilteredLit": FilteredLit,
}


def shade_rays(
    rays: RayArguments, arguments: TraceArguments, shading: ShadeArguments, parameter_54: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Twin of `ops.shade_rays`."""
    kind = SHADER_KINDS[shading.shader]
    twin = TWINS[kind]
    walk = Walk.enter(rays, arguments, twin.bricks)
    beam, channel = walk.intervals.beam, walk.channel
    columns = (rays.origin_r3, rays.direction_r3, beam.moved, arguments.place_33[1])
    light = Light(
        ShadeParameters.read(parameter_54),
        channel.components(shading.normal_bzyxc, shading.normal_tnc),
        *(column.to(beam.first) for column in columns),
    )
    shadows = Shadows(walk, light.cube, arguments.cone_scale)
    others = channel.components(shading.other_bzyxc, shading.other_tnc)
    features = beam.first.new_zeros((len(beam.first), shading.features))
    shader = twin.begin(
        *(rays, arguments, walk, light, others, shading.other_component, features),
        shadows if kind.startswith("Shadowed") else None,
    )
    walk.go(shader)
    shader.done(walk)
    return (
        *shader.sum.hits(beam),
        *(walk.samples + shadows.samples, walk.missed | shadows.missed),
        *(unit(shader.normal), shader.features),
    )


def _with_length(rows: Tensor, lengths: Tensor) -> Tensor:
    """Returns (r, 4) premultiplied colour and alpha of the same values over another length."""
    old_alpha = rows[:, 3]
    changes = (old_alpha > 0) & (lengths != 1)
    alpha = torch.where(lengths > 0, stretch(old_alpha, lengths), 0.0)
    scale = alpha / torch.where(changes, old_alpha, 1.0)
    scaled = torch.cat((rows[:, :3] * scale[:, None], alpha[:, None]), 1)
    return torch.where(changes[:, None], scaled, rows)


def _over(a: Tensor, b: Tensor) -> Tensor:
    return a + (1 - a[:, 3:]) * b
