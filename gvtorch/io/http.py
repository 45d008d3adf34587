"""`read_http`: reads a file, or a part of it, over http or https, within bounds of size and time
whatever the server does. Connections are kept open and reused; proxies and redirections, which
lead to http and https alone, are left to urllib.
"""

from __future__ import annotations

import contextlib
import functools
import http.client
import io
import os
import re
import socket
import ssl
import string
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from typing import Any

from ..base.messages import one_line

STALL_SECONDS = 20.0  # seconds for which a server may send nothing
MIN_BYTES_PER_SECOND = 20_000  # that a server must send after its first STALL_SECONDS
REFUSED_SECONDS = 30.0  # seconds for which a file is not requested again after `Endless`
_MAX_REASONS = 1000  # errors that are remembered
_NOT_REFUSED = (0.0, "")
_refused: dict[str, tuple[float, str]] = {}  # by URL: until when it is refused, and why
_refused_lock = threading.Lock()  # held while it is changed
EXTRA_BYTES = 1 << 20  # bytes that any file may take in addition to what its content may take
_PART_BYTES = 1 << 16  # bytes
_SILENT_SECONDS = 1.0  # seconds without a byte after which `retry_refused` aborts a request
_MAX_IDLE = 16  # idle connections that are kept open to a server
REQUEST_HEADERS = {"Accept-Encoding": "identity", "User-Agent": "gvtorch"}
MISSING_STATUS = (404, 410)  # status codes for a file that does not exist
_REDIRECT_STATUS = (301, 302, 303, 307, 308)
_CLOSED_ERRORS = (http.client.RemoteDisconnected, BrokenPipeError, ConnectionResetError)


class Endless(OSError):
    """A file is larger than it may be, or may never end: its server stalls, or it is a pipe."""


class HttpStatus(OSError):
    """The server answered with an error.

    Attributes:
        status: The status code, such as 503.
    """

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(f"{status} {reason}")
        self.status = status


def is_http(root: object) -> bool:
    """Returns whether a folder is an http or https URL."""
    return isinstance(root, str) and root.startswith(("http://", "https://"))


def file_url(folder: str, name: str) -> str:
    """Returns the URL of a file in a folder; the folder's URL may end in a query."""
    base, question_mark, query = folder.partition("?")
    return f"{base.rstrip('/')}/{name}{question_mark}{query}"


def read_http(
    url: str,
    max_bytes: int,
    byte_range: slice | None = None,
    *,
    max_file_bytes: int | None = None,
    seconds: float = 1e9,
) -> bytes | None:
    """Returns the content of a file, or a part of its bytes; None if there is no such file.

    Args:
        url: The file.
        max_bytes: Largest number of bytes to return.
        byte_range: The range of bytes; a negative start counts from the end of the file.
        max_file_bytes: Largest size of the whole file, which a server without support for ranges
            sends instead of the part; None: `max_bytes`.
        seconds: Time limit.

    Raises:
        TimeoutError: It took longer than `seconds`.
        Endless: The server sends too much or too slowly, or did so less than `REFUSED_SECONDS`
            ago.
        HttpStatus: The server answers with an error.
        OSError: The server can't be reached, or breaks off.
    """
    refused_until, reason = _refused.get(url, _NOT_REFUSED)
    if time.monotonic() < refused_until:
        raise Endless(reason)
    max_seconds = STALL_SECONDS + max_bytes / MIN_BYTES_PER_SECOND
    deadline = time.monotonic() + min(seconds, max_seconds)
    max_file_bytes = max_bytes if max_file_bytes is None else max_file_bytes
    try:
        return _read(url, max_bytes, byte_range, max_file_bytes, deadline)
    except OSError as error:
        if isinstance(error, TimeoutError):
            if seconds < max_seconds and time.monotonic() >= deadline:
                raise
            error = Endless("the server sends hardly anything")
        keep_reason(url, error, REFUSED_SECONDS if isinstance(error, Endless) else 0.0)
        raise error from None


