"""`through`: lets tensorstore read the folder at a URL by way of a relay, a server in this process.

tensorstore accepts whatever a server sends, for however long. So it asks the relay instead, on
127.0.0.1 and under a secret path. The relay reads the file, or the part of it, with `read_http`
(from s3:// and gs:// with `read_within`) and answers once it has all of it; it refuses files that
are longer than a chunk can be, and servers that stall or send too slowly.
"""

from __future__ import annotations

import functools
import hmac
import http.server
import os
import re
import secrets
import threading
import urllib.parse
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..base.messages import one_line
from .http import (
    SLOWEST,
    SMALL,
    STALL,
    Endless,
    HttpStatus,
    file_url,
    is_http,
    keep_reason,
    read_http,
    refused,
)

if TYPE_CHECKING:  # not at run time: `gvtorch --help` imports this module
    import numpy as np

    from .stores.chunk_files import ChunkFiles

_JOINED = 1 << 27  # bytes of parts that tensorstore joins in one request
_METADATA = 1 << 24  # bytes of a file of metadata
_INDEXES = 1 << 26  # bytes of shards' indexes that are cached for a folder
_RETRIES = {"max_retries": 4, "initial_delay": "200ms", "max_delay": "1s"}
_TOGETHER = 16  # concurrent requests for one folder


