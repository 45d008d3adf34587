"""Miss rate of a fly-through: a moving camera, one frame a picture, and (on CUDA, optionally) rays
that request bricks ahead of it.

The protocol is that of the original GigaVoxels' Mandelbulb flight; the volume is a synthetic one of
the same kind: a solid with holes at every scale, so that rays end at surfaces and new ones come
into view. The miss rate is bricks requested / (bricks requested + bricks used), summed over the
flight. "Fitting" is the same over frames whose view, with all that it requests, fits into the pool;
what does not fit is requested again in every frame. "Unserved" is the share of nodes whose data was
missing; pending ones count again in each frame. Bricks of 8^3 and a border hold 1,000 bytes here,
and 4,000 in the original: its 512 MB are 128 MB here. Rates depend on the camera's speed: 1,200
frames are 20 s at 60 frames a second.

With `--source formula` the solid is computed brick by brick on the device that renders; with
`--source mandelbulb` it is the original's scene, the bulb of power 8, whose voxels are 4 bytes as
in the original. On CUDA each frame is one graph (`Engine.capture`); with `--no-graph` it is
`Engine.frame`.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

import gvtorch as gv
from gvtorch.bench.scenes import worn_planes
from gvtorch.cameras.path import CameraPath


@dataclass
class Settings:
    """What to run."""

    side: int = 1024
    frames: int = 1200
    size: tuple[int, int] = (512, 512)
    source: Literal["store", "formula", "mandelbulb"] = "store"
    pools: tuple[str, ...] = ("512 MB", "128 MB", "32 MB", "8 MB")
    brick_size: int = 8
    """voxels along a side of a brick"""
    loading: str = "straight"
    workers: int = 1
    """threads that read the store"""
    batch: int = 512
    """on CUDA: most bricks that a frame makes"""
    look_ahead: float = 0
    """on CUDA: how many frames ahead of the camera rays ask for bricks"""
    fit: bool = False
    """on CUDA: views that the pool can't hold are drawn at levels that fit"""
    compiled: bool = False
    """torch.compile makes bricks and classifies nodes, in batches that are full"""
    graph: bool = True
    """on CUDA: each frame is one graph"""
    device: str = "cpu"
    resident: bool = False
    """also fly through a tree that is all in memory: what the cache costs"""
    folder: Path | None = None
    """where the store is kept; a temporary folder if left out"""


class Worn(gv.Producer):
    """The worn sphere (`worn_planes`), computed on demand. At coarse levels, the solid's edges are
    softer in proportion to the width of a voxel.
    """

    on_device = True
    wear, octaves = 0.12, [(7.0 * 2.0**n, 1.9**-n) for n in range(5)]

    def __init__(self, side: int) -> None:
        super().__init__(side, channels={"value": gv.Channel(torch.uint8)})
        #: Largest change of a value from one voxel of the finest level to the next.
        self.steepest = 5.1 * (1 + self.wear * sum(2 * k * weight for k, weight in self.octaves))

    def value(self, axes, voxel):
        """Returns values at places x, y, z, which broadcast, for voxels of a width; the caller
        clamps them to 0..255.
        """
        x, y, z = (2 / (self.extent[0] - 1) * place - 1 for place in axes)
        inside = 0.9 - (x * x + y * y + z * z).sqrt()
        for k, weight in self.octaves:
            (sx, cx), (sy, cy), (sz, cz) = (((k * a).sin(), (k * a).cos()) for a in (x, y, z))
            inside = inside + self.wear * weight * (sx * cy + sy * cz + sz * cx)
        return 128 + 2.5 * self.extent[0] / voxel * inside

    def classify(self, nodes):
        middle = self.value(nodes.center.float().unbind(1), 1)
        reach = self.steepest * nodes.radius.float()
        low, high = middle - reach, middle + reach
        kind = torch.where(high < 0, gv.Region.EMPTY, gv.Region.DATA)
        kind = torch.where(low > 255, gv.Region.CONSTANT, kind)
        ends = torch.stack((low, high), 1).clamp(0, 255).to(torch.uint8)[..., None]
        full = torch.full_like(ends[:, 0], 255)
        return gv.Regions(kind=kind, constants={"value": full}, ranges={"value": ends})

    def fill(self, nodes):
        voxel = nodes.voxel_size.float()[:, :1, None, None]
        return {"value": self.value(nodes.axes, voxel).clamp(0, 255).to(torch.uint8)}


