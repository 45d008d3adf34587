"""`Geometry`: distances from a mesh, winding numbers, and the voxels of cubes; `Hierarchy`: boxes
around triangles, level by level, as the op `voxelize` traverses them.

Source: Karras, "Maximizing parallelism in the construction of BVHs", HPG 2012 (triangles sorted
    along a Morton curve; here every box holds eight of the level below, so no pointers are needed).
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from ..ops.voxelize import ARITY, Voxelized, voxelize
from .mesh import Mesh, solids

_MORTON_BITS = 20  # bits of a Morton code along each axis
HALF_DIAGONAL = 0.5 * 3**0.5  # from a unit cube's centre to its corner
_BATCH_POINTS = 1 << 20  # points per call of the op


class Hierarchy:
    """The boxes of triangles, sorted so that neighbours in memory are neighbours in space.

    Attributes:
        order: (f,) int64 the triangle in each box of the lowest level.
        box: (n, 6) float64 low and high corners of all boxes, those of the triangles first.
        first: The index of each level's first box, lowest level first, and the number of all boxes.
            Box i of a level holds boxes 8 i to 8 i + 7 of the level below.
    """

    def __init__(self, corner_f33: Tensor) -> None:
        """Sorts (f, 3, 3) float64 triangles and builds all levels."""
        low, high = corner_f33.amin(1), corner_f33.amax(1)
        self.order = _morton(0.5 * (low + high)).argsort(stable=True)
        levels = [torch.cat((low[self.order], high[self.order]), 1)]
        while len(levels[-1]) > ARITY:
            below = padded(levels[-1]).view(-1, ARITY, 6)
            levels.append(torch.cat((below[..., :3].amin(1), below[..., 3:].amax(1)), 1))
        self.box = torch.cat(levels)
        self.first = [0, *itertools.accumulate(map(len, levels))]


class Geometry:
    """The triangles of a mesh in a hierarchy. No method waits for the device.

    Attributes:
        mesh_face: (f,) int64 index in the mesh of each triangle used here, in the hierarchy's
            order; see `solids`.
        corner: (f, 3, 3) float64 corners.
        solid: (f,) bool, whether a triangle bounds a solid.
        hierarchy: Boxes around the triangles.
        size: Longest side of the mesh's bounds, world units.
        detail: World size of a typical triangle: the square root of the median area, which a few
            large triangles do not change.
        largest: Longest side of the bounds of any triangle, world units.
    """

    def __init__(
        self, mesh: Mesh, device: torch.device | str = "cpu", *, solid: bool = True
    ) -> None:
        """Builds the hierarchy; if `solid` is False, all triangles are sheets."""
        kept, closed = solids(mesh)
        corner = torch.from_numpy(mesh.vertices[mesh.faces[kept]]).to(device)
        self.hierarchy = Hierarchy(corner)
        order = self.hierarchy.order
        self.corner = corner[order].contiguous()
        self.mesh_face = torch.from_numpy(kept)[order.cpu()]
        self.solid = torch.from_numpy(closed & solid).to(device)[order]
        bounds = self.corner.amax(1) - self.corner.amin(1)
        self.size = float((self.corner.amax((0, 1)) - self.corner.amin((0, 1))).max())
        self.detail, self.largest = float(self.area.median().sqrt()), float(bounds.max())

    @property
    def area(self) -> Tensor:
        """(f,) float64 area of each triangle, square world units."""
        a, b, c = self.corner.unbind(1)
        return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1)

    def winding(self, point_p3: Tensor) -> Tensor:
        """Returns (p,) int32 winding numbers of the closed parts at points (p, 3)."""
        return self._winding_and_distance(point_p3, -1.0)[0]

    def signed_distance(self, point_p3: Tensor) -> Tensor:
        """Returns (p,) float64 distances to the nearest triangle, negative inside of closed parts;
        exact to float64's rounding at any distance.
        """
        winding, distance = self._winding_and_distance(point_p3, torch.inf)
        return torch.where(winding != 0, -distance, distance)

    def _winding_and_distance(self, point_p3: Tensor, reach: float) -> tuple[Tensor, Tensor]:
        """Returns (p,) winding numbers and distances up to `reach`, from mesh-sized voxels."""
        parts = []
        for point in point_p3.to(self.corner).split(_BATCH_POINTS):
            size = point.new_tensor((self.size, self.size, reach)).expand(len(point), 3)
            low = point - 0.5 * self.size
            voxels = self.cubes(low, size.contiguous(), 1, wide=True)
            parts.append((voxels.winding.view(-1), voxels.distance.view(-1) * self.size))
        winding, distance = (torch.cat(part) for part in zip(*parts, strict=True))
        return winding, distance

    def touched(
        self,
        low_k3: Tensor,  # (k, 3) float64 low corners of the boxes, which are cubes
        size_k: Tensor,  # (k,) float64 their sides
        reach_k: Tensor,  # (k,) float64 world distance
        *,
        parts: int = 4,  # along a side of a box
        wide: bool,  # as for `cubes`, for voxels as large as parts
    ) -> tuple[Tensor, Tensor]:
        """Finds which parts of boxes are near triangles, by a ball around each part.

        Returns:
            (k, parts, parts, parts) bool, z y x: False where no triangle comes within reach of a
            part; and, of the same shape, whether such a part lies inside the mesh.
        """
        part_size = size_k / parts
        reach = (reach_k + HALF_DIAGONAL * part_size) * (1 + 1e-3)  # exceeds float32's rounding
        size = torch.stack((part_size, part_size, reach), 1)
        voxels = self.cubes(low_k3, size, parts, wide=wide)
        return voxels.nearest >= 0, voxels.winding != 0

    def cubes(
        self,
        low_k3: Tensor,
        size_k3: Tensor,
        side: int,
        thickness: float = 0.0,
        *,
        wide: bool,
        shares: bool = False,
        weights: bool = False,
    ) -> Voxelized:
        """Voxelizes cubes of side^3 voxels; arguments as for `ops.voxelize`."""
        return voxelize(
            *(self.corner, self.solid, self.hierarchy.box, low_k3, size_k3, side, thickness),
            detail=self.detail,
            shares=shares,
            weights=weights,
            wide=wide,
        )


def padded(level: Tensor) -> Tensor:
    """Returns (n, ...) with its last row repeated, up to a multiple of the hierarchy's arity."""
    return torch.cat((level, level[-1:].expand(-len(level) % ARITY, *level.shape[1:])))


def _morton(center_f3: Tensor) -> Tensor:
    """Returns (f,) int64 Morton codes of positions: close positions tend to have close codes."""
    low, high = center_f3.amin(0), center_f3.amax(0)
    size = (high - low).max().clamp(min=torch.finfo(center_f3.dtype).tiny)
    cell = ((center_f3 - low) / size * (2**_MORTON_BITS - 1)).to(torch.int64)
    code = torch.zeros_like(cell[:, 0])
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return code
