"""The torch twin of `shade_rays`: the fused shaders, right by definition. csrc/shaders/shaders.h
describes each of them. stored_color.py, channels.py and labels.py hold those that read more of a
voxel than its value; light.py lights them, march.py walks the rays.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from ...base import check
from ..arguments import RayArguments, ShadeArguments, TraceArguments
from ..shading import Number, ShadeParameters
from .channels import ChannelMix
from .exact import clamp, dot, larger, sqrt_exact, stretch, unit
from .labels import Labels
from .light import Light, Shadows
from .lit import Lit
from .march import Interval, Probe, Walk, a_little_above, a_little_below, mix
from .rays import INF
from .stored_color import Filtered, FilteredLit, StoredColor

_BISECTIONS = 4


class PreIntegrated(Lit):
    """A table over the values at both ends of an interval, (l, m, m, 4)."""

    integrates = True

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        lengths = torch.where(interval.odd, interval.lengths, 1.0)
        level = torch.where(interval.odd, 0, interval.level)
        end_values = probe.value(interval.start), probe.value(interval.end)
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
        self.sum.absorb(rgba[:, 3], interval, mask)

    def _between(self, front: Tensor, back: Tensor, level: Tensor) -> Tensor:
        """Returns (r, 4) table rows of intervals of a level's length, from one value to another."""
        table = self.transfer.table_lm4
        (row, row_weight), (column, weight) = self.transfer.cell(front), self.transfer.cell(back)
        near, far = (
            mix(table[level, r, column], table[level, r, column + 1], weight)
            for r in (row, row + 1)
        )
        return mix(near, far, row_weight)


class IsosurfaceNumbers(NamedTuple):
    """The numbers specific to isosurfaces."""

    level: Number  # the value at the surface
    filled: float = 1.0  # the solid side. 1: values >= level; -1: values < level; 0: neither
    scale: float = 0.0  # factor of the second channel's four numbers, a colour; 0: use the table
    premultiplied: float = 0.0  # above 0: its colours are stored times the fourth number


class Isosurface(Lit):
    """The first point where the value crosses a level."""

    def __post_init__(self) -> None:
        super().__post_init__()
        zeros = torch.zeros_like(self.sum.clear)
        self.numbers = self.light.parameters.own_as(IsosurfaceNumbers)
        self.level = torch.as_tensor(self.numbers.level, device=zeros.device)
        self.filled = self.numbers.filled
        self.is_hit = torch.zeros_like(zeros, dtype=torch.bool)
        self.last_value, self.last_end, self.share = zeros, zeros - INF, zeros

    def hides(self, ray_index: Tensor, node: Tensor) -> Tensor:
        return super().hides(ray_index, node) & ~self.is_hit[ray_index]

    def transparent(self, low: Tensor, high: Tensor) -> Tensor:
        below, above = a_little_above(high) < self.level, a_little_below(low) >= self.level
        return (below & (self.filled >= 0)) | (above & (self.filled <= 0))

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        level = self.level
        front, back = probe.value(interval.start), probe.value(interval.end)
        below = front < level
        hits_start = (self.last_end == interval.start) & ((self.last_value < level) != below)
        if self.filled != 0:
            hits_start = hits_start | (~below if self.filled > 0 else below)
        hits_start = mask & hits_start
        # The ray starts inside: there is no surface and no normal.
        begins = hits_start & (self.last_end == -INF)
        crosses = mask & ~hits_start & (below != (back < level))
        self.last_value = torch.where(mask, back, self.last_value)
        self.last_end = torch.where(mask, interval.end, self.last_end)
        self.last_end = torch.where(begins, INF, self.last_end)
        if not (hits_start | crosses).any():
            return
        near, far, near_value, far_value = interval.start, interval.end, front, back
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
        self.sum.depth = torch.where(
            hit, torch.where(hits_start, interval.start, t), self.sum.depth
        )

    def done(self, walk: Walk) -> None:
        """Shades the surface points found; each looks its node up once more."""
        self.is_hit = self.sum.depth < INF
        t = torch.where(self.is_hit, self.sum.depth, 0.0)
        walk.find(self.is_hit.nonzero()[:, 0], t, self)
        probe = Probe(walk.intervals.beam, walk.visit, self.channel)
        normal = self.light.normal_at(probe, t)
        normal = torch.where((self.last_end < INF)[:, None], normal, 0.0)
        color = self.share[:, None] * self.light.shade(self.color_at(probe, t), normal, t)
        self.sum.color = torch.where(self.is_hit[:, None], color, 0.0)
        self.normal = torch.where(self.is_hit[:, None], normal, 0.0)

    def color_at(self, probe: Probe, t: Tensor) -> Tensor:
        """Returns (r, 3) base colours of the surface at distances t (r,)."""
        other = self.other
        if self.numbers.scale > 0 and other is not None and other.constant_nc.shape[1] >= 4:
            rgba = probe.numbers(other, t)[:, :4] * self.numbers.scale
            has_opacity = (rgba[:, 3:] > 0) & (self.numbers.premultiplied > 0)
            return rgba[:, :3] / torch.where(has_opacity, rgba[:, 3:], 1.0)
        if other is not None:
            return self.transfer.look_up(probe.number(other, t))[:, :3]
        return self.transfer.look_up(self.level.expand_as(t))[:, :3]


