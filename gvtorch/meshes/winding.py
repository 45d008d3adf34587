"""`WindingNumber`: the generalised winding number of triangles that need not be closed.

Sources: Jacobson, Kavan, Sorkine-Hornung, "Robust inside-outside segmentation using generalized
    winding numbers", SIGGRAPH 2013; Barill, Dickson, Schmidt, Levin, Jacobson, "Fast winding
    numbers for soups and clouds", SIGGRAPH 2018 (from afar, many triangles act as one dipole, plus
    the next term of its series); Van Oosterom, Strackee, "The solid angle of a plane triangle",
    IEEE Trans. Biomed. Eng. 30, 1983.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..ops.voxelize import ARITY
from .geometry import Hierarchy, padded

_FAR = 3.5  # distance, in radii of a box, beyond which it acts as a dipole: errors are below 1e-3
_PLACES = 1 << 11  # points that are computed together


class WindingNumber:
    """Winding numbers of triangles at any point: whole if closed, 1/2 on a plane hole."""

    def __init__(self, corner_f33: Tensor) -> None:
        """Takes (f, 3, 3) float64 corners, and sums the dipoles of all boxes."""
        self._first = (hierarchy := Hierarchy(corner_f33)).first
        self._corner = corner_f33[hierarchy.order]
        a, b, c = self._corner.unbind(1)
        normal = 0.5 * torch.linalg.cross(b - a, c - a)
        levels = [(normal.norm(dim=1), self._corner.mean(1), normal)]
        for _ in self._first[2:]:
            area, middle, normal = levels[-1]
            spare = -len(area) % ARITY
            area = torch.cat((area, area.new_zeros(spare))).view(-1, ARITY, 1)
            middle = padded(middle).view(-1, ARITY, 3)
            weight = area.clamp(min=1e-300)  # for boxes without area, any middle inside will do
            middle = (weight * middle).sum(1) / weight.sum(1)
            normal = torch.cat((normal, normal.new_zeros(spare, 3))).view(-1, ARITY, 3).sum(1)
            levels.append((area.sum((1, 2)), middle, normal))
        self._middle = torch.cat([level[1] for level in levels])
        self._normal = torch.cat([level[2] for level in levels])
        low, high = hierarchy.box.split(3, 1)
        away = torch.maximum(self._middle - low, high - self._middle)
        self._radius = away.norm(dim=1)
        self._second = torch.cat(self._moments(len(levels)))

    def _moments(self, levels: int) -> list[Tensor]:
        """Returns for each level (n, 3, 3): sums over a box's triangles of the outer products of
        (triangle's middle - box's middle) and the triangle's normal.
        """
        found = [self._corner.new_zeros(len(self._corner), 3, 3)]
        for number in range(1, levels):
            below = slice(self._first[number - 1], self._first[number])
            own = slice(self._first[number], self._first[number + 1])
            above = torch.arange(below.stop - below.start, device=self._corner.device) // ARITY
            shift = self._middle[below] - self._middle[own][above]
            moved = found[-1] + shift[:, :, None] * self._normal[below][:, None]
            sums = moved.new_zeros(own.stop - own.start, 3, 3)
            found.append(sums.index_add_(0, above, moved))
        return found

    def __call__(self, place_p3: Tensor) -> Tensor:
        """Returns (p,) float64 winding numbers at points (p, 3) float64."""
        return torch.cat([self._at(place) for place in place_p3.split(_PLACES)])

    def _at(self, place_p3: Tensor) -> Tensor:
        total = torch.zeros_like(place_p3[:, 0])
        top = self._first[-1] - self._first[-2]
        which = torch.arange(len(place_p3), device=total.device).repeat_interleave(top)
        box = torch.arange(top, device=total.device).repeat(len(place_p3))
        for level in range(len(self._first) - 2, 0, -1):
            own = box + self._first[level]
            toward = self._middle[own] - place_p3[which]
            distance = toward.norm(dim=1)
            far = distance > _FAR * self._radius[own]
            total.index_add_(0, which[far], self._dipole(own[far], toward[far], distance[far]))
            below = torch.arange(ARITY, device=total.device)
            box = (box[~far, None] * ARITY + below).view(-1)
            which = which[~far].repeat_interleave(ARITY)
            there = box < self._first[level] - self._first[level - 1]
            which, box = which[there], box[there]
        return total.index_add_(0, which, _turn(self._corner[box] - place_p3[which, None]))

    def _dipole(self, box: Tensor, toward: Tensor, distance: Tensor) -> Tensor:
        """Returns (m,) what far boxes add: the first two terms of the series at their middles."""
        first = (self._normal[box] * toward).sum(1) / distance**3
        second = self._second[box]
        trace = second.diagonal(dim1=1, dim2=2).sum(1)
        along = torch.einsum("mi,mij,mj->m", toward, second, toward)
        return (first + trace / distance**3 - 3 * along / distance**5) / (4 * math.pi)


def _turn(corner_m33: Tensor) -> Tensor:
    """Returns (m,) the signed solid angle of triangles seen from the origin, over 4 pi."""
    a, b, c = corner_m33.unbind(1)
    la, lb, lc = (one.norm(dim=1) for one in (a, b, c))
    above = (a * torch.linalg.cross(b, c)).sum(1)
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return torch.atan2(above, below) / (2 * math.pi)
