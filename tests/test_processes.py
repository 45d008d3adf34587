"""Producers, trees and stores in other processes: pickled, spawned and forked."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from concurrent.futures import Future
from pathlib import Path

import loaders
import numpy as np
import pytest
import torch
from helpers import meshes
from helpers.packets import result, start
from helpers.pictures import GRAY, assert_same_picture
from helpers.processes import in_forked_child
from helpers.stores import noise

import gvtorch as gv
from gvtorch.cpp_ext import instructions
from gvtorch.io.stores.conversion import convert

VIEW = gv.Camera.orbit(width=16, height=12)
POOLS = {"node_pool": "1 MB", "brick_pool": "4 MB"}


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("processes") / "a.zarr"
    convert(gv.Volume(noise((20, 22, 24, 1))), target, workers=1)
    return target


def producers(store: Path) -> dict[str, gv.Producer]:
    return {
        "stored": gv.StoredProducer(store, workers=2),
        "volume": gv.VolumeProducer(gv.Volume(noise((20, 22, 24, 1))), hold="bricks"),
        "field": gv.FieldProducer(gv.sdf.Sphere(), 16),
        "points": gv.PointProducer(torch.rand(50, 3), extent=16),
        "mesh": gv.MeshProducer(meshes.box(), resolution=16),
    }


@pytest.mark.parametrize("name", ["stored", "volume", "field", "points", "mesh"])
def test_producers_are_pickled(store, name):
    producer = producers(store)[name]
    shader = gv.StoredColor("rgba") if "rgba" in producer.channels else None
    shader = shader or gv.TransferFunction.preset("gray", 0, 1)
    other = pickle.loads(pickle.dumps(producer))
    with gv.Engine(producer, **POOLS) as engine:
        expected = engine.render(VIEW, shader)
        assert expected.alpha.max() > 0
        again = copy.deepcopy(other)  # before an engine has prepared it
        used = copy.deepcopy(producer)  # a copy serves no engine
        with gv.Engine(used, **POOLS) as second:
            assert torch.equal(second.render(VIEW, shader).color, expected.color)
    for copied in (other, again, pickle.loads(pickle.dumps(used))):
        with gv.Engine(copied, **POOLS) as engine:
            assert torch.equal(engine.render(VIEW, shader).color, expected.color)


def test_a_store_is_pickled_with_what_it_was_asked_for(tmp_path):
    data = np.stack([noise((9, 9, 9, 2), seed=seed) for seed in (0, 1)])
    np.save(tmp_path / "a.npy", data)
    convert(tmp_path / "a.npy", tmp_path / "a.zarr", axes="tzyxc", workers=1)
    store = gv.Store.open(tmp_path / "a.zarr", time=1, channels=[1])
    other = pickle.loads(pickle.dumps(store))
    whole = (0, 0, 0), (9, 9, 9)
    assert other.time == 1 and np.array_equal(other.read_region(0, *whole), data[1][..., 1:])


@pytest.fixture(scope="module")
def workers(store, tmp_path_factory) -> dict[str, float | str]:
    """What `loaders.by_workers` returns in a process that has opened no store before."""
    folder = tmp_path_factory.mktemp("workers")
    return result(start(loaders.by_workers, folder, instructions(), STORE=str(store)))


def test_an_engine_says_that_it_is_not_copied(blobs):
    with gv.Engine(gv.VolumeProducer(blobs)) as engine:
        for take in (pickle.dumps, copy.copy, copy.deepcopy):
            with pytest.raises(TypeError, match="Engine: it can't be copied or pickled: make one"):
                take(engine)


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_workers_of_data_loaders(workers, method):
    """A forked worker opens its own store; using one that was opened before is a one-line error."""
    if method == "spawn":
        assert isinstance(workers["spawn outside"], float) and workers["spawn outside"] > 0, workers
        return
    assert isinstance(workers["fork inside"], float) and workers["fork inside"] > 0, workers
    assert "forked after one was opened" in str(workers["fork outside"]), workers


@pytest.mark.backend("cuda")
@pytest.mark.filterwarnings("ignore:.*fork")
def test_a_forked_child_is_told_that_it_can_not_use_cuda(blobs):
    gv.N3Tree.from_volume(blobs, device="cuda")
    told = in_forked_child(lambda: gv.Engine(gv.VolumeProducer(blobs), device="cuda"))
    assert "Engine: device 'cuda' can't be used here: this process was forked" in told


@pytest.mark.backend("cuda")
def test_an_import_leaves_cuda_to_forked_children():
    """Workers of a data loader, say, may use CUDA if the process that forks them does not."""
    code = """
import gvtorch as gv, gvtorch.ops, torch
from helpers.processes import in_forked_child
volume = gv.Volume(torch.ones(8, 8, 8))
shader = gv.TransferFunction.preset("gray", 0, 1)
gv.render(gv.N3Tree.from_volume(volume), gv.Camera.orbit(width=4, height=4), shader)
print(in_forked_child(lambda: gv.Engine(gv.VolumeProducer(volume), device="cuda").device))
"""
    ran = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        text=True,
        capture_output=True,
        check=False,
    )
    assert ran.stdout.strip() == "cuda:0", ran


@pytest.mark.filterwarnings("ignore:.*fork")
def test_a_forked_child_has_threads_of_its_own(store):
    """The threads of before the fork are gone: an answer would never arrive."""
    producer = gv.StoredProducer(store)
    with gv.Engine(producer) as engine:
        engine.render(VIEW, GRAY)

        def answer() -> object:
            (source,) = engine.trees.values()
            loc = torch.zeros((1, 4), dtype=torch.int64)
            filled = producer.fill(gv.Nodes(loc, source.layout))
            assert isinstance(filled, Future)
            return filled.result(60).errors

        assert "forked after one was opened" in in_forked_child(answer)
        assert_same_picture(engine.render(VIEW, GRAY), engine.render(VIEW, GRAY))
