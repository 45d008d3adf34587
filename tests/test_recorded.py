"""Frames whose requests are served on the device, in batches of fixed size: on the CPU step by
step, and on CUDA as one graph, for which the host never waits.
"""

from __future__ import annotations

import functools
import gc
import math
import time
import weakref
from typing import Any

import pytest
import torch
from helpers import DEVICES
from helpers.recorded import COMPILED, TRANSFER, Ball, Frames, recorded, view
from helpers.waits import nobody_waits
from torch import Tensor

import gvtorch as gv
from gvtorch.base.branches import in_branches
from gvtorch.base.constants import REQUEST_PENDING_SHIFT
from gvtorch.cache import Cache
from gvtorch.cache.requests import MAX_EXTRA_LEVELS, extra_levels, levels_wanted
from gvtorch.engine.device_frame import DeviceFrame
from gvtorch.engine.stats import Collected, Counts, Readback
from gvtorch.io.stores.conversion import convert
from gvtorch.pool import staging


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("branching, kinds, batch", [(2, False, 64), (2, True, 7), (3, False, 300)])
def test_they_come_to_the_picture_that_the_host_comes_to(backend, branching, kinds, batch):
    def engine() -> gv.Engine:
        producer = Ball(branching=branching, fill_kinds=kinds)
        return gv.Engine(producer, brick_pool="16 MB", device=DEVICES[backend])

    with engine() as served:
        expected = served.render(view(32), TRANSFER)
        assert expected.stats.converged and (expected.alpha > 0.5).any()
    with engine() as recorder:
        frames = Frames(recorder, view(32), TRANSFER, batch)
        recorder.trees["scene"].producer.batch_sizes.clear()
        produced = {"tiles": 0, "bricks": 0, "constant": 0}
        for _ in range(400):
            hits, stats = frames.frame()
            assert stats.produced["bricks"] <= batch
            assert stats.produced["tiles"] <= batch * (1 + MAX_EXTRA_LEVELS)
            produced = {name: produced[name] + stats.produced[name] for name in produced}
            if stats.converged:
                break
        assert stats.converged and not stats.capacity_exceeded
        recorder.validate()
        assert set(recorder.trees["scene"].producer.batch_sizes) == {batch * branching**3}
        there = int((recorder.cache.bricks.owner_b >= 0).sum())
        assert produced["bricks"] == there - 1, "the root was there"
        assert produced["tiles"] > 20 and (produced["constant"] > 0) == kinds
    assert torch.equal(hits.color, expected.color.reshape(-1, 3))
    assert torch.equal(hits.depth, expected.depth.reshape(-1, 1))


@pytest.mark.parametrize("backend", COMPILED)
def test_a_volume_that_the_device_reads_in_place_is_recorded(backend, monkeypatch):
    monkeypatch.setattr(staging, "_MAX_COPIED_BYTES", 100_000)  # bytes: the voxels are more
    values = torch.rand((48, 52, 44, 2), generator=torch.Generator().manual_seed(2))
    volume = gv.Volume(values, (1, 1.5, 1), (-20, 3, 4))
    tree = gv.N3Tree.from_volume(volume, device=DEVICES[backend])
    expected = gv.render(tree, view(), TRANSFER, backend=backend)
    options = {"brick_pool": "8 MB", "device": DEVICES[backend]}
    with gv.Engine(gv.VolumeProducer(volume, hold="mapped"), **options) as engine:
        frames = Frames(engine, view(), TRANSFER, 64)
        assert isinstance(frames.served, DeviceFrame)
        hits, _ = frames.whole()
        assert expected.alpha.max() > 0.5
        engine.validate()
    assert torch.equal(hits.color, expected.color.reshape(-1, 3))


