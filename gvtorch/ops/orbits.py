"""`orbits` and `orbit_bounds`: escape-time fractals, as distances at points and over balls."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from ..base import check
from .reference import orbits as twin
from .registry import Backend, choose_backend

KINDS = ("power", "fold")  # z^n, and the Mandelbox's step


def orbits(
    point_p3: Tensor,
    constant_3: Tensor,
    bailout_1: Tensor,
    kind: str,
    amount: float,
    iterations: int,
    julia: bool = False,
    backend: Backend = "auto",
) -> Tensor:
    """Follows the orbits z -> f(z) + c of points, until they are further than `bailout_1` from the
    origin.

    On all backends and devices every bit is the same. Where gradients are recorded, the twin is
    evaluated, which torch can differentiate.

    Args:
        point_p3: (p, 3) float32 or float64. NaN gives NaN.
        constant_3: (3,) c, if `julia`.
        bailout_1: (1,) more than 1.
        kind: f: power, z^n in spherical coordinates, or fold, the Mandelbox's step.
        amount: n, or the Mandelbox's scale.
        iterations: Most steps.
        julia: Whether c is `constant_3`; else it is each point itself.
        backend: auto, reference, cpp or cuda.

    Returns:
        (3, p) of the same dtype: a distance, as the orbit tells it (-1 where it does not escape),
        and how near it came to the origin, and to the nearest plane of two axes.

    Raises:
        ValueError: A tensor of the wrong shape or dtype, or a number out of its range.
    """
    fields = [("point_p3", point_p3, "p3")]
    _check("orbits", fields, constant_3, bailout_1, kind, amount, iterations)
    given = (point_p3, constant_3, bailout_1)
    learns = torch.is_grad_enabled() and any(one.requires_grad for one in given)
    if _chosen(backend, point_p3) == "reference" or (learns and backend == "auto"):
        return twin.orbits(point_p3, _way(constant_3, bailout_1, kind, amount, iterations, julia))
    numbers = (KINDS.index(kind), float(amount), iterations, julia)
    return torch.ops.gvtorch.orbits(*given, *numbers)


def orbit_bounds(
    center_k3: Tensor,
    reach_k: Tensor,
    constant_3: Tensor,
    bailout_1: Tensor,
    kind: str,
    amount: float,
    iterations: int,
    julia: bool = False,
    backend: Backend = "auto",
) -> Tensor:
    """Follows balls of points, with middles (k, 3) and radii (k,); see `orbits`.

    Returns:
        (2, k): no distance that `orbits` gives for a point of a ball is less than the first, or
        more than the second. (-1, inf) where nothing is known.

    Raises:
        ValueError: See `orbits`.
    """
    fields = [("center_k3", center_k3, "k3"), ("reach_k", reach_k, "k")]
    _check("orbit_bounds", fields, constant_3, bailout_1, kind, amount, iterations)
    if _chosen(backend, center_k3) == "reference":
        way = _way(constant_3, bailout_1, kind, amount, iterations, julia)
        return twin.orbit_bounds(center_k3, reach_k, way)
    numbers = (KINDS.index(kind), float(amount), iterations, julia)
    return torch.ops.gvtorch.orbit_bounds(center_k3, reach_k, constant_3, bailout_1, *numbers)


def _check(
    where: str,
    tensors: list[tuple[str, Tensor, str]],
    constant_3: Tensor,
    bailout_1: Tensor,
    kind: str,
    amount: float,
    iterations: int,
) -> None:
    """ValueError unless all are of one dtype, on one device, and in their range."""
    name, first, _ = tensors[0]
    if first.dtype not in (torch.float32, torch.float64):
        got = check.describe(first)
        raise ValueError(f"{where}: {name} must be float32 or float64, got {got}")
    both = [*tensors, ("constant_3", constant_3, "3"), ("bailout_1", bailout_1, "1")]
    check.tensors(where, first.device, [(*one, first.dtype) for one in both])
    if kind not in KINDS:
        raise ValueError(f"{where}: kind must be one of {KINDS}, got {kind!r}")
    if kind == "power":
        check.whole(where, "amount", amount, low=2, high=64)
    else:
        check.number(where, "amount", amount)
    check.whole(where, "iterations", iterations, low=1, high=1000)


def _chosen(backend: str, like: Tensor) -> str:
    return choose_backend.__wrapped__(backend, like.device)  # torch.compile warns of caches


def _way(
    constant_3: Tensor,
    bailout_1: Tensor,
    kind: str,
    amount: float,
    iterations: int,
    julia: bool,
) -> twin.Way:
    """What the twin takes."""
    if kind == "power":
        step: twin.Step = partial(twin.power, n=int(amount))
        ranges: twin.Ranges = partial(twin.power_ranges, n=int(amount))
    else:
        step = partial(twin.fold, scale=amount)
        ranges = partial(twin.fold_ranges, scale=amount)
    constant = constant_3 if julia else None
    return twin.Way(step, ranges, constant, bailout_1, iterations, kind == "power")
