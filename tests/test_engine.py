"""The engine: a picture from small pools equals that of a resident tree; pools stay valid."""

from __future__ import annotations

import functools
import gc
import random
from collections.abc import Callable
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
import torch
from helpers import DEVICES, shared
from helpers.pictures import FIELDS, VESSELS, assert_same_picture, camera
from helpers.producers import Checked, Late
from hypothesis import given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base.constants import REQUEST_LOAD
from gvtorch.engine import EngineSettings
from gvtorch.engine.ray_subsets import scouts

AORTA = gv.TransferFunction.from_points([(140, 0), (400, 0.25), (900, 0.95)])


def working_set(picture: gv.Picture) -> int:
    return picture.stats.bricks_used


@pytest.fixture(scope="module")
def whole(aneurism) -> Callable[[str, gv.Camera], gv.Picture]:
    """Draws views of the resident tree, which is made once for each device."""
    resident = functools.cache(lambda device: gv.N3Tree.from_volume(aneurism, device=device))
    return functools.cache(lambda device, view: gv.render(resident(device), view, VESSELS))


def tooth() -> gv.Volume:
    return gv.read_volume(shared("volumes/tooth_103x94x161_uint8.raw.gz"))


@pytest.mark.parametrize(
    ("scan", "producer", "loading"),
    [  # each pair of values
        *(
            (scan, producer, loading)
            for scan in ("aneurism", "tooth")
            for producer, loading in ((gv.VolumeProducer, "straight"), (Late, "levels"))
        ),
        *(
            (scan, producer, loading)
            for scan in ("stent", "blobs")
            for producer, loading in ((gv.VolumeProducer, "levels"), (Late, "straight"))
        ),
    ],
)
def test_a_small_pool_gives_the_picture_of_the_whole(request, compiled, scan, producer, loading):
    volume = tooth() if scan == "tooth" else request.getfixturevalue(scan)
    shader = AORTA if scan == "stent" else gv.TransferFunction.preset("gray", *volume.value_range)
    device, view = DEVICES[compiled], camera(distance=1.4)
    resident = gv.render(gv.N3Tree.from_volume(volume, device=device), view, shader)
    bricks = int(1.25 * working_set(resident)) + 8
    pool = bricks * 1000 * volume.data.element_size()
    options = {"brick_pool": pool, "node_pool": "1 MB", "device": device, "loading": loading}
    with gv.Engine(producer(volume), **options) as engine:
        picture = engine.render(view, shader)
        engine.validate()
        stats = picture.stats
        assert stats.converged and not stats.capacity_exceeded and stats.failed == 0
        assert_same_picture(picture, resident)
        again, stats = engine.frame(view, shader)
        assert stats.converged and not any(stats.produced.values()), "nothing is asked for twice"
        assert_same_picture(again, resident)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("lod", ["auto", "finest"])
def test_many_views_from_one_small_pool(aneurism, lod):
    """Bricks are replaced between views; each converged picture equals the resident tree's."""
    tree = gv.N3Tree.from_volume(aneurism)
    views = [camera(32, azimuth=a, distance=d) for a, d in ((0, 0.5), (80, 0.7), (200, 0.4))]
    whole = [gv.render(tree, view, VESSELS, lod=lod) for view in views]
    largest = max(working_set(picture) for picture in whole)
    with gv.Engine(gv.VolumeProducer(aneurism), brick_pool=int(1.3 * largest) * 1000) as engine:
        evicted = 0
        for view, expected in [*zip(views, whole, strict=True)] * 2:
            picture = engine.render(view, VESSELS, lod=lod)
            engine.validate()
            assert picture.stats.converged
            assert_same_picture(picture, expected)
            evicted += picture.stats.evicted["bricks"]
        assert evicted > largest, "the views must not fit together"


VIEW, FINE = (camera(size, distance=1.2) for size in (64, 96))


def slots_of(picture: gv.Picture, pool: str) -> tuple[int, int]:
    """Returns how many slots of a pool a picture needs, and the size of one in bytes."""
    if pool == "brick_pool":
        return working_set(picture), 1000
    return picture.stats.tiles_used, 8 * 11


