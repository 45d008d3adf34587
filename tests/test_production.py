"""Production: late answers, answers that fail, and interrupted frames."""

from __future__ import annotations

import random
import time
from concurrent.futures import Future, ThreadPoolExecutor

import pytest
import torch
from helpers.pictures import GRAY, camera
from helpers.producers import SIZE, Ball, Held

import gvtorch as gv
from gvtorch.base import constants as config
from gvtorch.engine import ProductionError

CORNER = camera(24, azimuth=45, elevation=35, distance=1.3)


class Broken(Ball):
    """Fails in one way for nodes in one corner of the finest level."""

    def __init__(self, how):
        super().__init__()
        self.how = how

    def bad(self, nodes):
        return (nodes.loc[:, :3] >= 4).all(1) & (nodes.depth == nodes.layout.depth)

    def fill(self, nodes):
        data, bad = super().fill(nodes)["value"], self.bad(nodes)
        if not bad.any():
            return {"value": data}
        if self.how == "raises":
            raise RuntimeError("the disk is on fire")
        if self.how == "raises later":
            future: Future = Future()
            future.set_exception(RuntimeError("the disk is on fire"))
            return future
        if self.how == "never answers":
            return Future()
        if self.how == "nan":
            data[bad] = float("nan")
            return {"value": data}
        if self.how == "names":
            wrong = {int(i): "chunk 7 is damaged" for i in bad.nonzero()[:, 0]}
            return gv.Bricks(data={"value": data}, errors=wrong)
        return {"shape": {"value": data[:, 1:]}, "dtype": {"value": data.double()}}.get(
            self.how, {"colour": data}
        )


REASONS = {
    "raises": "RuntimeError: the disk is on fire",
    "raises later": "RuntimeError: the disk is on fire",
    "never answers": "no answer within 0.2 s",
    "nan": "channel 'value' holds NaN or infinite values",
    "names": "chunk 7 is damaged",
    "shape": "Broken.fill: data['value'] must be (",
    "dtype": "float32, got",
    "channel": "Broken.fill: channel 'value' is missing",
}


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("how", REASONS)
def test_what_fails_is_named_and_takes_nobody_with_it(how):
    """The picture stays complete, but coarser where bricks failed; each failure is named once."""
    view = CORNER
    with gv.Engine(Ball(), **SIZE) as whole, gv.Engine(Broken(how), patience=0.2, **SIZE) as engine:
        expected = whole.render(view, GRAY, lod="finest")
        start = time.monotonic()
        picture = engine.render(view, GRAY, lod="finest")
        assert time.monotonic() - start < 30
        engine.validate()
        stats = picture.stats
        assert stats.converged and stats.failed == len(engine.failures) > 0
        assert len({failure.loc for failure in engine.failures}) == stats.failed
        failure = engine.failures[0]
        assert failure.kind == "load" and failure.tree == "scene" and failure.loc[3] == 3
        assert REASONS[how] in failure.message, failure
        x, y, z, _ = failure.loc
        assert f"depth 3, node ({x}, {y}, {z}), load: " in str(failure)
        if how in ("raises", "nan", "names"):  # a whole batch of the wrong shape is lost
            assert all(min(failure.loc[:3]) >= 4 for failure in engine.failures)
        assert (picture.color - expected.color).abs().max() < 0.2
        assert not torch.equal(picture.color, expected.color)
        again = engine.render(view, GRAY, lod="finest")
        assert again.stats.failed == stats.failed, "what failed is not asked for again"


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("how", REASONS)
def test_a_strict_engine_raises_what_failed(how):
    with gv.Engine(Broken(how), patience=0.2, strict=True, **SIZE) as engine:
        with pytest.raises(ProductionError) as caught:
            engine.render(CORNER, GRAY, lod="finest")
        assert REASONS[how] in str(caught.value) and "depth 3, node" in str(caught.value)
        engine.validate()
        engine.production.failures.strict = False
        picture = engine.render(CORNER, GRAY, lod="finest")
        assert picture.stats.converged and picture.alpha.max() > 0.3, "and it goes on"


class Reversed(Ball):
    """Returns (largest, smallest) as the range of nodes at the finest level."""

    def classify(self, nodes):
        finest = nodes.depth == nodes.layout.depth
        ends = torch.where(finest[:, None], torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0]))
        return gv.Regions(kind=super().classify(nodes), ranges={"value": ends[..., None]})


