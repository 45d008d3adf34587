"""Shapes moved, bent and repeated in space, and their surfaces moved outwards.

Where a space is stretched, the value changes faster than the place, and intervals say so by
`slope`. Sources: Hart, "Sphere tracing", 1996, sections on Lipschitz bounds of deformations; Barr,
    "Global and local deformations of solid primitives", SIGGRAPH 1984 (twist).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..base import check
from .distance import Changed, Distance, grown
from .field import Interval, length, tighter

Matrix = Sequence[Sequence[float]]


class Space(Changed):
    """Base of shapes that are asked somewhere else: at `place` of a point, in boxes `over`."""

    def place(self, points: Tensor) -> Tensor:
        """Returns the points (..., 3) at which the shape is asked; itself unless overridden."""
        return points

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        """Returns the value at points, given the shape's; it never falls where that rises."""
        return value

    def stretch(self, center: Tensor, half: Tensor) -> Tensor | float:
        """Returns (k,) how far apart points of boxes come at most, for one unit."""
        return 1.0

    def forward(self, points: Tensor) -> Tensor:
        return self.value(self.shape(self.place(points)), points)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        value, color = self.shape.surface(self.place(points))
        return self.value(value, points), color

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        return super().slope(center, half) * self.stretch(center, half)

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """What the shape tells of the place of a box, and the slope."""
        low, high = super().bounds(center, half)
        known = self.value(low, center), self.value(high, center)
        return tighter(known, Distance.bounds(self, center, half))


