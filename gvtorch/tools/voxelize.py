"""`gvtorch voxelize`: a mesh to a store."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from .making import Making, told_store

_ENDINGS = "OBJ, PLY, STL, glTF or OFF, also with .gz behind"


@dataclass(frozen=True, kw_only=True)
class Voxelize:
    """Voxelize a mesh into a store, of any resolution: OME-Zarr with bordered blocks."""

    path: Positional[Annotated[str, arg(metavar="MESH", help=f"the mesh: {_ENDINGS}")]]
    output: Annotated[Path, arg(aliases=["-o"], metavar="STORE.zarr")]
    """the folder to make"""
    resolution: Annotated[int, arg(metavar="N")] = 1024
    """voxels along the mesh's longest side"""
    channels: Annotated[str, arg(aliases=["--channel"], metavar="NAME,NAME,...")] = "coverage"
    """what a voxel holds, one or several: coverage, the filled share; distance, signed, up to the
    band; color, premultiplied linear colour and opacity; normal, the surface's; material, labels.
    color and normal together are drawn as they are, lit"""
    texture: Annotated[Path | None, arg(metavar="IMAGE")] = None
    """an image that is laid on all that has texture coordinates"""
    band: Annotated[float, arg(metavar="VOXELS")] = 4.0
    """how far from the surface distances, colours and normals are told"""
    thickness: Annotated[float, arg(metavar="VOXELS")] = 1.0
    """of parts that are not closed"""
    solid: Literal["auto", "always", "never"] = "auto"
    """auto: what is closed is a solid, all else a sheet; always: holes are filled; never: all is a
    sheet"""
    making: tyro.conf.OmitArgPrefixes[Making] = Making()

    def run(self) -> None:
        """Voxelizes."""
        from ..io.mesh_source import voxelize
        from ..io.stores.channels import channel_names
        from ..io.stores.store import Store

        start = time.perf_counter()
        with self.making.working(speed=True) as work:
            store = voxelize(
                *(self.path, self.output),
                resolution=self.resolution,
                channels=tuple(name.strip() for name in self.channels.split(",")),
                band=self.band,
                thickness=self.thickness,
                solid=self.solid,
                texture=self.texture,
                **work,
            )
        names = channel_names(self.output)
        stores = [Store.open(self.output, image=name) for name in names] or [store]
        print(told_store(self.output, stores, start))
