"""`Distance`: signed distance fields, negative inside, with a colour and a normal; and their
combinations. Shapes are in shapes.py, deformations of space in spaces.py.

The value of a combination is in general not an exact distance. But divided by a bound on how fast
it changes (`slope`), it still bounds the distance from below, which proves boxes empty or full.

Sources: Hart, "Sphere tracing: a geometric method for the antialiased ray tracing of implicit
    surfaces", The Visual Computer 1996 (Lipschitz bounds, shapes, their combination); Ricci, "A
    constructive geometry for computer graphics", The Computer Journal 1973 (minimum and maximum);
    the quadratic smooth minimum: Quilez, "Smooth minimum", 2013.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ..base import check
from ..base.lasting import in_transform
from .field import Field, Interval, between, length

Color = Sequence[float]  # linear red, green, blue, 0 to 1
WHITE = (0.8, 0.8, 0.8)
HASH = 0x9E3779B1  # odd factor by which `alike` combines the numbers of parts
_ROUNDING = 2.0**-16  # times the size of coordinates: rounding in float32 changes values by less


class Distance(Field):
    """Base of signed distances. A subclass implements `forward`, and `slope` if the value may
    change by more than 1 per unit of length.

    Attributes:
        exact: Whether the value is the distance itself near the surface, so that its gradient has
            length 1 there.
        smooth: Whether the surface has a normal nearly everywhere; False if it is rough at every
            scale.
    """

    exact: bool = True
    smooth: bool = True
    color: Tensor  # (3,) float64

    def __init__(self, color: Color = WHITE) -> None:
        """Sets the colour of the surface."""
        super().__init__()
        self.register_buffer("color", checked_colors(type(self).__name__, "color", color, (3,)))

    def forward(self, points: Tensor) -> Tensor:
        """Returns (...,) signed distances at points (..., 3)."""
        raise NotImplementedError(f"{type(self).__name__}: forward is not implemented")

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns distances (...,) and linear colours (..., 3) at points (..., 3)."""
        return self(points), self.color.to(points).expand_as(points)

    def gradient(self, points: Tensor) -> Tensor:
        """Returns gradients (..., 3) of the value, which point along the normal."""
        return self.surface_and_gradient(points)[2]

    def surface_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns distances (...,), linear colours (..., 3) and gradients (..., 3) at points."""
        if not _computes_only():
            value, vjp, color = torch.func.vjp(self.surface, points, has_aux=True)  # type: ignore[misc]
            (gradient,) = vjp(torch.ones_like(value))
            return value, color, gradient
        # Not vjp: its first call imports torch's compiler, for seconds, and in inference mode
        # it gives zeros with torch 2.11.
        with torch.inference_mode(False), torch.enable_grad():
            at = points.clone() if points.is_inference() else points.detach()
            at.requires_grad_()
            value, color = self.surface(at)
            gradient, ones = torch.zeros_like(points), torch.ones_like(value)
            if value.requires_grad:
                (gradient,) = torch.autograd.grad(value, at, ones, materialize_grads=True)
        return value.detach(), color.detach(), gradient

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        """Returns (k,) float64: the most that the value changes per unit of length anywhere in
        boxes center - half to center + half, (k, 3); 1 unless overridden.
        """
        return torch.ones_like(center[:, 0])

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Returns the value in the middle plus and minus what the slope allows; see `Field`."""
        middle, deviation = self(center), self.slope(center, half) * length(half)
        return middle - deviation, middle + deviation

    def near(self, center: Tensor, half: Tensor) -> Distance:
        return self

    def level_box(self, level: Tensor | float) -> Tensor | None:
        """Returns (2, 3) float64 corners of a box outside which the value exceeds a level >= 0;
        None: unknown. Unless overridden, this is `box` grown by the level, which is right if the
        value is at least the distance from `box`.
        """
        return grown(self.box(), level)

    def colors(self, center: Tensor, half: Tensor) -> Interval:
        """Returns intervals (k, 3) float64 that hold the colours everywhere in boxes."""
        color = self.color.to(center).expand_as(center)
        return color, color

    def __or__(self, other: Distance) -> Union:
        return Union(self, other)

    def __and__(self, other: Distance) -> Intersection:
        return Intersection(self, other)

    def __sub__(self, other: Distance) -> Difference:
        return Difference(self, other)


