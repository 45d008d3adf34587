"""The shader arguments of `shade_rays`: the shader's number, and 20 numbers for light, material and
the shader itself. Shaders write them; the torch twin and csrc/shaders/shaders.h read them.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from ..base import check
from ..base.volume import DIRECTIONS

Number = float | Tensor
Triple = Sequence[float] | Tensor

#: Numbers of a colour in a voxel: red, green, blue, opacity.
COLOR_WIDTH = 4
#: Numbers of a filtered colour of lit matter: red, green, blue, alpha, then the mean products
#: xx xy xz yy yz zz of the components of its normals. All but alpha are premultiplied.
LIT_COLOR_WIDTH = 10


def channel_widths(color_width: int) -> tuple[int, int]:
    """Returns how many numbers a voxel has that holds one colour, or one for each direction."""
    return color_width, len(DIRECTIONS) * color_width


@dataclass(frozen=True)
class ShaderFacts:
    """What a fused shader requires of the arguments of `shade_rays`."""

    integrates: bool = False  # its table is (l, m, m, 4)
    colored: bool = False  # its channel holds colours: see `channel_widths`
    filtered: int = 0  # above 0: width of the colours in its second channel, of which only the
    # pool's first bricks have them
    features: int | None = 0  # how many it returns; None: as many as its second channel is wide
    shadows: bool = False  # each sample sends a ray to the light


#: The fused shaders, in the order of `GV_SHADERS` in csrc/shaders/shaders.h.
SHADER_KINDS: Mapping[str, ShaderFacts] = {
    "Lit": ShaderFacts(),
    "PreIntegrated": ShaderFacts(integrates=True),
    "StoredColor": ShaderFacts(colored=True),
    "Isosurface": ShaderFacts(),
    "Projection": ShaderFacts(features=1),
    "Features": ShaderFacts(features=None),
    "ShadowedLit": ShaderFacts(shadows=True),
    "ShadowedColor": ShaderFacts(colored=True, shadows=True),
    "GradientMagnitude": ShaderFacts(),
    "Filtered": ShaderFacts(filtered=COLOR_WIDTH),
    "ChannelMix": ShaderFacts(),
    "Labels": ShaderFacts(features=1),
    "FilteredLit": ShaderFacts(filtered=LIT_COLOR_WIDTH),
}


#: Filtered colours hold the moments of normals that no light reaches divided by this, and shaders
#: multiply the moments' trace by it; as `kFaint` in csrc/shaders/light.h.
FAINT = 32


def shader_number(kind: str) -> int:
    """Returns the number of a fused shader; raises ValueError if there is none of this name."""
    check.one_of("shader", "kind", kind, SHADER_KINDS)
    return [*SHADER_KINDS].index(kind)


class LightKind(IntEnum):
    """Where light comes from."""

    HEADLIGHT = 0  # the eye of each ray
    DIRECTIONAL = 1  # infinitely far away
    POINT = 2  # a position


class ProjectionKind(IntEnum):
    """How a projection reduces the values along a ray."""

    MAXIMUM = 0
    MINIMUM = 1
    MEAN = 2


class StoredColorNumbers(NamedTuple):
    """The numbers specific to stored colours."""

    scale: Number  # factor that brings stored numbers to 0 to 1
    reference: Number  # world length for which opacity is given
    premultiplied: Number  # above 0: colours are stored times opacity
    lit: Number  # above 0: colours are lit


class IsosurfaceNumbers(NamedTuple):
    """The numbers specific to isosurfaces."""

    level: Number  # the value at the surface
    filled: float = 1.0  # the solid side. 1: values >= level; -1: values < level; 0: neither
    scale: float = 0.0  # factor of the second channel's four numbers, a colour; 0: use the table
    premultiplied: float = 0.0  # above 0: its colours are stored times the fourth number


class ProjectionNumbers(NamedTuple):
    """The number specific to projections."""

    kind: Number  # a ProjectionKind


class GradientMagnitudeNumbers(NamedTuple):
    """The number specific to shading by gradient magnitude."""

    full: Number  # the gradient's length from which opacity is unreduced, value per world unit


class FilteredNumbers(NamedTuple):
    """The number specific to filtered colours."""

    side: Number  # smallest side of the root cube, world units


class LabelNumbers(NamedTuple):
    """The number specific to labels."""

    lit: Number  # above 0: labels are lit


_Record = TypeVar("_Record")


@cache
def _parameter_count(record: Callable[..., Any]) -> int:
    return len(inspect.signature(record).parameters)


#: How many numbers each field of `ShadeParameters` takes, in order.
_WIDTHS = (3, 1, 3, 1, 1, 1, 1, 1, 4, 1, 1, 1, 1)


class ShadeParameters(NamedTuple):
    """The 20 numbers of `parameter_54`, in its order; the defaults show colours unlit."""

    light: Triple = (0.0, 0.0, 0.0)  # world position of a point light, or direction a sun shines in
    light_kind: Number = LightKind.HEADLIGHT
    light_color: Triple = (1.0, 1.0, 1.0)  # linear RGB
    ambient: Number = 1.0  # factor of the base colour
    diffuse: Number = 0.0  # factor of base colour, light and cosine
    specular: Number = 0.0  # factor of the highlight
    shininess: Number = 1.0  # exponent of the highlight
    light_growth: Number = 0.0  # of cones to the light, per unit length; point light: its width
    own: Sequence[Number] | Tensor = ()  # up to four shader-specific numbers: a record above
    normal_scale: Number = 1.0  # a stored normal is number * scale + offset
    normal_offset: Number = 0.0
    octaves: Number = 0.0  # of scattering; 0: a surface's light
    anisotropy: Number = 0.0  # mean cosine of scattering

    def pack(self, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Returns (5, 4) numbers; raises ValueError as the function `pack` does."""
        own_index = self._fields.index("own")
        own_numbers = (*self.own, *(0.0,) * (_WIDTHS[own_index] - len(self.own)))
        return pack(
            (*self[:own_index], *own_numbers, *self[own_index + 1 :]), dtype, device
        ).reshape(5, 4)

    def own_as(self, record: Callable[..., _Record]) -> _Record:
        """Returns the shader-specific numbers by name, as one of the records above."""
        return record(*self.own[: _parameter_count(record)])

    @classmethod
    def read(cls, parameter_54: Tensor) -> ShadeParameters:
        """Returns packed numbers by name, as views of shape () or (k,)."""
        parts = parameter_54.reshape(-1)[: sum(_WIDTHS)].split(_WIDTHS)[: len(cls._fields)]
        return cls(*(part if len(part) > 1 else part[0] for part in parts))


def pack(parts: Sequence[Any], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Joins numbers, triples and tensors to one (k,) tensor on the device. It does not block:
    numbers are passed as kernel arguments, and tensors on the device stay there, so each replay of
    a CUDA graph reads their current values. Raises ValueError if a number is beyond what the dtype
    holds, RuntimeError if its gradient would be lost.
    """
    out: list[Tensor] = []
    for part in parts:
        check.no_gradient("shader", "its numbers", part)
        if isinstance(part, Tensor) and part.device == device:
            out.append(part.detach().reshape(-1).to(dtype))
            continue
        numbers = part.reshape(-1).tolist() if isinstance(part, Tensor) else part
        for number in numbers if isinstance(numbers, Sequence) else (numbers,):
            if torch.finfo(dtype).max < abs(number) < math.inf:
                raise ValueError(f"shader: {number!r} is beyond what {dtype} holds")
            out.append(torch.full((1,), float(number), dtype=dtype, device=device))
    return torch.cat(out)
