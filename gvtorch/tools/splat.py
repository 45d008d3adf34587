"""`gvtorch splat`: points to a store."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from .common import Bar, numbers
from .voxelize import cluster


@dataclass(frozen=True, kw_only=True)
class Splat:
    """Add points up in the voxels of a store, of any extent: OME-Zarr with bordered blocks."""

    path: Positional[
        Annotated[str, arg(metavar="POINTS", help="arrays (.npz), PLY, or a FITS table")]
    ]
    output: Annotated[Path, arg(aliases=["-o"], metavar="STORE.zarr")]
    """the folder to make"""
    extent: Annotated[str, arg(metavar="N or X,Y,Z", aliases=["--resolution"])] = "1024"
    """voxels along the longest side, or along each"""
    channels: Annotated[Literal["value", "color"], arg(aliases=["--channel"])] = "value"
    """what a voxel holds: the sum of values; or light, the value times the colour, and opacity"""
    opacity: Annotated[float, arg(metavar="SHARE")] = 1e-4
    """of a point, for color"""
    box: Annotated[str | None, arg(metavar="X,Y,Z,X,Y,Z")] = None
    """world corners; points outside are left out; around all if left out"""
    positions: Annotated[str | None, arg(metavar="NAMES")] = None
    """columns, as in x,y,z; known by their names if left out, as are the next three"""
    values: Annotated[str | None, arg(metavar="NAMES")] = None
    """columns whose numbers add up"""
    colors: Annotated[str | None, arg(metavar="NAMES")] = None
    """columns, as in red,green,blue"""
    radius: Annotated[str | None, arg(metavar="NAME or SIZE")] = None
    """how far points reach: a column, or one number for all; if there is none, a voxel each"""
    memory: Annotated[str, arg(metavar="BYTES")] = "1 GB"
    """that sorting takes, roughly"""
    block: Literal[32, 64] = 32
    """voxels along a side of a block"""
    workers: Annotated[int | None, arg(metavar="N")] = None
    """processes; one a core if left out"""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """of a dask cluster that shares this folder, as in tcp://host:8786"""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """go on with a half-written store"""

    def run(self) -> None:
        """Adds them up."""
        from ..io.point_source import splat
        from ..io.resources import amount

        if self.scheduler is not None and self.workers is not None:
            raise ValueError("--scheduler brings its own workers: leave --workers out")
        start = time.perf_counter()
        with Bar() as bar, cluster(self.scheduler) as executor:
            store = splat(
                self.path,
                self.output,
                opacity=self.opacity,
                channel=self.channels,
                memory=self.memory,
                block=self.block,
                workers=self.workers,
                executor=executor,
                resume=self.resume,
                progress=bar,
                **self._places(),
            )
        seconds = time.perf_counter() - start
        size = amount(store.describe()["disk bytes"])
        extent = "x".join(str(n) for n in store.extent)
        print(f"{self.output}: {extent}, {store.levels} levels, {size} in {seconds:.1f} s")

    def _places(self) -> dict[str, Any]:
        """Extent, box and columns, those that are given."""
        count = 3 if "," in self.extent else 1
        extent = numbers("--extent", self.extent, count, int)
        found: dict[str, Any] = {"extent": extent if count > 1 else extent[0]}
        if self.box is not None:
            corners = numbers("--box", self.box, 6, float)
            found["box"] = (corners[:3], corners[3:])
        for name in ("positions", "values", "colors", "radius"):
            if (given := getattr(self, name)) is not None:
                found[name] = given
        try:
            found["radius"] = float(self.radius or "")
        except ValueError:
            pass
        return found
