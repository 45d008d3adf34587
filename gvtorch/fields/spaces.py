"""Shapes moved, bent and repeated in space, and their surfaces moved outwards.

Where a deformation stretches space, the value may change by more than 1 per unit of length;
`slope` bounds it. Sources: Hart, "Sphere tracing", 1996, sections on Lipschitz bounds of
    deformations; Barr, "Global and local deformations of solid primitives", SIGGRAPH 1984 (twist).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..base import check
from .distance import Changed, Difference, Distance, Intersection, grown
from .field import Interval, box_distance, length, tighter, unit_vector

Matrix = Sequence[Sequence[float]]


class Space(Changed):
    """Base of deformed shapes: a point is mapped by `place`, and the shape evaluated there."""

    def place(self, points: Tensor) -> Tensor:
        """Maps points (..., 3) to those at which the shape is evaluated; by default, identity."""
        return points

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        """Returns the value at points, given the shape's; must not decrease as that grows. `bounds`
        calls it for the centres of boxes, so a subclass whose value also depends on points
        overrides `bounds`.
        """
        return value

    def stretch(self, center: Tensor, half: Tensor) -> Tensor | float:
        """Returns (k,): the most that `place` stretches distances within boxes."""
        return 1.0

    def forward(self, points: Tensor) -> Tensor:
        return self.value(self.shape(self.place(points)), points)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        value, color = self.shape.surface(self.place(points))
        return self.value(value, points), color

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        return super().slope(center, half) * self.stretch(center, half)

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Intersects the bounds of the shape over the mapped boxes with those by the slope."""
        low, high = super().bounds(center, half)
        mapped_bounds = self.value(low, center), self.value(high, center)
        return tighter(mapped_bounds, Distance.bounds(self, center, half))

    def around(self, box: Tensor) -> Tensor | None:
        """Returns a (2, 3) box around the deformed shape, given one around the shape; None: unknown
        unless overridden.
        """
        return None

    def box(self) -> Tensor | None:
        box = self.shape.box()
        return None if box is None else self.around(box)

    @property
    def _has_far_values(self) -> bool:
        """Whether the shape's value is at least the distance from its box. Beyond a corner of an
        intersection's box, the larger of two distances is less; a difference has the first's box.
        """
        return self.shape.exact and all(isinstance(cut, Difference) for cut in _cuts(self.shape))

    def level_box(self, level: Tensor | float) -> Tensor | None:
        box = None if self._has_far_values else self.shape.level_box(level)
        box = None if box is None else self.around(box)
        return super().level_box(level) if box is None else box


