"""Lighting of the fused shaders, and shadows, by cones traced from samples to the light: the twin
of csrc/shaders/light.h.

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

#: Factors from one octave of scattering to the next, of its light and of its directedness; fitted
#: to path traced clouds (benchmarks/cloud_light.py).
OCTAVE_LIGHT, OCTAVE_DIRECTION = 0.55, 0.6
#: Largest factor by which moments of normals are reduced where no light comes: see `coarse_colors`.
FAINT = 32


@dataclass
class Light:
    """A light, the lit material and the eye. World units."""

    parameters: ShadeParameters
    normals: tuple[ChannelBricks, ...]  # three components, or none
    eye: Tensor  # (r, 3) position
    along: Tensor  # (r, 3) direction of the rays
    moved: Tensor  # (r,) distance from the eye to where distances t begin
    cube: Tensor  # (3,) size of the root cube

    @property
    def scatters(self) -> bool:
        """Whether matter is a scattering medium, which has no normals."""
        return bool(self.parameters.octaves > 0)

    def normal_at(self, probe: Probe, t: Tensor) -> Tensor:
        """Returns (r, 3) normals towards the eye, stored or the gradient's; 0 where none exists."""
        if self.scatters:
            return torch.zeros_like(self.along)
        if self.normals:
            p, columns = self.parameters, [probe.number(c, t) for c in self.normals]
            normal = torch.stack(columns, 1) * p.normal_scale + p.normal_offset
        else:
            normal = probe.gradient(t, self.cube)
        return self.to_eye(normal)

    def to_eye(self, way: Tensor) -> Tensor:
        """Returns (r, 3) unit normals towards the eye, from vectors of any length."""
        normal = unit(way)
        return torch.where((dot(normal, self.along) > 0)[:, None], -normal, normal)

    def towards(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns (r, 3) directions and (r,) distances to the light, and (r,) growth of cones."""
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
        """Returns (r, 3) lit colours of base colours (r, 3). `share` maps bools (r,), which samples
        face the light, to the share of light that reaches them; None: all light reaches all.
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
        """Returns (r, 3) lit base colours, given cosines to the light and highlights (r,)."""
        p = self.parameters
        diffuse = (p.diffuse * facing)[:, None]
        specular = (p.specular * highlight)[:, None]
        light = torch.as_tensor(p.light_color)
        return base * (p.ambient + diffuse * light) + specular * light

    def shade_rough(
        self,
        base: Tensor,  # (r, 3) base colours
        moments: Tensor,  # (r, 6) mean products xx xy xz yy yz zz of the components of the normals;
        # where their trace is 0, the matter is lit as if it faced the light
        front: Tensor | None,  # (r, 3) mean normals of matter that is seen from one side only, on
        # the same scale: light from behind does not show. None: both sides are seen
        t: Tensor,  # (r,) distances
    ) -> tuple[Tensor, Tensor]:
        """Lights rough surfaces of which only the moments of the normals are known.

        The moments give mean and deviation of the cosine with the light on the side that the eye
        sees. The cosine is assumed to be uniformly distributed, as it is for the normals of a ball.
        Highlights: Toksvig, "Mipmapping normal maps", 2005, for a spread that is the same to all
        sides of a main normal.

        Returns:
            (r, 3) lit colours, and (r, 3) vectors along the normals, towards the eye.
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
        known = 0.8 + 0.2 * square  # ratio of mean magnitude to root mean square
        mean = known * dot(to_light, back) / torch.where(seen > 0, seen, 1.0)
        if front is not None:
            outside = known * dot(to_light, front) / torch.where(total > 0, total, 1.0)
            mean = smaller(mean, outside)
        variance = larger(zero, dot(to_light, times(to_light)) - mean * mean)
        wide = sqrt_exact(3 * variance)  # half the width of the uniform distribution
        above = clamp(mean + wide, 0, 2 * wide)
        part = above * above / torch.where(wide > 0, 4 * wide, 1.0)
        facing = part + larger(zero, mean - wide)

        half = unit(to_light - d)
        even = sqrt_exact(clamp(1.5 * square - 0.5, 0, 1))  # 0: a ball's normals, 1: one normal
        spread = divide(1 - even, 3.0, even)
        little = 0.9 * (spread * spread)  # large where there is no main normal
        along = dot(half, times(half)) - spread + divide(little, 3.0, little)
        dull = divide(shininess, 1 + shininess * spread, spread)
        bright = divide(1 + dull, 1 + shininess, dull)
        highlight = bright * power(clamp(along / (even + little), 0, 1), dull * 0.5)
        highlight = torch.where(facing > 0, highlight, zero)
        return self.lit(base, 1 - share + share * facing, share * highlight), back

    def scattered(self, base: Tensor, cosine: Tensor, clear: Tensor) -> Tensor:
        """Returns (r, 3) colours of samples in a medium, given the transmittance (r,) to the light.
        The first octave is single scattering, further ones approximate multiple scattering: each
        has half the extinction of the one before, is weaker, more coloured and less directed.
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
        """Returns the transmittance at which shadow cones end: the last octave uses its root."""
        for _ in range(1, int(self.parameters.octaves)):
            stop_clear = stop_clear * stop_clear
        return stop_clear


def phase(g: Tensor, cosine: Tensor) -> Tensor:
    """Returns (r,) Henyey and Greenstein's phase function, whose mean over all directions is 1."""
    square = g * g
    away = 1 + square - 2 * g * cosine
    return (1 - square) / (away * sqrt_exact(away))


class Shadows:
    """Traces cones from samples to the light, and counts their samples and misses."""

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
        """Returns (r,) the share of a light, `length` (r,) away, that reaches the points at t (r,)
        where `where` is true. A cone starts as wide as the eye's is there; its first interval is
        left out, so that a point does not shadow itself.
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
    """The visitor of shadow cones: the transmittance through matter."""

    matter: Plain
    along: Tensor  # (r, 3) world direction
    clear: Tensor  # (r,) transmittance
    stop_clear: Tensor  # (): cones end at this transmittance
    each_interval: bool  # regions of one value are not taken in one step

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        return self.matter.hides(which, low, high)

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        if self.each_interval:  # 1 - alpha of a long interval would round to 0
            return torch.zeros_like(fine, dtype=torch.bool)
        return self.matter.same(fine, coarse)

    def goes_on(self, leaves: Tensor) -> Tensor:
        return self.clear > self.stop_clear

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        clear = self.clear * (1 - self.matter.alpha(piece, probe, self.along))
        self.clear = torch.where(where, clear, self.clear)
