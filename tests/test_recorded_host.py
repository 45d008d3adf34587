"""Producers on the host answer requests of recorded frames while these go on."""

from __future__ import annotations

import gc
import math
import threading
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

import pytest
import torch
from helpers import DEVICES
from helpers.recorded import COMPILED, TRANSFER, Frames, view

import gvtorch as gv
from gvtorch.engine import asker, host_frame
from gvtorch.engine.upload_queue import UploadQueue
from gvtorch.io.stores.conversion import convert
from gvtorch.pool.staging import BrickTable


def on_the_host(blobs, tmp_path, kind: str) -> gv.Producer:
    """Returns a producer that answers from the host: at once, by rows of a table, or later."""
    if kind == "store":
        return gv.StoredProducer(convert(blobs, tmp_path))
    return gv.VolumeProducer(blobs, hold=kind)


class Later(gv.VolumeProducer):
    """Answers with bricks once the test says so."""

    late: list[tuple[Future, Any]] | None = (
        None  # answers, and what they are to hold; None: at once
    )

    def fill(self, nodes):
        if self.late is None:
            return super().fill(nodes)
        self.late.append((Future(), super().fill(nodes)))
        return self.late[-1][0]


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("kind", ["voxels", "bricks", "store"])
@pytest.mark.parametrize("batch, pool", [(5, "4 MB"), (200, "4 MB"), (64, "150 kB")])
def test_producers_on_the_host_answer_while_frames_go_on(
    blobs, tmp_path, kind, batch, pool, backend
):
    device = DEVICES[backend]
    camera = view(24 if pool == "4 MB" else 6)
    options = {"brick_size": 4, "brick_pool": pool, "device": device}
    with gv.Engine(on_the_host(blobs, tmp_path / "one", kind), **options) as engine:
        expected = engine.render(camera, TRANSFER)
        assert (expected.alpha > 0.5).any()
    with gv.Engine(on_the_host(blobs, tmp_path / "two", kind), **options) as engine:
        frames, bricks_made = Frames(engine, camera, TRANSFER, batch), 0
        for _ in range(600):
            hits, stats = frames.frame()
            bricks_made += stats.produced["bricks"]
            time.sleep(0.002 * (kind == "store"))
            if stats.converged:
                break
        assert stats.converged and bricks_made > 8
        engine.validate()
        assert frames.served.pending == 0
        picture, _ = engine.frame(camera, TRANSFER)  # the host continues from there
        assert torch.equal(picture.color, expected.color)
        frames.frame()  # its record of slots is stale
        engine.validate()
    assert torch.equal(hits.color, expected.color.reshape(-1, 3))
    assert torch.equal(hits.depth, expected.depth.reshape(-1, 1))


