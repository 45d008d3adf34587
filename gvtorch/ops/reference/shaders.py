"""The torch twin of `shade_rays`: the fused shaders, right by definition. See csrc/shaders.h for
what each does, and reference.py for the walk along the rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..arguments import RayArguments, ShadeArguments, TraceArguments
from ..shading import (
    IsosurfaceNumbers,
    LightKind,
    ProjectionKind,
    ProjectionNumbers,
    ShadeParameters,
    ShaderKind,
    StoredColorNumbers,
)
from .exact import clamp, divide, dot, larger, power, sqrt_exact, stretch, unit
from .march import Accumulator, Piece, Probe, Transfer, walk
from .rays import INF, Beam, Intervals
from .shadows import Shadows
from .tree import Bricks, Tree

_BISECTIONS = 4


@dataclass
class Shade:
    """What the shaders share: tables, parameters, channels, and the sums of every ray."""

    transfer: Transfer
    parameters: ShadeParameters
    normals: tuple[Bricks, ...]  # three components, or none
    others: tuple[Bricks, ...]  # components of the second channel, or none
    other_component: int
    channel: Bricks  # the value's
    eye: Tensor  # (r, 3) world
    along: Tensor  # (r, 3) world
    moved: Tensor  # (r,)
    cube: Tensor  # (3,) world size of the root cube
    sum: Accumulator
    normal: Tensor  # (r, 3)
    features: Tensor  # (r, c)
    hit_clear: Tensor
    shadows: Shadows | None
    sees_empty: bool = False

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """See `reference.Shader`."""
        return self.transfer.transparent(low, high)

    def same(self, bricks: Bricks, fine: Tensor, coarse: Tensor) -> Tensor:
        """See `reference.Shader`. Shadows differ from place to place."""
        if self.shadows is not None:
            return torch.zeros_like(fine, dtype=torch.bool)
        return self.equal(fine, coarse)

    def equal(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """(k,) bool: two nodes without bricks hold the same numbers."""
        equal = torch.ones_like(fine, dtype=torch.bool)
        for channel in (self.channel, *self.normals[:1], *self.others[:1]):
            numbers = channel.constant_nc
            equal = equal & (numbers[fine] == numbers[coarse]).all(1)
        equal = equal | (fine == coarse)
        # Near a light, a stored normal is lit differently wherever it stands.
        return equal & (self.parameters.light_kind != LightKind.POINT) if self.normals else equal

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """The transfer function, lit."""
        rgba = self.transfer.interval(probe.value(piece.middle), piece)
        self.lit(rgba, piece, probe, where)

    def alpha(self, piece: Piece, probe: Probe, along: Tensor) -> Tensor:
        """(r,) what intervals take from the light that goes along `along` (r, 3)."""
        return self.transfer.interval(probe.value(piece.middle), piece)[:, 3]

    def done(self) -> None:
        """After the last interval."""

    def lit(self, rgba: Tensor, piece: Piece, probe: Probe, where: Tensor) -> None:
        """Adds an interval in the light."""
        seen = where & (rgba[:, 3] > 0)
        normal = self.normal_at(probe, piece.middle)
        color = self.shade(rgba[:, :3], normal, piece.middle, seen)
        color = torch.where(seen[:, None], color, rgba[:, :3])
        share = self.sum.clear * rgba[:, 3]
        added = self.normal + share[:, None] * normal
        self.normal = torch.where(seen[:, None], added, self.normal)
        self.composite(torch.cat((color, rgba[:, 3:]), 1), piece, where)

    def composite(self, rgba: Tensor, piece: Piece, where: Tensor) -> None:
        """Adds an interval of a colour and an alpha."""
        self.sum.add(rgba, piece.start, piece.length, self.hit_clear, where)

    def gradient(self, probe: Probe, t: Tensor) -> Tensor:
        """(r, 3) gradients of the value per world unit, from half a voxel to each side."""
        columns = []
        for axis in range(3):
            low, high = ([0.0] * 3 for _ in range(2))
            low[axis], high[axis] = -0.5, 0.5

            def ask(
                node: Tensor,
                corner: Tensor,
                size: Tensor,
                axis: int = axis,
                low: tuple[float, ...] = tuple(low),
                high: tuple[float, ...] = tuple(high),
            ) -> Tensor:
                below, above = (
                    probe.read(self.channel, node, corner, size, t, (s[0], s[1], s[2]))
                    for s in (low, high)
                )
                side = self.channel.bricks_bzyxc.shape[1] - 2 * self.channel.border
                return (above - below) * (divide(side, size, size) / self.cube[axis])

            columns.append(probe.blend(t, ask))
        return torch.stack(columns, 1)

    def normal_at(self, probe: Probe, t: Tensor) -> Tensor:
        """(r, 3) normals towards the eye, stored or the gradient's; 0 where there is none."""
        if self.normals:
            p, columns = self.parameters, [probe.number(c, t) for c in self.normals]
            normal = torch.stack(columns, 1) * p.normal_scale + p.normal_offset
        else:
            normal = self.gradient(probe, t)
        normal = unit(normal)
        return torch.where((dot(normal, self.along) > 0)[:, None], -normal, normal)

    def shade(self, base: Tensor, normal: Tensor, t: Tensor, seen: Tensor | None = None) -> Tensor:
        """(r, 3) colours in the light, by Blinn and Phong; shadows fall where `seen` is true."""
        p, back = self.parameters, -self.along
        kind, light = p.light_kind, torch.as_tensor(p.light)
        way = light - (self.eye + (t + self.moved)[:, None] * self.along)
        to_light, zero = back, torch.zeros_like(t)
        length, growth = zero + INF, zero + p.light_growth
        if kind == LightKind.DIRECTIONAL:
            to_light = unit(-light.expand_as(back))
        if kind == LightKind.POINT:
            to_light, length = unit(way), sqrt_exact(dot(way, way))
            growth = growth / length
        bare = ~(dot(normal, normal) > 0)
        facing = torch.where(bare, 1.0, larger(zero, dot(normal, to_light)))
        half = unit(to_light - self.along)
        highlight = power(larger(zero, dot(normal, half)), p.shininess)
        highlight = torch.where((facing > 0) & ~bare, highlight, zero)
        if self.shadows is not None and seen is not None and kind != LightKind.HEADLIGHT:
            dark = seen & (facing > 0)
            share = self.shadows.share(self, t, to_light, length, growth, dark)
            facing, highlight = facing * share, highlight * share
        diffuse = p.diffuse * facing
        specular = p.specular * highlight
        color = torch.as_tensor(p.light_color)
        return base * (p.ambient + diffuse[:, None] * color) + specular[:, None] * color


