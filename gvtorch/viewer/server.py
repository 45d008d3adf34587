"""`Server`: serves a session's page over HTTP and a websocket for each page, in its own thread
(aiohttp).

Only the page's files of this package are served, by name. A websocket needs the token in its
address, a page of this server (Origin) and a name of this machine (Host), so that a page of another
site is refused even if that site's name is made to point here (DNS rebinding).
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import logging
import secrets
import socket
import threading
from collections.abc import Iterable
from concurrent.futures import Future
from functools import partial
from importlib import resources
from typing import Any
from urllib.parse import urlencode, urlsplit

from ..base import check
from ..base.messages import need_library
from .protocol import MAX_MESSAGE_BYTES
from .session import Session

_CONTENT_TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
_MAX_QUEUED = 2**26  # bytes that may wait for a page, if they are not of one message
_MIN_COUNTED = 2**14  # bytes that the smallest message counts as: what holds it takes memory too
_LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")


def page_files() -> dict[str, bytes]:
    """Returns the files of the page by name."""
    folder = resources.files(__package__) / "page"
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def aiohttp_web() -> Any:
    """Imports aiohttp.web; raises ImportError, which says what to install, if it can't be used."""
    need_library("view", "PIL", "Pillow", "view")
    return need_library("view", "aiohttp.web", "aiohttp", "view")


def _is_worth_logging(record: logging.LogRecord) -> bool:
    """Returns whether a log record of aiohttp is worth showing: not one of a malformed request."""
    error = record.exc_info[1] if record.exc_info else None
    return type(error).__module__ != "aiohttp.http_exceptions"


class _Outbox:
    """The messages that wait to be sent to a page; one that does not keep up gets no more."""

    def __init__(self) -> None:
        self._messages: asyncio.Queue[str | bytes | None] = asyncio.Queue()
        self._queued = 0  # bytes
        self._given_up = False

    def put(self, data: str | bytes) -> None:
        if self._given_up:
            return
        size = max(len(data), _MIN_COUNTED)
        self._given_up = self._queued > 0 and self._queued + size > _MAX_QUEUED
        self._queued += size
        self._messages.put_nowait(None if self._given_up else data)

    async def get(self) -> str | bytes | None:
        """Waits for a message; returns None once the page is to be disconnected."""
        data = await self._messages.get()
        self._queued -= max(len(data), _MIN_COUNTED) if data is not None else 0
        return data