@pytest.mark.parametrize("loading", ["straight", "levels"])
@pytest.mark.parametrize("pool", ["brick_pool", "node_pool"])
def test_where_pools_are_too_small_rays_take_turns(aneurism, whole, compiled, loading, pool):
    """Converged pictures equal the resident tree's, though no frame can hold all their bricks."""
    device = DEVICES[compiled]
    expected = whole(device, VIEW)
    slots, size = slots_of(expected, pool)
    for share in (0.45, 0.8, 1.3):
        options = {pool: int(share * slots) * size, "device": device, "loading": loading}
        with gv.Engine(gv.VolumeProducer(aneurism), **options) as engine:
            picture = engine.render(VIEW, VESSELS)
            engine.validate()
            assert picture.stats.converged
            assert picture.stats.capacity_exceeded == (share < 0.5) or 0.5 < share < 1
            assert_same_picture(picture, expected)


@pytest.mark.parametrize("loading", ["straight", "levels"])
@pytest.mark.parametrize("pool", ["brick_pool", "node_pool"])
def test_a_frame_from_too_small_pools_is_complete_and_coarser(
    aneurism, whole, compiled, loading, pool
):
    """Frames are drawn until the pools no longer change: the error falls as the pool grows."""
    device = DEVICES[compiled]
    expected = whole(device, VIEW)
    slots, size = slots_of(expected, pool)
    errors = []
    for share in (0.1, 0.3, 0.6, 1.3):
        options = {pool: int(share * slots) * size, "device": device, "loading": loading}
        with gv.Engine(gv.VolumeProducer(aneurism), **options) as engine:
            for number in range(200):
                picture, stats = engine.frame(VIEW, VESSELS)
                stats.settle()
                if number and not any(stats.produced.values()):
                    break
            engine.validate()
            assert not any(stats.produced.values()), "it comes to rest"
            assert stats.capacity_exceeded == (share < 1) == (not stats.converged)
            covered = (picture.alpha > 0).float().mean()
            assert covered > 0.8 * (expected.alpha > 0).float().mean()
            errors.append(float((picture.color - expected.color).square().mean().sqrt()))
    assert errors == sorted(errors, reverse=True) and errors[-1] == 0 < errors[2] < errors[0]


@pytest.mark.backend("cpp")
def test_a_pool_that_holds_almost_nothing_ends_too(aneurism):
    for options in ({"brick_pool": 2000}, {"node_pool": 16 * 8 * 11}):
        with gv.Engine(gv.VolumeProducer(aneurism), **options) as engine:
            picture = engine.render(camera(24, distance=0.8), VESSELS, max_frames=150)
            engine.validate()
            assert picture.stats.capacity_exceeded and picture.stats.frames <= 150
            assert not picture.stats.converged and torch.isfinite(picture.color).all()


@settings(max_examples=25, deadline=None)
@given(data=st.data())
@pytest.mark.backend("cpp")
def test_pools_stay_in_order_over_random_frames(blobs, data):
    """`Checked` asserts after every frame."""
    branching = data.draw(st.sampled_from([2, 3]))
    loading = data.draw(st.sampled_from(["straight", "levels"]))
    producer = (
        Late(blobs, max_delay=0.001) if data.draw(st.booleans()) else gv.VolumeProducer(blobs)
    )
    producer.branching = branching
    options = {
        "brick_size": 4,
        "brick_pool": data.draw(st.integers(3, 300)) * 6**3 * 4,
        "node_pool": data.draw(st.integers(8, 80)) * branching**3 * 20,
        "load_budget": data.draw(st.integers(1, 200)),
        "subdivide_budget": data.draw(st.integers(1, 50)),
        "order": data.draw(st.sampled_from(["coarse", "fine"])),
        "scout_rounds": data.draw(st.integers(0, 4)),
    }
    shader = gv.TransferFunction.preset("gray", 0, 1)
    with Checked(producer, loading=loading, **options) as engine:
        for _ in range(data.draw(st.integers(1, 12))):
            view = camera(
                10,
                azimuth=data.draw(st.floats(-180, 180)),
                distance=data.draw(st.sampled_from([0.1, 0.6, 1.5, 5.0])),
            )
            lod = data.draw(st.sampled_from(["auto", "finest"]))
            engine.frame(view, shader, lod=lod)


