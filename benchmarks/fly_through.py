"""Miss rate of a fly-through: a moving camera, one frame a picture, nothing fetched ahead.

The protocol is that of the original's Mandelbulb flight; the volume is a made-up one of the same
kind: a solid with holes at every scale, so that rays end at surfaces and new ones come into view.
The rate is bricks asked for over bricks asked for and bricks used, summed over the flight;
"unserved" is the share of nodes that were not there yet, those on their way counted again in each
frame. Bricks of 8^3 and a border hold 1,000 bytes here, and 4,000 in the original: its 512 MB are
128 MB here. How fast the camera moves decides: 1,200 frames are 20 s at 60 frames a second.
"""

from __future__ import annotations

import tempfile
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
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
    size: int = 512
    pools: tuple[str, ...] = ("512 MB", "128 MB", "32 MB", "8 MB")
    loading: str = "straight"
    device: str = "cpu"
    folder: Path | None = None
    """where the store is kept; a temporary folder if left out"""


def write_volume(file: Path, side: int) -> None:
    """Writes the worn sphere as RAW, plane by plane."""
    with file.open("wb") as out:
        for plane in worn_planes(side):
            out.write(plane.tobytes())


def flight(side: int) -> CameraPath:
    """From afar to the surface, along it, into a hole, and out again."""
    keys = [(0, 0.2, 3.4), (0.6, 0.3, 2.0), (0.9, 0.4, 1.3), (1.15, 0.5, 0.5), (1.2, 0.3, -0.4)]
    keys += [(0.9, -0.2, -0.8), (0.4, -0.5, -1.1), (-0.3, -0.4, -1.3), (-1.0, 0.2, -1.6)]
    eyes = (np.array(keys) + 1) * side / 2
    ahead = np.vstack((eyes[1:], eyes[-1:]))
    targets = 0.5 * (side / 2) + 0.5 * ahead  # between the middle and the way
    return CameraPath(eyes.tolist(), targets.tolist(), fov=[45.0] * len(keys))


def fly(store: Path, pool: str, settings: Settings, console: Console) -> list[str]:
    """Flies once; returns a row of the table."""
    opacity = [(100, 0), (140, 0.9)]
    color = [(100, 0.3, 0.1, 0.05), (160, 0.9, 0.6, 0.3), (255, 1, 0.95, 0.8)]
    shader = gv.TransferFunction.from_points(opacity, color, reference=4.0)
    path, used, asked, missed = flight(settings.side), 0, 0, 0
    options = {"brick_pool": pool, "node_pool": "64 MB", "loading": settings.loading}
    with gv.Engine(gv.StoredProducer(store), device=settings.device, **options) as engine:
        first = path.camera(0.0, settings.size, settings.size)
        engine.render(first, shader)  # the flight begins with what its first view needs
        places = np.linspace(0, 1, settings.frames)
        for place in track(places, pool, console=console, transient=True):
            view = path.camera(float(place), settings.size, settings.size)
            _, stats = engine.frame(view, shader)
            used, missed = used + stats.bricks_used, missed + stats.misses
            asked += stats.requests["load"]
        report = engine.report().as_dict()
        engine.validate()
    return [
        *(pool, f"{asked / (used + asked):.2%}", f"{missed / (used + missed):.2%}"),
        f"{used / settings.frames:,.0f}",
        *(f"{report['milliseconds']['median']:.0f}", f"{report['bricks_per_second']:,.0f}"),
        f"{report['megabytes_per_second']:.1f}",
    ]


def main(settings: Settings) -> None:
    """Makes the store once, then flies with each pool."""
    console = Console(stderr=True)
    kept = nullcontext(settings.folder) if settings.folder else tempfile.TemporaryDirectory()
    with kept as name:
        folder = Path(str(name))
        store, raw = folder / "worn.zarr", folder / f"worn_{settings.side}.raw"
        if not store.exists():
            console.print(f"making {store}")
            write_volume(raw, settings.side)
            gv.convert(raw, store, shape=(settings.side,) * 3, dtype="uint8")
            raw.unlink()
        table = Table(title=f"{settings.frames} frames of {settings.size}^2, {settings.loading}")
        for column in ("brick pool", "miss rate", "unserved", "bricks used a frame"):
            table.add_column(column, justify="right")
        for column in ("ms a frame", "bricks / s", "MB / s"):
            table.add_column(column, justify="right")
        for pool in settings.pools:
            table.add_row(*fly(store, pool, settings, console))
        Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
