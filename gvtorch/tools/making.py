"""`gvtorch voxelize` makes a store of a mesh, `gvtorch splat` one of points;
`ConversionFlags`: the flags of all commands that make a store: block size, workers, resuming.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional

from ..base.messages import printable
from .common import Bar, Switch, option, parse_numbers

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..io.stores.store import Store

_MESH_FORMATS = "OBJ, PLY, STL, glTF or OFF, also compressed (.gz)"


@dataclass(frozen=True, kw_only=True)
class ConversionFlags:
    """How the store is made."""

    # voxels along a side of a block
    block: Literal[32, 64] = 32
    # number of processes; if left out: one per core, fewer if memory is short
    workers: Annotated[int | None, option(metavar="N")] = None
    # address of a dask scheduler, as in tcp://host:8786, whose workers see the store's folder under
    # the same path
    scheduler: Annotated[str | None, option(metavar="ADDRESS")] = None
    # continue a half-written store
    resume: Switch = False

    def check(self) -> None:
        """Raises ValueError if flags exclude each other."""
        if self.scheduler is not None and self.workers is not None:
            raise ValueError("--scheduler brings its own workers: leave --workers out")

    @contextlib.contextmanager
    def arguments(self, *, speed: bool = False) -> Iterator[dict[str, Any]]:
        """Yields arguments of `convert`, `voxelize` and `splat`; for `speed` see `Bar`."""
        self.check()
        with Bar(speed=speed) as bar, cluster_executor(self.scheduler) as executor:
            yield {
                "block": self.block,
                "workers": self.workers,
                "executor": executor,
                "resume": self.resume,
                "progress": bar,
            }


@dataclass(frozen=True, kw_only=True)
class Voxelize:
    """Voxelize a mesh into a store, of any resolution: OME-Zarr with bordered blocks."""

    path: Positional[Annotated[str, option(metavar="MESH", help=f"mesh: {_MESH_FORMATS}")]]
    # folder to create
    output: Annotated[Path, option(aliases=["-o"], metavar="STORE.zarr")]
    # voxels along the mesh's longest side, including a margin of 2 at either end
    resolution: Annotated[int, option(metavar="N")] = 1024
    # what to store in each voxel, one or several: coverage (share that is filled),
    # distance (signed, in world units, up to --band), color (premultiplied linear colour and
    # opacity), normal (of the nearest surface), material (labels); gvtorch render draws color
    # directly, lit by normal if it is stored too
    channels: Annotated[str, option(aliases=["--channel"], metavar="NAME,NAME,...")] = "coverage"
    # image that replaces all textures and colours; the mesh needs texture coordinates
    texture: Annotated[Path | None, option(metavar="IMAGE")] = None
    # distance up to which voxels take distance, colour and normal from the nearest surface
    band: Annotated[float, option(metavar="VOXELS")] = 4.0
    # thickness of sheets, the parts that are not solid
    thickness: Annotated[float, option(metavar="VOXELS")] = 1.0
    # auto: closed parts are solid, others sheets; always: fill holes first; never: only sheets
    solid: Literal["auto", "always", "never"] = "auto"

    conversion: tyro.conf.OmitArgPrefixes[ConversionFlags] = ConversionFlags()

    def run(self) -> None:
        from ..io.mesh_source import voxelize
        from ..io.stores.channels import channel_names
        from ..io.stores.store import Store

        start = time.perf_counter()
        channels = tuple(name.strip() for name in self.channels.split(","))
        if self.texture is not None and "color" not in channels:
            raise ValueError("--texture is for --channels color")
        with self.conversion.arguments(speed=True) as store_options:
            store = voxelize(
                *(self.path, self.output),
                resolution=self.resolution,
                channels=channels,
                band=self.band,
                thickness=self.thickness,
                solid=self.solid,
                texture=self.texture,
                **store_options,
            )
        names = channel_names(self.output)
        stores = [Store.open(self.output, image=name) for name in names] or [store]
        print(store_summary(self.output, stores, start))


@dataclass(frozen=True, kw_only=True)
class Splat:
    """Accumulate points in the voxels of a store, of any extent: OME-Zarr with bordered blocks."""

    path: Positional[
        Annotated[str, option(metavar="POINTS", help="points: arrays (.npz), PLY, or a FITS table")]
    ]
    # folder to create
    output: Annotated[Path, option(aliases=["-o"], metavar="STORE.zarr")]
    # voxels along the longest side of the box, or along x, y and z
    extent: Annotated[str, option(metavar="N or X,Y,Z", aliases=["--resolution"])] = "1024"
    # value: store the sum of the values; color: store light (value times colour) and opacity
    channels: Annotated[Literal["value", "color"], option(aliases=["--channel"])] = "value"
    # opacity of each point, for color
    opacity: Annotated[float, option(metavar="SHARE")] = 1e-4
    # world corners of the grid; points outside are skipped; if left out: a box around all points
    box: Annotated[str | None, option(metavar="X,Y,Z,X,Y,Z")] = None
    # columns of the positions, as in x,y,z; if left out: found by their usual names
    positions: Annotated[str | None, option(metavar="NAMES")] = None
    # columns of the values to add up; if left out: found by name, else 1 for each point
    values: Annotated[str | None, option(metavar="NAMES")] = None
    # columns of the colours, as in red,green,blue; if left out: found by name
    colors: Annotated[str | None, option(metavar="NAMES")] = None
    # radius of the points in world units, a column or one number for all; if left out: found by
    # name, else each point lies in one voxel
    radius: Annotated[str | None, option(metavar="NAME or SIZE")] = None
    # approximate memory for sorting the points
    memory: Annotated[str, option(metavar="BYTES")] = "1 GB"

    conversion: tyro.conf.OmitArgPrefixes[ConversionFlags] = ConversionFlags()

    def run(self) -> None:
        from ..io.point_source import splat

        start = time.perf_counter()
        if self.channels == "value" and (self.opacity != Splat.opacity or self.colors is not None):
            raise ValueError("--opacity and --colors are for --channels color")
        with self.conversion.arguments() as store_options:
            store = splat(
                self.path,
                self.output,
                opacity=self.opacity,
                channel=self.channels,
                memory=self.memory,
                **store_options,
                **self._point_arguments(),
            )
        print(store_summary(self.output, [store], start))

    def _point_arguments(self) -> dict[str, Any]:
        """Returns extent, box and columns as arguments of `splat`, those that are given."""
        count = 3 if "," in self.extent else 1
        extent = parse_numbers("--extent", self.extent, count, int)
        arguments: dict[str, Any] = {"extent": extent if count > 1 else extent[0]}
        if self.box is not None:
            corners = parse_numbers("--box", self.box, 6, float)
            arguments["box"] = (corners[:3], corners[3:])
        for name in ("positions", "values", "colors", "radius"):
            if (value := getattr(self, name)) is not None:
                arguments[name] = value
        try:
            arguments["radius"] = float(self.radius or "")
        except ValueError:
            pass
        return arguments


def store_summary(output: Path, stores: list[Store], start: float) -> str:
    """Returns a line on the stores: extent of the first, size of all, time since `start`."""
    from ..io.resources import amount

    seconds, first = time.perf_counter() - start, stores[0]
    size = amount(sum(store.describe()["disk bytes"] for store in stores))
    extent = "x".join(str(n) for n in first.extent)
    times = f" at {first.times} times" if first.times > 1 else ""
    return f"{printable(output)}: {extent}{times}, {first.levels} levels, {size} in {seconds:.1f} s"


@contextlib.contextmanager
def cluster_executor(address: str | None) -> Iterator[Executor | None]:
    """Yields the executor of a dask cluster, or None without an address."""
    if address is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError:
        raise ImportError("--scheduler needs dask: pip install distributed") from None
    with Client(address, timeout="20s") as client:
        yield client.get_executor()
