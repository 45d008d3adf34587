"""Sessions and their pages, and the server, without a browser."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import threading
import weakref
from dataclasses import dataclass, field

import aiohttp
import numpy as np
import pytest
import torch
from helpers import ROOT, gvtorch
from helpers.pictures import GRAY
from helpers.viewer import SOON, Page, bright_ball, pixels, split
from yarl import URL

import gvtorch as gv
from gvtorch.viewer.client import jpeg
from gvtorch.viewer.server import Server, page_files
from gvtorch.viewer.view import new_session

pytestmark = pytest.mark.backend("cpp")
FUNCTION = gv.TransferFunction([(20, 0), (200, 0.6)], [(0, 1, 0.4, 0.1), (255, 1, 1, 1)])


@pytest.fixture
def session():
    made = new_session(bright_ball(), FUNCTION, engine={"time_budget": None})
    yield made
    made.close()
    assert not made._thread.is_alive()


@pytest.fixture
def server(session):
    made = Server(session)
    yield made
    made.close()
    assert not made._thread.is_alive()


def turned(camera: dict, angle: float) -> dict:
    """The camera turned around its target and +y."""
    away = np.subtract(camera["eye"], camera["target"])
    c, s = np.cos(angle), np.sin(angle)
    away = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ away
    return {**camera, "eye": (away + camera["target"]).tolist()}


def test_a_page_gets_the_picture_that_python_makes(session):
    """Coarse at once, then all samples: what `gv.Progressive` makes of a resident tree, but for
    what JPEG takes."""
    page = Page(session, 96, 64)
    head, seen = page.final()
    first, data = page.pictures[0]
    assert first["number"] == 1 and pixels(data).shape[0] <= 64
    assert head["samples"] == session.state.develop.samples == 16
    tree = gv.N3Tree.from_volume(bright_ball())
    camera = session.state.camera.camera(96, 64, tree.box)
    made = gv.Progressive(lambda one: gv.render(tree, one, FUNCTION)).refine(camera, 16)
    expected = made.to_srgb8().numpy()
    assert seen.shape == expected.shape == (64, 96, 3) and expected.std() > 10
    assert np.array_equal(seen, pixels(jpeg(made, 94))), "to the last bit, before JPEG"
    assert np.abs(seen.astype(int) - expected).mean() < 1


def test_pictures_stop_when_nothing_changes_and_go_on_when_something_does(session):
    page = Page(session)
    page.final()
    count = len(page.pictures)
    assert session.ask(lambda: [one.wants() for one in session.clients.values()]) == [False]
    _, before = page.final()
    _, after = page.moved(turned(page.camera, 1.0))
    assert len(page.pictures) > count and np.abs(before.astype(int) - after).max() > 60
    page.send("change", state={"options": {"background": [0.0, 0.5, 0.0]}})
    page.until(
        lambda: page.pictures[-1][0]["final"] and pixels(page.pictures[-1][1])[0, 0, 1] > 150
    )
    state = page.of("state")[-1]["state"]
    assert state["options"]["background"] == [0.0, 0.5, 0.0] and state["options"]["step"] == 0.5
    whole = {name: one for name, one in page.of("welcome")[0]["state"].items() if name != "camera"}
    page.send("change", state=whole)  # as undo does
    page.until(lambda: page.of("state")[-1]["state"]["options"]["background"] == [0.0, 0.0, 0.0])
    assert not page.of("refused")


def test_at_most_one_picture_is_on_its_way(session):
    """A page that does not answer gets no second picture, and holds up nobody else."""
    slow, page = Page(session, acks=False), Page(session)
    slow.until(lambda: slow.pictures)
    camera = page.camera
    for step in range(20):
        camera = turned(camera, 0.2)
        for one in (slow, page):
            one.send("move", camera=camera, moving=step < 19)
    page.until(lambda: page.pictures and page.pictures[-1][0]["camera"]["eye"] == camera["eye"])
    page.final()
    assert len(slow.pictures) == 1
    slow.acks = True
    slow.send("ack", number=slow.pictures[0][0]["number"])
    head, _ = slow.moved(camera)
    assert head["camera"]["eye"] == camera["eye"]


def test_two_pages_have_cameras_of_their_own_and_may_follow(session):
    one, other = Page(session), Page(session)
    _, still = other.final()
    there = turned(one.camera, 0.7)
    _, moved = one.moved(there)
    assert np.array_equal(other.final()[1], still) and not np.array_equal(moved, still)
    other.send("follow", client=one.client.number)
    other.until(lambda: other.of("camera"))
    further = turned(there, 0.7)
    _, seen = one.moved(further)
    other.until(lambda: np.allclose(other.pictures[-1][0]["camera"]["eye"], further["eye"]))
    assert np.array_equal(other.final()[1], seen)
    assert other.of("clients")[-1]["clients"] == {"1": None, "2": 1}
    session.leave(one.client)
    other.until(lambda: other.of("clients")[-1]["clients"] == {"2": None})
    other.moved(there)
    other.send("follow", client=7)
    assert "there is no client 7" in other.next("refused", 0)["text"]


def test_a_change_is_seen_by_all_and_a_wrong_one_by_nobody(session):
    one, other = Page(session), Page(session)
    _, before = other.final()
    function = {"kind": "TransferFunction", "opacity": [[20, 0], [60, 1]], "color": [[0, 0, 1, 0]]}
    one.send("change", state={"shader": function})
    other.until(lambda: other.of("state"))
    other.until(
        lambda: other.pictures[-1][0]["final"] and pixels(other.pictures[-1][1])[..., 0].max() < 60
    )
    assert pixels(other.pictures[-1][1])[..., 1].max() > 200 > before[..., 1].min()
    told = len(other.of("state"))
    for wrong in ({"shader": {"kind": "Lit"}}, {"options": {"step": -1}}, {"nothing": 1}):
        count = len(one.of("refused"))
        one.send("change", state=wrong)
        text = one.next("refused", count)["text"]
        assert "\n" not in text and text
    one.session.receive(one.client, b"\xff\xfe")
    one.session.receive(one.client, "[1, 2]")
    one.until(lambda: len(one.of("refused")) == 5)
    assert len(other.of("state")) == told and not other.of("refused")
    assert session.state.shader.opacity.tolist() == [[20, 0], [60, 1]]


def test_a_state_that_can_not_be_drawn_gives_way_to_the_last_that_could(session):
    """It has the right form, but the tree has no such channel."""
    page = Page(session)
    _, before = page.final()
    page.send(
        "change",
        state={
            "shader": {
                "kind": "Features",
                "transfer": page.of("welcome")[0]["state"]["shader"],
                "channel": "none",
            }
        },
    )
    assert "has no channel 'none'" in page.next("error", 0)["text"]
    page.until(
        lambda: (
            page.of("state")
            and page.of("state")[-1]["state"]["shader"]["kind"] == "TransferFunction"
        )
    )
    page.moved(turned(page.camera, 0.1))
    _, after = page.moved(page.camera)
    assert np.abs(after.astype(int) - before).max() <= 2


def test_what_is_hit_histograms_presets_and_stills(session):
    page = Page(session, 64, 48)
    page.final()
    page.send("pick", x=0.5, y=0.5, purpose="focus")
    corner = {"x": 0.0, "y": 0.0}
    page.send("pick", **corner)
    page.until(lambda: len(page.of("picked")) == 2)
    hit, missed = page.of("picked")
    assert missed["place"] is None and hit["purpose"] == "focus"
    if hit["place"] is None:  # the ball is beside the middle
        rows, columns = np.nonzero(page.final()[1].max(-1) > 120)
        page.send("pick", x=float(columns.mean() / 64), y=float(rows.mean() / 48))
        hit = page.next("picked", 2)
    centre = (np.array([0.65, 0.5, 0.4]) * 40) - 0.5
    away = np.linalg.norm(np.array(hit["place"]) - centre)
    assert 3 < away < 10, "on the ball's surface"
    page.send("histogram", in_view=False)
    told = page.next("histogram", 0)
    values = bright_ball().data.numpy()
    assert sum(told["counts"]) == values.size and told["low"] <= 0 and told["high"] >= values.max()
    assert told["counts"] == np.bincount(values.ravel()).tolist(), "a bar for each whole number"
    page.send("histogram", in_view=True)
    told = page.next("histogram", 1)
    assert 0 < sum(told["counts"]) < values.size * 2
    page.send("preset", name="hot", low=0.0, high=200.0)
    found = page.next("preset", 0)["function"]
    assert found["color"] == gv.TransferFunction.preset("hot", 0, 200).color.tolist()
    page.send("preset", name="no")
    assert "unknown preset 'no'" in page.next("refused", 0)["text"]
    page.send("still", width=80, height=40)
    page.until(lambda: page.files)
    still = pixels(page.files["picture.png"])
    tree = gv.N3Tree.from_volume(bright_ball())
    camera = session.state.camera.camera(80, 40, tree.box)
    made = gv.Progressive(lambda one: gv.render(tree, one, FUNCTION)).refine(camera, 16)
    assert np.array_equal(still, made.to_srgb8().numpy())


def test_figures_and_cost_pictures(session):
    page = Page(session)
    page.final()
    page.send("monitor", on=True)
    told = page.next("figures", 0)
    assert (
        told["samples"] > 0
        and "trace" in told["stages"]
        and told["report"]["occupancy"]["bricks"] > 0
    )
    assert told["rays"] == 64 * 48
    page.send("change", state={"show": "samples"})
    page.until(lambda: page.of("state"))
    page.until(lambda: pixels(page.pictures[-1][1]).shape == (24, 32, 3))
    page.send("do", what="fit")
    page.next("camera", 0)


class Broken(gv.Producer):
    """A store that dies: what is not made yet fails from then on."""

    alive = True

    def fill(self, nodes):
        if not self.alive:
            raise OSError("the disk is gone")
        return {
            "value": torch.ones(*nodes.positions.shape[:-1], 1)
            * nodes.depth[:, None, None, None, None]
        }


def test_a_scene_that_dies_is_told_and_the_picture_goes_on():
    producer = Broken(512)
    session = new_session(producer, gv.TransferFunction([(0, 0.01), (9, 0.2)]))
    try:
        page = Page(session)
        page.final()
        producer.alive = False
        near = {**page.camera, "target": [256.0, 256, 256], "eye": [300.0, 280, 520]}
        page.send("move", camera=near, moving=False)
        told = page.next("failed", 0)
        assert "the disk is gone" in told["text"] and told["count"] > 0
        _, seen = page.moved(near)
        assert seen.max() > 0
        producer.alive = True
        page.send("do", what="retry")
        page.until(lambda: not page.of("busy") or page.of("busy")[-1]["misses"] == 0)
        page.final()
        assert session.ask(lambda: len(session.scene.engine.production.failures)) == 0
    finally:
        session.close()


@dataclass
class Settings:
    """What a scene is made of."""

    radius: float = field(default=10.0, metadata={"range": (1, 20)})
    hollow: bool = False


def ball(settings: Settings) -> gv.Producer:
    shape = gv.sdf.Sphere(settings.radius)
    return gv.FieldProducer(gv.Solid(shape), 64, box=((-20, -20, -20), (20, 20, 20)))


def test_fields_of_a_dataclass_and_parameters_of_a_module_become_controls():
    session = new_session(ball, gv.TransferFunction([(0.4, 0), (0.6, 1)]))
    try:
        page = Page(session)
        _, before = page.final()
        told = page.of("welcome")[0]["parameters"]
        assert told["radius"] == {"type": "number", "range": [1, 20], "value": 10.0}
        assert told["hollow"] == {"type": "flag", "value": False}
        page.send("set", name="radius", value=4.0)
        assert page.next("parameters", 0)["parameters"]["radius"]["value"] == 4.0
        share = page.until(lambda: (page.final()[1] > 128).sum() / (before > 128).sum() % 1.0)
        assert abs(share - (4 / 10) ** 2) < 0.06
        page.send("set", name="radius", value="large")
        assert "radius: must be a number" in page.next("refused", 0)["text"]
        page.send("set", name="weight", value=1)
        assert "no parameter 'weight'" in page.next("refused", 1)["text"]
    finally:
        session.close()

    class Level(gv.Producer):
        def __init__(self):
            super().__init__(32)
            self.level = torch.nn.Parameter(torch.tensor(0.1))

        def fill(self, nodes):
            return {"value": self.level.detach().expand(*nodes.positions.shape[:-1], 1).clone()}

    session = new_session(Level(), GRAY)
    try:
        page = Page(session)
        _, before = page.final()
        value = page.of("welcome")[0]["parameters"]["level"]
        assert value["type"] == "number" and abs(value["value"] - 0.1) < 1e-6
        page.send("set", name="level", value=0.9)
        page.until(lambda: page.final()[1].max() > before.max())
    finally:
        session.close()


def test_memory_is_set_while_it_is_looked_at(session):
    page = Page(session)
    _, before = page.final()
    page.send("resize", engine={"brick_pool": "2 MB"})
    page.until(lambda: session.ask(lambda: session.scene.engine.options.brick_pool) == "2 MB")
    page.moved(turned(page.camera, 0.1))
    _, after = page.moved(page.camera)
    assert np.abs(after.astype(int) - before).max() <= 2
    page.send("resize", engine={"brick_pool": "2 B"})
    page.next("refused", 0)
    page.send("resize", engine={"device": "cuda"})
    assert "'device' can't be set" in page.next("refused", 1)["text"]
    page.moved(turned(page.camera, 0.2))


@pytest.mark.parametrize("kind", ["tree", "engine", "producer", "store", "array", "path", "labels"])
def test_anything_can_be_looked_at(kind, scan_store, tmp_path):
    volume = bright_ball(16)
    np.save(tmp_path / "ball.npy", volume.data[..., 0].numpy())
    what = {
        "tree": lambda: gv.N3Tree.from_volume(volume),
        "engine": lambda: gv.Engine(gv.VolumeProducer(volume)),
        "producer": lambda: gv.VolumeProducer(volume),
        "store": lambda: gv.Store.open(scan_store),
        "array": volume.data[..., 0].numpy,
        "path": lambda: str(tmp_path / "ball.npy"),
        "labels": lambda: gv.Volume((volume.data > 100).to(torch.uint8), labels=True),
    }[kind]()
    session = new_session(what)
    try:
        page = Page(session)
        _, seen = page.final()
        assert seen.max() > 60, kind
    finally:
        session.close()
    if kind == "engine":
        what.frame(gv.Camera.orbit(width=8, height=8), FUNCTION)  # it stays its owner's
        what.close()
    with pytest.raises(ValueError, match="view: takes an Engine"):
        new_session(object())
    with pytest.raises(FileNotFoundError):
        new_session(tmp_path / "no.npy")


def test_a_thousand_moves_leave_nothing_behind(session):
    page = Page(session, 32, 24)
    page.final()
    camera = page.camera

    def wander(times: int) -> None:
        nonlocal camera
        for _ in range(times):
            camera = turned(camera, 0.05)
            page.send("move", camera=camera, moving=True)
            if len(page.pictures) > 20:
                del page.pictures[:-5]
        page.moved(camera)

    wander(200)
    gc.collect()
    before = len(gc.get_objects())
    wander(1000)
    gc.collect()
    assert len(gc.get_objects()) - before < 400
    client = weakref.ref(page.client)
    session.leave(page.client)
    del page.client
    session.ask(lambda: None)
    gc.collect()
    assert client() is None


# The server.


def with_socket(server: Server, what, **options):
    """Runs a coroutine of a page's websocket."""

    async def run():
        async with aiohttp.ClientSession() as client:
            path = f"http://127.0.0.1:{server.port}/ws"
            given = {"params": {"token": server.token}, **options}
            async with client.ws_connect(path, **given) as ws:
                return await asyncio.wait_for(what(ws), SOON)

    return asyncio.run(run())


