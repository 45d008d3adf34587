"""`Voxelizer`: the voxels of a mesh, at any level and in any part. One definition for what a
producer makes while it is looked at and for what is written into a store.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..base import check
from .geometry import Cubes, Geometry
from .mesh import Mesh
from .paint import Paint, nearest_weights

#: Each channel's dtype and how many numbers a voxel has.
CHANNELS = {
    "coverage": (torch.uint8, 1),
    "distance": (torch.float32, 1),
    "color": (torch.float16, 4),
    "normal": (torch.int8, 3),
    "material": (torch.uint8, 1),
}
_MARGIN = 2  # voxels around the mesh
_CUBE, _BLOCK = 8, 32  # voxels along a side of the cubes of a region; of cubes looked at before
_BATCH = 1 << 21  # voxels that are made together
_DIAGONAL = 0.5 * math.sqrt(3)  # from a voxel's centre to its corner


class Voxelizer:
    """A mesh in a grid of voxels. Voxel x covers world coordinates origin + (x - 1/2) * spacing to
    origin + (x + 1/2) * spacing.

    Attributes:
        mesh: The mesh.
        extent: Finest voxels along x, y, z.
        spacing: World size of one, the same along x, y and z.
        origin: World place of the centre of voxel 0.
        channels: Names of what a voxel holds:
            coverage uint8, 255 times the share of the voxel that is filled.
            distance float32, to the surface in world units, below 0 inside of solids; no farther
                than `band`.
            color float16 x 4, premultiplied linear red, green, blue, and opacity: the surface's at
                the nearest place, times the coverage; its mean farther inside than the band.
            normal int8 x 3, 127 times the unit normal at the nearest place; 0 beyond the band.
            material uint8, 1 + the material of the nearest triangle where the voxel is half filled
                or more, else 0: labels.
        band: World distance up to which the nearest place counts.
        thickness: World thickness of what is no solid.
    """

    def __init__(
        self,
        mesh: Mesh,
        *,
        resolution: int = 1024,
        channels: Sequence[str] = ("coverage",),
        band: float = 4.0,
        thickness: float = 1.0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Lays the grid around the mesh.

        Args:
            mesh: The mesh.
            resolution: Finest voxels along its longest side, 2 at either end beyond it.
            channels: Of `CHANNELS`.
            band: In finest voxels, at least 2.
            thickness: Of sheets, in finest voxels.
            device: Where it is worked out.

        Raises:
            ValueError: An unknown channel, or a number out of its range.
        """
        where = "voxelize"
        check.whole(where, "resolution", resolution, low=8, high=2**30)
        channels = (channels,) if isinstance(channels, str) else tuple(channels)
        unknown = [name for name in channels if name not in CHANNELS]
        if unknown or not channels or len({*channels}) < len(channels):
            what = f"{unknown[0]!r}" if unknown else f"{channels!r}"
            raise ValueError(f"{where}: channels must be some of {', '.join(CHANNELS)}, got {what}")
        if "material" in channels and len(mesh.materials) > 255:
            raise ValueError(
                f"{mesh.name}: {len(mesh.materials)} materials, a uint8 tells 255 apart"
            )
        low, high = mesh.bounds
        size = (high - low).max()
        self.mesh, self.channels = mesh, channels
        self.spacing = float(size / (resolution - 2 * _MARGIN))
        counts = [max(1, math.ceil(n / self.spacing - 1e-9)) + 2 * _MARGIN for n in high - low]
        x, y, z = counts
        self.extent = (x, y, z)
        middle, half = 0.5 * (low + high), [0.5 * (n - 1) * self.spacing for n in counts]
        x, y, z = (float(m - h) for m, h in zip(middle, half, strict=True))
        self.origin = (x, y, z)
        self.band = check.number(where, "band", band, low=2) * self.spacing
        self.thickness = check.number(where, "thickness", thickness, low=0.1) * self.spacing
        self.device = torch.device(device)
        self.geometry = Geometry(mesh, self.device)
        painted = {"color", "normal", "material"} & {*channels}
        self.paint = Paint(mesh, self.geometry) if painted else None

    def reach(self, voxel: float) -> float:
        """World distance from voxels of a size up to which triangles matter to them."""
        share = _DIAGONAL * voxel + 0.5 * self.thickness
        near = {"coverage"} == {*self.channels}
        return share * (1 + 1e-6) if near else max(share * (1 + 1e-6), self.band)

    def cubes(
        self, low_k3: Tensor, voxel: float, side: int, *, finer: int = 1
    ) -> dict[str, Tensor]:
        """Makes k cubes of voxels.

        Args:
            low_k3: (k, 3) float64 low corners, world units.
            voxel: World size of a voxel.
            side: Voxels along a side of a cube.
            finer: Each voxel is the mean of so many along each axis.

        Returns:
            By channel (k, z, y, x, c) of its dtype.
        """
        parts: dict[str, list[Tensor]] = {name: [] for name in self.channels}
        step = max(1, _BATCH // (side * finer) ** 3)
        for low in low_k3.to(self.device, torch.float64).split(step):
            made = self._make(low, voxel / finer, side * finer)
            for name, values in made.items():
                parts[name].append(_stored(name, _mean(name, values, finer)))
        empty = (0, side, side, side)
        return {
            name: torch.cat(own) if own else torch.empty((*empty, width), dtype=dtype)
            for (name, own), (dtype, width) in zip(
                parts.items(), (CHANNELS[name] for name in self.channels), strict=True
            )
        }

    def constants(self, inside_k: Tensor) -> dict[str, Tensor]:
        """Returns by channel (k, c) what voxels hold, inside or outside, that are far from all
        triangles.
        """
        shape = (len(inside_k), 1, 1, 1)
        inside = inside_k.view(shape)
        far = Cubes(
            distance=torch.full(shape, torch.inf, device=self.device),
            face=torch.full(shape, -1, dtype=torch.int64, device=self.device),
            inside=inside,
            coverage=inside.to(torch.float32),
        )
        place = torch.zeros((len(inside_k), 3), dtype=torch.float64, device=self.device)
        made = self._channels(far, place, self.spacing)
        return {name: _stored(name, values)[:, 0, 0, 0] for name, values in made.items()}

    def region(self, low: Sequence[int], high: Sequence[int]) -> dict[str, Tensor]:
        """Makes the finest voxels of a box `low` to `high`, (z, y, x).

        Returns:
            By channel (z, y, x, c) of its dtype, on the CPU.
        """
        first = [n // _BLOCK for n in low]
        blocks = [-(-b // _BLOCK) - a for a, b in zip(first, high, strict=True)]
        out = {
            name: torch.empty(
                (*(n * _BLOCK for n in blocks), CHANNELS[name][1]), dtype=CHANNELS[name][0]
            )
            for name in self.channels
        }
        places = torch.tensor(list(itertools.product(*map(range, blocks)))).view(-1, 3)
        world = self._corner((places + torch.tensor(first)) * _BLOCK)
        size = _BLOCK * self.spacing
        touched = self.geometry.touched(world, world + size, self.reach(self.spacing)).cpu()
        bare = places[~touched]
        inside = self.geometry.winding(world[~touched.to(world.device)] + 0.5 * size) != 0
        constants = self.constants(inside)
        for name, values in out.items():
            for zyx, value in zip(bare.tolist(), constants[name].cpu(), strict=True):
                values[tuple(slice(n * _BLOCK, (n + 1) * _BLOCK) for n in zyx)] = value
        self._cut_region(places[touched], torch.tensor(first), low, high, out)
        start = [n - a * _BLOCK for n, a in zip(low, first, strict=True)]
        box = tuple(slice(s, s + b - a) for s, a, b in zip(start, low, high, strict=True))
        return {name: values[box] for name, values in out.items()}

    def _cut_region(
        self,
        blocks: Tensor,
        first: Tensor,
        low: Sequence[int],
        high: Sequence[int],
        out: dict[str, Tensor],
    ) -> None:
        """Fills the blocks (k, 3) of a region that triangles touch, z y x, cube by cube."""
        per = _BLOCK // _CUBE
        inner = torch.tensor(list(itertools.product(range(per), repeat=3)))
        cubes = (blocks[:, None] * per + inner).view(-1, 3)
        at = (cubes + first * per) * _CUBE
        wanted = ((at + _CUBE > torch.tensor(low)) & (at < torch.tensor(high))).all(1)
        cubes, at = cubes[wanted], at[wanted]
        views = {
            name: values.view(
                *itertools.chain(*((n // _CUBE, _CUBE) for n in values.shape[:3])), values.shape[3]
            ).permute(0, 2, 4, 1, 3, 5, 6)
            for name, values in out.items()
        }
        step = max(1, _BATCH // _CUBE**3)
        for zyx, corner in zip(cubes.split(step), at.split(step), strict=True):
            made = self.cubes(self._corner(corner), self.spacing, _CUBE)
            for name, values in made.items():
                views[name][zyx.unbind(1)] = values.cpu()

    def _corner(self, zyx: Tensor) -> Tensor:
        """(k, 3) float64 world place of the low corner of voxels z, y, x."""
        origin = torch.tensor(self.origin, dtype=torch.float64)
        return (origin + (zyx.flip(1) - 0.5) * self.spacing).to(self.device)

    def _make(self, low: Tensor, voxel: float, side: int) -> dict[str, Tensor]:
        size = torch.full((3,), voxel, dtype=torch.float64, device=self.device)
        found = self.geometry.cubes(low, size, side, self.reach(voxel), self.thickness)
        return self._channels(found, low, voxel)

    def _channels(self, found: Cubes, low: Tensor, voxel: float) -> dict[str, Tensor]:
        """By channel (k, z, y, x, c) float32 of what was found (materials int64)."""
        made: dict[str, Tensor] = {}
        if "coverage" in self.channels:
            made["coverage"] = found.coverage[..., None]
        if "distance" in self.channels:
            distance = found.distance.clamp(max=self.band)
            made["distance"] = torch.where(found.inside, -distance, distance)[..., None]
        if self.paint is None:
            return {name: made[name] for name in self.channels}
        near = (
            (found.face >= 0)
            if "normal" in self.channels
            else (found.face >= 0) & (found.coverage > 0)
        )
        at = near.nonzero()
        face = found.face[near]
        local = (at[:, 1:].flip(1) + 0.5) * voxel
        corner = (self.geometry.corner[face] - low[at[:, 0], None]).to(torch.float32)
        weight = nearest_weights(local.to(torch.float32) / voxel, corner / voxel)
        if "color" in self.channels:
            color = self.paint.mean_color.expand(*near.shape, 4).clone()
            color[near] = self.paint.color(face, weight)
            opacity = color[..., 3:] * found.coverage[..., None]
            made["color"] = torch.cat((color[..., :3] * opacity, opacity), -1)
        if "normal" in self.channels:
            made["normal"] = torch.zeros((*near.shape, 3), device=self.device)
            made["normal"][near] = self.paint.normal(face, weight)
        if "material" in self.channels:
            material = torch.full_like(found.face, self.paint.main_material + 1)
            material[near] = self.paint.material[face] + 1
            made["material"] = torch.where(found.coverage >= 0.5, material, 0)[..., None]
        return {name: made[name] for name in self.channels}


def _mean(name: str, values: Tensor, finer: int) -> Tensor:
    """(k, z, y, x, c) means over cubes of finer^3; of labels the one in the middle."""
    if finer == 1:
        return values
    if name == "material":
        return values[:, finer // 2 :: finer, finer // 2 :: finer, finer // 2 :: finer]
    k, z, y, x, c = values.shape
    blocks = values.view(k, z // finer, finer, y // finer, finer, x // finer, finer, c)
    return blocks.mean((2, 4, 6))


def _stored(name: str, values: Tensor) -> Tensor:
    """Returns values in the dtype of their channel, rounded to the nearest, ties to even."""
    dtype, _ = CHANNELS[name]
    if name in ("distance", "color", "material"):
        return values.to(dtype)
    return (values * torch.iinfo(dtype).max).round_().to(dtype)