@pytest.mark.backend("cpp")
def test_a_reversed_range_is_named():
    """The transfer function would show nothing of its nodes."""
    with gv.Engine(Reversed(), **SIZE) as engine:
        picture = engine.render(CORNER, GRAY, lod="finest")
        assert picture.stats.converged and picture.alpha.max() > 0.3
        reasons = {str(failure).rpartition(": ")[2] for failure in engine.failures}
        assert reasons == {"the range of channel 'value' is reversed"}


@pytest.mark.backend("cpp")
def test_failures_can_be_forgotten_and_are_then_asked_for_again():
    view, broken = CORNER, Broken("raises")
    with gv.Engine(Ball(), **SIZE) as whole, gv.Engine(broken, **SIZE) as engine:
        assert engine.render(view, GRAY, lod="finest").stats.failed > 0
        broken.how = "nothing"
        broken.bad = lambda nodes: torch.zeros(len(nodes), dtype=torch.bool)
        engine.forget_failures()
        picture = engine.render(view, GRAY, lod="finest")
        assert picture.stats.failed == 0 and engine.failures == []
        assert torch.equal(picture.color, whole.render(view, GRAY, lod="finest").color)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda n: None, "classify: must return Regions or a tensor, got NoneType"),
        (lambda n: torch.zeros(3), "classify: kind must be (8,) of Region, got (3,) float32"),
        (lambda n: torch.full((len(n),), 9), "9 is no Region"),
        (lambda n: torch.full((len(n),), 4), "classify: alias must be (8, 4)"),
        (
            lambda n: gv.Regions(kind=torch.full((len(n),), 2), ranges={"value": torch.zeros(2)}),
            "classify: ranges['value'] must be (8, 2, 1) float32",
        ),
        (
            lambda n: gv.Regions(kind=torch.full((len(n),), 2), constants={"red": torch.zeros(8)}),
            "classify: constants: unknown channel 'red'; the producer has value",
        ),
    ],
)
def test_wrong_regions_are_named(answer, message):
    class Wrong(Ball):
        def classify(self, nodes):
            return answer(nodes) if (nodes.depth > 0).any() else super().classify(nodes)

    with gv.Engine(Wrong(), **SIZE) as engine:
        picture = engine.render(camera(24, distance=1.3), GRAY)
        assert picture.stats.failed >= 1 and message in engine.failures[0].message
        assert engine.failures[0].kind == "subdivide" and picture.alpha.max() > 0.1


#: Answers of the wrong form, given voxels (k, ...), and what the failures say.
MALFORMED = {
    "no data": (lambda v: gv.Bricks(data=None), "fill: data must be a dict, got NoneType"),
    "data": (lambda v: gv.Bricks(data=v), "fill: data must be a dict, got ("),
    "constants": (
        lambda v: gv.Bricks(data={"value": v}, constants=torch.zeros(len(v), 1)),
        "fill: constants must be a dict, got (",
    ),
    "no errors": (lambda v: gv.Bricks(data={"value": v}, errors=None), "errors must be a dict"),
    "key": (
        lambda v: gv.Bricks(data={"value": v}, errors={"0": "x"}),
        "errors names an item that is not in the batch",
    ),
    "message": (
        lambda v: gv.Bricks(data={"value": v}, errors=dict.fromkeys(range(len(v)), 404)),
        "404",
    ),
    "kind": (
        lambda v: gv.Bricks(data={"value": v}, kind=torch.full((len(v),), 2j)),
        "kind must be (",
    ),
    "sparse": (lambda v: {"value": v.to_sparse()}, "float32 on cpu, sparse_coo"),
    "meta": (lambda v: {"value": v.to("meta")}, "float32 on meta"),
    "mapping": (lambda v: gv.Bricks(data=Unreadable()), "KeyError: 'unreadable'"),
}


class Unreadable(dict):
    def __iter__(self):
        raise KeyError("unreadable")


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("how", MALFORMED)
def test_answers_of_the_wrong_form_fail_and_never_break_the_frame(how):
    answer, message = MALFORMED[how]

    class Wrong(Ball):
        def fill(self, nodes):
            values = super().fill(nodes)["value"]
            return answer(values) if (nodes.depth > 0).any() else values

    with gv.Engine(Wrong(), **SIZE) as engine:
        stats = engine.render(CORNER, GRAY).stats
        assert stats.converged and stats.failed == len(engine.failures) > 0
        assert message in engine.failures[0].message
        engine.validate()


