"""Stores and archives that earlier versions wrote are read by this one, with the same content.

tests/data/kept was written by version 0.1.0. Files of later formats are added, none is ever
rewritten.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import TESTS
from helpers.stores import assert_holds

import gvtorch as gv
from gvtorch.io.stores.store import Store

KEPT = TESTS / "data" / "kept"
Z, Y, X = np.mgrid[0:10, 0:11, 0:12]
SCAN = ((X * 7 + Y * 5 + Z * 3) % 251).astype(np.uint8)


@pytest.fixture
def unpacked(tmp_path):
    def unpack(name: str) -> Path:
        shutil.unpack_archive(KEPT / f"{name}.zip", tmp_path / name)
        return tmp_path / name

    return unpack


def test_a_store(unpacked):
    store = Store.open(unpacked("scan.zarr"))
    assert store.spacing == (1.0, 1.0, 2.0) and store.value_range == [(0.0, float(SCAN.max()))]
    assert_holds(store, SCAN[..., None])


def test_a_store_of_times(unpacked):
    folder = unpacked("times.zarr")
    for time, data in enumerate((SCAN, 250 - SCAN)):
        assert_holds(Store.open(folder, time=time), data[..., None])


def test_a_store_of_labels(unpacked):
    store = Store.open(unpacked("labels.zarr"))
    actual = store.read_stored((0, 0, 0), SCAN.shape)[..., 0]
    assert np.array_equal(actual, SCAN.astype(np.int64) // 40 * 1000)


@pytest.mark.filterwarnings("ignore")  # torch deprecates its own TorchScript
@pytest.mark.parametrize("kind", ["tracer.pt", "tracer.pt2", "tracer_state.pt"])
def test_tracers(kind, unpacked):
    expected = np.load(KEPT / "expected.npz")
    rays = [torch.from_numpy(expected[f"ray{number}"]) for number in range(4)]
    file = str(unpacked("tracers") / kind)
    if kind == "tracer_state.pt":
        tree = gv.N3Tree.from_volume(gv.Volume(SCAN[:6, :6, :6]), 4)
        state = torch.load(file, weights_only=True)
        transfer = gv.TransferFunction.from_points([(0, 0), (100, 0.2), (250, 0.9)])
        tracer = gv.TreeTracer(tree, transfer)
        tracer.load_state_dict(state)
        outputs = tracer(*rays)
    elif kind == "tracer.pt2":
        outputs = torch.export.load(file).module()(*rays)
    else:
        outputs = torch.jit.load(file)(*rays)
    for name, output in zip(("color", "alpha"), outputs, strict=False):
        assert torch.equal(output, torch.from_numpy(expected[name])), name
    assert np.array_equal(outputs[3].numpy(), expected["samples"]) and expected["alpha"].max() > 0.3
