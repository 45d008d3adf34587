"""Frames that do not wait for the device: late counts and statistics, CUDA graphs."""

from __future__ import annotations

import copy
import pickle
import random

import numpy as np
import pytest
import torch
from helpers.pictures import FIELDS, GRAY, VESSELS, assert_same_picture, camera
from helpers.producers import Checked, Held, Late
from helpers.waits import nobody_waits

import gvtorch as gv
from gvtorch.engine.stats import Readback
from gvtorch.ops import unavailable
from gvtorch.tracing.pixels import View


@pytest.fixture
def cuda() -> str:
    """The device, where CUDA is."""
    reason = unavailable()["cuda"]
    if reason:
        pytest.skip(f"backend cuda: {reason}")
    return "cuda"


@pytest.fixture
def traced(monkeypatch):
    """Records for each pass over a camera's rays whether it was one over scouts."""
    passes: list[bool] = []
    trace = View.hits

    def note(view, *progress, again=None):
        passes.append(again is not None)
        return trace(view, *progress, again=again)

    monkeypatch.setattr(View, "hits", note)
    return passes


@pytest.fixture
def slow(monkeypatch):
    """Readbacks that never arrive by themselves; records which of them were waited for."""
    waited: list[Readback] = []
    wait = Readback.wait

    def note(self):
        if self not in waited:
            waited.append(self)
        return wait(self)

    monkeypatch.setattr(Readback, "arrived", property(lambda self: False))
    monkeypatch.setattr(Readback, "wait", note)
    return waited


class Noted(gv.VolumeProducer):
    """Records which nodes it was asked for."""

    def __init__(self, volume):
        super().__init__(volume)
        self.asked: list[tuple[int, ...]] = []

    def classify(self, nodes):
        self.asked += [tuple(loc) for loc in nodes.loc.tolist()]
        return super().classify(nodes)

    def fill(self, nodes):
        self.asked += [tuple(loc) for loc in nodes.loc.tolist()]
        return super().fill(nodes)


@pytest.mark.backend("cpp")
def test_a_frame_serves_what_the_one_before_missed(blobs):
    producer = Noted(blobs)
    with gv.Engine(producer, brick_size=4) as engine:
        producer.asked.clear()
        _, stats = engine.frame(camera(), GRAY)
        assert not any(stats.produced.values()) and not producer.asked
        assert stats.misses > 0 and not stats.converged
        _, stats = engine.frame(camera(), GRAY)
        assert sum(stats.produced.values()) > 0 and producer.asked
        while not stats.converged:
            _, stats = engine.frame(camera(), GRAY)
        producer.asked.clear()
        _, stats = engine.frame(camera(), GRAY)
        assert not producer.asked, "nothing was missed, nothing is asked for"


@pytest.mark.backend("cpp")
def test_frames_go_on_where_counts_do_not_come(slow, blobs):
    """Only a host that is too far ahead waits, for the oldest frame; because that one missed
    something, it also waits for the newest list, and serves only that.
    """
    left, right = (camera(8, azimuth=azimuth, distance=0.6) for azimuth in (0, 180))
    requested = []
    for views in ((left, left, left, right), (right,) * 4, (left,) * 4):
        producer = Noted(blobs)
        with gv.Engine(producer, brick_size=4, monitor=False) as engine:
            engine.render(camera(distance=9.0), GRAY)
            producer.asked.clear()
            slow.clear()
            for view in views:
                engine.frame(view, GRAY)
            assert not slow and not producer.asked, "the host does not wait"
            engine.frame(right, GRAY)
            assert len(slow) == 4, "the fifth frame looks at the four before"
            requested.append(set(producer.asked))
    assert requested[0] == requested[1] != requested[2] and requested[2]


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("loading", ["straight", "levels"])
def test_pictures_converge_where_counts_do_not_come(slow, aneurism, loading):
    whole = gv.render(gv.N3Tree.from_volume(aneurism), camera(distance=1.4), VESSELS)
    with gv.Engine(gv.VolumeProducer(aneurism), loading=loading) as engine:
        for _ in range(100):
            picture, stats = engine.frame(camera(distance=1.4), VESSELS)
            if stats.converged:
                break
        engine.validate()
        assert stats.frame > 5
        assert_same_picture(picture, whole)


