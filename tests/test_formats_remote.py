"""Files behind URLs: servers with and without validators, what is cached, and what goes wrong."""

from __future__ import annotations

import contextlib
import gzip
import http.server
import shutil
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import numpy as np
import pytest
from helpers.servers import WebServer
from helpers.stores import noise, stopped_at

import gvtorch as gv
from gvtorch.io import remote
from gvtorch.io.http import read_http
from gvtorch.io.stores.conversion import convert
from gvtorch.io.stores.store import Store


class Server(WebServer):
    """Serves a few files without byte ranges, and counts what it sends."""

    files: dict[str, bytes]
    tag: str | None = '"one"'
    modified: str | None = None
    sized = True
    packed = False
    status = 200
    cut = 0
    sent: list[str]

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files, self.sent = {}, []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        server, name = self.server, self.path.partition("?")[0]
        content = server.files.get(name)
        if content is None:
            self.send_error(404)
            return
        if (server.tag and self.headers.get("If-None-Match") == server.tag) or (
            server.modified and self.headers.get("If-Modified-Since") == server.modified
        ):
            self.send_response(304)
            self.end_headers()
            return
        server.sent.append(self.path)
        self.send_response(server.status)
        if server.status == 302:
            self.send_header("Location", "ftp://127.0.0.1/x/a.npy")
        for header, value in (("ETag", server.tag), ("Last-Modified", server.modified)):
            if value:
                self.send_header(header, value)
        if server.sized:
            self.send_header("Content-Length", str(len(content)))
        if server.packed:
            self.send_header("Content-Encoding", "gzip")
        self.end_headers()
        self.wfile.write(content[: len(content) - server.cut])

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(tmp_path, monkeypatch) -> Iterator[Server]:
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path / "cache"))
    with Server() as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


@pytest.fixture
def grid(tmp_path, server) -> np.ndarray:
    data = noise((7, 9, 12), "int16")
    np.save(tmp_path / "a.npy", data)
    server.files["/x/a.npy"] = (tmp_path / "a.npy").read_bytes()
    return data


def kept(tmp_path: Path) -> list[Path]:
    return [p for p in (tmp_path / "cache").rglob("*") if p.is_file() and p.suffix != ".json"]


@pytest.mark.parametrize("sized", [True, False])
def test_a_file_is_downloaded_once(tmp_path, server, grid, sized):
    server.sized = sized
    for _ in range(2):
        volume = gv.read_volume(f"{server.url}/x/a.npy?token=1")
        assert np.array_equal(volume.data[..., 0].numpy(), grid) and volume.name == "a.npy"
    store = convert(f"{server.url}/x/a.npy?token=1", tmp_path / "a.zarr")
    assert np.array_equal(store.read_region(0, (0, 0, 0), grid.shape)[..., 0], grid)
    assert len(server.sent) == 1 and len(kept(tmp_path)) == 1


def test_blanks_and_letters_of_a_url_are_quoted(server, grid):
    server.files["/x/sl%C3%A9%20%231.npy"] = server.files["/x/a.npy"]
    volume = gv.read_volume(f"{server.url}/x/sl\u00e9 %231.npy?q= a")
    assert np.array_equal(volume.data[..., 0].numpy(), grid)
    assert server.sent == ["/x/sl%C3%A9%20%231.npy?q=%20a"]
    with pytest.raises(OSError, match="can't be downloaded: nonnumeric port"):
        gv.read_volume("http://localhost:port/a.npy")


@pytest.mark.parametrize("by", ["tag", "modified"])
def test_a_new_version_is_downloaded(tmp_path, server, grid, by):
    server.tag = server.modified = None
    setattr(server, by, "Sun, 22 Nov 2026 10:00:00 GMT")
    url = f"{server.url}/x/a.npy"
    assert gv.read_volume(url).extent == (12, 9, 7)
    np.save(tmp_path / "b.npy", grid[:3])
    server.files["/x/a.npy"] = (tmp_path / "b.npy").read_bytes()
    assert gv.read_volume(url).extent == (12, 9, 7)  # as the server says
    setattr(server, by, "Sun, 22 Nov 2026 11:00:00 GMT")
    assert gv.read_volume(url).extent == (12, 9, 3)
    assert len(server.sent) == 2


