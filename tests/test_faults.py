"""Faults at every call: open, read, write, fsync and rename fail in turn while a volume is
converted, streamed, and a picture is written. Nothing is lost, nothing hangs, and what went wrong
is told in one line.
"""

from __future__ import annotations

import errno
import os
import pathlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.pictures import GRAY
from helpers.stores import assert_holds, noise

import gvtorch as gv
from gvtorch.io import conversion, shard
from gvtorch.io.conversion import convert
from gvtorch.io.store import Store
from gvtorch.io.store_layout import WORK

VIEW = gv.Camera.orbit(width=24, height=16)


class Faults:
    """Lets the call of one number fail; counts them."""

    def __init__(self, number: int) -> None:
        self.number, self.calls = number, 0

    def wrapped(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            self.calls += 1
            if self.calls - 1 == self.number:
                raise OSError(errno.EIO, "Input/output error")
            return original(*given, **named)

        return call


@contextmanager
def failing(number: int) -> Iterator[Faults]:
    """The calls by which files of gvtorch's own are written: open, fsync, rename, remove."""
    faults = Faults(number)
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in (
            (pathlib.Path, "open"), (pathlib.Path, "replace"), (os, "fsync"),
            (pathlib.Path, "mkdir"), (shard, "write"), (shard, "finish"), (shard, "shard_files"),
        ):  # fmt: skip
            patch.setattr(owner, name, faults.wrapped(getattr(owner, name)))
        yield faults


def test_a_conversion_goes_on_after_a_fault_at_any_call(tmp_path, monkeypatch):
    data = noise((12, 14, 150, 1))
    raw = tmp_path / "a_150x14x12_uint8.raw"
    raw.write_bytes(data.tobytes())
    monkeypatch.setattr(conversion, "_check_room", lambda *_: None)
    monkeypatch.setattr(conversion, "_estimate", lambda _: None)
    with failing(-1) as whole:
        convert(raw, tmp_path / "whole.zarr", workers=1)
    broken = 0
    for number in (*range(6), *range(6, whole.calls, max(1, whole.calls // 10))):
        target = tmp_path / f"{number}.zarr"
        try:
            with failing(number):
                convert(raw, target, workers=1)
        except OSError as error:
            assert "\n" not in str(error)
            broken += 1
            if target.exists() and not (target / "zarr.json").exists():
                with pytest.raises((ValueError, OSError)):
                    Store.open(target)  # what is half-written is never opened
        assert_holds(convert(raw, target, workers=1, resume=True), data)
        assert not (target / WORK).exists()
        shutil.rmtree(target)
    assert whole.calls > 15 and broken > 8


def test_power_that_fails_before_any_file_is_on_disk(tmp_path):
    """What was renamed without being synced may be empty after a loss of power, and what was synced
    is there: of store and journal nothing is trusted that was not.
    """
    data = noise((12, 14, 300, 1))
    raw = tmp_path / "a_300x14x12_uint8.raw"
    raw.write_bytes(data.tobytes())
    synced: list[dict[str, bytes]] = []
    target = tmp_path / "a.zarr"

    def files() -> dict[str, bytes]:
        found = (file for file in target.rglob("*") if file.is_file())
        return {str(file.relative_to(target)): file.read_bytes() for file in found}

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


def test_reads_that_fail_cost_their_nodes_alone(tmp_path, monkeypatch):
    data = noise((40, 40, 40, 1))
    whole = gv.render(gv.N3Tree.from_volume(gv.Volume(data)), VIEW, GRAY)
    assert whole.alpha.max() > 0
    store = convert(gv.Volume(data), tmp_path / "a.zarr", workers=1)
    for number in (0, 2, 5):
        with gv.Engine(gv.StoredProducer(Store.open(store.location)), patience=20) as engine:
            look = gv.TransferFunction.preset("gray", 0, 255)
            with pytest.MonkeyPatch.context() as patch:
                faults = Faults(number)
                for name in ("_read_stored", "_read_cells"):
                    patch.setattr(Store, name, faults.wrapped(getattr(Store, name)))
                picture = engine.render(VIEW, look)
            assert torch.isfinite(picture.color).all()
            engine.validate()
            engine.forget_failures()
            again = engine.render(VIEW, look)
            assert again.stats.converged and not engine.failures


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
            for name in ("replace", "chmod", "close"):
                patch.setattr(os, name, faults.wrapped(getattr(os, name)))
            try:
                picture.save(file)
            except OSError as error:
                assert "\n" not in str(error)
        if faults.calls <= number:
            break
        assert file.read_bytes() == b"old" and [*tmp_path.iterdir()] == [Path(file)], number
        number += 1
    assert number >= 2 and file.stat().st_size > 100