class Relayed:
    """A folder with an array, read through the relay.

    Attributes:
        spec: The key-value store that tensorstore opens in place of the folder.
    """

    def __init__(self, url: str, base: str, context: Any) -> None:
        self.url, self._context = url, context
        self.spec = {
            "driver": "http",
            "base_url": base,
            # Limited per folder, so that a server that stalls does not block files of others.
            "http_request_concurrency": {"limit": _TOGETHER},
            "http_request_retries": _RETRIES,
        }
        self.future: Any = None  # of the folder's array, once that is being opened
        self._files: ChunkFiles | None = None
        self._indexes: OrderedDict[str, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def files(self) -> ChunkFiles | None:
        """The sizes that the array's files may have; None before the array is open."""
        from .stores.chunk_files import ChunkFiles

        future = self.future
        if future is not None and future.done():
            self._files = ChunkFiles.of(future.result()) if future.exception() is None else None
            self.future = None
        return self._files

    def read(self, name: str, part: slice | None) -> bytes | None:
        """Returns a file, or a part of it; raises as `read_http`."""
        from .stores.chunk_files import HEADS

        url = file_url(self.url, name)
        try:
            files = None if name.endswith(HEADS) else self.files
            content = self._read(name, part, files)
            if files is not None and content is not None:
                self._look(name, part, content, files)
        except OSError as error:
            keep_reason(url, error)
            raise
        return content

    def _read(self, name: str, part: slice | None, files: ChunkFiles | None) -> bytes | None:
        whole = piece = most = _METADATA
        if files is not None:
            whole = most = files.most
            piece = max(2 * files.chunk_bytes + SMALL + _JOINED, files.index_bytes)
        if part is not None:
            most = -part.start if part.stop is None else part.stop - part.start
            if not 0 < most <= min(piece, whole):
                raise Endless(f"{most} bytes are asked for, more than a chunk has")
        url = file_url(self.url, name)
        if is_http(url):
            return read_http(url, most, part, whole=whole)
        return self._read_bucket(urllib.parse.unquote(name), part, most)

    def _look(self, name: str, part: slice | None, content: bytes, files: ChunkFiles) -> None:
        """Caches the content if it is a shard's index; else raises Endless if it holds a chunk that
        Blosc would unpack to too many bytes.
        """
        place, index = files.index_part, None
        if files.index and part == place:
            with self._lock:
                self._indexes[name] = files.entries(content)
                while len(self._indexes) * files.index_bytes > _INDEXES and len(self._indexes) > 1:
                    self._indexes.popitem(last=False)
            return
        if files.index and part is None:
            index = files.entries(content[place])
        elif files.index:
            with self._lock:
                index = self._indexes.get(name)
            if index is None:  # it was evicted from the cache
                index = files.entries(self._read(name, place, files) or b"")
        files.check_sent(part.start if part else 0, content, index)

    def _read_bucket(self, name: str, part: slice | None, most: int) -> bytes | None:
        seconds = STALL + most / SLOWEST
        try:
            return read_within(self._bucket, name, part, most, lambda f: f.result(timeout=seconds))
        except TimeoutError:
            raise Endless("the server sends hardly anything") from None
        except OSError:
            raise
        except Exception as error:  # tensorstore raises what its status maps to
            raise OSError(one_line(error)) from None

    @functools.cached_property
    def _bucket(self) -> Any:
        import tensorstore as ts

        return ts.KvStore.open(self.url, context=self._context).result(timeout=STALL)


def read_within(
    folder: Any, name: str, part: slice | None, most: int, wait: Callable[[Any], Any]
) -> bytes | None:
    """Returns the content of a file in a key-value store of tensorstore, or a part of it; None if
    there is no such file. Before a whole file is read, the byte after `most` is requested.

    Raises:
        Endless: The file has more than `most` bytes.
        Exception: What `wait` raises, a function that returns a future's result.
    """
    if part is None:
        try:
            if wait(folder.read(name, byte_range=slice(most, most + 1))).state != "value":
                return None
        except Exception as error:
            if "OUT_OF_RANGE" not in str(error):
                raise
        else:
            raise Endless(f"the file is more than {most} bytes")
    found = wait(folder.read(name, byte_range=part))
    return bytes(found.value) if found.state == "value" else None


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.word = secrets.token_urlsafe(16)
        self.folders: list[Relayed] = []
        threading.Thread(target=self.serve_forever, daemon=True, name="gvtorch-relay").start()

    def folder(self, url: str, context: Any) -> Relayed:
        """Returns the relayed folder of a URL, the same one for the same URL."""
        for found in self.folders:
            if found.url == url:
                return found
        base = f"http://127.0.0.1:{self.server_port}/{self.word}/{len(self.folders)}/"
        self.folders.append(Relayed(url, base, context))
        return self.folders[-1]

    def handle_error(self, *_: object) -> None:
        """Prints nothing: errors are normal when tensorstore gives up a request."""


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"  # keeps connections open
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        asked = re.fullmatch(r"/([\w-]+)/(\d+)/(.+)", self.path, re.ASCII)
        if asked is None or not hmac.compare_digest(asked[1], self.server.word):
            self._answer(403)
            return
        wanted = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers.get("Range", ""))
        part = None
        if wanted is not None:
            first, last = wanted.groups()
            part = slice(int(first), int(last) + 1) if first else slice(-int(last), None)
        folder, name = self.server.folders[int(asked[2])], asked[3]
        content: bytes | None = None
        try:
            content = folder.read(name, part)
            status = 404 if content is None else 200 if part is None else 206
        except Endless:
            status = 403
        except HttpStatus as error:
            status = error.status
        except OSError:  # tensorstore tries again for a while
            status = 503
        self._answer(status, content or b"", part)

    def _answer(self, status: int, content: bytes = b"", part: slice | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        if part is not None and status == 206:
            begin = part.start if part.start >= 0 else 0
            self.send_header("Content-Range", f"bytes {begin}-{begin + len(content) - 1}/*")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Prints nothing."""


@functools.cache
def _server() -> _Server:
    for name in ("no_proxy", "NO_PROXY"):  # libcurl would ask a proxy even for this machine
        told = os.environ.get(name, "")
        if any(key.lower().endswith("_proxy") for key in os.environ) and "127.0.0.1" not in told:
            os.environ[name] = f"{told},127.0.0.1" if told else "127.0.0.1"
    return _Server()


_starting = threading.Lock()


def through(url: str, context: Any = None) -> Relayed:
    """Returns the relayed folder of a URL; `context` is tensorstore's, for s3:// and gs://."""
    with _starting:
        return _server().folder(url, context)


def with_urls(text: str) -> str:
    """Replaces the relay's addresses in a message by the original URLs; if a file was refused,
    returns its URL and the reason instead.
    """
    if not _server.cache_info().currsize:
        return text
    server = _server()
    base = rf"http://127\.0\.0\.1:\d+/{re.escape(server.word)}/(\d+)/"
    for found in re.finditer(rf"{base}(\S*): (?!.*{base})", text):
        folder = server.folders[int(found[1])]
        url = file_url(folder.url, found[2])
        if reason := refused(url):
            return f"{url}: {reason}"
    return re.sub(base, lambda at: server.folders[int(at[1])].url, text)
