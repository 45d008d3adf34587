"""`MeshProducer`: the voxels of a mesh, made while it is looked at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..io.mesh_file import read_mesh
from ..meshes.mesh import Mesh
from ..meshes.voxelizer import CHANNELS, Voxelizer
from ..pool import Channel
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions

_FINER = 2  # places along a side that a coarse voxel is the mean of


class MeshProducer(Producer):
    """Makes bricks of a mesh at any level, out of its triangles: nothing is made that is not looked
    at, so the resolution is free. What the finest voxels hold is what `gv.voxelize` writes.

    Where a store's coarse voxels are means of those below, these are means of 2^3 places in each,
    every one with a plane through it. Coverage and distance differ where several parts of the
    surface lie in a voxel; colours and normals come of the surface within `band` voxels of each
    level.
    """

    def __init__(
        self,
        mesh: Mesh | str | Path,
        *,
        resolution: int = 1024,
        channels: Sequence[str] = ("coverage",),
        band: float = 4.0,
        thickness: float = 1.0,
    ) -> None:
        """Takes a mesh.

        Args:
            mesh: A `Mesh`, or a file that `read_mesh` knows.
            resolution: Finest voxels along its longest side.
            channels: coverage, distance, color, normal, material; see `Voxelizer`.
            band: Finest voxels up to which the nearest place of the surface counts.
            thickness: Finest voxels, of what bounds no solid.

        Raises:
            ValueError: A number is out of its range, a channel unknown, or see `read_mesh`.
        """
        mesh = mesh if isinstance(mesh, Mesh) else read_mesh(mesh)
        self._told: dict[str, Any] = {
            "resolution": resolution,
            "channels": channels,
            "band": band,
            "thickness": thickness,
        }
        grid = Voxelizer(mesh, **self._told)
        ranges = {"coverage": (0.0, 255.0), "distance": (-grid.band, grid.band)}
        super().__init__(
            grid.extent,
            channels={name: Channel(*CHANNELS[name]) for name in grid.channels},
            spacing=grid.spacing,
            origin=grid.origin,
            value_range={name: one for name, one in ranges.items() if name in grid.channels},
            labels={"material": None} if "material" in grid.channels else None,
        )
        self.voxelizer = grid

    def prepare(self, layout: Layout) -> None:
        """Moves the triangles to where they are worked on."""
        if layout.device != self.voxelizer.device:
            self.voxelizer = Voxelizer(self.voxelizer.mesh, **self._told, device=layout.device)

    def classify(self, nodes: Nodes) -> Regions:
        """EMPTY outside and CONSTANT inside, where no triangle comes near any voxel in reach."""
        grid, layout = self.voxelizer, nodes.layout
        kind = torch.full((len(nodes),), int(Region.DATA), device=grid.device)
        inside = torch.zeros(len(nodes), dtype=torch.bool, device=grid.device)
        for here, low, voxel in _by_depth(nodes, grid):
            high = low + layout.side * voxel
            bare = here[~grid.geometry.touched(low, high, grid.reach(voxel))]
            inside[bare] = grid.geometry.winding(nodes.center.to(grid.device)[bare]) != 0
            kind[bare] = int(Region.CONSTANT)
        constants = grid.constants(inside)
        if "distance" not in grid.channels:
            kind[(kind == Region.CONSTANT) & ~inside] = int(Region.EMPTY)
        return Regions(kind=kind, constants=constants)

    def fill(self, nodes: Nodes) -> Bricks:
        """Makes the bricks, level by level."""
        grid, layout = self.voxelizer, nodes.layout
        data = {
            name: torch.empty(
                (len(nodes), *(layout.side,) * 3, one.width), dtype=one.dtype, device=grid.device
            )
            for name, one in self.channels.items()
        }
        for here, low, voxel in _by_depth(nodes, grid):
            finer = 1 if voxel < 1.5 * grid.spacing else _FINER
            for name, made in grid.cubes(low, voxel, layout.side, finer=finer).items():
                data[name][here] = made
        return Bricks(data=data)


def _by_depth(nodes: Nodes, grid: Voxelizer) -> list[tuple[Tensor, Tensor, float]]:
    """For each depth which of the nodes it has, (m,), the low corners of their bricks with border,
    (m, 3) float64, and the size of their voxels.
    """
    found = []
    low = nodes.box[:, 0] - nodes.layout.border * nodes.voxel_size
    for depth in nodes.depth.unique().tolist():
        here = (nodes.depth == depth).nonzero()[:, 0]
        voxel = grid.spacing * nodes.layout.branching ** (nodes.layout.depth - depth)
        found.append((here.to(grid.device), low[here].to(grid.device), float(voxel)))
    return found