def test_scouts_are_few():
    """Scouts are all rays that missed something if these are at most a sixteenth, else 1 of 4x4."""
    missed = torch.zeros(8, 16, dtype=torch.bool)
    missed[3, 1:9] = True
    assert torch.equal(scouts(missed.flatten(), 16), missed.flatten())
    missed[:5, :5] = True
    sent = scouts(missed.flatten(), 16).view(8, 16)
    assert sent.nonzero().tolist() == [[0, 0], [0, 4], [4, 0], [4, 4]]


@pytest.mark.parametrize("loading", ["straight", "levels"])
def test_scouts_save_frames(aneurism, whole, compiled, loading):
    """The same picture from the same bricks; the requests of all rounds add up."""
    device, view = DEVICES[compiled], FINE
    frames, bricks = [], []
    for rounds in (0, 1, 3):
        options = {"scout_rounds": rounds, "loading": loading, "device": device}
        with Checked(gv.VolumeProducer(aneurism), **options) as engine:
            total = {"load": 0, "subdivide": 0, "bricks": 0, "tiles": 0, "constant": 0}
            converged = False
            while not converged:
                picture, stats = engine.frame(view, VESSELS)
                converged = stats.converged
                for name, number in {**stats.requests, **stats.produced}.items():
                    total[name] += number
            assert_same_picture(picture, whole(device, view))
            assert total["load"] == total["bricks"] + total["constant"]
            assert total["subdivide"] <= total["tiles"], "some were made before they were asked for"
            frames.append(engine.frames)
            bricks.append(total["bricks"])
    assert frames[2] < frames[1] < frames[0] and frames[2] <= 0.6 * frames[0]
    assert max(bricks) <= 1.05 * min(bricks)


class Watched(Checked):
    """Asserts after every round of a frame that nothing was evicted that was written within the
    frame or used by scouts.
    """

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.rounds = self.evicted = 0
        self.unwatched, self.production.serve = self.production.serve, self.serve

    def frame(self, *args, **options):
        nodes, bricks = self.cache.nodes, self.cache.bricks
        self.start = [bricks.owner_b.clone(), nodes.parent_t.clone()]
        self.round = 0
        return super().frame(*args, **options)

    def serve(self, listed, counts, stats):
        nodes, bricks = self.cache.nodes, self.cache.bricks
        before = [bricks.owner_b.clone(), nodes.parent_t.clone()]
        kept = [
            (now >= 0) & ((now != start) | (stamp == self.frames))
            for now, start, stamp in zip(
                before, self.start, (bricks.stamp_b, nodes.stamp_t), strict=True
            )
        ]
        evicted = sum(stats.evicted.values())
        self.unwatched(listed, counts, stats)
        for now, old, keep in zip((bricks.owner_b, nodes.parent_t), before, kept, strict=True):
            assert torch.equal(now[keep], old[keep])
        if self.round:
            self.rounds += 1
            self.evicted += sum(stats.evicted.values()) - evicted
        self.round += 1


