"""Random flights with random pools, budgets, producers and faults. The pools stay valid, memory
stays flat, and once all faults are over the picture equals the resident one in every bit.

`make soak FRAMES=100000` flies longer than the tests do.
"""

from __future__ import annotations

import gc
import os
import random
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import DEVICES, resident_bytes
from helpers.producers import Late
from helpers.recorded import recorded, stepped

import gvtorch as gv
from gvtorch.io.stores.conversion import convert
from gvtorch.pool import staging

COMPILED = [pytest.param(b, marks=pytest.mark.backend(b)) for b in ("cpp", "cuda")]
FRAMES = int(os.environ.get("GVTORCH_SOAK", "1000"))
LOOK = gv.TransferFunction.preset("gray", 0, 1)
FAULTS = ("raises", "nan", "errors", "never")


class Faulty(gv.VolumeProducer):
    """Fails now and then in the way that `fault` says."""

    def __init__(self, volume: gv.Volume, pick: random.Random, hold: str) -> None:
        super().__init__(volume, hold=hold)
        self.pick, self.fault, self.patience = pick, "", 0.02

    def classify(self, nodes):
        return self.spoilt(super().classify(nodes), nodes)

    def fill(self, nodes):
        return self.spoilt(super().fill(nodes), nodes)

    def spoilt(self, answer, nodes):
        if not self.fault or (nodes.depth == 0).any() or self.pick.random() < 0.7:
            return answer
        if self.fault == "raises":
            raise OSError("the disk is gone")
        if self.fault == "never":
            return Future()
        if self.fault == "errors" or isinstance(answer, gv.Regions):
            return answer.each(lambda rows: rows, errors={0: "spoilt"})
        return {n: torch.full(r.shape, torch.nan, dtype=r.dtype) for n, r in answer.data.items()}


class Spots(torch.nn.Module):
    """A ball with spots, which contains NaN while `spoiled` is not 0."""

    spoiled: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("spoiled", torch.zeros(()))

    def forward(self, position):
        ball = (3 - 4 * position.norm(dim=-1, keepdim=True)).clamp(0, 1)
        value = ball * (0.6 + 0.4 * (9 * position[..., :1]).sin())
        return torch.where((position[..., 1:2] > 0.2) & (self.spoiled > 0), torch.nan, value)


class Spotted(gv.FieldProducer):
    """Makes bricks on the device; returns NaN while there is a `fault`."""

    def __init__(self, branching: int) -> None:
        super().__init__(Spots(), 40, box=((-1, -1, -1), (1, 1, 1)), branching=branching)

    @property
    def fault(self) -> str:
        return "nan" if self.field.spoiled else ""

    @fault.setter
    def fault(self, fault: str) -> None:
        self.field.spoiled.fill_(fault != "")


def random_producer(pick: random.Random, blobs: gv.Volume, store: Path) -> gv.Producer:
    kind = pick.choice(["voxels", "bricks", "late", "mapped", "store", "field"])
    seed, branching = pick.randrange(1000), pick.choice([2, 3])
    if kind == "store":
        return gv.StoredProducer(store)
    if kind == "field":
        return Spotted(branching)
    if kind == "late":
        producer: gv.VolumeProducer = Late(blobs, seed, max_delay=0.001)
    elif kind == "mapped":
        producer = gv.VolumeProducer(blobs, hold="mapped")
    else:
        producer = Faulty(blobs, pick, kind)
    producer.branching = branching
    return producer


def random_engine(pick: random.Random, producer: gv.Producer, device: torch.device) -> gv.Engine:
    return gv.Engine(
        producer,
        device=device,
        brick_size=4,
        brick_pool=pick.choice([3, 20, 80, 300, 3000]) * 6**3 * 4,
        node_pool=pick.choice([8, 30, 100, 1000]) * producer.branching**3 * 20,
        load_budget=pick.choice([1, 7, 50, 4096]),
        subdivide_budget=pick.choice([1, 7, 50, 4096]),
        order=pick.choice(["coarse", "fine"]),
        loading=pick.choice(["straight", "levels"]),
        scout_rounds=pick.randrange(4),
        monitor=pick.random() < 0.3,
    )


def random_view(pick: random.Random) -> gv.Camera:
    distance = pick.choice([0.1, 0.4, 0.8, 1.5, 5.0])
    return gv.Camera.orbit(pick.uniform(-180, 180), pick.uniform(-80, 80), distance, None, 12, 10)


Resident = Callable[[gv.Producer, gv.Camera], gv.Picture]


