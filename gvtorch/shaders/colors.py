"""Linear colours from names and #RRGGBB, and distinct colours for integers such as labels."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..base import check
from ..base.image_info import array_from_srgb, from_hex

#: Colours by name, as sRGB.
NAMED = {
    **{"black": "#000000", "gray": "#808080", "grey": "#808080", "silver": "#c0c0c0"},
    **{"white": "#ffffff", "red": "#e6332a", "orange": "#f39200", "gold": "#ffc800"},
    **{"yellow": "#ffed00", "lime": "#a5d700", "green": "#2ca02c", "teal": "#008c8c"},
    **{"cyan": "#00c8dc", "sky": "#78c8ff", "blue": "#2864dc", "navy": "#14286e"},
    **{"violet": "#8246c8", "magenta": "#dc28b4", "pink": "#ff96be", "salmon": "#fa8072"},
    **{"brown": "#8c5032", "tan": "#d2b48c", "bone": "#e8dcc5", "olive": "#808000"},
}
_HUE_STEP = 0x9E3779B97F4A7C15  # 2^64 / the golden ratio
_HASHED_FROM = np.uint64(2**16)
_LIGHTNESS_STEP = 0x57AE147AE147B001  # 2^64 * 0.3425: this makes the first 64 colours differ most


def linear_color(
    context: str, value: Any, named: Mapping[str, str] = NAMED
) -> tuple[float, float, float]:
    """Returns a colour as linear red, green, blue: one of the names or #RRGGBB, which are sRGB, or
    three numbers in [0, 1], which are linear; raises ValueError if it is neither.
    """
    if not isinstance(value, str):
        return check.triple(context, "colour", value, low=0, high=1)
    text = named.get(value.lower(), value)
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        names = ", ".join(named)
        raise ValueError(f"{context}: {value!r} is not a colour; known: #RRGGBB, {names}")
    red, green, blue = array_from_srgb(np.array(from_hex(text[1:]))).tolist()
    return (red, green, blue)


def distinct_colors(numbers: np.ndarray) -> np.ndarray:
    """Returns (k, 3) float64 linear colours of numbers (k,) int64; the same for the same number.

    Hues of consecutive numbers are a golden ratio of the circle apart, so that any few of them
    differ; lightness and chroma vary with another period. Large numbers are seldom consecutive but
    may have a common divisor: from 2^16 on their bits are mixed first.

    Source: Ottosson, "A perceptual color space for image processing", 2020 (OKLab); Steele, Lea,
        Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014 (the mixing).
    """
    bits = numbers.astype(np.int64).view(np.uint64)
    bits = np.where(bits < _HASHED_FROM, bits, _hashed(bits))
    steps = np.uint64(_HUE_STEP), np.uint64(_LIGHTNESS_STEP)
    hue, variation = ((bits * step >> np.uint64(11)) * 2.0**-53 for step in steps)
    lightness = 0.56 + 0.30 * variation
    chroma = 0.165 - 0.05 * np.abs(2 * variation - 1)
    angle = 2 * math.pi * (hue + 0.07)
    return _from_oklab(lightness, chroma * np.cos(angle), chroma * np.sin(angle))


def _hashed(bits: np.ndarray) -> np.ndarray:
    """Returns (k,) uint64 hashes: every bit depends on all bits of a number."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        bits = (bits ^ (bits >> np.uint64(shift))) * np.uint64(factor)
    return bits ^ (bits >> np.uint64(31))


def _from_oklab(lightness: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns (k, 3) linear RGB, clipped to [0, 1]."""
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    red = 4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short
    green = -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short
    blue = -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short
    return np.stack((red, green, blue), -1).clip(0, 1)
