"""Stores: random volumes with constant regions, images by other writers, and a web server."""

from __future__ import annotations

import functools
import http.server
import re
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import gvtorch as gv
from gvtorch.io.stores import shard
from gvtorch.io.stores.store import Store
from gvtorch.pool.pyramid import round_to, volume_levels

from .servers import WebServer


def read_with_warnings(path: Path, **options) -> tuple[gv.Volume, list[str]]:
    """Reads a volume; returns it, and the warnings of reading it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        volume = gv.read_volume(path, **options)
    return volume, [str(warning.message) for warning in caught]


@contextmanager
def stopped_at(monkeypatch: pytest.MonkeyPatch, number: int) -> Iterator[None]:
    """Stops conversions on disk within the block at the number-th shard, as by Ctrl-C."""
    original, positions = shard.write_shard, []

    def stop(job, level, position):
        if "memory" not in job.root["driver"]:
            positions.append(position)
            if len(positions) == number:
                raise KeyboardInterrupt
        return original(job, level, position)

    with monkeypatch.context() as patch:
        patch.setattr(shard, "write_shard", stop)
        yield


def noise(shape: tuple[int, ...], dtype: str = "uint8", seed: int = 0) -> np.ndarray:
    """Returns (z, y, x, c) random values with constant regions among them."""
    rng = np.random.default_rng(seed)
    low, high = (0, 255) if dtype.startswith("u") else (-120, 120)
    data = (rng.random(shape) * (high - low) + low).astype(dtype)
    z, y, x = (n // 2 for n in shape[:3])
    data[:z, :y] = 3
    data[z:, y:, :x] = 0
    return data


def block_of(level: np.ndarray, position: np.ndarray, block: int) -> np.ndarray:
    """Returns a block with its border, cut out of a whole level."""
    indices = [
        np.arange(n * block - 1, (n + 1) * block + 1).clip(0, size - 1)
        for n, size in zip(position, level.shape[:3], strict=True)
    ]
    return level[np.ix_(*indices)]


def assert_holds(store: Store, data: np.ndarray) -> None:
    """Asserts that the store has the bits of the pyramid that is built in memory."""
    sizes = {"branching": 2, "brick_size": store.cell, "border": store.border}
    levels = list(volume_levels(gv.Volume(data), store.levels, **sizes))
    for number, level in enumerate(levels):
        values = level.values.numpy()
        assert store.level_extent(number) == values.shape[2::-1]
        assert np.array_equal(store.read_region(number, (0, 0, 0), values.shape[:3]), values)
        positions = np.array(list(np.ndindex(*store.block_grid(number))))
        blocks, errors = store.read_blocks(number, positions)
        assert not errors
        for block, position in zip(blocks, positions, strict=True):
            assert np.array_equal(block, block_of(values, position, store.block))
        if store.has_blocks:
            cells = store.read_cells(number, (0, 0, 0), store.cell_grid(number))
            for index, expected in enumerate((level.nodes.low, level.nodes.high, level.nodes.mean)):
                rounded = round_to(expected, store.dtype).numpy()
                assert np.array_equal(cells[..., index, :], rounded)
    assert max(store.level_extent(store.levels - 1)) <= 8


def write_foreign(
    folder: Path,
    arrays: list[np.ndarray],
    axes: str,
    scales: list[list[float]],
    *,
    version: int = 3,
    sharded: bool = False,
    name: str = "a",
) -> Path:
    """Writes an image with zarr-python: NGFF 0.5 on Zarr v3, or 0.4 on v2."""
    import zarr

    group = zarr.open_group(folder, mode="w", zarr_format=version)  # type: ignore[arg-type]
    datasets = []
    for number, (array, scale) in enumerate(zip(arrays, scales, strict=True)):
        chunk = tuple(min(16, n) for n in array.shape)
        options = {"shards": tuple(4 * n for n in chunk)} if sharded else {}
        dataset = group.create_array(
            f"s{number}", shape=array.shape, dtype=array.dtype, chunks=chunk, **options
        )
        dataset[...] = array
        transforms = [{"type": "scale", "scale": scale}]
        datasets.append({"path": f"s{number}", "coordinateTransformations": transforms})
    kinds = {"t": "time", "c": "channel"}
    named = [{"name": axis, "type": kinds.get(axis, "space")} for axis in axes]
    image = {"name": name, "axes": named, "datasets": datasets}
    if version == 3:
        group.attrs["ome"] = {"version": "0.5", "multiscales": [image]}
    else:
        group.attrs["multiscales"] = [{**image, "version": "0.4"}]
    return folder


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves a folder with byte ranges, as data servers do; chunks after `delay` seconds."""

    delay = 0.0

    def do_GET(self) -> None:
        if "/c/" in self.path:
            time.sleep(self.delay)
        file = Path(self.translate_path(self.path))
        byte_range = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers.get("Range", ""))
        if byte_range is None or not file.is_file():
            super().do_GET()
            return
        content = file.read_bytes()
        first, last = byte_range.groups()
        start = int(first) if first else len(content) - int(last)
        stop = int(last) + 1 if first and last else len(content)
        self.send_response(206)
        self.send_header("Content-Length", str(stop - start))
        self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{len(content)}")
        self.end_headers()
        self.wfile.write(content[start:stop])

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serving(folder: Path, kind: type[Handler] = Handler) -> Iterator[str]:
    """Serves a folder within the block, by handlers of a kind; yields its URL."""
    handler = functools.partial(kind, directory=str(folder))
    server = WebServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    Handler.delay = 0.0
    server.shutdown()
    server.server_close()
    thread.join()
