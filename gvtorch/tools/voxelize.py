"""`gvtorch voxelize`: a mesh to a store."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from .common import Bar

if TYPE_CHECKING:
    from concurrent.futures import Executor

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
    block: Literal[32, 64] = 32
    """voxels along a side of a block"""
    workers: Annotated[int | None, arg(metavar="N")] = None
    """processes; one a core if left out"""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """of a dask cluster that shares this folder, as in tcp://host:8786"""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """go on with a half-written store"""

    def run(self) -> None:
        """Voxelizes."""
        from ..io.channels import channel_names
        from ..io.mesh_source import voxelize
        from ..io.resources import amount
        from ..io.store import Store

        if self.scheduler is not None and self.workers is not None:
            raise ValueError("--scheduler brings its own workers: leave --workers out")
        start = time.perf_counter()
        with Bar(speed=True) as bar, cluster(self.scheduler) as executor:
            store = voxelize(
                *(self.path, self.output),
                resolution=self.resolution,
                channels=tuple(name.strip() for name in self.channels.split(",")),
                band=self.band,
                thickness=self.thickness,
                solid=self.solid,
                texture=self.texture,
                block=self.block,
                workers=self.workers,
                executor=executor,
                resume=self.resume,
                progress=bar,
            )
        seconds = time.perf_counter() - start
        names = channel_names(self.output)
        stores = [Store.open(self.output, image=name) for name in names] or [store]
        size = amount(sum(one.describe()["disk bytes"] for one in stores))
        extent = "x".join(str(n) for n in store.extent)
        print(f"{self.output}: {extent}, {store.levels} levels, {size} in {seconds:.1f} s")


@contextlib.contextmanager
def cluster(address: str | None) -> Iterator[Executor | None]:
    """The executor of a dask cluster, or none."""
    if address is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError:
        raise ImportError("--scheduler needs dask: pip install distributed") from None
    with Client(address, timeout="20s") as client:
        yield client.get_executor()
