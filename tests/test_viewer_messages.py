"""Wrong messages of a page by the thousand, each answered with one line; and scenes that fail while
they are viewed: a store that goes away, a server that stops in the middle of a chunk, and code that
raises.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
import types
from collections import Counter
from functools import partial
from inspect import Parameter
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
import pytest
import torch
from helpers.pictures import GRAY
from helpers.servers import WebServer
from helpers.stores import Handler, noise
from helpers.viewer import TIMEOUT, Page, turned_camera

import gvtorch as gv
from gvtorch.io.stores.conversion import convert
from gvtorch.viewer import schema
from gvtorch.viewer.protocol import MESSAGES
from gvtorch.viewer.session import Session
from gvtorch.viewer.view import new_session

pytestmark = pytest.mark.backend("cpp")
COUNT = 100_000 if os.environ.get("GVTORCH_FUZZ") else 20_000  # messages; `make fuzz` sends more
#: One valid message of each kind.
GOOD: dict[str, dict[str, Any]] = {
    "hello": {"width": 640, "height": 480, "rate": 30},
    "move": {"camera": {"eye": [0, 0, 9], "target": [0, 0, 0]}, "moving": True, "sent": 1.5},
    "ack": {"number": 3},
    "change": {"state": {"options": {"step": 0.5}}, "rest": True},
    "pick": {"x": 0.5, "y": 0.5, "purpose": "focus"},
    "histogram": {"in_view": True},
    "find": {"text": "17"},
    "preset": {"name": "gray", "low": 0, "high": 1},
    "read": {"file": "a.json", "text": "{}", "name": None, "low": 0, "high": 1},
    "export": {"name": "mine"},
    "nodes": {"on": True},
    "resize": {"engine": {"brick_pool": "256 MB"}},
    "set": {"name": "radius", "value": 4.5},
    "follow": {"client": 1},
    "monitor": {"on": True},
    "still": {"width": 64, "height": 48},
    "surface": {"value": 0.5, "format": "ply", "level": 0},
    "do": {"what": "fit"},
}
#: Values that each type never has.
NEVER: dict[Any, tuple[Any, ...]] = {
    int: ("7", 1.5, True, None, [], {}, [3], 10**400, "", 1e300),
    float: ("7", True, [], {}, [0.5], 10**400, "nan"),
    str: (7, 1.5, True, [], {}, ["a"]),
    bool: (0, 1, "true", [], {}, 2.5),
    dict: (7, "a", True, [], [1, 2], None, 1.5),
}


def wrong_value(rng: np.random.Generator, hint: Any) -> Any:
    """Returns a value that the type hint of a message's field does not allow."""
    parts = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    kinds = {get_origin(v) or v for v in parts}
    if kinds & {Literal}:
        return [7, "nothing", None, [], {}][rng.integers(5)]
    kind = next((v for v in (int, float, str, bool, dict) if v in kinds), dict)
    candidates = [v for v in NEVER[kind] if not (v is None and type(None) in kinds)]
    return candidates[rng.integers(len(candidates))]


def damaged_state(rng: np.random.Generator, state: dict[str, Any]) -> dict[str, Any]:
    """Returns a state with a wrong number, name or shape somewhere."""
    content = json.loads(state["text"])
    part, path = content, []
    while isinstance(part, dict) and part:
        key = [*part][rng.integers(len(part))]
        path.append((part, key))
        part = part[key]
        if rng.random() < 0.3:
            break
    parent, key = path[-1]
    choice = rng.integers(3)
    if choice == 0:
        parent[f"no {key}"] = parent.pop(key)
    elif choice == 1:
        parent[key] = {"kind": "Engine", "deep": [[[]]]}
    else:
        parent[key] = [[[1, "two"], {}], 10**400]
    return content


