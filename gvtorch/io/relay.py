"""`relay_folder`: lets tensorstore read the folder at a URL by way of a relay, a server in this
process.

tensorstore accepts whatever a server sends, for however long. So it asks the relay instead, on
127.0.0.1 and under a secret path. The relay reads the file, or the part of it, with `read_http`
(from s3:// and gs:// with `read_within`) and answers once it has all of it; it refuses files that
are longer than a chunk can be, and servers that stall or send too slowly.
"""

from __future__ import annotations

import functools
import hmac
import http.server
import operator
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
    EXTRA_BYTES,
    MIN_BYTES_PER_SECOND,
    STALL_SECONDS,
    Endless,
    HttpStatus,
    file_url,
    is_forbidden,
    is_http,
    keep_reason,
    read_http,
    refused,
)

if TYPE_CHECKING:  # not at run time: `gvtorch --help` imports this module
    import numpy as np

    from .stores.chunk_files import ChunkFiles

_MAX_JOINED_BYTES = 1 << 27  # bytes of parts that tensorstore joins in one request
_MAX_METADATA_BYTES = 1 << 24  # bytes of a file of metadata
_INDEX_CACHE_BYTES = 1 << 26  # bytes of shards' indexes that are cached for a folder
_NO_BYTES = slice(0, 0)  # what "bytes=-0" asks for
_RETRIES = {"max_retries": 4, "initial_delay": "200ms", "max_delay": "1s"}
_BLOCKS = "/gvtorch/blocks/"  # in the URLs of arrays of which files may be missing
_UNSATISFIABLE = 416  # status code for a range with no byte of the file
_MAX_CONCURRENT = 16  # concurrent requests for one folder


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
            "http_request_concurrency": {"limit": _MAX_CONCURRENT},
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

    def read(self, name: str, byte_range: slice | None) -> bytes | None:
        """Returns a file, or a part of it; raises as `read_http`."""
        from .stores.chunk_files import METADATA_FILES

        url = file_url(self.url, name)
        try:
            files = None if name.endswith(METADATA_FILES) else self.files
            content = self._read(name, byte_range, files)
            if files is not None and content is not None:
                self._check_content(name, byte_range, content, files)
        except OSError as error:
            if is_forbidden(error) and _BLOCKS in url:
                return None  # the store finds out whether it should be there
            keep_reason(url, error)
            raise
        return content

    def _read(self, name: str, byte_range: slice | None, files: ChunkFiles | None) -> bytes | None:
        """Reads a file, or a part of it that is not larger than what tensorstore may ask for."""
        max_file_bytes = max_part_bytes = max_bytes = _MAX_METADATA_BYTES
        if files is not None:
            max_file_bytes = max_bytes = files.max_bytes
            joined_bytes = 2 * files.chunk_bytes + EXTRA_BYTES + _MAX_JOINED_BYTES
            max_part_bytes = min(max(joined_bytes, files.index_bytes), max_file_bytes)
        if byte_range is not None:
            max_bytes = range_bytes(byte_range, max_part_bytes)
            if not 0 < max_bytes <= max_part_bytes:
                raise Endless(f"{max_bytes} bytes are asked for, more than a chunk has")
        url = file_url(self.url, name)
        if is_http(url):
            return read_http(url, max_bytes, byte_range, max_file_bytes=max_file_bytes)
        return self._read_bucket(urllib.parse.unquote(name), byte_range, max_bytes)

    def _check_content(
        self, name: str, byte_range: slice | None, content: bytes, files: ChunkFiles
    ) -> None:
        """Caches the content if it is a shard's index; else raises Endless if it holds a chunk that
        Blosc would unpack to too many bytes.
        """
        index_range, entries = files.index_part, None
        if files.index and byte_range == index_range:
            with self._lock:
                self._indexes[name] = files.entries(content)
                while len(self._indexes) > max(1, _INDEX_CACHE_BYTES // files.index_bytes):
                    self._indexes.popitem(last=False)
            return
        if files.index and byte_range is None:
            entries = files.entries(content[index_range])
        elif files.index:
            with self._lock:
                entries = self._indexes.get(name)
            if entries is None:  # it was evicted from the cache
                entries = files.entries(self._read(name, index_range, files) or b"")
        files.check_sent(byte_range.start if byte_range else 0, content, entries)

    def _read_bucket(self, name: str, byte_range: slice | None, max_bytes: int) -> bytes | None:
        seconds = STALL_SECONDS + max_bytes / MIN_BYTES_PER_SECOND
        try:
            wait = operator.methodcaller("result", timeout=seconds)
            return read_within(self._bucket, name, byte_range, max_bytes, wait)
        except TimeoutError:
            raise Endless("the server sends hardly anything") from None
        except OSError:
            raise
        except Exception as error:  # tensorstore raises what its status maps to
            is_open = byte_range is not None and byte_range.stop is None and byte_range.start >= 0
            if is_open and "OUT_OF_RANGE" in str(error):
                raise HttpStatus(_UNSATISFIABLE, "the file ends before the range") from None
            raise OSError(one_line(error)) from None

    @functools.cached_property
    def _bucket(self) -> Any:
        import tensorstore as ts

        return ts.KvStore.open(self.url, context=self._context).result(timeout=STALL_SECONDS)


def range_bytes(byte_range: slice, default: int) -> int:
    """Returns how many bytes a range has; `default` if it has no end."""
    start, stop = byte_range.start or 0, byte_range.stop
    return stop - start if stop is not None else -start if start < 0 else default


def read_within(
    folder: Any, name: str, byte_range: slice | None, max_bytes: int, wait: Callable[[Any], Any]
) -> bytes | None:
    """Returns the content of a file in a key-value store of tensorstore, or a part of it; None if
    there is no such file. Before a whole file is read, or all from a byte on, the byte after
    `max_bytes` is requested.

    Raises:
        Endless: There are more than `max_bytes` bytes.
        Exception: What `wait` raises, a function that returns a future's result.
    """
    start = 0 if byte_range is None else byte_range.start or 0
    if byte_range is None or (byte_range.stop is None and start >= 0):
        end = start + max_bytes
        try:
            if wait(folder.read(name, byte_range=slice(end, end + 1))).state != "value":
                return None
        except Exception as error:
            if "OUT_OF_RANGE" not in str(error):
                raise
        else:
            raise Endless(f"the file is more than {end} bytes")
    result = wait(folder.read(name, byte_range=byte_range))
    return bytes(result.value) if result.state == "value" else None


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.secret = secrets.token_urlsafe(16)
        # By number, which is part of the address; kept, because arrays that are open use it.
        self.folders: list[Relayed] = []
        threading.Thread(target=self.serve_forever, daemon=True, name="gvtorch-relay").start()

    def handle_error(self, *_: object) -> None:
        """Prints nothing: errors are normal when tensorstore gives up a request."""


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"  # keeps connections open
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        path_match = re.fullmatch(r"/([\w-]+)/(\d{1,9})/(.+)", self.path, re.ASCII)
        if (
            path_match is None
            or not hmac.compare_digest(path_match[1], self.server.secret)
            or int(path_match[2]) >= len(self.server.folders)
        ):
            self._respond(403)
            return
        byte_range = _parse_range(self.headers.get("Range", ""))
        if byte_range == _NO_BYTES:
            self._respond(_UNSATISFIABLE)
            return
        folder, name = self.server.folders[int(path_match[2])], path_match[3]
        content: bytes | None = None
        try:
            content = folder.read(name, byte_range)
            status = 404 if content is None else 200 if byte_range is None else 206
            if status == 206 and not content:
                status = _UNSATISFIABLE
        except Endless:
            status = 403
        except HttpStatus as error:
            status = error.status
        except OSError:  # tensorstore tries again for a while
            status = 503
        self._respond(status, content or b"", byte_range)

    def _respond(self, status: int, content: bytes = b"", byte_range: slice | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        if byte_range is not None and status == 206:
            # The file's size is unknown here, and with it the position of its last bytes; for these
            # this says 0, which tensorstore, the only client, accepts.
            begin = max(byte_range.start, 0)
            self.send_header("Content-Range", f"bytes {begin}-{begin + len(content) - 1}/*")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Prints nothing."""


def _parse_range(text: str) -> slice | None:
    """Returns the bytes that a Range header asks for; None if it is to be ignored: if it is empty,
    invalid, or asks for several ranges. Source: RFC 9110, HTTP Semantics, section 14.
    """
    match = re.fullmatch(r"bytes=(\d{0,18})-(\d{0,18})", text, re.ASCII)
    if match is None or not any(match.groups()):
        return None
    first, last = match.groups()
    if not first:
        return slice(-int(last), None) if int(last) else _NO_BYTES
    if not last:
        return slice(int(first), None)
    return slice(int(first), int(last) + 1) if int(first) <= int(last) else None


@functools.cache
def _server() -> _Server:
    has_proxy = any(key.lower().endswith("_proxy") for key in os.environ)
    for name in ("no_proxy", "NO_PROXY"):  # libcurl would ask a proxy even for this machine
        no_proxy = os.environ.get(name, "")
        if has_proxy and "127.0.0.1" not in no_proxy:
            os.environ[name] = f"{no_proxy},127.0.0.1".lstrip(",")
    return _Server()


_starting = threading.Lock()


def relay_folder(url: str, context: Any = None) -> Relayed:
    """Returns the relayed folder of a URL, the same one for the same URL; `context` is
    tensorstore's, for s3:// and gs://.
    """
    with _starting:
        server = _server()
        for folder in server.folders:
            if folder.url == url:
                return folder
        base = f"http://127.0.0.1:{server.server_port}/{server.secret}/{len(server.folders)}/"
        server.folders.append(Relayed(url, base, context))
        return server.folders[-1]


def with_urls(text: str) -> str:
    """Replaces the relay's addresses in a message by the original URLs; if a file was refused,
    returns its URL and the reason instead.
    """
    if not _server.cache_info().currsize:
        return text
    server = _server()
    base = rf"http://127\.0\.0\.1:\d+/{re.escape(server.secret)}/(\d+)/"
    for match in re.finditer(rf"{base}(\S*): (?!.*{base})", text):
        folder = server.folders[int(match[1])]
        url = file_url(folder.url, match[2])
        if reason := refused(url):
            return f"{url}: {reason}"
    return re.sub(base, lambda match: server.folders[int(match[1])].url, text)