@pytest.mark.backend("cpp")
def test_a_failure_is_one_printable_line():
    class Loud(Ball):
        def fill(self, nodes):
            if (nodes.depth > 0).any():
                raise RuntimeError("\x1b[31mfire\n" * 10_000)
            return super().fill(nodes)

    with gv.Engine(Loud(), **SIZE) as engine:
        engine.render(CORNER, GRAY)
        message = engine.failures[0].message
        assert message.startswith("RuntimeError: \\x1b[31mfire") and len(message) < 2000


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("raises", "RuntimeError: the disk is on fire$"),
        ("nan", "channel 'value' holds NaN or infinite values$"),
        ("never answers", "TimeoutError: no answer within 0.1 s$"),
    ],
)
def test_a_root_that_cannot_be_made_is_an_error_at_once(how, message):
    class Rootless(Broken):
        def bad(self, nodes):
            return nodes.depth == 0

    with pytest.raises(ProductionError, match=f"the root of tree 'scene' can't be made: {message}"):
        gv.Engine(Rootless(how), patience=0.1, **SIZE)


class Watched(Ball):
    closed = False

    def close(self):
        self.closed = True


class Stopped(Ball):
    """Ctrl-C arrives while the root is made."""

    def classify(self, nodes):
        raise KeyboardInterrupt


def test_an_engine_that_is_interrupted_while_it_opens_closes_its_producers():
    first = Watched()
    with pytest.raises(KeyboardInterrupt):
        gv.Engine({"first": first, "second": Stopped()})
    assert first.closed


@pytest.mark.parametrize("patience", [20.0, float("inf")])
def test_the_root_is_waited_for_as_long_as_the_producer_says(patience):
    pool = ThreadPoolExecutor(1)

    class Late(Ball):
        def classify(self, nodes):
            answer = super().classify(nodes)
            return pool.submit(lambda: (time.sleep(0.3), answer)[1]) if len(nodes) == 1 else answer

    producer = Late()
    producer.patience = patience
    with gv.Engine(producer, patience=0.05, **SIZE) as engine:
        assert engine.trees["scene"].patience == patience
    pool.shutdown()


@pytest.mark.parametrize(
    ("own", "part", "expected"), [(None, 5.0, 7.0), (None, 9.0, 9.0), (1.0, 5.0, 1.0)]
)
def test_joined_producers_are_as_patient_as_the_most_patient_part(own, part, expected):
    """A part without a patience of its own has the engine's."""
    parts = {"a": Ball(), "b": Ball()}
    joined = gv.JoinedProducer(parts)
    joined.patience, parts["a"].patience = own, part
    with gv.Engine(joined, patience=7, **SIZE) as engine:
        assert engine.trees["scene"].patience == expected


@pytest.mark.backend("cpp")
def test_an_answer_for_a_node_that_is_gone_is_dropped():
    """Futures that finish after their tile was evicted do no harm."""
    slow = ThreadPoolExecutor(1)

    class Slow(Ball):
        def fill(self, nodes):
            if (nodes.depth == 0).any():
                return super().fill(nodes)
            data = super().fill(nodes)
            return slow.submit(lambda: (time.sleep(0.02), data)[1])

    options = {**SIZE, "node_pool": 12 * 8 * 20}
    with gv.Engine(Slow(128), **options) as engine:
        for azimuth in range(0, 360, 20):
            engine.frame(camera(8, azimuth=azimuth, distance=0.4), GRAY)
            engine.validate()
        picture = engine.render(camera(24, distance=9.0), GRAY)
        engine.validate()
        assert picture.stats.failed == 0
    slow.shutdown()