@pytest.mark.parametrize("loading", ["straight", "levels"])
def test_scouts_take_nothing_that_is_in_use(blobs, compiled, loading):
    """In pools of a few slots; budgets apply to all rounds of a frame together."""
    pick = random.Random(5)
    shader = gv.TransferFunction.preset("gray", 0, 1)
    rounds = evicted = 0
    for trial in range(8):
        slots, tiles_ = pick.choice([(pick.randint(8, 60), 200), (200, pick.randint(10, 60))])
        limit = pick.choice([3, 20, 1000])
        options = {"brick_pool": slots * 6**3 * 4, "node_pool": tiles_ * 8 * 20, "brick_size": 4}
        budgets = {"load_budget": limit, "subdivide_budget": limit, "scout_rounds": 1 + trial % 4}
        placement = {"device": DEVICES[compiled], "loading": loading}
        with Watched(gv.VolumeProducer(blobs), **options, **budgets, **placement) as engine:
            azimuth, distance = 0.0, 1.0
            for _ in range(48):
                azimuth += pick.gauss(0, 20)
                distance = min(3.0, max(0.2, distance * np.exp(pick.gauss(0, 0.2))))
                view = camera(12, azimuth=azimuth % 360 - 180, distance=distance)
                _, stats = engine.frame(view, shader)
                assert max(stats.produced["bricks"], stats.produced["tiles"]) <= limit
            rounds, evicted = rounds + engine.rounds, evicted + engine.evicted
    assert rounds > 100 and evicted > 20


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 1000), loading=st.sampled_from(["straight", "levels"]))
@pytest.mark.backend("cpp")
def test_twins_and_kernels_drive_the_engine_alike(blobs, seed, loading):
    """The same frames, by the reference and the C++ backend, leave the same pools."""
    pick = random.Random(seed)
    views = [
        camera(8, azimuth=pick.uniform(0, 360), distance=pick.choice([0.3, 1.2, 4.0]))
        for _ in range(2)
    ]
    shader = gv.TransferFunction.preset("gray", 0, 1)
    fields = []
    for backend in ("reference", "cpp"):
        options = {"brick_size": 4, "brick_pool": 40 * 6**3 * 4, "node_pool": 30 * 8 * 20}
        with gv.Engine(gv.VolumeProducer(blobs), loading=loading, **options) as engine:
            for view in views:
                engine.frame(view, shader, backend=backend)
            nodes, bricks = engine.cache.nodes, engine.cache.bricks
            fields.append({**nodes.fields, **bricks.fields})
    for name, field in fields[0].items():
        assert torch.equal(field, fields[1][name]), name


@pytest.mark.backend("cpp")
def test_modes(blobs):
    shader = gv.TransferFunction.preset("gray", 0, 1)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        once = engine.render(camera(), shader, "interactive")
        assert once.stats.frames == 1 and not once.stats.converged
        three = engine.render(camera(), shader, "balanced", productions=2)
        assert three.stats.frames == 2 and engine.frames == 3
        done = engine.render(camera(), shader, "converge")
        assert done.stats.converged
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        cut = engine.render(camera(), shader, "converge", max_frames=1)
        assert cut.stats.frames == 1 and not cut.stats.converged


@pytest.mark.backend("cpp")
def test_several_trees_of_different_branching_share_the_pools(blobs):
    """Two scans side by side, N = 2 and N = 3, in one cache: each looks as it does alone."""
    right = gv.Volume(blobs.data, blobs.spacing, (70.0, -3.0, 2.0))
    scene = {"left": gv.VolumeProducer(blobs), "right": gv.VolumeProducer(right)}
    scene["right"].branching = 3
    shader = gv.TransferFunction.preset("hot", 0, 1)
    view = gv.Camera.look_at((60, 10, 170), (60, 10, 30), (0, 1, 0), 40, 64, 40)
    with gv.Engine(scene, brick_size=4) as engine:
        both = engine.render(view, shader)
        engine.validate()
        assert both.stats.converged
    alone = []
    for volume, branching in ((blobs, 2), (right, 3)):
        tree = gv.N3Tree.from_volume(volume, 4, branching=branching)
        alone.append(gv.render(tree, view, shader))
    a, b = alone
    assert ((a.alpha > 0) & (b.alpha > 0)).sum() == 0, "they stand side by side"
    assert torch.equal(both.color, a.color + b.color)
    assert torch.equal(both.alpha, a.alpha + b.alpha)
    assert torch.equal(both.depth, torch.minimum(a.depth, b.depth))
    assert a.alpha.max() > 0.3 and b.alpha.max() > 0.3


