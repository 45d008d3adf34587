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
LIT = 10  # numbers per direction of filtered colours with moments of normals


@dataclass
class Shade(Plain):
    """The lit transfer function, and the base of all fused shaders."""

    light: Light
    others: tuple[ChannelBricks, ...]  # components of the second channel, or none
    other_component: int
    features: Tensor  # (r, c) sums
    shadows: Shadows | None
    bricks: ClassVar[type[ChannelBricks]] = ChannelBricks  # how it reads its channel

    def __post_init__(self) -> None:
        self.normal = torch.zeros_like(self.light.along)  # (r, 3) sum

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """As `Visitor.same`; false for shadows, and for stored normals with a point light."""
        same = torch.ones_like(fine, dtype=torch.bool)
        for channel in (self.channel, *self.light.normals[:1], *self.others[:1]):
            numbers = channel.constant_nc
            same = same & (numbers[fine] == numbers[coarse]).all(1)
        near = self.light.parameters.light_kind == LightKind.POINT and bool(self.light.normals)
        return (same | (fine == coarse)) & (self.shadows is None) & (not near)

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        self.lit(self.rgba(piece, probe), piece, probe, where)

    def lit(self, rgba: Tensor, piece: Piece, probe: Probe, where: Tensor) -> None:
        """Lights an interval and adds it."""
        t, seen = piece.middle, where & (rgba[:, 3] > 0)
        normal = self.light.normal_at(probe, t)
        at_eye = self.light.parameters.light_kind == LightKind.HEADLIGHT
        share = None  # no shadows
        if self.shadows is not None and not at_eye:
            share = partial(self.comes, self.shadows, t, seen)
        color = self.light.shade(rgba[:, :3], normal, t, share)
        color = torch.where(seen[:, None], color, rgba[:, :3])
        weight = self.sum.clear * rgba[:, 3]
        self.normal = torch.where(
            seen[:, None], self.normal + weight[:, None] * normal, self.normal
        )
        self.sum.add(torch.cat((color, rgba[:, 3:]), 1), piece, where)

    def comes(self, shadows: Shadows, t: Tensor, seen: Tensor, facing: Tensor) -> Tensor:
        """Returns (r,) the share of light that reaches t (r,), where it is seen and faces it."""
        matter = replace(self, shadows=None)
        return shadows.share(matter, t, *self.light.towards(t), seen & facing, self.light)

    def done(self, walk: Walk) -> None:
        """Finishes after the last interval."""


class Sided(ChannelBricks):
    """A channel of red, green, blue, opacity, once or for six directions; ranges are opacity's."""

    def ends(self, node: Tensor, real: torch.dtype) -> tuple[Tensor, Tensor]:
        low, high = self.range_n2c[node, :, 3::4].to(real).unbind(1)
        return low.amin(1), high.amax(1)


class StoredColor(Shade):
    """Colour and opacity of each voxel."""

    bricks = Sided

    @property
    def own(self) -> StoredColorNumbers:
        return self.light.parameters.own_as(StoredColorNumbers)

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        return ~(a_little_above(high) > 0)

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        own = self.own
        opacity = self.opacity(piece, probe, self.light.along)
        seen = where & (opacity > 0)
        numbers = [self.seen(probe, i, piece.middle, self.light.along) for i in range(3)]
        color = torch.stack(numbers, 1) * own.scale
        divisor = torch.where((own.premultiplied > 0) & seen, opacity, 1.0)
        alpha = stretch(opacity, piece.length / own.reference)
        rgba = torch.cat((color / divisor[:, None], alpha[:, None]), 1)
        if own.lit > 0:
            self.lit(rgba, piece, probe, seen)
        else:
            self.sum.add(rgba, piece, seen)

    def alpha(self, piece: Piece, probe: Probe, along: Tensor) -> Tensor:
        return stretch(self.opacity(piece, probe, along), piece.length / self.own.reference)

    def opacity(self, piece: Piece, probe: Probe, along: Tensor) -> Tensor:
        """Returns (r,) opacity per reference length."""
        return clamp(self.seen(probe, 3, piece.middle, along) * self.own.scale, 0, 1)

    def seen(self, probe: Probe, number: int, t: Tensor, along: Tensor) -> Tensor:
        """Returns (r,) one of the four numbers as seen along rays (r, 3), for which three of the
        directions are mixed where the channel holds six.
        """

        def read(component: int) -> Tensor:
            return probe.number(replace(self.channel, component=component), t)

        return _by_direction(along, self.channel.bricks_bzyxc.shape[4], number, read)


