"""`MeshProducer`: voxelizes a mesh on demand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

import torch
from torch import Tensor

from ..base import check
from ..io.mesh_file import read_mesh
from ..meshes.holes import warn_of_holes
from ..meshes.mesh import Mesh
from ..meshes.voxelizer import CHANNELS, GridSettings, Voxelizer
from ..pool import Channel
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions


class MeshProducer(Producer):
    """Makes bricks of a mesh at any level from its triangles. Only what is seen is made, so any
    resolution is possible. The finest voxels are, to rounding, those that `gv.voxelize` writes.

    In a store, coarse voxels are means of those below; here they are means of 2^3 samples in the
    voxel (materials: one sample). The coverage of solids is the same, to rounding; that of sheets,
    and distances, differ where several parts of the surface are in a voxel. Colours and normals are
    those of the surface within `band` finest voxels or, if more, about half a voxel's diagonal.
    """

    on_device = True

    def __init__(
        self,
        mesh: Mesh | str | Path,
        *,
        channels: Sequence[str] = ("coverage",),
        branching: int = 2,
        **settings: Unpack[GridSettings],
    ) -> None:
        """Sets the mesh and its grid.

        Args:
            mesh: A `Mesh`, or a file that `read_mesh` knows.
            channels: coverage, distance, color, normal, material; see `Voxelizer`.
            branching: N.
            **settings: resolution: finest voxels along its longest side, a margin of 2 at either
                end included; 1024 if left out. band: distance in finest voxels up to which the
                nearest surface counts, 4. thickness: in finest voxels, of sheets that bound no
                solid, 1. solid: "auto", the default: closed parts are solid; "always": holes are
                filled first; "never": everything is a sheet.

        Raises:
            ValueError: It is not a mesh (see `read_mesh`), a channel is unknown, or a number is out
                of its range.
        """
        check.instance("MeshProducer", "mesh", mesh, Mesh, str, Path)
        mesh = mesh if isinstance(mesh, Mesh) else read_mesh(mesh)
        check.known_options("MeshProducer", settings, GridSettings)
        warn_of_holes(mesh, settings.get("solid", "auto"), stacklevel=2)
        grid = Voxelizer(mesh, channels=channels, **settings)
        ranges = {"coverage": (0.0, 255.0), "distance": (-grid.band, grid.band)}
        super().__init__(
            grid.extent,
            channels={name: Channel(*CHANNELS[name]) for name in grid.channels},
            spacing=grid.spacing,
            origin=grid.origin,
            branching=branching,
            value_range={name: bounds for name, bounds in ranges.items() if name in grid.channels},
            labels={"material": None} if "material" in grid.channels else None,
        )
        self.voxelizer = grid

    def prepare(self, layout: Layout) -> None:
        """Moves the triangles to the layout's device."""
        if layout.device != self.voxelizer.device:
            grid, device = self.voxelizer, layout.device
            self.voxelizer = Voxelizer(
                grid.mesh, channels=grid.channels, device=device, **grid.settings
            )

    def classify(self, nodes: Nodes) -> Regions:
        """Returns EMPTY outside (CONSTANT if there are distances) and CONSTANT inside, where no
        triangle is near any voxel in reach; else DATA.
        """
        grid = self.voxelizer
        low, voxel = _cubes(nodes, grid)
        touched, within = grid.touched(low, nodes.layout.side * voxel, voxel)
        untouched, inside = ~touched.flatten(1).any(1), within[:, 0, 0, 0]
        kind = torch.where(untouched, int(Region.CONSTANT), int(Region.DATA))
        if "distance" not in grid.channels:
            kind = torch.where(untouched & ~inside, int(Region.EMPTY), kind)
        return Regions(kind=kind, constants=grid.constants(inside))

    def fill(self, nodes: Nodes) -> Bricks:
        """Makes the bricks."""
        grid, side = self.voxelizer, nodes.layout.side
        low, voxel = _cubes(nodes, grid)
        coarse = nodes.depth.to(grid.device) < nodes.layout.depth
        if grid.device.type != "cpu":
            return Bricks(data=grid.cubes(low, voxel, side, coarse_k=coarse))
        # Finest voxels are sampled at one position, which is faster; reading `coarse` is free here.
        order = coarse.to(torch.int8).argsort(stable=True)
        fine_rows, coarse_rows = order.split([len(order) - int(coarse.sum()), int(coarse.sum())])
        fine = grid.cubes(low[fine_rows], voxel[fine_rows], side)
        low, voxel, coarse = low[coarse_rows], voxel[coarse_rows], coarse[coarse_rows]
        means = grid.cubes(low, voxel, side, coarse_k=coarse)
        row = order.argsort()
        return Bricks(data={n: torch.cat((fine[n], means[n]))[row] for n in self.channels})


def _cubes(nodes: Nodes, grid: Voxelizer) -> tuple[Tensor, Tensor]:
    """Returns low corners (k, 3) of bricks with borders, and their voxel sizes (k,), float64."""
    low = nodes.box[:, 0] - nodes.layout.border * nodes.voxel_size
    return low.to(grid.device).contiguous(), nodes.voxel_size[:, 0].to(grid.device)
