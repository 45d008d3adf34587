"""Lights, and `LitShader`, the base of the shaders that are lit.

Each number may be a float or a tensor, and may be set between frames, which checks it; tensors
are read when a frame is traced, so nothing is rebuilt.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypedDict

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.checked import Check, Checked, class_name, instance_of, whole_between
from ..ops import ShadeArguments
from ..ops.shading import LightKind, Number, ShadeParameters, Triple
from ..pool import N3Tree
from .shader import Shader

#: Width of a shadow cone relative to the light's disc; fitted, and below 1 because prefiltering
#: widens occluders.
CONE_OF_DISC = 0.35


def a_number(low: float = -math.inf, high: float = math.inf) -> Check:
    """A check for a finite number in [low, high], or a tensor of one. The value of a CUDA tensor is
    not checked, since reading it would block.
    """

    def checked(owner: Any, name: str, value: Any) -> Any:
        context, number = class_name(owner), value
        check.no_gradient(context, name, value)
        if isinstance(value, Tensor):
            if value.numel() != 1:
                got = f"got {check.describe(value)}"
                raise ValueError(f"{context}: {name} must be a number or a tensor of one, {got}")
            if value.is_cuda:
                return value
            number = value.item()
        number = check.number(context, name, number, low=low, high=high)
        return number if isinstance(value, np.ndarray) else value

    return checked


def a_triple(low: float = -math.inf, high: float = math.inf, zero: bool = True) -> Check:
    """A check for three finite numbers in [low, high], as `a_number`; `zero`: they may all be 0."""

    def checked(owner: Any, name: str, value: Any) -> Any:
        context = class_name(owner)
        check.no_gradient(context, name, value)
        if isinstance(value, Tensor) and value.is_cuda:
            if value.shape != (3,):
                raise ValueError(f"{context}: {name} must be (3,), got {check.describe(value)}")
            return value
        numbers = check.triple(context, name, value, low=low, high=high)
        if not zero and not any(numbers):
            raise ValueError(f"{context}: {name} must not be zero")
        return numbers if isinstance(value, np.ndarray) else value

    return checked


@dataclass
class Headlight(Checked):
    """A light at the eye of each ray."""

    color: Triple = (1.0, 1.0, 1.0)  # linear RGB

    checks: ClassVar[Mapping[str, Check]] = {"color": a_triple(low=0)}

    def parameters(self) -> ShadeParameters:
        """Returns the kernel's parameters of the light, without those of a material."""
        self.check_again()
        return ShadeParameters(light_color=self.color)


@dataclass
class DirectionalLight(Checked):
    """A light at infinity."""

    direction: Triple  # in which it shines, world axes; any length but 0
    color: Triple = (1.0, 1.0, 1.0)  # linear RGB
    angle: Number = 0.0  # angular diameter in degrees, for soft shadows; the sun: 0.53

    checks: ClassVar[Mapping[str, Check]] = {
        "direction": a_triple(zero=False),
        "color": a_triple(low=0),
        "angle": a_number(low=0, high=120),
    }

    @property
    def size(self) -> Number:
        """Radius at distance 1: tan(angle / 2)."""
        if isinstance(self.angle, Tensor):
            return torch.tan(torch.deg2rad(self.angle) / 2)
        return math.tan(math.radians(self.angle) / 2)

    def parameters(self) -> ShadeParameters:
        """See `Headlight`."""
        self.check_again()
        kind, growth = LightKind.DIRECTIONAL, 2 * CONE_OF_DISC * self.size
        return ShadeParameters(self.direction, kind, self.color, light_growth=growth)


@dataclass
class PointLight(Checked):
    """A light at a point. Its strength does not fall off with distance."""

    position: Triple  # world
    color: Triple = (1.0, 1.0, 1.0)  # linear RGB
    radius: Number = 0.0  # of the luminous sphere, world units, for soft shadows

    checks: ClassVar[Mapping[str, Check]] = {
        "position": a_triple(),
        "color": a_triple(low=0),
        "radius": a_number(low=0),
    }

    def parameters(self) -> ShadeParameters:
        """See `Headlight`."""
        self.check_again()
        width = 2 * CONE_OF_DISC * self.radius
        return ShadeParameters(self.position, LightKind.POINT, self.color, light_growth=width)


