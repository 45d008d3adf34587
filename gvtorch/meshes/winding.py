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

#: Distance in radii of a box from which it acts as a dipole; errors are below 1e-3 on average.
_FAR_RADII = 3.5
_BATCH_POINTS = 1 << 11  # points that are computed together


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
            missing = -len(area) % ARITY
            area = torch.cat((area, area.new_zeros(missing))).view(-1, ARITY, 1)
            middle = padded(middle).view(-1, ARITY, 3)
            weight = area.clamp(min=1e-300)  # for boxes without area, any middle inside will do
            middle = (weight * middle).sum(1) / weight.sum(1)
            normal = torch.cat((normal, normal.new_zeros(missing, 3))).view(-1, ARITY, 3).sum(1)
            levels.append((area.sum((1, 2)), middle, normal))
        self._middle = torch.cat([level[1] for level in levels])
        self._normal = torch.cat([level[2] for level in levels])
        low, high = hierarchy.box.split(3, 1)
        farthest = torch.maximum(self._middle - low, high - self._middle)
        self._radius = farthest.norm(dim=1)
        self._moment = torch.cat(self._moments(len(levels)))

    def _moments(self, levels: int) -> list[Tensor]:
        """Returns for each level (n, 3, 3): sums over a box's triangles of the outer products of
        (triangle's middle - box's middle) and the triangle's normal.
        """
        moments = [self._corner.new_zeros(len(self._corner), 3, 3)]
        for level in range(1, levels):
            below = slice(self._first[level - 1], self._first[level])
            boxes = slice(self._first[level], self._first[level + 1])
            parent = torch.arange(below.stop - below.start, device=self._corner.device) // ARITY
            shift = self._middle[below] - self._middle[boxes][parent]
            moved = moments[-1] + shift[:, :, None] * self._normal[below][:, None]
            sums = moved.new_zeros(boxes.stop - boxes.start, 3, 3)
            moments.append(sums.index_add_(0, parent, moved))
        return moments

    def __call__(self, point_p3: Tensor) -> Tensor:
        """Returns (p,) float64 winding numbers at points (p, 3) float64."""
        return torch.cat([self._compute(point) for point in point_p3.split(_BATCH_POINTS)])

    def _compute(self, point_p3: Tensor) -> Tensor:
        total = torch.zeros_like(point_p3[:, 0])
        top = self._first[-1] - self._first[-2]
        point = torch.arange(len(point_p3), device=total.device).repeat_interleave(top)
        box = torch.arange(top, device=total.device).repeat(len(point_p3))
        for level in range(len(self._first) - 2, 0, -1):
            box_index = box + self._first[level]
            toward = self._middle[box_index] - point_p3[point]
            distance = toward.norm(dim=1)
            far = distance > _FAR_RADII * self._radius[box_index]
            dipole = self._dipole(box_index[far], toward[far], distance[far])
            total.index_add_(0, point[far], dipole)
            child = torch.arange(ARITY, device=total.device)
            box = (box[~far, None] * ARITY + child).view(-1)
            point = point[~far].repeat_interleave(ARITY)
            exists = box < self._first[level] - self._first[level - 1]
            point, box = point[exists], box[exists]
        return total.index_add_(0, point, _solid_angle(self._corner[box] - point_p3[point, None]))

    def _dipole(self, box: Tensor, toward: Tensor, distance: Tensor) -> Tensor:
        """Returns (m,) what far boxes add: the first two terms of the series at their middles."""
        first = (self._normal[box] * toward).sum(1) / distance**3
        moment = self._moment[box]
        trace = moment.diagonal(dim1=1, dim2=2).sum(1)
        along = torch.einsum("mi,mij,mj->m", toward, moment, toward)
        return (first + trace / distance**3 - 3 * along / distance**5) / (4 * math.pi)


def _solid_angle(corner_m33: Tensor) -> Tensor:
    """Returns (m,) the signed solid angle of triangles seen from the origin, over 4 pi."""
    a, b, c = corner_m33.unbind(1)
    la, lb, lc = (vector.norm(dim=1) for vector in (a, b, c))
    numerator = (a * torch.linalg.cross(b, c)).sum(1)
    denominator = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return torch.atan2(numerator, denominator) / (2 * math.pi)