def test_without_validators_it_is_downloaded_each_time(server, grid):
    server.tag = None
    for _ in range(2):
        gv.read_volume(f"{server.url}/x/a.npy")
    assert len(server.sent) == 2


@pytest.mark.parametrize("tag", ['"one"', None])
def test_a_conversion_goes_on_with_a_new_copy_of_the_same_content(
    tmp_path, server, grid, tag, monkeypatch
):
    server.tag, url, target = tag, f"{server.url}/x/a.npy", tmp_path / "a.zarr"
    with stopped_at(monkeypatch, 1), pytest.raises(KeyboardInterrupt):
        convert(url, target, workers=1)
    shutil.rmtree(tmp_path / "cache")  # as if it had to make room
    store = convert(url, target, resume=True)
    assert np.array_equal(store.read_region(0, (0, 0, 0), grid.shape)[..., 0], grid)
    shutil.rmtree(target)
    with stopped_at(monkeypatch, 1), pytest.raises(KeyboardInterrupt):
        convert(url, target, workers=1)
    np.save(tmp_path / "b.npy", grid + 1)
    server.files["/x/a.npy"] = (tmp_path / "b.npy").read_bytes()
    server.tag = tag and '"two"'
    with pytest.raises(ValueError, match="the source is not the one that it was begun with"):
        convert(url, target, resume=True)


def test_the_cache_is_bounded_and_the_oldest_goes(tmp_path, server, grid, monkeypatch):
    size = len(server.files["/x/a.npy"])
    monkeypatch.setenv("GVTORCH_CACHE_GB", str(2.5 * size / 1e9))
    for name in "abcd":
        server.files[f"/{name}.npy"] = server.files["/x/a.npy"]
        gv.read_volume(f"{server.url}/{name}.npy")
    assert sorted(file.name for file in kept(tmp_path)) == ["c.npy", "d.npy"]


def test_what_is_too_large_is_refused(tmp_path, server, grid, monkeypatch):
    monkeypatch.setenv("GVTORCH_CACHE_GB", "1e-6")
    for server.sized, message in ((True, "is 1.6 kB, the cache"), (False, "is more than 1.0 kB")):
        with pytest.raises(OSError, match=message):
            gv.read_volume(f"{server.url}/x/a.npy")
    assert not kept(tmp_path)
    monkeypatch.setenv("GVTORCH_CACHE_GB", "much")
    with pytest.raises(ValueError, match="GVTORCH_CACHE_GB must be gigabytes, got 'much'"):
        gv.read_volume(f"{server.url}/x/a.npy")


def test_a_broken_download_leaves_nothing(tmp_path, server, grid):
    server.cut = 100
    with pytest.raises(OSError, match=r"is cut off"):
        gv.read_volume(f"{server.url}/x/a.npy")
    assert not kept(tmp_path)
    with pytest.raises(FileNotFoundError, match="volume not found: http"):
        gv.read_volume(f"{server.url}/none.npy")
    server.files["/x/a.npy"] = gzip.compress(server.files["/x/a.npy"])
    for server.packed, server.sized in ((True, True), (True, False)):
        with pytest.raises(OSError, match=r"is cut off: what is packed is cut off"):
            gv.read_volume(f"{server.url}/x/a.npy")
    assert not kept(tmp_path)


@pytest.mark.parametrize("status", [206, 302])
def test_a_part_or_another_protocol_is_refused(tmp_path, server, grid, status):
    server.status = status
    with pytest.raises(OSError, match=r"206 Partial Content|unknown url type: ftp"):
        gv.read_volume(f"{server.url}/x/a.npy")
    with pytest.raises(OSError, match=r"206 Partial Content|unknown url type: ftp"):
        read_http(f"{server.url}/x/a.npy", 9999)
    assert not kept(tmp_path)


@pytest.mark.parametrize("name", ["a.npy", "a.npy.gz", "b.npy.gz"])
def test_what_a_server_packs_is_unpacked(server, grid, name):
    """Also .gz files that are packed again, but not those of which it only says so."""
    server.packed, content = True, gzip.compress(server.files["/x/a.npy"])
    server.files[f"/{name}"] = gzip.compress(content) if name == "b.npy.gz" else content
    volume = gv.read_volume(f"{server.url}/{name}")
    assert np.array_equal(volume.data[..., 0].numpy(), grid) and volume.name == name