def test_pending_requests_are_not_listed_twice(backend):
    requested = []

    class Never(Ball):
        def fill(self, nodes):
            if (nodes.depth == 0).any():
                return super().fill(nodes)
            requested.append(nodes.loc)
            return Future()

    device = "cuda" if backend == "cuda" else "cpu"
    with gv.Engine(Never(), device=device, **SIZE) as engine:
        for _ in range(6):
            _, stats = engine.frame(camera(8, distance=1.3), GRAY, backend=backend)
        everything = torch.cat(requested)
        assert len(everything.unique(dim=0)) == len(everything) == stats.pending
        assert stats.misses >= stats.pending > 0 and not stats.converged
        request = engine.cache.nodes.request_tn
        bits = config.REQUEST_LOAD << config.REQUEST_PENDING_SHIFT
        assert int((request & bits).count_nonzero()) == stats.pending


@pytest.mark.backend("cpp")
def test_late_answers_never_land_in_the_wrong_place():
    """Tiles arrive late, when their nodes are not in use, in pools of a few tiles: the tile that
    holds a node may be evicted for another node of the same answer."""
    volume = gv.Volume(torch.rand((64, 64, 64), generator=torch.Generator().manual_seed(0)))
    tree = gv.N3Tree.from_volume(volume, 4)
    haze = gv.TransferFunction.from_points([(0, 0.0), (1, 0.02)])
    pick = random.Random(3)
    for trial in range(12):
        producer, tiles = Held(volume, trial), pick.randint(12, 80)
        with gv.Engine(producer, brick_size=4, brick_pool="8 MB", node_pool=tiles * 160) as engine:
            for _ in range(20):
                eye, target = ([pick.uniform(0, 64) for _ in range(3)] for _ in range(2))
                view = gv.Camera.look_at(eye, target, (0, 1, 0), 30, 8, 8)
                engine.frame(view, haze)
                if pick.random() < 0.4:
                    producer.release()
                engine.validate()
            producer.hold = False
            producer.release()
            picture = engine.render(view, haze)
            engine.validate()
            if picture.stats.converged:
                assert torch.equal(picture.color, gv.render(tree, view, haze).color)


@pytest.mark.backend("cpp")
def test_a_later_job_may_answer_before_an_earlier_one(blobs):
    producer = Held(blobs)
    with gv.Engine(producer, brick_size=4, loading="levels") as engine:
        views = [camera(8, azimuth=azimuth, distance=0.5) for azimuth in (0, 90, 180)]
        engine.frame(views[0], GRAY)
        for view in views:
            engine.frame(view, GRAY)
            first, *others = producer.held
            producer.held = others
            producer.release()
            producer.held = [first]
        _, stats = engine.frame(views[-1], GRAY)
        assert stats.pending > 0 and stats.frame == 5
        producer.hold = False
        producer.release()
        assert engine.render(views[-1], GRAY).stats.converged
        assert len(engine.production.failures) == 0


@pytest.mark.backend("cpp")
def test_what_failed_counts_once_even_when_its_tile_comes_back():
    options = {**SIZE, "node_pool": 14 * 160}
    seen = set()
    with gv.Engine(Broken("names"), **options) as engine:
        for _ in range(2):
            for azimuth in (30, 45, 60):
                view = camera(12, elevation=35, azimuth=azimuth, distance=0.8)
                stats = engine.render(view, GRAY, lod="finest", max_frames=200).stats
        seen = {failure.loc for failure in engine.failures}
        assert stats.failed == len(seen) == len(engine.failures) > 0


@pytest.mark.backend("cpp")
def test_a_producer_that_always_raises_is_not_asked_for_ever():
    calls = []

    class Never(Ball):
        def fill(self, nodes):
            if (nodes.depth == 0).any():
                return super().fill(nodes)
            calls.append(len(nodes))
            raise RuntimeError("out of order")

    with gv.Engine(Never(256), **{**SIZE, "node_pool": "4 MB"}) as engine:
        picture = engine.render(camera(64, distance=1.3), GRAY, lod="finest")
        assert picture.stats.failed > 2000 and len(calls) < 0.6 * picture.stats.failed
        assert picture.stats.converged and picture.alpha.max() > 0.1


