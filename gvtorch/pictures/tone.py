"""From scene light to display values: tone curves and the sRGB encoding.

Sources: Reinhard, Stark, Shirley, Ferwerda, "Photographic tone reproduction for digital images",
SIGGRAPH 2002, eq. 4; Narkowicz, "ACES filmic tone mapping curve", 2016; IEC 61966-2-1:1999 (sRGB).
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from ..base import check

ToneCurve = Literal["none", "reinhard", "aces"]
CURVES: tuple[ToneCurve, ...] = get_args(ToneCurve)
_MOST_LIGHT = 1e9  # its square fits into float32
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear RGB with the primaries of Rec. 709


def tone_map(
    color: Tensor, curve: ToneCurve = "aces", *, exposure: float = 0.0, white: float = 4.0
) -> Tensor:
    """Returns display-referred linear RGB in [0, 1] of linear RGB (..., 3), not premultiplied; NaN
    becomes 0. See `Picture.tone_map`.
    """
    stops = checked_curve("tone_map", curve, exposure)
    white = check.number("tone_map", "white", white, low=1 / _MOST_LIGHT, high=_MOST_LIGHT)
    color = (finite(color) * 2.0**stops).clamp(max=_MOST_LIGHT)
    if curve == "reinhard":
        weights = torch.stack([torch.full_like(color[..., 0], w) for w in LUMINANCE], -1)
        light = (color * weights).sum(-1, keepdim=True)
        color = color * ((1 + light / white**2) / (1 + light))
    elif curve == "aces":
        color = color * (2.51 * color + 0.03) / (color * (2.43 * color + 0.59) + 0.14)
    return color.clamp(0, 1)


def checked_curve(context: str, curve: str, exposure: float) -> float:
    """Returns the exposure; raises ValueError if it or the curve's name is wrong."""
    check.one_of(context, "curve", curve, CURVES)
    return check.number(context, "exposure", exposure, low=-100, high=100)


def finite(color: Tensor) -> Tensor:
    """Returns colours without negative numbers, NaN (0 instead) and infinity (1e9 instead)."""
    return torch.nan_to_num(color, nan=0.0, posinf=_MOST_LIGHT, neginf=0.0).clamp(min=0)


def to_srgb(color: Tensor) -> Tensor:
    """Returns linear RGB (..., 3), clipped to [0, 1], encoded as sRGB."""
    from kornia.color import linear_rgb_to_rgb

    planes = finite(color).clamp(max=1).movedim(-1, -3)
    return linear_rgb_to_rgb(planes).movedim(-3, -1)


def from_srgb(color: Tensor) -> Tensor:
    """Returns linear RGB (..., 3) of sRGB-encoded colours in [0, 1]."""
    from kornia.color import rgb_to_linear_rgb

    return rgb_to_linear_rgb(color.movedim(-1, -3)).movedim(-3, -1)
