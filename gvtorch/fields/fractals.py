"""Escape-time fractals as distance fields: `Mandelbulb`, `Julia`, `Mandelbox`, or user-defined ones
by an `Iteration`, with a colour by orbit traps.

The map z -> f(z) + c is applied to a point repeatedly. Points whose orbits stay within `bailout`
are the fractal. For those that escape, the distance is estimated from how fast orbits diverge.

**What is proven.** The estimate is no bound: next to the axis of the bulb it is in places more than
30 times too large, because the map stretches circles of latitude by more than the one factor that
is used for all directions. So `bounds` does not use it. Instead, it follows the orbit of a box's
centre, with a radius around it that holds the orbits of all points of the box (`Iteration.ranges`
bounds how much the map stretches there). That bounds where and when they escape, and so the number
that `forward` returns, whether or not it is a good estimate.

Sources: those of ops/reference/orbits.py, which follows the orbits; Pickover, "Computers, pattern,
    chaos, and beauty", 1990 (orbit traps).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypedDict, Unpack

import torch
from torch import Tensor, nn

from .. import ops
from ..base import check
from ..ops.reference import orbits as twin
from .distance import Color, Distance, checked_colors, grown
from .field import Interval, joined, length, parts_of

_PARTS = 2  # parts of a box along each axis; more would cost as much as the bricks they save
_LEAST_ESTIMATE = 1 / 3  # of the distance beyond the box along an axis; 0.34 was the least found


class Iteration(nn.Module):
    """One step f of an orbit, without the constant that is added. Points are (3, ...)."""

    logarithmic: bool = True  # whether |z| grows as a power; else by a factor

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Returns f(z), and the factor (...,) by which f stretches distances around z."""
        raise NotImplementedError(f"{type(self).__name__}: forward is not implemented")

    def ranges(self, z: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns bounds over balls around z (3, k) of radii `reach` (k,): the most that f really
        stretches distances, and the smallest and largest factor that `forward` returns, (k,) each.
        Unless overridden, nothing is known, so nothing is proven.
        """
        return torch.full_like(reach, torch.inf), torch.zeros_like(reach), reach + torch.inf


class Power(Iteration):
    """z^n in spherical coordinates: |z| to the power n, both angles times n."""

    def __init__(self, power: int) -> None:
        """Takes n."""
        super().__init__()
        self.power = check.integer("Power", "power", power, low=2, high=64)

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        return twin.spherical_power(z, self.power)

    def ranges(self, z: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return twin.power_ranges(z, reach, self.power)


class Fold(Iteration):
    """The Mandelbox's step: folds coordinates beyond -1 and 1 back, inverts small vectors by balls
    of radius 1/2 and 1, and scales the result.
    """

    logarithmic = False

    def __init__(self, scale: float) -> None:
        """Takes the scale; its absolute value must be more than 1."""
        super().__init__()
        self.scale = check.number("Fold", "scale", scale)
        if abs(self.scale) <= 1:
            raise ValueError(f"Fold: scale must be beyond -1 and 1, got {scale!r}")

    @property
    def side(self) -> float:
        """Half the side of the cube that holds all orbits that never escape: 2 (s + 1) / (s - 1)
        for scales s above 1, 2 for scales below -1.
        """
        return 2 * (self.scale + 1) / (self.scale - 1) if self.scale > 1 else 2.0

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        return twin.fold(z, self.scale)

    def ranges(self, z: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return twin.fold_ranges(z, reach, self.scale)


class OrbitSettings(TypedDict, total=False):
    """The keyword arguments of `Fractal` but `constant`, for constructors that pass them on."""

    iterations: int
    bailout: float
    colors: Sequence[Color]


class FractalSettings(OrbitSettings, total=False):
    """All keyword arguments of `Fractal`."""

    constant: Sequence[float] | None


class Fractal(Distance):
    """The points that do not escape; see the head of the file. Outside, the value is the distance
    estimate; inside, where there is none, -1.
    """

    exact = True  # used as if the estimate were exact
    smooth = False
    colors_33: Tensor

    def __init__(
        self,
        iteration: Iteration,
        *,
        constant: Sequence[float] | None = None,
        iterations: int = 12,
        bailout: float = 2.0,
        colors: Sequence[Color] = ((0.95, 0.75, 0.4), (0.75, 0.25, 0.15), (0.12, 0.2, 0.35)),
    ) -> None:
        """Sets the iteration and the look.

        Args:
            iteration: f.
            constant: c, for a Julia set; left out: the point itself, for a Mandelbrot set.
            iterations: Number of steps after which a point that has not escaped is inside. A step
                that stretches distances by 8 resolves details of 8^-iterations.
            bailout: An orbit has escaped when it is this far from the origin.
            colors: Three linear colours: of orbits that come near to the origin, near to a plane
                of two axes, and to neither.
        """
        super().__init__()
        context = type(self).__name__
        self.iteration = check.instance(context, "iteration", iteration, Iteration)
        self.iterations = check.integer(context, "iterations", iterations, low=1, high=1000)
        self.bailout = self.number("bailout", bailout, low=1, open_low=True)
        self.julia = constant is not None
        self.constant = self.vector("constant", (0.0, 0.0, 0.0) if constant is None else constant)
        self.register_buffer("colors_33", checked_colors(context, "colors", colors, (3, 3)))

    def forward(self, points: Tensor) -> Tensor:
        return self._orbits(points)[0]

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        value, origin_distance, plane_distance = self._orbits(points)
        origin_color, plane_color, base_color = self.colors_33.to(points)
        near_plane = (1 - plane_distance[..., None]).clamp(0, 1) ** 4
        near_origin = (1.2 - origin_distance[..., None]).clamp(0, 1) ** 2
        color = torch.lerp(base_color, plane_color, near_plane)
        return value, torch.lerp(color, origin_color, near_origin)

    def _orbits(self, points: Tensor) -> Tensor:
        """Returns (3, ...) distances, and least distances of orbits to origin and axis planes."""
        point = points.reshape(-1, 3).contiguous()
        orbit = self._orbit(point)
        if orbit is None:
            result = twin.orbits(point, self._twin_orbit(point))
        else:
            result = ops.orbits(point, orbit)
        return result.view(3, *points.shape[:-1])

    def _orbit(self, like: Tensor) -> ops.Orbit | None:
        """Returns the arguments of the ops, in the dtype of `like`; None for user-defined steps."""
        step, tensors = self.iteration, (self.constant.to(like), self.bailout.to(like).view(1))
        if type(step) is Power:
            return ops.Orbit(*tensors, "power", step.power, self.iterations, self.julia)
        if type(step) is Fold:
            return ops.Orbit(*tensors, "fold", step.scale, self.iterations, self.julia)
        return None

    def _twin_orbit(self, like: Tensor) -> twin.TwinOrbit:
        """Returns the arguments of the torch twin, which follows any step."""
        return twin.TwinOrbit(
            self.iteration,
            self.iteration.ranges,
            self.constant.to(like) if self.julia else None,
            self.bailout.to(like),
            self.iterations,
            self.iteration.logarithmic,
        )

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        """Returns a huge slope: the value jumps where an orbit takes one more step."""
        return torch.full_like(center[:, 0], 1e30)

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Follows the orbits of whole boxes, in parts; see the head of the file."""
        middle, half_part = parts_of(center, half, _PARTS)
        orbit, reach = self._orbit(middle), length(half_part)
        if orbit is None:
            low, high = twin.orbit_bounds(middle, reach, self._twin_orbit(middle))
        else:
            low, high = ops.orbit_bounds(middle, reach, orbit)
        return joined((low, high), _PARTS)

    def level_box(self, level: Tensor | float) -> Tensor | None:
        return grown(self.box(), level / _LEAST_ESTIMATE)

    def colors(self, center: Tensor, half: Tensor) -> Interval:
        """Returns the smallest and largest red, green and blue of the three colours."""
        ends = self.colors_33.to(center)
        return ends.amin(0).expand_as(center), ends.amax(0).expand_as(center)

    def _escape_radius(self, radius: float, growth: float, gain: float = 0.0) -> float:
        """Returns the radius beyond which all orbits escape within `iterations`, given one beyond
        which they escape at last: each step multiplies an orbit's distance beyond that by at least
        `growth`, and adds at least `gain`. What float32 can't resolve is left out.
        """
        first_step = max(0.0, float(self.bailout) - radius) * growth ** (1 - self.iterations)
        excess = (first_step - gain) / growth
        return radius + excess if excess > radius * torch.finfo(torch.float32).eps else radius

    def _cube(self, half_side: float) -> Tensor:
        """Returns the box (2, 3) of a cube around the origin."""
        device = self.colors_33.device
        ends = torch.tensor((-half_side, half_side), dtype=torch.float64, device=device)
        return ends[:, None].expand(2, 3)


class Mandelbulb(Fractal):
    """z^n + c in three dimensions: White and Nylander's bulb."""

    def __init__(self, power: int = 8, **settings: Unpack[FractalSettings]) -> None:
        """Takes n and the arguments of `Fractal`."""
        super().__init__(Power(power), **settings)

    def box(self) -> Tensor:
        """Returns a cube of half side R = 2^(1 / (n - 1)), a little enlarged for orbits that have
        not escaped after `iterations`: from |z| = R + d, at most as far out as c is, |z^n + c| is
        at least |z|^n - |c| >= R^n + n R^(n-1) d - |c| >= R + (2 n - 1) d.
        """
        power = self.iteration.power
        assert isinstance(power, int)
        return self._cube(self._escape_radius(2.0 ** (1 / (power - 1)), 2 * power - 1))


class Julia(Fractal):
    """z^n + a constant, in three dimensions."""

    def __init__(
        self,
        constant: Sequence[float] = (-0.55, 0.3, -0.25),
        power: int = 2,
        **settings: Unpack[OrbitSettings],
    ) -> None:
        """Takes the constant, at most 10^20 long, n, and the arguments of `Fractal`."""
        super().__init__(Power(power), constant=constant, **settings)
        check.number("Julia", "length of the constant", self.constant.norm(), high=1e20)

    def box(self) -> Tensor:
        """Returns a cube of half side R >= 1 with R^n - |c| > R: all points beyond R escape. It is
        a little enlarged for those that have not escaped after `iterations`: from |z| = R + d,
        |z^n + c| is at least R^n + n R^(n-1) d - |c|.
        """
        power = self.iteration.power
        assert isinstance(power, int)
        constant_norm = float(self.constant.norm())
        radius = max(1.0, math.floor(constant_norm ** (1 / power)))  # not yet large enough
        while radius**power - constant_norm <= radius:
            radius += 1 / 64
        growth, gain = power * radius ** (power - 1), radius**power - constant_norm - radius
        return self._cube(self._escape_radius(radius, growth, gain))


class Mandelbox(Fractal):
    """Lowe's box: each step folds, inverts, scales and translates."""

    def __init__(self, scale: float = 2.0, **settings: Unpack[FractalSettings]) -> None:
        """Takes the scale, below -1 or above 1, and the arguments of `Fractal`."""
        step = Fold(scale)
        settings.setdefault("bailout", 1.8 * step.side)  # corners are sqrt(3) = 1.73 `side` away
        super().__init__(step, **settings)
        self._side = step.side + 2 * float(self.bailout) * abs(step.scale) ** -self.iterations

    def box(self) -> Tensor:
        """Returns the cube that holds all orbits that never escape, a little enlarged for those
        that have not escaped after `iterations`: each step multiplies an orbit's distance beyond
        the cube by |scale|.
        """
        return self._cube(self._side)