class PreIntegrated(Shade):
    """A table over the values at both ends of an interval, (l, m, m, 4)."""

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        lengths = torch.where(piece.odd, piece.lengths, 1.0)
        level = torch.where(piece.odd, 0, piece.level)
        ends = probe.value(piece.start), probe.value(piece.end)
        low, high = self.transfer.domain_2
        front, back = (clamp(value, low, high) for value in ends)
        row = self._pair(front, back, level)
        inside = (front == back) | ((front == ends[0]) & (back == ends[1]))
        rise = ends[1] - ends[0]
        share = lengths / torch.where(inside, 1.0, larger(rise, -rise))

        def of(rows: Tensor, rise: Tensor) -> Tensor:
            return _part(rows, share * larger(rise, -rise))

        mixed = of(row, back - front)
        mixed = _over(of(self._pair(front, front, level), front - ends[0]), mixed)
        mixed = _over(mixed, of(self._pair(back, back, level), ends[1] - back))
        rgba = torch.where(inside[:, None], _part(row, lengths), mixed)
        self.sum.add_light(self.sum.clear[:, None] * rgba[:, :3], where)
        self.sum.absorb(rgba[:, 3], piece, where)

    def _pair(self, front: Tensor, back: Tensor, level: Tensor) -> Tensor:
        """Returns (r, 4) table rows of intervals of a level's length, from one value to another."""
        table = self.transfer.table_lm4
        (row, row_weight), (column, weight) = self.transfer.cell(front), self.transfer.cell(back)
        near, far = (
            mix(table[level, r, column], table[level, r, column + 1], weight)
            for r in (row, row + 1)
        )
        return mix(near, far, row_weight)


class Isosurface(Shade):
    """The first point where the value crosses a level."""

    def __post_init__(self) -> None:
        super().__post_init__()
        nothing = torch.zeros_like(self.sum.clear)
        own = self.light.parameters.own_as(IsosurfaceNumbers)
        self.own, self.level, self.filled = own, torch.as_tensor(own.level), own.filled
        self.found = torch.zeros_like(nothing, dtype=torch.bool)
        self.before, self.before_end, self.share = nothing, nothing - INF, nothing

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        level, filled, hides = self.level, self.filled, torch.zeros_like(self.found[which])
        if filled >= 0:
            hides = hides | (a_little_above(high) < level)
        if filled <= 0:
            hides = hides | (a_little_below(low) >= level)
        return hides & ~self.found[which]

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        level = self.level
        front, back = probe.value(piece.start), probe.value(piece.end)
        under = front < level
        early = (self.before_end == piece.start) & ((self.before < level) != under)
        if self.filled != 0:
            early = early | (~under if self.filled > 0 else under)
        early = where & early
        begins = early & (self.before_end == -INF)  # the ray starts inside: no surface, no normal
        crosses = where & ~early & (under != (back < level))
        self.before = torch.where(where, back, self.before)
        self.before_end = torch.where(where, piece.end, self.before_end)
        self.before_end = torch.where(begins, INF, self.before_end)
        if not (early | crosses).any():
            return
        near, far, near_value, far_value = piece.start, piece.end, front, back
        for _ in range(_BISECTIONS):
            middle = near + (far - near) * 0.5
            value = probe.value(middle)
            same = (value < level) == under
            near, near_value = torch.where(same, middle, near), torch.where(same, value, near_value)
            far, far_value = torch.where(same, far, middle), torch.where(same, far_value, value)
        rise = torch.where(crosses, far_value - near_value, 1.0)
        t = near + clamp((level - near_value) / rise, 0, 1) * (far - near)
        hit = early | crosses
        self.share = torch.where(hit, self.sum.clear, self.share)
        self.sum.clear = torch.where(hit, 0.0, self.sum.clear)
        self.sum.depth = torch.where(hit, torch.where(early, piece.start, t), self.sum.depth)

    def done(self, walk: Walk) -> None:
        """Shades the surface points found; each looks its node up once more."""
        self.found = self.sum.depth < INF
        t = torch.where(self.found, self.sum.depth, 0.0)
        walk.look_up(self.found.nonzero()[:, 0], t, self)
        probe = Probe(walk.at.beam, walk.visit, self.channel)
        normal = self.light.normal_at(probe, t)
        normal = torch.where((self.before_end < INF)[:, None], normal, 0.0)
        color = self.share[:, None] * self.light.shade(self.color_at(probe, t), normal, t)
        self.sum.color = torch.where(self.found[:, None], color, 0.0)
        self.normal = torch.where(self.found[:, None], normal, 0.0)

    def color_at(self, probe: Probe, t: Tensor) -> Tensor:
        """Returns (r, 3) base colours of the surface at distances t (r,)."""
        if self.own.scale > 0:
            numbers = [probe.number(self.others[i], t) for i in range(4)]
            rgba = torch.stack(numbers, 1) * self.own.scale
            known = (rgba[:, 3:] > 0) & (self.own.premultiplied > 0)
            return rgba[:, :3] / torch.where(known, rgba[:, 3:], 1.0)
        if self.others:
            return self.transfer.look_up(probe.number(self.others[self.other_component], t))[:, :3]
        return self.transfer.look_up(self.level.expand_as(t))[:, :3]