class Unready(Future):
    """Is done when it is checked for the second time."""

    def __init__(self, answer):
        super().__init__()
        self.answer, self.looks = answer, 0

    def done(self):
        self.looks += 1
        return self.looks > 1

    def result(self, timeout=None):
        return self.answer()


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("later", [False, True])
def test_a_frame_that_is_broken_off_loses_nothing(later):
    """Ctrl-C in the middle of production, as in a notebook: the next picture is complete. If
    answers are late, bricks have arrived and tiles are being checked."""
    broken = []

    class Stopped(Ball):
        def classify(self, nodes):
            def answer():
                if (nodes.depth == nodes.layout.depth).any() and len(broken) < 3:
                    broken.append(len(nodes))
                    raise KeyboardInterrupt
                return torch.full((len(nodes),), gv.Region.DATA)

            root = (nodes.depth == 0).any()
            return Unready(answer) if later and not root else answer()

        def fill(self, nodes):
            data = super().fill(nodes)
            return Unready(lambda: data) if later and not (nodes.depth == 0).any() else data

    view, options = camera(24, distance=1.0), {**SIZE, "loading": "levels"}
    with gv.Engine(Ball(64), **options) as plain, gv.Engine(Stopped(64), **options) as engine:
        for _ in range(3):
            with pytest.raises(KeyboardInterrupt):
                for azimuth in range(0, 180, 4):
                    engine.frame(camera(8, distance=1.0, azimuth=azimuth), GRAY, lod="finest")
        engine.production.wait = lambda *_, **__: None  # nothing wakes an Unready
        picture = engine.render(view, GRAY, lod="finest")
        engine.validate()
        assert picture.stats.converged and picture.stats.failed == 0 and len(broken) == 3
        assert torch.equal(picture.color, plain.render(view, GRAY, lod="finest").color)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32])
def test_loaded_bricks_narrow_the_ranges_of_nodes_without_children(dtype):
    """`classify` gives bounds; once a brick is loaded, its voxels, with borders, give the range."""

    class Loose(Ball):
        def fill(self, nodes):
            value = super().fill(nodes)["value"]
            return {"value": value if dtype.is_floating_point else (200 * value).to(dtype)}

    options = {"channels": {"value": gv.Channel(dtype)}}
    shader = gv.TransferFunction.preset("gray", 0, 1 if dtype.is_floating_point else 200)
    with gv.Engine(Loose(**options), **SIZE) as engine:
        picture = engine.render(camera(64), shader)
        nodes, pool = engine.cache.nodes, engine.cache.bricks
        held = nodes.brick_tn >= 0
        leaf = held & (nodes.child_tn == config.TERMINAL)
        slot = nodes.brick_tn[leaf].to(torch.int64)
        voxels = pool.bricks["value"].to(torch.float64).flatten(1, 3)[slot]
        ranges = nodes.ranges["value"].to(torch.float64)
        assert leaf.sum() > 20
        assert torch.equal(ranges[leaf], torch.stack((voxels.amin(1), voxels.amax(1)), 1))
        limits = torch.tensor(gv.Channel(dtype).limits, dtype=torch.float64)[:, None]
        assert (held & ~leaf).any() and (ranges[held & ~leaf] == limits).all()
        assert torch.equal(engine.render(camera(64), shader).color, picture.color)


class Clocked(Ball):
    """Takes 6 ms a call and 0.01 ms for each node, on a simulated clock."""

    def __init__(self):
        super().__init__(64)
        self.now, self.calls = 0.0, []

    def answered(self, nodes, answer):
        self.calls.append((type(answer), len(nodes)))
        self.now += 1e-3 * (6 + 0.01 * len(nodes))
        return answer

    def classify(self, nodes):
        return self.answered(nodes, super().classify(nodes))

    def fill(self, nodes):
        return self.answered(nodes, super().fill(nodes))


def test_a_time_budget_does_not_stick_at_one_node_a_frame(monkeypatch):
    """If the fixed cost of a call exceeds production's share of a frame, batches grow."""
    producer = Clocked()
    monkeypatch.setattr("gvtorch.engine.production.time.perf_counter", lambda: producer.now)
    sizes = {**SIZE, "brick_pool": "16 MB", "node_pool": "2 MB"}
    with gv.Engine(producer, time_budget=8.0, scout_rounds=0, **sizes) as engine:
        for number in range(200):
            _, stats = engine.frame(CORNER, GRAY)
            if number > 3 and not sum(stats.requests.values()):
                break
    bricks = [n for kind, n in producer.calls if kind is dict]
    assert stats.converged and sum(bricks) > 700
    assert sum(n == 1 for n in bricks) < 5 and max(bricks) > 90
    assert number < 20