class ProjectionKind(IntEnum):
    """How a projection reduces the values along a ray."""

    MAXIMUM = 0
    MINIMUM = 1
    MEAN = 2


class ProjectionNumbers(NamedTuple):
    """The number specific to projections."""

    kind: Number  # a ProjectionKind


class Projection(Lit):
    """Maximum, minimum or mean of the value."""

    sees_empty = True
    feature_count = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.kind = self.light.parameters.own_as(ProjectionNumbers).kind
        self.value, self.length, self.value_t = (torch.zeros_like(self.sum.clear) for _ in range(3))

    def hides(self, ray_index: Tensor, node: Tensor) -> Tensor:
        kind, value = self.kind, self.value[ray_index]
        low, high = self.channel.value_range(node, value.dtype)
        no_gain = ((kind == ProjectionKind.MAXIMUM) & (a_little_above(high) <= value)) | (
            (kind == ProjectionKind.MINIMUM) & (a_little_below(low) >= value)
        )
        return no_gain & (self.length[ray_index] > 0)

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        kind, value = self.kind, probe.value(interval.middle)
        first = ~(self.length > 0)
        if kind == ProjectionKind.MEAN:
            self.value_t = torch.where(mask & first, interval.start, self.value_t)
            self.value = torch.where(mask, self.value + value * interval.length, self.value)
        else:
            better = value > self.value if kind == ProjectionKind.MAXIMUM else value < self.value
            better = mask & (first | better)
            self.value = torch.where(better, value, self.value)
            self.value_t = torch.where(better, interval.middle, self.value_t)
        self.length = torch.where(mask, self.length + interval.length, self.length)

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

    feature_count = None

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        rgba = self.rgba(interval, probe)
        share = torch.where(mask, self.sum.clear * rgba[:, 3], 0.0)
        assert self.other is not None  # `ops.trace.check_shade` requires it
        numbers = probe.numbers(self.other, interval.middle)
        self.features = self.features + share[:, None] * numbers
        self.sum.add(rgba, interval, mask)


class GradientMagnitudeNumbers(NamedTuple):
    """The number specific to shading by gradient magnitude."""

    full: Number  # the gradient's length from which opacity is unreduced, value per world unit


class GradientMagnitude(Lit):
    """The transfer function, denser where the value changes faster."""

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        numbers = self.light.parameters.own_as(GradientMagnitudeNumbers)
        rgba = self.rgba(interval, probe)
        slope = probe.gradient(interval.middle, self.light.cube)
        fraction = clamp(sqrt_exact(dot(slope, slope)) / numbers.full, 0, 1)
        alpha = torch.where(fraction > 0, stretch(rgba[:, 3], fraction), 0.0)
        self.sum.add(torch.cat((rgba[:, :3], alpha[:, None]), 1), interval, mask)


class ShaderKind(NamedTuple):
    """A fused shader. Its twin tells what it requires of the arguments of `shade_rays`."""

    twin: type[Lit]
    shadows: bool = False  # whether each sample sends a ray to the light


#: The fused shaders, in the order of `GV_SHADERS` in csrc/shaders/shaders.h.
SHADER_KINDS: Mapping[str, ShaderKind] = {
    "Lit": ShaderKind(Lit),
    "PreIntegrated": ShaderKind(PreIntegrated),
    "StoredColor": ShaderKind(StoredColor),
    "Isosurface": ShaderKind(Isosurface),
    "Projection": ShaderKind(Projection),
    "Features": ShaderKind(Features),
    "ShadowedLit": ShaderKind(Lit, shadows=True),
    "ShadowedColor": ShaderKind(StoredColor, shadows=True),
    "GradientMagnitude": ShaderKind(GradientMagnitude),
    "Filtered": ShaderKind(Filtered),
    "ChannelMix": ShaderKind(ChannelMix),
    "Labels": ShaderKind(Labels),
    "FilteredLit": ShaderKind(FilteredLit),
}


def shader_number(kind: str) -> int:
    """Returns the number of a fused shader; raises ValueError if there is none of this name."""
    check.one_of("shader", "kind", kind, SHADER_KINDS)
    return [*SHADER_KINDS].index(kind)


def shade_rays(
    rays: RayArguments, arguments: TraceArguments, shading: ShadeArguments, parameter_54: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Twin of `ops.shade_rays`."""
    twin, is_shadowed = [*SHADER_KINDS.values()][shading.shader]
    walk = Walk.enter(rays, arguments, twin.bricks)
    beam, channel = walk.intervals.beam, walk.channel
    columns = (rays.origin_r3, rays.direction_r3, beam.moved, arguments.place_33[1])
    normals = channel.other(shading.normal_bzyxc, shading.normal_tnc, 0)
    rounded = (column.to(beam.first) for column in columns)
    light = Light(ShadeParameters.read(parameter_54), normals, *rounded)
    shadows = Shadows(walk, light.cube, arguments.cone_scale)
    other = channel.other(shading.other_bzyxc, shading.other_tnc, shading.other_component)
    features = beam.first.new_zeros((len(beam.first), shading.features))
    fields = (light, other, features, shadows if is_shadowed else None)
    shader = twin.begin(rays, arguments, walk, *fields)
    walk.follow(shader)
    shader.done(walk)
    samples, missed = walk.samples + shadows.samples, walk.missed | shadows.missed
    return *shader.sum.hits(beam), samples, missed, unit(shader.normal), shader.features


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
