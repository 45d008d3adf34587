"""`Client`: one page: its camera, its picture, which is refined while the camera rests, and data on
its way to the page. `tell`, `ack` and `send_file` may be called from any thread; everything else
runs in the thread that renders.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from threading import Lock
from typing import Any

from ..cameras import Camera
from ..pictures import Picture, Progressive
from .protocol import message_text, with_picture
from .scene import Scene
from .slices import Planes, panes
from .state import Eye, ViewState, blended

Send = Callable[[str | bytes], None]  # from any thread; does not block

_REST = 0.18  # seconds without a move after which a camera counts as resting
_EVERY = 0.3  # seconds between pictures of a camera at rest
_DRAFT, _FINAL = 80, 94  # JPEG quality
_LITTLE = 200_000  # pixels up to which the final quality costs little
_SMALLEST = 0.1  # least share of the width and height, of a draft
_STILL_FRAMES = 3  # frames without new data, after which a picture counts as finished


class Interrupted(Exception):
    """Ends work early: something newer is to be shown, or nobody waits any more."""


def _nobody(_: str | bytes) -> None:
    """Drops messages to a page that has left."""


class Client:
    """A page.

    Attributes:
        number: The number by which other pages name it.
        eye: Its camera.
        size: (width, height) pixels of its picture.
        follows: The number of the client whose camera it follows, or None.
        picture: Its last picture, or None.
        monitor: Whether it receives figures of the frames.
        nodes: Whether it receives boxes of the nodes of each frame.
        gone: Whether it has left.
    """

    def __init__(self, number: int, send: Send, eye: Eye) -> None:
        """Takes a function that sends a text or bytes to the page."""
        self.number, self._send = number, send
        self.eye, self.size, self.rate = eye, (0, 0), 25.0
        self.follows: int | None = None
        self.monitor = self.nodes = self.gone = False
        self._moving, self._moved, self._sent = False, 0.0, 0.0
        self._drawn: tuple[Any, ...] | None = None  # (eye, size) of the last draft
        self._progressive: Progressive | None = None
        self._settled, self._still, self._done = False, 0, False
        self._last_sent = self._not_before = 0.0
        self._last: tuple[Picture, float, bool] | None = None  # developed, milliseconds, final
        self._renew = False  # whether planes beside it have changed
        self._milliseconds, self._fixed = 5e-4, 0.0  # cost of a pixel; of a frame in addition
        self.picture: Picture | None = None
        self._camera: Camera | None = None
        self._frames = 0
        self._lock = Lock()
        self._planes: Planes | None = None
        self._time = 0.0  # of the scene
        self._in_flight: int | None = None
        self._waiting: tuple[int, bytes] | None = None

    def end(self) -> None:
        """Drops the references to page and scene, so that neither keeps the other alive."""
        self._send, self._progressive, self.gone = _nobody, None, True

    # The network's side.

    def tell(self, kind: str, **content: Any) -> None:
        self._send(message_text(kind, **content))

    def ack(self, number: int) -> None:
        """Notes that the page has drawn a picture, and sends the next one if it waits."""
        with self._lock:
            if number != self._in_flight:
                return
            self._in_flight, waiting = None, self._waiting
            self._waiting = None
        if waiting is not None:
            self._post(*waiting)

    def send_file(self, name: str, data: bytes) -> None:
        """Sends a file that the page saves."""
        self._send(with_picture({"file": name}, data))

    def _post(self, number: int, data: bytes) -> None:
        """Sends a picture, or keeps it until the page has drawn the one before."""
        with self._lock:
            if self._in_flight is not None:
                self._waiting = number, data
                return
            self._in_flight = number
        self._send(data)

    @property
    def busy(self) -> bool:
        """Whether a picture waits for the network."""
        return self._waiting is not None

    # The renderer's side.

    def move(self, eye: Eye, moving: bool, sent: float) -> None:
        """Sets the camera."""
        self.eye, self._moving, self._moved, self._sent = eye, moving, time.monotonic(), sent
        self._done = False

    def renew(self) -> None:
        """Notes that planes beside the picture have changed, but not the picture."""
        self._renew = True

    def stir(self, resting: bool) -> None:
        """Restarts the picture after a change; unless `resting`, as if the camera moved."""
        self._progressive, self._done, self._drawn = None, False, None
        self._settled, self._still = False, 0
        if not resting:
            self._moving, self._moved = True, time.monotonic()

    def resized(self, width: int, height: int, rate: float) -> None:
        """Sets the size of the picture, and the pictures a second wanted during moves."""
        if (width, height) != self.size:
            self.size = (width, height)
            self.stir(False)
        self.rate = rate

    @property
    def resting(self) -> bool:
        """Whether the camera stands still."""
        return not self._moving or time.monotonic() - self._moved > _REST

    def wants(self) -> bool:
        """Returns whether a picture is to be drawn now."""
        if not self.waits() or self.busy or time.monotonic() < self._not_before:
            return False
        return self.resting or self._renew or self._drawn != (self.eye, self.size)

    def waits(self) -> bool:
        """Returns whether it will want a picture without a further message."""
        return bool(self.size[0]) and (self._renew or not self._done)

    def pause(self) -> None:
        """Draws nothing for a second, after a picture failed."""
        self._not_before = time.monotonic() + 1.0

    def draw(
        self, scene: Scene, state: ViewState, newer: Callable[[], bool], planes: Planes | None
    ) -> Picture | None:
        """Draws and sends the next picture: a coarse one while the camera moves, else one more
        frame of the mean, with planes beside it if the state says so. Returns it, or None if
        `newer` returned true, so that it is out of date, or if only the planes have changed.
        """
        self._planes, self._time = planes if state.slices is not None else None, scene.time
        if self._drawn != (self.eye, self.size):
            return self._draft(scene, state)
        if self._renew and self._last is not None and self._camera is not None:
            picture, took, final = self._last
            self._send_picture(picture, state, _FINAL, took, final)
            return None
        try:
            return self._refined(scene, state, newer)
        except Interrupted:
            return None

    def _part(self) -> tuple[int, int]:
        """Returns (width, height) of the picture without the planes beside it."""
        return self.size if self._planes is None else panes(*self.size)["view"][2:]

    def _draft(self, scene: Scene, state: ViewState) -> Picture:
        width, height = self._part()
        wanted = 1e3 / self.rate
        budget = max(wanted - self._fixed, wanted / 2)
        scale = (budget / (self._milliseconds * width * height)) ** 0.5
        scale = min(1.0, max(_SMALLEST, scale))
        small = max(1, round(width * scale)), max(1, round(height * scale))
        camera, start = self.eye.camera(*small, scene.box), time.perf_counter()
        picture = scene.frame(camera, state)
        took = 1e3 * (time.perf_counter() - start)
        self._learn(picture, took, small[0] * small[1])
        self._drawn, self._progressive = (self.eye, self.size), None
        self._settled, self._still = False, 0
        quality = _FINAL if small[0] * small[1] <= _LITTLE else _DRAFT
        self._show(picture, camera, state, quality, took, final=False)
        return picture

    def _learn(self, picture: Picture, took: float, pixels: int) -> None:
        """Updates the estimated cost of a draft: per pixel, and fixed whatever its size."""
        stages = picture.stats.stages
        traced = sum(stages.get(name, 0.0) for name in ("rays", "trace")) or took
        share = 0.4  # weight of the newest
        self._milliseconds += share * (traced / pixels - self._milliseconds)
        self._fixed += share * (max(0.0, took - traced) - self._fixed)

    def _refined(self, scene: Scene, state: ViewState, newer: Callable[[], bool]) -> Picture | None:
        def check(what: str, done: int, total: int) -> None:
            if done < total and newer():
                raise Interrupted

        width, height = self._part()
        camera, start = self.eye.camera(width, height, scene.box), time.perf_counter()
        if state.show != "picture":
            camera = self.eye.camera(max(1, width // 2), max(1, height // 2), scene.box)
            picture = scene.cost(camera, state, check)
            if state.blend < 1:
                below = state.develop.develop(scene.frame(camera, state, check))
                picture = blended(below, picture, state.blend)
            self._done = True
            self._show(picture, camera, state, _FINAL, 1e3 * (time.perf_counter() - start))
            return picture
        if self._progressive is None:
            self._progressive = Progressive(lambda one: scene.frame(one, state, check))
        if not self._settled:
            self._progressive.reset()  # missing data may be there now
        picture = self._progressive.frame(camera)
        took = 1e3 * (time.perf_counter() - start)
        if not self._settled:
            self._still = self._still + 1 if scene.settled(picture) else 0
            converged = getattr(picture.stats, "converged", True)
            self._settled = converged or self._still >= _STILL_FRAMES
        count = self._progressive.count if self._settled else 0
        self._done = count >= state.develop.samples
        first = count & (count - 1) == 0 and self._settled
        if first or self._done or time.monotonic() - self._last_sent > _EVERY or not self._settled:
            self._show(picture, camera, state, _FINAL, took, final=self._done)
        return picture

    def _show(
        self,
        picture: Picture,
        camera: Camera,
        state: ViewState,
        quality: int,
        took: float,
        final: bool = True,
    ) -> None:
        self.picture, self._camera = picture, camera
        shown = picture if state.show != "picture" and final else state.develop.develop(picture)
        self._send_picture(shown, state, quality, took, final)

    def _send_picture(
        self, shown: Picture, state: ViewState, quality: int, took: float, final: bool
    ) -> None:
        """Sends a developed picture, with planes beside it if there are any."""
        self._last, self._renew = (shown, took, final), False
        self._frames += 1
        self._last_sent = time.monotonic()
        missed, layout = shown.missed, None
        if self._planes is not None:
            shown, layout, complete = self._planes.composed(shown, state, *self.size)
            final = final and complete
        data = image_file(shown, "JPEG", quality=quality, subsampling=0 if quality > 90 else 2)
        head = {
            "number": self._frames,
            "camera": vars(self.eye),
            "sent": self._sent,
            "milliseconds": round(took, 2),
            "samples": self._progressive.count if self._progressive is not None else 0,
            "final": final,
            "missed": bool(missed.any()) if missed is not None else False,
            "layout": layout,
            "time": self._time,
        }
        self._post(self._frames, with_picture(head, data))

    def picked(self, x: float, y: float) -> list[float] | None:
        """Returns the world position (3,) seen at x, y (0 to 1) of the last picture, or None."""
        if self.picture is None or self._camera is None:
            return None
        rows, columns = self.picture.nearest.shape[:2]
        row = min(rows - 1, int(y * rows))
        column = min(columns - 1, int(x * columns))
        distance = float(self.picture.nearest[row, column, 0])
        if not distance < float("inf"):
            return None
        rays = self._camera.rays(rows=(row, row + 1))
        place = rays.origin[column] + distance * rays.direction[column]
        return place.tolist()


def image_file(picture: Picture, kind: str, **options: Any) -> bytes:
    """Returns a picture as a JPEG or PNG, made with Pillow's options."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(picture.to_srgb8().numpy()).save(out, kind, **options)
    return out.getvalue()