class Sided(Bricks):
    """The opacity in a channel that holds red, green, blue and opacity for each of six directions,
    or once.
    """

    def ends(self, node: Tensor, real: torch.dtype) -> tuple[Tensor, Tensor]:
        """Over all directions, see `reference.Bricks`."""
        low, high = self.range_n2c[node, :, 3::4].to(real).unbind(1)
        return low.amin(1), high.amax(1)


class StoredColor(Shade):
    """Colour and opacity of each voxel."""

    @property
    def own(self) -> StoredColorNumbers:
        """The shader's own numbers."""
        return self.parameters.own_as(StoredColorNumbers)

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """See `reference.Shader`."""
        return ~(_above(high) > 0)

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """See `reference.Shader`."""
        own = self.own
        opacity = self.opacity(piece, probe, self.along)
        seen = where & (opacity > 0)
        numbers = [self.seen(probe, i, piece.middle, self.along) for i in range(3)]
        color = torch.stack(numbers, 1) * own.scale
        divisor = torch.where((own.premultiplied > 0) & seen, opacity, 1.0)
        alpha = stretch(opacity, piece.length / own.reference)
        rgba = torch.cat((color / divisor[:, None], alpha[:, None]), 1)
        if own.lit > 0:
            self.lit(rgba, piece, probe, seen)
        else:
            self.composite(rgba, piece, seen)

    def alpha(self, piece: Piece, probe: Probe, along: Tensor) -> Tensor:
        """See `Shade`."""
        return stretch(self.opacity(piece, probe, along), piece.length / self.own.reference)

    def opacity(self, piece: Piece, probe: Probe, along: Tensor) -> Tensor:
        """(r,) per reference length."""
        return clamp(self.seen(probe, 3, piece.middle, along) * self.own.scale, 0, 1)

    def seen(self, probe: Probe, number: int, t: Tensor, along: Tensor) -> Tensor:
        """(r,) one of the four numbers, as it is seen along rays (r, 3): of three directions, where
        the channel holds six.
        """

        def read(component: int) -> Tensor:
            return probe.number(replace(self.channel, component=component), t)

        if self.channel.bricks_bzyxc.shape[4] == 4:
            return read(number)
        side = [
            torch.where(d < 0, read(8 * axis + 4 + number), read(8 * axis + number))
            for axis, d in enumerate(along.unbind(1))
        ]
        x, y, _ = (along * along).unbind(1)
        return side[2] + x * (side[0] - side[2]) + y * (side[1] - side[2])


