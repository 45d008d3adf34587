"""`Fur`: hairs on a shape, as values that a transfer function colours.

Source: Perlin, Hoffert, "Hypertexture", SIGGRAPH 1989 (fur as noise around a surface); how hairs
    end and bend is ours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ..base import check
from . import noise
from .distance import Distance, OfShape
from .field import Interval, length
from .noise.fractal import MOST_SEED

_SKIN_VALUE = 0.1  # value of skin and roots
# Height at which hairs end, in lengths: mean + spread * noise.
_MEAN_HEIGHT, _HEIGHT_SPREAD = 0.45, 0.7
_MAX_SPREAD = _HEIGHT_SPREAD * noise.bounds(noise.perlin).high
_END_SLOPE = 5.0  # slope with which a hair ends: from 1 to 0 within 1 / 5 of a length


class Fur(OfShape):
    """Value 0 between hairs, and from 0.1 at their roots to 1 at tips one length high. A point is
    in a hair if its height is below a limit that grows with the noise at its root, the nearest
    point of the shape.

    A voxel has the value at its centre, with the contrast of noise that is left at its size.
    """

    prefiltered = True
    threshold: Mapping[str, float] = {"value": 0.0}

    def __init__(
        self,
        shape: Distance,
        *,
        length: float,
        frequency: float,
        fall: Sequence[float] = (0.0, 0.0, 0.0),
        seed: int = 0,
    ) -> None:
        """Sets the shape and its hairs.

        Args:
            shape: The shape that they grow on.
            length: Height at which the value reaches 1, in world units.
            frequency: Hairs per world unit.
            fall: How far a hair's tip hangs down, in hair lengths (x, y, z); at a share h of the
                height, h^2 times as far.
            seed: Seed of the noise.
        """
        super().__init__()
        self.shape = check.instance("Fur", "shape", shape, Distance)
        self.length = self.number("length", length, low=0, open_low=True)
        self.frequency = self.number("frequency", frequency, low=0, open_low=True)
        self.fall = self.vector("fall", fall)
        self.seed = check.integer("Fur", "seed", seed, low=-MOST_SEED, high=MOST_SEED)

    def forward(self, points: Tensor) -> Mapping[str, Tensor]:
        return self.filtered(points, torch.zeros_like(points))

    def filtered(self, points: Tensor, size: Tensor) -> Mapping[str, Tensor]:
        distance, _, gradient = self.shape.surface_and_gradient(points)
        height = distance / self.length
        normal = gradient / length(gradient).clamp(min=0.5)[..., None]
        displacement = (height * height * self.length)[..., None] * self.fall.to(points)
        root = points - distance[..., None] * normal - displacement
        side_cells = size.amax(-1).to(points) * self.frequency
        contrast = torch.exp(-noise.MEAN_DECAY * side_cells * side_cells)
        hairs = noise.perlin(root * self.frequency, seed=self.seed) * contrast
        inside = ((_MEAN_HEIGHT + _HEIGHT_SPREAD * hairs - height) * _END_SLOPE).clamp(0, 1)
        return {"value": inside * (_SKIN_VALUE + (1 - _SKIN_VALUE) * height.clamp(0, 1))}

    def bounds(self, center: Tensor, half: Tensor) -> Mapping[str, Interval]:
        """Returns 0 above all hairs, the skin's value below all roots, else 0 to 1."""
        low, high = self.shape.bounds(center, half)
        above = low > (_MEAN_HEIGHT + _MAX_SPREAD) * self.length
        skin = high < (_MEAN_HEIGHT - _MAX_SPREAD - 1 / _END_SLOPE) * self.length
        skin_value = _SKIN_VALUE * skin.to(low)
        return {"value": (skin_value, torch.where(skin, skin_value, (~above).to(low)))}

    def box(self) -> Tensor | None:
        """Returns the box around the shape and its hairs."""
        return self.shape.level_box((_MEAN_HEIGHT + _MAX_SPREAD) * self.length)
