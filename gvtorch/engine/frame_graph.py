"""`FrameGraph`: a frame recorded as CUDA graphs; `LookAhead`: its rays of future pictures."""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ..base.records import Hits, Rays
from ..base.stage import stage
from ..cameras import Camera
from ..cameras.custom import as_camera
from ..pictures import Picture
from ..tracing.pixels import View
from .device_frame import DeviceFrame
from .recorded import RecordedFrame
from .stats import FrameStats
from .steps import FrameSteps

_STRIDE = 4  # pixels between look-ahead rays
_MAX_INTERVAL = 4  # most frames between two look-aheads
_LOOKS_AHEAD = 4  # look-aheads before the camera arrives: each deepens a tree by a level


class FrameGraph:
    """A frame recorded as CUDA graphs, each launched by one host call: one serves, one subdivides
    what was just made, one draws, and two look ahead of the camera and finish. `Engine.capture`
    makes it. Replays take turns with the other frames of the engine; the picture is one buffer, so
    one thread should replay a graph.

    A replay renders the frame that `Engine.frame` would render. Where all producers are
    `on_device`, it also makes what the previous replay missed; where all are `on_host`, they get
    the list of what a replay missed once it has arrived, and a later replay writes their answers.
    Otherwise it produces nothing; while `Engine.steady` is false, something was missed or an answer
    is on its way: then call `Engine.frame` until it is true::

        render = graph.replay if engine.steady else partial(engine.frame, shader=shader)
        picture, stats = render(camera)
    """

    def __init__(
        self,
        engine: FrameSteps,
        view: View,
        recorded: RecordedFrame | None,
        render_frame: Callable[[Camera | Rays], tuple[Picture, FrameStats]],
        look_ahead: float = 0,
    ) -> None:
        """Records the frame; see `Engine.capture`. The host serves frames of `render_frame`."""
        self._engine, self._recorded, self._render_frame = engine, recorded, render_frame
        self._view = view = replace(view, numbers=view.numbers.clone())  # written by replays
        self._frame_number = -1  # of the last replay's picture
        self._look_ahead = LookAhead(view, look_ahead) if look_ahead else None
        if recorded is not None:
            self._serve = self._record(recorded.serve)
        if isinstance(recorded, DeviceFrame):
            self._deepen = self._record(recorded.deepen)
        self._draw = self._record(self._draw_picture)
        if recorded is not None and self._look_ahead is not None:
            self._look = self._record(functools.partial(recorded.look_ahead, self._look_ahead.hits))
            self._finish = self._record(self._collect)

    def _record(self, step: Callable[[], None]) -> Callable[[], None]:
        """Records a step's work on the device as a graph; returns the function that launches it.
        Meanwhile Python collects no garbage: freeing what an old engine held, such as locked host
        memory, would abort the recording.
        """
        graph, device = torch.cuda.CUDAGraph(), self._engine.device
        gc_was_enabled = gc.isenabled()
        gc.disable()
        try:
            stream = _recording_stream(device)
            recording = torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local")
            with torch.cuda.device(device), recording:
                step()
        finally:
            if gc_was_enabled:
                gc.enable()
        return graph.replay

    def _draw_picture(self) -> None:
        """Traces the picture; collects its requests, unless look-ahead rays come first."""
        view, recorded = self._view, self._recorded
        if recorded is None:
            self._engine.cache.frame_1.add_(1)
            self._hits = view.hits()
        else:
            self._hits = recorded.draw(view, self._look_ahead is not None)
        self._picture = view.picture(self._hits, FrameStats())
        if self._look_ahead is None:
            self._collect()

    def _collect(self) -> None:
        """Lists the picture's requests, sorts the slots by use, and counts."""
        if self._recorded is None:
            self._collected = self._engine.collect_requests_and_use(self._hits.samples)
        else:
            self._collected = self._recorded.finish(self._hits)

    def replay(self, camera: Camera | Rays) -> tuple[Picture, FrameStats]:
        """Renders a frame; the host does not wait for the device.

        Args:
            camera: Cameras of the number, size and model that were captured.

        Returns:
            The picture, which the next replay overwrites, and its statistics; see `Engine.frame`.

        Raises:
            ValueError: The camera differs in number, size or model, or the engine is closed.
        """
        camera = as_camera("replay", camera)
        captured = self._view.camera.form
        if camera.form != captured:
            raise ValueError(f"replay: camera must be {captured} as captured, got {camera.form}")
        engine, recorded = self._engine, self._recorded
        with engine.lock:
            if engine.changed or (recorded and recorded.take_host_needed(engine.readbacks)):
                return self._render_frame(camera)  # which also renews the changed trees
            with torch.cuda.device(engine.device):
                return self._replay(camera)

    def _replay(self, camera: Camera) -> tuple[Picture, FrameStats]:
        engine, recorded = self._engine, self._recorded
        with engine.new_frame(self._view.options) as stats:
            stale = engine.frames != self._frame_number
            if recorded is not None:
                self._serve_missed(recorded, stale, stats)
            engine._number_picture()
            self._frame_number = engine.frames
            self._draw_from(camera.placed(self._view.box), stale)
            collected = self._collected
            if recorded is not None:
                collected = recorded.to_read_back(collected)
            engine.read_back(stats, self._hits, collected)
        engine.readbacks.hold_back()
        return replace(self._picture, stats=stats), stats

    def _serve_missed(self, recorded: RecordedFrame, stale: bool, stats: FrameStats) -> None:
        """Serves what earlier replays missed; `stale`: other frames came since the last one."""
        engine = self._engine
        engine._release(keep=recorded)
        engine.readbacks.take_arrived()
        steady = engine.steady and not (self._look_ahead and self._look_ahead.due)
        with stage("serve"):
            if recorded.begin(stale, steady, stats):
                self._serve()
                for _ in range(engine.readbacks.extra_levels):
                    self._deepen()

    def _draw_from(self, camera: Camera, stale: bool) -> None:
        """Draws what a placed camera sees; `stale`: other frames came since the last replay."""
        look_ahead, numbers = self._look_ahead, camera.numbers(self._engine.device)
        if look_ahead is not None:
            look_ahead.follow(camera, numbers, stale)
        self._view.numbers.copy_(numbers)
        with stage("replay"):
            self._draw()
            if look_ahead is not None:
                if look_ahead.due:
                    self._look()
                self._finish()

    def __repr__(self) -> str:
        return f"FrameGraph({self._view.camera!r})"


