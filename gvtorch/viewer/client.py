"""`Client`: one page: its camera, its picture, which is refined while the camera rests, and data on
its way to the page. `send_message`, `ack` and `send_file` may be called from any thread; everything
else runs in the thread that renders.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from threading import Lock
from typing import Any

from ..cameras import Camera
from ..pictures import Picture, Progressive
from .protocol import binary_message, message_text
from .scene import Scene
from .slices import Planes, panes
from .state import Eye, ViewState

Send = Callable[[str | bytes], None]  # from any thread; does not block

_REST_SECONDS = 0.18  # seconds without a move after which a camera counts as resting
_SHOW_SECONDS = 0.3  # seconds between pictures of a camera at rest
_DRAFT_QUALITY, _FINAL_QUALITY = 80, 94  # JPEG quality
_CHEAP_PIXELS = 200_000  # pixels up to which the final quality costs little
_MIN_DRAFT_SCALE = 0.1  # least fraction of the width and height, of a draft
_LATE_DRAFT_MS = 250.0  # milliseconds after which a draft is given up for something newer
_UNCHANGED_FRAMES = 3  # frames without new data, after which a picture counts as finished


class Interrupted(Exception):
    """Ends work early: something newer is to be shown, or nobody waits any more."""


class Client:
    """A page.

    Attributes:
        number: The number by which other pages name it.
        eye: Its camera.
        size: (width, height) pixels of its picture.
        follows: The number of the client whose camera it follows, or None.
        picture: Its last picture, developed and without planes, or None.
        monitor: Whether it receives figures of the frames.
        nodes: Whether it receives boxes of the nodes of each frame.
        planes_changed: Whether planes beside its picture have changed, but not the picture.
        gone: Whether it has left, or the view is closed: ends work for it.
    """

    def __init__(self, number: int, send: Send, eye: Eye) -> None:
        self.number, self._send = number, send
        self.eye, self.size, self.rate = eye, (0, 0), 25.0
        self.follows: int | None = None
        self.monitor = self.nodes = self.gone = self.planes_changed = False
        self._moving, self._move_time, self._move_clock = False, 0.0, 0.0
        self._draft_key: tuple[Any, ...] | None = None  # (eye, size) of the last draft
        self._progressive: Progressive | None = None
        self._settled, self._unchanged_frames, self._finished = False, 0, False
        self._last_sent_time = self._paused_until = 0.0
        self._last_shown = (0.0, False)  # milliseconds that `picture` took, whether it is final
        self._pixel_ms, self._fixed_ms = 5e-4, 0.0  # cost of a pixel; of a frame in addition
        self.picture: Picture | None = None
        self._camera: Camera | None = None
        self._picture_number = 0
        self._lock = Lock()
        self._planes: Planes | None = None
        self._scene_time = 0.0
        self._in_flight: int | None = None
        self._waiting_picture: tuple[int, bytes] | None = None

    def end(self) -> None:
        """Drops the references to page and scene, so that neither keeps the other alive."""
        self._send, self._progressive, self.gone = lambda _: None, None, True

    # The network's side.

    def send_message(self, kind: str, **content: Any) -> None:
        self._send(message_text(kind, **content))

    def ack(self, number: int) -> None:
        """Notes that the page has drawn a picture, and sends the next one if it waits."""
        with self._lock:
            if number != self._in_flight:
                return
            self._in_flight, waiting = None, self._waiting_picture
            self._waiting_picture = None
        if waiting is not None:
            self._send_or_hold(*waiting)

    def send_file(self, name: str, data: bytes) -> None:
        """Sends a file that the page saves."""
        self._send(binary_message({"file": name}, data))

    def _send_or_hold(self, number: int, data: bytes) -> None:
        """Sends a picture, or keeps it until the page has drawn the one before."""
        with self._lock:
            if self._in_flight is not None:
                self._waiting_picture = number, data
                return
            self._in_flight = number
        self._send(data)

    # The renderer's side.

    def move(self, eye: Eye, moving: bool, sent: float) -> None:
        self.eye, self._moving, self._finished = eye, moving, False
        self._move_time, self._move_clock = time.monotonic(), sent

    def restart(self, resting: bool) -> None:
        """Restarts the picture after a change; unless `resting`, as if the camera moved."""
        self._progressive, self._finished, self._draft_key = None, False, None
        self._settled, self._unchanged_frames = False, 0
        if not resting:
            self._moving, self._move_time = True, time.monotonic()

    def resized(self, width: int, height: int, rate: float) -> None:
        """Sets the size of the picture, and the pictures a second wanted during moves."""
        if (width, height) != self.size:
            self.size = (width, height)
            self.restart(False)
        self.rate = rate

    @property
    def resting(self) -> bool:
        """Whether the camera stands still."""
        return not self._moving or time.monotonic() - self._move_time > _REST_SECONDS

    def wants_picture(self) -> bool:
        """Returns whether a picture is to be drawn now."""
        waits_for_network = self._waiting_picture is not None
        if not self.is_unfinished() or waits_for_network or time.monotonic() < self._paused_until:
            return False
        return self.resting or self.planes_changed or self._draft_key != (self.eye, self.size)

    def is_unfinished(self) -> bool:
        """Returns whether it will want a picture without a further message."""
        return bool(self.size[0]) and (self.planes_changed or not self._finished)

    def pause(self) -> None:
        """Draws nothing for a second, after a picture failed."""
        self._paused_until = time.monotonic() + 1.0

    def draw(
        self, scene: Scene, state: ViewState, is_outdated: Callable[[], bool], planes: Planes | None
    ) -> Picture | None:
        """Draws and sends the next picture: a coarse one while the camera moves, else one more
        frame of the mean, with planes beside it if the state says so. Returns it, or None if
        `is_outdated` returned true, or if only the planes have changed.
        """
        self._planes, self._scene_time = planes if state.slices is not None else None, scene.time
        is_draft = self._draft_key != (self.eye, self.size)
        if not is_draft and self.planes_changed and self.picture is not None:
            self._send_picture(self.picture, state, _FINAL_QUALITY, *self._last_shown)
            return None
        try:
            draw = self._draw_draft if is_draft else self._draw_refined
            return draw(scene, state, is_outdated)
        except Interrupted:
            return None

    def _view_size(self) -> tuple[int, int]:
        """Returns (width, height) of the picture without the planes beside it."""
        return self.size if self._planes is None else panes(*self.size)["view"][2:]

    def _draw_draft(
        self, scene: Scene, state: ViewState, is_outdated: Callable[[], bool]
    ) -> Picture:
        """Draws a picture of as many pixels as fit in the time of a frame. If it takes much longer
        and something newer is to be shown, it is given up, and the next has fewer pixels.
        """

        def stop_if_late(_stage: str, done: int, total: int) -> None:
            late_ms = 1e3 * (time.perf_counter() - start)
            is_late = late_ms > _LATE_DRAFT_MS and scale > _MIN_DRAFT_SCALE
            if done < total and (self.gone or (is_late and is_outdated())):
                self._pixel_ms = late_ms / (done * size[0])
                raise Interrupted

        width, height = self._view_size()
        frame_ms = 1e3 / self.rate
        pixels_ms = max(frame_ms - self._fixed_ms, frame_ms / 2)
        scale = (pixels_ms / (self._pixel_ms * width * height)) ** 0.5
        scale = min(1.0, max(_MIN_DRAFT_SCALE, scale))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        camera, start = self.eye.camera(*size, scene.box), time.perf_counter()
        picture = scene.frame(camera, state, stop_if_late)
        elapsed_ms = 1e3 * (time.perf_counter() - start)
        self._update_costs(picture, elapsed_ms, size[0] * size[1])
        self._draft_key, self._progressive = (self.eye, self.size), None
        self._settled, self._unchanged_frames = False, 0
        quality = _FINAL_QUALITY if size[0] * size[1] <= _CHEAP_PIXELS else _DRAFT_QUALITY
        self._camera = camera
        self._send_picture(state.develop.develop(picture), state, quality, elapsed_ms, final=False)
        return picture

    def _update_costs(self, picture: Picture, elapsed_ms: float, pixels: int) -> None:
        """Updates the estimated cost of a draft: per pixel, and fixed whatever its size."""
        stages = picture.stats.stages
        trace_ms = sum(stages.get(name, 0.0) for name in ("rays", "trace")) or elapsed_ms
        weight = 0.4  # of the newest draft
        self._pixel_ms += weight * (trace_ms / pixels - self._pixel_ms)
        self._fixed_ms += weight * (max(0.0, elapsed_ms - trace_ms) - self._fixed_ms)

    def _draw_refined(
        self, scene: Scene, state: ViewState, is_outdated: Callable[[], bool]
    ) -> Picture | None:
        def stop_if_outdated(stage: str, done: int, total: int) -> None:
            if done < total and is_outdated():
                raise Interrupted

        width, height = self._view_size()
        camera, start = self.eye.camera(width, height, scene.box), time.perf_counter()
        if state.show != "picture":
            camera = self.eye.camera(max(1, width // 2), max(1, height // 2), scene.box)
            drawn = scene.frame(camera, state, stop_if_outdated)  # requests what is missing
            picture = state.with_costs(
                state.develop.develop(drawn), lambda: scene.cost(camera, state, stop_if_outdated)
            )
            self._update_settled(scene, drawn)
            self._finished = self._settled
            elapsed_ms = 1e3 * (time.perf_counter() - start)
            self._camera = camera
            self._send_picture(picture, state, _FINAL_QUALITY, elapsed_ms, self._finished)
            return picture
        if self._progressive is None:
            self._progressive = Progressive(
                lambda jittered: scene.frame(jittered, state, stop_if_outdated)
            )
        if not self._settled:
            self._progressive.reset()  # missing data may be there now
        picture = self._progressive.frame(camera)
        elapsed_ms = 1e3 * (time.perf_counter() - start)
        self._update_settled(scene, picture)
        count = self._progressive.count if self._settled else 0
        self._finished = count >= state.develop.samples
        is_milestone = count & (count - 1) == 0 and self._settled
        if (
            is_milestone
            or self._finished
            or time.monotonic() - self._last_sent_time > _SHOW_SECONDS
            or not self._settled
        ):
            self._camera = camera
            developed = state.develop.develop(picture)
            self._send_picture(developed, state, _FINAL_QUALITY, elapsed_ms, self._finished)
        return picture

    def _update_settled(self, scene: Scene, picture: Picture) -> None:
        """Notes whether a frame shows all data, or frames no longer bring any."""
        if not self._settled:
            self._unchanged_frames = self._unchanged_frames + 1 if scene.settled(picture) else 0
            converged = getattr(picture.stats, "converged", True)
            self._settled = converged or self._unchanged_frames >= _UNCHANGED_FRAMES

    def _send_picture(
        self, shown: Picture, state: ViewState, quality: int, elapsed_ms: float, final: bool
    ) -> None:
        """Sends a developed picture, with planes beside it if there are any."""
        self.picture, self._last_shown = shown, (elapsed_ms, final)
        self.planes_changed = False
        self._picture_number += 1
        self._last_sent_time = time.monotonic()
        missed, layout = shown.missed, None
        if self._planes is not None:
            shown, layout, complete = self._planes.composed(shown, state, *self.size)
            final = final and complete
        data = image_file(shown, "JPEG", quality=quality, subsampling=0 if quality > 90 else 2)
        header = {
            "number": self._picture_number,
            "camera": vars(self.eye),
            "sent": self._move_clock,
            "milliseconds": round(elapsed_ms, 2),
            "samples": self._progressive.count if self._progressive is not None else 0,
            "final": final,
            "missed": bool(missed.any()) if missed is not None else False,
            "layout": layout,
            "time": self._scene_time,
        }
        self._send_or_hold(self._picture_number, binary_message(header, data))

    def position_at(self, x: float, y: float) -> list[float] | None:
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
        return (rays.origin[column] + distance * rays.direction[column]).tolist()


def image_file(picture: Picture, kind: str, **options: Any) -> bytes:
    """Returns a picture as a JPEG or PNG, made with Pillow's options."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(picture.to_srgb8().numpy()).save(out, kind, **options)
    return out.getvalue()