def test_without_a_network_the_copy_is_used(server, grid, monkeypatch):
    url = f"{server.url}/x/a.npy"
    gv.read_volume(url)

    def fail(*_: object, **__: object) -> None:
        raise OSError("no route to host")

    monkeypatch.setattr(remote, "ask_by_urllib", fail)
    with pytest.warns(UserWarning, match=r"no answer \(no route to host\); using the cached copy"):
        gv.read_volume(url)
    with pytest.raises(OSError, match="can't be downloaded: no route to host"):
        gv.read_volume(f"{server.url}/other.npy")


def test_a_data_set_of_a_file_behind_a_url(tmp_path, server, grid):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as out:
        out["g/a"], out["b"] = grid, grid + 1
    server.files["/a.h5"] = (tmp_path / "a.h5").read_bytes()
    volume = gv.read_volume(f"{server.url}/a.h5:/g/a")
    assert np.array_equal(volume.data[..., 0].numpy(), grid)
    with pytest.raises(ValueError, match="its numbers are in another file next to it"):
        gv.read_volume(f"{server.url}/a.mhd")


@pytest.mark.filterwarnings("ignore")
def test_other_schemes_through_fsspec(tmp_path, server, grid):
    fsspec = pytest.importorskip("fsspec")
    fsspec.filesystem("memory").pipe("/bucket/a.npy", server.files["/x/a.npy"])
    for _ in range(2):
        volume = gv.read_volume("memory://bucket/a.npy")
        assert np.array_equal(volume.data[..., 0].numpy(), grid)
    assert len(kept(tmp_path)) == 1
    with pytest.raises(FileNotFoundError, match="volume not found: memory://"):
        gv.read_volume("memory://bucket/none.npy")
    with pytest.raises((OSError, ValueError), match="nothing://"):
        gv.read_volume("nothing://bucket/none.npy")


@pytest.mark.parametrize(
    ("url", "is_file"),
    [
        ("https://host/a/scan.nii.gz", True),
        ("https://host/a/scan.tif?key=a.zarr", True),
        ("s3://bucket/scan.nrrd", True),
        ("https://host/a.zarr", False),
        ("https://host/a.zarr/0", False),
        ("https://host/v0.4/6001240.zarr/", False),
        ("s3://bucket/a.n5", False),
        ("file:///a/b.tif", False),
        ("/a/b.tif", False),
    ],
)
def test_what_is_the_url_of_a_file(url, is_file):
    assert remote.is_file_url(url) == is_file


def test_a_file_url_is_a_path(tmp_path):
    data = noise((3, 4, 5), "int16")
    np.save(tmp_path / "a b.npy", data)
    url = (tmp_path / "a b.npy").as_uri()
    assert url.startswith("file:///") and "%20" in url
    assert np.array_equal(gv.read_volume(url).data[..., 0].numpy(), data)
    store = convert(url, tmp_path / "a.zarr")
    assert np.array_equal(
        Store.open(f"file://{store.location}").read_region(0, (0, 0, 0), data.shape)[..., 0], data
    )
    with pytest.raises(FileNotFoundError, match=r"volume not found: file:///none\.npy"):
        gv.read_volume("file:///none.npy")


class Endless(http.server.BaseHTTPRequestHandler):
    """Answers without an end, as fast as it can or a byte at a time."""

    pause = 0.0

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        with contextlib.suppress(OSError):
            while not Endless.over:
                self.wfile.write(b"[" * (1 if self.pause else 1 << 20))
                time.sleep(self.pause)

    over = False

    def log_message(self, *_: object) -> None:
        pass


@pytest.mark.parametrize("pause", [0.0, 0.05])
def test_a_server_without_an_end_is_given_up(pause, monkeypatch):
    server = WebServer(("127.0.0.1", 0), Endless)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setattr(Endless, "pause", pause)
    monkeypatch.setattr("gvtorch.io.stores.store._OPEN_TIMEOUT", 1.0)
    url = f"http://127.0.0.1:{server.server_port}/a.zarr"
    try:
        with pytest.raises(OSError, match=r"more than 16777216 bytes|no answer within 1 s"):
            Store.open(url)
    finally:
        monkeypatch.setattr(Endless, "over", True)
        server.shutdown()
        server.server_close()
