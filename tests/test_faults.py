"""Faults at every call: open, read, write, fsync, rename and memory allocation fail in turn while a
volume is converted, streamed and rendered, and a picture is written. Nothing is lost, nothing
hangs, and the error is one line.
"""

from __future__ import annotations

import errno
import os
import pathlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tensorstore  # noqa: F401  # it looks for NumPy's own functions when it is loaded
import torch
from helpers.pictures import GRAY
from helpers.stores import assert_holds, noise
from torch.utils._python_dispatch import TorchDispatchMode

import gvtorch as gv
from gvtorch.io.source import VolumeSource
from gvtorch.io.stores import conversion, shard
from gvtorch.io.stores.block_reader import BlockReader
from gvtorch.io.stores.conversion import convert
from gvtorch.io.stores.level_reader import StoredArray
from gvtorch.io.stores.store import Store
from gvtorch.io.stores.store_layout import WORK
from gvtorch.io.stores.tensorstores import Deadline

VIEW = gv.Camera.orbit(width=24, height=16)


Calls = Sequence[tuple[Any, str]]
ALLOCATIONS: Calls = [
    (np, name)
    for name in ("empty", "zeros", "full", "stack", "concatenate", "where", "repeat", "array",
                 "ascontiguousarray", "moveaxis", "arange", "minimum", "maximum")
]  # fmt: skip
READS: Calls = [
    *((Deadline, "wait"), (VolumeSource, "read_region"), (StoredArray, "read")),
    *((pathlib.Path, "read_bytes"), (pathlib.Path, "read_text")),
]


def no_memory() -> Exception:
    return MemoryError("Unable to allocate 1. GiB for an array")


