"""`Voxelizer`: the voxels of a mesh, at any level and in any part. Producers that stream a mesh and
conversions into a store both use it, and so make the same voxels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, TypedDict, get_args

import torch
from torch import Tensor

from ..base import check
from ..ops.voxelize import Voxelized
from .geometry import HALF_DIAGONAL, Geometry
from .holes import SolidParts, filled
from .mesh import Mesh
from .paint import Paint

#: Each channel's dtype and how many numbers a voxel has.
CHANNELS = {
    "coverage": (torch.uint8, 1),
    "distance": (torch.float32, 1),
    "color": (torch.float16, 4),
    "normal": (torch.int8, 3),
    "material": (torch.uint8, 1),
}
_MOST_VOXELS = 2**30  # most voxels along a side, and of a length in voxels
_MARGIN_VOXELS = 2  # voxels around the mesh
# Voxels along a cube's side; cubes along the side of a block of a region.
_CUBE_VOXELS, _BLOCK_CUBES = 8, 4
_BATCH_VOXELS = 1 << 20  # voxels that are computed together
_SAMPLES_PER_SIDE = 2  # samples along a side of a coarse voxel, which is their mean
_FLOAT32_VOXELS = 2048.0  # size of a triangle, in voxels, from which on float64 is used


class GridSettings(TypedDict, total=False):
    """Settings of a `Voxelizer`, whatever its channels."""

    resolution: int
    band: float
    thickness: float
    solid: SolidParts


def check_channels(context: str, channels: str | Sequence[str]) -> tuple[str, ...]:
    """Returns the names as a tuple; ValueError if there are none, or unknown or repeated ones."""
    names = (channels,) if isinstance(channels, str) else check.items(context, "channels", channels)
    unknown = [name for name in names if name not in CHANNELS]
    if unknown or not names or len({*names}) < len(names):
        rejected = f"{unknown[0]!r}" if unknown else f"{names!r}"
        known = ", ".join(CHANNELS)
        raise ValueError(f"{context}: channels must be some of {known}, got {rejected}")
    return names


class Voxelizer:
    """A mesh in a grid of voxels. Voxel x covers world coordinates origin + (x - 1/2) * spacing to
    origin + (x + 1/2) * spacing.

    Attributes:
        mesh: The mesh, its holes filled if `solid` was "always".
        settings: Arguments with which `mesh` gives the same voxels: "auto" in place of "always".
        extent: Finest voxels along x, y, z.
        spacing: World size of a finest voxel, the same along x, y and z.
        origin: World position of the centre of voxel 0.
        channels: Names of what a voxel holds:
            coverage uint8, 255 times the share of the voxel that is filled.
            distance float32, to the surface in world units, negative inside of solids; its absolute
                value is at most `band`.
            color float16 x 4, premultiplied linear red, green, blue, and opacity: the colour of the
                nearest surface point, or the surface's mean beyond the band, times the coverage.
            normal int8 x 3, 127 times the unit normal at the nearest surface point; 0 beyond the
                band.
            material uint8, a label: 1 + the material of the nearest triangle if at least half of
                the voxel is filled, else 0.
        band: World distance up to which the nearest surface point is used.
        thickness: World thickness of sheets, the parts that are not solids.
    """

    def __init__(
        self,
        mesh: Mesh,
        *,
        resolution: int = 1024,
        channels: Sequence[str] = ("coverage",),
        band: float = 4.0,
        thickness: float = 1.0,
        solid: SolidParts = "auto",
        device: torch.device | str = "cpu",
    ) -> None:
        """Places the grid around the mesh.

        Args:
            mesh: The mesh.
            resolution: Finest voxels along its longest side, including a margin of 2 at either end.
            channels: Names from `CHANNELS`.
            band: In finest voxels, at least 2.
            thickness: Of sheets, in finest voxels.
            solid: auto: closed parts are solids; always: holes are filled first; never: all parts
                are sheets.
            device: Where voxels are computed.

        Raises:
            ValueError: An unknown channel, or a number out of its range.
        """
        context = "voxelize"
        check.integer(context, "resolution", resolution, low=8, high=_MOST_VOXELS)
        check.one_of(context, "solid", solid, get_args(SolidParts))
        channels = check_channels(context, channels)
        if solid == "always":
            mesh, solid = filled(mesh), "auto"
        self.settings: GridSettings = {
            "resolution": resolution,
            "band": band,
            "thickness": thickness,
            "solid": solid,
        }
        if "material" in channels and len(mesh.materials) > 255:
            raise ValueError(
                f"{mesh.name}: {len(mesh.materials)} materials, a uint8 distinguishes 255"
            )
        low, high = mesh.bounds
        size = (high - low).max()
        self.mesh, self.channels = mesh, channels
        self.spacing = float(size / (resolution - 2 * _MARGIN_VOXELS))
        counts = (max(1, math.ceil(n / self.spacing - 1e-9)) for n in high - low)
        x, y, z = (n + 2 * _MARGIN_VOXELS for n in counts)
        self.extent = (x, y, z)
        middle = 0.5 * (low + high)
        half_extent = [0.5 * (n - 1) * self.spacing for n in self.extent]
        x, y, z = (float(m - h) for m, h in zip(middle, half_extent, strict=True))
        self.origin = (x, y, z)
        band = check.number(context, "band", band, low=2, high=_MOST_VOXELS)
        thickness = check.number(context, "thickness", thickness, low=0.1, high=_MOST_VOXELS)
        self.band, self.thickness = band * self.spacing, thickness * self.spacing
        self.device = torch.device(device)
        self.geometry = Geometry(mesh, self.device, solid=solid != "never")
        self._wide = self.geometry.largest >= _FLOAT32_VOXELS * self.spacing
        # Shares of solids are exact in voxels of any size.
        self._exact_shares = {"coverage"} == {*channels} and bool(self.geometry.solid.all())
        offsets = list(itertools.product(range(_SAMPLES_PER_SIDE), repeat=3))
        self._sample_offsets = torch.tensor(offsets, dtype=torch.float64, device=self.device)
        painted = {"color", "normal", "material"} & {*channels}
        self.paint = Paint(mesh, self.geometry) if painted else None

    def reach(self, voxel_k: Tensor) -> Tensor:
        """Returns (k,) the world distance up to which triangles affect voxels of sizes (k,)."""
        distance = (HALF_DIAGONAL * voxel_k + 0.5 * self.thickness) * (1 + 1e-6)
        return distance if {"coverage"} == {*self.channels} else distance.clamp(min=self.band)

    def touched(self, low_k3: Tensor, size_k: Tensor, voxel_k: Tensor) -> tuple[Tensor, Tensor]:
        """Calls `Geometry.touched` with the `reach` of voxels of sizes (k,) float64."""
        reach, wide = self.reach(voxel_k), self._wide
        return self.geometry.touched(low_k3, size_k, reach, parts=_BLOCK_CUBES, wide=wide)

    def cubes(
        self,
        low_k3: Tensor,  # (k, 3) float64 low corners, world units
        voxel_k: Tensor,  # (k,) float64 world sizes of their voxels
        side: int,  # voxels along a side of a cube
        *,
        coarse_k: Tensor | None = None,  # (k,) bool, which have coarse voxels; None: none
    ) -> dict[str, Tensor]:
        """Computes k cubes of voxels, by channel (k, z, y, x, c) of its dtype, on the device and
        without waiting for it. A coarse voxel is the mean of 2^3 samples in it, unless one sample
        is exact (coverage alone, of solids alone).
        """
        parts: dict[str, list[Tensor]] = {}
        for name in self.channels:
            dtype, width = CHANNELS[name]
            empty = (0, side, side, side, width)
            parts[name] = [torch.empty(empty, dtype=dtype, device=self.device)]
        step = max(1, _BATCH_VOXELS // side**3)
        for begin in range(0, len(low_k3), step):
            part = slice(begin, begin + step)
            coarse = None if coarse_k is None else coarse_k[part]
            for name, values in self._sampled(low_k3[part], voxel_k[part], side, coarse).items():
                parts[name].append(_to_channel_dtype(name, values))
        return {name: torch.cat(batches) for name, batches in parts.items()}

    def constants(self, inside_k: Tensor) -> dict[str, Tensor]:
        """Returns by channel (k, c) the values of voxels far from all triangles, inside the mesh
        where `inside_k` (k,) is true, else outside.
        """
        shape = (len(inside_k), 1, 1, 1)
        inside = inside_k.view(shape)
        far = Voxelized(
            distance=torch.full(shape, torch.inf, dtype=torch.float32, device=self.device),
            nearest=torch.full(shape, -1, dtype=torch.int32, device=self.device),
            winding=inside.to(torch.int32),
            coverage=inside.to(torch.float32),
            weight=torch.zeros((*shape, 3), dtype=torch.float32, device=self.device),
        )
        voxels = self._channels(far)
        return {name: _to_channel_dtype(name, v)[:, 0, 0, 0] for name, v in voxels.items()}

    def region(self, low: Sequence[int], high: Sequence[int]) -> dict[str, Tensor]:
        """Computes the finest voxels of a box `low` to `high`, (z, y, x).

        Returns:
            By channel (z, y, x, c) of its dtype, on the device.
        """
        block, device = _CUBE_VOXELS * _BLOCK_CUBES, self.device
        first = torch.tensor([n // block for n in low], device=device)
        count = [-(-b // block) - n // block for n, b in zip(low, high, strict=True)]
        blocks = torch.cartesian_prod(*(torch.arange(n, device=device) for n in count)).view(-1, 3)
        world = self._corner((blocks + first) * block)
        voxel = world.new_full((len(world),), self.spacing)
        touched = self.touched(world, block * voxel, voxel)

        def joined(values: Tensor) -> Tensor:  # (z, y, x) cubes
            by_axis = values.view(*count, *(_BLOCK_CUBES,) * 3).permute(0, 3, 1, 4, 2, 5)
            return by_axis.reshape([n * _BLOCK_CUBES for n in count])

        near_triangles, inside = map(joined, touched)
        cubes = near_triangles.nonzero()
        cube_low = (cubes + first * _BLOCK_CUBES) * _CUBE_VOXELS
        # Blocks may stick out of the region; cubes outside of it are not computed.
        begin, end = torch.tensor((tuple(low), tuple(high)), device=device)
        overlaps = ((cube_low + _CUBE_VOXELS > begin) & (cube_low < end)).all(1)
        out = self._blank(inside)
        batch_size = max(1, _BATCH_VOXELS // _CUBE_VOXELS**3)
        for batch in torch.stack((cubes, cube_low), 1)[overlaps].split(batch_size):
            size = torch.full((len(batch),), self.spacing, dtype=torch.float64, device=device)
            for name, values in self.cubes(self._corner(batch[:, 1]), size, _CUBE_VOXELS).items():
                out[name][batch[:, 0].unbind(1)] = values
        start = [n % block for n in low]
        box = tuple(slice(s, s + b - a) for s, a, b in zip(start, low, high, strict=True))
        return {
            name: values.permute(0, 3, 1, 4, 2, 5, 6).flatten(0, 1).flatten(1, 2).flatten(2, 3)[box]
            for name, values in out.items()
        }

    def _blank(self, inside: Tensor) -> dict[str, Tensor]:
        """Returns by channel (gz, gy, gx, z, y, x, c) cubes as if far from all triangles."""
        both = self.constants(torch.tensor([False, True], device=self.device))
        cubes = {}
        for name, values in both.items():
            cube_values = torch.where(inside[..., None], values[1], values[0])
            repeats = (1, 1, 1, *(_CUBE_VOXELS,) * 3, 1)
            cubes[name] = cube_values[..., None, None, None, :].repeat(repeats)
        return cubes

    def _corner(self, zyx: Tensor) -> Tensor:
        """Returns (k, 3) float64 world positions x, y, z of the low corners of voxels z, y, x."""
        origin = torch.tensor(self.origin, dtype=torch.float64, device=zyx.device)
        return origin + (zyx.flip(1) - 0.5) * self.spacing

    def _sampled(
        self, low: Tensor, voxel: Tensor, side: int, coarse: Tensor | None
    ) -> dict[str, Tensor]:
        """Returns by channel (k, z, y, x, c) of cubes; coarse ones are means of samples (labels:
        the last sample).
        """
        if coarse is None or self._exact_shares:
            return self._voxelized(low, voxel, voxel, side)
        sample_size = torch.where(coarse, voxel / _SAMPLES_PER_SIDE, voxel)
        is_coarse = coarse.view(-1, 1, 1, 1, 1)

        def mean(begin: int, end: int) -> dict[str, Tensor]:
            """Averages a range of samples pairwise: equal values then have exactly that mean."""
            if end - begin == 1:
                step = sample_size if begin == 0 else torch.where(coarse, sample_size, 0)
                return self._voxelized(
                    low + self._sample_offsets[begin] * sample_size[:, None], step, voxel, side
                )
            middle = (begin + end) // 2
            first, second = mean(begin, middle), mean(middle, end)
            return {
                name: torch.where(
                    is_coarse,
                    second[name] if name == "material" else 0.5 * (values + second[name]),
                    values,
                )
                for name, values in first.items()
            }

        return mean(0, len(self._sample_offsets))

    def _voxelized(self, low: Tensor, voxel: Tensor, step: Tensor, side: int) -> dict[str, Tensor]:
        size = torch.stack((voxel, step, self.reach(voxel)), 1)
        options: dict[str, Any] = {
            "shares": bool({"coverage", "color", "material"} & {*self.channels}),
            "weights": self.paint is not None,
            "wide": self._wide,
        }
        voxelized = self.geometry.cubes(low, size, side, self.thickness, **options)
        world = voxelized.distance * voxel[:, None, None, None].to(voxelized.distance.dtype)
        distance = torch.where(voxelized.nearest >= 0, world, torch.inf)
        results = {"distance": distance, "coverage": voxelized.coverage, "weight": voxelized.weight}
        float32_results = {name: values.to(torch.float32) for name, values in results.items()}
        return self._channels(voxelized._replace(**float32_results))

    def _channels(self, voxels: Voxelized) -> dict[str, Tensor]:
        """Returns (k, z, y, x, c) float32 by channel (material int64); distances in world units."""
        channels: dict[str, Tensor] = {}
        if "coverage" in self.channels:
            channels["coverage"] = voxels.coverage[..., None]
        if "distance" in self.channels:
            distance = voxels.distance.clamp(max=self.band)
            channels["distance"] = torch.where(voxels.winding != 0, -distance, distance)[..., None]
        if self.paint is not None:
            near_surface = voxels.nearest[..., None] >= 0
            face = voxels.nearest.clamp(min=0).view(-1)
            shape, weight = voxels.nearest.shape, voxels.weight.view(-1, 3)
            if "color" in self.channels:
                color = self.paint.color(face, weight).view(*shape, 4)
                color = torch.where(near_surface, color, self.paint.mean_color)
                opacity = color[..., 3:] * voxels.coverage[..., None]
                channels["color"] = torch.cat((color[..., :3] * opacity, opacity), -1)
            if "normal" in self.channels:
                normal = self.paint.normal(face, weight).view(*shape, 3)
                channels["normal"] = normal * near_surface
            if "material" in self.channels:
                material = self.paint.material[face].view(*shape, 1)
                material = torch.where(near_surface, material, self.paint.main_material) + 1
                channels["material"] = material * (voxels.coverage[..., None] >= 0.5)
        return {name: channels[name] for name in self.channels}


def _to_channel_dtype(name: str, values: Tensor) -> Tensor:
    """Returns values in the dtype of their channel, rounded to the nearest, ties to even."""
    dtype, _ = CHANNELS[name]
    if name in ("distance", "color", "material"):
        return values.to(dtype)
    return (values * torch.iinfo(dtype).max).round_().to(dtype)
