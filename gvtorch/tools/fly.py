"""`gvtorch fly`: a picture a frame along a path through a store, or a video."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional, arg

from .common import Bar, ReadOptions, numbers, refuse_for_store, size
from .look import Look
from .streaming import Streaming, tell_failures

if TYPE_CHECKING:
    from ..cameras.path import CameraPath
    from ..engine.engine import Engine


@dataclass(frozen=True, kw_only=True)
class Fly:
    """Fly through a store: a picture a frame, and what each cost."""

    path: Positional[Annotated[str, arg(metavar="STORE.zarr")]]
    """the store, a folder or a URL"""
    output: Annotated[Path, arg(aliases=["-o"], metavar="DIR|OUT.mp4")]
    """a folder for 0000.png, 0001.png, ..., or a video"""
    flight: Annotated[str, arg(name="path", metavar="orbit|FILE.json")] = "orbit"
    """once around, or keys [{"eye": [x, y, z], "target": [x, y, z], "up": ..., "fov": ...}]"""
    frames: Annotated[int, arg(metavar="N")] = 100
    """number of pictures"""
    fps: Annotated[int, arg(metavar="N")] = 25
    """pictures a second of a video"""
    orbit: Annotated[str, arg(metavar="AZ,EL,DIST")] = "30,20,2.4"
    """where an orbit starts: degrees, and largest sides of the box"""
    stats: Annotated[Path | None, arg(metavar="FILE.jsonl")] = None
    """one JSON line a frame; stats.jsonl beside the pictures if left out"""
    look: tyro.conf.OmitArgPrefixes[Look] = Look()
    streaming: tyro.conf.OmitArgPrefixes[Streaming] = Streaming()
    source: tyro.conf.OmitArgPrefixes[ReadOptions] = ReadOptions()

    def run(self) -> None:
        """Renders frame after frame."""
        from ..base import check
        from .video import Video

        width, height = size(self.look.size)
        check.whole("fly", "--frames", self.frames, low=1)
        check.whole("fly", "--fps", self.fps, low=1, high=1000)
        options, is_video = self.look.options(), self.output.suffix == ".mp4"
        if not self.output.parent.is_dir():
            raise FileNotFoundError(f"folder not found: {self.output.parent}")
        if self.output.suffix and not is_video:
            raise ValueError(f"--output must be a folder or end in .mp4, got {str(self.output)!r}")
        start = numbers("--orbit", self.orbit, 3, float)
        with ExitStack() as stack:
            bar = stack.enter_context(Bar())
            bar("reading", 0, 0)
            refuse_for_store(self.source)
            opened = self.streaming.open(self.path, self.look, self.source.time or 0)
            engine, shader = stack.enter_context(opened)
            path = self._path(engine, start)
            video = None
            if is_video:
                video = stack.enter_context(Video(self.output, width, height, fps=self.fps))
            else:
                self.output.mkdir(exist_ok=True)
            lines = stack.enter_context(self._stats_file().open("w", encoding="utf-8"))
            for number in range(self.frames):
                place = number / max(1, self.frames - 1 + (self.flight == "orbit"))
                picture = engine.render(
                    *(path.camera(place, width, height, self.look.camera_model), shader),
                    self.streaming.mode or "balanced",
                    max_frames=self.streaming.max_frames,
                    **options,
                )
                lines.write(json.dumps({"picture": number, **picture.stats.as_dict()}) + "\n")
                if video is not None:
                    video.add(picture)
                else:
                    picture.save(self.output / f"{number:04d}.png")
                bar("frames", number + 1, self.frames)
            tell_failures(engine)
            report = engine.report()
        from rich.console import Console

        Console().print(report)
        print(f"{self.output}: {self.frames} pictures; what each cost: {self._stats_file()}")

    def _stats_file(self) -> Path:
        if self.stats is not None:
            return self.stats
        if self.output.suffix == ".mp4":
            return self.output.with_suffix(".jsonl")
        return self.output / "stats.jsonl"

    def _path(self, engine: Engine, start: list[float]) -> CameraPath:
        from ..cameras.path import CameraPath

        if self.flight != "orbit":
            return CameraPath.from_json(self.flight)
        azimuth, elevation, distance = start
        return CameraPath.orbit(
            *(engine.box, self.look.camera_model, self.look.fov),
            azimuth=azimuth,
            elevation=elevation,
            distance=distance,
        )
