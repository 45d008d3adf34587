"""Shapes as signed distances.

Sources: Hart, "Sphere tracing", 1996, appendix (sphere, box, torus, plane). Other
    shapes that name no source are plain geometry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..base import check
from .distance import WHITE, Color, Distance
from .field import Interval, box_distance, length, unit_vector


class Sphere(Distance):
    """A ball around the origin."""

    def __init__(self, radius: float = 1.0, *, color: Color = WHITE) -> None:
        """Takes its radius."""
        super().__init__(color)
        self.radius = self.number("radius", radius, low=0, open_low=True)

    def forward(self, points: Tensor) -> Tensor:
        return length(points) - self.radius

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Returns the values at the nearest and the farthest point of the box: exact."""
        absolute = center.abs()
        near, far = (absolute - half).clamp(min=0), absolute + half
        return length(near) - self.radius, length(far) - self.radius

    def box(self) -> Tensor:
        return _mirrored(self.radius.expand(3))


class Box(Distance):
    """A box around the origin, with edges rounded by a radius."""

    def __init__(
        self, size: Sequence[float] = (1.0, 1.0, 1.0), *, round: float = 0.0, color: Color = WHITE
    ) -> None:
        """Takes its sides and the radius of its edges, at most half of the shortest side."""
        super().__init__(color)
        self.size = self.vector("size", size, positive=True)
        self.round = self.number("round", round, low=0, high=float(self.size.min()) / 2)

    def forward(self, points: Tensor) -> Tensor:
        beyond = points.abs() - (self.size / 2 - self.round).to(points)
        return box_distance(beyond) - self.round

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Returns the values at the nearest and the farthest point of the box: exact, because the
        value rises with |x|, |y| and |z|.
        """
        absolute = center.abs()
        return self((absolute - half).clamp(min=0)), self(absolute + half)

    def box(self) -> Tensor:
        return _mirrored(self.size / 2)


class Torus(Distance):
    """A torus around the z axis."""

    def __init__(self, radius: float = 1.0, tube: float = 0.25, *, color: Color = WHITE) -> None:
        """Takes the radius of its centre line and that of its tube."""
        super().__init__(color)
        self.radius = self.number("radius", radius, low=0, open_low=True)
        self.tube = self.number("tube", tube, low=0, open_low=True)

    def forward(self, points: Tensor) -> Tensor:
        ring_distance = length(points[..., :2]) - self.radius
        return length(torch.stack((ring_distance, points[..., 2]), -1)) - self.tube

    def box(self) -> Tensor:
        extent = self.radius + self.tube
        return _mirrored(torch.stack((extent, extent, self.tube)))


class Capsule(Distance):
    """The points within a radius of a line segment."""

    def __init__(
        self,
        start: Sequence[float] = (0.0, 0.0, -0.5),
        end: Sequence[float] = (0.0, 0.0, 0.5),
        radius: float = 0.25,
        *,
        color: Color = WHITE,
    ) -> None:
        """Takes the ends of the line and the radius."""
        super().__init__(color)
        self.start = self.vector("start", start)
        self.end = self.vector("end", end)
        self.radius = self.number("radius", radius, low=0, open_low=True)

    def forward(self, points: Tensor) -> Tensor:
        start, axis = self.start.to(points), (self.end - self.start).to(points)
        squared_length = (axis * axis).sum().clamp(min=1e-30)
        fraction = ((points - start) * axis).sum(-1, keepdim=True) / squared_length
        return length(points - start - fraction.clamp(0, 1) * axis) - self.radius

    def box(self) -> Tensor:
        low, high = torch.minimum(self.start, self.end), torch.maximum(self.start, self.end)
        return torch.stack((low - self.radius, high + self.radius))


class Plane(Distance):
    """The half-space below a plane: on the side opposite to its normal."""

    normal: Tensor

    def __init__(
        self,
        normal: Sequence[float] = (0.0, 0.0, 1.0),
        height: float = 0.0,
        *,
        color: Color = WHITE,
    ) -> None:
        """Takes the normal, of any length but 0, and the plane's height along it."""
        super().__init__(color)
        self.register_buffer("normal", unit_vector("Plane", "normal", normal))
        self.height = self.number("height", height)

    def forward(self, points: Tensor) -> Tensor:
        return (points * self.normal.to(points)).sum(-1) - self.height

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Returns the values at the box's lowest and highest corner along the normal: exact."""
        middle, deviation = self(center), (half * self.normal.abs()).sum(1)
        return middle - deviation, middle + deviation


class Gyroid(Distance):
    """One side of Schoen's infinite surface sin x cos y + sin y cos z + sin z cos x = 0. The value
    is that sum times the length of a radian, divided by sqrt(3), the sum's largest slope: at most
    the distance, near the surface 0.7 to 1 times the distance.

    Source: Schoen, "Infinite periodic minimal surfaces without self-intersections", NASA TN D-5541,
        1970 (the surface; the sum is its usual approximation). The slope: Cauchy's inequality
        bounds the squares of the three derivatives, which then add up to at most 3.
    """

    exact = False

    def __init__(self, period: float = 1.0, *, color: Color = WHITE) -> None:
        """Takes the period, in world units, along every axis."""
        super().__init__(color)
        self.period = self.number("period", period, low=0, open_low=True)

    def forward(self, points: Tensor) -> Tensor:
        radian = self.period / (2 * math.pi)
        sine, cosine = (points / radian).sin(), (points / radian).cos()
        return (sine * cosine.roll(-1, -1)).sum(-1) * (radian / math.sqrt(3))


class Menger(Distance):
    """Menger's sponge in the cube from -1/2 to 1/2: of its 3^3 parts those of the central cross are
    removed, and so on within each of the others. The value is at most the distance.

    Source: Menger, "Allgemeine Raeume und Cartesische Raeume", 1926 (the sponge); Quilez, "Menger
        fractal", 2011 (crosses of all sizes by folding space).
    """

    exact = True  # next to its faces

    def __init__(self, levels: int = 4, *, color: Color = WHITE) -> None:
        """Takes the number of times that parts are removed, at most 30."""
        super().__init__(color)
        self.levels = check.integer("Menger", "levels", levels, low=0, high=30)

    def forward(self, points: Tensor) -> Tensor:
        distance = box_distance(points.abs() - 0.5)
        cell = 1.0
        for _ in range(self.levels):
            # Distances from the cell's centre along each axis; cells meet at odd halves.
            offset = (points - cell * (points / cell).detach().round()).abs()
            distance = torch.maximum(distance, cell / 6 - offset.sort(-1).values[..., 1])
            cell /= 3
        return distance

    def box(self) -> Tensor:
        return _mirrored(torch.full((3,), 0.5, dtype=torch.float64, device=self.color.device))


def _mirrored(high: Tensor) -> Tensor:
    """Returns the (2, 3) box from -high to high (3,)."""
    return torch.stack((-high, high))
