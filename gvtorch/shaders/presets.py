"""Preset transfer functions, as points: opacity (v, a) and colour (v, r, g, b), linear light."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ..base import check
from ..base.declared import did_you_mean

Points = Sequence[Sequence[float]]
FunctionPoints = tuple[Points, Points]  # opacity and colour

#: Over [0, 1], to be stretched over a window of the data.
PRESETS: dict[str, FunctionPoints] = {
    "gray": ([(0, 0), (0.05, 0), (1, 0.5)], [(0, 0, 0, 0), (1, 1, 1, 1)]),
    "hot": (
        [(0, 0), (0.1, 0), (0.4, 0.05), (1, 0.6)],
        [(0, 0.1, 0, 0), (0.35, 0.9, 0.1, 0), (0.7, 1, 0.6, 0.05), (1, 1, 1, 0.8)],
    ),
    "vessels": (
        [(0, 0), (0.15, 0), (0.3, 0.25), (0.6, 0.9), (1, 0.95)],
        [(0, 0.3, 0.02, 0.02), (0.3, 0.55, 0.05, 0.03), (0.6, 0.9, 0.45, 0.25), (1, 1, 0.95, 0.8)],
    ),
    "bone": (
        [(0, 0), (0.45, 0), (0.55, 0.02), (0.65, 0.4), (1, 0.9)],
        [(0, 0.3, 0.1, 0.05), (0.5, 0.6, 0.25, 0.15), (0.65, 0.9, 0.8, 0.6), (1, 1, 1, 0.95)],
    ),
    "tissue": (
        [(0, 0), (0.3, 0), (0.45, 0.03), (0.6, 0.2), (0.8, 0.8), (1, 0.9)],
        [(0, 0.4, 0.15, 0.1), (0.3, 0.8, 0.4, 0.25), (0.6, 0.95, 0.75, 0.5), (1, 1, 1, 0.95)],
    ),
    # Magnetic resonance: noise is dark; the values of grey and white matter are close together.
    "mr": (
        [(0, 0), (0.12, 0), (0.3, 0.05), (0.55, 0.3), (0.8, 0.75), (1, 0.9)],
        [(0, 0.1, 0.04, 0.04), (0.3, 0.4, 0.17, 0.13), (0.6, 0.75, 0.55, 0.45), (1, 1, 0.97, 0.9)],
    ),
    # Electron microscopy: stained matter is dark, so low values are opaque.
    "em": (
        [(0, 0.95), (0.2, 0.7), (0.4, 0.1), (0.55, 0), (1, 0)],
        [(0, 1, 0.9, 0.7), (0.2, 0.75, 0.55, 0.35), (0.4, 0.3, 0.35, 0.5), (1, 0.05, 0.06, 0.1)],
    ),
    "cloud": (
        [(0, 0), (0.08, 0), (0.25, 0.02), (0.6, 0.15), (1, 0.5)],
        [(0, 0.35, 0.5, 0.75), (0.3, 0.65, 0.75, 0.9), (0.7, 0.95, 0.97, 1), (1, 1, 1, 1)],
    ),
    "galaxy": (
        [(0, 0), (0.03, 0), (0.2, 0.012), (0.5, 0.06), (0.8, 0.25), (1, 0.6)],
        [
            *[(0, 0.01, 0.01, 0.12), (0.25, 0.12, 0.04, 0.45), (0.5, 0.7, 0.1, 0.35)],
            *[(0.75, 1, 0.5, 0.15), (1, 1, 0.95, 0.8)],
        ],
    ),
}
COLORMAP_OPACITY = PRESETS["gray"][0]  # opacity of colour maps

#: In Hounsfield units: air is -1000, lung -900 to -500, fat -100, water 0, muscle 50, vessels with
#: contrast agent 150 to 500, bone 300 to 2000.
CT_PRESETS: dict[str, FunctionPoints] = {
    "ct-bone": (
        [(150, 0), (250, 0.03), (400, 0.35), (700, 0.8), (1500, 0.95)],
        [
            (150, 0.35, 0.1, 0.06),
            (300, 0.75, 0.5, 0.3),
            (600, 0.95, 0.85, 0.66),
            (1500, 1, 1, 0.95),
        ],
    ),
    "ct-soft": (
        [(-200, 0), (-150, 0.02), (-50, 0.04), (10, 0.08), (80, 0.3), (200, 0.5), (1000, 0.9)],
        [
            *[(-200, 0.75, 0.45, 0.3), (-80, 0.85, 0.6, 0.3), (20, 0.55, 0.12, 0.09)],
            *[(90, 0.75, 0.25, 0.17), (250, 0.95, 0.8, 0.6), (1000, 1, 1, 0.95)],
        ],
    ),
    "ct-lung": (
        [(-950, 0), (-850, 0.006), (-650, 0.02), (-500, 0.06), (-300, 0.12), (-200, 0)],
        [
            (-950, 0.1, 0.25, 0.5),
            (-750, 0.35, 0.6, 0.9),
            (-500, 0.9, 0.75, 0.6),
            (-200, 1, 0.4, 0.3),
        ],
    ),
    "ct-vessels": (
        [(110, 0), (150, 0.08), (250, 0.4), (400, 0.8), (1500, 0.95)],
        [
            *[(110, 0.35, 0.02, 0.02), (200, 0.6, 0.06, 0.04), (320, 0.9, 0.4, 0.22)],
            *[(500, 1, 0.9, 0.75), (1500, 1, 1, 0.95)],
        ],
    ),
}
#: For a preset over a window, the one in Hounsfield units that shows the same tissue.
IN_HU = {"bone": "ct-bone", "tissue": "ct-soft", "vessels": "ct-vessels"}

COLORMAP_SAMPLES = 256  # of a colour map
_POSITIONS = np.arange(COLORMAP_SAMPLES) / (COLORMAP_SAMPLES - 1)  # of these samples, 0 to 1


def preset_points(name: str) -> FunctionPoints:
    """Returns the points of a preset or of a colour map of matplotlib, which gets the opacity of
    "gray". Values are in [0, 1], for `CT_PRESETS` in Hounsfield units. ValueError: unknown name.
    """
    presets = {**PRESETS, **CT_PRESETS}
    if check.instance("preset", "name", name, str) in presets:
        return presets[name]
    maps, hint = _colormaps()
    map_name = name.removeprefix("matplotlib:")
    if map_name in maps:
        return _colormap(np.asarray(maps[map_name](_POSITIONS))[:, :3])
    known = f"{', '.join(sorted(presets))}, {hint}{did_you_mean(map_name, (*presets, *maps))}"
    raise ValueError(f"unknown preset {name!r}; known: {known}")


def display_grays() -> FunctionPoints:
    """Returns grays over [0, 1] whose sRGB value is the data value."""
    return _colormap(np.repeat(_POSITIONS[:, None], 3, 1))


def _colormap(colors: np.ndarray) -> FunctionPoints:
    """Returns the points of a colour map, given its colours (k, 3) at `_POSITIONS`, as sRGB."""
    points = np.column_stack((_POSITIONS, linear_from_srgb(colors)))
    return COLORMAP_OPACITY, points.tolist()


def _colormaps() -> tuple[Mapping[str, Callable[..., Any]], str]:
    """Returns matplotlib's colour maps, and the words for them in an error message."""
    try:
        from matplotlib import colormaps
    except ImportError:
        return {}, "and with matplotlib (pip install 'gvtorch[color]') its colour maps"
    return colormaps, "and matplotlib's colour maps"


def convert_colors(name: str, colors: np.ndarray, **options: bool) -> np.ndarray:
    """Converts colours (..., 3) by a function of kornia, in float64."""
    import kornia.color

    planes = torch.from_numpy(np.array(colors, np.float64)).reshape(-1, 3).T[None, :, :, None]
    converted = getattr(kornia.color, name)(planes, **options)
    return converted[0, :, :, 0].T.reshape(colors.shape).numpy()


def linear_from_srgb(colors: np.ndarray) -> np.ndarray:
    """Converts sRGB (k, 3) to linear light."""
    return convert_colors("rgb_to_linear_rgb", colors).clip(0, 1)