class PreIntegrated(Shade):
    """A table over the values at both ends of an interval, (l, m, m, 4)."""

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """See `reference.Shader`."""
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
        alpha = rgba[:, 3]
        color = self.sum.color + self.sum.clear[:, None] * rgba[:, :3]
        color = torch.where(where[:, None], color, self.sum.color)
        self.composite(torch.cat((torch.zeros_like(color), alpha[:, None]), 1), piece, where)
        self.sum.color = color

    def _pair(self, front: Tensor, back: Tensor, level: Tensor) -> Tensor:
        """(r, 4) of an interval of a length of the table, from one value to another."""
        (row, row_weight), (column, column_weight) = self._cell(front), self._cell(back)
        table = self.transfer.table_lm4

        def mix(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
            return a + weight[:, None] * (b - a)

        near, far = (
            mix(table[level, r, column], table[level, r, column + 1], column_weight)
            for r in (row, row + 1)
        )
        return mix(near, far, row_weight)

    def _cell(self, value: Tensor) -> tuple[Tensor, Tensor]:
        place = self.transfer.place(value)
        row = torch.clamp(torch.floor(place), max=self.transfer.table_lm4.shape[1] - 2)
        return row.to(torch.int64), place - row


class Isosurface(Shade):
    """The first place where the value passes a level."""

    def begin(self) -> None:
        """No side is known, and nothing found."""
        self.level = torch.as_tensor(self.parameters.own_as(IsosurfaceNumbers).level)
        self.found = torch.zeros_like(self.moved, dtype=torch.bool)
        self.before, self.share = torch.zeros_like(self.moved), torch.zeros_like(self.moved)
        self.before_end = torch.full_like(self.moved, -INF)

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """See `reference.Shader`."""
        level = self.level
        return ((_above(high) < level) | (_below(low) >= level)) & ~self.found[which]

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """See `reference.Shader`."""
        level = self.level
        front, back = probe.value(piece.start), probe.value(piece.end)
        below = front < level
        early = where & (self.before_end == piece.start) & ((self.before < level) != below)
        crosses = where & ~early & (below != (back < level))
        self.before = torch.where(where, back, self.before)
        self.before_end = torch.where(where, piece.end, self.before_end)
        if not (early | crosses).any():
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
        hit = early | crosses
        self.share = torch.where(hit, self.sum.clear, self.share)
        self.sum.clear = torch.where(hit, 0.0, self.sum.clear)
        self.sum.depth = torch.where(hit, torch.where(early, piece.start, t), self.sum.depth)

    def surface(self, t: Tensor, probe: Probe) -> None:
        """Shades the places t (r,) that were found; `probe` stands in their nodes."""
        normal = self.normal_at(probe, t)
        value = self.level.expand_as(t)
        if self.others:
            value = probe.number(self.others[self.other_component], t)
        row = self.transfer.look_up(value, torch.zeros_like(t, dtype=torch.int64))
        color = self.share[:, None] * self.shade(row[:, :3], normal, t)
        self.sum.color = torch.where(self.found[:, None], color, 0.0)
        self.normal = torch.where(self.found[:, None], normal, 0.0)


class Projection(Shade):
    """Maximum, minimum or mean of the value."""

    def begin(self) -> None:
        """Nothing found."""
        self.sees_empty = True
        self.kind = self.parameters.own_as(ProjectionNumbers).kind
        self.found, self.length, self.at = (torch.zeros_like(self.moved) for _ in range(3))

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """See `reference.Shader`."""
        kind, found = self.kind, self.found[which]
        useless = ((kind == ProjectionKind.MAXIMUM) & (_above(high) <= found)) | (
            (kind == ProjectionKind.MINIMUM) & (_below(low) >= found)
        )
        return useless & (self.length[which] > 0)

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """See `reference.Shader`."""
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

    def done(self) -> None:
        """Colours what was found."""
        seen = self.length > 0
        mean = self.found / torch.where(seen, self.length, 1.0)
        value = mean if self.kind == ProjectionKind.MEAN else self.found
        row = self.transfer.look_up(value, torch.zeros_like(value, dtype=torch.int64))
        color = self.sum.clear[:, None] * row[:, :3]
        self.sum.color = torch.where(seen[:, None], color, 0.0)
        self.sum.clear = torch.where(seen, 0.0, self.sum.clear)
        self.sum.depth = torch.where(seen, self.at, INF)
        self.features = torch.where(seen, value, 0.0)[:, None]


class Features(Shade):
    """All numbers of a second channel, composited with the transfer function's alpha."""

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """See `reference.Shader`."""
        rgba = self.transfer.interval(probe.value(piece.middle), piece)
        share = torch.where(where, self.sum.clear * rgba[:, 3], 0.0)
        numbers = torch.stack([probe.number(channel, piece.middle) for channel in self.others], 1)
        self.features = self.features + share[:, None] * numbers
        self.composite(rgba, piece, where)


_KINDS: dict[int, type[Shade]] = {
    ShaderKind.LIT: Shade,
    ShaderKind.PRE_INTEGRATED: PreIntegrated,
    ShaderKind.STORED_COLOR: StoredColor,
    ShaderKind.ISOSURFACE: Isosurface,
    ShaderKind.PROJECTION: Projection,
    ShaderKind.FEATURES: Features,
    ShaderKind.SHADOWED_LIT: Shade,
    ShaderKind.SHADOWED_COLOR: StoredColor,
}


def shade_rays(
    rays: RayArguments, arguments: TraceArguments, shading: ShadeArguments, parameter_54: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.shade_rays`; see `gvtorch.ops.shade_rays`."""
    a, table, shader = arguments, arguments.table_lm4, shading.shader
    real = table.dtype
    beam = Beam.enter(*rays[:4], a.place_33, a.cone_scale, real)

    def number(value: float) -> Tensor:
        return torch.tensor(value, dtype=real).to(table)

    at = Intervals.begin(beam, a.step, table.shape[0])
    tree = Tree.of(a, number(a.root_voxel))
    channel = (Sided if ShaderKind(shader).stores_color else Bricks).of(a)

    def components(bricks: Tensor | None, constants: Tensor | None) -> tuple[Bricks, ...]:
        if bricks is None or constants is None:
            return ()
        own = replace(channel, bricks_bzyxc=bricks, constant_nc=constants.flatten(0, 1))
        return tuple(replace(own, component=c) for c in range(bricks.shape[4]))

    stop_clear = 1 - number(a.stop_alpha)
    none = torch.zeros_like(beam.first, dtype=torch.int32)
    shadows = Shadows(
        *(beam, tree, a.step, table.shape[0], stop_clear, number(a.cone_scale), none, none > 0)
    )
    shade = _KINDS[shader](
        transfer=Transfer(table, a.domain_2, a.opaque_m),
        parameters=ShadeParameters.read(parameter_54),
        normals=components(shading.normal_bzyxc, shading.normal_tnc),
        others=components(shading.other_bzyxc, shading.other_tnc),
        other_component=shading.other_component,
        channel=channel,
        eye=rays.origin_r3.to(real),
        along=rays.direction_r3.to(real),
        moved=beam.moved,
        cube=a.place_33[1].to(real),
        sum=Accumulator.begin(beam, rays.clear_r),
        normal=torch.zeros_like(beam.origin),
        features=beam.first.new_zeros((len(beam.first), shading.features)),
        hit_clear=1 - number(a.depth_alpha),
        shadows=shadows if ShaderKind(shader).shadowed else None,
    )
    if isinstance(shade, (Isosurface, Projection)):
        shade.begin()
    samples, visit = walk(beam, at, tree, channel, shade, number(a.step), stop_clear)
    if isinstance(shade, Isosurface):
        shade.found = shade.sum.depth < INF
        t = torch.where(shade.found, shade.sum.depth, 0.0)
        visit.look_up(shade.found, beam, at, tree, channel, shade, t)
        probe = Probe(visit, shade.found, beam, at.near, at.growth, tree, channel)
        shade.surface(t, probe)
    shade.done()
    depth, alpha = shade.sum.depth + beam.moved, 1 - shade.sum.clear
    return (
        *(shade.sum.color, alpha[:, None], depth[:, None]),
        *(samples + shadows.samples, visit.missed | shadows.missed),
        *(unit(shade.normal), shade.features),
    )


def _above(value: Tensor) -> Tensor:
    return value + larger(value, -value) * 2.0**-20


def _below(value: Tensor) -> Tensor:
    return value - larger(value, -value) * 2.0**-20


def _part(rows: Tensor, lengths: Tensor) -> Tensor:
    """(r, 4) premultiplied colour and alpha of the same values over another length."""
    whole = rows[:, 3]
    changed = (whole > 0) & (lengths != 1)
    alpha = torch.where(lengths > 0, stretch(whole, lengths), 0.0)
    scale = alpha / torch.where(changed, whole, 1.0)
    scaled = torch.cat((rows[:, :3] * scale[:, None], alpha[:, None]), 1)
    return torch.where(changed[:, None], scaled, rows)


def _over(a: Tensor, b: Tensor) -> Tensor:
    return a + (1 - a[:, 3:]) * b