def write_volume(file: Path, side: int) -> None:
    """Writes the worn sphere as RAW, plane by plane."""
    with file.open("wb") as out:
        for plane in worn_planes(side):
            out.write(plane.tobytes())


def mandelbulb(side: int) -> gv.Producer:
    """Returns a producer of the bulb of power 8, coloured by orbit traps."""
    colors = {"rgba": gv.Channel(torch.uint8, 4)}
    solid = gv.Solid(gv.Mandelbulb(8, iterations=6), normals=False)
    return gv.FieldProducer(solid, side, channels=colors)


def flight(middle: float, half: float) -> CameraPath:
    """Returns a path from afar to the surface, along it, into a hole, and out again, around a solid
    whose box has this middle and half this side.
    """
    keys = [(0, 0.2, 3.4), (0.6, 0.3, 2.0), (0.9, 0.4, 1.3), (1.15, 0.5, 0.5), (1.2, 0.3, -0.4)]
    keys += [(0.9, -0.2, -0.8), (0.4, -0.5, -1.1), (-0.3, -0.4, -1.3), (-1.0, 0.2, -1.6)]
    eyes = np.array(keys) * half + middle
    ahead = np.vstack((eyes[1:], eyes[-1:]))
    targets = 0.5 * middle + 0.5 * ahead  # between the middle and the next eye
    return CameraPath(eyes.tolist(), targets.tolist(), fov=[45.0] * len(keys))


def scene(settings: Settings) -> tuple[gv.Shader, list[gv.Camera]]:
    """Returns the shader and the cameras of the flight."""
    if settings.source == "mandelbulb":
        shader: gv.Shader = gv.Isosurface(127.5, None, color_channel="rgba", premultiplied=True)
        shader.channel, shader.component = "rgba", 3  # the surface is where the opacity is a half
        path = flight(0.0, 1.1)
    else:
        opacity = [(100, 0), (140, 0.9)]
        color = [(100, 0.3, 0.1, 0.05), (160, 0.9, 0.6, 0.3), (255, 1, 0.95, 0.8)]
        shader = gv.TransferFunction.from_points(opacity, color, reference=4.0)
        path = flight(settings.side / 2, settings.side / 2)
    times = np.linspace(0, 1, settings.frames)
    return shader, [path.camera(float(t), *settings.size) for t in times]


def source(settings: Settings, store: Path) -> gv.Producer:
    """Returns the producer of the scene."""
    if settings.source == "store":
        return gv.StoredProducer(store, workers=settings.workers)
    return mandelbulb(settings.side) if settings.source == "mandelbulb" else Worn(settings.side)


def compile_batches(producer: gv.Producer, batch: int) -> None:
    """Compiles `fill` for batches of this size, and `classify` for the children of as many nodes;
    batches of other sizes run eagerly.
    """

    def compiled(eager: Callable[[gv.Nodes], Any], size: int) -> Callable[[gv.Nodes], Any]:
        quick = torch.compile(eager, dynamic=False)
        return lambda nodes: (quick if len(nodes) == size else eager)(nodes)

    producer.fill = compiled(producer.fill, batch)
    producer.classify = compiled(producer.classify, producer.branching**3 * batch)


def quantiles(times: list[float]) -> list[str]:
    """Returns the median and the 99th percentile of milliseconds."""
    return [f"{sorted(times)[math.ceil(q * len(times)) - 1]:.2f}" for q in (0.5, 0.99)]


def fits(stats: gv.FrameStats) -> bool:
    """Returns whether the pool can hold a frame's view with all that it requested."""
    return stats.bricks_used + stats.requests["load"] + stats.overflow < stats.bricks