def wrong_message(rng: np.random.Generator, state: dict[str, Any]) -> str | bytes:
    """Returns a message that no page sends."""
    kind = [*GOOD][rng.integers(len(GOOD))]
    fields = dict(GOOD[kind])
    hints = schema.arguments(MESSAGES[kind])
    choice = rng.integers(7)
    if choice == 0:
        fields[["no", "kind2", "__class__", ""][rng.integers(4)]] = 1
    elif choice == 1:
        needed = [name for name, (_, default) in hints.items() if default is Parameter.empty]
        if not needed:
            return json.dumps([kind, fields])
        del fields[needed[rng.integers(len(needed))]]
    elif choice == 2:
        return rng.integers(0, 256, rng.integers(1, 60), np.uint8).tobytes()
    elif choice == 3:
        text = json.dumps({"type": kind, **fields})
        return text[: rng.integers(1, len(text) - 1)]
    elif choice == 4:
        return json.dumps({"type": "change", "state": damaged_state(rng, state)})
    elif choice == 5:
        return json.dumps({"type": [kind, None, 7, "no", {}][rng.integers(1, 5)], **fields})
    else:
        names = [name for name, (hint, _) in hints.items() if hint is not Any]
        name = names[rng.integers(len(names))]
        fields[name] = wrong_value(rng, hints[name][0])
    return json.dumps({"type": kind, **fields})


def test_there_is_a_right_one_of_each_message():
    assert set(GOOD) == set(MESSAGES)
    for kind, fields in GOOD.items():
        assert schema.decode(kind, MESSAGES[kind], fields) is not None
        assert set(fields) == set(schema.arguments(MESSAGES[kind]))
    taken = {name.removeprefix("_take_") for name in vars(Session) if name.startswith("_take_")}
    assert taken == {*MESSAGES} - {"ack"}, "what a page may ask for, something takes"


def test_wrong_messages_are_each_refused_with_a_line_and_the_view_goes_on(session):
    page = Page(session)
    _, before = page.final()
    whole = page.of_type("welcome")[0]["state"]
    state = {"text": json.dumps({name: v for name, v in whole.items() if name != "camera"})}
    rng, counts = np.random.default_rng(17), Counter[str]()
    kinds, lines = Counter[str](), list[str]()

    def take(data: str | bytes) -> None:
        if isinstance(data, str):
            content = json.loads(data)
            counts[content["type"]] += 1
            if content["type"] == "refused":
                lines.append(content["text"])

    rude = session.join(take)
    session.ask(lambda: None)
    for number in range(COUNT):
        message = wrong_message(rng, state)
        kinds[type(message).__name__] += 1
        session.receive(rude, message)
        if number % 2000 == 0:
            session.ask(lambda: None)  # so that not all are queued at once
    session.ask(lambda: None, 600)
    assert counts["refused"] == COUNT == len(lines) and min(kinds.values()) > COUNT / 20
    assert all(line and "\n" not in line and len(line) < 4000 for line in lines)
    assert len({line[:40] for line in lines}) > 100, "of many kinds"
    assert not counts["error"] and not page.of_type("error") and not page.of_type("refused")
    assert session.state.to_json() == {**whole, "camera": session.state.to_json()["camera"]}
    page.moved(turned_camera(page.camera, 0.4))
    _, after = page.moved(page.camera)
    assert np.abs(after.astype(int) - before).max() <= 2


# Scenes that fail.


def goes_on(page: Page, session: Session, angle: float = 0.3) -> None:
    """Asserts that pictures arrive, also of another camera, and that questions are answered."""
    _, seen = page.moved(turned_camera(page.camera, angle))
    assert seen.max() > 0
    page.send("histogram", in_view=True)
    page.until(lambda: page.of_type("histogram"))
    assert session._thread.is_alive()


@pytest.fixture
def stored(tmp_path):
    """A store with finer levels than its first picture needs."""
    np.save(tmp_path / "a.npy", noise((96, 96, 96, 1))[..., 0])
    convert(tmp_path / "a.npy", tmp_path / "a.zarr")
    return tmp_path / "a.zarr"


def near(page: Page, session: Session) -> dict[str, Any]:
    """Returns a camera that sees finest voxels."""
    box = session.scene.box
    centre = box.mean(0)
    eye = centre + 0.6 * (box[1] - centre)
    return {**page.camera, "eye": eye.tolist(), "target": centre.tolist(), "fov": 20.0}


def test_a_store_that_is_deleted_is_told_and_the_picture_goes_on(stored):
    session = new_session(str(stored), GRAY)
    try:
        page = Page(session, 48, 32)
        page.final()
        shutil.rmtree(stored)
        page.send("move", camera=near(page, session), moving=False)
        failure = page.next("failed", 0)
        assert failure["count"] > 0 and failure["text"] and "\n" not in failure["text"]
        page.final()
        goes_on(page, session)
        page.send("change", state={"slices": {}})  # planes can't be read either
        page.until(lambda: any("a slice can't be read" in e["text"] for e in page.of_type("error")))
        page.until(lambda: page.pictures[-1][0]["layout"] and page.pictures[-1][0]["final"])
    finally:
        session.close()