def keep_reason(url: str, error: OSError, seconds: float = 0.0) -> None:
    """Remembers why a file can't be read; `read_http` refuses it for the next `seconds`."""
    with _refused_lock:
        _refused[url] = time.monotonic() + seconds, str(error)
        while len(_refused) > _MAX_REASONS:
            del _refused[next(iter(_refused))]


def refused(url: str) -> str:
    """Returns why a file could not be read the last time, or ""."""
    return _refused.get(url, _NOT_REFUSED)[1]


def retry_refused() -> None:
    """Makes the next read of any file try again at once: no file is refused any longer, and
    requests that wait for a silent server are aborted.
    """
    with _refused_lock:
        _refused.clear()
    _connections.shut_down_silent(time.monotonic() - _SILENT_SECONDS)


def _read(
    url: str, max_bytes: int, byte_range: slice | None, max_file_bytes: int, deadline: float
) -> bytes | None:
    headers = dict(REQUEST_HEADERS)
    first = 0 if byte_range is None else byte_range.start or 0
    if byte_range is not None:
        last = "" if byte_range.stop is None else byte_range.stop - 1
        headers["Range"] = f"bytes={first}" if first < 0 else f"bytes={first}-{last}"
    try:
        connection, response = _send_request(url, headers, deadline)
    except TimeoutError:
        raise
    except HttpStatus as error:
        if error.status in MISSING_STATUS:
            return None
        raise
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise OSError(one_line(error)) from None
    is_complete = False
    try:
        if response.status in MISSING_STATUS:
            return None
        if response.status not in ((200,) if byte_range is None else (200, 206)):
            raise HttpStatus(response.status, response.reason)
        content_range = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
        if content_range and byte_range and int(content_range[1]) != first >= 0:
            raise OSError(f"another part came: {content_range[0]}")
        body_range = byte_range if response.status == 200 else None
        content = _read_content(url, response, max_bytes, body_range, max_file_bytes, connection)
        is_complete = response.isclosed()
        return content
    finally:
        keep = is_complete and not response.will_close
        if connection is None or not keep:
            response.close()
        if connection is not None:
            _connections.give_back(url, connection, keep=keep)


def _read_content(
    url: str,
    response: TimedResponse,
    max_bytes: int,
    body_range: slice | None,
    max_file_bytes: int,
    connection: http.client.HTTPConnection | None,
) -> bytes:
    """Reads to the end of a response, or to the end of `body_range`, the range to return of a whole
    file; bytes before that range are not kept in memory.
    """
    # `content` starts at byte `content_start` of the response's body.
    content, content_start, stream = bytearray(), 0, unpacked(url, response)
    start, stop = (body_range.start or 0, body_range.stop) if body_range is not None else (0, None)
    limit = max_bytes if body_range is None else max_file_bytes
    while stop is None or content_start + len(content) < stop:
        try:
            chunk = stream.read1(_PART_BYTES)
        except TimeoutError:
            raise
        except Exception as error:  # http.client has its own exceptions
            raise OSError(one_line(error)) from None
        if not chunk:
            break
        if connection is not None:
            _connections.note_activity(connection)
        content += chunk
        received = content_start + len(content)
        if received > limit and (stop is None or received < stop):
            raise Endless(f"the server sends more than {limit} bytes")
        unneeded = len(content) + start if start < 0 else min(start - content_start, len(content))
        if unneeded > _PART_BYTES or (start > content_start and unneeded > 0):
            del content[:unneeded]
            content_start += unneeded
    # `read1` ends without an error where a server breaks off.
    if response.length and (stop is None or content_start + len(content) < stop):
        raise OSError(f"cut off: {response.length} bytes are missing")
    end = None if stop is None else stop - content_start
    wanted = content[start:] if start < 0 else content[:end]
    if len(wanted) > max_bytes:
        raise Endless(f"the server sends more than {max_bytes} bytes")
    return bytes(wanted)


