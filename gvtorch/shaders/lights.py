"""Lights and how a surface takes them: what the lit shaders hand to the kernel.

Each number may be a float or a tensor, and may be edited between frames; tensors are read when a
frame is traced, so nothing is built again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..ops.shading import LightKind, Number, ShadeParameters, Triple

#: Width of a cone over that of the disc of light it stands for. What it meets reaches as far again
#: as its voxels are wide, and a cone that grazes takes more than its share: shadows agree best with
#: this.
CONE_OF_DISC = 0.35


@dataclass
class Headlight:
    """A light at the eye of each ray."""

    color: Triple = (1.0, 1.0, 1.0)  # linear RGB
    kind = LightKind.HEADLIGHT
    width = 0.0

    def __post_init__(self) -> None:
        """Checks the colour."""
        check_triple("Headlight", "color", self.color, low=0.0)

    @property
    def place(self) -> Triple:
        """Nowhere in the world."""
        return (0.0, 0.0, 0.0)


@dataclass
class DirectionalLight:
    """A light far away."""

    direction: Triple  # the way it shines, world; of any length but 0
    color: Triple = (1.0, 1.0, 1.0)  # linear RGB
    angle: Number = 0.0  # how wide it looks, degrees, for soft shadows; the sun: 0.53
    kind = LightKind.DIRECTIONAL

    def __post_init__(self) -> None:
        """Checks direction, colour and angle."""
        check_triple("DirectionalLight", "direction", self.direction, zero=False)
        check_triple("DirectionalLight", "color", self.color, low=0.0)
        check_number("DirectionalLight", "angle", self.angle, low=0, high=120.0)

    @property
    def place(self) -> Triple:
        """The way it shines."""
        return self.direction

    @property
    def width(self) -> Number:
        """How much a cone that goes to it grows per unit of length."""
        if isinstance(self.angle, Tensor):
            return 2 * CONE_OF_DISC * torch.tan(torch.deg2rad(self.angle) / 2)
        return 2 * CONE_OF_DISC * math.tan(math.radians(self.angle) / 2)


@dataclass
class PointLight:
    """A light at a place. Its strength does not fall with the distance."""

    position: Triple  # world
    color: Triple = (1.0, 1.0, 1.0)  # linear RGB
    radius: Number = 0.0  # of the ball that shines, world units, for soft shadows
    kind = LightKind.POINT

    def __post_init__(self) -> None:
        """Checks position, colour and radius."""
        check_triple("PointLight", "position", self.position)
        check_triple("PointLight", "color", self.color, low=0.0)
        check_number("PointLight", "radius", self.radius, low=0)

    @property
    def place(self) -> Triple:
        """Where it stands."""
        return self.position

    @property
    def width(self) -> Number:
        """Of a cone that goes to it, where it stands."""
        return 2 * CONE_OF_DISC * self.radius


Light = Headlight | DirectionalLight | PointLight


@dataclass(kw_only=True)
class Material:
    """How a place answers light (Blinn, 1977): base colour * (ambient + diffuse * cosine * light)
    + specular * cosine^shininess * light.
    """

    light: Light
    ambient: Number
    diffuse: Number
    specular: Number
    shininess: Number

    def __post_init__(self) -> None:
        """Checks every number that the host can see."""
        check_light("shader: light", self.light)
        for name in ("ambient", "diffuse", "specular", "shininess"):
            check_number("shader", name, getattr(self, name), low=0)

    def parameters(self) -> ShadeParameters:
        """What `shade_rays` is told of light and material."""
        return ShadeParameters(
            light=self.light.place,
            light_kind=self.light.kind,
            light_color=self.light.color,
            ambient=self.ambient,
            diffuse=self.diffuse,
            specular=self.specular,
            shininess=self.shininess,
            light_growth=self.light.width,
        )


def check_light(what: str, value: Any) -> None:
    """Raises ValueError unless it is a light."""
    if not isinstance(value, (Headlight, DirectionalLight, PointLight)):
        raise ValueError(
            f"{what} must be a Headlight, DirectionalLight or PointLight, "
            f"got {type(value).__name__}"
        )


def check_number(
    where: str, name: str, value: Any, *, low: float = -math.inf, high: float = math.inf
) -> None:
    """Raises ValueError unless it is a finite number in [low, high], or a tensor of one. A tensor
    on CUDA is not looked at, since that would block.
    """
    if isinstance(value, Tensor):
        if value.numel() != 1:
            got = check.describe(value)
            raise ValueError(f"{where}: {name} must be a number or a tensor of one, got {got}")
        if value.is_cuda:
            return
        value = value.item()
    check.number(where, name, value, low=low, high=high)


def check_triple(
    where: str,
    name: str,
    value: Any,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    zero: bool = True,
) -> None:
    """Raises ValueError unless these are three finite numbers in [low, high], or a tensor of them,
    as for `check_number`; `zero` tells whether all may be 0.
    """
    if isinstance(value, Tensor) and value.is_cuda:
        if value.shape != (3,):
            raise ValueError(f"{where}: {name} must be (3,), got {check.describe(value)}")
        return
    numbers = check.triple(where, name, value)
    for number in numbers:
        check.number(where, name, number, low=low, high=high)
    if not zero and not any(numbers):
        raise ValueError(f"{where}: {name} must not be zero")
