"""`Hierarchy`: boxes around triangles, level by level, as flat tensors; and the lists of triangles
near boxes that are found in it, many boxes at a time.

Source: Karras, "Maximizing parallelism in the construction of BVHs", HPG 2012 (triangles sorted
    along a Morton curve; here every box holds eight of the level below, so no pointers are needed).
"""

from __future__ import annotations

import torch
from torch import Tensor

ARITY = 8
_BITS = 20  # of a Morton code, along an axis
_PAIRS = 1 << 21  # pairs of box and node that are looked at together
_BOXES = 1 << 13  # boxes that begin together
_MARGIN = 1e-9  # of the mesh's size, by which float64 bounds are taken wider


class Hierarchy:
    """The boxes of triangles, sorted so that neighbours in memory are neighbours in space.

    Attributes:
        order: (f,) int64 the triangle at each place of the lowest level.
        levels: Of each level, lowest first, (n, 3) low and (n, 3) high corners of its boxes; box i
            holds boxes 8 i to 8 i + 7 of the level below.
    """

    def __init__(self, corner_f33: Tensor) -> None:
        """Sorts (f, 3, 3) float64 triangles and makes all levels."""
        low, high = corner_f33.amin(1), corner_f33.amax(1)
        self._corner = corner_f33
        self.order = _morton(0.5 * (low + high)).argsort()
        low, high = low[self.order], high[self.order]
        self._margin = float((high.amax(0) - low.amin(0)).max()) * _MARGIN
        self.levels = [(low, high)]
        while len(low) > ARITY:
            spare = -len(low) % ARITY
            low = torch.cat((low, low[-1:].expand(spare, 3))).view(-1, ARITY, 3).amin(1)
            high = torch.cat((high, high[-1:].expand(spare, 3))).view(-1, ARITY, 3).amax(1)
            self.levels.append((low, high))

    def near(self, low_k3: Tensor, high_k3: Tensor, reach: float) -> tuple[Tensor, Tensor]:
        """Lists for each box the triangles within a reach of it that may be the nearest of some
        place in it. None that is so is left out; some that are not may be in the list.

        Args:
            low_k3: (k, 3) float64 low corners of boxes.
            high_k3: (k, 3) float64 high corners.
            reach: World units.

        Returns:
            first_k (k + 1,) int64: box i has entries first_k[i] to first_k[i + 1] - 1; (m,) int64
            triangles, always in the same order.
        """
        boxes, found = [self.order[:0]], [self.order[:0]]
        for begin in range(0, len(low_k3), _BOXES):
            part = slice(begin, begin + _BOXES)
            box, place = self._search(low_k3[part], high_k3[part], reach)
            boxes.append(box + begin)
            found.append(self.order[place])
        counts = torch.bincount(torch.cat(boxes), minlength=len(low_k3))
        return torch.cat((counts.new_zeros(1), counts.cumsum(0))), torch.cat(found)

    def _search(self, low_k3: Tensor, high_k3: Tensor, reach: float) -> tuple[Tensor, Tensor]:
        """Returns pairs of boxes and places in the lowest level, sorted."""
        center, half = 0.5 * (low_k3 + high_k3), 0.5 * (high_k3 - low_k3)
        radius = half.norm(dim=1)
        # Where a box is small beside the reach, some triangle soon shows that most are too far.
        nearest = reach > 2 * float(radius.max())
        most = torch.full_like(radius, reach)
        if nearest:
            most = torch.minimum(most, self._some_distance(low_k3, high_k3))
        device, top = low_k3.device, len(self.levels[-1][0])
        box = torch.arange(len(low_k3), device=device).repeat_interleave(top)
        node = torch.arange(top, device=device).repeat(len(low_k3))
        for number in range(len(self.levels) - 1, -1, -1):
            if len(box) > _PAIRS and len(low_k3) > 1:  # too many at once: the boxes in two halves
                middle = len(low_k3) // 2
                first = self._search(low_k3[:middle], high_k3[:middle], reach)
                second = self._search(low_k3[middle:], high_k3[middle:], reach)
                return torch.cat((first[0], second[0] + middle)), torch.cat((first[1], second[1]))
            low, high = self.levels[number]
            a, b = low[node], high[node]
            if nearest:  # the node's triangles are no farther than its farthest corner
                far = torch.maximum(b - center[box], center[box] - a).norm(dim=1) + radius[box]
                most.scatter_reduce_(0, box, far, "amin")
            gap = torch.maximum(a - high_k3[box], low_k3[box] - b).clamp_(min=0)
            within = (most * (1 + _MARGIN) + self._margin) ** 2
            kept = ((gap * gap).sum(1) <= within[box]).nonzero()[:, 0]
            box, node = box[kept], node[kept]
            if number:
                below = torch.arange(ARITY, device=device)
                node = (node[:, None] * ARITY + below).view(-1)
                box = box.repeat_interleave(ARITY)
                there = (node < len(self.levels[number - 1][0])).nonzero()[:, 0]
                box, node = box[there], node[there]
        return self._cut_by_plane(box, node, center, half, most + self._margin)

    def _some_distance(self, low_k3: Tensor, high_k3: Tensor) -> Tensor:
        """Returns (k,) how far a triangle is at most from any place of each box: one that is found
        by going down to whatever node seems nearest.
        """
        center, radius = 0.5 * (low_k3 + high_k3), 0.5 * (high_k3 - low_k3).norm(dim=1)
        best = torch.zeros(len(low_k3), dtype=torch.int64, device=low_k3.device)
        for number in range(len(self.levels) - 1, -1, -1):
            low, high = self.levels[number]
            top = number == len(self.levels) - 1
            count = len(low) if top else ARITY
            node = torch.arange(count, device=low.device) + (0 if top else best[:, None] * ARITY)
            node = node.clamp(max=len(low) - 1).expand(len(center), count)
            away = 0.5 * (high[node] + low[node]) - center[:, None]
            best = node.gather(1, (away * away).sum(2).argmin(1, keepdim=True))[:, 0]
        vertex = self._corner[self.order[best], 0]
        return (vertex - center).norm(dim=1) + radius

    def _cut_by_plane(
        self, box: Tensor, place: Tensor, center: Tensor, half: Tensor, most: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Leaves out triangles whose planes pass a box by more than its reach."""
        corner = self._corner[self.order[place]]
        a, b, c = corner.unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        length = normal.norm(dim=1)
        height = (normal * (center[box] - a)).sum(1).abs()
        span = (normal.abs() * half[box]).sum(1)
        # A needle's normal is not known well: it is never left out.
        size = (corner.amax(1) - corner.amin(1)).norm(dim=1)
        needle = length < 1e-6 * size * size
        kept = (needle | (height <= span + length * (most[box] + 1e-6 * size))).nonzero()
        return box[kept[:, 0]], place[kept[:, 0]]


def _morton(place_f3: Tensor) -> Tensor:
    """Returns (f,) int64 codes: places that are close have close codes."""
    low, high = place_f3.amin(0), place_f3.amax(0)
    size = (high - low).max().clamp(min=torch.finfo(place_f3.dtype).tiny)
    cell = ((place_f3 - low) / size * (2**_BITS - 1)).to(torch.int64)
    code = torch.zeros_like(cell[:, 0])
    for bit in range(_BITS):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return code