@pytest.mark.parametrize("backend", COMPILED)
def test_what_was_asked_before_a_frame_of_the_host_is_dropped_however_late(blobs, backend):
    class Slow(gv.VolumeProducer):
        gate = threading.Event()

        def fill(self, nodes):
            if threading.current_thread().name.startswith("gvtorch-ask"):
                self.gate.wait()
            return super().fill(nodes)

    with gv.Engine(Slow(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        Slow.gate.set()
        frames, asker = Frames(engine, view(24), TRANSFER, 64), engine._host_frames[0]
        while not frames.frame()[1].requests["load"]:
            asker._executor.submit(int).result()
        Slow.gate.clear()
        frames.frame()  # requests these, and is held up
        engine._release()
        for _ in range(2):
            frames.frame()  # requests them again
        Slow.gate.set()
        asker._executor.submit(int).result()  # both answers have arrived
        for _ in range(3):
            frames.frame()
            engine.validate()  # no node has two slots
        for _ in range(200):
            _, stats = frames.frame()
            asker._executor.submit(int).result()
            if stats.converged:
                break
        assert stats.converged and engine.render(view(24), TRANSFER).stats.produced["bricks"] == 0


@pytest.mark.parametrize("backend", COMPILED)
def test_an_answer_that_its_producer_cancels_has_failed(blobs, backend):
    class Fickle(gv.VolumeProducer):
        def fill(self, nodes):
            if (nodes.depth == 0).any() or not (nodes.loc[:, :3] > 2).all(1).any():
                return super().fill(nodes)
            future: Future = Future()
            threading.Timer(0.01, future.cancel).start()
            return future

    with gv.Engine(Fickle(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(24), TRANSFER, 64)
        _, stats = frames.whole(pause=0.01)
        assert stats.failed == len(engine.failures) > 0 and frames.served.pending == 0
        assert engine.failures[0].message == "CancelledError"
        assert all(min(failure.loc[:3]) > 2 for failure in engine.failures)


class Sudden(Future):
    """Gets its answer just after somebody looked whether it is there."""

    def __init__(self, answer: Any) -> None:
        super().__init__()
        self.answer = answer

    def done(self) -> bool:
        was_done = super().done()
        if not was_done:
            self.set_result(self.answer)
        return was_done


@pytest.mark.parametrize("backend", COMPILED)
def test_an_answer_that_arrives_before_it_is_waited_for_is_written_once(blobs, backend):
    """Its callback is called at once, in the thread that asked."""

    class Quick(gv.VolumeProducer):
        def fill(self, nodes):
            bricks = super().fill(nodes)
            return bricks if (nodes.depth == 0).any() else Sudden(bricks)

    with gv.Engine(Quick(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        expected = engine.render(view(24), TRANSFER)
        assert expected.stats.produced["bricks"] > 8
    with gv.Engine(Quick(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(24), TRANSFER, 64)
        hits, _ = frames.whole(pause=0.01)
        engine.validate()
        assert frames.served.pending == 0 and not frames.served._waiting
    assert torch.equal(hits.color, expected.color.reshape(-1, 3))


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("how", ["failures forgotten", "frame broken off"])
def test_answers_on_their_way_are_not_written_twice(blobs, backend, how):
    """Nodes that are no longer marked as pending are asked for again."""
    producer = Later(blobs)
    with gv.Engine(producer, brick_size=4, device=DEVICES[backend]) as engine:
        frames, asker = Frames(engine, view(24), TRANSFER, 64), engine._host_frames[0]._executor
        producer.late = []
        while not producer.late:
            frames.frame()
            asker.submit(int).result()
        asked = len(producer.late)
        if how == "failures forgotten":
            engine.forget_failures()
        else:
            with pytest.raises(KeyError), engine.new_frame(frames._view.options):
                raise KeyError
        while len(producer.late) == asked:
            frames.frame()
            asker.submit(int).result()
        producer.late, late = None, producer.late
        for future, bricks in late:
            future.set_result(bricks)
        frames.whole(pause=0.01)
        engine.validate()


@pytest.mark.parametrize("backend", COMPILED)
def test_a_graph_that_is_dropped_gives_its_buffers_and_its_nodes_back(blobs, backend):
    producer = Later(blobs)
    with gv.Engine(producer, brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(24), TRANSFER, 64)
        frames.served.graph = weakref.ref(frames)
        buffers = weakref.ref(frames.served._uploads[0])
        producer.late = []
        while not producer.late:
            frames.frame()
        producer.late, late = None, producer.late
        del frames
        gc.collect()
        assert engine.render(view(24), TRANSFER).stats.produced["bricks"] > 0
        assert not engine._host_frames
        for future, bricks in late:
            future.set_result(bricks)
        late.clear()
        del future
        gc.collect()
        assert buffers() is None
        engine.validate()


@pytest.mark.parametrize("backend", COMPILED)
def test_a_closed_engine_asks_for_nothing_more(blobs, backend):
    class Slow(gv.VolumeProducer):
        asked, gate, calls = threading.Event(), threading.Event(), 0

        def fill(self, nodes):
            if threading.current_thread().name.startswith("gvtorch-ask"):
                self.calls += 1
                self.asked.set()
                self.gate.wait()
                raise RuntimeError("its files are closed")
            return super().fill(nodes)

    producer = Slow(blobs)
    with gv.Engine(producer, brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(24), TRANSFER, 64)
        while not Slow.asked.is_set():
            frames.frame()
            time.sleep(0.01)
        asker = engine._host_frames[0]._executor
    Slow.gate.set()
    asker.shutdown()  # waits for its thread
    assert producer.calls == 1


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("slow", [False, True])
def test_a_busy_producer_is_asked_for_several_frames_at_once(blobs, backend, slow, monkeypatch):
    monkeypatch.setattr(host_frame, "_CALL_GAP", 0.0 if slow else math.inf)
    with gv.Engine(Later(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        engine.render(view(24), TRANSFER)
        late = engine.trees["scene"].producer.late = []
        frames, listed = Frames(engine, view(24), TRANSFER, 3), 0
        for angle in (90, 180, 270):
            frames.look_from(view(24, angle))
            for _ in range(6):
                listed += frames.frame()[1].requests["load"] > 0
                frames.served._executor.submit(int).result()  # until its requests are passed on
        assert listed > 3
        if slow:  # it does not wait for answers
            assert len(late) > 3
        else:
            assert len(late) == 1
            late[0][0].set_result(late[0][1])
            frames.served._executor.submit(int).result()
            assert len(late) == 2
            assert len(late[1][1].data["value"]) > 2 * 3, "of more than two frames"
        for _ in range(3):
            frames.frame()
        engine.validate()


@pytest.mark.backend("cpp")
def test_a_batch_whose_frames_were_dropped_while_it_was_asked_for_is_not_waited_for(blobs):
    class Ended(Later):
        def fill(self, nodes):
            answer = super().fill(nodes)
            if self.late:
                frames.served.release()
            return answer

    with gv.Engine(Ended(blobs), brick_size=4) as engine:
        engine.frame(view(24), TRANSFER)
        frames = Frames(engine, view(24), TRANSFER, 3)
        late = engine.trees["scene"].producer.late = []
        while not late:
            frames.frame()
            frames.served._executor.submit(int).result()  # until its requests are passed on
        assert not frames.served._waiting, "its kind would count as busy"


class Guarded(list[Any]):
    """Lists its methods that are called while nobody holds a lock."""

    def __init__(self, lock: threading.Lock) -> None:
        super().__init__()
        self.lock, self.unlocked = lock, []

    def __getattribute__(self, name: str) -> Any:
        if name in ("append", "remove", "clear") and not self.lock.locked():
            self.unlocked.append(name)
        return super().__getattribute__(name)

    def __iter__(self) -> Iterator[Any]:
        if not self.lock.locked():
            self.unlocked.append("iter")
        return super().__iter__()


@pytest.mark.parametrize("backend", COMPILED)
def test_answers_on_their_way_are_listed_under_a_lock(blobs, backend):
    """Frames read and change the list, and so do the threads in which answers arrive."""

    class Impatient(Later):
        patience = 0.2

    with gv.Engine(Impatient(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        engine.frame(view(24), TRANSFER)
        frames = Frames(engine, view(24), TRANSFER, 3)
        late = engine.trees["scene"].producer.late = []
        waiting = frames.served._waiting = Guarded(frames.served._lock)
        while not (late and waiting):
            frames.frame()
        late[0][0].set_result(late[0][1])
        while not any("no answer within" in failure.message for failure in engine.failures):
            frames.frame()
        engine._release()
        assert not waiting and not waiting.unlocked


@pytest.mark.parametrize("backend", COMPILED)
def test_what_fails_on_the_host_is_named_and_not_asked_for_again(blobs, backend):
    class Spoiled(gv.VolumeProducer):
        def fill(self, nodes):
            bricks = super().fill(nodes)
            errors = {n: "spoiled" for n, d in enumerate(nodes.depth.tolist()) if d == 3}
            return gv.Bricks(data=bricks.data, errors=errors)

    with gv.Engine(Spoiled(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(24), TRANSFER, 64)
        hits, stats = frames.whole()
        assert stats.failed == len(engine.failures) > 4
        assert all(f.message == "spoiled" and f.loc[3] == 3 for f in engine.failures)
        engine.validate()
    assert bool(torch.isfinite(hits.color).all())


@pytest.mark.parametrize("backend", COMPILED)
def test_what_raises_costs_itself_alone_and_what_never_comes_is_given_up(blobs, backend):
    class Unruly(gv.VolumeProducer):
        patience = 0.2

        def fill(self, nodes):
            if bool((nodes.loc[:, 0] == 1).any()):
                raise OSError("no such column")
            if bool((nodes.loc[:, 0] == 2).all()):
                return Future()  # never done
            return super().fill(nodes)

    with gv.Engine(Unruly(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(16), TRANSFER, 64)
        hits, _ = frames.whole(400, 0.002)
        messages = {failure.message for failure in engine.failures}
        assert "OSError: no such column" in messages
        assert messages <= {"OSError: no such column", "no answer within 0.2 s"}
        raised = [failure for failure in engine.failures if failure.message.startswith("OSError")]
        assert all(failure.loc[0] == 1 for failure in raised)
        engine.validate()
    assert bool(torch.isfinite(hits.color).all())


@pytest.mark.parametrize("backend", COMPILED)
def test_several_batches_may_wait_for_one_future(blobs, backend, monkeypatch):
    never: Future = Future()

    class Shared(gv.VolumeProducer):
        patience, calls = 0.3, 0

        def fill(self, nodes):
            if (nodes.depth == 0).any():
                return super().fill(nodes)
            self.calls += 1
            return never

    monkeypatch.setattr(host_frame, "_CALL_GAP", 0.0)
    producer = Shared(blobs)
    with gv.Engine(producer, brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(24), TRANSFER, 3)
        while not never.done():
            frames.frame()
            frames.served._executor.submit(int).result()  # until its requests are passed on
        assert producer.calls > 1
        frames.whole(pause=0.01)
        assert frames.served.pending == 0


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("later", [False, True])
def test_a_producer_on_the_host_that_always_raises_is_not_asked_for_ever(
    blobs, later, backend, monkeypatch
):
    calls = []

    class Never(gv.VolumeProducer):
        def fill(self, nodes):
            if (nodes.depth == 0).any():
                return super().fill(nodes)
            calls.append(len(nodes))
            answer: Future = Future()
            answer.set_exception(RuntimeError("out of order"))
            return answer if later else answer.result()

    monkeypatch.setattr(asker, "_MAX_RAISING_CALLS", 8)
    with gv.Engine(Never(blobs), brick_size=4, device=DEVICES[backend]) as engine:
        frames = Frames(engine, view(48), TRANSFER, 64)
        while not calls:
            frames.frame()
            frames.served._executor.submit(int).result()  # until its requests are passed on
        assert calls[0] > 16
        assert 8 < len(calls) <= 8 + 7, "each half that was left is asked for once"
        frames.whole()
        engine.validate()
        locs = [failure.loc for failure in engine.failures]
        assert len(locs) == len(set(locs)) >= calls[0], "each is named once"


def test_a_batch_larger_than_memory_is_refused_before_it_is_allocated(monkeypatch):
    form = {"bricks": {"data": ((10, 10, 10, 1), torch.float32)}}
    monkeypatch.setattr("os.sysconf", lambda _: 1000)
    with pytest.raises(ValueError, match="a batch of 512 takes"):
        UploadQueue(form, 512, torch.device("cpu"))


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32])
def test_rows_of_answers_arrive_in_order_although_few_fit_at_once(backend, dtype):
    """Rows of a table are gathered, and a producer may use its own memory again."""
    table = BrickTable(torch.arange(20 * 27).view(20, 3, 3, 3, 1).to(dtype))
    form = {"bricks": {"data": ((3, 3, 3, 1), dtype)}, "tiles": {"child": ((8,), torch.int32)}}
    queue = UploadQueue(form, 5, torch.device(DEVICES[backend]))
    row = torch.tensor([7, 7, 0, 19, 3, 11, 2, 5, 13, 1, 4])
    child = torch.arange(24, dtype=torch.int32).view(3, 8)
    queue.add("bricks", {"node": row + 100, "data": table[row]}, lambda: True)
    own = {"node": row[:3] + 200, "data": table.bricks[:3].clone()}
    queue.add("bricks", own, lambda: True)
    for values in own.values():
        values.zero_()
    queue.add("tiles", {"node": row[:3], "child": child}, lambda: True)
    node, data, tiles = [], [], []
    while len(node) < 14 or not tiles:
        if queue.send():
            bricks, children = queue.device_tables["bricks"], queue.device_tables["tiles"]
            count = int((bricks["node"] >= 0).sum())
            node += bricks["node"][:count].tolist()
            data.append(bricks["data"][:count].cpu().int())
            tiles += children["child"][children["node"] >= 0].tolist()
            queue.clear()
    assert node == [*(row + 100).tolist(), *(row[:3] + 200).tolist()] and queue.sent == 17
    bricks = table.bricks.int()
    assert torch.equal(torch.cat(data), torch.cat((bricks[row], bricks[:3])))
    assert tiles == child.tolist() and not queue.send()


@pytest.mark.parametrize("answers", [[False], [True, False]])
def test_rows_that_are_dropped_while_they_are_copied_are_not_sent(answers):
    queue = UploadQueue({"bricks": {}}, 2, torch.device("cpu"))
    wanted = iter(answers)
    queue.add("bricks", {"node": torch.arange(5)}, lambda: next(wanted))
    queue.forget()  # before the second answer, as far as the queue can tell
    assert not queue.send() and next(wanted, None) is None


def test_an_engine_that_is_closed_cancels_the_answers_on_their_way(blobs):
    producer = Later(blobs)
    with gv.Engine(producer, brick_size=4) as engine:
        frames = Frames(engine, view(24), TRANSFER, 64)
        producer.late = late = []
        while not late:
            frames.frame()
            time.sleep(0.01)
        engine._host_frames[0]._executor.submit(int).result()
    assert all(future.cancelled() for future, _ in late)