def get(server: Server, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    async def run():
        async with aiohttp.ClientSession() as client:
            url = URL(f"http://127.0.0.1:{server.port}{path}", encoded=True)  # as it stands
            async with client.get(url, headers=headers, allow_redirects=False) as answer:
                return answer.status, dict(answer.headers), await answer.read()

    return asyncio.run(run())


async def first_pictures(ws):
    """Says hello, and answers pictures until one is final."""
    await ws.send_json({"type": "hello", "width": 48, "height": 32})
    texts = []
    async for message in ws:
        if message.type == aiohttp.WSMsgType.TEXT:
            texts.append(json.loads(message.data))
            continue
        head, data = split(message.data)
        await ws.send_json({"type": "ack", "number": head["number"]})
        if head["final"]:
            return texts, head, pixels(data)
    raise AssertionError(f"the socket closed: {ws.close_code}")


def test_a_page_over_http_and_a_websocket(server):
    texts, head, seen = with_socket(server, first_pictures)
    assert texts[0]["type"] == "welcome" and head["samples"] == 16
    assert seen.shape == (32, 48, 3) and seen.max() > 100
    status, headers, body = get(server, "/")
    assert status == 200 and b"<canvas" not in body and b"main.js" in body
    policy = headers["Content-Security-Policy"]
    assert (
        policy.startswith("default-src 'none'") and "unsafe" not in policy and "http" not in policy
    )
    for name, content in page_files().items():
        status, headers, body = get(server, f"/{name}")
        assert status == 200 and body == content and headers["X-Content-Type-Options"] == "nosniff"


def test_nothing_but_the_page_is_read(server):
    for path in (
        *("/../../pyproject.toml", "/%2e%2e/%2e%2e/pyproject.toml", "/..%2fview.py", "/view.py"),
        *("/page/app.js", "//etc/passwd", "/etc/passwd", "/__init__.py", "/app.js%00", "/%00"),
        *("/app.js/..", "/..%5c..%5cview.py", "/ws/app.js", "/" + "a" * 5000),
    ):
        status, headers, body = get(server, path)
        assert status in (400, 403, 404), path
        assert b"import" not in body and str(ROOT).encode() not in body
        assert "default-src 'none'" in headers.get("Content-Security-Policy", "default-src 'none'")


@pytest.mark.parametrize(
    ("params", "headers"),
    [
        ({}, {}),
        ({"token": "wrong"}, {}),
        ({"token": "ö"}, {}),
        (None, {"Origin": "http://evil.example"}),
        (None, {"Origin": "null"}),
        (None, {"Host": "evil.example"}),
        (None, {"Host": "127.0.0.1.evil.example:80", "Origin": "http://127.0.0.1.evil.example:80"}),
        (None, {"Host": "192.168.0.7"}),
    ],
)
def test_strangers_are_refused(server, params, headers):
    """Without the token, from another site's page, or under a name that is not this machine's."""

    async def nothing(ws):
        return None

    given = {"params": {"token": server.token} if params is None else params, "headers": headers}
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        with_socket(server, nothing, **given)
    assert refused.value.status == 403
    if "Host" in headers:
        assert get(server, "/", Host=headers["Host"])[0] == 403


def test_friends_are_let_in(server, session):
    """Through a forwarded port, and under names that were allowed."""
    for host in ("localhost:9999", "127.0.0.1", "[::1]:80", f"LOCALHOST:{server.port}"):
        headers = {"Host": host, "Origin": f"http://{host}"}
        texts, *_ = with_socket(server, first_pictures, headers=headers)
        assert texts[0]["type"] == "welcome", host
    other = Server(session, host="0.0.0.0", allow=["scans.example"], token="secret")
    try:
        assert "token=secret" in other.url
        for host, status in (("scans.example", 200), ("10.1.2.3:8", 200), ("evil.example", 403)):
            assert get(other, "/", Host=host)[0] == status, host
    finally:
        other.close()
    with pytest.raises(ValueError, match="a token is needed"):
        Server(session, host="0.0.0.0", token="")
    with pytest.raises(OSError, match="address already in use"):
        Server(session, port=server.port)


def test_a_rude_page_harms_nobody(server, session):
    """Wrong messages by the thousand, a message too large, and a page that goes in the middle."""

    async def rude(ws):
        rng, refused = np.random.default_rng(3), 0
        for _ in range(2000):
            await ws.send_bytes(rng.integers(0, 256, 40, np.uint8).tobytes())
        while refused < 2000:
            refused += json.loads(await ws.receive_str())["type"] == "refused"
        await ws.send_str("x" * (2 << 20))
        async for _ in ws:
            pass
        return ws.close_code

    assert with_socket(server, rude) == 1009  # too large

    async def deaf(ws):
        with contextlib.suppress(aiohttp.ClientConnectionError):
            for _ in range(100000):
                await ws.send_str("[]")
        return True

    assert with_socket(server, deaf)

    async def gone(ws):
        await ws.send_json({"type": "hello", "width": 640, "height": 480})
        ws._response.connection.transport.abort()

    with_socket(server, gone)
    texts, *_ = with_socket(server, first_pictures)
    assert texts[0]["type"] == "welcome"
    deadline = threading.Event()
    for _ in range(200):
        if not session.ask(lambda: len(session.clients)):
            break
        deadline.wait(0.05)
    assert not session.clients


def test_view_serves_and_ends(tmp_path):
    with gv.view(bright_ball(), FUNCTION, browser=False, wait=False, step=0.7) as viewer:
        assert "token=" in viewer.url and viewer.state.options.step == 0.7
        texts, *_ = with_socket(viewer.server, first_pictures)
        assert texts[0]["state"]["options"]["step"] == 0.7
        viewer.state.save(tmp_path / "a.json")
    with pytest.raises(aiohttp.ClientConnectionError):
        with_socket(viewer.server, first_pictures)
    assert json.loads((tmp_path / "a.json").read_text())["camera"]["fov"] == 30
    with gv.view(bright_ball(), state=tmp_path / "a.json", browser=False, wait=False) as viewer:
        assert viewer.state.options.step == 0.7
    with pytest.raises(ValueError, match="unknown option 'stp'"):
        gv.view(bright_ball(), FUNCTION, browser=False, wait=False, stp=1)


def test_the_command(tmp_path, small, scan_store, monkeypatch):
    """`gvtorch view` of a volume, a store and a script shows what `gvtorch render` does."""
    seen = []

    def shown(viewer):
        texts, *_ = with_socket(viewer.server, first_pictures)
        seen.append(texts[0])
        viewer.close()

    monkeypatch.setattr(gv.Viewer, "wait", shown)
    script = tmp_path / "scene.py"
    script.write_text(
        "import gvtorch as gv\nscene = gv.FieldProducer(gv.Solid(gv.sdf.Sphere(1.0)), 64)\n"
        "shader = gv.Isosurface(0.5)\noptions = {'step': 0.4}\n"
    )
    for args in (
        (small, "--tf", "hot", "--step", "0.3"),
        (scan_store, "--brick-pool", "4 MB"),
        (script,),
    ):
        run = gvtorch("view", *args, "--no-browser")
        assert run.returncode == 0, run.stderr
        assert "http://127.0.0.1:" in run.stdout
    assert seen[0]["state"]["options"]["step"] == 0.3
    assert seen[1]["engine"]["brick_pool"] == "4 MB"
    assert seen[2]["state"]["shader"]["kind"] == "Isosurface"
    for args, message in (
        ((tmp_path / "no.npy",), "not found"),
        ((small, "--size", "8x8"), "--size is for pictures"),
        ((script, "--tf", "hot"), "--tf is for files"),
        ((small, "--state", tmp_path / "no.json"), "state not found"),
    ):
        run = gvtorch("view", *args, "--no-browser")
        assert run.returncode == 2 and message in run.stderr, run.stderr
        assert len(run.stderr.splitlines()) == 1


def test_a_missing_library_is_one_line(monkeypatch, small):
    monkeypatch.setitem(__import__("sys").modules, "aiohttp", None)
    run = gvtorch("view", small, "--no-browser")
    assert run.returncode == 2 and "pip install 'gvtorch[view]'" in run.stderr
    assert len(run.stderr.splitlines()) == 1


def test_the_widget_joins_leaves_and_has_a_png(session):
    pytest.importorskip("anywidget")
    from gvtorch.viewer.notebook import widget

    made, sent = widget(session), []
    made.send = lambda content, buffers=None: sent.append((content, buffers))
    made._take(made, {"joined": True}, [])
    session.ask(lambda: None)
    made._take(made, {"text": '{"type": "hello", "width": 64, "height": 48}'}, [])
    for _ in range(100):
        session.ask(lambda: None)
        if any(buffers for _, buffers in sent):
            break
    assert json.loads(sent[0][0]["text"])["type"] == "welcome"
    made._take(made, {"joined": False}, [])
    assert session.ask(lambda: len(session.clients)) == 0
    shown = made._repr_mimebundle_()
    bundle = shown[0] if isinstance(shown, tuple) else shown
    still = pixels(bundle["image/png"])
    assert still.shape == (540, 960, 3) and still.max() > 100
