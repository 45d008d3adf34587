"""`Geometry`: how far places are from a mesh, whether they lie in it, and what cubes of voxels hold
of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..ops.voxelize import Voxelized, voxelize
from .hierarchy import Hierarchy
from .mesh import Mesh, solids

_FLOAT32 = 2048.0  # voxels that triangles may reach away from their cube, in float32
_HALF_DIAGONAL = 0.5 * 3**0.5  # of a cube of side 1
_POINTS = 1 << 20  # places that are asked for together


@dataclass(frozen=True, kw_only=True)
class MeshCubes:
    """What k cubes of side^3 voxels hold; see `ops.voxelize`."""

    distance: Tensor  # (k, z, y, x) float32 to the nearest place, world units; inf beyond the reach
    face: Tensor  # (k, z, y, x) int32 the nearest triangle, -1 beyond the reach
    inside: Tensor  # (k, z, y, x) bool
    coverage: Tensor  # (k, z, y, x) float32, 0 to 1; or of no cubes
    weight: Tensor  # (k, z, y, x, 3) of the nearest triangle's corners there; or of no cubes


class Geometry:
    """The triangles of a mesh in their hierarchy. All that it tells is worked out without waiting
    for the device.

    Attributes:
        kept: (f,) int64 the mesh's triangles that are here: see `solids`.
        corner: (f, 3, 3) float64 corners.
        solid: (f,) bool, whether a triangle bounds a solid.
        hierarchy: Boxes around them.
        size: World size of their bounds.
        detail: World size of a usual one, the square root of the median area: a few large ones tell
            nothing of the many.
        largest: World size of the bounds of the largest.
    """

    def __init__(
        self, mesh: Mesh, device: torch.device | str = "cpu", *, solid: bool = True
    ) -> None:
        """Builds the hierarchy; not `solid`: all are sheets."""
        kept, closed = solids(mesh)
        corner = torch.from_numpy(mesh.vertices[mesh.faces[kept]]).to(device)
        self.hierarchy = Hierarchy(corner)
        order = self.hierarchy.order
        self.corner = corner[order].contiguous()
        self.kept = torch.from_numpy(kept)[order.cpu()]
        self.solid = torch.from_numpy(closed & solid).to(device)[order]
        bounds = self.corner.amax(1) - self.corner.amin(1)
        self.size = float((self.corner.amax((0, 1)) - self.corner.amin((0, 1))).max())
        self.detail, self.largest = float(self.area.median().sqrt()), float(bounds.max())

    @property
    def area(self) -> Tensor:
        """(f,) float64 of each triangle, world units squared."""
        a, b, c = self.corner.unbind(1)
        return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1)

    def winding(self, place_p3: Tensor) -> Tensor:
        """Returns (p,) int32 how often closed parts wind around places (p, 3)."""
        return self._at(place_p3, -1.0)[0]

    def signed_distance(self, place_p3: Tensor) -> Tensor:
        """Returns (p,) float64 distances to the nearest triangle, below 0 inside of closed parts;
        to what float64 can tell, anywhere.
        """
        winding, distance = self._at(place_p3, torch.inf)
        return torch.where(winding != 0, -distance, distance)

    def _at(self, place_p3: Tensor, reach: float) -> tuple[Tensor, Tensor]:
        """(p,) winding numbers, and distances up to a reach: of voxels as large as the mesh."""
        parts = []
        for place in place_p3.to(self.corner).split(_POINTS):
            size = place.new_tensor((self.size, self.size, reach)).expand(len(place), 3)
            low = place - 0.5 * self.size
            found = self._voxelize(low, size.contiguous(), 1, wide=True)
            parts.append((found.winding.view(-1), found.distance.view(-1) * self.size))
        if not parts:
            none = self.corner.new_empty(0)
            return none.to(torch.int32), none
        winding, distance = (torch.cat(part) for part in zip(*parts, strict=True))
        return winding, distance

    def touched(
        self, low_k3: Tensor, size_k: Tensor, reach_k: Tensor, *, parts: int = 4, wide: bool
    ) -> tuple[Tensor, Tensor]:
        """Tells which parts of boxes are near triangles: a ball around each is looked at.

        Args:
            low_k3: (k, 3) float64 low corners of the boxes, which are cubes.
            size_k: (k,) float64 their sides.
            reach_k: (k,) float64 world distance.
            parts: Along a side of a box.
            wide: As of `cubes`, for voxels as large as parts.

        Returns:
            (k, parts, parts, parts) bool, z y x: False where no triangle comes within the reach of
            a part; bool, whether it lies inside then.
        """
        part = size_k / parts
        reach = (reach_k + _HALF_DIAGONAL * part) * (1 + 1e-3)  # more than float32 rounds
        size = torch.stack((part, part, reach), 1)
        found = self._voxelize(low_k3, size, parts, wide=wide)
        return found.nearest >= 0, found.winding != 0

    def is_narrow(self, voxel: float) -> bool:
        """Whether float32 will do for voxels of a size, and larger ones."""
        return self.largest < _FLOAT32 * voxel

    def cubes(
        self,
        low_k3: Tensor,
        size_k3: Tensor,
        side: int,
        thickness: float,
        *,
        shares: bool,
        weights: bool,
        wide: bool,
    ) -> MeshCubes:
        """Looks at cubes of side^3 voxels.

        Args:
            low_k3: (k, 3) float64 low corners of the cubes' first voxels, world units.
            size_k3: (k, 3) float64 world sizes: a voxel's side, the distance from one voxel to the
                next, and how far the nearest triangle may be; no side leaves a cube out.
            side: Voxels along a side of a cube.
            thickness: Of sheets, world units.
            shares: Whether coverage is wanted.
            weights: Whether weights are wanted.
            wide: Whether it is worked out in float64.
        """
        found = self._voxelize(
            low_k3, size_k3, side, thickness, shares=shares, weights=weights, wide=wide
        )
        world = found.distance * size_k3[:, :1, None, None].to(found.distance.dtype)
        return MeshCubes(
            distance=torch.where(found.nearest >= 0, world, torch.inf).to(torch.float32),
            face=found.nearest,
            inside=found.winding != 0,
            coverage=found.coverage.to(torch.float32),
            weight=found.weight.to(torch.float32),
        )

    def _voxelize(
        self,
        low: Tensor,
        size: Tensor,
        side: int,
        thickness: float = 0.0,
        *,
        wide: bool,
        shares: bool = False,
        weights: bool = False,
    ) -> Voxelized:
        return voxelize(
            *(self.corner, self.solid, self.hierarchy.box, low, size, side, thickness),
            detail=self.detail,
            shares=shares,
            weights=weights,
            wide=wide,
        )