def miss_rate(all_stats: list[gv.FrameStats]) -> str:
    """Returns bricks requested / (bricks requested + bricks used), summed over frames."""
    requested = sum(stats.requests["load"] for stats in all_stats)
    used = sum(stats.bricks_used for stats in all_stats)
    return f"{requested / max(1, used + requested):.2%}"


def fly_resident(store: Path, settings: Settings, console: Console) -> list[str]:
    """Renders the same pictures from a resident tree; returns a row of the table."""
    tree = gv.N3Tree.from_volume(gv.read_volume(store), device=settings.device)
    shader, cameras = scene(settings)
    pictures = [gv.render(tree, c, shader) for c in track(cameras, "resident", console=console)]
    times = [picture.stats.milliseconds for picture in pictures]
    used = sum(picture.stats.bricks_used for picture in pictures)
    rate = f"{1e3 * len(times) / sum(times):,.0f}"
    return ["resident", "", "", "", f"{used / len(times):,.0f}", *quantiles(times), rate, "", ""]


def fly(producer: gv.Producer, pool: str, settings: Settings, console: Console) -> list[str]:
    """Flies once; returns a row of the table."""
    all_stats = []
    shader, cameras = scene(settings)
    options = {"brick_pool": pool, "node_pool": "64 MB", "loading": settings.loading}
    options["brick_size"] = settings.brick_size
    with gv.Engine(producer, device=settings.device, **options) as engine:
        engine.render(cameras[0], shader)  # the flight begins with its first view loaded
        if engine.device.type == "cuda" and settings.graph:
            graph_options = {
                "batch": settings.batch,
                "look_ahead": settings.look_ahead,
                "fit": settings.fit,
            }
            draw = engine.capture(cameras[0], shader, **graph_options).replay
        else:
            draw = partial(engine.frame, shader=shader)
        start = time.perf_counter()
        for camera in track(cameras, pool, console=console, transient=True):
            all_stats.append(draw(camera)[1])
        for stats in all_stats:
            stats.settle()
        seconds = time.perf_counter() - start
        engine.validate()
    used, missed = (sum(getattr(s, n) for s in all_stats) for n in ("bricks_used", "misses"))
    made = sum(stats.produced["bricks"] for stats in all_stats)
    times = [stats.milliseconds for stats in all_stats]
    return [
        *(pool, miss_rate(all_stats), miss_rate([s for s in all_stats if fits(s)])),
        f"{missed / (used + missed):.2%}",
        f"{used / settings.frames:,.0f}",
        *quantiles(times),
        *(f"{settings.frames / seconds:,.0f}", f"{made / seconds:,.0f}"),
        f"{sum(stats.coarser for stats in all_stats) / len(all_stats):.2f}",
    ]


def main(settings: Settings) -> None:
    """Makes the store once, then flies with each pool."""
    console = Console(stderr=True)
    context = nullcontext(settings.folder) if settings.folder else tempfile.TemporaryDirectory()
    with context as name:
        folder = Path(str(name))
        store, raw = folder / "worn.zarr", folder / f"worn_{settings.side}.raw"
        if settings.source == "store" and not store.exists():
            console.print(f"making {store}")
            write_volume(raw, settings.side)
            gv.convert(raw, store, shape=(settings.side,) * 3, dtype="uint8")
            raw.unlink()
        width, height = settings.size
        table = Table(title=f"{settings.frames} frames of {width}x{height}, {settings.loading}")
        for column in ("brick pool", "miss rate", "fitting", "unserved", "bricks used a frame"):
            table.add_column(column, justify="right")
        for column in ("median ms", "p99 ms", "frames / s", "bricks / s", "coarser"):
            table.add_column(column, justify="right")
        for pool in settings.pools:
            producer = source(settings, store)
            if settings.compiled:
                compile_batches(producer, settings.batch)
            table.add_row(*fly(producer, pool, settings, console))
        if settings.resident and settings.source == "store":
            table.add_row(*fly_resident(store, settings, console))
        Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
