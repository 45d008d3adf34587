"""`gvtorch splat`: points to a store."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from .common import numbers
from .making import Making, told_store


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
    making: tyro.conf.OmitArgPrefixes[Making] = Making()

    def run(self) -> None:
        """Adds them up."""
        from ..io.point_source import splat

        start = time.perf_counter()
        with self.making.working() as work:
            store = splat(
                self.path,
                self.output,
                opacity=self.opacity,
                channel=self.channels,
                memory=self.memory,
                **work,
                **self._places(),
            )
        print(told_store(self.output, [store], start))

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
