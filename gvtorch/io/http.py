"""`read_http`: reads a file, or a part of it, over http or https, within bounds of size and time
whatever the server does. Connections are kept open and reused; proxies and redirections are left to
urllib.
"""

from __future__ import annotations

import contextlib
import functools
import http.client
import os
import re
import socket
import ssl
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from typing import Any

from ..base.messages import one_line

STALL = 20.0  # seconds for which a server may send nothing
SLOWEST = 20_000  # bytes a second that a server must send after its first STALL seconds
REFUSED = 30.0  # seconds for which a file is not requested again after `Endless`
_REASONS = 1000  # errors that are remembered
_NOT = (0.0, "")
_refused: dict[str, tuple[float, str]] = {}  # by URL: until when it is refused, and why
SMALL = 1 << 20  # bytes that any file may take in addition to what its content may take
_PART = 1 << 16  # bytes
_SILENT = 1.0  # seconds without a byte after which `ask_again` aborts a request
_KEPT = 16  # idle connections that are kept open to a server
AGENT = {"Accept-Encoding": "identity", "User-Agent": "gvtorch"}
MISSING = (404, 410)  # status codes for a file that does not exist
_ELSEWHERE = (301, 302, 303, 307, 308)
_CLOSED = (http.client.RemoteDisconnected, BrokenPipeError, ConnectionResetError)


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
    base, mark, query = folder.partition("?")
    return f"{base.rstrip('/')}/{name}{mark}{query}"


def read_http(
    url: str,
    most: int,
    part: slice | None = None,
    *,
    whole: int | None = None,
    seconds: float = 1e9,
) -> bytes | None:
    """Returns the content of a file, or a part of its bytes; None if there is no such file.

    Args:
        url: The file.
        most: Largest number of bytes to return.
        part: The range of bytes; a negative start counts from the end of the file.
        whole: Largest size in bytes of the whole file, which a server without support for ranges
            sends instead of the part; None: `most`.
        seconds: Time limit.

    Raises:
        TimeoutError: It took longer than `seconds`.
        Endless: The server sends too much or too slowly, or did so less than `REFUSED` s ago.
        HttpStatus: The server answers with an error.
        OSError: The server can't be reached, or breaks off.
    """
    if time.monotonic() < _refused.get(url, _NOT)[0]:
        raise Endless(_refused[url][1])
    slow = STALL + most / SLOWEST
    end = time.monotonic() + min(seconds, slow)
    try:
        return _read(url, most, part, most if whole is None else whole, end)
    except TimeoutError:
        if seconds < slow and time.monotonic() >= end:
            raise
        found: OSError = Endless("the server sends hardly anything")
    except OSError as error:
        found = error
    keep_reason(url, found, REFUSED if isinstance(found, Endless) else 0.0)
    try:
        raise found from None
    finally:
        del found  # its traceback holds this frame, and what was read


def keep_reason(url: str, error: OSError, seconds: float = 0.0) -> None:
    """Remembers why a file can't be read; `read_http` refuses it for the next `seconds`."""
    _refused[url] = time.monotonic() + seconds, str(error)
    while len(_refused) > _REASONS:
        _refused.pop(next(iter(_refused)), None)


def refused(url: str) -> str:
    """Returns why a file could not be read the last time, or ""."""
    return _refused.get(url, _NOT)[1]


def ask_again() -> None:
    """Makes the next read of any file try again at once: no file is refused any longer, and
    requests that wait for a silent server are aborted.
    """
    _refused.clear()
    _connections.break_off(time.monotonic() - _SILENT)


def _read(url: str, most: int, part: slice | None, whole: int, end: float) -> bytes | None:
    headers = dict(AGENT)
    if part is not None:
        first, last = part.start or 0, "" if part.stop is None else part.stop - 1
        headers["Range"] = f"bytes={first}" if first < 0 else f"bytes={first}-{last}"
    patience = max(1e-3, min(end - time.monotonic(), STALL))
    try:
        connection, answer = _ask(url, headers, patience)
    except TimeoutError:
        raise
    except HttpStatus as error:
        if error.status in MISSING:
            return None
        raise
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise OSError(one_line(error)) from None
    done = False
    try:
        if answer.status in MISSING:
            return None
        if answer.status not in (200, 206):
            raise HttpStatus(answer.status, answer.reason)
        sent = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range", ""))
        if sent and part and (part.start or 0) >= 0 and int(sent[1]) != (part.start or 0):
            raise OSError(f"another part came: {sent[0]}")
        cut = part if answer.status == 200 else None
        content = _content(answer, end, most, cut, whole, connection)
        done = answer.isclosed()
        return content
    finally:
        keep = done and not answer.will_close
        if connection is None or not keep:
            answer.close()
        if connection is not None:
            _connections.give_back(url, connection, keep=keep)


