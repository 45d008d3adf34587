"""Speed of the store: conversion, and random bordered blocks a second, beside what Zarr does
without stored borders in the same run.

The volume is made up: waves and noise in a ball, zero around it. The peers keep aligned 32^3 chunks
of the same voxels and gather each bordered block from them and their neighbours.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from gvtorch.io import Store, convert

BLOCK = 32


@dataclass
class Settings:
    """What to run."""

    side: int = 1024
    counts: tuple[int, ...] = (64, 256, 1024, 4096)
    repeats: int = 5
    folder: Path | None = None
    """where the volume and the stores are kept; a temporary folder if left out"""


def write_volume(file: Path, side: int) -> None:
    """Writes a RAW volume plane by plane."""
    noise = np.random.default_rng(0).random((side, side), dtype=np.float32) * 6
    y, x = np.ogrid[:side, :side]
    centre, radius = side / 2, 0.58 * side
    with file.open("wb") as out:
        for z in range(side):
            wave = np.sin(x / 9) * np.sin(y / 8) * np.sin(z / 7)
            plane = 100 + 50 * wave + np.roll(noise, 37 * z, 1)
            plane[(x - centre) ** 2 + (y - centre) ** 2 + (z - centre) ** 2 > radius**2] = 0
            out.write(plane.astype(np.uint8).tobytes())


class Memory:
    """Largest memory of this process and its children together, while it runs, and the first that
    was seen (Linux).
    """

    def __init__(self) -> None:
        """Starts at nothing."""
        self.most, self.first, self._ends = 0, 0, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Memory:
        """Starts to look."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Ends."""
        self._ends.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ends.wait(0.05):
            own = str(os.getpid())
            total = 0
            for folder in Path("/proc").glob("[0-9]*"):
                try:
                    parent = (folder / "stat").read_text().rsplit(")", 1)[1].split()[1]
                    if own in (folder.name, parent):
                        lines = (folder / "smaps_rollup").read_text().splitlines()
                        total += next(int(line.split()[1]) for line in lines if "Pss:" in line)
                except OSError:
                    continue
            self.first = self.first or total * 1024
            self.most = max(self.most, total * 1024)


def write_aligned(path: Path, store: Store) -> None:
    """Writes the finest level with aligned chunks and no borders, many to a shard."""
    import zarr

    x, y, z = store.extent
    array = zarr.create_array(
        path, shape=(z, y, x), dtype="uint8", chunks=(BLOCK,) * 3, shards=(256,) * 3
    )
    for k in range(0, z, 256):
        array[k : k + 256] = store.read_region(0, (k, 0, 0), (min(k + 256, z), y, x))[..., 0]


def gather(read: Callable[[tuple[slice, ...]], Any], zyx: np.ndarray, side: int) -> list[Any]:
    """Reads bordered blocks as regions; those at the volume's faces come out smaller."""
    low = np.maximum(zyx * BLOCK - 1, 0)
    high = np.minimum((zyx + 1) * BLOCK + 1, side)
    return [read(tuple(map(slice, a, b))) for a, b in zip(low.tolist(), high.tolist(), strict=True)]


def rate(run: Callable[[np.ndarray], object], grid: np.ndarray, count: int, repeats: int) -> float:
    """Blocks a second: the best of some runs, each on other random blocks of data."""
    rng, best = np.random.default_rng(count), 0.0
    for _ in range(repeats):
        zyx = grid[rng.integers(0, len(grid), count)]
        start = time.perf_counter()
        run(zyx)
        best = max(best, count / (time.perf_counter() - start))
    return best


def main(settings: Settings) -> None:
    """Converts, reads, prints the table."""
    folder = settings.folder or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    side = settings.side
    raw = folder / f"ball_{side}x{side}x{side}_uint8.raw"
    if not raw.exists():
        write_volume(raw, side)
    path = folder / f"ball_{side}.zarr"
    console = Console()
    if not path.exists():
        with Memory() as memory:
            start = time.perf_counter()
            convert(raw, path)
            seconds = time.perf_counter() - start
        console.print(
            f"convert {side}^3 uint8: {seconds:.1f} s, {side**3 / seconds / 1e6:.0f} MB/s, "
            f"{memory.most / 1e9:.2f} GB of memory in all processes"
        )
    store = Store.open(path)
    console.print(f"on disk: {store.describe()['disk bytes'] / side**3:.2f} bytes a voxel")
    table = Table(title=f"random blocks of {BLOCK}^3 with border, blocks a second")
    table.add_column("read")
    for count in settings.counts:
        table.add_column(f"{count} at once", justify="right")
    for name, run, limit in readers(folder, store):
        cells = store.read_cells(0, (0, 0, 0), store.cell_grid(0))
        varied = (cells[..., 0, 0] != cells[..., 1, 0])[::4, ::4, ::4]
        grid = np.argwhere(varied)
        rates = [
            f"{rate(run, grid, min(n, limit), settings.repeats):,.0f}" for n in settings.counts
        ]
        table.add_row(name, *rates)
    console.print(table)
    if settings.folder is None:
        shutil.rmtree(folder)


def readers(folder: Path, store: Store) -> list[tuple[str, Callable[[np.ndarray], object], int]]:
    """Name, function of places, and how many of them are read at most."""
    import tensorstore as ts
    import zarr

    side = store.extent[0]
    aligned = folder / f"aligned_{side}.zarr"
    if not aligned.exists():
        write_aligned(aligned, store)
    plain = zarr.open_array(aligned, mode="r")
    spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{aligned}/"}}
    array = ts.open(spec).result()

    def batch(zyx: np.ndarray) -> None:
        for future in gather(lambda place: array[place].read(), zyx, side):
            future.result()

    return [
        ("Store.read_blocks", lambda zyx: store.read_blocks(0, zyx), 1 << 30),
        ("tensorstore, aligned chunks and neighbours", batch, 1 << 30),
        ("zarr-python, the same", lambda zyx: gather(lambda p: plain[p], zyx, side), 64),
    ]


if __name__ == "__main__":
    main(tyro.cli(Settings))