class LookAhead:
    """Rays of future pictures, which request what these would miss. Their camera is where
    the picture's will be if its motion since the last frame continues.

    There is one of these rays for 4 x 4 pixels of the picture: a brick is wider than that on the
    screen. What they use counts as used and so is kept; their requests are served after the
    picture's. On a GPU they take as long as their longest ray, not a sixteenth of the picture's
    time, so they are traced only every few frames, more rarely the farther they look ahead.

    Attributes:
        due: Whether they are traced in this frame: the camera moves, and it is their turn.
    """

    def __init__(self, view: View, frames: float) -> None:
        """Prepares rays that look `frames` ahead of a picture's view."""
        self._numbers, self._camera, self._frames = view.numbers, view.camera, frames
        self._numbers_before, self._camera_before = self._numbers.clone(), view.camera
        self._interval = max(1, min(_MAX_INTERVAL, int(frames / _LOOKS_AHEAD)))
        self._moved_frames, self.due = 0, False
        options = replace(view.options, layer=None)
        thinned = view.camera.thinned(_STRIDE)
        self._view = replace(view, camera=thinned, numbers=self._numbers_ahead(), options=options)

    def follow(self, camera: Camera, numbers: Tensor, stale: bool) -> None:
        """Prepares the next frame: updates `due`, and copies the last camera's numbers before the
        next one's are written to `View.numbers`. `camera` is placed, `numbers` are its own;
        `stale`: other frames were rendered since the last one.
        """
        self._numbers_before.copy_(numbers if stale else self._numbers)
        moving = not (stale or camera.same(self._camera_before))
        self.due, self._camera_before = moving and self._moved_frames % self._interval == 0, camera
        self._moved_frames += moving

    def hits(self) -> Hits:
        """Traces the rays; only their usage stamps and requests matter."""
        self._view.numbers.copy_(self._numbers_ahead())
        return self._view.hits()

    def _numbers_ahead(self) -> Tensor:
        now, before = self._numbers, self._numbers_before
        return self._camera.numbers_ahead(now, before, self._frames, _STRIDE)


@functools.cache
def _recording_stream(device: torch.device) -> torch.cuda.Stream:
    """Returns a device's stream for recording. torch's own default is one stream for all devices,
    on the first that recorded: graphs of the others would be empty.
    """
    return torch.cuda.Stream(device)
