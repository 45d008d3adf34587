"""Worlds of formulas, as deep as float64 resolves, and independent answers of what rays meet."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import torch
from torch import Tensor

import gvtorch as gv

Gap = Callable[[Tensor, Tensor, Tensor], Tensor]  # float64 positions to depths inside


class Solid(gv.Producer):
    """Matter whose edge fades over eight voxels at every level: 0.5 on the surface. `gap` is the
    distance from the surface, positive inside, or a lower bound of it.
    """

    def __init__(self, gap: Gap, depth: int, branching: int = 2, *, filled: bool = True) -> None:
        super().__init__(8 * branching**depth, box=((-1,) * 3, (1,) * 3), branching=branching)
        self.gap, self.filled = gap, filled

    def classify(self, nodes):
        gap = self.gap(*nodes.center.unbind(1))
        reach = nodes.radius + 4 * nodes.voxel_size[:, 0]
        kind = torch.full((len(nodes),), int(gv.Region.DATA))
        kind[gap < -reach] = int(gv.Region.EMPTY)
        if self.filled:
            kind[gap > reach] = int(gv.Region.CONSTANT)
        return gv.Regions(kind=kind, constants={"value": (gap > 0).float()[:, None]})

    def fill(self, nodes):
        center = nodes.center[:, :, None, None, None]
        positions = (center[:, axis] + local for axis, local in enumerate(nodes.local_axes))
        gap = self.gap(*positions) / (8 * nodes.voxel_size[:, 0, None, None, None])
        return {"value": (0.5 + gap).clamp(0, 1).float()}


def ball(radius: float) -> Gap:
    return lambda x, y, z: radius - (x * x + y * y + z * z).sqrt()


def torus(ring: float, tube: float) -> Gap:
    return lambda x, y, z: tube - (((x * x + y * y).sqrt() - ring) ** 2 + z * z).sqrt()


def bulb(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Mandelbulb of power 8: minus a lower bound of the distance (Hart, Sandin, Kauffman, "Ray
    tracing deterministic 3-D fractals", SIGGRAPH 1989).
    """
    x, y, z = (1.2 * c for c in torch.broadcast_tensors(x, y, z))
    a, b, c, slope = x, y, z, torch.ones_like(x)
    r = (a * a + b * b + c * c).sqrt()
    for _ in range(60):
        inside = r < 4
        theta, phi = 8 * torch.acos((c / r).clamp(-1, 1)), 8 * torch.atan2(b, a)
        slope = torch.where(inside, 8 * r**7 * slope + 1, slope)
        a = torch.where(inside, r**8 * theta.sin() * phi.cos() + x, a)
        b = torch.where(inside, r**8 * theta.sin() * phi.sin() + y, b)
        c = torch.where(inside, r**8 * theta.cos() + z, c)
        r = torch.where(inside, (a * a + b * b + c * c).sqrt(), r)
    return torch.where(r >= 4, -0.5 * r.log() * r / slope / 1.2, 0.0)


class Menger(gv.Producer):
    """The Menger sponge on [0, 1]^3, whose smallest holes are cells of a grid of 3^cells a side: a
    voxel of any level is solid if it is a solid cell, or lies in one of the smallest solid cells.
    """

    def __init__(self, depth: int, cells: int) -> None:
        super().__init__(9 * 3**depth, box=((0,) * 3, (1,) * 3), branching=3)
        self.cells = cells

    def classify(self, nodes):
        offsets = torch.cartesian_prod(*(torch.arange(-1, 2),) * 3)
        neighbours = nodes.loc[:, None, :3] + offsets
        full = self.solid(*neighbours.unbind(2), nodes.loc[:, 3, None]).any(1)
        return torch.where(full, gv.Region.DATA, gv.Region.EMPTY)

    def fill(self, nodes):
        x, y, z = (nodes.loc[:, axis, None] * 9 + nodes.layout.reach for axis in range(3))
        cell_indices = x[:, None, None, :], y[:, None, :, None], z[:, :, None, None]
        return {"value": self.solid(*cell_indices, nodes.loc[:, 3, None, None, None] + 2).float()}

    def solid(self, x: Tensor, y: Tensor, z: Tensor, digits: Tensor) -> Tensor:
        """Returns which cells of a grid of 3^digits a side are solid."""
        full = torch.ones_like(x + y + z, dtype=torch.bool)
        up = 3 ** (digits - self.cells).clamp(min=0)
        for axis in (x, y, z):
            full = full & (axis >= 0) & (axis < 3**digits)
        x, y, z = x // up, y // up, z // up
        for _ in range(self.cells):
            full = full & (sum((axis % 3 == 1).int() for axis in (x, y, z)) < 2)
            x, y, z = x // 3, y // 3, z // 3
        return full


def meets_menger(origin: Tensor, direction: Tensor, cells: int) -> float:
    """Returns the distance at which a float64 ray that begins in the sponge's box meets a solid
    cell of the grid of 3^cells a side, +inf if none; steps from cube to empty cube in integers.
    """
    side = 3**cells
    start = [Fraction(float(c)) * side for c in origin]
    whole = [math.floor(c) for c in start]
    fraction = [float(c - w) for c, w in zip(start, whole, strict=True)]  # within the cell
    velocity = [float(d) * side for d in direction]
    cell, t = list(whole), 0.0
    while all(0 <= c < side for c in cell):
        size = side // 3
        while size and sum(c // size % 3 == 1 for c in cell) < 2:
            size //= 3
        if not size:
            return t
        low = [c // size * size for c in cell]
        faces = [a + size if d > 0 else a for a, d in zip(low, velocity, strict=True)]
        exits = [
            ((f - w) - p) / d if d else math.inf
            for f, w, p, d in zip(faces, whole, fraction, velocity, strict=True)
        ]
        t = min(exits)
        for axis in range(3):
            position = whole[axis] + math.floor(fraction[axis] + t * velocity[axis])
            cell[axis] = min(max(position, low[axis]), low[axis] + size - 1)
            if exits[axis] == t:
                cell[axis] = faces[axis] if velocity[axis] > 0 else faces[axis] - 1
    return math.inf
