"""The server of a view: what it serves, to whom, and how it is started."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import socket
import sys
import threading
import weakref
from functools import partial

import aiohttp
import numpy as np
import pytest
from helpers import ROOT, gvtorch
from helpers.viewer import FUNCTION, TIMEOUT, Page, bright_ball, pixels, split
from yarl import URL

import gvtorch as gv
from gvtorch.viewer.server import Server, _Outbox, page_files
from gvtorch.viewer.view import new_session

pytestmark = pytest.mark.backend("cpp")


@pytest.fixture
def server(session):
    running = Server(session)
    yield running
    running.close()
    assert not running._thread.is_alive()


def with_socket(server: Server, talk, **options):
    """Runs a coroutine with a page's websocket."""

    async def run():
        async with aiohttp.ClientSession() as client:
            path = f"http://127.0.0.1:{server.port}/ws"
            arguments = {"params": {"token": server.token}, **options}
            async with client.ws_connect(path, **arguments) as ws:
                return await asyncio.wait_for(talk(ws), TIMEOUT)

    return asyncio.run(run())


def get(server: Server, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    async def run():
        async with aiohttp.ClientSession() as client:
            url = URL(f"http://127.0.0.1:{server.port}{path}", encoded=True)  # not normalised
            async with client.get(url, headers=headers, allow_redirects=False) as answer:
                return answer.status, dict(answer.headers), await answer.read()

    return asyncio.run(run())


async def first_pictures(ws):
    """Says hello, and acknowledges pictures until one is final."""
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


def test_what_is_no_http_is_answered_and_not_told(server, capfd, caplog):
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(b"GET /ws?token=\xff HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert b" 400 " in connection.recv(200).split(b"\r\n")[0]
    assert not caplog.records and not any(capfd.readouterr())


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
    """Without the token, from another site's page, or under a host name of another machine."""

    async def nothing(ws):
        return None

    request = {"params": {"token": server.token} if params is None else params, "headers": headers}
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        with_socket(server, nothing, **request)
    assert refused.value.status == 403
    if "Host" in headers:
        assert get(server, "/", Host=headers["Host"])[0] == 403


def test_friends_are_let_in(server, session):
    """Through a forwarded port, and under host names that were allowed."""
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
    """Wrong messages by the thousand, a message too large, and a page that leaves in the middle."""

    async def rude(ws):
        rng, refused = np.random.default_rng(3), 0
        for _ in range(2000):
            await ws.send_bytes(rng.integers(0, 256, 40, np.uint8).tobytes())
        while refused < 2000:
            refused += json.loads(await ws.receive_str())["type"] == "refused"
        with contextlib.suppress(ConnectionError):  # it may be cut off before all is sent
            await ws.send_str("x" * (2 << 20))
            async for _ in ws:
                pass
        return ws.close_code

    assert with_socket(server, rude) in (1009, 1006, None)  # too large, or cut off

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


def test_a_page_that_reads_too_slowly_is_given_up():
    """By bytes: a thousand small messages may wait, and one file of any size."""

    async def run():
        outbox, picture = _Outbox(), bytes(2**20)
        for _ in range(3):  # also once there is room again
            for number in range(1000):
                outbox.put(f"{number}")
            assert [await outbox.get() for _ in range(1000)] == [f"{n}" for n in range(1000)]
            outbox.put(bytes(2**27))
            assert len(await outbox.get()) == 2**27
        for number in range(100):
            outbox.put(picture if number < 64 else "late")
        assert [await outbox.get() for _ in range(65)] == [picture] * 64 + [None]
        outbox.put("later")
        assert outbox._messages.empty()

    asyncio.run(run())


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

    def wait(viewer):
        texts, *_ = with_socket(viewer.server, first_pictures)
        seen.append(texts[0])
        viewer.close()

    monkeypatch.setattr(gv.Viewer, "wait", wait)
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
    assert all(text["engine"]["time_budget"] == 40 for text in seen)  # no frame takes long
    assert seen[2]["state"]["shader"]["kind"] == "Isosurface"
    for args, message in (
        ((tmp_path / "no.npy",), "not found"),
        ((small, "--size", "8x8"), "Unrecognized options: --size 8x8;"),
        ((script, "--tf", "hot"), "--tf is for files"),
        ((small, "--state", tmp_path / "no.json"), "state not found"),
    ):
        run = gvtorch("view", *args, "--no-browser")
        assert run.returncode == 2 and message in run.stderr, run.stderr
        assert len(run.stderr.splitlines()) == 1


def test_a_missing_library_is_one_line(monkeypatch, small):
    for name in ("aiohttp", "aiohttp.web"):
        monkeypatch.setitem(sys.modules, name, None)
    run = gvtorch("view", small, "--no-browser")
    assert run.returncode == 2 and "pip install 'gvtorch[view]'" in run.stderr
    assert len(run.stderr.splitlines()) == 1


def test_the_widget_joins_leaves_and_has_a_png(session):
    pytest.importorskip("anywidget")
    from gvtorch.viewer.notebook import widget

    opened, sent = widget(session), []
    opened.send = lambda content, buffers=None: sent.append((content, buffers))
    opened._receive(opened, {"joined": True}, [])
    session.ask(lambda: None)
    opened._receive(opened, {"text": '{"type": "hello", "width": 64, "height": 48}'}, [])
    for _ in range(100):
        session.ask(lambda: None)
        if any(buffers for _, buffers in sent):
            break
    assert json.loads(sent[0][0]["text"])["type"] == "welcome"
    opened._receive(opened, {"joined": True}, [])  # the view is shown below a second cell
    opened._receive(opened, {"joined": False}, [])
    assert session.ask(lambda: len(session.clients)) == 1, "the other cell still shows it"
    opened._receive(opened, {"joined": False}, [])
    assert session.ask(lambda: len(session.clients)) == 0
    bundles = opened._repr_mimebundle_()
    bundle = bundles[0] if isinstance(bundles, tuple) else bundles
    still = pixels(bundle["image/png"])
    assert still.shape == (540, 960, 3) and still.max() > 100


def seen_whole(page: Page) -> bool:
    return any(head["final"] for head, _ in page.pictures)


def test_a_closed_view_lets_go_of_its_pools_at_once():
    """They may fill a GPU, so they must not wait for Python's cyclic garbage collector."""
    gc.collect()
    gc.disable()
    try:
        session = new_session(bright_ball(), FUNCTION)
        engine = weakref.ref(session.scene.engine)
        page, server = Page(session), Server(session)
        page.until(partial(seen_whole, page))
        with_socket(server, first_pictures)
        server.close()
        session.close()
        del page, server, session
        assert engine() is None
    finally:
        gc.enable()
