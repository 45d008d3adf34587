"""`gvtorch fly`: a picture a frame along a path through a volume or a store, or a film."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional, arg

from ..base.declared import declared_names
from ..io.ngff import is_zarr
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
    """number of pictures; 100 if left out, or one for each of --times"""
    times: Annotated[str | None, arg(metavar="all|A-B")] = None
    """a film over time: all time points, or those from A to B; the camera stands still where an
    orbit starts, unless --turntable or --path FILE.json move it"""
    fps: Annotated[int | None, arg(metavar="N")] = None
    """pictures a second of a film or a turntable; 25 if left out"""
    orbit: Annotated[str | None, arg(metavar="AZ,EL[,DIST]")] = None
    """where an orbit starts: degrees, and largest sides of the box; as of gvtorch render if left
    out, and all of the box in each picture"""
    stats: Annotated[Path | None, arg(metavar="FILE.jsonl")] = None
    """what each picture cost, one JSON line a frame"""
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
            lines = None
            if self.stats is not None:
                lines = stack.enter_context(self.stats.open("w", encoding="utf-8"))
            coarse = 0
            for moment, numbers in self._parts(frames):
                source = self.scene.source
                source = source if moment is None else replace(source, time=moment)
                with replace(self.scene, source=source).open(self.path, options, bar) as scene:
                    path = self._path(scene, width, height)
                    if numbers.start == 0 and film is not None:  # what is there can be read
                        stack.enter_context(film)
                    elif film is None:
                        self.output.mkdir(exist_ok=True)
                    for number in numbers:
                        bar("frames", number, frames)
                        camera = path.camera(
                            self._place(number, frames), width, height, look.camera_model
                        )
                        picture = scene.render(camera)
                        told = picture.stats.as_dict()
                        coarse += not told.get("converged", True)
                        if lines is not None:
                            lines.write(json.dumps({"picture": number, **told}) + "\n")
                        if film is not None:
                            film.add(picture)
                        else:
                            picture.save(self.output / f"{number:04d}.png")
            bar("frames", frames, frames)
        missing = f", {coarse} of them are not complete" if coarse else ""
        print(f"{self.output}: {frames} pictures{missing}")

    def _place(self, number: int, frames: int) -> float:
        """Where on its path, 0 to 1, the camera of a picture is."""
        if self.times is not None and self.turntable is None and self.flight == "orbit":
            return 0.0
        return number / max(1, frames - 1 + (self.flight == "orbit"))

    def _parts(self, frames: int) -> list[tuple[int | None, range]]:
        """Time points, and the pictures that are taken of each; None: of whichever is read."""
        if self.times is None:
            return [(None, range(frames))]
        moments = self._moments()
        ends = [-(-number * frames // len(moments)) for number in range(len(moments) + 1)]
        return [(m, range(a, b)) for m, a, b in zip(moments, ends, ends[1:], strict=False) if a < b]

    def _moments(self) -> range:
        """The time points that `--times` names."""
        from ..io.reading import open_source
        from ..io.store import Store

        if self.scene.source.time is not None:
            raise ValueError("--times and --time both tell which: leave one out")
        if is_zarr(self.path):
            count = Store.open(self.path, image=self.scene.streaming.image).times
        else:
            options = self.scene.source.options()
            del options["nan"]
            count = open_source(self.path, **options).times
        first, _, last = (self.times or "").partition("-")
        if self.times == "all":
            return range(count)
        if first.isdigit() and last.isdigit() and int(first) <= int(last) < count:
            return range(int(first), int(last) + 1)
        raise ValueError(
            f"--times must be all or A-B, from 0 to {count - 1} of {self.path}, got {self.times!r}"
        )

    def _length(self) -> tuple[int, int]:
        """Number of pictures, and pictures a second."""
        from ..base import check

        fps = check.whole("fly", "--fps", 25 if self.fps is None else self.fps, low=1, high=1000)
        if self.turntable is None:
            if self.fps is not None and self.output.suffix not in _FILMS:
                raise ValueError("--fps is for a film or --turntable: pictures have no speed")
            most = 100 if self.times is None else len(self._moments())
            frames = most if self.frames is None else self.frames
            return check.whole("fly", "--frames", frames, low=1), fps
        if self.frames is not None:
            raise ValueError("--turntable and --frames both tell how many pictures: leave one out")
        if self.flight != "orbit":
            raise ValueError("--turntable goes once around: not with --path FILE.json")
        seconds = check.number("fly", "--turntable", self.turntable, low=0, open_low=True)
        return max(1, round(seconds * fps)), fps

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
