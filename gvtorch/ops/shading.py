"""The 20 numbers for light, material and the shader itself that `shade_rays` takes. Shaders write
them; the torch twin and csrc/shaders/shaders.h read them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
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


#: Filtered colours hold the moments of normals that no light reaches divided by this, and shaders
#: multiply the moments' trace by it; as `kFaint` in csrc/shaders/light.h.
FAINT = 32


class LightKind(IntEnum):
    """Where light comes from."""

    HEADLIGHT = 0  # the eye of each ray
    DIRECTIONAL = 1  # infinitely far away
    POINT = 2  # a position


_Record = TypeVar("_Record", bound=NamedTuple)

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
    own: Sequence[Number] | Tensor = ()  # up to four numbers of its own: a record beside its twin
    normal_scale: Number = 1.0  # a stored normal is number * scale + offset
    normal_offset: Number = 0.0
    octaves: Number = 0.0  # of scattering; 0: a surface's light
    anisotropy: Number = 0.0  # mean cosine of scattering

    def pack(self, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Returns (5, 4) numbers; raises ValueError as the function `pack` does."""
        index = self._fields.index("own")
        own_numbers = (*self.own, *(0.0,) * (_WIDTHS[index] - len(self.own)))
        parts = (*self[:index], *own_numbers, *self[index + 1 :])
        return pack(parts, dtype, device).reshape(5, 4)

    def own_as(self, record: type[_Record]) -> _Record:
        """Returns the shader-specific numbers by name, as a record of theirs."""
        return record(*self.own[: len(record._fields)])

    @classmethod
    def read(cls, parameter_54: Tensor) -> ShadeParameters:
        """Returns packed numbers by name, as views of shape () or (k,)."""
        parts = parameter_54.reshape(-1)[: sum(_WIDTHS)].split(_WIDTHS)
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