def _computes_only() -> bool:
    """Returns whether torch records nothing: no gradients in either mode, transform, or graph."""
    recording = torch.is_grad_enabled() or forward_ad._current_level >= 0
    compiling = torch.compiler.is_compiling() or torch.jit.is_tracing()
    return not (recording or compiling or in_transform())


class Pair(Distance):
    """Base of combinations of two shapes by `mix`, which must not decrease with either value. A
    subclass whose value may be less than both overrides `level_box`, as `SmoothUnion` does.
    """

    def __init__(self, first: Distance, second: Distance) -> None:
        """Sets the shapes, which keep their colours."""
        super().__init__()
        context = type(self).__name__
        self.first = check.instance(context, "first", first, Distance)
        self.second = check.instance(context, "second", second, Distance)
        self.exact = first.exact and second.exact
        self.smooth = first.smooth and second.smooth

    def mix(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the value that two values combine to, and the second one's share of the colour,
        which is monotonic in each value. Where it is 0 or 1, the value is the first or the second.
        """
        raise NotImplementedError

    def forward(self, points: Tensor) -> Tensor:
        return self.mix(self.first(points), self.second(points))[0]

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        first, first_color = self.first.surface(points)
        second, second_color = self.second.surface(points)
        value, fraction = self.mix(first, second)
        return value, torch.lerp(first_color, second_color, fraction[..., None].to(first_color))

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        return torch.maximum(self.first.slope(center, half), self.second.slope(center, half))

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Combines the ends of both intervals, which is right because `mix` never decreases."""
        bounds = (part.bounds(center, half) for part in (self.first, self.second))
        low, high = zip(*bounds, strict=True)
        return self.mix(*low)[0], self.mix(*high)[0]

    def colors(self, center: Tensor, half: Tensor) -> Interval:
        """Returns one shape's intervals where only its colour counts, else the hull of both."""
        first, second = (part.colors(center, half) for part in (self.first, self.second))
        return between(first, second, *self._fraction_bounds(center, half, 0.0))

    def _fraction_bounds(self, center: Tensor, half: Tensor, rounding: float) -> Interval:
        """Returns intervals (k,) of the second one's share in boxes; values may be off by rounding,
        `rounding` times the size of coordinates.
        """
        slack = rounding * (center.abs() + half).amax(1)
        (a, b), (c, d) = self.first.bounds(center, half), self.second.bounds(center, half)
        fractions = self.mix(a - slack, d + slack)[1], self.mix(b + slack, c - slack)[1]
        ends = torch.stack([fraction.to(a) for fraction in fractions])
        return ends.amin(0), ends.amax(0)

    def near(self, center: Tensor, half: Tensor) -> Distance:
        """Returns one shape if only it counts in all boxes, else the pair, with reduced parts."""
        low, high = self._fraction_bounds(center, half, _ROUNDING)
        alone = torch.stack(((high == 0).all(), (low == 1).all())).tolist()
        if alone[0]:
            return self.first.near(center, half)
        if alone[1]:
            return self.second.near(center, half)
        first, second = self.first.near(center, half), self.second.near(center, half)
        return self.replaced(first=first, second=second)

    def alike(self, center: Tensor, half: Tensor) -> Tensor:
        low, high = self._fraction_bounds(center, half, _ROUNDING)
        relevance = torch.where(high == 0, 0, torch.where(low == 1, 1, 2))
        first = torch.where(relevance == 1, 0, self.first.alike(center, half))
        second = torch.where(relevance == 0, 0, self.second.alike(center, half))
        return (first * HASH + second) * 3 + relevance

    def box(self) -> Tensor | None:
        return self.level_box(0.0)

    def level_box(self, level: Tensor | float) -> Tensor | None:
        return joint_box(self.first.level_box(level), self.second.level_box(level))


class Union(Pair):
    """The union of two shapes."""

    def mix(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        return torch.minimum(first, second), second < first


class Intersection(Pair):
    """The intersection of two shapes."""

    def mix(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        return torch.maximum(first, second), second > first

    def level_box(self, level: Tensor | float) -> Tensor | None:
        return common_box(self.first.level_box(level), self.second.level_box(level))


class SmoothUnion(Pair):
    """The union, blended where both values differ by less than `width`, colours too."""

    def __init__(self, first: Distance, second: Distance, width: float) -> None:
        """Sets the shapes, and the difference of their values at which they begin to blend."""
        super().__init__(first, second)
        self.width = self.number("width", width, low=0, open_low=True)
        self.exact = False

    def mix(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        weight = (0.5 + 0.5 * (first - second) / self.width).clamp(0, 1)
        return torch.lerp(first, second, weight) - self.width * weight * (1 - weight), weight

    def level_box(self, level: Tensor | float) -> Tensor | None:
        return super().level_box(level + self.width / 4)


class OfShape(Field):
    """Base of fields made of one shape. `over` maps the boxes in which the field is evaluated to
    those in which the shape is evaluated, so that `near` and `alike` can use the shape's.
    """

    shape: Distance

    def over(self, center: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        """Returns boxes (k, 3) that hold all points at which the shape is evaluated for the given
        boxes; these boxes unless overridden.
        """
        return center, half

    def near(self, center: Tensor, half: Tensor) -> Self:
        return self.replaced(shape=self.shape.near(*self.over(center, half)))

    def alike(self, center: Tensor, half: Tensor) -> Tensor:
        return self.shape.alike(*self.over(center, half))


class Changed(OfShape, Distance):
    """Base of modifications of one shape: has its values, slope and colours unless overridden."""

    def __init__(self, shape: Distance) -> None:
        """Sets the shape, which keeps its colour."""
        super().__init__()
        self.shape = check.instance(type(self).__name__, "shape", shape, Distance)
        self.exact, self.smooth = shape.exact, shape.smooth

    def forward(self, points: Tensor) -> Tensor:
        return self.shape(points)

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        return self.shape.slope(*self.over(center, half))

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        return self.shape.bounds(*self.over(center, half))

    def colors(self, center: Tensor, half: Tensor) -> Interval:
        return self.shape.colors(*self.over(center, half))


class Negative(Changed):
    """The complement of a shape: its outside."""

    def forward(self, points: Tensor) -> Tensor:
        return -self.shape(points)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        value, color = self.shape.surface(points)
        return -value, color

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        low, high = self.shape.bounds(center, half)
        return -high, -low


class Difference(Intersection):
    """The first shape without the second. Cut faces have the second shape's colour."""

    def __init__(self, first: Distance, second: Distance) -> None:
        """Takes the shapes."""
        check.instance("Difference", "second", second, Distance)
        super().__init__(first, Negative(second))


class SmoothIntersection(Negative):
    """The intersection; its edge is blended as in `SmoothUnion`."""

    def __init__(self, first: Distance, second: Distance, width: float) -> None:
        """Sets the shapes and the width of the blend, see `SmoothUnion`."""
        check.instance("SmoothIntersection", "first", first, Distance)
        check.instance("SmoothIntersection", "second", second, Distance)
        super().__init__(SmoothUnion(Negative(first), Negative(second), width))
        self._parts = (first, second)

    def box(self) -> Tensor | None:
        return self.level_box(0.0)

    def level_box(self, level: Tensor | float) -> Tensor | None:
        first, second = self._parts
        return common_box(first.level_box(level), second.level_box(level))


class SmoothDifference(SmoothIntersection):
    """The first shape without the second; the edge is blended as in `SmoothUnion`."""

    def __init__(self, first: Distance, second: Distance, width: float) -> None:
        """Sets the shapes and the width of the blend, see `SmoothUnion`."""
        check.instance("SmoothDifference", "second", second, Distance)
        super().__init__(first, Negative(second), width)


def checked_colors(context: str, name: str, value: Any, shape: tuple[int, ...]) -> Tensor:
    """Returns float64 colours of a shape; ValueError unless all their numbers are in [0, 1]."""
    colors = check.reals(context, name, value, shape)
    if not bool(((colors >= 0) & (colors <= 1)).all()):
        raise ValueError(f"{context}: {name} must be in 0 to 1, got {check.quoted(value)}")
    return colors


def joint_box(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Returns the (2, 3) box around two boxes; None if either is unknown."""
    if first is None or second is None:
        return None
    return torch.stack((torch.minimum(first[0], second[0]), torch.maximum(first[1], second[1])))


def common_box(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Returns the intersection of two (2, 3) boxes; the known one if the other is unknown."""
    if first is None or second is None:
        return second if first is None else first
    return torch.stack((torch.maximum(first[0], second[0]), torch.minimum(first[1], second[1])))


def grown(box: Tensor | None, by: Tensor | float) -> Tensor | None:
    """Returns a (2, 3) box with all faces moved outwards by a length; None if it is unknown."""
    return None if box is None else torch.stack((box[0] - by, box[1] + by))
