"""Where rays enter and leave boxes, and convex sets that are given by their faces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..base.records import Rays

Face = tuple[float, ...]  # unit normal and offset (a, b, c, d): inside, a x + b y + c z + d >= 0


def box_span(low: Tensor, high: Tensor, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Returns (r,) first and last distance of lines inside a box; last < first where they pass by.

    Args:
        low: (3,) corner.
        high: (3,) corner.
        origin: (r, 3).
        direction: (r, 3).
    """
    a, b = (low - origin) / direction, (high - origin) / direction
    # 0 / 0: the line lies in a face, and no other place on it lies farther out.
    first = torch.minimum(a, b).nan_to_num(-torch.inf, torch.inf, -torch.inf)
    last = torch.maximum(a, b).nan_to_num(torch.inf, torch.inf, -torch.inf)
    return first.amax(1), last.amin(1)


def tree_span(place_33: Tensor, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Returns `box_span` of the box of a tree, given `N3Tree.place`."""
    low, size, high = place_33
    return box_span(low, low + size * high, origin, direction)


def convex_span(
    faces: Sequence[Face], rays: Rays, first: Tensor, last: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns (r,) distances between which rays lie inside all faces, cut out of [first, last];
    last < first where they pass by. float64; numbers stay on the host, so nothing waits for it.
    """
    for face in faces:
        height, rate = height_over(face, rays)
        t = -height / rate
        first = torch.where(rate > 0, torch.maximum(first, t), first)
        last = torch.where(rate < 0, torch.minimum(last, t), last)
        last = torch.where((rate == 0) & (height < 0), -torch.inf, last)
    return first, last


def height_over(face: Face, rays: Rays) -> tuple[Tensor, Tensor]:
    """Returns (r,) how far each ray's origin lies inside of a face, and by how much that grows per
    unit distance.
    """
    *normal, offset = face
    height = dot(normal, rays.origin.to(torch.float64).unbind(1)) + offset
    return height, dot(normal, rays.direction.to(torch.float64).unbind(1))


def dot(normal: Sequence[float], vector: Sequence[Any]) -> Any:
    """Returns the dot product with a vector of three numbers or three (r,) columns."""
    x, y, z = vector
    return normal[0] * x + normal[1] * y + normal[2] * z
