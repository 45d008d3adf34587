"""Stores: `convert` (a volume file to a store) and `blocks` (random bordered blocks out of one,
compared in the same run with Zarr without stored borders).

The volume is synthetic: waves and noise in a ball, zero around it. The peers store aligned chunks
of the same voxels, and gather each bordered block from a chunk and its neighbours.
"""

from __future__ import annotations

import functools
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..io.stores.conversion import convert as convert_volume
from ..io.stores.store import Store
from .record import Record, clock, summarize

_BLOCK_SIDE = 32
Reader = Callable[[np.ndarray], object]


def convert(record: Record) -> None:
    """Converts a RAW file to a store on all cores; the file is in the page cache."""
    settings = record.settings
    side = 64 if settings.quick else 1024
    case = f"{side}^3 uint8"
    if not record.wants(case):
        return
    with tempfile.TemporaryDirectory() as directory:
        raw, path = _write_raw(Path(directory), side), Path(directory) / "ball.zarr"
        clock_store(record, case, path, lambda: convert_volume(raw, path), source_bytes=side**3)


def blocks(record: Record) -> None:
    """Reads random blocks that hold data, in calls of 64 to 4096 blocks."""
    settings = record.settings
    side = 64 if settings.quick else 1024
    counts = (8,) if settings.quick else (64, 256, 1024, 4096)
    cases = {count: f"{count:,} blocks of {_BLOCK_SIDE}^3 and border" for count in counts}
    cases = {count: case for count, case in cases.items() if record.wants(case)}
    if not cases:
        return
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory)
        settings.tell("blocks: making a store")
        store = convert_volume(_write_raw(folder, side), folder / "ball.zarr")
        readers = dict(_readers(record, folder, store))
        cells = store.read_cells(0, (0, 0, 0), store.cell_grid(0))
        indices = np.argwhere((cells[..., 0, 0] != cells[..., 1, 0])[::4, ::4, ::4])
        rng = np.random.default_rng(4)
        for count, case in cases.items():
            for who, read in readers.items():
                if who == "zarr" and count > 64:
                    continue
                settings.tell(f"{case}: {who}")
                timing = clock(functools.partial(_read_random, read, rng, indices, count), settings)
                rate, times = 1e3 * count / timing.median, record.relative_to_first(case, timing)
                record.add(case, who, timing, blocks_per_second=rate, **times)
    record.note("peers gather blocks from aligned chunks of the same size; zarr: only 64 blocks")


def _read_random(read: Reader, rng: np.random.Generator, indices: np.ndarray, count: int) -> None:
    read(indices[rng.integers(0, len(indices), count)])


def _write_raw(folder: Path, side: int) -> Path:
    """Writes the volume plane by plane."""
    file = folder / f"ball_{side}x{side}x{side}_uint8.raw"
    noise = np.random.default_rng(0).random((side, side), dtype=np.float32) * 6
    y, x = np.ogrid[:side, :side]
    centre, radius = side / 2, 0.58 * side
    with file.open("wb") as out:
        for z in range(side):
            wave = np.sin(x / 9) * np.sin(y / 8) * np.sin(z / 7)
            plane = 100 + 50 * wave + np.roll(noise, 37 * z, 1)
            plane[(x - centre) ** 2 + (y - centre) ** 2 + (z - centre) ** 2 > radius**2] = 0
            out.write(plane.astype(np.uint8).tobytes())
    return file


def _readers(record: Record, folder: Path, store: Store) -> Iterator[tuple[str, Reader]]:
    """Yields the name of each reader, ours first, and its function of block indices (k, 3)."""
    yield "gvtorch", lambda zyx: store.read_blocks(0, zyx)
    peers = [name for name in ("tensorstore", "zarr") if record.has_peer(name, "zarr")]
    if not peers:
        return
    import tensorstore as ts
    import zarr

    side = store.extent[0]
    aligned = folder / "aligned.zarr"
    _write_aligned(aligned, store)
    if "tensorstore" in peers:
        spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{aligned}/"}}
        array = ts.open(spec).result()

        def read_all(zyx: np.ndarray) -> None:
            for future in _gather(lambda region: array[region].read(), zyx, side):
                future.result()

        yield "tensorstore", read_all
    if "zarr" in peers:
        zarr_array = zarr.open_array(aligned, mode="r")
        yield "zarr", lambda zyx: _gather(lambda region: zarr_array[region], zyx, side)


def _write_aligned(path: Path, store: Store) -> None:
    """Writes the finest level with aligned chunks and no borders, many to a shard."""
    import zarr

    x, y, z = store.extent
    shard = min(256, x)
    array = zarr.create_array(
        path, shape=(z, y, x), dtype="uint8", chunks=(_BLOCK_SIDE,) * 3, shards=(shard,) * 3
    )
    for k in range(0, z, shard):
        array[k : k + shard] = store.read_region(0, (k, 0, 0), (min(k + shard, z), y, x))[..., 0]


def _gather(read: Callable[[tuple[slice, ...]], Any], zyx: np.ndarray, side: int) -> list[Any]:
    """Reads bordered blocks as regions; those at the volume's faces are smaller."""
    low = np.maximum(zyx * _BLOCK_SIDE - 1, 0)
    high = np.minimum((zyx + 1) * _BLOCK_SIDE + 1, side)
    return [read(tuple(map(slice, a, b))) for a, b in zip(low.tolist(), high.tolist(), strict=True)]


def clock_store(
    record: Record, case: str, path: Path, make: Callable[[], Store], **amounts: int
) -> None:
    """Times `make`, which writes a store at a path, repeatedly; adds a row with its memory and disk
    use, and with each of the `amounts` per second.
    """
    settings, times, peak = record.settings, list[float](), 0
    began = time.perf_counter()
    while not times or (
        len(times) < settings.repeats and time.perf_counter() - began < settings.seconds
    ):
        settings.tell(f"{case}: {len(times) + 1}")
        shutil.rmtree(path, ignore_errors=True)
        with MemorySampler() as memory:
            start = time.perf_counter()
            store = make()
            times.append(1e3 * (time.perf_counter() - start))
        peak = max(peak, memory.peak)
    timing = summarize(times)
    speeds = {f"{name}_per_second": 1e3 * n / timing.median for name, n in amounts.items()}
    disk = store.describe()["disk bytes"]
    record.add(case, "gvtorch", timing, **speeds, memory_bytes=peak, disk_bytes=disk)
    record.note("memory bytes: the peak of this process and its workers; there is no warm-up run")


class MemorySampler:
    """Samples the memory of this process and its children together while it is entered; `peak` and
    `initial` are the largest and the first sample, in bytes (Linux).
    """

    def __init__(self) -> None:
        self.peak, self.initial, self._stopped = 0, 0, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> MemorySampler:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stopped.wait(0.05):
            own_id = str(os.getpid())
            total = 0
            for folder in Path("/proc").glob("[0-9]*"):
                try:
                    parent = (folder / "stat").read_text().rsplit(")", 1)[1].split()[1]
                    if own_id in (folder.name, parent):
                        lines = (folder / "smaps_rollup").read_text().splitlines()
                        total += next(int(line.split()[1]) for line in lines if "Pss:" in line)
                except OSError:
                    continue
            self.initial = self.initial or total * 1024
            self.peak = max(self.peak, total * 1024)
