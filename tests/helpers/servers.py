"""A server of HTTP that answers many at once, without a wait of its own."""

from __future__ import annotations

from http.server import ThreadingHTTPServer


class WebServer(ThreadingHTTPServer):
    """The sixth of connections that come at once is not left to knock again after a second, and an
    end is seen at once, not within half a second.
    """

    daemon_threads = True
    request_queue_size = 128

    def serve_forever(self, poll_interval: float = 0.01) -> None:
        super().serve_forever(poll_interval)