class Projection(Shade):
    """Maximum, minimum or mean of the value."""

    sees_empty = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.kind = self.light.parameters.own_as(ProjectionNumbers).kind
        self.found, self.length, self.at = (torch.zeros_like(self.sum.clear) for _ in range(3))

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        kind, found = self.kind, self.found[which]
        useless = ((kind == ProjectionKind.MAXIMUM) & (a_little_above(high) <= found)) | (
            (kind == ProjectionKind.MINIMUM) & (a_little_below(low) >= found)
        )
        return useless & (self.length[which] > 0)

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        kind, value = self.kind, probe.value(piece.middle)
        first = ~(self.length > 0)
        if kind == ProjectionKind.MEAN:
            self.at = torch.where(where & first, piece.start, self.at)
            self.found = torch.where(where, self.found + value * piece.length, self.found)
        else:
            better = value > self.found if kind == ProjectionKind.MAXIMUM else value < self.found
            better = where & (first | better)
            self.found = torch.where(better, value, self.found)
            self.at = torch.where(better, piece.middle, self.at)
        self.length = torch.where(where, self.length + piece.length, self.length)

    def done(self, walk: Walk) -> None:
        seen = self.length > 0
        mean = self.found / torch.where(seen, self.length, 1.0)
        value = mean if self.kind == ProjectionKind.MEAN else self.found
        row = self.transfer.look_up(value)
        color = self.sum.clear[:, None] * row[:, :3]
        self.sum.color = torch.where(seen[:, None], color, 0.0)
        self.sum.clear = torch.where(seen, 0.0, self.sum.clear)
        self.sum.depth = torch.where(seen, self.at, INF)
        self.features = torch.where(seen, value, 0.0)[:, None]


class Features(Shade):
    """All numbers of a second channel, composited with the transfer function's alpha."""

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        rgba = self.rgba(piece, probe)
        share = torch.where(where, self.sum.clear * rgba[:, 3], 0.0)
        numbers = torch.stack([probe.number(channel, piece.middle) for channel in self.others], 1)
        self.features = self.features + share[:, None] * numbers
        self.sum.add(rgba, piece, where)


