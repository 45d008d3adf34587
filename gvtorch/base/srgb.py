"""sRGB, as arrays: how files and people tell colours, and the linear light that is rendered.

`pictures/tone.py` does the same for tensors of pictures.
"""

from __future__ import annotations

import numpy as np


def array_from_srgb(color: np.ndarray) -> np.ndarray:
    """Returns sRGB in [0, 1] as linear light (IEC 61966-2-1)."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
