"""`gvtorch fly`: a picture a frame along a path through a volume or a store, or a film."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional, arg

from ..base.declared import declared_names
from .common import Bar, size, volume_formats
from .look import first_orbit, parse_orbit, stance
from .scene import Scene, SceneFlags

if TYPE_CHECKING:
    from ..cameras.path import CameraPath

_FILMS = tuple(declared_names("pictures.video", "FILMS"))


@dataclass(frozen=True, kw_only=True)
class Fly:
    """Fly around or through a volume or a store: a picture a frame, or a film."""

    path: Positional[Annotated[str, arg(metavar="PATH", help=f"a volume: {volume_formats()}")]]
    output: Annotated[Path, arg(aliases=["-o"], metavar="DIR|OUT.mp4")]
    """a film, .mp4, or .gif or .webp, which loop; or a folder for 0000.png, 0001.png, ..."""
    flight: Annotated[str, arg(name="path", metavar="orbit|FILE.json")] = "orbit"
    """once around, or keys [{"eye": [x, y, z], "target": [x, y, z], "up": ..., "fov": ...}]"""
    turntable: Annotated[float | None, arg(metavar="SECONDS")] = None
    """an orbit that takes so long: instead of --frames"""
    frames: Annotated[int | None, arg(metavar="N")] = None
    """number of pictures; 100 if left out"""
    fps: Annotated[int | None, arg(metavar="N")] = None
    """pictures a second of a film or a turntable; 25 if left out"""
    orbit: Annotated[str | None, arg(metavar="AZ,EL[,DIST]")] = None
    """where an orbit starts: degrees, and largest sides of the box; as of gvtorch render if left
    out, and all of the box in each picture"""
    stats: Annotated[Path | None, arg(metavar="FILE.jsonl")] = None
    """one JSON line a frame; stats.jsonl beside the pictures if left out"""
    scene: tyro.conf.OmitArgPrefixes[SceneFlags] = SceneFlags()

    def run(self) -> None:
        """Renders frame after frame."""
        from ..pictures import Video

        look = self.scene.look
        width, height = size(look.size)
        frames, fps = self._length()
        options, is_film = look.options(), self.output.suffix in _FILMS
        if not self.output.parent.is_dir():
            raise FileNotFoundError(f"folder not found: {self.output.parent}")
        if self.output.suffix and not is_film:
            kinds = ", ".join(_FILMS)
            raise ValueError(
                f"--output must be a folder or end in {kinds}, got {str(self.output)!r}"
            )
        if is_film and options["background"] is None:
            raise ValueError(f"--background transparent is for pictures, not {self.output.suffix}")
        self._check_path()
        with ExitStack() as stack:
            bar = stack.enter_context(Bar())
            film = Video(self.output, width, height, fps=fps) if is_film else None
            scene = stack.enter_context(self.scene.open(self.path, options, bar))
            path = self._path(scene, width, height)
            if film is not None:
                stack.enter_context(film)
            else:
                self.output.mkdir(exist_ok=True)
            lines = stack.enter_context(self._stats_file().open("w", encoding="utf-8"))
            for number in range(frames):
                bar("frames", number, frames)
                place = number / max(1, frames - 1 + (self.flight == "orbit"))
                picture = scene.render(path.camera(place, width, height, look.camera_model))
                lines.write(json.dumps({"picture": number, **picture.stats.as_dict()}) + "\n")
                if film is not None:
                    film.add(picture)
                else:
                    picture.save(self.output / f"{number:04d}.png")
            bar("frames", frames, frames)
            report = scene.engine.report() if scene.engine is not None else None
        if report is not None:
            from rich.console import Console

            Console().print(report)
        print(f"{self.output}: {frames} pictures; what each cost: {self._stats_file()}")

    def _length(self) -> tuple[int, int]:
        """Number of pictures, and pictures a second."""
        from ..base import check

        fps = check.whole("fly", "--fps", 25 if self.fps is None else self.fps, low=1, high=1000)
        if self.turntable is None:
            if self.fps is not None and self.output.suffix not in _FILMS:
                raise ValueError("--fps is for a film or --turntable: pictures have no speed")
            return check.whole(
                "fly", "--frames", self.frames or 100 * (self.frames is None), low=1
            ), fps
        if self.frames is not None:
            raise ValueError("--turntable and --frames both tell how many pictures: leave one out")
        if self.flight != "orbit":
            raise ValueError("--turntable goes once around: not with --path FILE.json")
        seconds = check.number("fly", "--turntable", self.turntable, low=0, open_low=True)
        return max(1, round(seconds * fps)), fps

    def _stats_file(self) -> Path:
        if self.stats is not None:
            return self.stats
        if self.output.suffix in _FILMS:
            return self.output.with_suffix(".jsonl")
        return self.output / "stats.jsonl"

    def _check_path(self) -> None:
        """Raises what is wrong with the path before the volume is read."""
        if self.flight != "orbit":
            if self.orbit is not None:
                raise ValueError("--orbit is for --path orbit, not for keys")
            self._keys()
        elif self.orbit is not None:
            parse_orbit("--orbit", self.orbit)

    def _keys(self) -> CameraPath:
        from ..cameras.path import CameraPath

        look = self.scene.look
        return CameraPath.from_json(self.flight, up=look.upward(), fov=look.fov)

    def _path(self, scene: Scene, width: int, height: int) -> CameraPath:
        from ..cameras.path import CameraPath

        if self.flight != "orbit":
            return self._keys()
        text = self.orbit or first_orbit(scene.space)
        azimuth, elevation, distance = parse_orbit("--orbit", text)
        look = self.scene.look
        return CameraPath.orbit(
            *(scene.box, look.camera_model, look.fov),
            azimuth=azimuth,
            elevation=elevation,
            distance=distance,
            up=look.upward() or stance(scene.space)[0],
            fit=(width, height) if distance is None else None,
        )