def _content(
    answer: http.client.HTTPResponse,
    end: float,
    most: int,
    cut: slice | None,
    whole: int,
    connection: http.client.HTTPConnection | None,
) -> bytes:
    """Reads to the end of an answer, or to the end of `cut`, the range to return of a whole file;
    bytes before that range are not kept in memory.
    """
    content, begin = bytearray(), 0  # `content` starts at byte `begin` of the answer
    first, last = (cut.start or 0, cut.stop) if cut is not None else (0, None)
    limit = most if cut is None else whole
    while last is None or begin + len(content) < last:
        if time.monotonic() > end:
            raise TimeoutError
        try:
            more = answer.read1(_PART)
        except TimeoutError:
            raise
        except Exception as error:  # http.client has its own exceptions
            raise OSError(one_line(error)) from None
        if not more:
            break
        if connection is not None:
            _connections.heard(connection)
        content += more
        got = begin + len(content)
        if got > limit and (last is None or got < last):
            raise Endless(f"the server sends more than {limit} bytes")
        useless = len(content) + first if first < 0 else min(first - begin, len(content))
        if useless > _PART or (first > begin and useless > 0):
            del content[:useless]
            begin += useless
    # `read1` ends without an error where a server breaks off.
    if answer.length and (last is None or begin + len(content) < last):
        raise OSError(f"cut off: {answer.length} bytes are missing")
    found = content[first:] if first < 0 else content[: None if last is None else last - begin]
    if len(found) > most:
        raise Endless(f"the server sends more than {most} bytes")
    return bytes(found)


def _ask(
    url: str, headers: dict[str, str], seconds: float
) -> tuple[http.client.HTTPConnection | None, http.client.HTTPResponse]:
    """Sends a request; returns the connection (None if it is urllib's) and the answer, whose body
    is not read yet.
    """
    place = urllib.parse.urlsplit(url)
    target = urllib.parse.quote(place.path or "/", safe="/%:@!$&'()*+,;=~")
    target += f"?{place.query}" if place.query else ""
    proxied = place.scheme in urllib.request.getproxies()
    if proxied and not urllib.request.proxy_bypass(place.hostname or ""):
        return None, ask_by_urllib(url, headers, seconds)
    while True:
        connection, used = _connections.take(url, seconds)
        try:
            connection.request("GET", target, headers=headers)
            _connections.heard(connection)
            answer = connection.getresponse()
            if answer.status not in _ELSEWHERE:
                return connection, answer
            answer.close()
        except BaseException as error:
            _connections.give_back(url, connection, keep=False)
            if used and isinstance(error, _CLOSED):
                continue  # the server has closed the idle connection
            raise
        _connections.give_back(url, connection, keep=False)
        return None, ask_by_urllib(url, headers, seconds)


def ask_by_urllib(url: str, headers: dict[str, str], seconds: float) -> http.client.HTTPResponse:
    """Sends a request through proxies and redirections; raises as `read_http`, except Endless."""
    request = urllib.request.Request(url, headers=headers)
    try:
        found: http.client.HTTPResponse = urllib.request.urlopen(request, timeout=seconds)
    except urllib.error.HTTPError as error:
        error.close()
        raise HttpStatus(error.code, error.reason) from None
    except urllib.error.URLError as error:
        if isinstance(error.reason, TimeoutError):
            raise TimeoutError(str(error.reason)) from None
        raise OSError(str(error.reason)) from None
    return found


_certificates = functools.cache(ssl.create_default_context)


class _Connections:
    """This process's idle connections, by server, and those that wait for an answer."""

    def __init__(self) -> None:
        self._idle: dict[Any, list[http.client.HTTPConnection]] = {}
        self._waiting: dict[http.client.HTTPConnection, tuple[float, socket.socket]] = {}
        self._lock = threading.Lock()

    @staticmethod
    def _key(url: str) -> tuple[int, str, str]:
        place = urllib.parse.urlsplit(url)
        return os.getpid(), place.scheme, place.netloc

    def take(self, url: str, seconds: float) -> tuple[http.client.HTTPConnection, bool]:
        """Returns a connection, and whether it was used before."""
        key = self._key(url)
        with self._lock:
            idle = self._idle.get(key)
            if idle:
                connection = idle.pop()
                if connection.sock is not None:
                    connection.sock.settimeout(seconds)
                    return connection, True
        if key[1] == "https":
            safe = http.client.HTTPSConnection(key[2], timeout=seconds, context=_certificates())
            return safe, False
        return http.client.HTTPConnection(key[2], timeout=seconds), False

    def heard(self, connection: http.client.HTTPConnection) -> None:
        """Records that a connection waits from now on for an answer, or for more of one."""
        with self._lock:
            sock = connection.sock or self._waiting[connection][1]
            self._waiting[connection] = time.monotonic(), sock

    def break_off(self, before: float) -> None:
        """Shuts down connections that were silent since `before`; reading from them fails."""
        with self._lock:
            silent = [sock for since, sock in self._waiting.values() if since < before]
        for sock in silent:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def give_back(self, url: str, connection: http.client.HTTPConnection, *, keep: bool) -> None:
        """Ends a connection's wait; keeps it open if `keep` and few are idle, else closes it."""
        with self._lock:
            self._waiting.pop(connection, None)
            idle = self._idle.setdefault(self._key(url), [])
            if keep and len(idle) < _KEPT:
                idle.append(connection)
                return
        connection.close()


_connections = _Connections()