@pytest.mark.backend("cpp")
def test_a_stalled_producer_stalls_no_frame(slow, blobs):
    """The host does not wait for counts of late answers either; those that arrive are written."""
    producer = Held(blobs)
    with gv.Engine(producer, brick_size=4) as engine:
        for _ in range(20):
            _, stats = engine.frame(camera(8), GRAY)
        assert stats.pending > 0 and producer.held
        slow.clear()
        for number in range(10):
            _, stats = engine.frame(camera(8), GRAY)
            assert len(slow) == number + 1, "one a frame, of a frame that is long done"
        assert not any(stats.produced.values())
        producer.release()
        _, stats = engine.frame(camera(8), GRAY)
        assert sum(stats.produced.values()) > 0
        producer.hold = False
        producer.release()  # answers the requests made meanwhile
        assert engine.render(camera(8), GRAY).stats.converged


@pytest.mark.backend("cpp")
def test_scouts_go_only_where_something_was_written(traced, blobs):
    """Neither in a steady frame nor while a store is stalled: the frame does not wait for it."""
    producer = Held(blobs)
    with gv.Engine(producer, brick_size=4) as engine:
        for _ in range(10):
            _, stats = engine.frame(camera(), GRAY)
        assert stats.pending > 0 and traced == [False] * 10
        traced.clear()
        producer.release()
        _, stats = engine.frame(camera(), GRAY)
        assert stats.pending > 0 and traced == [True, False], "what they ask for does not come"
        producer.hold = False
        producer.release()
        traced.clear()
        engine.frame(camera(), GRAY)
        assert traced == [True, True, False]
        while not stats.converged:
            _, stats = engine.frame(camera(), GRAY)
        traced.clear()
        engine.frame(camera(), GRAY)
        assert traced == [False]


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("producer", [gv.VolumeProducer, Late])
def test_pools_stay_in_order_where_counts_come_at_random(blobs, monkeypatch, producer):
    """500 frames each, from pools of a few slots; `Checked` asserts after every frame."""
    pick = random.Random(11)
    monkeypatch.setattr(Readback, "arrived", property(lambda self: pick.random() < 0.4))
    tree = gv.N3Tree.from_volume(blobs, 4)
    evicted = 0
    for trial in range(4):
        bricks, tiles = pick.randint(6, 60), pick.randint(8, 40)
        options = {"brick_pool": bricks * 6**3 * 4, "node_pool": tiles * 8 * 20, "brick_size": 4}
        loading = ("straight", "levels")[trial % 2]
        with Checked(producer(blobs), loading=loading, **options) as engine:
            azimuth, distance = 0.0, 1.0
            for _ in range(125):
                azimuth += pick.gauss(0, 20)
                distance = min(3.0, max(0.2, distance * np.exp(pick.gauss(0, 0.2))))
                view = camera(4, azimuth=azimuth % 360 - 180, distance=distance)
                _, stats = engine.frame(view, GRAY)
                evicted += stats.evicted["bricks"]
            picture = engine.render(view, GRAY, max_frames=200)
            engine.validate()
            if picture.stats.converged:
                expected = gv.render(tree, view, GRAY)
                assert all(torch.equal(getattr(picture, n), getattr(expected, n)) for n in FIELDS)
    assert evicted > 100


@pytest.mark.backend("cpp")
def test_statistics_come_when_they_are_read(slow, blobs):
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        _, stats = engine.frame(camera(), GRAY)
        assert stats.frame == 1 and stats.rays == 48 * 48 and stats.pending == 0 and not slow
        assert stats.samples > 0 and len(slow) == 1
        assert stats.as_dict()["misses"] == stats.misses > 0
        assert stats.milliseconds >= sum(stats.stages.values()) > 0
        assert len(slow) == 1, "once is enough"
        for again in (copy.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))):
            _, stats = engine.frame(camera(), GRAY)
            assert again(stats) == stats and stats.tiles_used > 0


def scenes(blobs) -> list:
    neighbour = gv.Volume(blobs.data, blobs.spacing, (70.0, -3.0, 2.0))
    return [
        gv.VolumeProducer(blobs),
        {"left": gv.VolumeProducer(blobs), "right": gv.VolumeProducer(neighbour)},
    ]


