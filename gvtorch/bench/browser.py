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

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_HELD = 1 / 60  # seconds between two moves of the mouse
_QUIET = 3.0  # seconds without a change, after which a new page is at rest
_PATIENCE = 60.0  # seconds within which a page must come to rest
_THUMB = (48, 27)

#: Stores [milliseconds, thumbnail] of each picture that differs from the one before, and the time
#: of the last move. WebGL must preserve its drawing buffer, because it is read later.
_PROBE = """
(() => {
  const open = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    const kept = kind.startsWith("webgl") ? { ...options, preserveDrawingBuffer: true } : options;
    return open.call(this, kind, kept);
  };
  const probe = (window.gvProbe = { seen: [], moved: 0, on: false });
  addEventListener("pointermove", () => { probe.moved = performance.now(); }, true);
  const thumb = document.createElement("canvas");
  [thumb.width, thumb.height] = SIZE;
  const context = open.call(thumb, "2d", { willReadFrequently: true });
  context.imageSmoothingEnabled = false;
  let before = "";
  const look = () => {
    requestAnimationFrame(look);
    if (!probe.on) return;
    context.clearRect(0, 0, thumb.width, thumb.height);
    for (const one of document.querySelectorAll(SELECTOR)) {
      const { width, height } = one.getBoundingClientRect();
      const small = width * height < 0.2 * innerWidth * innerHeight;
      if (small || !(one.naturalWidth ?? one.width)) continue;
      context.drawImage(one, 0, 0, thumb.width, thumb.height);
    }
    const found = context.getImageData(0, 0, thumb.width, thumb.height).data;
    const green = Array.from({ length: found.length / 4 }, (_, n) => found[4 * n + 1]);
    const text = green.join();
    if (text !== before && new Set(green).size > 1) probe.seen.push([performance.now(), green]);
    before = text;
  };
  requestAnimationFrame(look);
})();
"""


def absent() -> str:
    """Returns why no browser can run here; an empty string if one can."""
    if importlib.util.find_spec("playwright") is None:
        return "playwright is not installed"
    return "" if executable() else f"none of {', '.join(_NAMES)} is on the path"


def executable() -> str | None:
    """Returns the path of Chromium; None if there is none."""
    return next(filter(None, map(shutil.which, _NAMES)), None)


@contextlib.contextmanager
def running() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as library:
        flags = ["--no-sandbox", "--disable-dev-shm-usage"]
        browser = library.chromium.launch(executable_path=executable(), args=flags)
        yield browser
        browser.close()


class Seen(NamedTuple):
    """What was measured while the mouse dragged."""

    waited: list[float]  # milliseconds from each jump to the first picture that shows it
    rate: float  # pictures a second during the long drag


class Page:
    """A page in the browser, its picture of a given size, and the mouse that drags in it."""

    def __init__(self, browser: Any, url: str, selector: str, size: tuple[int, int]) -> None:
        """Opens the page, and waits until its picture is shown and has come to rest."""
        self.size, self.quiet = size, _QUIET
        window = {"width": max(size[0], 640), "height": max(size[1], 400)}
        self.context = browser.new_context(viewport=window)
        self.page = self.context.new_page()
        script = _PROBE.replace("SIZE", str(list(_THUMB)))
        self.page.add_init_script(script.replace("SELECTOR", repr(selector)))
        self.page.goto(url)
        self._fit(selector)
        self._watch(True)
        self._rest()

    def _fit(self, selector: str) -> None:
        """Resizes the window so that the picture gets its size beside the page's other parts."""
        width, height = self.size
        for _ in range(2):
            box = self._largest(selector)
            more = round(width - box["width"]), round(height - box["height"])
            now = self.page.viewport_size
            wanted = {"width": now["width"] + more[0], "height": now["height"] + more[1]}
            self.page.set_viewport_size(wanted)
        self.middle = box["x"] + width / 2, box["y"] + height / 2

    def _largest(self, selector: str) -> Any:
        """Waits for an element of a selector, and returns the rectangle of the largest one."""
        script = f"""() => [...document.querySelectorAll({selector!r})]
            .map((one) => one.getBoundingClientRect().toJSON())
            .sort((a, b) => b.width * b.height - a.width * a.height)
            .find((one) => one.width > 0)"""
        found = self.page.wait_for_function(script, timeout=1e3 * _PATIENCE).json_value()
        self.page.wait_for_timeout(300)  # until its layout is final
        return self.page.evaluate(script) or found

    def _watch(self, on: bool) -> None:
        self.page.evaluate("on => { gvProbe.on = on; gvProbe.seen = gvProbe.seen.slice(-1); }", on)

    def _rest(self, moved: float = 0.0) -> None:
        """Waits until the picture has changed after `moved` (ms), then not for `quiet` seconds."""
        end = time.monotonic() + _PATIENCE
        last = "(gvProbe.seen.at(-1)?.[0] ?? Infinity)"
        quiet = f"{last} > {moved} && performance.now() - {last} > {1e3 * self.quiet}"
        while not self.page.evaluate(quiet):
            if time.monotonic() > end:
                raise RuntimeError("view: the picture does not come to rest")
            self.page.wait_for_timeout(50)

    def drag(self, seconds: float, jumps: int) -> Seen:
        """Drags for some seconds, then `jumps` times for 0.4 s with a jump at the end."""
        (x, y), mouse = self.middle, self.page.mouse
        mouse.move(x, y)
        mouse.down()
        self._watch(True)
        self._swing(seconds)
        rate = (self.page.evaluate("gvProbe.seen.length") - 1) / seconds
        self.quiet = min(_QUIET, 0.6 + 4 / max(rate, 1.0))
        waited = []
        for _ in range(jumps):
            self._watch(True)
            self._swing(0.4)
            waited.append(self._jump(x + 0.15 * self.size[0], y))
        mouse.up()
        return Seen(waited=waited, rate=rate)

    def _swing(self, seconds: float) -> None:
        """Moves the mouse a little to and fro, and ends in the middle."""
        (x, y), start = self.middle, time.perf_counter()
        count = max(2, round(seconds / _HELD))
        for n in range(1, count + 1):
            shift = 40 * math.sin(2 * math.pi * n * _HELD / 1.6) if n < count else 0
            self.page.mouse.move(x + shift, y)
            time.sleep(max(0.0, start + n * _HELD - time.perf_counter()))

    def _jump(self, x: float, y: float) -> float:
        """Moves the mouse in one step; returns the milliseconds until a picture is first more
        similar to the final one than to the one before the jump.
        """
        self.page.mouse.move(x, y)
        moved = self.page.evaluate("gvProbe.moved")
        self._rest(moved)
        seen = self.page.evaluate("gvProbe.seen")
        thumbs = np.array([thumb for _, thumb in seen], float)
        at = np.array([when for when, _ in seen])
        before = thumbs[at <= moved][-1]
        to_last, to_first = (np.abs(thumbs - one).mean(1) for one in (thumbs[-1], before))
        shown = at[(at > moved) & (to_last < to_first)]
        if not len(shown):
            raise RuntimeError("view: the picture does not show where the pointer is")
        return float(shown[0] - moved)

    def close(self) -> None:
        self.context.close()