@pytest.mark.backend("cpp")
def test_the_nearer_tree_hides_the_farther_one():
    solid = np.full((8, 8, 8), 200, np.uint8)
    near = gv.VolumeProducer(gv.Volume(solid, origin=(0, 0, 20)))
    far = gv.VolumeProducer(gv.Volume(solid, origin=(0, 0, 0)))
    red = gv.TransferFunction.from_points([(0, 1)], [(0, 1, 0, 0)])
    blue = gv.TransferFunction.from_points([(0, 1)], [(0, 0, 0, 1)])
    shaders = {"near": red, "far": blue}
    for eye, color in ((60, [1, 0, 0]), (-60, [0, 0, 1])):
        view = gv.Camera.look_at((3.5, 3.5, eye), (3.5, 3.5, 13), (0, 1, 0), 20, 9, 9)
        with gv.Engine({"near": near, "far": far}) as engine:
            picture = engine.render(view, shaders)
        assert picture.color[4, 4].tolist() == color


def test_pools_are_honoured_to_the_byte():
    """They hold the requested bytes to within one slot; bookkeeping adds at most 3.1 %."""

    class Colour(gv.Producer):
        def fill(self, nodes):
            side = nodes.layout.brick_size + 2 * nodes.layout.border
            return {"rgba": torch.ones((len(nodes), *(side,) * 3, 4), dtype=torch.uint8)}

    producer = Colour(1 << 20, channels={"rgba": gv.Channel(torch.uint8, 4)})
    with gv.Engine(producer, node_pool="8 MB", brick_pool="256 MB") as engine:
        memory = engine.memory()
        assert 8e6 - 8 * 20 < memory["node_pool"] <= 8e6
        assert 256e6 - 4000 < memory["brick_pool"] <= 256e6
        managed = memory["node_pool"] + memory["brick_pool"]
        assert memory["bookkeeping"] <= 0.031 * managed
        lru = [tensor for group in engine.cache.lru.values() for tensor in group]
        fields = [*engine.cache.nodes.fields.values(), *engine.cache.bricks.fields.values()]
        total = sum(field.nbytes for field in fields) + sum(tensor.nbytes for tensor in lru)
        assert total == sum(memory.values())


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_a_wandering_camera_leaves_memory_flat(blobs):
    """After 400 frames nothing has piled up, and the pools are valid."""
    pick = random.Random(7)
    shader = gv.TransferFunction.preset("gray", 0, 1)
    options = {"brick_size": 4, "brick_pool": 60 * 6**3 * 4, "node_pool": 40 * 8 * 20}
    azimuth, distance, live, pages, evicted = 0.0, 1.0, [], [], 0
    with gv.Engine(gv.VolumeProducer(blobs), **options) as engine:
        for number in range(400):
            azimuth += pick.gauss(0, 12)
            distance = min(3.0, max(0.2, distance * np.exp(pick.gauss(0, 0.1))))
            view = camera(4, azimuth=azimuth % 360 - 180, distance=distance)
            _, stats = engine.frame(view, shader)
            evicted += stats.evicted["bricks"]
            if number % 100 == 99:
                engine.validate()
                gc.collect()
                live.append(sum(isinstance(item, torch.Tensor) for item in gc.get_objects()))
                pages.append(int(Path("/proc/self/statm").read_text().split()[1]))
        engine.validate()
        assert len(live) == 4 and max(live) - live[0] <= 8, live  # others' garbage may be freed
        assert (pages[-1] - pages[0]) * 4096 < 8e6, "resident memory is flat"
        assert evicted > 40 and len(engine.production.failures) == 0