class Server:
    """The server of a session's page.

    Attributes:
        url: The page's address, with the token.
        port: The page's port.
    """

    def __init__(
        self,
        session: Session,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        allow: Iterable[str] = (),
    ) -> None:
        """Starts to serve; for the arguments see `view`. A token "" means none, which is allowed if
        only this machine can reach the host.

        Raises:
            ValueError: The host needs a token, or an argument is of another type.
            OSError: The port is taken, or the host is not this machine's.
            ImportError: aiohttp is missing.
        """
        self._session, self._host = session, check.instance("view", "host", host, str)
        token = check.text("view", "token", token)
        self.token = secrets.token_urlsafe(18) if token is None else token
        if not self.token and host not in _LOCAL_HOSTS:
            raise ValueError(f"view: a token is needed where others reach {host!r}")
        if isinstance(allow, str):
            raise ValueError(f"view: allow must be a list of names, got {allow!r}")
        names = [*_LOCAL_HOSTS, host, *allow]
        if host not in _LOCAL_HOSTS:
            names += [socket.gethostname(), socket.getfqdn()]
        self._allowed_hosts = {name.lower() for name in names}  # as `is_allowed` compares them
        self.port = port
        self._web, self._files = aiohttp_web(), page_files()
        self._sockets: set[Any] = set()
        self._loop, started = asyncio.new_event_loop(), Future[None]()
        self._thread = threading.Thread(
            target=self._run, args=(started,), name="gvtorch view server", daemon=True
        )
        self._thread.start()
        started.result()

    @property
    def url(self) -> str:
        """The page's address."""
        anywhere = self._host in ("0.0.0.0", "::")
        host = socket.gethostname() if anywhere else self._host
        host = f"[{host}]" if ":" in host else host
        query = f"?{urlencode({'token': self.token})}" if self.token else ""
        return f"http://{host}:{self.port}/{query}"

    def close(self) -> None:
        if self._loop.is_running():
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(timeout=10)

    def _run(self, started: Future[None]) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve(started))
        except BaseException as error:
            if not started.done():
                started.set_exception(error)
        finally:
            self._loop.close()
            del self._session  # aiohttp's reference cycles would keep it and its pools a while

    async def _serve(self, started: Future[None]) -> None:
        self._stop = asyncio.Event()
        logger = logging.getLogger("gvtorch.view")
        logger.addFilter(_is_worth_logging)
        runner = self._web.AppRunner(
            self._application(), shutdown_timeout=1.0, access_log=None, logger=logger
        )
        await runner.setup()
        try:
            await self._web.TCPSite(runner, self._host, self.port).start()
            self.port = runner.addresses[0][1]
            started.set_result(None)
            await self._stop.wait()
        finally:
            await runner.cleanup()

    def _application(self) -> Any:
        guard = partial(self._guard_request)  # aiohttp marks it, which a method does not allow
        app = self._web.Application(middlewares=[self._web.middleware(guard)])
        app.router.add_get("/", self._serve_page)
        app.router.add_get("/ws", self._serve_socket)
        app.router.add_get("/{name}", self._serve_page)
        app.on_response_prepare.append(self._add_headers)
        app.on_shutdown.append(self._close_sockets)
        return app

    async def _close_sockets(self, _app: Any) -> None:
        for ws in list(self._sockets):
            await ws.close(code=1001, message=b"the view was closed")

    def is_allowed(self, host: str | None) -> bool:
        """Returns whether a page may reach this server under the name of its Host header."""
        name = (urlsplit(f"//{host or ''}").hostname or "").rstrip(".")
        if name in self._allowed_hosts:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return self._host not in _LOCAL_HOSTS  # an address can't be rebound

    async def _guard_request(self, request: Any, handler: Any) -> Any:
        """Refuses foreign hosts."""
        try:
            if not self.is_allowed(request.headers.get("Host")):
                raise self._web.HTTPForbidden(text="This name is not the viewer's.")
            return await handler(request)
        except ValueError:
            raise self._web.HTTPBadRequest(text="No such address.") from None

    async def _add_headers(self, _request: Any, response: Any) -> None:
        """Adds the headers that isolate the page from other sites, to errors as well."""
        response.headers.update(_HEADERS)

    async def _serve_page(self, request: Any) -> Any:
        name = request.match_info.get("name", "index.html")
        if name not in self._files:
            raise self._web.HTTPNotFound(text="There is no such page.")
        kind = _CONTENT_TYPES.get(f".{name.rpartition('.')[2]}", "application/octet-stream")
        return self._web.Response(body=self._files[name], content_type=kind, charset="utf-8")

    def _is_authorized(self, request: Any) -> bool:
        origin = request.headers.get("Origin")
        same_origin = origin is None or urlsplit(origin).netloc == request.headers.get("Host")
        token = request.query.get("token", "")
        return same_origin and hmac.compare_digest(token.encode(), self.token.encode())

    async def _serve_socket(self, request: Any) -> Any:
        web = self._web
        if not self._is_authorized(request):
            raise web.HTTPForbidden(text="The address needs the token that the viewer told.")
        ws = web.WebSocketResponse(max_msg_size=MAX_MESSAGE_BYTES, heartbeat=30, compress=False)
        await ws.prepare(request)
        self._sockets.add(ws)
        outbox = _Outbox()
        loop = asyncio.get_running_loop()

        def send(data: str | bytes) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(outbox.put, data)

        async def send_queued() -> None:
            while (data := await outbox.get()) is not None:
                await (ws.send_str(data) if isinstance(data, str) else ws.send_bytes(data))
            await ws.close(code=1008, message=b"too slow")

        client = self._session.join(send)
        task = asyncio.ensure_future(send_queued())
        try:
            async for message in ws:
                if message.type in (web.WSMsgType.TEXT, web.WSMsgType.BINARY):
                    self._session.receive(client, message.data)
        finally:
            self._session.leave(client)
            self._sockets.discard(ws)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        return ws