def unpacked(url: str, response: http.client.HTTPResponse) -> Any:
    """Returns a stream of a file as it was before its server packed it (gzip or deflate), which was
    not asked for. Parts of files are left as they are, and so are .gz files that were not packed
    again.
    """
    is_packed = response.headers.get("Content-Encoding") in ("gzip", "x-gzip", "deflate")
    if not is_packed or response.status == 206:
        return response
    from .packed import GZIP_MAGIC, ZlibStream, new_unpacker

    start = response.peek(1)
    if urllib.parse.urlsplit(url).path.endswith("gz"):
        start = new_unpacker().decompress(start, 2) if start.startswith(GZIP_MAGIC) else b""
    if not start.startswith((GZIP_MAGIC, b"x")):
        return response
    return io.BufferedReader(ZlibStream(response))


def is_forbidden(error: OSError) -> bool:
    """Returns whether a server refused a file: buckets that can't be listed say so of files that
    are not there.
    """
    return re.search(r"\b403 |PERMISSION_DENIED", str(error)) is not None


class TimedResponse(http.client.HTTPResponse):
    """An answer that is read until `deadline`, of time.monotonic: then whatever reads it, also its
    header, raises TimeoutError. http.client alone would wait forever for a server that sends a
    header a byte at a time, or "100 Continue" or lines behind the body without an end.
    """

    def __init__(self, *args: Any, deadline: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._timed = _TimedStream(self.fp.detach(), deadline)
        self.fp = io.BufferedReader(self._timed)

    def read_until(self, deadline: float) -> None:
        """Sets another deadline."""
        self._timed.deadline = deadline


class _TimedStream(io.RawIOBase):
    def __init__(self, stream: io.RawIOBase, deadline: float) -> None:
        self._stream, self.deadline = stream, deadline

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        if time.monotonic() > self.deadline:
            raise TimeoutError("the server sends hardly anything")
        return self._stream.readinto(buffer)

    def close(self) -> None:
        self._stream.close()
        super().close()


def _send_request(
    url: str, headers: dict[str, str], deadline: float
) -> tuple[http.client.HTTPConnection | None, TimedResponse]:
    """Returns a connection (None if it is urllib's), and the answer, whose body is not read yet."""
    url_parts = urllib.parse.urlsplit(_quoted(url))
    request_target = url_parts.path + (f"?{url_parts.query}" if url_parts.query else "")
    proxied = url_parts.scheme in urllib.request.getproxies()
    if proxied and not urllib.request.proxy_bypass(url_parts.hostname or ""):
        return None, ask_by_urllib(url, headers, deadline)
    while True:
        connection, is_reused = _connections.take(url, _stall_seconds(deadline))
        connection.response_class = _response_class(deadline)
        try:
            connection.request("GET", request_target, headers=headers)
            _connections.note_activity(connection)
            response: Any = connection.getresponse()
        except BaseException as error:
            _connections.give_back(url, connection, keep=False)
            if is_reused and isinstance(error, _CLOSED_ERRORS):
                continue  # the server has closed the idle connection
            raise
        if response.status not in _REDIRECT_STATUS:
            return connection, response
        response.close()
        _connections.give_back(url, connection, keep=False)
        return None, ask_by_urllib(url, headers, deadline)


def _stall_seconds(deadline: float) -> float:
    """Returns the seconds for which a connection may send nothing."""
    return max(1e-3, min(deadline - time.monotonic(), STALL_SECONDS))


def _response_class(deadline: float) -> Any:
    return functools.partial(TimedResponse, deadline=deadline)


def _quoted(url: str) -> str:
    """Returns a URL in which blanks and letters that are not ASCII are quoted."""
    parts = urllib.parse.urlsplit(url)
    path = urllib.parse.quote(parts.path or "/", "/%:@!$&'()*+,;=~")
    query = urllib.parse.quote(parts.query, string.punctuation)
    return urllib.parse.urlunsplit((parts.scheme, parts.netloc, path, query, ""))


class _TimedHttp(urllib.request.HTTPHandler, urllib.request.HTTPSHandler):
    """Opens http and https URLs with `TimedResponse`s."""

    def __init__(self, deadline: float) -> None:
        urllib.request.HTTPSHandler.__init__(self)
        self._deadline = deadline

    def do_open(self, http_class: Any, req: Any, **http_conn_args: Any) -> Any:
        def connect(host: str, **options: Any) -> Any:
            connection = http_class(host, **options)
            connection.response_class = _response_class(self._deadline)
            return connection

        return super().do_open(connect, req, **http_conn_args)


def ask_by_urllib(url: str, headers: dict[str, str], deadline: float) -> TimedResponse:
    """Sends a request through proxies and redirections; raises as `read_http`, except Endless."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        _TimedHttp(deadline),
        urllib.request.HTTPRedirectHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
        urllib.request.UnknownHandler(),
    ):
        opener.add_handler(handler)
    try:
        request = urllib.request.Request(_quoted(url), headers=headers)
        response: Any = opener.open(request, timeout=_stall_seconds(deadline))
    except urllib.error.HTTPError as error:
        error.close()
        raise HttpStatus(error.code, error.reason) from None
    except urllib.error.URLError as error:
        if isinstance(error.reason, TimeoutError):
            raise TimeoutError(str(error.reason)) from None
        raise OSError(str(error.reason)) from None
    except (http.client.HTTPException, ValueError) as error:  # no URL
        raise OSError(one_line(error)) from None
    assert isinstance(response, TimedResponse)
    return response


_certificates = functools.cache(ssl.create_default_context)


class _Connections:
    """This process's idle connections, by server, and those that wait for an answer."""

    def __init__(self) -> None:
        self._idle: dict[Any, list[http.client.HTTPConnection]] = {}
        self._waiting: dict[http.client.HTTPConnection, tuple[float, socket.socket]] = {}
        self._lock = threading.Lock()

    @staticmethod
    def _server_key(url: str) -> tuple[int, str, str]:
        url_parts = urllib.parse.urlsplit(url)
        return os.getpid(), url_parts.scheme, url_parts.netloc

    def take(self, url: str, seconds: float) -> tuple[http.client.HTTPConnection, bool]:
        """Returns a connection, and whether it was used before."""
        key = self._server_key(url)
        with self._lock:
            idle = self._idle.get(key)
            if idle:
                connection = idle.pop()
                if connection.sock is not None:
                    connection.sock.settimeout(seconds)
                    return connection, True
        if key[1] == "http":
            return http.client.HTTPConnection(key[2], timeout=seconds), False
        certificates = _certificates()
        return http.client.HTTPSConnection(key[2], timeout=seconds, context=certificates), False

    def note_activity(self, connection: http.client.HTTPConnection) -> None:
        """Records that a connection waits from now on for an answer, or for more of one."""
        with self._lock:
            sock = connection.sock or self._waiting[connection][1]
            self._waiting[connection] = time.monotonic(), sock

    def shut_down_silent(self, before: float) -> None:
        """Shuts down connections that have sent nothing since `before`: reading from them fails."""
        with self._lock:
            silent = [sock for since, sock in self._waiting.values() if since < before]
        for sock in silent:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def give_back(self, url: str, connection: http.client.HTTPConnection, *, keep: bool) -> None:
        """Ends a connection's wait; keeps it open if `keep` and few are idle, else closes it."""
        with self._lock:
            self._waiting.pop(connection, None)
            idle = self._idle.setdefault(self._server_key(url), [])
            if keep and len(idle) < _MAX_IDLE:
                idle.append(connection)
                return
        connection.close()


_connections = _Connections()
