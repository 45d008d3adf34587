"""Shapes as signed distances.

Sources: Hart, "Sphere tracing", 1996, appendix (sphere, box, torus, plane); distances to a segment
    and to a triangle of coordinates are plain geometry.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .distance import WHITE, Color, Distance
from .field import Interval, length


class Sphere(Distance):
    """A ball around the origin."""

    radius: Tensor

    def __init__(self, radius: float = 1.0, *, color: Color = WHITE) -> None:
        """Takes its radius."""
        super().__init__(color)
        self.number("radius", radius, low=0, open_low=True)

    def forward(self, points: Tensor) -> Tensor:
        return length(points) - self.radius

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """The nearest and the farthest point of the box: exact."""
        away = center.abs()
        near, far = (away - half).clamp(min=0), away + half
        return length(near) - self.radius, length(far) - self.radius

    def box(self) -> Tensor:
        return _mirrored(self.radius.expand(3))


class Box(Distance):
    """A box around the origin, with edges rounded by a radius."""

    size: Tensor
    round: Tensor

    def __init__(
        self, size: Sequence[float] = (1.0, 1.0, 1.0), *, round: float = 0.0, color: Color = WHITE
    ) -> None:
        """Takes its sides and how far its edges are rounded, at most half of the shortest side."""
        super().__init__(color)
        self.vector("size", size, positive=True)
        self.number("round", round, low=0, high=float(self.size.min()) / 2)

    def forward(self, points: Tensor) -> Tensor:
        beyond = points.abs() - (self.size / 2 - self.round).to(points)
        return length(beyond.clamp(min=0)) + beyond.amax(-1).clamp(max=0) - self.round

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """The nearest and the farthest point of the box: exact, for the value rises with |x|, |y|
        and |z|.
        """
        away = center.abs()
        return self((away - half).clamp(min=0)), self(away + half)

    def box(self) -> Tensor:
        return _mirrored(self.size / 2)


def _mirrored(high: Tensor) -> Tensor:
    """(2, 3) box from -high to high (3,)."""
    return torch.stack((-high, high))
