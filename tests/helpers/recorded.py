"""Frames that serve themselves, as `Engine.capture` records them."""

from __future__ import annotations

from functools import partial

import gvtorch as gv
from gvtorch.engine.host_frame import HostFrame
from gvtorch.engine.setup import make_recorded_frame


class Frames:
    """Frames of an engine, served on the device: without a graph, so that the CPU runs them."""

    def __init__(self, engine: gv.Engine, camera: gv.Camera, look: gv.Shader, batch: int) -> None:
        self.engine, self.batch = engine, batch
        self.look = look
        self.look_from(camera)
        trees = [*engine.trees.values()]
        made = make_recorded_frame(engine.cache, trees, engine.scheduler, batch, engine.production)
        assert made is not None
        self.served, self.number = made, -1
        if isinstance(made, HostFrame):
            engine.recorded.append(made)

    def look_from(self, camera: gv.Camera) -> None:
        self.view = self.engine.view("test", camera, self.look, {})

    def frame(self) -> tuple[gv.Hits, gv.FrameStats]:
        with self.engine.new_frame(self.view.options) as stats:
            self.engine.release(but=self.served)
            self.engine.readbacks.take_arrived()
            if self.served.begin(self.engine.frames != self.number, self.engine.steady, stats):
                self.served.serve()
            self.engine.number_picture(on_device=False)
            self.number = self.engine.frames
            hits, collected = self.served.draw(self.view.hits)
            if isinstance(self.served, HostFrame):
                collected = collected._replace(ask=partial(self.served.ask, self.served.turn))
            self.engine.read_back(stats, hits, collected)
        self.engine.readbacks.hold_back()
        return hits, stats.settle()
