"""Light of the fused shaders, and shadows, which are cones from samples to the light: the twin of
csrc/shaders/light.h.

Sources: Blinn, "Models of light reflection for computer synthesized pictures", SIGGRAPH 1977;
Wrenninge, Kulla, Lundqvist, "Oz: the great and volumetric", SIGGRAPH 2013 talks; Henyey,
Greenstein, "Diffuse radiation in the galaxy", ApJ 93, 1941.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..shading import LightKind, ShadeParameters
from .exact import clamp, divide, dot, larger, power, smaller, sqrt_exact, unit
from .march import Piece, Plain, Probe, Visitor, Walk
from .rays import INF, Intervals, split
from .tree import ChannelBricks

#: Each octave of scattering gives so much of the light of the one before it, and keeps so much of
#: its direction: fitted to path traced clouds (benchmarks/cloud_light.py).
OCTAVE_LIGHT, OCTAVE_DIRECTION = 0.55, 0.6
#: By how much the moments of normals may be lessened where no light comes: see `coarse_colors`.
FAINT = 32


@dataclass
class Light:
    """A light, the material it falls on, and the eye that sees it. World units."""

    parameters: ShadeParameters
    normals: tuple[ChannelBricks, ...]  # three components, or none
    eye: Tensor  # (r, 3)
    along: Tensor  # (r, 3)
    moved: Tensor  # (r,) distance from the eye to where distances begin
    cube: Tensor  # (3,) size of the root cube

    @property
    def scatters(self) -> bool:
        """Whether this is a medium, whose places have no normal."""
        return bool(self.parameters.octaves > 0)

    def normal_at(self, probe: Probe, t: Tensor) -> Tensor:
        """(r, 3) normals towards the eye, stored or the gradient's; 0 where there is none."""
        if self.scatters:
            return torch.zeros_like(self.along)
        if self.normals:
            p, columns = self.parameters, [probe.number(c, t) for c in self.normals]
            normal = torch.stack(columns, 1) * p.normal_scale + p.normal_offset
        else:
            normal = probe.gradient(t, self.cube)
        return self.to_eye(normal)

    def to_eye(self, way: Tensor) -> Tensor:
        """(r, 3) normals towards the eye, of vectors of any length."""
        normal = unit(way)
        return torch.where((dot(normal, self.along) > 0)[:, None], -normal, normal)

    def towards(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(r, 3) ways to the light, (r,) their lengths, (r,) growth of cones there per length."""
        back, place = -self.along, torch.as_tensor(self.parameters.light)
        length = torch.full_like(t, INF)
        growth = torch.zeros_like(t) + self.parameters.light_growth
        if self.parameters.light_kind == LightKind.DIRECTIONAL:
            return unit(-place.expand_as(back)), length, growth
        if self.parameters.light_kind == LightKind.POINT:
            way = place - (self.eye + (t + self.moved)[:, None] * self.along)
            length = sqrt_exact(dot(way, way))
            return unit(way), length, growth / length
        return back, length, growth

    def shade(
        self,
        base: Tensor,
        normal: Tensor,
        t: Tensor,
        share: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        """(r, 3) colours in the light of base colours (r, 3). `share` gives the share of light that
        comes to those places that face the light, (r,) bool; None: all comes to all.
        """
        zero = torch.zeros_like(t)
        to_light, _, _ = self.towards(t)
        bare = ~(dot(normal, normal) > 0)
        facing = torch.where(bare, 1.0, larger(zero, dot(normal, to_light)))
        half = unit(to_light - self.along)
        highlight = power(larger(zero, dot(normal, half)), self.parameters.shininess)
        highlight = torch.where((facing > 0) & ~bare, highlight, zero)
        if share is not None:
            comes = share(facing > 0)
            if self.scatters:
                return self.scattered(base, dot(self.along, to_light), comes)
            facing, highlight = facing * comes, highlight * comes
        return self.lit(base, facing, highlight)

    def lit(self, base: Tensor, facing: Tensor, highlight: Tensor) -> Tensor:
        """(r, 3) colours of base colours (r, 3), by how much they face the light and shine (r,)."""
        p = self.parameters
        diffuse = (p.diffuse * facing)[:, None]
        specular = (p.specular * highlight)[:, None]
        light = torch.as_tensor(p.light_color)
        return base * (p.ambient + diffuse * light) + specular * light

    def shade_rough(
        self,
        base: Tensor,  # (r, 3) base colours
        moments: Tensor,  # (r, 6) mean products xx xy xz yy yz zz of the components of the normals;
        # where their trace is 0, places are lit as if they faced the light
        front: Tensor | None,  # (r, 3) mean normals of what is seen from one side alone, in the
        # same measure: what light comes from behind does not show. None: both sides are seen
        t: Tensor,  # (r,) distances
    ) -> tuple[Tensor, Tensor]:
        """Lights rough surfaces, of which only the moments of their normals are known.

        Of a cosine with the light, as it is on the side that the eye sees, they tell mean and
        deviation; it is taken to be evenly spread, as it is for the normals of a ball. Highlights:
        Toksvig, "Mipmapping normal maps", 2005, for a spread that is the same to all sides of a
        main normal.

        Returns:
            (r, 3) colours in the light, and (r, 3) vectors along the normals, towards the eye.
        """
        zero, d, shininess = torch.zeros_like(t), self.along, self.parameters.shininess
        total = moments[:, 0] + moments[:, 3] + moments[:, 5]
        share = clamp(FAINT * total, 0, 1)
        xx, xy, xz, yy, yz, zz = (moments / torch.where(total > 0, total, 1.0)[:, None]).unbind(1)

        def times(v: Tensor) -> Tensor:
            x, y, z = v.unbind(1)
            rows = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
            return torch.stack([a * x + b * y + c * z for a, b, c in rows], 1)

        square = xx * xx + yy * yy + zz * zz + 2 * (xy * xy + xz * xz + yz * yz)
        to_light, _, _ = self.towards(t)
        back = -times(d)
        seen = sqrt_exact(larger(zero, -dot(d, back)))
        known = 0.8 + 0.2 * square  # the mean of a size over its root mean square
        mean = known * dot(to_light, back) / torch.where(seen > 0, seen, 1.0)
        if front is not None:
            outside = known * dot(to_light, front) / torch.where(total > 0, total, 1.0)
            mean = smaller(mean, outside)
        variance = larger(zero, dot(to_light, times(to_light)) - mean * mean)
        wide = sqrt_exact(3 * variance)  # half of what it is spread over
        above = clamp(mean + wide, 0, 2 * wide)
        part = above * above / torch.where(wide > 0, 4 * wide, 1.0)
        facing = part + larger(zero, mean - wide)

        half = unit(to_light - d)
        even = sqrt_exact(clamp(1.5 * square - 0.5, 0, 1))  # 0: a ball's normals, 1: one normal
        spread = divide(1 - even, 3.0, even)
        little = 0.9 * (spread * spread)  # where no normal is the main one
        along = dot(half, times(half)) - spread + divide(little, 3.0, little)
        dull = divide(shininess, 1 + shininess * spread, spread)
        bright = divide(1 + dull, 1 + shininess, dull)
        highlight = bright * power(clamp(along / (even + little), 0, 1), dull * 0.5)
        highlight = torch.where(facing > 0, highlight, zero)
        return self.lit(base, 1 - share + share * facing, share * highlight), back

    def scattered(self, base: Tensor, cosine: Tensor, clear: Tensor) -> Tensor:
        """(r, 3) colours of places in a medium, from the share of light that comes there straight:
        by one scattering, and by octaves that stand for more and more of them. Each takes half as
        much from light on its way as the one before, is weaker, more coloured and less directed.
        """
        p, weight, total = self.parameters, base, torch.zeros_like(base)
        g = torch.zeros_like(cosine) + p.anisotropy
        for _ in range(int(p.octaves)):
            total = total + weight * (phase(g, cosine) * clear)[:, None]
            weight = weight * (base * base) * OCTAVE_LIGHT
            g = g * OCTAVE_DIRECTION
            clear = sqrt_exact(clear)
        light = torch.as_tensor(p.light_color)
        return base * p.ambient + p.diffuse * light * total

    def faintest(self, stop_clear: Tensor) -> Tensor:
        """Transmittance below which light is not followed: the last octave sees its root."""
        for _ in range(1, int(self.parameters.octaves)):
            stop_clear = stop_clear * stop_clear
        return stop_clear


def phase(g: Tensor, cosine: Tensor) -> Tensor:
    """(r,) Henyey's and Greenstein's phase function, its mean over all directions 1."""
    square = g * g
    away = 1 + square - 2 * g * cosine
    return (1 - square) / (away * sqrt_exact(away))


class Shadows:
    """What cones from samples to the light go through, and what they cost."""

    def __init__(self, walk: Walk, cube: Tensor, cone_scale: float) -> None:
        self.walk, self.cube, self.cone_scale = walk, cube, cone_scale  # the eye's; see `Light`
        self.samples, self.missed = torch.zeros_like(walk.samples), torch.zeros_like(walk.missed)

    def share(
        self,
        matter: Plain,
        t: Tensor,
        way: Tensor,
        length: Tensor,
        growth: Tensor,
        where: Tensor,
        light: Light,
    ) -> Tensor:
        """(r,) share of a light, `length` (r,) away, that comes to places t (r,), where `where` is
        true. A cone is as wide there as the eye's; its first interval is left out, so that a place
        does not stand in its own shadow.
        """
        which = where.nonzero()[:, 0]
        t, way, eye = t[which], way[which], self.walk.at.beam[which]
        origin, rest = split(eye.along(t), eye.deep, t.dtype)
        beam = replace(
            eye,
            origin=origin,
            rest=rest,
            direction=way / self.cube,
            cone_near=eye.cone(t),
            cone_growth=growth[which] * self.cone_scale,
            first=torch.zeros_like(t),
            last=length[which],
            moved=torch.zeros_like(t),
        ).clipped()
        length_l = self.walk.at.length_l
        at = Intervals(beam, length_l[0], len(length_l))
        at.next(torch.ones_like(where[which]))
        ends = light.faintest(matter.stop_clear), light.scatters
        veil = Veil(matter.transfer, matter.channel, matter, way, torch.ones_like(t), *ends)
        walk = Walk(at, self.walk.tree, matter.channel)
        walk.go(veil)
        self.samples[which] += walk.samples
        self.missed[which] |= walk.missed
        return torch.ones_like(length).index_put((which,), veil.clear)


@dataclass
class Veil(Visitor):
    """What matter takes from the light that goes through."""

    matter: Plain
    along: Tensor  # (r, 3) world
    clear: Tensor  # (r,) transmittance
    stop_clear: Tensor  # (): at which the way ends
    each_interval: bool  # regions of one value are not taken as one

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        return self.matter.hides(which, low, high)

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        if self.each_interval:  # 1 - alpha of a long one would round to 0
            return torch.zeros_like(fine, dtype=torch.bool)
        return self.matter.same(fine, coarse)

    def goes_on(self, leaves: Tensor) -> Tensor:
        return self.clear > self.stop_clear

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        clear = self.clear * (1 - self.matter.alpha(piece, probe, self.along))
        self.clear = torch.where(where, clear, self.clear)
