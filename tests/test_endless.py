"""Servers that send a chunk without an end, fast or a byte at a time, that stall, break off or send
another part than was requested: this costs only the nodes of that chunk, and no more memory than a
chunk can take.
"""

from __future__ import annotations

import contextlib
import os
import re
import socketserver
import threading
import time
from collections.abc import Callable, Iterator
from http import server as servers
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import google_crc32c
import numpy as np
import pytest
import torch
from helpers.servers import WebServer
from helpers.stores import noise, write_foreign

import gvtorch as gv
from gvtorch.io import http, relay, remote
from gvtorch.io.http import read_http
from gvtorch.io.stores.conversion import convert
from gvtorch.io.stores.store import Store

MEMORY = 300 << 20  # bytes that reading may take
VIEW = gv.Camera.orbit(width=128, height=48)


class Server(WebServer):
    """Serves a folder, with byte ranges if `parts`; files whose paths match `bad` as `how` says."""

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.folder, self.bad, self.how, self.parts, self.over = folder, "", "", True, False
        self.shift = 0

    def handle_error(self, *_: object) -> None:
        pass  # readers close the connection

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(servers.BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        server, file = self.server, self.server.folder / self.path.strip("/")
        if not file.is_file():
            self.send_error(404)
            return
        if server.bad and re.search(server.bad, self.path):
            with contextlib.suppress(OSError):
                self.misbehave(file.read_bytes())
            self.close_connection = True
            return
        content = file.read_bytes()
        byte_range = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers.get("Range", ""))
        status = 200
        if byte_range is not None and server.parts:
            first, last = byte_range.groups()
            start = int(first) if first else max(0, len(content) - int(last))
            size = len(content)
            content = content[start : int(last) + 1 if first and last else None]
            status = 206
        self.send_response(status)
        if status == 206:
            start += server.shift
            self.send_header("Content-Range", f"bytes {start}-{start + len(content) - 1}/{size}")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def misbehave(self, content: bytes) -> None:
        server, how = self.server, self.server.how
        if how == "error":
            self.send_error(403)
            return
        self.send_response(206 if how.startswith("part") and "Range" in self.headers else 200)
        if how == "break":
            self.send_header("Content-Length", "1000000")
        self.end_headers()
        self.wfile.write(content[:100])
        while not server.over and how != "break":
            if how.endswith("fast"):
                self.wfile.write(b"[" * (1 << 20))
            elif how == "slow":
                self.wfile.write(b"[")
            if not how.endswith("fast"):
                time.sleep(0.02)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(tmp_path, monkeypatch) -> Iterator[Server]:
    monkeypatch.setattr(http, "STALL_SECONDS", 1.5)
    monkeypatch.setattr(http, "MIN_BYTES_PER_SECOND", 10**7)
    monkeypatch.setattr(http, "REFUSED_SECONDS", 60.0)
    delays = {"initial_delay": "20ms", "max_delay": "100ms"}
    monkeypatch.setattr(relay, "_RETRIES", relay._RETRIES | delays)
    with Server(tmp_path) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield running
        running.over = True
        running.shutdown()
        thread.join()


def mended(server: Server, read: Callable[[], Any]) -> Any:
    """Returns what a read gives once the server works again and its failure is forgotten."""
    server.bad = ""
    for _ in range(400):
        http.retry_refused()
        try:
            return read()
        except OSError:
            time.sleep(0.05)  # until pending requests have ended
    return read()


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@contextlib.contextmanager
def little_memory() -> Iterator[None]:
    """Asserts that the process stays small within the block."""
    before, peak, over = resident(), [0], threading.Event()

    def watch() -> None:
        while not over.wait(0.005):
            peak[0] = max(peak[0], resident())

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
    assert peak[0] - before < MEMORY


@pytest.fixture(scope="module")
def data() -> np.ndarray:
    return noise((40, 40, 300, 1))


REASONS = {
    "fast": r"more than \d+ bytes",
    "part fast": r"more than \d+ bytes",
    "slow": "sends hardly anything",
    "stall": "sends hardly anything",
    "break": "cut off",
    "error": "403",
}


