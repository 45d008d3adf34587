"""Several threads on one engine, one tree, one store: what is allowed concurrently gives the
pictures of one thread; what is not raises at once.
"""

from __future__ import annotations

import copy
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import ROOT
from helpers.pictures import GRAY, assert_same_picture, camera
from helpers.producers import Ball, Late
from helpers.recorded import Frames

import gvtorch as gv
from gvtorch.cache import KINDS
from gvtorch.engine.production import Failures

POOLS = {"brick_size": 4, "brick_pool": 150 * 6**3 * 4, "node_pool": 60 * 8 * 20}
VIEWS = [
    gv.Camera.orbit(azimuth, 20, distance, None, 16, 12)
    for azimuth, distance in ((0, 0.6), (90, 1.0), (180, 0.5), (270, 1.4))
]


@pytest.fixture(autouse=True)
def often() -> Iterator[None]:
    """Makes Python switch threads as often as possible."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def at_once(work: Callable[[int], object], count: int = 4) -> None:
    """Runs `work` of 0, 1, ... in threads that start together; raises what one of them raised."""
    begin = threading.Barrier(count)

    def run_one(number: int) -> None:
        begin.wait()
        work(number)

    with ThreadPoolExecutor(count) as threads:
        for future in [threads.submit(run_one, number) for number in range(count)]:
            future.result(timeout=120)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("producer", [gv.VolumeProducer, Late])
def test_threads_that_share_an_engine_render_what_each_asks_for(blobs, producer):
    tree = gv.N3Tree.from_volume(blobs, 4)
    whole = [gv.render(tree, view, GRAY) for view in VIEWS]
    with gv.Engine(producer(blobs), **POOLS) as engine:

        def render_view(number: int) -> None:
            for turn in range(6):
                if turn % 3 == 2:
                    engine.frame(VIEWS[number], GRAY)
                    engine.report()
                else:
                    assert_same_picture(engine.render(VIEWS[number], GRAY), whole[number])
                engine.validate()

        at_once(render_view)
        engine.validate()
        assert engine.frames > 24


@pytest.mark.backend("cpp")
def test_captured_frames_answer_while_another_thread_renders(blobs):
    """Answers come from other threads; no lock that a frame holds blocks them."""
    with gv.Engine(Late(blobs), **POOLS) as engine:
        engine.trees["scene"].producer.on_host = True
        frames = Frames(engine, VIEWS[0], GRAY, 64)

        def render_view(number: int) -> None:
            for _ in range(15):
                if number:
                    engine.frame(VIEWS[number], GRAY)
                else:
                    frames.frame()

        at_once(render_view, 2)
        assert engine.frames >= 30
        engine.validate()


@pytest.mark.backend("cpp")
def test_an_engine_closed_by_another_thread_says_so(blobs):
    engine = gv.Engine(gv.VolumeProducer(blobs), **POOLS)
    begun = threading.Event()

    def render_view() -> None:
        while True:
            engine.render(VIEWS[0], GRAY)
            begun.set()

    with ThreadPoolExecutor(1) as threads:
        future = threads.submit(render_view)
        assert begun.wait(60)
        engine.close()
        with pytest.raises(ValueError, match="Engine: it is closed"):
            future.result(timeout=60)


@pytest.mark.backend("cpp")
def test_failures_are_forgotten_while_a_captured_frame_reports_others():
    loc = torch.arange(40_000).view(-1, 4)
    targets = SimpleNamespace(loc=loc)
    source = SimpleNamespace(name="a")
    batch: Any = SimpleNamespace(source=source, kind=KINDS["load"], targets=targets)
    failures = Failures(strict=False)
    failures.add(batch, "slow", None)
    with ThreadPoolExecutor(1) as thread:
        targets.loc = loc + 40_000
        adding = thread.submit(failures.add, batch, "slow", None)
        while not adding.done():
            failures.forget("another")
        adding.result()
    assert len(failures) == 20_000


def test_a_frame_within_a_frame_is_refused():
    class Curious(Ball):
        engine: gv.Engine | None = None

        def fill(self, nodes):
            if self.engine is not None:
                self.engine.frame(VIEWS[0], GRAY)
            return super().fill(nodes)

    producer = Curious()
    with gv.Engine(producer, **POOLS) as engine:
        object.__setattr__(producer, "engine", engine)
        engine.frame(VIEWS[0], GRAY)
        engine.frame(VIEWS[0], GRAY)
        assert "within a frame" in engine.failures[0].message
        object.__setattr__(producer, "engine", None)
        engine.forget_failures()
        engine.render(VIEWS[0], GRAY)
        engine.validate()


@pytest.mark.backend("cpp")
def test_statistics_read_by_several_threads_are_completed_once(blobs):
    with gv.Engine(gv.VolumeProducer(blobs), **POOLS) as engine:
        _, alone = engine.frame(VIEWS[0], GRAY)
        expected = alone.settle().requests
    for _ in range(20):
        with gv.Engine(gv.VolumeProducer(blobs), **POOLS) as engine:
            _, stats = engine.frame(VIEWS[0], GRAY)
            seen: list[dict[str, int]] = []
            at_once(lambda _number: seen.append(dict(stats.requests)))  # noqa: B023
            assert seen == [expected] * 4


@pytest.mark.backend("cpp")
def test_threads_render_one_tree(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    whole = [gv.render(tree, view, GRAY) for view in VIEWS]

    def render_view(number: int) -> None:
        for _ in range(10):
            assert_same_picture(gv.render(tree, VIEWS[number], GRAY), whole[number])

    before = tree.frame
    at_once(render_view)
    assert tree.frame == before + 40, "each picture has a number of its own"
    tree.validate()


@pytest.mark.backend("cpp")
def test_a_tree_that_is_rendered_is_not_refreshed_by_another_thread(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    inside, go_on = threading.Event(), threading.Event()

    def wait(*_told: object) -> None:
        inside.set()
        go_on.wait(60)

    with ThreadPoolExecutor(1) as threads:
        future = threads.submit(gv.render, tree, VIEWS[0], GRAY, progress=wait)
        assert inside.wait(60)
        with pytest.raises(RuntimeError, match=r"N3Tree\.refresh: another thread renders"):
            tree.refresh()
        gv.render(tree, VIEWS[1], GRAY)
        go_on.set()
        future.result(timeout=60)
    tree.refresh()
    with tree.turns.changing("refresh"), ThreadPoolExecutor(1) as threads:
        with pytest.raises(RuntimeError, match="render: another thread changes"):
            threads.submit(gv.render, tree, VIEWS[0], GRAY).result(timeout=60)
        gv.render(tree, VIEWS[0], GRAY)


def test_trees_are_still_copied_and_pickled(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    for other in (copy.deepcopy(tree), pickle.loads(pickle.dumps(tree))):
        assert torch.equal(other.nodes.child_tn, tree.nodes.child_tn)
        other.refresh()
        assert_same_picture(gv.render(other, camera(16), GRAY), gv.render(tree, camera(16), GRAY))


def test_what_threads_may_do_with_an_object_is_told_where_it_is_described():
    """In the class's docstring and in the table of docs/robustness.md, one row per object."""
    table = (ROOT / "docs" / "robustness.md").read_text(encoding="utf-8").split("## Processes")[0]
    for kind in (gv.Engine, gv.N3Tree, gv.Store, gv.TreeTracer, gv.Camera, gv.Volume, gv.Producer,
                 gv.Progressive, gv.Video):  # fmt: skip
        assert "thread" in str(kind.__doc__).lower() and f"`{kind.__name__}`" in table, kind
    for kind in (gv.Shader, gv.RenderOptions, gv.NodePool, gv.BrickPool):
        assert "thread" in str(kind.__doc__).lower(), kind