class Stalling(Handler):
    """Sends half of each chunk, then nothing more, while `stalls` is true."""

    stalls = False
    over = threading.Event()

    def copyfile(self, source: Any, outputfile: Any) -> None:
        content = source.read()
        outputfile.write(content[: len(content) // 2] if self.stalled else content)
        if self.stalled:
            outputfile.flush()
            Stalling.over.wait(TIMEOUT)

    @property
    def stalled(self) -> bool:
        return Stalling.stalls and "/c/" in self.path

    def do_GET(self) -> None:
        if self.stalled and "Range" in self.headers:
            first, _, last = self.headers["Range"].removeprefix("bytes=").partition("-")
            count = int(last) - int(first) + 1 if first and last else int(last or 1 << 10)
            self.send_response(206)
            self.send_header("Content-Length", str(count))
            self.end_headers()
            self.wfile.write(b"\0" * (count // 2))
            self.wfile.flush()
            Stalling.over.wait(TIMEOUT)
            return
        super().do_GET()


@pytest.mark.parametrize("refused", [False, True])
def test_a_server_that_stops_in_a_chunk_is_told_and_asked_again(stored, monkeypatch, refused):
    """While a chunk is waited for, or after reading it was suspended for half a minute."""
    monkeypatch.setattr(
        "gvtorch.io.http.REFUSED_SECONDS", 1e6
    )  # so it would never be retried automatically
    monkeypatch.setattr(Stalling, "over", threading.Event())
    server = WebServer(("127.0.0.1", 0), partial(Stalling, directory=str(stored.parent)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/a.zarr"
    producer = gv.StoredProducer(url, timeout=5.0 if refused else 1.2)
    session = new_session(producer, GRAY)
    try:
        page = Page(session, 48, 32)
        page.final()
        monkeypatch.setattr("gvtorch.io.http.STALL_SECONDS", 0.2 if refused else 1e6)
        Stalling.stalls = True
        there = near(page, session)
        page.send("move", camera=there, moving=False)
        page.until(lambda: np.allclose(page.pictures[-1][0]["camera"]["eye"], there["eye"]))
        failure = page.next("failed", 0)
        assert failure["count"] > 0 and "\n" not in failure["text"]
        _, seen = page.final()
        assert seen.max() > 0
        goes_on(page, session)
        monkeypatch.setattr("gvtorch.io.http.STALL_SECONDS", 20.0)
        Stalling.stalls = False  # requests that wait for it get nothing more
        page.send("do", what="retry")
        page.send("move", camera=there, moving=False)
        (client,) = session.clients.values()
        whole = session.ask(lambda: session.still(client.eye, 48, 32))
        assert whole.stats.converged and whole.stats.failed == 0
        assert not session.ask(session.scene.failures)
    finally:
        Stalling.stalls = False
        Stalling.over.set()
        session.close()
        server.shutdown()
        server.server_close()


class Raising(gv.Producer):
    """Code with a bug."""

    def __init__(self) -> None:
        super().__init__(64)
        self.wrong = False

    def fill(self, nodes):
        if self.wrong:
            raise ZeroDivisionError("division by zero\nin line 3")
        return {"value": torch.ones(*nodes.positions.shape[:-1], 1)}


def test_code_that_raises_is_told_and_the_picture_goes_on():
    producer = Raising()
    session = new_session(producer, gv.TransferFunction([(0, 0.2), (1, 0.2)]))
    try:
        page = Page(session, 48, 32)
        page.final()
        producer.wrong = True
        producer.changed()
        page.send("move", camera=near(page, session), moving=False)
        page.until(lambda: page.of_type("failed") or page.of_type("error"))
        failure = (page.of_type("failed") or page.of_type("error"))[0]["text"]
        assert "division by zero" in failure and "\n" not in failure
        producer.wrong = False
        page.send("do", what="retry")
        page.moved(turned_camera(page.camera, 0.2))
        goes_on(page, session)
    finally:
        session.close()


def test_a_question_that_raises_what_nobody_thought_of_is_told(session, monkeypatch):
    def broken(*_given: Any) -> None:
        raise KeyError("a mistake of ours")

    page = Page(session)
    page.final()
    monkeypatch.setattr(session.scene, "histogram", broken)
    page.send("histogram")
    assert "a mistake of ours" in page.next("error", 0)["text"]
    monkeypatch.undo()
    goes_on(page, session)