@pytest.mark.parametrize("how", REASONS)
def test_a_chunk_without_an_end_costs_its_nodes(server, tmp_path, data, how):
    convert(gv.Volume(data), tmp_path / "a.zarr", workers=1)
    store = Store.open(f"{server.url}/a.zarr")
    server.bad, server.how = r"blocks/0/c/0/0/1/", how
    positions = np.array(list(np.ndindex(*store.block_grid(0))))
    with little_memory():
        blocks, errors = store.read_blocks(0, positions, timeout=60.0)
    bad = np.flatnonzero(positions[:, 2] * 32 >= 256).tolist()
    assert sorted(errors) == bad
    for text in errors.values():
        assert re.search(REASONS[how], text) and "\n" not in text, text
        assert "a.zarr" in text and str(relay._server().server_port) not in text
    assert not mended(server, lambda: store.read_blocks(0, positions)[1])
    assert np.array_equal(blocks[0, 1:33, 1:33, 1:33], data[:32, :32, :32])


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("how", ["fast", "slow"])
def test_a_picture_of_such_a_store_is_made_of_the_rest(server, tmp_path, data, how):
    convert(gv.Volume(data), tmp_path / "a.zarr", workers=1)
    server.bad, server.how = r"blocks/[1-3]/c/", how
    transfer = gv.TransferFunction.preset("gray", 0, 255)
    with little_memory(), gv.Engine(gv.StoredProducer(f"{server.url}/a.zarr")) as engine:
        picture = engine.render(VIEW, transfer)
        assert torch.isfinite(picture.color).all() and engine.failures
        assert all(re.search(REASONS[how], failure.message) for failure in engine.failures)
        mended(server, lambda: None)
        engine.forget_failures()
        whole = engine.render(VIEW, transfer)
        assert whole.stats.converged and not engine.failures
    resident = gv.render(gv.N3Tree.from_volume(gv.Volume(data)), VIEW, transfer)
    assert torch.equal(whole.color, resident.color) and whole.alpha.max() > 0


@pytest.mark.parametrize("kind", ["v2", "v3", "sharded", "n5"])
@pytest.mark.parametrize("how", ["fast", "stall"])
def test_chunks_and_indices_of_other_writers(server, tmp_path, data, kind, how):
    values = data[..., :100, 0]
    if kind == "n5":
        import tensorstore as ts

        spec = {"driver": "n5", "kvstore": {"driver": "file", "path": f"{tmp_path}/a.n5/"}}
        ts.open(spec, create=True, dtype=ts.uint8, shape=values.shape).result()[...] = values
        source = f"{server.url}/a.n5"

        def read() -> np.ndarray:
            return gv.read_volume(source, axes="zyx").data[..., 0].numpy()
    else:
        version = 2 if kind == "v2" else 3
        arrays = [values], "zyx", [[1.0, 1.0, 1.0]]
        write_foreign(tmp_path / "a.zarr", *arrays, version=version, sharded=kind == "sharded")
        store = Store.open(f"{server.url}/a.zarr")

        def read() -> np.ndarray:
            return store.read_region(0, (0, 0, 0), values.shape)[..., 0]

    expected = values if kind != "n5" else None
    good = read()
    assert good.size == values.size and (expected is None or np.array_equal(good, expected))
    server.bad, server.how = r"\d[/.]\d[/.]\d$", how
    with little_memory(), pytest.raises(OSError, match=REASONS[how]):
        read()
    server.parts = False  # a server that sends all of a file in any case
    assert np.array_equal(mended(server, read), good)


def test_a_server_that_sends_all_of_a_file_and_breaks_off_within_the_part_is_told(server, tmp_path):
    (tmp_path / "file").write_bytes(bytes(1000))
    server.bad, server.how = "file", "break"  # 100 bytes come
    with pytest.raises(OSError, match="cut off: 999900 bytes are missing"):
        http.read_http(
            f"{server.url}/file",
            max_bytes=1000,
            byte_range=slice(50, 500),
            max_file_bytes=10**7,
            seconds=9.0,
        )
    assert (
        len(
            http.read_http(
                f"{server.url}/file", max_bytes=1000, byte_range=slice(50, 90), seconds=9.0
            )
        )
        == 40
    )


