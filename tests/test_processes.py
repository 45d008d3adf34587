"""Producers, trees and stores in other processes: pickled, spawned and forked."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import subprocess
import sys
import textwrap
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import meshes
from helpers.pictures import GRAY, assert_same_picture
from helpers.stores import noise

import gvtorch as gv
from gvtorch.io.stores.conversion import convert

VIEW = gv.Camera.orbit(width=16, height=12)


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
    with gv.Engine(producer) as engine:
        expected = engine.render(VIEW, shader)
        assert expected.alpha.max() > 0
        again = copy.deepcopy(other)  # before an engine has prepared it
        used = copy.deepcopy(producer)  # a copy serves no engine
        with gv.Engine(used) as second:
            assert torch.equal(second.render(VIEW, shader).color, expected.color)
    for copied in (other, again, pickle.loads(pickle.dumps(used))):
        with gv.Engine(copied) as engine:
            assert torch.equal(engine.render(VIEW, shader).color, expected.color)


def test_a_store_is_pickled_with_what_it_was_asked_for(tmp_path):
    data = np.stack([noise((9, 9, 9, 2), seed=seed) for seed in (0, 1)])
    np.save(tmp_path / "a.npy", data)
    convert(tmp_path / "a.npy", tmp_path / "a.zarr", axes="tzyxc", workers=1)
    store = gv.Store.open(tmp_path / "a.zarr", time=1, channels=[1])
    other = pickle.loads(pickle.dumps(store))
    whole = (0, 0, 0), (9, 9, 9)
    assert other.time == 1 and np.array_equal(other.read_region(0, *whole), data[1][..., 1:])


WORKERS = """
    import copy, sys, torch, gvtorch as gv

    class Pictures(torch.utils.data.Dataset):
        def __init__(self, path, inside):
            self.path = path
            self.producer = None if inside else gv.StoredProducer(path)

        def __len__(self):
            return 3

        def __getitem__(self, index):
            producer = copy.deepcopy(self.producer) or gv.StoredProducer(self.path)
            with gv.Engine(producer, brick_pool="1 MB", node_pool="1 MB") as engine:
                view = gv.Camera.orbit(40 * index, width=8, height=8)
                return engine.render(view, gv.TransferFunction.preset("gray", 0, 255)).color

    if __name__ == "__main__":
        path, method, *where = sys.argv[1:]
        for place in where:
            pictures = Pictures(path, place == "inside")
            loader = torch.utils.data.DataLoader(
                pictures, num_workers=1, timeout=100, multiprocessing_context=method
            )
            try:
                print("sum", sum(float(one.sum()) for one in loader))
            except Exception as error:
                print("error", " ".join(str(error).split())[-400:])
"""


def test_an_engine_says_that_it_is_not_copied(blobs):
    with gv.Engine(gv.VolumeProducer(blobs)) as engine:
        for take in (pickle.dumps, copy.copy, copy.deepcopy):
            with pytest.raises(TypeError, match="Engine: it can't be copied or pickled: make one"):
                take(engine)


@pytest.mark.parametrize(
    ("method", "where"), [("spawn", ["outside"]), ("fork", ["inside", "outside"])]
)
def test_workers_of_data_loaders(store, tmp_path, method, where):
    """A forked worker opens its own store; using one that was opened before is a one-line error."""
    file = tmp_path / "workers.py"
    file.write_text(textwrap.dedent(WORKERS))
    run = subprocess.run(
        [sys.executable, str(file), str(store), method, *where],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    first, *others = run.stdout.splitlines()
    assert first.startswith("sum ") and float(first.split()[1]) > 0, run.stdout
    assert len(others) == (method == "fork")
    assert all("forked after one was opened" in line for line in others), run.stdout


@pytest.mark.filterwarnings("ignore:.*fork")
def test_a_forked_child_has_threads_of_its_own(store):
    """The threads of before the fork are gone: an answer would never arrive."""
    producer = gv.StoredProducer(store)
    with gv.Engine(producer) as engine:
        engine.render(VIEW, GRAY)
        context = multiprocessing.get_context("fork")
        receive, send = context.Pipe(duplex=False)

        def child() -> None:
            (source,) = engine.trees.values()
            loc = torch.zeros((1, 4), dtype=torch.int64)
            answer = producer.fill(gv.Nodes(loc, source.layout))
            assert isinstance(answer, Future)
            try:
                send.send(str(answer.result(60).errors))
            except BaseException as error:
                send.send(repr(error))
            os._exit(0)

        process = context.Process(target=child)
        process.start()
        assert receive.poll(100) and "forked after one was opened" in receive.recv()
        process.join(60)
        assert_same_picture(engine.render(VIEW, GRAY), engine.render(VIEW, GRAY))