@pytest.mark.backend("cpp")
def test_report_tells_stages_rates_and_occupancy(blobs):
    shader = gv.TransferFunction.preset("gray", 0, 1)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        engine.render(camera(), shader)
        content = engine.report().as_dict()
        assert content["frames"] == engine.frames and content["bricks_per_second"] > 0
        for name in ("rays", "trace", "requests", "lru", "schedule", "produce", "write"):
            assert 0 < content["stages"][name]["median"] <= content["stages"][name]["p95"]
        assert content["hit_rate"] + content["miss_rate"] == pytest.approx(1)
        assert 0 < content["occupancy"]["bricks"] < 1
        text = str(engine.report())
        assert "trace, ms" in text and "bookkeeping" in text
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, monitor=False) as engine:
        picture = engine.render(camera(), shader)
        assert engine.report().as_dict()["frames"] == 0 and picture.stats.stages == {}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (gv.Engine, "must be a Producer, got Volume"),
        (lambda v: gv.Engine({1: v}), "name of a tree must be a str, got int"),
        (lambda v: gv.Engine({}), "at least one producer"),
        (lambda v: engine(v, brick_pool="lots"), 'brick_pool must be bytes, as in "256 MB"'),
        (lambda v: engine(v, brick_pool=0), "brick_pool must be an int >= 1"),
        (lambda v: engine(v, brick_pool="4 kB"), "holds 1 slots of 4000 bytes, at least 2"),
        (lambda v: engine(v, brick_pool="900 TB"), "GB free"),
        (lambda v: engine(v, node_pool="100 B"), "node_pool of 100 bytes holds 0 slots"),
        (lambda v: engine(v, brick_size=1), "brick_size must be an int >= 2"),
        (lambda v: engine(v, loading="fast"), "loading must be 'straight' or 'levels'"),
        (lambda v: engine(v, order="best"), "order must be 'coarse' or 'fine'"),
        (lambda v: engine(v, time_budget=-1), "time_budget must be finite and > 0"),
        (lambda v: engine(v, patience=0), "patience must be finite and > 0"),
        (lambda v: engine(v, load_budget="many"), "load_budget must be an int >= 1"),
        (lambda v: engine(v, scout_rounds=-1), "scout_rounds must be an int >= 0"),
        (lambda v: engine(v, device="gpu"), "device must name a device, got 'gpu'"),
        (lambda v: engine(v, strict="no"), "strict must be a bool, got str"),
        (lambda v: gv.VolumeProducer("scan"), "VolumeProducer: channel 'value'"),
        (lambda v: gv.VolumeProducer({}), "VolumeProducer: volume must name at least one"),
        (lambda v: gv.Producer(4, channels={"a": torch.uint8}), "channels['a'] must be a Channel"),
        (lambda v: gv.Engine(type("Lazy", (gv.Producer,), {"__init__": nothing})()), "super()"),
        (lambda v: engine(v).frame(camera(), VESSELS, channel="b"), "'b'; tree 'scene' has"),
        (lambda v: engine(v, cache="1 MB"), "unknown option 'cache'; known: node_pool"),
        (lambda v: engine(v).frame(None, VESSELS), "camera must be a Camera, got NoneType"),
        (
            lambda v: engine(v).frame(camera(), None),
            "must be a TransferFunction or another shader, got None",
        ),
        (lambda v: engine(v).frame(camera(), VESSELS, lod="x"), "lod must be 'auto'"),
        (lambda v: engine(v).render(camera(), VESSELS, "fast"), "mode must be 'interactive'"),
        (lambda v: engine(v).render(camera(), VESSELS, max_frames=0), "max_frames must be"),
        (lambda v: engine(v).render(camera(), {"other": VESSELS}), "shader of tree 'scene'"),
    ],
)
def test_bad_arguments_are_named(blobs, call, message):
    with pytest.raises(ValueError) as caught:
        call(blobs)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def nothing(self) -> None:
    torch.nn.Module.__init__(self)


def engine(volume: gv.Volume, **options) -> gv.Engine:
    return gv.Engine(gv.VolumeProducer(volume), **options)


def test_trees_must_agree_on_channels(blobs):
    other = gv.Volume((blobs.data * 9).to(torch.uint8))
    with pytest.raises(ValueError, match="trees disagree on channel 'value'"):
        gv.Engine({"a": gv.VolumeProducer(blobs), "b": gv.VolumeProducer(other)})


