"""An HTTP server that answers many requests at once, without delays."""

from __future__ import annotations

from http.server import ThreadingHTTPServer


class WebServer(ThreadingHTTPServer):
    """With a longer queue, the sixth simultaneous connection need not retry after a second; with a
    shorter poll, a shutdown is noticed at once, not within half a second.
    """

    daemon_threads = True
    request_queue_size = 128

    def serve_forever(self, poll_interval: float = 0.01) -> None:
        super().serve_forever(poll_interval)