@pytest.mark.parametrize("how", ["fast", "index", "stall", "metadata"])
def test_buckets_are_read_within_bounds(tmp_path, data, how, monkeypatch):
    import tensorstore as ts

    from gvtorch.io.stores.tensorstores import context

    stalls = pytest.MonkeyPatch()
    sharded, url = how == "index", f"memory://endless-{how}/"
    values = data[..., :100, 0]
    arrays = [values], "zyx", [[1.0, 1.0, 1.0]]
    folder = write_foreign(tmp_path / "a.zarr", *arrays, sharded=sharded)
    root = ts.KvStore.open(url, context=context()).result()
    for file in folder.rglob("*"):
        if file.is_file():
            root[str(file.relative_to(folder))] = file.read_bytes()
    store = Store.open(url)

    def read() -> np.ndarray:
        return store.read_region(0, (0, 0, 0), values.shape)[..., 0]

    assert np.array_equal(read(), values)
    name = "zarr.json" if how == "metadata" else f"s0/c/0/0/{0 if sharded else 1}"
    good = bytes(root[name])
    if how == "stall":
        _promise, future = ts.Promise.new()
        never = SimpleNamespace(read=lambda *_, **__: future)
        for server_folder in relay._server().folders:
            stalls.setitem(vars(server_folder), "_bucket", never)
        monkeypatch.setattr(relay, "STALL_SECONDS", 0.2)
        monkeypatch.setattr(relay, "MIN_BYTES_PER_SECOND", 10**9)
    elif how == "index":  # the first chunk is said to be huge
        index = bytearray(good)
        index[-(16 * 64 + 4) : -(16 * 64 - 12)] = np.array([0, 1 << 40], "<u8").tobytes()
        root[name] = (
            bytes(index[:-4]) + google_crc32c.Checksum(bytes(index[-1028:-4])).digest()[::-1]
        )
    else:
        root[name] = bytes(100_000_000)
    reason = {"stall": "hardly anything", "index": "asked for"}.get(how, r"more than \d+ bytes")
    with little_memory(), pytest.raises(OSError, match=reason) as caught:
        Store.open(url) if how == "metadata" else read()
    assert url in str(caught.value) and "\n" not in str(caught.value)
    root[name] = good
    stalls.undo()
    http._refused.clear()
    assert np.array_equal(read(), values)


def test_parts_of_files_that_never_end(server, tmp_path):
    content = bytes(range(256)) * 1000
    (tmp_path / "a").write_bytes(content)
    url = f"{server.url}/a"
    for server.parts in (True, False):
        for part in (slice(0, 1), slice(5, 70_000), slice(200_000, 200_010), slice(-20, None)):
            expected = content[part]
            assert read_http(url, len(expected), part, max_file_bytes=len(content)) == expected
    with pytest.raises(OSError, match="more than 255999 bytes"):
        read_http(url, 20, slice(-20, None), max_file_bytes=len(content) - 1)
    http._refused.clear()
    server.parts, server.shift = True, 1
    with pytest.raises(OSError, match="another part came: bytes 6-"):
        read_http(url, 5, slice(5, 10))
    server.bad, server.how = "a", "fast"
    http._refused.clear()
    assert read_http(url, 90, slice(0, 90), max_file_bytes=1000) == content[:90]
    for part in (None, slice(-20, None), slice(10**7, 10**7 + 5)):
        http.retry_refused()
        with pytest.raises(OSError, match=r"more than 1\d* bytes"):
            read_http(url, 10**6, part, max_file_bytes=10**6)
    server.how = "slow"
    http._refused.clear()
    with pytest.raises(TimeoutError):
        read_http(url, 10**6, seconds=0.3)
    assert read_http(f"{server.url}/none", 9) is None


ANSWER = b"HTTP/1.1 200 OK\r\n"
UNENDING = {  # what comes first, and what comes again and again
    "header": (ANSWER + b"X: ", b"x"),
    "before the answer": (b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
    "behind the body": (ANSWER + b"Transfer-Encoding: chunked\r\n\r\n1\r\nx\r\n0\r\n", b"X: x\r\n"),
    "body": (ANSWER + b"Content-Length: 999999\r\n\r\n", b"x"),
    "redirected": (b"HTTP/1.1 302 Found\r\nLocation: /b\r\nContent-Length: 0\r\n\r\n", b""),
}


class Unending(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        path = self.request.recv(1 << 16).split()[1].decode()
        first, again = UNENDING["header" if path == "/b" else self.server.how]
        with contextlib.suppress(OSError):
            self.request.sendall(first)
            while again and not self.server.over:
                self.request.sendall(again)
                time.sleep(0.02)


@pytest.mark.parametrize("how", UNENDING)
def test_headers_and_what_is_around_a_body_end_too(how, tmp_path, monkeypatch):
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path))
    monkeypatch.setattr(http, "STALL_SECONDS", 0.3)
    monkeypatch.setattr(remote, "_PART_SECONDS", 0.3)
    server: Any = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Unending)
    server.daemon_threads, server.how, server.over = True, how, False
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    url, start = f"http://127.0.0.1:{server.server_address[1]}", time.monotonic()
    with pytest.raises(http.Endless, match="hardly anything"):
        read_http(f"{url}/a.npy", 999)
    with pytest.raises(OSError, match="hardly anything"):
        remote.fetch(f"{url}/a.npy")
    assert time.monotonic() - start < 10, "both wait 0.3 s"
    server.over = True
    server.shutdown()
    server.server_close()