class GradientMagnitude(Shade):
    """The transfer function, denser where the value changes faster."""

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        own = self.light.parameters.own_as(GradientMagnitudeNumbers)
        rgba = self.rgba(piece, probe)
        slope = probe.gradient(piece.middle, self.light.cube)
        part = clamp(sqrt_exact(dot(slope, slope)) / own.full, 0, 1)
        alpha = torch.where(part > 0, stretch(rgba[:, 3], part), 0.0)
        self.sum.add(torch.cat((rgba[:, :3], alpha[:, None]), 1), piece, where)


class Labels(Shade):
    """The label of the nearest voxel."""

    bricks = LabelBricks
    channel: LabelBricks

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        first, last = self.row(low), self.row(high)
        before = self.transfer.opaque_m[(first - 1).clamp(min=0)]
        return self.transfer.opaque_m[last] == torch.where(first > 0, before, 0)

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        fine, coarse = probe.nodes.fine, probe.nodes.coarse
        looks = probe.blend(piece.middle, partial(self.look, piece, probe))
        color, alpha, normal = looks.split((3, 1, 3), 1)
        hidden = ~(self.look(piece, probe, fine)[:, 3] > 0)
        holder = fine.index_put((hidden.nonzero()[:, 0],), coarse[hidden])
        label = self.row(self.channel.nearest(holder, probe.beam, piece.middle).value)
        left, clear, at = self.sum.clear * (1 - alpha[:, 0]), self.sum.clear, self.sum.hit_clear
        hit = where & (left < at) & (clear >= at)
        self.features = torch.where(hit[:, None], (1 + label)[:, None].to(alpha), self.features)
        shown = where & (alpha[:, 0] > 0)
        self.normal = torch.where(
            shown[:, None], self.normal + clear[:, None] * normal, self.normal
        )
        self.sum.add_light(clear[:, None] * color, shown)
        self.sum.absorb(alpha[:, 0], piece, shown)

    def row(self, label: Tensor) -> Tensor:
        """Returns (r,) int64 table rows of labels."""
        low, last = self.transfer.domain_2[0], len(self.transfer.opaque_m) - 1
        return clamp(label - low, 0, last).to(torch.int64)

    def look(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 7) what a node shows: premultiplied colours, alphas, normals times alpha."""
        t, table = piece.middle, self.transfer.table_lm4
        found = self.channel.nearest(holder, probe.beam, t)
        level = torch.where(piece.odd, 0, piece.level)
        color, alpha = table[level, self.row(found.value)].split((3, 1), 1)
        stretched = stretch(alpha[:, 0], piece.lengths)[:, None]
        alpha = torch.where((piece.odd & (alpha[:, 0] > 0))[:, None], stretched, alpha)
        normal = torch.zeros_like(color)
        if self.light.parameters.own_as(LabelNumbers).lit > 0:
            way = self.channel.away(holder, found) * (holder.scale[:, None] / self.light.cube)
            normal = unit(torch.where((holder.brick >= 0)[:, None], way, 0.0))
            away = dot(normal, self.light.along) > 0
            normal = torch.where(away[:, None], -normal, normal)
            color = self.light.shade(color, normal, t)
        seen = alpha > 0
        parts = torch.cat((color * alpha, alpha, normal * alpha), 1)
        return torch.where(seen, parts, 0.0)


class Filtered(Shade):
    """The transfer function, and filtered colours where bricks have them (in coarse slots)."""

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        fine, coarse = probe.nodes.fine, probe.nodes.coarse
        stored = self.stored(fine) | self.stored(coarse)
        self.add_near(piece, probe, where & ~stored)
        if not (where & stored).any():
            return
        found = probe.blend(piece.middle, lambda holder: self.look(piece, probe, holder))
        self.add_found(found, piece, where & stored)

    def add_near(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """Adds an interval where no node has colours."""
        self.sum.add(self.rgba(piece, probe), piece, where)

    def add_found(self, found: Tensor, piece: Piece, where: Tensor) -> None:
        """Adds an interval, given the result of `look`."""
        self.sum.add_light(self.sum.clear[:, None] * found[:, :3], where)
        self.sum.absorb(found[:, 3], piece, where)

    def stored(self, holder: Holder) -> Tensor:
        """Returns (r,) bool: the node's brick has colours."""
        bricks = self.others[0].bricks_bzyxc if self.others else self.channel.bricks_bzyxc[:0]
        return (holder.brick >= 0) & (holder.brick < len(bricks))

    def look(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 4) premultiplied colours and alphas of intervals, from one of the nodes."""
        row = self.row(piece, probe, holder)
        row = torch.cat((row[:, :3] * row[:, 3:], row[:, 3:]), 1)
        read = self.reader(piece, probe, holder)
        seen, alpha, part = self.seen(4, read, piece, holder)
        colors = torch.stack([*(one * part for one in seen[:3]), alpha], 1)
        colors = torch.where((part > 0)[:, None], colors, 0.0)
        return torch.where(self.stored(holder)[:, None], colors, row)

    def row(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 4) the transfer function's rows for one node's values."""
        value = self.channel.sample(holder, probe.beam, piece.middle)
        return self.transfer.interval(value, piece)

    def reader(self, piece: Piece, probe: Probe, holder: Holder) -> Callable[[int], Tensor]:
        """Returns a function that reads one number (r,) of a node's filtered colours."""
        brick = torch.where(self.stored(holder), holder.brick, EMPTY)
        known = replace(holder, brick=brick)
        return lambda number: self.others[number].sample(known, probe.beam, piece.middle)

    def seen(
        self, one: int, read: Callable[[int], Tensor], piece: Piece, holder: Holder
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Returns colour and alpha (r,) of a node's voxels as rays see them, `one` numbers a
        direction; alphas (r,) of intervals; and their ratios to the voxels' alphas.
        """
        width = len(self.others)
        seen = [_by_direction(self.light.along, width, i, read, one) for i in range(4)]
        whole = clamp(seen[3], 0, 1)
        side = self.light.parameters.own_as(FilteredNumbers).side
        alpha = stretch(whole, piece.length * holder.scale / side)
        part = alpha / torch.where(whole > 0, whole, 1.0)
        return seen, alpha, torch.where(whole > 0, part, 0.0)


class FilteredLit(Filtered):
    """The lit transfer function, and filtered colours with moments of normals."""

    def add_near(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        self.lit(self.rgba(piece, probe), piece, probe, where)

    def add_found(self, found: Tensor, piece: Piece, where: Tensor) -> None:
        clear, seen = self.sum.clear[:, None], where & (found[:, 3] > 0)
        normal = self.normal + clear * found[:, 4:]
        self.normal = torch.where(seen[:, None], normal, self.normal)
        super().add_found(found, piece, where)

    def look(self, piece: Piece, probe: Probe, holder: Holder) -> Tensor:
        """Returns (r, 7): the result of `Filtered.look`, lit, and normals times alpha."""
        t, light = piece.middle, self.light
        row = self.row(piece, probe, holder)
        normal = light.to_eye(probe.slope(holder, t, light.cube))
        color, alpha = light.shade(row[:, :3], normal, t), row[:, 3:]
        near = torch.cat((color * alpha, alpha, normal * alpha), 1)
        near = torch.where(alpha > 0, near, 0.0)

        read = self.reader(piece, probe, holder)
        seen, long, part = self.seen(LIT, read, piece, holder)
        shown, alpha = (part > 0)[:, None], long[:, None]
        whole = torch.where(part > 0, clamp(seen[3], 0, 1), 1.0)[:, None]
        moments, front = self.moments(read)
        front = None if front is None else front / whole
        base = torch.stack(seen[:3], 1) / whole
        color, normal = light.shade_rough(base, moments / whole, front, t)
        far = torch.cat((color * alpha, alpha, unit(normal) * alpha), 1)
        far = torch.where(shown, far, 0.0)
        return torch.where(self.stored(holder)[:, None], far, near)

    def moments(self, read: Callable[[int], Tensor]) -> tuple[Tensor, Tensor | None]:
        """Returns (r, 6) moments of the normals that rays see, and, if six directions are stored,
        (r, 3) their mean, each normal turned to the side from which its direction sees it.
        """
        if len(self.others) == LIT:
            return torch.stack([read(i) for i in range(4, LIT)], 1), None
        mean = front = torch.zeros_like(self.light.along[:, :1])
        for axis, d in enumerate(self.light.along.unbind(1)):
            back, first = d < 0, 2 * axis * LIT
            m = [torch.where(back, read(first + LIT + i), read(first + i)) for i in range(4, LIT)]
            column = [m[i] for i in ((0, 1, 2), (1, 3, 4), (2, 4, 5))[axis]]
            weight, total, own = d * d, m[0] + m[3] + m[5], column[axis]
            some = (total > 0) & (own > 0)
            scale = sqrt_exact(torch.where(some, total, 0.0) / torch.where(some, own, 1.0)) * weight
            turned = torch.where(back, scale, -scale)[:, None]
            mean = mean + weight[:, None] * torch.stack(m, 1)
            front = front + turned * torch.stack(column, 1)
        return mean, front


class ChannelMix(Shade):
    """Several numbers of a voxel, each with its transfer function."""

    bricks = AllNumbers

    def __post_init__(self) -> None:
        super().__post_init__()
        self.table = ChannelTable(self.transfer)

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        return self.table.transparent(low, high)

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        rgba = self.table.interval(piece, probe)
        self.sum.add_light(self.sum.clear[:, None] * rgba[:, :3], where)
        self.sum.absorb(rgba[:, 3], piece, where)


def _by_direction(
    along: Tensor, width: int, number: int, read: Callable[[int], Tensor], one: int = 4
) -> Tensor:
    """Returns (r,) one of the numbers of a voxel as seen along rays (r, 3); `read` reads one. Where
    a channel holds six times `one` numbers, three of the directions are mixed.
    """
    if width == one:
        return read(number)
    side = [
        torch.where(d < 0, read((2 * axis + 1) * one + number), read(2 * axis * one + number))
        for axis, d in enumerate(along.unbind(1))
    ]
    x, y, _ = (along * along).unbind(1)
    return side[2] + x * (side[0] - side[2]) + y * (side[1] - side[2])


#: Twins by the names of the C++ structs.
TWINS: dict[str, type[Shade]] = {
    "Lit": Shade,
    "PreIntegrated": PreIntegrated,
    "StoredColor": StoredColor,
    "Isosurface": Isosurface,
    "Projection": Projection,
    "Features": Features,
    "ShadowedLit": Shade,
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
    beam, channel = walk.at.beam, walk.channel
    columns = (rays.origin_r3, rays.direction_r3, beam.moved, arguments.place_33[1])
    light = Light(
        ShadeParameters.read(parameter_54),
        channel.components(shading.normal_bzyxc, shading.normal_tnc),
        *(column.to(beam.first) for column in columns),
    )
    shadows = Shadows(walk, light.cube, arguments.cone_scale)
    others = channel.components(shading.other_bzyxc, shading.other_tnc)
    features = beam.first.new_zeros((len(beam.first), shading.features))
    shade = twin.begin(
        *(rays, arguments, walk, light, others, shading.other_component, features),
        shadows if kind.startswith("Shadowed") else None,
    )
    walk.go(shade)
    shade.done(walk)
    return (
        *shade.sum.hits(beam),
        *(walk.samples + shadows.samples, walk.missed | shadows.missed),
        *(unit(shade.normal), shade.features),
    )


def _part(rows: Tensor, lengths: Tensor) -> Tensor:
    """Returns (r, 4) premultiplied colour and alpha of the same values over another length."""
    whole = rows[:, 3]
    changed = (whole > 0) & (lengths != 1)
    alpha = torch.where(lengths > 0, stretch(whole, lengths), 0.0)
    scale = alpha / torch.where(changed, whole, 1.0)
    scaled = torch.cat((rows[:, :3] * scale[:, None], alpha[:, None]), 1)
    return torch.where(changed[:, None], scaled, rows)


def _over(a: Tensor, b: Tensor) -> Tensor:
    return a + (1 - a[:, 3:]) * b