@pytest.mark.parametrize("backend", COMPILED)
def test_joined_producers_are_recorded_where_all_are(backend):
    """Two channels, of which only one has EMPTY regions."""

    def joined() -> gv.JoinedProducer:
        return gv.JoinedProducer({"a": Ball(64), "b": Ball(64, fill_kinds=True)})

    options = {"brick_pool": "16 MB", "device": DEVICES[backend]}
    with gv.Engine(joined(), **options) as served:
        expected, other = (served.render(view(), TRANSFER, channel=name) for name in "ab")
    with gv.Engine(joined(), **options) as recorder:
        frames = Frames(recorder, view(), TRANSFER, 64)
        assert isinstance(frames.served, DeviceFrame)
        hits, stats = frames.whole()
        recorder.validate()
        assert torch.equal(recorder.render(view(), TRANSFER, channel="b").color, other.color)
    assert stats.converged and (expected.alpha > 0.5).any()
    assert torch.equal(hits.color, expected.color.reshape(-1, 3))
    cast = Ball(64)
    cast.on_device = False
    assert not gv.JoinedProducer({"a": Ball(64), "b": cast}).on_device


@pytest.mark.parametrize("backend", COMPILED)
def test_aliases_are_left_to_the_host(blobs, backend):
    """Such a node is requested again by a frame that the host serves."""

    class Twice(gv.VolumeProducer):
        def fill(self, nodes):
            bricks = super().fill(nodes)
            kind = torch.where(nodes.loc[:, 0] == 1, gv.Region.ALIAS, gv.Region.DATA)
            alias = nodes.loc.clone()
            alias[:, 0] = 0
            return gv.Bricks(data=bricks.data, kind=kind, alias=alias)

    with gv.Engine(Twice(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        expected = engine.render(view(16), TRANSFER)
    with gv.Engine(Twice(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(16), TRANSFER, 64)
        for _ in range(100):
            frames.frame()
            time.sleep(0.001)
            if frames.served.host_needed:
                break
        assert frames.served.host_needed
        picture = engine.render(view(16), TRANSFER)
        engine.validate()
    assert torch.equal(picture.color, expected.color)


@pytest.mark.parametrize("backend", COMPILED)
def test_a_pool_that_is_too_small_gives_away_what_is_used_least(backend):
    """A flight around with a pool of a few hundred bricks; back at the start, all is complete."""
    with gv.Engine(Ball(), brick_pool="1 MB", node_pool="60 kB", device=DEVICES[backend]) as engine:
        evicted = 0
        for angle in (0, 50, 100, 180, 270, 0):
            frames = Frames(engine, view(24, angle), TRANSFER, 32)
            for _ in range(200):
                hits, stats = frames.frame()
                evicted += stats.evicted["bricks"] + stats.evicted["tiles"]
                if stats.converged:
                    break
            engine.validate()
            assert stats.converged, angle
        assert evicted > 50
        picture = engine.render(view(24, 0), TRANSFER)
    assert torch.equal(hits.color, picture.color.reshape(-1, 3))


@pytest.mark.parametrize("backend", COMPILED)
def test_bricks_with_nan_are_left_out_and_counted(backend):
    with gv.Engine(Ball(), brick_pool="16 MB", device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(), TRANSFER, 512)
        engine.trees["scene"].producer.spoiled.fill_(1)
        for _ in range(12):
            hits, _ = frames.frame()
        assert engine.readbacks.failed or engine.readbacks[-1].wait().failed > 0
        engine.validate()
        assert bool(torch.isfinite(hits.color).all())
        picture = engine.render(view(), TRANSFER)  # the host names them
        assert len(engine.failures) > 0 and "NaN" in engine.failures[0].message
        assert torch.isfinite(picture.color).all()


@pytest.mark.backend("cpp")
def test_what_the_host_would_have_to_see_to_is_refused():
    class Named(Ball):
        def fill(self, nodes):
            return gv.Bricks(data=super().fill(nodes), errors={0: "no"})

    with gv.Engine(Ball(), brick_pool="16 MB") as engine:
        frames = Frames(engine, view(), TRANSFER, 8)
        engine.trees["scene"].producer.__class__ = Named
        with pytest.raises(ValueError, match="without alias and errors"):
            frames.frame()


@functools.cache
def missed_on_a_flight(backend: str, look_ahead: float) -> tuple[int, gv.Hits, gv.FrameStats]:
    """Returns the number of nodes that a turning camera missed, and its final view."""
    missed, looked_ahead = 0, 0
    with gv.Engine(Ball(1024), brick_pool="64 MB", device=DEVICES[backend]) as engine:
        engine.render(view(48, 0), TRANSFER)
        frames = Frames(engine, view(48, 0), TRANSFER, 144, look_ahead)
        for step in range(1, 25):
            frames.look_from(view(48, 1.5 * step))
            hits, stats = frames.frame()
            missed, looked_ahead = missed + stats.misses, looked_ahead + (stats.ahead > 0)
        assert looked_ahead == (0 if look_ahead == 0 else 23 if look_ahead < 8 else 6)
        for _ in range(30):
            hits, stats = frames.frame()
            assert stats.ahead == 0, "it stands still"
            if stats.converged:
                break
        engine.validate()
        assert stats.converged
        expected = engine.render(view(48, 1.5 * step), TRANSFER)
    assert torch.equal(hits.color, expected.color.reshape(-1, 3))
    return missed, hits, stats


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("look_ahead, fewer", [(3, 2), (16, 2)])
def test_rays_ahead_of_a_moving_camera_ask_for_what_it_would_miss(look_ahead, fewer):
    missed, hits, stats = missed_on_a_flight("cpp", 0)
    left, same, last_stats = missed_on_a_flight("cpp", look_ahead)
    assert left * fewer < missed and missed > 100
    assert torch.equal(hits.color, same.color) and last_stats.bricks_used == stats.bricks_used


@pytest.mark.backend("cpp")
def test_what_the_picture_misses_comes_before_what_the_next_ones_will():
    """The picture's misses are counted as without look-ahead rays."""
    counts = []
    for look_ahead in (0, 5):
        with gv.Engine(Ball(1024), brick_pool="64 MB") as engine:
            frames = Frames(engine, view(64, 0), TRANSFER, 8, look_ahead)
            for angle in (0, 0, 1, 3):
                frames.look_from(view(64, angle))
                _, stats = frames.frame()
            counts.append((stats.requests, stats.misses, stats.bricks_used, stats.tiles_used))
            requested = frames.served._requests[0, 0]
            chosen = torch.cat([choice.node for choice in frames.served.choose()])
            assert (chosen >= 0).any() and (stats.ahead > 0) == (look_ahead > 0)
            assert torch.isin(chosen[chosen >= 0], requested.long()).all()
            request_words = engine.cache.nodes.request_tn
            assert not (request_words >> REQUEST_PENDING_SHIFT).any(), "nothing is on its way"
    assert counts[0] == counts[1] and counts[0][1] > 16


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("branching, loading", [(2, "straight"), (3, "straight"), (2, "levels")])
def test_a_tree_deepens_by_many_levels_a_frame(backend, branching, loading):
    """If rays need it: views from afar do not, nor is there more below the last level."""
    device = DEVICES[backend]
    size, batch = (32, 1024) if loading == "levels" else (64, 2048)
    options = {"brick_pool": "64 MB", "loading": loading, "device": device}
    with gv.Engine(Ball(1024, branching), **options) as engine:
        frames, depth = Frames(engine, view(size), TRANSFER, batch), []
        for _ in range(60):
            _, stats = frames.frame()
            there = engine.cache.nodes.parent_t >= 0
            depth.append(int(engine.cache.nodes.loc_t4[there, 3].max()) if there.any() else 0)
            if stats.converged:
                break
        engine.validate()
        assert stats.converged
        seen = stats.tiles_used
        tiles = int((engine.cache.nodes.parent_t >= 0).sum())
    deepest = depth[-1]
    reached = depth.index(deepest)
    if loading == "levels":
        assert reached >= deepest, "a level needs its bricks first"
    else:
        assert deepest > 3 and reached <= 2 < deepest and tiles < 3 * seen


@pytest.mark.parametrize("backend", COMPILED)
def test_a_frame_deepens_by_no_more_than_its_most(backend):
    """Whatever look-ahead rays request, which may be far more than the frame itself requests."""
    for priority, max_levels in (
        ([1024] * 3 + [-1] * 500, MAX_EXTRA_LEVELS),
        ([0, 16, 32, -1], 0),
        ([-1], 0),
    ):
        assert extra_levels(levels_wanted(torch.tensor(priority), 2).tolist()) == max_levels
    with gv.Engine(Ball(1024), brick_pool="64 MB", device=DEVICES[backend]) as engine:
        frames, levels = Frames(engine, view(64, 0), TRANSFER, 256, 8), []
        for turn in range(20):
            frames.look_from(view(64, 3.0 * turn))
            frames.frame()
            engine.readbacks.catch_up(wait=True)
            levels.append(engine.readbacks.extra_levels)
    assert 0 < max(levels) <= MAX_EXTRA_LEVELS


class Unsaid(Ball):
    """The same, but without `on_device`."""

    on_device = False


def flown(
    engine: gv.Engine, path: list[gv.Camera], batch: int, look_ahead: float = 0
) -> tuple[Any, gv.Picture, gv.FrameStats, int]:
    """Replays a flight without the host waiting, then its last view until it is complete; also
    returns how many nodes were missed on the flight.
    """
    graph = engine.capture(path[0], TRANSFER, batch=batch, look_ahead=look_ahead)
    with nobody_waits():
        flight = [graph.replay(camera)[1] for camera in path]
    missed = sum(stats.misses for stats in flight)
    assert any(stats.ahead for stats in flight) == (look_ahead > 0)
    for _ in range(300):
        picture, stats = graph.replay(path[-1])
        time.sleep(0.002)
        if stats.settle().converged:
            break
    assert stats.converged
    engine.validate()
    return graph, picture, stats, missed


PATH = [view(96, 1.5 * number) for number in range(61)]


def winding(number: int, size: int) -> gv.Camera:
    """Returns a view of a long flight that sees new parts all the time."""
    height, distance = 50 * math.sin(number / 40), 0.85 + 0.3 * math.cos(number / 90)
    return gv.Camera.orbit(1.7 * number, height, distance, None, size, size)


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize(
    "scene, look_ahead", [("store", 0), ("store", 12), ("mapped", 0), ("formula", 6)]
)
def test_a_long_flight_does_not_wait(blobs, tmp_path, scene, look_ahead, backend, monkeypatch):
    monkeypatch.setattr(staging, "_MAX_COPIED_BYTES", 100_000)  # bytes: the voxels are more
    device, options = DEVICES[backend], {"brick_pool": "12 MB"}
    if scene == "store":
        producer = gv.StoredProducer(convert(blobs, tmp_path / "store"))
        options = {"brick_pool": "150 kB", "brick_size": 4}
    elif scene == "mapped":
        values = torch.rand((128,) * 3, generator=torch.Generator().manual_seed(2))
        producer = gv.VolumeProducer(gv.Volume(values), hold="mapped")
    else:
        producer = Ball(1024)
    count, size = (1000, 96) if device == "cuda" else (30, 48)
    path = [winding(number, size) for number in range(count)]
    with gv.Engine(producer, device=device, **options) as engine:
        replay = recorded(engine, path[0], TRANSFER, batch=64, look_ahead=look_ahead)
        with nobody_waits(device=device):
            flight = [replay(camera)[1] for camera in path]
        for _ in range(600):
            color, stats = replay(path[-1])
            time.sleep(0.002)
            if stats.settle().converged:
                break
        assert stats.converged and sum(stats.misses > 0 for stats in flight) > 0.1 * len(path)
        assert any(stats.ahead for stats in flight) == (look_ahead > 0)
        engine.validate()
        last_color = color.clone()
        assert torch.equal(engine.render(path[-1], TRANSFER).color.reshape(-1, 3), last_color)


@pytest.mark.backend("cuda")
def test_a_flight_is_replayed_without_the_host():
    """The graph loads what it misses, and converges to the host's picture."""
    with gv.Engine(Ball(1024), brick_pool="64 MB", device="cuda") as engine:
        graph, picture, _, missed = flown(engine, PATH, 256)
        assert sum(graph.replay(PATH[-1])[1].settle().produced.values()) == 0
        last_color = picture.color.clone()
        served = engine.render(PATH[-1], TRANSFER)
        assert torch.equal(served.color, last_color)
        engine.frame(view(96, 200), TRANSFER)  # another frame between two replays
        picture, stats = graph.replay(PATH[-1])
        assert stats.settle().converged and torch.equal(picture.color, last_color)
    with gv.Engine(Ball(1024), brick_pool="64 MB", device="cuda") as engine:
        _, picture, _, left = flown(engine, PATH, 256, look_ahead=6)
        assert torch.equal(picture.color, last_color) and left < 0.8 * missed
    with gv.Engine(Unsaid(1024), brick_pool="64 MB", device="cuda") as engine:
        expected = engine.render(PATH[-1], TRANSFER)
        graph = engine.capture(PATH[-1], TRANSFER)
        picture, stats = graph.replay(view(96, 200))
        assert not stats.settle().converged and sum(stats.produced.values()) == 0
    assert torch.equal(expected.color, last_color)


@pytest.mark.backend("cuda")
def test_a_node_that_fails_in_a_replay_is_named_by_the_host():
    with gv.Engine(Ball(), brick_pool="16 MB", device="cuda") as engine:
        graph = engine.capture(view(), TRANSFER)
        engine.trees["scene"].producer.spoiled.fill_(1)
        for _ in range(40):
            picture, _ = graph.replay(view())
        assert len(engine.failures) > 0 and "NaN" in engine.failures[0].message
        assert torch.isfinite(picture.color).all()
        engine.validate()


def test_jobs_side_by_side_give_what_they_give_one_by_one(compiled):
    """Recorded, they are branches of the graph; each replay sees the state before all of them."""
    device = torch.device(DEVICES[compiled])
    many, few = torch.zeros(1 << 20, device=device), torch.zeros(3, device=device)

    def step() -> Tensor:
        many.add_(1)
        total, least = in_branches(lambda: many.double().sum().view(1), lambda: few + 1)
        few.copy_(least)
        return torch.cat((total, few.double()))

    results, replay = step(), None
    if device.type == "cuda":
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            results = step()
        replay = graph.replay
    for turn in range(2, 40):
        if replay is None:
            results = step()
        else:
            replay()
        assert results.tolist() == [turn * (1 << 20), turn, turn, turn]


@pytest.mark.backend("cuda")
def test_garbage_of_other_engines_does_not_end_a_recording(blobs, monkeypatch):
    """Page-locked memory of garbage is freed by whichever thread runs the garbage collector."""
    monkeypatch.setattr(staging, "_MAX_COPIED_BYTES", 0)
    garbage: list[Any] = [staging.mapped(torch.zeros(1 << 20), torch.device("cuda"))]
    garbage.append(garbage)
    held, sort, thresholds = [garbage], Cache.sort_by_use, gc.get_threshold()
    given_back = weakref.ref(garbage[0])
    del garbage

    def collecting(cache: Cache) -> Tensor:
        if torch.cuda.is_current_stream_capturing():
            held.clear()
            gc.set_threshold(1, 1, 1)
            assert [[] for _ in range(1000)]
        return sort(cache)

    monkeypatch.setattr(Cache, "sort_by_use", collecting)
    with gv.Engine(gv.VolumeProducer(blobs), device="cuda") as engine:
        try:
            graph = engine.capture(view(24), TRANSFER)
        finally:
            gc.set_threshold(*thresholds)
        assert not held and gc.isenabled()
        gc.collect()
        assert given_back() is None
        assert graph.replay(view(24))[1].settle().samples > 0


@pytest.mark.parametrize("chosen", [0, 2])
def test_what_the_frame_before_asks_for_is_on_its_way(chosen):
    """The earlier frame's rays marked nodes as pending, so the next frame does not report them; and
    it may be settled before the host has requested any.
    """
    requests = []

    def ask(numbers: Tensor) -> int:
        requests.append(numbers.tolist())
        return chosen

    counts = torch.zeros(len(Counts._fields) + 3, dtype=torch.int64)
    stats = [gv.FrameStats() for _ in range(3)]
    before = Readback(stats[0], Collected(None, counts, ask))
    after = Readback(stats[1], Collected(None, counts), (before,))
    Readback(stats[2], Collected(None, counts), (before, after))
    assert stats[2].settle().converged == stats[1].settle().converged == (chosen == 0)
    assert before.ask() == chosen and requests == [[0, 0, 0]], "it asks once"
