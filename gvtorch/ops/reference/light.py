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

from ..shading import FAINT, LightKind, ShadeParameters
from .exact import clamp, divide, dot, larger, power, smaller, sqrt_exact, unit
from .march import Interval, Plain, Probe, Visitor, Walk
from .rays import INF, Intervals, rounded
from .tree import ChannelBricks

#: Factors from one octave of scattering to the next, of its light and of its directedness; fitted
#: to path traced clouds (benchmarks/cloud_light.py).
OCTAVE_LIGHT, OCTAVE_DIRECTION = 0.55, 0.6
_MAX_OCTAVES = 16


@dataclass
class Light:
    """A light, the lit material and the eye. World units."""

    parameters: ShadeParameters
    normals: ChannelBricks | None  # stored ones
    eye: Tensor  # (r, 3) position
    direction: Tensor  # (r, 3) direction of the rays
    moved: Tensor  # (r,) distance from the eye to where distances t begin
    cube: Tensor  # (3,) size of the root cube

    @property
    def scatters(self) -> bool:
        """Whether matter is a scattering medium, which has no normals."""
        return bool(self.parameters.octaves > 0)

    @property
    def octaves(self) -> int:
        """How many octaves of scattering are summed."""
        return int(min(max(0.0, float(self.parameters.octaves)), _MAX_OCTAVES))

    def normal_at(self, probe: Probe, t: Tensor) -> Tensor:
        """Returns (r, 3) normals towards the eye, stored or the gradient's; 0 where none exists."""
        if self.scatters:
            return torch.zeros_like(self.direction)
        if self.normals is not None:
            p = self.parameters
            normal = probe.numbers(self.normals, t) * p.normal_scale + p.normal_offset
        else:
            normal = probe.gradient(t, self.cube)
        return self.to_eye(normal)

    def to_eye(self, vector: Tensor) -> Tensor:
        """Returns (r, 3) unit normals towards the eye, from vectors of any length."""
        normal = unit(vector)
        return torch.where((dot(normal, self.direction) > 0)[:, None], -normal, normal)

    def towards(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns (r, 3) directions and (r,) distances to the light, and (r,) growth of cones."""
        backward = -self.direction
        light_vector = torch.as_tensor(self.parameters.light, device=t.device)
        length = torch.full_like(t, INF)
        growth = torch.zeros_like(t) + self.parameters.light_growth
        if self.parameters.light_kind == LightKind.DIRECTIONAL:
            return unit(-light_vector.expand_as(backward)), length, growth
        if self.parameters.light_kind == LightKind.POINT:
            to_light = light_vector - (self.eye + (t + self.moved)[:, None] * self.direction)
            length = sqrt_exact(dot(to_light, to_light))
            return unit(to_light), length, growth / length
        return backward, length, growth

    def shade(
        self,
        base: Tensor,
        normal: Tensor,
        t: Tensor,
        shadow: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        """Returns (r, 3) lit colours of base colours (r, 3). `shadow` maps bools (r,), true for
        samples that face the light, to the share of light that reaches them; None: all of it.
        """
        zero = torch.zeros_like(t)
        to_light, _, _ = self.towards(t)
        no_normal = ~(dot(normal, normal) > 0)
        facing = torch.where(no_normal, 1.0, larger(zero, dot(normal, to_light)))
        half_vector = unit(to_light - self.direction)
        highlight = power(larger(zero, dot(normal, half_vector)), self.parameters.shininess)
        highlight = torch.where((facing > 0) & ~no_normal, highlight, zero)
        if shadow is not None:
            share = shadow(facing > 0)
            if self.scatters:
                return self.scattered(base, dot(self.direction, to_light), share)
            facing, highlight = facing * share, highlight * share
        return self.lit(base, facing, highlight)

    def lit(self, base: Tensor, facing: Tensor, highlight: Tensor) -> Tensor:
        """Returns (r, 3) lit base colours, given cosines to the light and highlights (r,)."""
        p = self.parameters
        diffuse = (p.diffuse * facing)[:, None]
        specular = (p.specular * highlight)[:, None]
        light = torch.as_tensor(p.light_color, device=base.device)
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
        zero, d, shininess = torch.zeros_like(t), self.direction, self.parameters.shininess
        total = moments[:, 0] + moments[:, 3] + moments[:, 5]
        share = clamp(FAINT * total, 0, 1)
        xx, xy, xz, yy, yz, zz = (moments / torch.where(total > 0, total, 1.0)[:, None]).unbind(1)

        def times(v: Tensor) -> Tensor:
            x, y, z = v.unbind(1)
            rows = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
            return torch.stack([a * x + b * y + c * z for a, b, c in rows], 1)

        square = xx * xx + yy * yy + zz * zz + 2 * (xy * xy + xz * xz + yz * yz)
        to_light, _, _ = self.towards(t)
        normal = -times(d)
        seen_rms = sqrt_exact(larger(zero, -dot(d, normal)))
        mean_per_rms = 0.8 + 0.2 * square  # ratio of mean magnitude to root mean square
        mean = mean_per_rms * dot(to_light, normal) / torch.where(seen_rms > 0, seen_rms, 1.0)
        if front is not None:
            front_mean = mean_per_rms * dot(to_light, front) / torch.where(total > 0, total, 1.0)
            mean = smaller(mean, front_mean)
        variance = larger(zero, dot(to_light, times(to_light)) - mean * mean)
        half_width = sqrt_exact(3 * variance)  # half the width of the uniform distribution
        upper_part = clamp(mean + half_width, 0, 2 * half_width)
        upper_term = upper_part * upper_part / torch.where(half_width > 0, 4 * half_width, 1.0)
        facing = upper_term + larger(zero, mean - half_width)

        half_vector = unit(to_light - d)
        # 0: a ball's normals, 1: one normal
        alignment = sqrt_exact(clamp(1.5 * square - 0.5, 0, 1))
        spread = divide(1 - alignment, 3.0, alignment)
        correction = 0.9 * (spread * spread)  # large where there is no main normal
        along = dot(half_vector, times(half_vector)) - spread + divide(correction, 3.0, correction)
        effective_shininess = divide(shininess, 1 + shininess * spread, spread)
        brightness = divide(1 + effective_shininess, 1 + shininess, effective_shininess)
        cosine_square = clamp(along / (alignment + correction), 0, 1)
        highlight = brightness * power(cosine_square, effective_shininess * 0.5)
        highlight = torch.where(facing > 0, highlight, zero)
        return self.lit(base, 1 - share + share * facing, share * highlight), normal

    def scattered(self, base: Tensor, cosine: Tensor, clear: Tensor) -> Tensor:
        """Returns (r, 3) colours of samples in a medium, given the transmittance (r,) to the light.
        The first octave is single scattering, further ones approximate multiple scattering: each
        has half the extinction of the one before, is weaker, more coloured and less directed.
        """
        p, weight, total = self.parameters, base, torch.zeros_like(base)
        g = torch.zeros_like(cosine) + p.anisotropy
        for _ in range(self.octaves):
            total = total + weight * (phase(g, cosine) * clear)[:, None]
            weight = weight * (base * base) * OCTAVE_LIGHT
            g = g * OCTAVE_DIRECTION
            clear = sqrt_exact(clear)
        light = torch.as_tensor(p.light_color, device=base.device)
        return base * p.ambient + p.diffuse * light * total

    def faintest(self, stop_clear: Tensor) -> Tensor:
        """Returns the transmittance at which shadow cones end: the last octave uses its root."""
        for _ in range(1, self.octaves):
            stop_clear = stop_clear * stop_clear
        return stop_clear


def phase(g: Tensor, cosine: Tensor) -> Tensor:
    """Returns (r,) Henyey and Greenstein's phase function, whose mean over all directions is 1."""
    square = g * g
    base = 1 + square - 2 * g * cosine
    return (1 - square) / (base * sqrt_exact(base))


class Shadows:
    """Traces cones from samples to the light, and counts their samples and misses."""

    def __init__(self, walk: Walk, cube: Tensor, cone_scale: float) -> None:
        # The walk of the eye's rays; world size of the root cube (3,); factor of all cones.
        self.walk, self.cube, self.cone_scale = walk, cube, cone_scale
        self.samples, self.missed = torch.zeros_like(walk.samples), torch.zeros_like(walk.missed)

    def light_share(
        self,
        shader: Plain,
        t: Tensor,
        direction: Tensor,
        length: Tensor,
        growth: Tensor,
        mask: Tensor,
        light: Light,
    ) -> Tensor:
        """Returns (r,) the share of a light, `length` (r,) away, that reaches the points at t (r,)
        where `mask` is true. A cone starts as wide as the eye's is there; its first interval is
        left out, so that a point does not shadow itself.
        """
        ray_index = mask.nonzero()[:, 0]
        t, direction = t[ray_index], direction[ray_index]
        eye_beam = self.walk.intervals.beam[ray_index]
        origin, exact_origin = rounded(eye_beam.along(t), eye_beam.scene.deep, t.dtype)
        beam = replace(
            eye_beam,
            origin=origin,
            exact_origin=exact_origin,
            direction=direction / self.cube,
            cone_near=eye_beam.cone(t),
            cone_growth=growth[ray_index] * self.cone_scale,
            first=torch.zeros_like(t),
            last=length[ray_index],
            moved=torch.zeros_like(t),
        ).clipped()
        length_l = self.walk.intervals.length_l
        intervals = Intervals(beam, length_l[0], len(length_l))
        intervals.next(torch.ones_like(mask[ray_index]))
        clear, limits = torch.ones_like(t), (light.faintest(shader.stop_clear), light.scatters)
        visitor = ShadowVisitor(shader.transfer, shader.channel, shader, direction, clear, *limits)
        walk = Walk(intervals, self.walk.tree, shader.channel)
        walk.follow(visitor)
        self.samples[ray_index] += walk.samples
        self.missed[ray_index] |= walk.missed
        return torch.ones_like(length).index_put((ray_index,), visitor.clear)


@dataclass
class ShadowVisitor(Visitor):
    """The visitor of shadow cones: the transmittance through matter."""

    shader: Plain
    direction: Tensor  # (r, 3) world direction
    clear: Tensor  # (r,) transmittance
    stop_clear: Tensor  # (): cones end at this transmittance
    each_interval: bool  # regions of one value are not taken in one step

    def hides(self, ray_index: Tensor, node: Tensor) -> Tensor:
        return self.shader.hides(ray_index, node)

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        if self.each_interval:  # 1 - alpha of a long interval would round to 0
            return torch.zeros_like(fine, dtype=torch.bool)
        return self.shader.same(fine, coarse)

    def goes_on(self, leaving: Tensor) -> Tensor:
        return self.clear > self.stop_clear

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        clear = self.clear * (1 - self.shader.alpha(interval, probe, self.direction))
        self.clear = torch.where(mask, clear, self.clear)
