"""`Geometry`: how far places are from a mesh, whether they lie in it, and what cubes of voxels hold
of it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from ..ops import voxelize
from ..ops.reference.voxelize import pierced
from ..ops.voxelize import MOST_VOXELS
from .hierarchy import Hierarchy
from .mesh import Mesh, solids

_LIST, _TEST = 1e-5, 1.2e-8  # seconds: to find the list of a cube; of a voxel and a triangle
_FLOAT32 = 2048.0  # voxels that triangles may reach away from their cube, in float32
_POINTS = 1 << 14  # places that are asked for together


@dataclass(frozen=True, kw_only=True)
class Cubes:
    """What k cubes of side^3 voxels hold; see `ops.voxelize`."""

    distance: Tensor  # (k, z, y, x) to the nearest place, in world units; infinite beyond the reach
    face: Tensor  # (k, z, y, x) int64 the nearest triangle, -1 beyond the reach
    inside: Tensor  # (k, z, y, x) bool
    coverage: Tensor  # (k, z, y, x) 0 to 1


class Geometry:
    """The triangles of a mesh in their hierarchy.

    Attributes:
        kept: (f,) int64 the mesh's triangles that are here: see `solids`.
        corner: (f, 3, 3) float64 corners.
        solid: (f,) bool, whether a triangle bounds a solid.
        hierarchy: Boxes around them.
    """

    def __init__(self, mesh: Mesh, device: torch.device | str = "cpu") -> None:
        """Builds the hierarchy."""
        kept, solid = solids(mesh)
        self.kept = torch.from_numpy(kept)
        self.corner = torch.from_numpy(mesh.vertices[mesh.faces[kept]]).to(device)
        self.solid = torch.from_numpy(solid).to(device)
        self.hierarchy = Hierarchy(self.corner)
        self._closed: Hierarchy | None = None
        self._closed_corner = self.corner[self.solid]
        if len(self._closed_corner):
            self._closed = Hierarchy(self._closed_corner)

    @functools.cached_property
    def _size(self) -> float:
        """Square root of the median triangle's area: a few large ones tell nothing of the many."""
        return float(self.area.median().sqrt())

    @property
    def area(self) -> Tensor:
        """(f,) float64 of each triangle, world units squared."""
        a, b, c = self.corner.unbind(1)
        return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1)

    def winding(self, place_p3: Tensor) -> Tensor:
        """Returns (p,) int32 how often closed parts wind around places: how many more of their
        triangles are left than entered on the way from there along x.
        """
        total = torch.zeros(len(place_p3), dtype=torch.int32, device=place_p3.device)
        if self._closed is None or not len(place_p3):
            return total
        high = place_p3.clone()
        high[:, 0] = torch.inf
        # A ray is a box without width; rays that begin beyond the mesh meet nothing.
        high[:, 0] = torch.maximum(self._closed_corner[..., 0].max(), place_p3[:, 0])
        first, face = self._closed.near(place_p3, high, 0.0)
        ray = torch.repeat_interleave(first.diff())
        at, way = pierced(place_p3[ray], self._closed_corner[face], 0)
        ahead = (way * (at > place_p3[ray, 0])).to(torch.int32)
        return total.index_add_(0, ray, ahead)

    def signed_distance(self, place_p3: Tensor) -> Tensor:
        """Returns (p,) float64 distances to the nearest triangle, below 0 inside of closed parts;
        to what float64 can tell, anywhere.
        """
        parts = []
        for place in place_p3.to(self.corner).split(_POINTS):
            first, face = self.hierarchy.near(place, place, torch.inf)
            size = float((self.corner.amax((0, 1)) - self.corner.amin((0, 1))).max())
            owner = torch.repeat_interleave(first.diff())
            corner = (self.corner[face] - place[owner, None]) / size + 0.5
            middle = torch.full_like(place, 0.5)
            distance, *_ = voxelize(
                corner,
                self.solid[face],
                first,
                middle,
                torch.zeros(len(place), dtype=torch.int32, device=place.device),
                torch.ones_like(place[0]),
                1,
                0.0,
            )
            inside = self.winding(place) != 0
            distance = distance.view(-1) * size
            parts.append(torch.where(inside, -distance, distance))
        return torch.cat(parts) if parts else place_p3.new_empty(0, dtype=torch.float64)

    def touched(self, low_k3: Tensor, high_k3: Tensor, reach: float) -> Tensor:
        """Returns (k,) bool, whether a triangle may come within a reach of each box."""
        return self.hierarchy.near(low_k3, high_k3, reach)[0].diff() > 0

    def cubes(
        self, low_k3: Tensor, voxel_3: Tensor, side: int, reach: float, thickness: float
    ) -> Cubes:
        """Looks at cubes of side^3 voxels.

        Args:
            low_k3: (k, 3) float64 low corners of the cubes, world units.
            voxel_3: (3,) float64 size of a voxel.
            side: Voxels along a side of a cube; cut into smaller cubes where that saves work.
            reach: How far the nearest triangle may be, world units.
            thickness: Of sheets, world units.
        """
        part = self._part(side, voxel_3)
        parts = side // part
        at = torch.arange(parts, device=low_k3.device) * part
        z, y, x = torch.meshgrid(at, at, at, indexing="ij")
        offset = torch.stack((x, y, z), -1).view(-1, 3) * voxel_3
        low = (low_k3[:, None] + offset).view(-1, 3)
        found = self._small_cubes(low, voxel_3, part, reach, thickness)
        if parts == 1:
            return found

        def joined(values: Tensor) -> Tensor:
            values = values.view(-1, parts, parts, parts, part, part, part)
            return values.permute(0, 1, 4, 2, 5, 3, 6).reshape(-1, side, side, side)

        return Cubes(**{name: joined(values) for name, values in vars(found).items()})

    def _part(self, side: int, voxel_3: Tensor) -> int:
        """Side of the cubes that have lists of their own, of those into which a cube can be cut:
        the one that costs least, if all triangles were as large as the median one. A cube's list
        holds those of a surface two voxels wider than the cube.
        """
        size = max(self._size / float(voxel_3.max()), 1e-6)

        def cost(part: int) -> float:
            return _LIST / part**3 + _TEST * ((part + 2) / size) ** 2

        return min((n for n in range(1, min(side, MOST_VOXELS) + 1) if side % n == 0), key=cost)

    def _small_cubes(
        self, low_k3: Tensor, voxel_3: Tensor, side: int, reach: float, thickness: float
    ) -> Cubes:
        high = low_k3 + side * voxel_3
        first, face = self.hierarchy.near(low_k3, high, reach)
        count = first.diff()
        full = (count > 0).nonzero()[:, 0]
        shape = (len(low_k3), side, side, side)
        center = 0.5 * (low_k3 + high)
        bare = (count == 0).nonzero()[:, 0]
        inside = torch.zeros(shape, dtype=torch.bool, device=low_k3.device)
        inside[bare] = (self.winding(center[bare]) != 0)[:, None, None, None]
        coverage = inside.to(torch.float32)
        distance = torch.full_like(coverage, torch.inf)
        nearest = torch.full(shape, -1, dtype=torch.int64, device=low_k3.device)
        if len(full):
            some = self._full_cubes(low_k3[full], voxel_3, side, count[full], face, thickness)
            gap, row, winding, share = some
            unit = float(voxel_3.min())
            gap = gap.to(torch.float32) * unit
            within = gap <= reach
            distance[full] = torch.where(within, gap, torch.inf)
            nearest[full] = torch.where(within, face[row.long()], -1)
            inside[full], coverage[full] = winding != 0, share.to(torch.float32)
        return Cubes(distance=distance, face=nearest, inside=inside, coverage=coverage)

    def _full_cubes(
        self,
        low: Tensor,
        voxel_3: Tensor,
        side: int,
        count: Tensor,
        face: Tensor,
        thickness: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`voxelize` of cubes that have triangles, in units of the smallest side of a voxel."""
        unit = float(voxel_3.min())
        first = torch.cat((count.new_zeros(1), count.cumsum(0)))
        owner = torch.repeat_interleave(count)
        corner = (self.corner[face] - low[owner, None]) / unit
        # float32 knows the corners of a triangle to 2^-24 of its size.
        real = torch.float32 if float(corner.abs().max()) < _FLOAT32 else torch.float64
        corner = corner.to(real)
        solid, none = self.solid[face], torch.zeros(len(low), dtype=torch.int32, device=low.device)
        voxel = (voxel_3 / unit).to(real)
        start = torch.zeros((len(low), 3), dtype=real, device=low.device)
        if self._closed is not None:
            # The winding number is counted from the one of eight places that is the farthest from
            # the surface, where rounding can't move a place to its other side.
            quarter = voxel * (side / 2)
            gap = voxelize(corner, solid, first, start, none, quarter, 2, 0.0)[0].view(-1, 8)
            best = gap.argmax(1)
            steps = torch.stack((best % 2, best // 2 % 2, best // 4), 1)
            start = (steps + 0.5) * quarter
            none = self.winding(low + start.to(low.dtype) * unit)
        return voxelize(corner, solid, first, start, none, voxel, side, thickness / unit)