class Faults:
    """Counts calls, and lets the one with a given number fail."""

    def __init__(self, number: int, made: Callable[[], Exception] | None = None) -> None:
        self.number, self.calls = number, 0
        self.made = made or (lambda: OSError(errno.EIO, "Input/output error"))

    def wrapped(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            self.calls += 1
            if self.calls - 1 == self.number:
                raise self.made()
            return original(*given, **named)

        return call


class Operations(TorchDispatchMode):
    """Counts tensor operations, and lets the one with a given number run out of memory."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number, self.calls = number, 0

    def __torch_dispatch__(self, op: Any, types: Any, args: Any = (), named: Any = None) -> Any:
        self.calls += 1
        if self.calls - 1 == self.number:
            raise RuntimeError("DefaultCPUAllocator: can't allocate memory")
        return op(*args, **(named or {}))


#: The calls by which gvtorch writes its own files: open, fsync, rename, remove.
WRITES: Calls = [
    *((pathlib.Path, "open"), (pathlib.Path, "replace"), (os, "fsync"), (pathlib.Path, "mkdir")),
    *((shard, "begin_write"), (shard, "finish_write"), (shard, "shard_checksums")),
]


@contextmanager
def failing(
    number: int, calls: Calls = WRITES, make_error: Callable[[], Exception] | None = None
) -> Iterator[Faults]:
    faults = Faults(number, make_error)
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in calls:
            patch.setattr(owner, name, faults.wrapped(getattr(owner, name)))
        yield faults


@pytest.mark.parametrize("kind", ["write", "read", "memory"])
def test_a_conversion_goes_on_after_a_fault_at_any_call(tmp_path, monkeypatch, kind):
    calls = {"write": WRITES, "read": READS, "memory": ALLOCATIONS}[kind]
    make_error = no_memory if kind == "memory" else None
    data = noise((12, 14, 150, 1))
    raw = tmp_path / "a_150x14x12_uint8.raw"
    raw.write_bytes(data.tobytes())
    monkeypatch.setattr(conversion, "check_room", lambda *_: None)
    monkeypatch.setattr(conversion, "estimate_of", lambda _: None)
    with failing(-1, calls) as whole:
        convert(raw, tmp_path / "whole.zarr", workers=1)
    broken = 0
    for number in (*range(6), *range(6, whole.calls, max(1, whole.calls // 6))):
        target = tmp_path / f"{number}.zarr"
        try:
            with failing(number, calls, make_error):
                convert(raw, target, workers=1)
        except (OSError, ValueError, MemoryError) as error:
            assert str(error) and "\n" not in str(error)
            broken += 1
            if target.exists() and not (target / "zarr.json").exists():
                with pytest.raises((ValueError, OSError)):
                    Store.open(target)  # a half-written store can't be opened
        if not (target / "zarr.json").exists():
            convert(raw, target, workers=1, resume=True)
        assert_holds(Store.open(target), data)
        assert not (target / WORK).exists()
        shutil.rmtree(target)
    assert whole.calls > 15 and broken > 8


def test_power_that_fails_before_any_file_is_on_disk(tmp_path):
    """After a loss of power, files that were renamed without a sync may be empty, and synced ones
    are there: of store and journal, only synced files are trusted.
    """
    data = noise((12, 14, 300, 1))
    raw = tmp_path / "a_300x14x12_uint8.raw"
    raw.write_bytes(data.tobytes())
    synced: list[dict[str, bytes]] = []
    target = tmp_path / "a.zarr"

    def files() -> dict[str, bytes]:
        left = (file for file in target.rglob("*") if file.is_file())
        return {str(file.relative_to(target)): file.read_bytes() for file in left}

    original = os.fsync

    def fsync(handle: int) -> None:
        original(handle)
        synced.append(files())  # the power fails here

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        convert(raw, target, workers=1)
    for moment in synced[:: max(1, len(synced) // 4)]:
        shutil.rmtree(target)
        for name, content in moment.items():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            lost = name.endswith((".draft", "lock"))
            (target / name).write_bytes(b"" if lost else content)
        if (target / "zarr.json").exists():
            assert_holds(Store.open(target), data)
        else:
            assert_holds(convert(raw, target, workers=1, resume=True), data)


@pytest.mark.parametrize("kind", ["read", "memory"])
def test_reads_that_fail_cost_their_nodes_alone(tmp_path, kind):
    data = noise((40, 40, 40, 1))
    transfer = gv.TransferFunction.preset("gray", 0, 255)
    resident = gv.render(gv.N3Tree.from_volume(gv.Volume(data)), VIEW, transfer)
    assert resident.alpha.max() > 0
    store = convert(gv.Volume(data), tmp_path / "a.zarr", workers=1)
    calls = {"read": [*READS, (BlockReader, "_read_chunks"), (BlockReader, "read_cells")]}.get(kind)
    failed = 0
    for number in (*range(0, 14, 2), 20, 30):
        producer = gv.StoredProducer(Store.open(store.location), workers=1)
        with gv.Engine(producer, patience=20) as engine:
            make_error = no_memory if kind == "memory" else None
            with failing(number, calls or ALLOCATIONS, make_error) as faults:
                try:
                    picture = engine.render(VIEW, transfer)
                    assert torch.isfinite(picture.color).all()
                except (MemoryError, RuntimeError) as error:
                    assert "\n" not in str(error)
                    failed += 1
            failed += len(engine.failures) > 0
            assert faults.calls > 0
            engine.validate()
            engine.forget_failures()
            again = engine.render(VIEW, transfer)
            assert again.stats.converged and not engine.failures
            assert torch.equal(again.color, resident.color)
    assert failed > 2


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_a_frame_that_finds_no_memory_leaves_the_pools_in_order(blobs):
    """In one engine each tensor operation fails in turn; the next frames equal those of a faultless
    engine.
    """
    pools: dict[str, Any] = {"brick_size": 4, "brick_pool": 150 * 6**3 * 4, "node_pool": 9600}
    views = [gv.Camera.orbit(azimuth, 20, 0.8, None, 16, 12) for azimuth in (0, 90)]
    tree = gv.N3Tree.from_volume(blobs, 4)
    whole = [gv.render(tree, view, GRAY).color for view in views]
    number, failed, step = 0, 0, 1
    with gv.Engine(gv.VolumeProducer(blobs), **pools) as engine:
        engine.render(views[0], GRAY)
        while True:
            operations = Operations(number)
            try:
                with operations:
                    engine.render(views[1], GRAY)
            except (RuntimeError, MemoryError) as error:
                assert "memory" in str(error) and "\n" not in str(error)
                failed += 1
            engine.validate()
            engine.forget_failures()
            for view, color in zip(reversed(views), reversed(whole), strict=True):
                assert torch.equal(engine.render(view, GRAY).color, color), number
            engine.validate()
            if operations.calls <= number:
                break
            step = max(step, operations.calls // 60)  # one in 45 falls where a tile is replaced
            number += step
    assert failed > 8


@pytest.mark.parametrize("kind", ["png", "exr", "npz", "tif"])
def test_a_picture_is_there_as_a_whole_or_as_it_was(tmp_path, kind):
    picture = gv.render(
        gv.Volume(np.random.default_rng(0).random((8, 8, 8), np.float32)), VIEW, GRAY
    )
    file, number = tmp_path / f"a.{kind}", 0
    file.write_bytes(b"old")
    while True:
        faults = Faults(number)
        with pytest.MonkeyPatch.context() as patch:
            for owner, name in ((os, "replace"), (os, "chmod"), (os, "close"), *ALLOCATIONS):
                patch.setattr(owner, name, faults.wrapped(getattr(owner, name)))
            try:
                picture.save(file)
            except (OSError, MemoryError) as error:
                assert "\n" not in str(error)
        if faults.calls <= number:
            break
        assert file.read_bytes() == b"old" and [*tmp_path.iterdir()] == [Path(file)], number
        number += 1
    assert number >= 2 and file.stat().st_size > 100