class Transform(Space):
    """A shape turned, scaled and sheared by a matrix, then moved. The value is scaled by the least
    that the matrix stretches, so it is never more than the distance; where the matrix stretches
    all directions alike, it is the distance.
    """

    inverse: Tensor
    scale: Tensor

    def __init__(
        self,
        shape: Distance,
        matrix: Matrix | Tensor = ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        offset: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Takes the shape, the (3, 3) matrix, and where its origin goes.

        Raises:
            ValueError: The matrix is no matrix, or has no inverse.
        """
        super().__init__(shape)
        turn = check.reals("Transform", "matrix", matrix, (3, 3))
        stretched = torch.linalg.svdvals(turn)
        least, most = stretched.min(), stretched.max()
        if not float(least) > 1e-12 * float(most):
            raise ValueError(f"Transform: matrix must have an inverse, got {turn.tolist()}")
        self.offset = self.vector("offset", offset)
        self.register_buffer("inverse", torch.linalg.inv(turn))
        self.register_buffer("scale", least)
        self.exact = shape.exact and float(most / least) < 1 + 1e-9

    def place(self, points: Tensor) -> Tensor:
        return (points - self.offset.to(points)) @ self.inverse.to(points).mT

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        return self.place(center), half @ self.inverse.abs().mT

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        return value * self.scale

    def box(self) -> Tensor | None:
        box = self.shape.box()
        if box is None:
            return None
        matrix = torch.linalg.inv(self.inverse)
        middle, half = box.mean(0) @ matrix.mT, (box[1] - box[0]) / 2 @ matrix.abs().mT
        return torch.stack((middle - half, middle + half)) + self.offset


class Twist(Space):
    """A shape turned about the z axis, by an angle that grows along it. Space is stretched the more
    the further from the axis: by about 1 + angle * radius.
    """

    def __init__(self, shape: Distance, rate: float) -> None:
        """Takes the shape and the angle by unit of length, in radians."""
        super().__init__(shape)
        self.rate = self.number("rate", rate)
        self.exact = False

    def place(self, points: Tensor) -> Tensor:
        x, y, z = points.unbind(-1)
        cosine, sine = (self.rate * z).cos(), (self.rate * z).sin()
        return torch.stack((cosine * x + sine * y, cosine * y - sine * x, z), -1)

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        reach = length(half) * self.stretch(center, half)
        wide = torch.minimum(reach, length((center.abs() + half)[:, :2]) + length(center[:, :2]))
        return self.place(center), torch.stack((wide, wide, half[:, 2]), 1)

    def stretch(self, center: Tensor, half: Tensor) -> Tensor:
        """The largest singular value of a shear by rate * radius."""
        shear = self.rate.abs() * length((center.abs() + half)[:, :2])
        return (shear + (shear * shear + 4).sqrt()) / 2

    def box(self) -> Tensor | None:
        box = self.shape.box()
        if box is None:
            return None
        radius = length(box.abs().amax(0)[:2])
        low, high = box.unbind(0)
        return torch.stack(
            (torch.stack((-radius, -radius, low[2])), torch.stack((radius, radius, high[2])))
        )


class Repeat(Space):
    """A shape again and again along the axes. It must lie within its cell, which is `period` wide
    around the origin: then the nearest of the two cells next to a point along each axis is right.
    """

    def __init__(
        self, shape: Distance, period: Sequence[float], count: Sequence[int] | None = None
    ) -> None:
        """Takes the shape, how far apart it is repeated along x, y, z (0: not at all), and how
        often in all (odd, around the origin); None: without end.

        Raises:
            ValueError: The shape is not known to lie within its cell, or a number is no good.
        """
        super().__init__(shape)
        where = type(self).__name__
        self.period = self.vector("period", period)
        self._axes = [axis for axis in range(3) if float(self.period[axis]) != 0]
        if bool((self.period < 0).any()) or not self._axes:
            raise ValueError(f"{where}: period must be >= 0 and once more, got {tuple(period)}")
        box = shape.box()
        beyond = None if box is None else box.abs().amax(0) - self.period / 2
        if beyond is None or bool((beyond[self._axes] > 1e-9).any()):
            size = "no box" if box is None else f"box {box.tolist()}"
            raise ValueError(f"{where}: the shape must lie within its cell, it has {size}")
        counts = (None,) * 3 if count is None else tuple(count)
        for one in counts:
            if one is not None and check.whole(where, "count", one, low=1) % 2 == 0:
                raise ValueError(f"{where}: count must be odd, got {counts}")
        self._most = [math.inf if one is None else (one - 1) // 2 for one in counts]

    def _cells(self, points: Tensor) -> list[Tensor]:
        """Points (..., 3) as the two nearest cells along each repeated axis see them."""
        cells = []
        coordinates = points.unbind(-1)
        for sides in itertools.product((0, 1), repeat=len(self._axes)):
            moved = [*coordinates]
            for axis, side in zip(self._axes, sides, strict=True):
                period, most = self.period[axis], self._most[axis]
                # torch has no gradient of floor, so a place moves as its point does.
                number = (coordinates[axis] / period).detach().floor() + side
                moved[axis] = coordinates[axis] - number.clamp(-most, most) * period
            cells.append(torch.stack(moved, -1))
        return cells

    def forward(self, points: Tensor) -> Tensor:
        return torch.stack([self.shape(cell) for cell in self._cells(points)]).amin(0)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        first, *others = self._cells(points)
        value, color = self.shape.surface(first)
        for cell in others:
            other, paint = self.shape.surface(cell)
            color = torch.where((other < value)[..., None], paint, color)
            value = torch.minimum(value, other)
        return value, color

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes (k, 3) that hold what `_cells` makes of the points of boxes."""
        low, high = center - half, center + half
        for axis in self._axes:
            period, most = self.period[axis], self._most[axis]
            first = (low[:, axis] / period).floor().clamp(-most, most)
            last = ((high[:, axis] / period).floor() + 1).clamp(-most, most)
            ends = (low[:, axis] - last * period, high[:, axis] - first * period)
            if math.isinf(most):
                ends = ends[0].clamp(min=-period), ends[1].clamp(max=period)
            low = torch.where(torch.arange(3, device=low.device) == axis, ends[0][:, None], low)
            high = torch.where(torch.arange(3, device=low.device) == axis, ends[1][:, None], high)
        return (low + high) / 2, (high - low) / 2

    def box(self) -> Tensor | None:
        most = torch.tensor(self._most, dtype=torch.float64)
        return grown(self.shape.box(), torch.where(self.period > 0, self.period * most, 0.0))


class Offset(Space):
    """A shape grown by a length on all sides, which rounds its edges; shrunk if it is negative."""

    def __init__(self, shape: Distance, by: float) -> None:
        """Takes the shape, and how far its surface moves outwards."""
        super().__init__(shape)
        self.by = self.number("by", by)

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        return value - self.by

    def box(self) -> Tensor | None:
        return grown(self.shape.box(), self.by.clamp(min=0))


class Shell(Offset):
    """The surface of a shape, as thick as told; hollow within."""

    def __init__(self, shape: Distance, thickness: float) -> None:
        """Takes the shape and how thick its wall is."""
        check.number("Shell", "thickness", thickness, low=0, open_low=True)
        super().__init__(shape, thickness / 2)

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        return value.abs() - self.by

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Of an interval around 0, the least is 0."""
        low, high = self.shape.bounds(center, half)
        least = torch.where((low < 0) & (high > 0), 0.0, torch.minimum(low.abs(), high.abs()))
        return least - self.by, torch.maximum(low.abs(), high.abs()) - self.by


class Extrusion(Space):
    """What a shape looks like at z = 0, along z. Right where it lies alike above and below."""

    def __init__(self, shape: Distance, height: float) -> None:
        """Takes the shape and how high it gets, around z = 0."""
        super().__init__(shape)
        self.height = self.number("height", height, low=0, open_low=True)

    def place(self, points: Tensor) -> Tensor:
        return torch.cat((points[..., :2], torch.zeros_like(points[..., 2:])), -1)

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        return self.place(center), self.place(half)

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        return self._within(value, points[..., 2].abs())

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        low, high = self.shape.bounds(*self.over(center, half))
        away, reach = center[:, 2].abs(), half[:, 2]
        known = self._within(low, (away - reach).clamp(min=0)), self._within(high, away + reach)
        return tighter(known, Distance.bounds(self, center, half))

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        """The caps' is 1."""
        return super().slope(center, half).clamp(min=1)

    def box(self) -> Tensor | None:
        box = self.shape.box()
        if box is None:
            return None
        ends = torch.stack((-self.height, self.height)) / 2
        return torch.cat((box[:, :2], ends[:, None]), 1)

    def _within(self, value: Tensor, away: Tensor) -> Tensor:
        """Of a value in the plane, and how far from the plane."""
        beyond = torch.stack((value, away - self.height / 2), -1)
        return length(beyond.clamp(min=0)) + beyond.amax(-1).clamp(max=0)


class Revolution(Space):
    """What a shape looks like at z = 0, around the z axis: its x becomes the distance from the axis
    less a radius, its y becomes z. Right where the shape lies alike above and below.
    """

    def __init__(self, shape: Distance, radius: float = 0.0) -> None:
        """Takes the shape and how far from the axis its origin goes."""
        super().__init__(shape)
        self.radius = self.number("radius", radius, low=0)

    def place(self, points: Tensor) -> Tensor:
        away = length(points[..., :2]) - self.radius
        return torch.stack((away, points[..., 2], torch.zeros_like(away)), -1)

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        away, reach = center[:, :2].abs(), half[:, :2]
        near, far = length((away - reach).clamp(min=0)), length(away + reach)
        none = torch.zeros_like(near)
        middle = torch.stack(((near + far) / 2 - self.radius, center[:, 2], none), 1)
        return middle, torch.stack(((far - near) / 2, half[:, 2], none), 1)

    def box(self) -> Tensor | None:
        box = self.shape.box()
        if box is None:
            return None
        wide = self.radius + box[:, 0].abs().max()
        return torch.stack(
            (torch.stack((-wide, -wide, box[0, 1])), torch.stack((wide, wide, box[1, 1])))
        )


def moved(shape: Distance, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Transform:
    """Returns a shape moved along the axes."""
    return Transform(shape, offset=(x, y, z))


def rotated(shape: Distance, axis: Sequence[float], degrees: float) -> Transform:
    """Returns a shape turned about an axis through the origin, counter-clockwise seen from its tip.

    Source: Rodrigues' formula.

    Raises:
        ValueError: The axis has no direction, or a number is not finite.
    """
    along = torch.tensor(check.triple("rotated", "axis", axis), dtype=torch.float64)
    if not float(along.norm()) > 0:
        raise ValueError(f"rotated: axis must have a direction, got {tuple(axis)}")
    angle = math.radians(check.number("rotated", "degrees", degrees))
    x, y, z = (along / along.norm()).tolist()
    cross = torch.tensor(((0, -z, y), (z, 0, -x), (-y, x, 0)), dtype=torch.float64)
    matrix = torch.eye(3).double() + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return Transform(shape, matrix)


def scaled(shape: Distance, x: float, y: float | None = None, z: float | None = None) -> Transform:
    """Returns a shape scaled along the axes, by x along all if y and z are left out."""
    sides = [check.number("scaled", "factor", x if one is None else one) for one in (x, y, z)]
    return Transform(shape, torch.diag(torch.tensor(sides, dtype=torch.float64)))
