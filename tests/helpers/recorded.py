"""Frames that serve their requests on the device, as `Engine.capture` records, and a ball."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

import gvtorch as gv
from gvtorch.cameras.custom import as_camera
from gvtorch.engine.frame_graph import FrameGraph
from gvtorch.engine.host_frame import HostFrame
from gvtorch.engine.setup import make_recorded_frame

COMPILED = [pytest.param(b, marks=pytest.mark.backend(b)) for b in ("cpp", "cuda")]
TRANSFER = gv.TransferFunction.from_points(
    [(0, 0), (0.4, 0.9)], [(0.4, 0.1, 0.2, 0.7), (1, 1, 0.8, 0.4)], reference=0.1
)


class Ball(gv.Producer):
    """A ball with bands. `classify`, or with `fill_kinds` `fill`, makes nodes outside EMPTY."""

    on_device = True

    def __init__(self, extent: int = 256, branching: int = 2, fill_kinds: bool = False) -> None:
        super().__init__(extent, box=((-1, -1, -1), (1, 1, 1)), branching=branching)
        self.fill_kinds, self.batch_sizes = fill_kinds, []
        self.register_buffer("bands", torch.tensor([6.0, 28.0, 4.0]))
        self.register_buffer("spoiled", torch.zeros(()))  # above 0: bricks near here hold NaN

    def classify(self, nodes):
        self.batch_sizes.append(len(nodes))
        if self.fill_kinds:
            return torch.full_like(nodes.depth, gv.Region.DATA)
        outside = nodes.center.norm(dim=1) - nodes.radius > 0.9
        return torch.where(outside, gv.Region.EMPTY, gv.Region.DATA)

    def fill(self, nodes):
        gap = 0.9 - nodes.positions.norm(dim=-1, keepdim=True)
        inside = (0.5 + gap / nodes.voxel_size.float()[:, None, None, None, :1]).clamp(0, 1)
        value = inside * (0.7 + 0.3 * (nodes.positions * self.bands).sum(-1, keepdim=True).sin())
        spoiled_nodes = (nodes.center[:, 0] > 0.3) & (nodes.depth > 2) & (self.spoiled > 0)
        value = torch.where(spoiled_nodes[:, None, None, None, None], torch.nan, value)
        if not self.fill_kinds:
            return {"value": value}
        kind = torch.where((value == 0).flatten(1).all(1), gv.Region.EMPTY, gv.Region.DATA)
        return gv.Bricks(data={"value": value}, kind=kind)


def view(size: int = 48, angle: float = 30) -> gv.Camera:
    return gv.Camera.orbit(angle, 20, 0.9, None, size, size)


class Frames(FrameGraph):
    """Frames of an engine as `Engine.capture` records them, but run step by step, without a CUDA
    graph, so that a CPU can, and never by `Engine.frame`.
    """

    def __init__(
        self,
        engine: gv.Engine,
        camera: gv.Camera,
        shader: gv.Shader,
        batch: int,
        look_ahead: float = 0,
        fit: bool = False,
    ) -> None:
        frame = make_recorded_frame(engine.production, batch, fit)
        assert frame is not None
        self.served = frame
        view = engine.view("test", camera, shader, {})
        super().__init__(engine, view, frame, partial(engine.frame, shader=shader), look_ahead)
        self.look_from(camera)
        if isinstance(frame, HostFrame):
            engine._host_frames.append(frame)

    def _record(self, step: Callable[[], None]) -> Callable[[], None]:
        return step

    def look_from(self, camera: gv.Camera) -> None:
        self.camera = as_camera("test", camera)

    def whole(self, max_frames: int = 200, pause: float = 0.0) -> tuple[gv.Hits, gv.FrameStats]:
        """Draws frames, with pauses in seconds, until one misses nothing; returns that one."""
        for _ in range(max_frames):
            hits, stats = self.frame()
            time.sleep(pause)
            if stats.converged:
                return hits, stats
        raise AssertionError(f"not whole within {max_frames} frames: {stats.requests}")

    def frame(self) -> tuple[gv.Hits, gv.FrameStats]:
        _, stats = self._replay(self.camera)
        return self._hits, stats.settle()


Replay = Callable[[gv.Camera], tuple[Tensor, gv.FrameStats]]


def stepped(engine: gv.Engine, camera: gv.Camera, shader: gv.Shader, **options: Any) -> Replay:
    """Returns a function that draws a frame by `Frames`: colour (r, 3) and statistics."""
    frames = Frames(engine, camera, shader, **options)

    def step(camera: gv.Camera) -> tuple[Tensor, gv.FrameStats]:
        frames.look_from(camera)
        hits, stats = frames.frame()
        return hits.color, stats

    return step


def recorded(engine: gv.Engine, camera: gv.Camera, shader: gv.Shader, **options: Any) -> Replay:
    """As `stepped`, but on CUDA by a captured graph, whose replays overwrite the colour."""
    if engine.device.type != "cuda":
        return stepped(engine, camera, shader, **options)
    graph = engine.capture(camera, shader, **options)

    def replay(camera: gv.Camera) -> tuple[Tensor, gv.FrameStats]:
        picture, stats = graph.replay(camera)
        return picture.color.reshape(-1, 3), stats

    return replay