class Transform(Space):
    """A shape turned, scaled and sheared by a matrix, then moved. The value is multiplied by the
    matrix's smallest singular value, so it is never more than the distance; if the matrix
    stretches all directions by the same factor, it is the distance.
    """

    inverse: Tensor
    scale: Tensor

    def __init__(
        self,
        shape: Distance,
        matrix: Matrix | Tensor = ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        offset: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Sets the shape, the (3, 3) matrix, and the position that the shape's origin is moved to.

        Raises:
            ValueError: The matrix has another shape or no inverse.
        """
        super().__init__(shape)
        linear = check.reals("Transform", "matrix", matrix, (3, 3))
        singular_values = torch.linalg.svdvals(linear)
        smallest, largest = singular_values.min(), singular_values.max()
        if not float(smallest) > 1e-12 * float(largest):
            raise ValueError(f"Transform: matrix must have an inverse, got {linear.tolist()}")
        self.offset = self.vector("offset", offset)
        self.register_buffer("inverse", torch.linalg.inv(linear))
        self.register_buffer("scale", smallest)
        self.exact = shape.exact and float(largest / smallest) < 1 + 1e-9

    def place(self, points: Tensor) -> Tensor:
        return (points - self.offset.to(points)) @ self.inverse.to(points).mT

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        return self.place(center), half @ self.inverse.abs().mT

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        return value * self.scale

    def level_box(self, level: Tensor | float) -> Tensor | None:
        """Where the matrix stretches, the value rises by less than 1 per unit of length."""
        if self.exact and self._has_far_values:
            return grown(self.box(), level)
        box = self.shape.level_box(level / self.scale)
        return None if box is None else self.around(box)

    def around(self, box: Tensor) -> Tensor | None:
        if not bool(box.isfinite().all()):  # 0 * infinity is NaN
            return None
        matrix = torch.linalg.inv(self.inverse)
        middle, half = box.mean(0) @ matrix.mT, (box[1] - box[0]) / 2 @ matrix.abs().mT
        return torch.stack((middle - half, middle + half)) + self.offset


class Twist(Space):
    """A shape turned about the z axis by an angle that grows along the axis. Space is stretched
    more with the distance from the axis: by at most 1 + |rate| * radius.
    """

    def __init__(self, shape: Distance, rate: float) -> None:
        """Takes the shape and the angle per unit of length, in radians."""
        super().__init__(shape)
        self.rate = self.number("rate", rate)
        self.exact = False

    def place(self, points: Tensor) -> Tensor:
        x, y, z = points.unbind(-1)
        cosine, sine = (self.rate * z).cos(), (self.rate * z).sin()
        return torch.stack((cosine * x + sine * y, cosine * y - sine * x, z), -1)

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        radius = length(half) * self.stretch(center, half)
        farthest = length((center.abs() + half)[:, :2]) + length(center[:, :2])
        half_width = torch.minimum(radius, farthest)
        return self.place(center), torch.stack((half_width, half_width, half[:, 2]), 1)

    def stretch(self, center: Tensor, half: Tensor) -> Tensor:
        """Returns the largest singular value of a shear by rate * radius."""
        shear = self.rate.abs() * length((center.abs() + half)[:, :2])
        return (shear + (shear * shear + 4).sqrt()) / 2

    def around(self, box: Tensor) -> Tensor:
        radius = length(box.abs().amax(0)[:2])
        sides = torch.stack((-radius, radius))
        return torch.stack((sides, sides, box[:, 2]), 1)


class Repeat(Space):
    """A shape repeated along the axes. It must lie within its cell, which is `period` wide around
    the origin: then only the two cells nearest to a point along each axis need be evaluated.
    """

    def __init__(
        self, shape: Distance, period: Sequence[float], count: Sequence[int] | None = None
    ) -> None:
        """Sets the shape, the spacing of its copies along x, y, z (0: not repeated), and how many
        there are along each axis (odd, centred at the origin); None: infinitely many.

        Raises:
            ValueError: The shape is not known to lie within its cell, or a number is invalid.
        """
        super().__init__(shape)
        context = type(self).__name__
        self.period = self.vector("period", period)
        self._axes = [axis for axis in range(3) if float(self.period[axis]) != 0]
        if bool((self.period < 0).any()) or not self._axes:
            got = tuple(period)
            raise ValueError(f"{context}: period must be >= 0, and > 0 along an axis, got {got}")
        box = shape.box()
        beyond = None if box is None else box.abs().amax(0) - self.period / 2
        if beyond is None or bool((beyond[self._axes] > 1e-9).any()):
            size = "no box" if box is None else f"box {box.tolist()}"
            raise ValueError(f"{context}: the shape must lie within its cell, it has {size}")
        if count is not None and (not isinstance(count, Sequence) or len(count) != 3):
            raise ValueError(f"{context}: count must be (x, y, z), got {count!r}")
        counts = count or (None,) * 3
        for n in counts:
            if n is not None and check.integer(context, "count", n, low=1) % 2 == 0:
                raise ValueError(f"{context}: count must be odd, got {counts}")
        # Whether values are no distances, see `slope`.
        self._jumps = not shape.exact or bool(_cuts(shape))
        self._max_cell = [math.inf if n is None else (n - 1) // 2 for n in counts]

    def _cells(self, points: Tensor) -> list[Tensor]:
        """Returns points (..., 3) relative to their two nearest cells along each repeated axis."""
        cells = []
        coordinates = points.unbind(-1)
        for sides in itertools.product((0, 1), repeat=len(self._axes)):
            relative = [*coordinates]
            for axis, side in zip(self._axes, sides, strict=True):
                period, max_cell = self.period[axis], self._max_cell[axis]
                # The cell number is piecewise constant, so it is detached from the gradient.
                cell_number = (coordinates[axis] / period).detach().floor() + side
                relative[axis] = coordinates[axis] - cell_number.clamp(-max_cell, max_cell) * period
            cells.append(torch.stack(relative, -1))
        return cells

    def forward(self, points: Tensor) -> Tensor:
        return torch.stack([self.shape(cell) for cell in self._cells(points)]).amin(0)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        first, *others = self._cells(points)
        value, color = self.shape.surface(first)
        for cell in others:
            other, other_color = self.shape.surface(cell)
            color = torch.where((other < value)[..., None], other_color, color)
            value = torch.minimum(value, other)
        return value, color

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        """Returns a huge slope for boxes in which the two nearest cells change: there the value
        jumps, unless it is a distance, which no other copy can be nearer than.
        """
        slope = super().slope(center, half)
        for axis in self._axes if self._jumps else ():
            period, max_cell = self.period[axis], self._max_cell[axis]
            cells = ((end[:, axis] / period).floor() for end in (center - half, center + half))
            first, last = (cell.clamp(-max_cell - 1, max_cell) for cell in cells)
            slope = torch.where(first < last, 1e30, slope)
        return slope

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        """Returns boxes (k, 3) that hold the results of `_cells` for all points of boxes."""
        low, high = center - half, center + half
        for axis in self._axes:
            period, max_cell = self.period[axis], self._max_cell[axis]
            first = (low[:, axis] / period).floor().clamp(-max_cell, max_cell)
            last = ((high[:, axis] / period).floor() + 1).clamp(-max_cell, max_cell)
            ends = (low[:, axis] - last * period, high[:, axis] - first * period)
            if math.isinf(max_cell):
                ends = ends[0].clamp(min=-period), ends[1].clamp(max=period)
            low = torch.where(torch.arange(3, device=low.device) == axis, ends[0][:, None], low)
            high = torch.where(torch.arange(3, device=low.device) == axis, ends[1][:, None], high)
        return (low + high) / 2, (high - low) / 2

    def around(self, box: Tensor) -> Tensor | None:
        max_cell = self.period.new_tensor(self._max_cell, dtype=torch.float64)
        return grown(box, torch.where(self.period > 0, self.period * max_cell, 0.0))


class Offset(Space):
    """A shape grown by a length on all sides, which rounds its edges; shrunk if it is negative."""

    def __init__(self, shape: Distance, by: float) -> None:
        """Sets the shape, and the distance by which its surface moves outwards."""
        super().__init__(shape)
        self.by = self.number("by", by)

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        return value - self.by

    def box(self) -> Tensor | None:
        return self.level_box(0.0)

    def level_box(self, level: Tensor | float) -> Tensor | None:
        return self.shape.level_box((level + self.by).clamp(min=0))


class Shell(Offset):
    """A hollow shape: a wall of a given thickness, centred at the surface."""

    def __init__(self, shape: Distance, thickness: float) -> None:
        """Sets the shape and the thickness of its wall."""
        check.number("Shell", "thickness", thickness, low=0, open_low=True)
        super().__init__(shape, thickness / 2)

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        return value.abs() - self.by

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Takes the absolute value of the shape's interval; if that contains 0, its least is 0."""
        low, high = self.shape.bounds(center, half)
        lowest = torch.where((low < 0) & (high > 0), 0.0, torch.minimum(low.abs(), high.abs()))
        return lowest - self.by, torch.maximum(low.abs(), high.abs()) - self.by


class Extrusion(Space):
    """A shape's cross-section at z = 0, extruded along z. The value is a distance only if the shape
    is the same above and below that plane.
    """

    def __init__(self, shape: Distance, height: float) -> None:
        """Sets the shape and its height, centred at z = 0."""
        super().__init__(shape)
        self.height = self.number("height", height, low=0, open_low=True)

    def place(self, points: Tensor) -> Tensor:
        return torch.cat((points[..., :2], torch.zeros_like(points[..., 2:])), -1)

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        return self.place(center), self.place(half)

    def value(self, value: Tensor, points: Tensor) -> Tensor:
        return self._with_caps(value, points[..., 2].abs())

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        low, high = self.shape.bounds(*self.over(center, half))
        plane_distance, half_height = center[:, 2].abs(), half[:, 2]
        mapped_bounds = (
            self._with_caps(low, (plane_distance - half_height).clamp(min=0)),
            self._with_caps(high, plane_distance + half_height),
        )
        return tighter(mapped_bounds, Distance.bounds(self, center, half))

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        """Returns the shape's slope, but at least 1, that of the caps."""
        return super().slope(center, half).clamp(min=1)

    def level_box(self, level: Tensor | float) -> Tensor | None:
        box = self.shape.level_box(level)
        return None if box is None else self.around(box, level)

    def around(self, box: Tensor, level: Tensor | float = 0.0) -> Tensor:
        end = self.height / 2 + level
        return torch.cat((box[:, :2], torch.stack((-end, end))[:, None]), 1)

    def _with_caps(self, value: Tensor, plane_distance: Tensor) -> Tensor:
        """Combines a 2D distance (`value`) with the distance from the plane (`plane_distance`)."""
        beyond = torch.stack((value, plane_distance - self.height / 2), -1)
        return box_distance(beyond)


class Revolution(Space):
    """A shape's cross-section at z = 0, revolved around the z axis: its x is the distance from the
    axis minus a radius, its y is z. Right if the shape is the same above and below its plane z = 0.
    """

    def __init__(self, shape: Distance, radius: float = 0.0) -> None:
        """Sets the shape, and the distance of its origin from the axis."""
        super().__init__(shape)
        self.radius = self.number("radius", radius, low=0)

    def place(self, points: Tensor) -> Tensor:
        axis_distance = length(points[..., :2]) - self.radius
        return torch.stack((axis_distance, points[..., 2], torch.zeros_like(axis_distance)), -1)

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        absolute, half_xy = center[:, :2].abs(), half[:, :2]
        near, far = length((absolute - half_xy).clamp(min=0)), length(absolute + half_xy)
        zero = torch.zeros_like(near)
        middle = torch.stack(((near + far) / 2 - self.radius, center[:, 2], zero), 1)
        return middle, torch.stack(((far - near) / 2, half[:, 2], zero), 1)

    def around(self, box: Tensor) -> Tensor:
        radius = self.radius + box[:, 0].abs().max()
        sides = torch.stack((-radius, radius))
        return torch.stack((sides, sides, box[:, 1]), 1)


def _cuts(shape: Distance) -> list[Intersection]:
    """Returns the intersections and differences in a shape."""
    return [part for part in shape.modules() if isinstance(part, Intersection)]


def moved(shape: Distance, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Transform:
    """Returns a shape moved along the axes."""
    return Transform(shape, offset=(x, y, z))


def rotated(shape: Distance, axis: Sequence[float], degrees: float) -> Transform:
    """Returns a shape turned about an axis through the origin, counter-clockwise seen from its tip.

    Source: Rodrigues' formula.

    Raises:
        ValueError: The axis has no direction, or a number is not finite.
    """
    x, y, z = unit_vector("rotated", "axis", axis).tolist()
    angle = math.radians(check.number("rotated", "degrees", degrees))
    cross = torch.tensor(((0, -z, y), (z, 0, -x), (-y, x, 0)), dtype=torch.float64, device="cpu")
    identity = torch.eye(3, dtype=torch.float64, device="cpu")
    matrix = identity + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return Transform(shape, matrix)


def scaled(shape: Distance, x: float, y: float | None = None, z: float | None = None) -> Transform:
    """Returns a shape scaled along the axes; y and z are x if left out."""
    sides = [check.number("scaled", "factor", x if n is None else n) for n in (x, y, z)]
    return Transform(shape, torch.diag(torch.tensor(sides, dtype=torch.float64, device="cpu")))