@pytest.mark.backend("cpp")
def test_stages_show_in_the_profiler_and_cost_nothing_without_listeners(blobs):
    shader = gv.TransferFunction.preset("gray", 0, 1)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, monitor=False) as engine:
        with torch.autograd.profiler.profile() as seen:  # torch.profiler's imports take seconds
            for _ in range(2):
                engine.frame(camera(8), shader)
        names = {event.key for event in seen.key_averages()}
        steps = ("rays", "trace", "requests", "lru", "schedule", "produce", "write")
        assert {f"gvtorch.{name}" for name in steps} <= names


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("dtype", "branching"),  # each size of a number and each branching
    [
        *(("uint16", 2), ("int16", 3), ("float16", 4), ("bfloat16", 3)),
        *(("int8", 2), ("int8", 3), ("int8", 4)),
    ],
)
def test_every_dtype_and_branching_streams_the_same_bits(dtype, branching):
    """The second component of a second channel, through pools that must evict bricks."""
    z, y, x = np.mgrid[-1:1:40j, -1:1:30j, -1:1:50j]
    kind = getattr(torch, dtype)
    ball = torch.from_numpy(np.clip(1 - x * x - y * y - z * z, 0, 1) * 100).to(kind)
    raw = ball.view(torch.int16) if kind == torch.uint16 else ball
    pair = torch.stack((torch.zeros_like(raw), raw), -1).view(kind)
    volumes = {"first": gv.Volume(ball), "second": gv.Volume(pair)}
    shader = gv.TransferFunction.preset("gray", 0, 100)
    channel = {"channel": "second", "component": 1}
    tree = gv.N3Tree.from_volume(volumes, 4, branching=branching)
    whole = gv.render(tree, camera(distance=1.5), shader, **channel)
    producer = gv.VolumeProducer(volumes)
    producer.branching = branching
    pool = int(0.5 * working_set(whole)) * 6**3 * 3 * kind.itemsize
    with gv.Engine(producer, brick_size=4, brick_pool=pool) as engine:
        picture = engine.render(camera(distance=1.5), shader, **channel)
        engine.validate()
        assert picture.stats.converged and picture.stats.evicted["bricks"] > 0
        assert_same_picture(picture, whole)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("extent", [(1, 1, 1), (3, 2, 5), (8, 8, 8), (9, 8, 8), (300, 1, 2)])
def test_volumes_of_a_brick_and_less(extent):
    x, y, z = extent
    values = torch.arange(x * y * z).reshape(z, y, x).to(torch.int16) * 3 + 100
    volume = gv.Volume(values, spacing=(1, 2, 0.5))
    shader = gv.TransferFunction.from_points([(0, 0.2), (2000, 0.9)])
    with gv.Engine(gv.VolumeProducer(volume)) as engine:
        picture = engine.render(camera(24), shader)
        engine.validate()
        assert picture.stats.converged
        expected = gv.render(gv.N3Tree.from_volume(volume), camera(24), shader)
        for name in FIELDS:
            assert torch.equal(getattr(picture, name), getattr(expected, name)), name
        assert expected.alpha.max() > 0


@pytest.mark.backend("cpp")
def test_a_batch_of_cameras_converges_as_one_picture(aneurism):
    views = gv.Camera.orbit(torch.tensor([0.0, 50.0, 100.0]), 20, 1.3, width=40, height=30)
    whole = gv.render(gv.N3Tree.from_volume(aneurism), views, VESSELS)
    with gv.Engine(gv.VolumeProducer(aneurism), brick_pool=250 * 1000) as engine:
        picture = engine.render(views, VESSELS)
        assert picture.stats.converged and picture.color.shape == (3, 30, 40, 3)
        assert_same_picture(picture, whole)


def test_keywords_of_an_engine_are_its_options():
    assert get_type_hints(EngineSettings) == get_type_hints(gv.EngineOptions)


@pytest.mark.backend("cpp")
def test_engine_objects_show_themselves_in_a_line(blobs):
    haze = gv.TransferFunction.preset("gray", 0, 1)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        _, stats = engine.frame(camera(), haze)
        assert "not read back" in repr(stats)
        assert "misses some" in repr(stats.settle())
        stats = engine.render(camera(), haze).stats
        assert "converged" in repr(stats)
        rays = camera().placed(engine.box).rays()
        objects = [engine, engine.cache, *engine.cache.lru[REQUEST_LOAD], engine.scheduler, stats]
        objects += [rays, engine.production, *engine.trees.values(), engine.report()]
        for item in objects:
            assert len(repr(item)) < 100 and "\n" not in repr(item) and " at 0x" not in repr(item)
