"""Drags the mouse in a browser, and measures when the page shows the result.

Every page is measured alike: playwright moves the mouse in a headless Chromium, and in each frame
of the browser a script in the page stores a thumbnail of the picture if it has changed. Times
therefore run from a pointer event to pixels in the page, exact to one frame of the browser.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import shutil
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

_PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_MOVE_INTERVAL = 1 / 60  # seconds between two moves of the mouse
_REST_SECONDS = 3.0  # seconds without a change, after which a new page is at rest
_TIMEOUT = 60.0  # seconds within which a page must come to rest
_THUMBNAIL_SIZE = (48, 27)

#: Stores [milliseconds, thumbnail] of each picture that differs from the one before, and the time
#: of the last move. WebGL must preserve its drawing buffer, because it is read later.
_PROBE = """
(() => {
  const getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (type, options) {
    if (type.startsWith("webgl")) options = { ...options, preserveDrawingBuffer: true };
    return getContext.call(this, type, options);
  };
  const probe = (window.gvProbe = { log: [], movedAt: 0, on: false });
  addEventListener("pointermove", () => { probe.movedAt = performance.now(); }, true);
  const thumbnail = document.createElement("canvas");
  [thumbnail.width, thumbnail.height] = SIZE;
  const context = getContext.call(thumbnail, "2d", { willReadFrequently: true });
  context.imageSmoothingEnabled = false;
  let previous = "";
  const capture = () => {
    requestAnimationFrame(capture);
    if (!probe.on) return;
    context.clearRect(0, 0, thumbnail.width, thumbnail.height);
    for (const element of document.querySelectorAll(SELECTOR)) {
      const { width, height } = element.getBoundingClientRect();
      const small = width * height < 0.2 * innerWidth * innerHeight;
      if (small || !(element.naturalWidth ?? element.width)) continue;
      context.drawImage(element, 0, 0, thumbnail.width, thumbnail.height);
    }
    const { data } = context.getImageData(0, 0, thumbnail.width, thumbnail.height);
    const green = Array.from({ length: data.length / 4 }, (_, n) => data[4 * n + 1]);
    const joined = green.join();
    const changed = joined !== previous && new Set(green).size > 1;
    if (changed) probe.log.push([performance.now(), green]);
    previous = joined;
  };
  requestAnimationFrame(capture);
})();
"""


def why_no_browser() -> str:
    """Returns why no browser can run here; an empty string if one can."""
    if importlib.util.find_spec("playwright") is None:
        return "playwright is not installed"
    return "" if chromium_path() else f"none of {', '.join(_PROGRAMS)} is on the path"


def chromium_path() -> str | None:
    """Returns the path of Chromium; None if there is none."""
    return next(filter(None, map(shutil.which, _PROGRAMS)), None)


@contextlib.contextmanager
def running_chromium() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        flags = ["--no-sandbox", "--disable-dev-shm-usage"]
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=flags)
        yield browser
        browser.close()


class DragResult(NamedTuple):
    """What was measured while the mouse dragged."""

    delays: list[float]  # milliseconds from each jump to the first picture that shows it
    rate: float  # pictures a second during the long drag


class Page:
    """A page in the browser, its picture of a given size, and the mouse that drags in it."""

    def __init__(self, browser: Any, url: str, selector: str, size: tuple[int, int]) -> None:
        """Opens the page, and waits until its picture is shown and has come to rest."""
        self.size, self.rest_seconds = size, _REST_SECONDS
        window = {"width": max(size[0], 640), "height": max(size[1], 400)}
        self.context = browser.new_context(viewport=window)
        self.page = self.context.new_page()
        script = _PROBE.replace("SIZE", str(list(_THUMBNAIL_SIZE)))
        self.page.add_init_script(script.replace("SELECTOR", repr(selector)))
        self.page.goto(url)
        self._fit_window(selector)
        self._start_log()
        self._wait_for_rest()

    def _fit_window(self, selector: str) -> None:
        """Resizes the window so that the picture gets its size beside the page's other parts."""
        width, height = self.size
        for _ in range(2):
            box = self._largest_box(selector)
            gap = round(width - box["width"]), round(height - box["height"])
            old = self.page.viewport_size
            viewport = {"width": old["width"] + gap[0], "height": old["height"] + gap[1]}
            self.page.set_viewport_size(viewport)
        self.center = box["x"] + width / 2, box["y"] + height / 2

    def _largest_box(self, selector: str) -> Any:
        """Waits for an element of a selector, and returns the rectangle of the largest one."""
        script = f"""() => [...document.querySelectorAll({selector!r})]
            .map((element) => element.getBoundingClientRect().toJSON())
            .sort((a, b) => b.width * b.height - a.width * a.height)
            .find((box) => box.width > 0)"""
        box = self.page.wait_for_function(script, timeout=1e3 * _TIMEOUT).json_value()
        self.page.wait_for_timeout(300)  # until its layout is final
        return self.page.evaluate(script) or box

    def _start_log(self) -> None:
        """Logs pictures from now on; of those before, the last one is kept."""
        self.page.evaluate("() => { gvProbe.on = true; gvProbe.log = gvProbe.log.slice(-1); }")

    def _wait_for_rest(self, moved_at: float = 0.0) -> None:
        """Waits until the picture changes after `moved_at` (ms), then not for `rest_seconds`."""
        deadline = time.monotonic() + _TIMEOUT
        last = "(gvProbe.log.at(-1)?.[0] ?? Infinity)"
        at_rest = f"{last} > {moved_at} && performance.now() - {last} > {1e3 * self.rest_seconds}"
        while not self.page.evaluate(at_rest):
            if time.monotonic() > deadline:
                raise RuntimeError("view: the picture does not come to rest")
            self.page.wait_for_timeout(50)

    def drag(self, seconds: float, jumps: int) -> DragResult:
        """Drags for some seconds, then `jumps` times for 0.4 s with a jump at the end."""
        (x, y), mouse = self.center, self.page.mouse
        mouse.move(x, y)
        mouse.down()
        self._start_log()
        self._swing(seconds)
        rate = (self.page.evaluate("gvProbe.log.length") - 1) / seconds
        self.rest_seconds = min(_REST_SECONDS, 0.6 + 4 / max(rate, 1.0))
        delays = []
        for _ in range(jumps):
            self._start_log()
            self._swing(0.4)
            delays.append(self._jump(x + 0.15 * self.size[0], y))
        mouse.up()
        return DragResult(delays=delays, rate=rate)

    def _swing(self, seconds: float) -> None:
        """Moves the mouse a little to and fro, and ends in the middle."""
        (x, y), start = self.center, time.perf_counter()
        count = max(2, round(seconds / _MOVE_INTERVAL))
        for n in range(1, count + 1):
            shift = 40 * math.sin(2 * math.pi * n * _MOVE_INTERVAL / 1.6) if n < count else 0
            self.page.mouse.move(x + shift, y)
            time.sleep(max(0.0, start + n * _MOVE_INTERVAL - time.perf_counter()))

    def _jump(self, x: float, y: float) -> float:
        """Moves the mouse in one step; returns the milliseconds until a picture is first more
        similar to the final one than to the one before the jump.
        """
        self.page.mouse.move(x, y)
        moved_at = self.page.evaluate("gvProbe.movedAt")
        self._wait_for_rest(moved_at)
        pictures = self.page.evaluate("gvProbe.log")
        images = np.array([image for _, image in pictures], float)
        times = np.array([ms for ms, _ in pictures])
        before = images[times <= moved_at][-1]
        to_final, to_before = (np.abs(images - other).mean(1) for other in (images[-1], before))
        shown_at = times[(times > moved_at) & (to_final < to_before)]
        if not len(shown_at):
            raise RuntimeError("view: the picture does not show where the pointer is")
        return float(shown_at[0] - moved_at)

    def close(self) -> None:
        self.context.close()
