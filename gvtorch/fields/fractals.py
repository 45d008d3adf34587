"""Escape-time fractals as distance fields: `Mandelbulb`, `Julia`, `Mandelbox`, or any by its own
`Iteration`, with a colour by orbit traps.

A point z runs through z -> f(z) + c again and again. Those that stay within `bailout` are the
fractal. Of those that escape, a distance is estimated from how fast neighbours part.

**What is proven.** The estimate is no bound: for the bulb, whose map stretches more along circles
of latitude than the number that is used for all directions, it is more than 30 times too large in
places next to the axis. So intervals do not trust it. They follow the middle of a box, and a radius
around it that holds the orbits of all points of the box (`Iteration.ranges` bounds how much the map
stretches there). That bounds where and when they escape, and so the very number that `forward`
gives, whatever it means.

Sources: White, Nylander, "The Mandelbulb", 2009 (z^n in spherical coordinates); Lowe, "Mandelbox",
    2010; Hart, Sandin, Kauffman, "Ray tracing deterministic 3-D fractals", SIGGRAPH 1989 (distance
    estimates of escape-time fractals); Pickover, "Computers, pattern, chaos, and beauty", 1990
    (orbit traps).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..base import check
from .distance import Color, Distance
from .field import Interval, joined, length, parts_of

_PARTS = 2  # of a box along each axis: more cost as much as the bricks that they save
_FAR = 1e3  # a box's orbits that get so far apart tell nothing any more
_INSIDE = 1.0  # world units that the fractal's inside is told to be deep: no estimate is known


class Iteration(nn.Module):
    """One step of an orbit, without the constant that is added. Points are (3, ...)."""

    logarithmic: bool = True  # |z| grows as a power; else by a factor
    rounds_alike: bool = False  # it takes + - * /, roots and comparisons alone

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Returns f(z) and (...,) how far it takes neighbours apart, by unit of their distance."""
        raise NotImplementedError(f"{type(self).__name__}: forward is not written")

    def ranges(self, z: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns what holds in balls around z (3, k) of radii `reach` (k,): the most that f takes
        points apart, by unit of their distance, and the smallest and largest of `forward`'s second
        answers, (k,) each. Unless overridden, nothing is known, so nothing is proven.
        """
        return torch.full_like(reach, math.inf), torch.zeros_like(reach), reach + math.inf


class Power(Iteration):
    """z^n in spherical coordinates: |z|^n, and both angles n times."""

    rounds_alike = True

    def __init__(self, power: int) -> None:
        """Takes n."""
        super().__init__()
        self.power = check.whole("Power", "power", power, low=2, high=64)

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Two complex powers: of z + i rho, whose angle is that from the axis, and of the direction
        (x + i y) / rho; rho is the distance from the axis.
        """
        x, y, up = z.unbind(0)
        away = (x * x + y * y).clamp(min=1e-30).sqrt()
        radius = (away * away + up * up).sqrt()
        cosine, sine = _power(x / away, y / away, self.power)
        height, width = _power(up, away, self.power)
        raised = torch.stack((width * cosine, width * sine, height))
        return raised, self.power * _product(radius, self.power - 1)

    def ranges(self, z: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Along radius and meridian n r^(n-1), along the circle of latitude that times
        |sin(n angle) / sin(angle)|, which is at most n. The angle, which is that from the axis,
        changes by at most asin(reach / r) in a ball.
        """
        n, radius, away = self.power, z.norm(dim=0), z[:2].norm(dim=0)
        least, most = (radius - reach).clamp(min=0), radius + reach
        sine = (away - reach).clamp(min=0) / most.clamp(min=1e-30)
        change = (reach / radius.clamp(min=1e-30)).clamp(max=1).asin()
        turned = (n * torch.atan2(away, z[2])).sin().abs() + n * change
        turn = (turned.clamp(max=1) / sine.clamp(min=1 / n)).clamp(min=1, max=n)
        low, high = n * least ** (n - 1), n * most ** (n - 1)
        return high * turn, low, high


class Fold(Iteration):
    """The Mandelbox's step: coordinates beyond 1 are folded back, small vectors inverted in balls
    of radius 1/2 and 1, and all is scaled.
    """

    logarithmic, rounds_alike = False, True

    def __init__(self, scale: float) -> None:
        """Takes the scale; its size must be more than 1."""
        super().__init__()
        self.scale = check.number("Fold", "scale", scale)
        if abs(self.scale) <= 1:
            raise ValueError(f"Fold: scale must be beyond -1 and 1, got {scale!r}")

    @property
    def side(self) -> float:
        """Half of a side of the cube in which orbits stay that never escape: 2 (s + 1) / (s - 1)
        for scales s above 1, 2 below -1.
        """
        return 2 * (self.scale + 1) / (self.scale - 1) if self.scale > 1 else 2.0

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        folded = 2 * z.clamp(-1, 1) - z
        grown = 1 / _squared(folded).clamp(0.25, 1.0)
        return folded * (grown * self.scale), grown * abs(self.scale)

    def ranges(self, z: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The fold takes nothing apart, inversion at most by 1 / r^2."""
        radius = (2 * z.clamp(-1, 1) - z).norm(dim=0)
        near = (radius - reach).clamp(0.5, 1.0)
        far = (radius + reach).clamp(0.5, 1.0)
        high = abs(self.scale) / (near * near)
        return high, abs(self.scale) / (far * far), high


class Fractal(Distance):
    """What does not escape; see the head of the file. Outside the value is the estimate, inside -1:
    there is none.
    """

    exact = True  # as far as an estimate is
    smooth = False
    constant: Tensor
    bailout: Tensor
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
        """Takes the step and what is added.

        Args:
            iteration: f.
            constant: c, for a Julia set; left out: the point itself, for a Mandelbrot set.
            iterations: After so many steps a point that has not escaped is inside. One that takes
                neighbours apart by 8 resolves details of 8^-iterations.
            bailout: What gets so far from the origin escapes.
            colors: Three linear colours: of orbits that come near to the origin, near to a plane
                of two axes, and to neither.
        """
        super().__init__()
        where = type(self).__name__
        self.iteration = check.instance(where, "iteration", iteration, Iteration)
        self.iterations = check.whole(where, "iterations", iterations, low=1, high=1000)
        self.number("bailout", bailout, low=1, open_low=True)
        self.julia = constant is not None
        self.vector("constant", constant or (0.0, 0.0, 0.0))
        if len(colors) != 3:
            raise ValueError(f"{where}: colors must be three colours, got {len(colors)}")
        self.register_buffer("colors_33", check.reals(where, "colors", colors, (3, 3)).clamp(0, 1))

    def forward(self, points: Tensor) -> Tensor:
        return self._orbit(points, traps=False)[0]

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        value, near, plane = self._orbit(points, traps=True)
        one, two, three = self.colors_33.to(points)
        color = torch.lerp(three, two, (1 - plane[..., None]).clamp(0, 1) ** 4)
        return value, torch.lerp(color, one, (1.2 - near[..., None]).clamp(0, 1) ** 2)

    def _orbit(self, points: Tensor, traps: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Distance, and how near the orbit came to the origin and to a plane of two axes, (...,)
        each.
        """
        z = points.movedim(-1, 0).reshape(3, -1).contiguous()
        constant = self.constant.to(z)[:, None] if self.julia else z
        radius = length(points).flatten()
        state = [torch.ones_like(radius), radius, *([radius, z.abs().amin(0)] if traps else [])]
        whole, rows = state, None
        looks = points.device.type == "cpu" and self.iteration.rounds_alike
        looks = looks and not (points.requires_grad or torch.compiler.is_compiling())
        for _ in range(self.iterations):
            alive = state[1] <= self.bailout
            if looks and 4 * int(alive.sum()) < 3 * len(alive):  # go on with those that are
                kept, whole = alive.nonzero()[:, 0], _with(whole, rows, state)
                rows = kept if rows is None else rows[kept]
                z, constant = z[:, kept], constant if self.julia else constant[:, kept]
                state, alive = [one[kept] for one in state], alive[kept]
            z, state = self._step(z, constant, alive, state)
        lead = points.shape[:-1]
        apart, radius, *trapped = (one.view(lead) for one in _with(whole, rows, state))
        found = torch.where(radius <= self.bailout, -_INSIDE, self._estimate(radius, apart))
        near, plane = trapped or (radius, radius)
        return found, near, plane

    def _step(
        self, z: Tensor, constant: Tensor, alive: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, list[Tensor]]:
        """One step of those that are alive: z, how far neighbours are apart, the radius, and what
        traps tell, if there are any.
        """
        after, grown = self.iteration(z)
        z = torch.where(alive, after + constant, z)
        apart = torch.where(alive, grown * state[0] + (0.0 if self.julia else 1.0), state[0])
        radius = _squared(z).sqrt()
        if len(state) == 2:
            return z, [apart, radius]
        near, plane = torch.minimum(state[2], radius), torch.minimum(state[3], z.abs().amin(0))
        return z, [apart, radius, near, plane]

    def _estimate(self, radius: Tensor, apart: Tensor) -> Tensor:
        """A distance, of an orbit that has got to a radius while neighbours came apart."""
        if self.iteration.logarithmic:
            return 0.5 * radius * radius.log() / apart
        return radius / apart

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        """Not known: the value jumps where an orbit takes one more step."""
        return torch.full_like(center[:, 0], 1e30)

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Follows the orbits of whole boxes, in parts; see the head of the file."""
        return joined(self._follow(*parts_of(center, half, _PARTS)), _PARTS)

    def _follow(self, center: Tensor, half: Tensor) -> Interval:
        """Intervals of boxes (k, 3)."""
        z, reach = center.mT.contiguous(), length(half)
        constant = self.constant.to(z)[:, None] if self.julia else z
        low_apart = high_apart = torch.ones_like(reach)
        step, add = (0.0, 0.0) if self.julia else (reach, 1.0)
        low, high = torch.full_like(reach, math.inf), torch.full_like(reach, -math.inf)
        inside = torch.ones_like(reach, dtype=torch.bool)  # whether any point may be, still
        lost = ~inside
        for turn in range(self.iterations + 1):
            radius = z.norm(dim=0)
            least, most = (radius - reach).clamp(min=0), radius + reach
            escaping = inside & (most > self.bailout)
            first = self._estimate(torch.maximum(least, self.bailout), high_apart)
            last = self._estimate(most, low_apart)
            low = torch.where(escaping, torch.minimum(low, first), low)
            high = torch.where(escaping, torch.maximum(high, last), high)
            lost = lost | (inside & ~(reach < _FAR))
            inside = inside & (least <= self.bailout) & ~lost
            if turn == self.iterations:
                break
            stretch, slow, fast = self.iteration.ranges(z, reach)
            after, _ = self.iteration(z)
            z = torch.where(inside, after + constant, z)
            reach = torch.where(inside, stretch * reach + step, reach)
            low_apart, high_apart = slow * low_apart + add, fast * high_apart + add
        low = torch.where(inside, low.clamp(max=-_INSIDE), low)
        high = torch.where(inside, high.clamp(min=-_INSIDE), high)
        return torch.where(lost, -_INSIDE, low), torch.where(lost, math.inf, high)

    def colors(self, center: Tensor, half: Tensor) -> Interval:
        """Between the darkest and the brightest of each."""
        ends = self.colors_33.to(center)
        return ends.amin(0).expand_as(center), ends.amax(0).expand_as(center)


class Mandelbulb(Fractal):
    """z^n + c in three dimensions: White and Nylander's bulb."""

    def __init__(self, power: int = 8, **look: object) -> None:
        """Takes n and what `Fractal` takes."""
        super().__init__(Power(power), **look)  # type: ignore[arg-type]

    def box(self) -> Tensor:
        """Beyond 2^(1 / (n - 1)) all escape: there |z|^n grows by more than |c| takes away."""
        power = self.iteration.power
        assert isinstance(power, int)
        most = 2.0 ** (1 / (power - 1))
        ends = torch.tensor((-most, most), dtype=torch.float64, device=self.colors_33.device)
        return ends[:, None].expand(2, 3)


class Julia(Fractal):
    """z^n + a constant, in three dimensions."""

    def __init__(
        self, constant: Sequence[float] = (-0.55, 0.3, -0.25), power: int = 2, **look: object
    ) -> None:
        """Takes the constant, n, and what `Fractal` takes."""
        super().__init__(Power(power), constant=constant, **look)  # type: ignore[arg-type]

    def box(self) -> Tensor:
        """Beyond a radius R >= 1 with R^n - |c| > R all escape."""
        power = self.iteration.power
        assert isinstance(power, int)
        most, size = 1.0, float(self.constant.norm())
        while most**power - size <= most:
            most += 1 / 64
        ends = torch.tensor((-most, most), dtype=torch.float64, device=self.colors_33.device)
        return ends[:, None].expand(2, 3)


class Mandelbox(Fractal):
    """Lowe's box: folded, inverted, scaled, moved."""

    def __init__(self, scale: float = 2.0, **look: object) -> None:
        """Takes the scale, beyond -1 and 1, and what `Fractal` takes."""
        step = Fold(scale)
        options = {"bailout": 1.8 * step.side, **look}  # the corners are 1.74 sides away
        super().__init__(step, **options)  # type: ignore[arg-type]
        self._side = step.side + 2 * float(self.bailout) / abs(step.scale) ** self.iterations

    def box(self) -> Tensor:
        """Where all orbits stay that never escape, and a little more for those that have not yet:
        what is beyond gets further away by the scale in each step.
        """
        side = torch.tensor((-self._side, self._side), dtype=torch.float64)
        return side.to(self.colors_33.device)[:, None].expand(2, 3)


def _with(whole: list[Tensor], rows: Tensor | None, part: list[Tensor]) -> list[Tensor]:
    """Returns (n,) tensors in which some rows are those of others; None: all are."""
    if rows is None:
        return part
    return [one.index_copy(0, rows, own) for one, own in zip(whole, part, strict=True)]


def _squared(z: Tensor) -> Tensor:
    """Returns (...,) squared lengths of (3, ...) vectors."""
    x, y, up = z.unbind(0)
    return x * x + y * y + up * up


def _product(value: Tensor, n: int) -> Tensor:
    """A number n times itself, n >= 1, by squares and products."""
    if n == 1:
        return value
    root = _product(value, n // 2)
    return root * root * value if n % 2 else root * root


def _power(real: Tensor, imaginary: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """The n-th power of complex numbers, by squares and products."""
    if n == 1:
        return real, imaginary
    a, b = _power(real, imaginary, n // 2)
    a, b = (a - b) * (a + b), 2 * a * b
    return (a * real - b * imaginary, a * imaginary + b * real) if n % 2 else (a, b)
