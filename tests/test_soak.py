"""Random flights: pools, budgets, producers and faults as they come. The pools stay in order,
memory stays flat, and once all is well again the picture is the resident one, in every bit.

`make soak FRAMES=100000` flies longer than the tests do.
"""

from __future__ import annotations

import os
import random
from concurrent.futures import Future

import pytest
import torch
from helpers import DEVICES, resident_bytes
from helpers.producers import Late
from helpers.recorded import Frames

import gvtorch as gv

COMPILED = [pytest.param(b, marks=pytest.mark.backend(b)) for b in ("cpp", "cuda")]
FRAMES = int(os.environ.get("GVTORCH_SOAK", "2000"))
LOOK = gv.TransferFunction.preset("gray", 0, 1)
FAULTS = ("raises", "nan", "errors", "never")


class Faulty(gv.VolumeProducer):
    """Fails now and then while `fault` says how."""

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


def random_engine(pick: random.Random, blobs: gv.Volume, device: torch.device) -> gv.Engine:
    kind = pick.choice(["voxels", "bricks", "late"])
    if kind == "late":
        producer: gv.VolumeProducer = Late(blobs, pick.randrange(1000), most=0.001)
    else:
        producer = Faulty(blobs, pick, kind)
    producer.branching = branching = pick.choice([2, 3])
    return gv.Engine(
        producer,
        device=device,
        brick_size=4,
        brick_pool=pick.choice([3, 20, 80, 300, 3000]) * 6**3 * 4,
        node_pool=pick.choice([8, 30, 100, 1000]) * branching**3 * 20,
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


def flight(
    seed: int, blobs: gv.Volume, trees: dict[int, gv.N3Tree], device: torch.device
) -> tuple[int, bool]:
    """Flies once with an engine of its own; returns its number of frames, and whether its last
    picture was whole: then it is the resident one.
    """
    pick = random.Random(seed)
    with random_engine(pick, blobs, device) as engine:
        (source,) = engine.trees.values()
        view = random_view(pick)
        batch, recorded = pick.choice([5, 64]), None
        if source.producer.on_host:
            recorded = Frames(engine, view, LOOK, batch, fit=pick.random() < 0.3)
        for number in range(pick.randrange(5, 80)):
            if isinstance(source.producer, Faulty) and pick.random() < 0.1:
                source.producer.fault = pick.choice(["", *FAULTS])
            if pick.random() < 0.3:
                view = random_view(pick)
            if recorded is not None and pick.random() < 0.5:
                recorded.look_from(view)
                recorded.frame()
            elif pick.random() < 0.1:
                engine.render(view, LOOK, max_frames=5)
            else:
                engine.frame(view, LOOK, lod=pick.choice(["auto", "finest"]))
            if number % 4 == 0:
                engine.validate()
        if isinstance(source.producer, Faulty):
            source.producer.fault = ""
        engine.production.wait(0.1)
        engine.forget_failures()
        picture = engine.render(view, LOOK, max_frames=300)
        engine.validate()
        whole = picture.stats.converged and not picture.stats.failed
        if whole:
            expected = gv.render(trees[source.producer.branching], view, LOOK)
            assert torch.equal(picture.color, expected.color), seed
            assert torch.equal(picture.depth, expected.depth), seed
        return engine.frames, whole


@pytest.mark.parametrize("backend", COMPILED)
def test_random_flights_end_in_the_resident_picture(blobs, backend):
    device = DEVICES[backend]
    trees = {n: gv.N3Tree.from_volume(blobs, 4, branching=n, device=device) for n in (2, 3)}
    begin = random.randrange(10**9) if FRAMES > 10_000 else 0  # long runs side by side differ
    frames = flights = compared = after_a_fifth = 0
    while frames < FRAMES:
        flown, whole = flight(begin + flights, blobs, trees, device)
        frames, flights, compared = frames + flown, flights + 1, compared + whole
        if not after_a_fifth and frames > FRAMES // 5:
            after_a_fifth = resident_bytes()
        if FRAMES > 10_000 and flights % 50 == 0:
            megabytes = resident_bytes() / 1e6
            print(f"{frames:,} frames, {flights:,} flights, {megabytes:,.0f} MB", flush=True)
    grown = resident_bytes() - after_a_fifth
    assert FRAMES < 10_000 or grown < 50e6, f"{grown / 1e6:.0f} MB more"
    assert compared > 0.4 * flights
