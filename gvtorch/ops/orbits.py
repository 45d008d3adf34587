"""`orbits` and `orbit_bounds`: escape-time fractals, as distances at points and over balls."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from ..base import check
from .reference import orbits as twin
from .registry import Backend, choose_backend, fake_of, runs_twin

KINDS = ("power", "fold")


class Orbit(NamedTuple):
    """The iteration z -> f(z) + c of a fractal, and when it ends."""

    constant_3: Tensor  # (3,) c, if `julia`; in the points' dtype, as is `bailout_1`
    bailout_1: Tensor  # (1,) above 1: an orbit escapes beyond this distance from the origin
    kind: Literal["power", "fold"]  # f: z^n in spherical coordinates, or the Mandelbox's step
    amount: float  # n, or the Mandelbox's scale
    iterations: int  # largest number of steps
    julia: bool = False  # whether c is `constant_3`; else it is each point itself

    def check(self, context: str, like: Tensor, fields: list[tuple[str, Tensor, str]]) -> None:
        """Raises ValueError unless all tensors have the dtype and device of `like` and their
        shapes, and numbers are in range. `fields`: name, tensor and shape of each other argument.
        """
        check.instance(context, fields[0][0], like, Tensor)
        if like.dtype not in (torch.float32, torch.float64):
            got = check.describe(like)
            raise ValueError(f"{context}: {fields[0][0]} must be float32 or float64, got {got}")
        own_fields = [("constant_3", self.constant_3, "3"), ("bailout_1", self.bailout_1, "1")]
        typed_fields = [(*field, like.dtype) for field in fields + own_fields]
        check.tensors(context, like.device, typed_fields)
        check.one_of(context, "kind", self.kind, KINDS)
        if self.kind == "power":
            check.integer(context, "amount", self.amount, low=2, high=64)
        else:
            check.number(context, "amount", self.amount)
        check.integer(context, "iterations", self.iterations, low=1, high=1000)

    def arguments(self) -> tuple[Any, ...]:
        """Returns the arguments of the compiled ops that come after the points or balls."""
        kind_index = KINDS.index(self.kind)
        return (*self[:2], kind_index, float(self.amount), self.iterations, self.julia)

    def twin_orbit(self) -> twin.TwinOrbit:
        """Returns this iteration in the form that the twin takes."""
        if self.kind == "power":
            step: twin.Step = partial(twin.spherical_power, n=int(self.amount))
            ranges: twin.Ranges = partial(twin.power_ranges, n=int(self.amount))
        else:
            step = partial(twin.fold, scale=self.amount)
            ranges = partial(twin.fold_ranges, scale=self.amount)
        constant, logarithmic = self.constant_3 if self.julia else None, self.kind == "power"
        return twin.TwinOrbit(step, ranges, constant, self.bailout_1, self.iterations, logarithmic)


def orbits(point_p3: Tensor, orbit: Orbit, backend: Backend = "auto") -> Tensor:
    """Follows the orbits of points until they escape.

    On all backends and devices every bit is the same. Where gradients are recorded, `auto` runs the
    twin, which torch can differentiate.

    Args:
        point_p3: (p, 3) float32 or float64, contiguous. NaN gives NaN.
        orbit: The iteration.
        backend: auto, reference, cpp or cuda.

    Returns:
        (3, p) of the same dtype: an estimate of the distance to the fractal (-1 where the orbit
        does not escape), and the orbit's least distances to the origin and to a coordinate plane.

    Raises:
        ValueError: A tensor of the wrong shape or dtype, or a number out of its range.
    """
    orbit.check("orbits", point_p3, [("point_p3", point_p3, "p3")])
    if runs_twin(backend, point_p3, orbit.constant_3, orbit.bailout_1):
        return twin.orbits(point_p3, orbit.twin_orbit())
    return torch.ops.gvtorch.orbits(point_p3, *orbit.arguments())


def orbit_bounds(
    center_k3: Tensor, reach_k: Tensor, orbit: Orbit, backend: Backend = "auto"
) -> Tensor:
    """Bounds the distances that `orbits` returns over balls of centres (k, 3) and radii (k,).

    Returns:
        (2, k): lower and upper bounds of all distances in a ball; (-1, inf) if nothing is known.

    Raises:
        ValueError: See `orbits`.
    """
    fields = [("center_k3", center_k3, "k3"), ("reach_k", reach_k, "k")]
    orbit.check("orbit_bounds", center_k3, fields)
    if choose_backend(backend, center_k3.device) == "reference":
        return twin.orbit_bounds(center_k3, reach_k, orbit.twin_orbit())
    return torch.ops.gvtorch.orbit_bounds(center_k3, reach_k, *orbit.arguments())


@fake_of("orbits", gradients=False)
def _fake_distances(*, point_p3: Tensor, **_: Any) -> Tensor:
    return point_p3.new_empty((3, point_p3.shape[0]))


@fake_of("orbit_bounds", gradients=False)
def _fake_bounds(*, center_k3: Tensor, **_: Any) -> Tensor:
    return center_k3.new_empty((2, center_k3.shape[0]))