@contextmanager
def resident(blobs: gv.Volume, store: Path, device: torch.device) -> Iterator[Resident]:
    """The reference pictures of producers: by the tree of a volume, else by an engine with enough
    room. A store's cells are wider than bricks here, so it has other CONSTANT regions.
    """
    size: dict[str, Any] = {"device": device, "brick_size": 4}
    trees = {n: gv.N3Tree.from_volume(blobs, branching=n, **size) for n in (2, 3)}
    others = [Spotted(2), Spotted(3), gv.StoredProducer(store)]
    kinds = [(type(volume), volume.branching) for volume in others]
    engines = [gv.Engine(volume, brick_pool="16 MB", **size) for volume in others]
    roomy = dict(zip(kinds, engines, strict=True))

    def show(producer: gv.Producer, view: gv.Camera) -> gv.Picture:
        engine = roomy.get((type(producer), producer.branching))
        if engine is None:
            return gv.render(trees[producer.branching], view, LOOK)
        picture = engine.render(view, LOOK, max_frames=300)
        assert picture.stats.converged
        return picture

    try:
        for volume in others:
            show(volume, gv.Camera.orbit(30, 20, 0.8, None, 12, 10))  # allocates all that it needs
        yield show
    finally:
        for engine in engines:
            engine.close()


def flight(
    seed: int, blobs: gv.Volume, store: Path, show: Resident, device: torch.device
) -> tuple[int, bool]:
    """Flies once with a new engine; returns its number of frames, and whether its last picture was
    complete: then it equals the resident one.
    """
    pick = random.Random(seed)
    producer = random_producer(pick, blobs, store)
    with random_engine(pick, producer, device) as engine:
        view, replay = random_view(pick), None
        if producer.on_host or producer.on_device:
            record = pick.choice([recorded, stepped])
            options = {"batch": pick.choice([5, 64]), "look_ahead": pick.choice([0, 0, 5])}
            replay = record(engine, view, LOOK, fit=pick.random() < 0.3, **options)
        for number in range(pick.randrange(5, 80)):
            if isinstance(producer, Faulty | Spotted) and pick.random() < 0.1:
                producer.fault = pick.choice(["", *FAULTS])
            if pick.random() < 0.3:
                view = random_view(pick)
            if pick.random() < 0.05:
                engine.forget_failures()
            if pick.random() < 0.03 and not isinstance(producer, Spotted):  # whose roots may fail
                producer.changed()
            if replay is not None and pick.random() < 0.5:
                replay(view)
            elif pick.random() < 0.1:
                engine.render(view, LOOK, max_frames=5)
            else:
                engine.frame(view, LOOK, lod=pick.choice(["auto", "finest"]))
            if number % 4 == 0:
                engine.validate()
        if isinstance(producer, Faulty | Spotted):
            producer.fault = ""
        engine.production.wait(0.1)
        engine.forget_failures()
        picture = engine.render(view, LOOK, max_frames=300)
        engine.validate()
        whole = picture.stats.converged and not picture.stats.failed
        if whole:
            expected = show(producer, view)
            assert torch.equal(picture.color, expected.color), seed
            assert torch.equal(picture.depth, expected.depth), seed
        return engine.frames, whole


def memory(device: torch.device) -> tuple[int, int]:
    """Returns the bytes of the process, and of tensors on a CUDA device."""
    gc.collect()
    on_device = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
    return resident_bytes(), on_device


@pytest.mark.parametrize("backend", COMPILED)
def test_random_flights_end_in_the_resident_picture(blobs, tmp_path, backend, monkeypatch):
    monkeypatch.setattr(staging, "_MAX_COPIED_BYTES", 0)  # everything mapped is read in place
    device = torch.device(DEVICES[backend])
    store = tmp_path / "store"
    convert(blobs, store)
    begin = random.randrange(10**9) if FRAMES > 10_000 else 0  # parallel long runs differ
    frames = flights = compared = 0
    after_a_fifth: tuple[int, int] | None = None
    with resident(blobs, store, device) as show:
        while frames < FRAMES or flights < 20:  # few flights prove little
            flown, whole = flight(begin + flights, blobs, store, show, device)
            frames, flights, compared = frames + flown, flights + 1, compared + whole
            if after_a_fifth is None and frames > FRAMES // 5:
                after_a_fifth = memory(device)
            if FRAMES > 10_000 and flights % 50 == 0:
                megabytes = memory(device)[0] / 1e6
                print(f"{frames:,} frames, {flights:,} flights, {megabytes:,.0f} MB", flush=True)
        assert after_a_fifth is not None
        grown, on_device = (b - a for a, b in zip(after_a_fifth, memory(device), strict=True))
    assert FRAMES < 10_000 or grown < 50e6, f"{grown / 1e6:.0f} MB more"
    assert on_device < 3e6, f"{on_device / 1e6:.1f} MB more on the device"
    assert compared > 0.4 * flights