class _Racing(dict):
    """A dict that other threads change while it is iterated over, and after it is looked into."""

    def __init__(self):
        super().__init__()
        self.threads = []

    def __iter__(self):
        keys = super().__iter__()
        for change in (http.retry_refused, lambda: http.keep_reason("other", OSError("other"))):
            self.threads.append(threading.Thread(target=change))
            self.threads[-1].start()
            self.threads[-1].join(0.2)
        return keys

    def get(self, *arguments):
        value = super().get(*arguments)
        self.clear()
        return value


def test_reasons_are_kept_while_other_threads_forget_them(monkeypatch):
    monkeypatch.setattr(http, "_MAX_REASONS", 2)
    racing = _Racing()
    monkeypatch.setattr(http, "_refused", racing)
    for name in "abc":
        http.keep_reason(name, OSError(name))
    for thread in racing.threads:
        thread.join()
    assert len(racing) <= 2
    http.keep_reason("a", http.Endless("it never ends"), 60.0)
    with pytest.raises(http.Endless, match="it never ends"):
        read_http("a", 9)


def test_nobody_else_reads_by_the_relay(server, tmp_path):
    (tmp_path / "a").write_bytes(b"mine")
    spec = relay.relay_folder(f"{server.url}/").spec
    assert read_http(f"{spec['base_url']}a", 9) == b"mine"
    port = relay._server().server_port
    for path in ("", "0/a", "x/0/a", f"{relay._server().secret}/999999/a"):
        with pytest.raises(http.HttpStatus, match="403"):
            read_http(f"http://127.0.0.1:{port}/{path}", 9)


@pytest.mark.parametrize("kind", ["parts", "whole files", "bucket"])
def test_the_relay_answers_every_range(server, tmp_path, kind):
    import tensorstore as ts

    from gvtorch.io.stores.tensorstores import context

    content, url = bytes(range(256)) * 4, f"{server.url}/"
    if kind == "bucket":
        url = "memory://endless-ranges/"
        ts.KvStore.open(url, context=context()).result()["a"] = content
    (tmp_path / "a").write_bytes(content)
    server.parts = kind == "parts"
    address = urlsplit(relay.relay_folder(url, context()).spec["base_url"])

    def ask(text: str, name: str = "a") -> tuple[int, str | None, bytes]:
        with contextlib.closing(HTTPConnection(address.netloc)) as connection:
            connection.request("GET", f"{address.path}{name}", headers={"Range": text})
            response = connection.getresponse()
            return response.status, response.headers["Content-Range"], response.read()

    for text, first, part in (
        ("bytes=1000-", 1000, content[1000:]),
        ("bytes=1023-", 1023, content[1023:]),
        ("bytes=0-", 0, content),
        ("bytes=5-9", 5, content[5:10]),
    ):
        assert ask(text) == (206, f"bytes {first}-{first + len(part) - 1}/*", part), text
    assert ask("bytes=-3")[::2] == (206, content[-3:])
    for text in ("bytes=1024-", "bytes=5000-", "bytes=-0"):
        assert ask(text) == (416, None, b""), text
    for text in ("", "bytes=-", "bytes=9-5", "bytes=0-1,5-6", "lines=0-1", f"bytes={'9' * 5000}-"):
        assert ask(text) == (200, None, content), text
    assert ask("bytes=1-", "none")[0] == 404
    if kind != "bucket":
        server.bad, server.how = "a", "fast"
    else:
        ts.KvStore.open(url, context=context()).result()["a"] = bytes(20_000_000)
    assert ask("bytes=1-")[0] == 403, "more than any file of metadata has"