Light = Headlight | DirectionalLight | PointLight


_MATERIAL = ("ambient", "diffuse", "specular", "shininess", "octaves", "anisotropy")
#: With more, the transmittances of thick clouds become 0 in float32 (see `Light.faintest`).
MOST_OCTAVES = 5


class LightSettings(TypedDict, total=False):
    """The keyword arguments of `LitShader`, for constructors that pass them on."""

    normals: str | None
    light: Light | None
    ambient: Number
    diffuse: Number
    specular: Number
    shininess: Number
    octaves: int
    anisotropy: Number


class LitShader(Shader):
    """A shader with a light and a material (Blinn, 1977): base colour * (ambient + diffuse * cosine
    * light) + specular * cosine^shininess * light.

    Attributes:
        shadows: Whether a cone is traced from each sample to the light: matter along it dims
            diffuse light and highlight. A `Headlight` casts no shadows.
        takes_shadows: Whether its kernel supports shadows, and octaves of scattering.
    """

    shadows = False
    takes_shadows = False
    checks: ClassVar[Mapping[str, Check]] = {
        "light": instance_of(Headlight, DirectionalLight, PointLight),
        **dict.fromkeys(_MATERIAL[:4], a_number(low=0)),
        "octaves": whole_between(0, MOST_OCTAVES),
        "anisotropy": a_number(low=-0.95, high=0.95),
    }

    def __init__(
        self,
        *,
        normals: str | None = None,
        light: Light | None = None,
        ambient: Number = 0.2,
        diffuse: Number = 0.8,
        specular: Number = 0.3,
        shininess: Number = 40.0,
        octaves: int = 0,
        anisotropy: Number = 0.0,
    ) -> None:
        """Sets light and material.

        Args:
            normals: Name of a channel of 3 numbers that holds normals (unsigned integers are scaled
                to -1 to 1); if left out, normals are gradients.
            light: A `Headlight` if left out.
            ambient: Factor of the base colour.
            diffuse: Factor of base colour, light and cosine.
            specular: Factor of the highlight.
            shininess: Exponent of the highlight.
            octaves: For `Lit` and `StoredColor`. Above 0: a medium that scatters light, with its
                own shadows, without normals and highlight. 1 counts light scattered once; each
                further octave, up to 5, models about twice as many scatterings. The base colour is
                the albedo, and the light's colour times `diffuse` its irradiance / 4 pi.
            anisotropy: Mean cosine of scattering: 0 is isotropic; near 1 is forward, as in clouds.

        Raises:
            ValueError: A number is not in its range.
        """
        self.normals, self.light = normals, Headlight() if light is None else light
        self.ambient, self.diffuse = ambient, diffuse
        self.specular, self.shininess = specular, shininess
        self.octaves, self.anisotropy = octaves, anisotropy

    def material(self) -> ShadeParameters:
        return self.light.parameters()._replace(**{name: getattr(self, name) for name in _MATERIAL})

    def shading(self, context: str, tree: N3Tree) -> ShadeArguments | None:
        if self.octaves or (self.shadows and not self.takes_shadows):
            self.check_scattering(context)
        return super().shading(context, tree)

    def check_scattering(self, context: str) -> None:
        """Raises ValueError if the shader or its light does not support `octaves`."""
        if not self.takes_shadows:
            raise ValueError(f"{context}: shadows per sample are for Lit and StoredColor")
        if isinstance(self.light, Headlight):
            raise ValueError(f"{context}: octaves of scattering need a sun or lamp, no Headlight")

    def own_light(self) -> Light:
        return self.light

    def unlit(self) -> Self:
        return self.changed(ambient=1.0, diffuse=0.0, specular=0.0, shadows=False, octaves=0)
