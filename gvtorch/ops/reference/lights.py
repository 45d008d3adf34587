"""Part of the torch twin: normals, and how a place answers light; see csrc/shaders/light.h.

Source: Blinn, "Models of light reflection for computer synthesized pictures", SIGGRAPH 1977.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..shading import LightKind, Number, ShadeParameters
from .exact import dot, larger, power, sqrt_exact, unit
from .march import Probe
from .rays import INF
from .tree import Bricks


@dataclass
class Light:
    """A light, the material it falls on, and the eye that sees it. World units."""

    parameters: ShadeParameters
    normals: tuple[Bricks, ...]  # three components, or none
    eye: Tensor  # (r, 3)
    along: Tensor  # (r, 3)
    moved: Tensor  # (r,) distance from the eye to where distances begin
    cube: Tensor  # (3,) size of the root cube

    @property
    def kind(self) -> Number:
        """A LightKind."""
        return self.parameters.light_kind

    def normal_at(self, probe: Probe, t: Tensor) -> Tensor:
        """(r, 3) normals towards the eye, stored or the gradient's; 0 where there is none."""
        if self.normals:
            p, columns = self.parameters, [probe.number(c, t) for c in self.normals]
            normal = torch.stack(columns, 1) * p.normal_scale + p.normal_offset
        else:
            normal = probe.gradient(t, self.cube)
        normal = unit(normal)
        return torch.where((dot(normal, self.along) > 0)[:, None], -normal, normal)

    def towards(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(r, 3) ways from places to the light, (r,) lengths of these ways, and (r,) how much cones
        to the light grow per unit of length.
        """
        back, place = -self.along, torch.as_tensor(self.parameters.light)
        length = torch.full_like(t, INF)
        growth = torch.zeros_like(t) + self.parameters.light_growth
        if self.kind == LightKind.DIRECTIONAL:
            return unit(-place.expand_as(back)), length, growth
        if self.kind == LightKind.POINT:
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
        comes to those places that face the light, (r,) bool.
        """
        p, zero = self.parameters, torch.zeros_like(t)
        to_light, _, _ = self.towards(t)
        bare = ~(dot(normal, normal) > 0)
        facing = torch.where(bare, 1.0, larger(zero, dot(normal, to_light)))
        half = unit(to_light - self.along)
        highlight = power(larger(zero, dot(normal, half)), p.shininess)
        highlight = torch.where((facing > 0) & ~bare, highlight, zero)
        if share is not None:
            comes = share(facing > 0)
            facing, highlight = facing * comes, highlight * comes
        diffuse = (p.diffuse * facing)[:, None]
        specular = (p.specular * highlight)[:, None]
        light = torch.as_tensor(p.light_color)
        return base * (p.ambient + diffuse * light) + specular * light