@pytest.mark.backend("cuda")
@pytest.mark.parametrize("trees", [1, 2])
@pytest.mark.parametrize("monitor", [True, False])
def test_a_steady_frame_on_cuda_waits_for_nobody(cuda, blobs, monitor, trees):
    scene, background = scenes(blobs)[trees - 1], (0.1, 0.2, 0.3)
    views = [camera(64, azimuth=azimuth) for azimuth in (30, 31)]
    views.append(gv.Camera.orbit([30.0, 40.0], 20, 2.4, width=64, height=64))
    with gv.Engine(scene, brick_size=4, device=cuda, monitor=monitor) as engine:
        expected = []
        for view in [*views, *views]:
            expected.append(engine.render(view, GRAY, background=background))
            assert expected[-1].stats.converged
        for view in views:  # one-time loads and uploads are done
            engine.frame(view, GRAY, background=background)
        with nobody_waits():
            frames = [engine.frame(view, GRAY, background=background) for view in views * 3]
        for (picture, stats), whole in zip(frames, (expected[3:]) * 3, strict=True):
            assert stats.converged and stats.milliseconds > 0
            assert ("trace" in stats.stages) == monitor
            assert_same_picture(picture, whole)
        engine.validate()


@pytest.mark.backend("cuda")
@pytest.mark.parametrize("trees", [1, 2])
def test_a_replayed_graph_on_cuda_is_the_frame(cuda, blobs, trees):
    scene = scenes(blobs)[trees - 1]
    views = [camera(64, azimuth=azimuth, distance=1.5) for azimuth in (0, 10, 20, 30)]
    with gv.Engine(scene, brick_size=4, device=cuda) as engine:
        for _ in range(2):
            for view in views:
                assert engine.render(view, GRAY).stats.converged
        expected = [engine.frame(view, GRAY) for view in views]
        graph = engine.capture(views[0], GRAY)
        torch.cuda.synchronize()
        assert engine.steady
        with nobody_waits():
            replayed = []
            for view in views:
                picture, stats = graph.replay(view)
                replayed.append(({n: getattr(picture, n).clone() for n in FIELDS}, stats))
        for (parts, stats), (whole, expected_stats) in zip(replayed, expected, strict=True):
            assert all(torch.equal(parts[name], getattr(whole, name)) for name in FIELDS)
            assert stats.converged and stats.milliseconds > 0 and "replay" in stats.stages
            for name in ("samples", "tiles_used", "bricks_used", "rays", "misses", "bytes"):
                assert getattr(stats, name) == getattr(expected_stats, name), name
        engine.validate()
        with pytest.raises(ValueError, match=r"must be 1 of 64x64 pixels \(pinhole\) as captured"):
            graph.replay(camera(32))


@pytest.mark.backend("cuda")
def test_a_graph_on_cuda_tells_when_it_is_not_steady(cuda, aneurism):
    """As a camera approaches, frames are replays while all is loaded, else ordinary frames."""
    tree = gv.N3Tree.from_volume(aneurism, device=cuda)
    with gv.Engine(gv.VolumeProducer(aneurism), device=cuda) as engine:
        engine.render(camera(distance=6.0), VESSELS)
        graph = engine.capture(camera(distance=6.0), VESSELS)
        replays = frames = 0
        for distance in (6.0, 5.0, 3.0, 1.2, 0.9):
            for _ in range(20):
                view = camera(distance=distance)
                if engine.steady:
                    picture, stats = graph.replay(view)
                    replays += 1
                else:
                    picture, stats = engine.frame(view, VESSELS)
                    frames += 1
                stats.settle()
                assert engine.steady == stats.converged
            assert stats.converged
            assert_same_picture(picture, gv.render(tree, view, VESSELS))
            engine.validate()
        assert replays > 20 and frames > 3


@pytest.mark.backend("cpp")
def test_steady_tells_what_is_known(slow, blobs):
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        assert not engine.steady
        assert engine.render(camera(), GRAY).stats.converged and engine.steady
        _, stats = engine.frame(camera(distance=0.1), GRAY)
        assert engine.steady and not stats.converged, "its counts have not come"
        engine.render(camera(distance=0.1), GRAY, "balanced", productions=1)
        assert not engine.steady


def test_a_graph_needs_cuda(blobs):
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        with pytest.raises(ValueError, match=r"Engine\.capture: the engine must be on CUDA, it is"):
            engine.capture(camera(), GRAY)
