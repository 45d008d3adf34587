"""`SampledDistance`: a volume of signed distances as a field, such as that of a mesh.

Sources: Hart, "Sphere tracing", 1996 (Lipschitz bounds); an interpolated value changes at most as
    fast as its neighbouring voxels differ. Danielsson, "Euclidean distance mapping", Computer
    Graphics and Image Processing 1980 (vectors to the nearest point, propagated in sweeps).
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base.volume import Volume
from ..meshes.holes import SolidParts, warn_of_holes
from ..meshes.mesh import Mesh
from ..meshes.voxelizer import Voxelizer
from .distance import WHITE, Color, Distance
from .field import Interval, length

_SPREAD_BYTES = 32  # bytes a voxel that `_spread` takes at least
_BAND = 3.0  # voxels around a mesh in which distances are computed from its triangles


class SampledDistance(Distance):
    """Distances interpolated between voxels. Beyond the box of the voxel centres, the distance to
    this box is added to the value at its nearest point.

    Attributes:
        values: (z, y, x) float32 distances, world units.
        steepest: () float64 largest slope of an interpolated value.
        apart: () float64 most that two voxels differ per unit of length between them.
    """

    exact = False
    values: Tensor
    steepest: Tensor
    apart: Tensor

    def __init__(self, volume: Volume, *, color: Color = WHITE) -> None:
        """Sets the volume, whose position in the world is the field's.

        Args:
            volume: One number a voxel: signed distance in world units, negative inside. float32
                data is not copied.
            color: The surface's, linear red, green, blue.

        Raises:
            ValueError: It does not have one number a voxel, or has less than 2 voxels on an axis.
        """
        super().__init__(color)
        check.instance("SampledDistance", "volume", volume, Volume)
        data = volume.data
        if data.shape[3] != 1 or min(volume.extent) < 2:
            got = " x ".join(map(str, volume.extent))
            raise ValueError(
                "SampledDistance: volume must have 1 number a voxel and at least 2 voxels along "
                f"each axis, got {data.shape[3]} and {got}"
            )
        values = data[..., 0].to(torch.float32)
        self.register_buffer("values", values)
        self.spacing = self.vector("spacing", volume.spacing)
        self.origin = self.vector("origin", volume.origin)
        self.last = self.vector("last", [n - 1 for n in volume.extent])
        self.register_buffer("steepest", _steepest(values, self.spacing))
        self.register_buffer("apart", _apart(values, self.spacing))

    @classmethod
    def of_mesh(
        cls,
        mesh: Mesh,
        *,
        resolution: int = 96,
        reach: float = 0.25,
        solid: SolidParts = "auto",
        color: Color = WHITE,
    ) -> SampledDistance:
        """Returns the distances to a mesh's surface, negative inside of closed parts: exact within
        3 voxels of it, and accurate to about a tenth of a voxel beyond.

        Args:
            mesh: As `read_mesh` returns it.
            resolution: Voxels along its longest side.
            reach: Margin of the volume around the mesh, as a share of that side.
            solid: Which parts are solids: "auto", closed ones (others are sheets; warns if parts
                are nearly closed, or a few triangles are turned); "always", all, after filling
                their holes; or "never".
            color: The surface's.

        Raises:
            ValueError: A number is out of its range.
        """
        check.instance("SampledDistance", "mesh", mesh, Mesh)
        warn_of_holes(mesh, solid, stacklevel=2)
        reach = check.number("SampledDistance", "reach", reach, low=0, high=4)
        settings: dict[str, Any] = {"channels": ("distance",), "band": _BAND, "solid": solid}
        grid = Voxelizer(mesh, resolution=resolution, **settings)
        margin = math.ceil(reach * resolution)
        ends = [n + margin for n in grid.extent[::-1]]
        nbytes = _SPREAD_BYTES * math.prod(n + margin for n in ends)
        check.memory("SampledDistance", f"resolution {resolution}", nbytes, torch.device("cpu"))
        near_surface = grid.region((-margin,) * 3, ends)["distance"][..., 0]
        values = grid.spacing * _spread(near_surface / grid.spacing)
        origin = [coordinate - margin * grid.spacing for coordinate in grid.origin]
        return cls(Volume(values, spacing=(grid.spacing,) * 3, origin=origin), color=color)

    def forward(self, points: Tensor) -> Tensor:
        position = (points - self.origin.to(points)) / self.spacing.to(points)
        last = self.last.to(position)
        clamped = position.clamp(min=torch.zeros_like(last), max=last)
        cell = torch.minimum(clamped.floor(), last - 1)
        weights = clamped - cell
        _, y, x = self.values.shape
        base_index = cell.nan_to_num().to(torch.int64)  # where a point is NaN, so is the value
        base_index = (base_index[..., 2] * y + base_index[..., 1]) * x + base_index[..., 0]
        flat = self.values.reshape(-1)
        corners = [
            flat[base_index + (dz * y + dy) * x + dx].to(position)
            for dz, dy, dx in itertools.product((0, 1), repeat=3)
        ]
        for axis in range(3):
            weight = weights[..., axis]
            pairs = zip(corners[::2], corners[1::2], strict=True)
            corners = [torch.lerp(left, right, weight) for left, right in pairs]
        beyond = length((position - clamped) * self.spacing.to(points))
        return corners[0] + beyond

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        """Returns the slope of the steepest cell; 1 more for boxes that reach out of the volume."""
        return torch.where(self._inside(center, half), self.steepest, self.steepest + 1)

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        """Returns the value in the middle plus and minus the lesser of two bounds: what the slope
        allows, and what `_apart` does. The latter adds a cell's diagonal to the distance, because
        at either end a value is a mean of voxels that are on average half a diagonal away.
        """
        middle, radius = self(center), length(half)
        deviation = self.apart * (radius + length(self.spacing))
        deviation = torch.where(self._inside(center, half), deviation, deviation + radius)
        deviation = torch.minimum(deviation, self.slope(center, half) * radius)
        return middle - deviation, middle + deviation

    def _inside(self, center: Tensor, half: Tensor) -> Tensor:
        """Returns (k,) bool: which boxes are within that of the voxel centres."""
        high = self.origin + self.last * self.spacing
        return ((center - half >= self.origin) & (center + half <= high)).all(1)

    def box(self) -> Tensor:
        """Returns the box of the voxel centres; beyond it is only what values below 0 on its faces
        continue.
        """
        return torch.stack((self.origin, self.origin + self.last * self.spacing))


def _steepest(values: Tensor, spacing: Tensor) -> Tensor:
    """Returns () float64: the largest slope of values interpolated between voxels (z, y, x). Along
    each axis, within a cell of 8 voxels, it is at most the largest along one of the cell's edges.
    """
    squares: Tensor | float = 0.0
    for axis in range(3):
        steps = values.diff(dim=2 - axis).abs()
        window = [2, 2, 2]
        window[2 - axis] = 1
        edge_max = torch.nn.functional.max_pool3d(steps[None], window, stride=1)[0]
        squares = squares + (edge_max.to(torch.float64) / spacing[axis]) ** 2
    assert isinstance(squares, Tensor)
    return squares.max().sqrt()


def _apart(values: Tensor, spacing: Tensor) -> Tensor:
    """Returns () float64: the most that any two voxels, however far apart, differ per unit of
    length between them.

    It is computed between the 26 neighbours. A path through neighbours is at most
    sqrt(1 + (sqrt 2 - 1)^2 + (sqrt 3 - sqrt 2)^2) = 1.128 times as long as the straight line; sqrt
    3 times if voxels are not cubes.
    """
    steepest = torch.zeros((), dtype=torch.float64, device=values.device)
    for step in itertools.product((-1, 0, 1), repeat=3):  # x, y, z
        if step <= (0, 0, 0):  # the same pair as from the other end
            continue
        start_slices = [slice(max(-n, 0), min(-n, 0) or None) for n in step[::-1]]
        end_slices = [slice(max(n, 0), min(n, 0) or None) for n in step[::-1]]
        difference = (values[tuple(start_slices)] - values[tuple(end_slices)]).abs().amax()
        distance = length(spacing.new_tensor(step) * spacing)
        steepest = torch.maximum(steepest, difference.to(torch.float64) / distance)
    is_cubic = bool((spacing == spacing[0]).all())
    return steepest * (1.1282 if is_cubic else math.sqrt(3))


def _spread(distances: Tensor) -> Tensor:
    """Completes distances (z, y, x) in voxels of which only the sign is known beyond `_BAND`.

    A voxel's vector to the nearest point of the surface is passed to its neighbours, along each
    axis in both directions; a second round takes it around corners.
    """
    reliable = distances.abs() < _BAND - 1.01  # then all neighbours are known, too
    slope = torch.stack(torch.gradient(distances))
    slope = slope / torch.linalg.vector_norm(slope, dim=0).clamp(min=1e-6)
    vectors = torch.where(reliable, -distances * slope, 1e6)
    for axis in (1, 2, 3) * 2:
        count = vectors.shape[axis]
        for step, planes in ((-1, range(1, count)), (1, range(count - 2, -1, -1))):
            for plane in planes:
                current = vectors.select(axis, plane)
                neighbour = vectors.select(axis, plane + step).clone()
                neighbour[axis - 1] += step
                nearer = (neighbour * neighbour).sum(0) < (current * current).sum(0)
                current.copy_(torch.where(nearer, neighbour, current))
    propagated = torch.copysign(torch.linalg.vector_norm(vectors, dim=0), distances)
    return torch.where(distances.abs() < _BAND - 1e-3, distances, propagated)
