"""A headless browser: Chromium of the system, driven by playwright."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gvtorch.bench.browser import chromium_path, running_chromium, why_no_browser

from . import slowness
from .viewer import TIMEOUT

__all__ = ["Tab", "chromium_path", "running_chromium", "why_no_browser"]


class Tab:
    """A page in the browser, its errors and warnings (`complaints`), and its requests."""

    def __init__(self, browser: Any, url: str, **options: Any) -> None:
        options = {"viewport": {"width": 1000, "height": 420}, **options}
        self.context = browser.new_context(**options)
        self.context.set_default_timeout(1e3 * TIMEOUT)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", self._said)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.page.goto(url)

    def _said(self, message: Any) -> None:
        from_pixels = "willReadFrequently" in message.text  # `pixels` does
        if message.type in ("error", "warning") and not from_pixels:
            self.complaints.append(message.text)

    def app(self, script: str) -> Any:
        """Returns the value of an expression of the page's `app`."""
        return self.page.evaluate(
            f"() => {{ const app = document.querySelector('.gv').app; return {script}; }}"
        )

    def until(self, condition: str | Callable[[], Any], timeout: float = TIMEOUT) -> Any:
        """Waits until an expression of `app`, or a function, is true."""
        end = time.monotonic() + timeout
        while True:
            result = self.app(condition) if isinstance(condition, str) else condition()
            if result:
                return result
            assert time.monotonic() < end, f"it never came: {condition}; {self.complaints}"
            self.page.wait_for_timeout(30)

    def pause(self, milliseconds: float) -> None:
        """Lets the page do what it does within this time, on a machine that is not busy."""
        self.page.wait_for_timeout(milliseconds * slowness())

    def final(self) -> np.ndarray:
        """Waits for the final picture of all changes so far; returns (h, w, 3) uint8."""
        self.until("!!app && !app.stateBefore && !app.frameRequest && app.view.head?.final")
        return self.pixels()

    def pixels(self) -> np.ndarray:
        """Returns the canvas as (h, w, 3) uint8."""
        size, data = self.page.evaluate(
            """() => {
              const c = document.querySelector(".gv-picture");
              const all = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
              let text = "";
              for (let n = 0; n < all.length; n += 8192) {
                text += String.fromCharCode(...all.subarray(n, n + 8192));
              }
              return [[c.height, c.width], btoa(text)];
            }"""
        )
        return np.frombuffer(base64.b64decode(data), np.uint8).reshape(*size, 4)[..., :3]

    def drag(self, start: tuple[float, float], end: tuple[float, float], **options: Any) -> None:
        """Moves the pressed mouse in a few steps."""
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down(**options)
        mouse.move(*end, steps=6)
        mouse.up(**options)

    def open(self, section: str) -> None:
        """Opens a section of the panel."""
        details = self.page.locator(f"details:has(> summary:text-is('{section}'))")
        if details.get_attribute("open") is None:
            details.locator("summary").first.click()

    def close(self) -> None:
        self.context.close()
