"""The records of tensors that the steps of a frame hand to each other."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Rays:
    """Rays in world units, all float32 or all float64 on one device."""

    origin: Tensor  # (r, 3)
    direction: Tensor  # (r, 3), unit length
    cone: Tensor  # (r, 2) width at the origin, growth of the width per unit distance
    range: Tensor  # (r, 2) first and last distance along the ray; +inf is allowed for the last


@dataclass(frozen=True, kw_only=True)
class Hits:
    """What the rays brought back."""

    color: Tensor  # (r, 3) linear RGB, premultiplied by alpha
    alpha: Tensor  # (r, 1)
    depth: Tensor  # (r, 1) distance along the ray in world units, +inf where nothing was hit
    samples: Tensor  # (r,) int32, places at which the shader was evaluated
