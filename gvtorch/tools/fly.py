"""`gvtorch fly`: renders pictures, or a film, along a path through a volume or a store."""

from __future__ import annotations

import json
import math
import os
import re
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import Positional

from ..base.declared import declared_names
from ..base.digits import whole_number
from ..base.image_info import up_and_front
from ..base.messages import printable
from ..base.whole_file import write_text
from ..io.stores.ngff import is_zarr
from .annotations import Annotations
from .common import Bar, check_outputs, given_flags, option, parse_size, volume_formats
from .look import default_orbit, parse_camera, parse_orbit
from .scene import RenderedScene, SceneFlags

if TYPE_CHECKING:
    from ..cameras import Camera
    from ..cameras.path import CameraPath
    from ..pictures import Picture, Video
    from ..viewer.flight import Flight, KeyFile, StateFile
    from ..viewer.state import ViewState

_FILM_SUFFIXES = tuple(declared_names("pictures.video", "FILM_SIDES"))


@dataclass(frozen=True, kw_only=True)
class Fly:
    """Fly around or through a volume or a store: a picture a frame, or a film."""

    path: Positional[Annotated[str, option(metavar="PATH", help=f"a volume: {volume_formats()}")]]
    # film to write, .mp4, or .gif or .webp, which loop; or a folder for 0000.png, 0001.png, ...
    output: Annotated[Path, option(aliases=["-o"], metavar="DIR|OUT.mp4")]
    # width and height of each picture in pixels
    size: Annotated[str, option(metavar="WxH")] = "512x512"
    # camera path: orbit (once around), or a file of keys [{"eye": [x, y, z], "target": [x, y,
    # z], "up": ..., "fov": ...}, ...]
    flight: Annotated[str, option(name="path", metavar="orbit|FILE.json")] = "orbit"
    # key frames instead of --path: [{"time": seconds, "state": what gvtorch view saved}, ...];
    # camera, colours, clips and all other numbers change smoothly between them, a series shows the
    # nearest time point, and a film that ends as it begins loops
    keys: Annotated[Path | None, option(metavar="FILE.json")] = None
    # view that gvtorch view saved: orbit once around in its look, starting at its camera
    state: Annotated[Path | None, option(metavar="FILE.json")] = None
    # duration of one orbit, instead of --frames
    turntable: Annotated[float | None, option(metavar="SECONDS")] = None
    # number of pictures; if left out: 100, one for each of --times, or as many as the times
    # in --keys need
    frames: Annotated[int | None, option(metavar="N")] = None
    # film over time: all time points, or those from A to B; the camera stands still where an orbit
    # starts, unless --turntable, --path FILE.json, --state or --keys move it
    times: Annotated[str | None, option(metavar="all|A-B")] = None
    # pictures per second of a film, --turntable or --keys; if left out: 25
    fps: Annotated[int | None, option(metavar="N")] = None
    # start of an orbit: azimuth and elevation in degrees, distance in largest sides of the box; if
    # left out: as in gvtorch render; without DIST the whole box is in each picture
    orbit: Annotated[str | None, option(metavar="AZ,EL[,DIST]")] = None
    # write what each picture cost, one line of JSON per picture
    stats: Annotated[Path | None, option(metavar="FILE.jsonl")] = None
    # write the camera of each picture: a folder for COLMAP, or .json for Blender and NeRF
    poses: Annotated[Path | None, option(metavar="FOLDER|FILE.json")] = None
    # write a trace of the stages of each frame, for ui.perfetto.dev
    trace: Annotated[Path | None, option(metavar="FILE.json")] = None

    scene: tyro.conf.OmitArgPrefixes[SceneFlags] = SceneFlags()
    annotation: tyro.conf.OmitArgPrefixes[Annotations] = Annotations()

    def run(self) -> None:
        from ..base.stage import Timeline, stage
        from ..cameras import write_cameras
        from ..pictures import Video

        look = self.scene.look
        width, height = parse_size(self.size)
        frames, fps = self._frames_and_fps()
        options = look.options()
        self._check_output(options)
        self._check_path()
        self._check_poses()
        with ExitStack() as stack:
            if self.trace is not None:
                stack.enter_context(Timeline(self.trace, look.device()))
            bar = stack.enter_context(Bar())
            is_film = self.output.suffix in _FILM_SUFFIXES
            film = Video(self.output, width, height, fps=fps) if is_film else None
            writer = _FrameWriter(self.output, film)
            if self.stats is not None:  # at the end: a full disk leaves the old file
                writer.stats_lines = []
                stack.callback(writer.write_stats, self.stats)
            steps = math.inf if self._stands_still() else max(1, frames - 1 + self._loops())
            for time, frame_numbers in self._time_parts(frames):
                source = self.scene.source
                source = source if time is None else replace(source, time=time)
                with replace(self.scene, source=source).open(self.path, options, bar) as scene:
                    take_picture = self._picture_taker(scene, options, width, height)
                    if frame_numbers.start == 0 and film is not None:  # data could be read
                        stack.enter_context(film)
                    elif film is None:
                        self.output.mkdir(exist_ok=True)
                    for number in frame_numbers:
                        bar("frames", number, frames)
                        with stage("frame"):
                            camera, picture = take_picture(number / steps)
                        with stage("save"):
                            writer.add(number, camera, picture)
            bar("frames", frames, frames)
        if film is None:
            self._warn_of_older_pictures(frames)
        if self.poses is not None:
            write_cameras(self.poses, writer.cameras)
        note = f", {writer.incomplete} of them are not complete" if writer.incomplete else ""
        print(f"{printable(self.output)}: {frames} pictures{note}")

    def _check_output(self, options: dict[str, Any]) -> None:
        """Raises ValueError or FileNotFoundError for wrong outputs before the volume is read."""
        is_film = self.output.suffix in _FILM_SUFFIXES
        if self.output.suffix and not is_film:
            suffixes = ", ".join(_FILM_SUFFIXES)
            raise ValueError(
                f"--output must be a folder or end in {suffixes}, got {str(self.output)!r}"
            )
        flight = self.flight if self.flight != "orbit" else None
        inputs = {"PATH": self.path, "--state": self.state, "--keys": self.keys, "--path": flight}
        outputs = {"--output": self.output, "--stats": self.stats, "--poses": self.poses}
        files = self.scene.look.files()
        check_outputs({**inputs, **files}, {**outputs, "--trace": self.trace})
        if is_film and options["background"] is None:
            raise ValueError(f"--background transparent is for pictures, not {self.output.suffix}")

    def _warn_of_older_pictures(self, frames: int) -> None:
        """Warns of pictures that an earlier, longer flight left in the folder."""
        numbers = (re.fullmatch(r"(\d{4,})\.png", name) for name in os.listdir(self.output))
        older = [int(match[1]) for match in numbers if match is not None]
        older = [number for number in older if number >= frames]
        if older:
            first = f"{min(older):04d}.png"
            warnings.warn(
                f"{self.output}: holds older pictures as well: {first}, {len(older)} in all",
                stacklevel=2,
            )

    def _loops(self) -> bool:
        """Whether the path ends where it begins, so that its last picture is left out."""
        return self._bare_flight.closed if self._saved is not None else self.flight == "orbit"

    def _stands_still(self) -> bool:
        """Whether the camera stands still: a film over time."""
        moves = self._saved is not None or self.turntable is not None or self.flight != "orbit"
        return self.times is not None and not moves

    def _picture_taker(
        self, scene: RenderedScene, options: dict[str, Any], width: int, height: int
    ) -> Callable[[float], tuple[Camera, Picture]]:
        """Returns a function that takes the picture at a position along the path, 0 to 1."""
        from ..viewer.state import Eye

        look = self.scene.look
        first_camera = parse_camera(None, look, width, height, scene.info.space)
        base_state = replace(scene.state(options), camera=Eye.of(first_camera, scene.box))
        if self._saved is None:
            path = self._camera_path(scene, width, height)

            def render_at(position: float) -> tuple[ViewState, Camera, Picture]:
                camera = path.camera(position, width, height, look.camera_model)
                annotated = given_flags(self.annotation)
                eye = Eye.of(camera, scene.box) if annotated else base_state.camera
                return replace(base_state, camera=eye), camera, scene.render(camera)
        else:
            flight = self._saved.flight(base_state)
            for _, state in flight.keys:
                name = f"{self._saved.path}: component"
                scene.info.check_component(name, state.component, scene.data.width)

            def render_at(position: float) -> tuple[ViewState, Camera, Picture]:
                state = flight.along(position)
                assert state.camera is not None
                camera = state.camera.camera(width, height, scene.box)
                return state, camera, scene.picture(state, camera)

        def take_picture(position: float) -> tuple[Camera, Picture]:
            state, camera, picture = render_at(position)
            overlay = self.annotation.overlay(state, scene.info, camera)
            return camera, picture if overlay is None else overlay.over(picture)

        return take_picture

    @cached_property
    def _saved(self) -> KeyFile | StateFile | None:
        """The content of --keys or --state, read once: files may change while pictures are made."""
        from ..viewer.flight import KeyFile, StateFile

        if self.keys is not None:
            return KeyFile(self.keys)
        return None if self.state is None else StateFile(self.state)

    @cached_property
    def _bare_flight(self) -> Flight:
        """The flight before the data are known: with its times, its length and its models."""
        from ..shaders import TransferFunction
        from ..viewer.state import Eye, ViewState

        placeholder = Eye(eye=(0, 0, 1), target=(0, 0, 0))
        assert self._saved is not None
        return self._saved.flight(ViewState(shader=TransferFunction([(0, 1)]), camera=placeholder))

    def _time_parts(self, frames: int) -> list[tuple[int | None, range]]:
        """Returns time points and the numbers of their pictures; None: the one of --time."""
        if self.times is None:
            return [(None, range(frames))] if self._saved is None else self._key_parts(frames)
        times = self._selected_times()
        ends = [-(-number * frames // len(times)) for number in range(len(times) + 1)]
        return [(t, range(a, b)) for t, a, b in zip(times, ends, ends[1:], strict=False) if a < b]

    def _key_parts(self, frames: int) -> list[tuple[int | None, range]]:
        """Returns the same by the times of key frames: runs of pictures of one time point."""
        flight = self._bare_flight
        if all(state.time == 0 for _, state in flight.keys):
            return [(None, range(frames))]
        if self.scene.source.time is not None:
            raise ValueError(f"{self._state_flag} sets what --time sets: leave one out")
        steps = max(1, frames - 1 + flight.closed)
        times = [round(flight.along(n / steps).time) for n in range(frames)]
        count = self._time_count
        if not 0 <= min(times) <= max(times) < count:
            time = next(t for t in times if not 0 <= t < count)
            raise ValueError(
                f"{self.keys or self.state}: time must be from 0 to {count - 1} of {self.path}, "
                f"got {time}"
            )
        starts = [n for n in range(frames) if n == 0 or times[n] != times[n - 1]]
        return [(times[a], range(a, b)) for a, b in pairwise((*starts, frames))]

    @cached_property
    def _time_count(self) -> int:
        from ..io.reading import open_source
        from ..io.stores.store import Store

        if is_zarr(self.path):
            return Store.open(self.path, image=self.scene.streaming.image).times
        options = self.scene.source.options()
        del options["nan"]
        return open_source(self.path, **options).times

    def _selected_times(self) -> range:
        """Returns the time points that `--times` selects."""
        if self.scene.source.time is not None:
            raise ValueError("--times and --time both choose time points: leave one out")
        count = self._time_count
        first, last = (whole_number(n) for n in (self.times or "").partition("-")[::2])
        if self.times == "all":
            return range(count)
        if first is not None and last is not None and first <= last < count:
            return range(first, last + 1)
        raise ValueError(
            f"--times must be all or A-B, from 0 to {count - 1} of {self.path}, got {self.times!r}"
        )

    def _frames_and_fps(self) -> tuple[int, int]:
        """Returns the number of pictures, and pictures a second."""
        from ..base import check

        fps = check.integer("fly", "--fps", 25 if self.fps is None else self.fps, low=1, high=1000)
        if self.keys is not None:
            frames = self._bare_flight.count(fps) if self.frames is None else self.frames
            return check.integer("fly", "--frames", frames, low=1), fps
        if self.turntable is None:
            if self.fps is not None and self.output.suffix not in _FILM_SUFFIXES:
                raise ValueError("--fps is for a film or --turntable: pictures have no speed")
            default_frames = 100 if self.times is None else len(self._selected_times())
            frames = default_frames if self.frames is None else self.frames
            return check.integer("fly", "--frames", frames, low=1), fps
        if self.frames is not None:
            problem = "both set the number of pictures: leave one out"
            raise ValueError(f"--turntable and --frames {problem}")
        if self.flight != "orbit":
            raise ValueError("--turntable goes once around: not with --path FILE.json")
        from ..viewer.flight import MAX_PICTURES

        limits: Any = {"low": 0, "high": MAX_PICTURES / fps, "open_low": True}
        seconds = check.number("fly", "--turntable", self.turntable, **limits)
        return max(1, round(seconds * fps)), fps

    def _check_path(self) -> None:
        """Raises ValueError for a wrong path before the volume is read."""
        if self._saved is not None:
            self._check_states()
        elif self.flight != "orbit":
            if self.orbit is not None:
                raise ValueError("--orbit is for --path orbit, not for keys")
            self._read_path()
        elif self.orbit is not None:
            parse_orbit("--orbit", self.orbit)

    def _check_poses(self) -> None:
        """Raises ValueError for a wrong --poses before there are pictures."""
        if self.poses is None:
            return
        is_folder = not self.poses.suffix and not self.poses.is_file()
        if not is_folder and self.poses.suffix != ".json":
            raise ValueError(f"--poses must be a folder or end in .json, got {self.poses}")
        models = [self.scene.look.camera_model]
        if self._saved is not None:
            models = [s.camera.model for _, s in self._bare_flight.keys if s.camera is not None]
        unsupported = next((model for model in models if model not in ("pinhole", "fisheye")), None)
        if unsupported is not None:
            raise ValueError(f"--poses can write pinhole and fisheye, not {unsupported}")

    def _check_states(self) -> None:
        """Raises ValueError if a flag sets what the saved states set."""
        flight = self._bare_flight  # raises if it is wrong
        path = self.flight if self.flight != "orbit" else None
        flag_values: dict[str, Any] = {"--path": path, "--orbit": self.orbit}
        if self.keys is not None:
            flag_values |= {"--turntable": self.turntable, "--state": self.state}
        flags = [name for name, value in flag_values.items() if value]
        if self.times is not None and any(state.time != 0 for _, state in flight.keys):
            flags.append("--times")
        assert self._saved is not None
        self.scene.look.check_state(self._state_flag, self._saved.first_fields, flags)

    @property
    def _state_flag(self) -> str:
        return "--state" if self.keys is None else "--keys"

    def _read_path(self) -> CameraPath:
        from ..cameras.path import CameraPath

        look = self.scene.look
        return CameraPath.from_json(self.flight, up=look.up_direction(), fov=look.fov)

    def _camera_path(self, scene: RenderedScene, width: int, height: int) -> CameraPath:
        from ..cameras.path import CameraPath

        if self.flight != "orbit":
            return self._read_path()
        text = self.orbit or default_orbit(scene.info.space)
        azimuth, elevation, distance = parse_orbit("--orbit", text)
        look = self.scene.look
        return CameraPath.orbit(
            *(scene.box, look.camera_model, look.fov),
            azimuth=azimuth,
            elevation=elevation,
            distance=distance,
            up=look.up_direction() or up_and_front(scene.info.space)[0],
            fit_size=(width, height) if distance is None else None,
        )


class _FrameWriter:
    """Writes a flight's pictures to a film or a folder, and their statistics to a file."""

    def __init__(self, output: Path, film: Video | None) -> None:
        self._output, self._film = output, film
        self.stats_lines: list[str] | None = None  # of JSON, if statistics are wanted
        self.incomplete = 0
        self.cameras: dict[str, Camera] = {}

    def add(self, number: int, camera: Camera, picture: Picture) -> None:
        name, stats = f"{number:04d}.png", picture.stats.as_dict()
        self.cameras[name] = camera
        self.incomplete += not stats.get("converged", True)
        if self.stats_lines is not None:
            self.stats_lines.append(json.dumps({"picture": number, **stats}) + "\n")
        if self._film is not None:
            self._film.add(picture)
        else:
            picture.save(self._output / name)

    def write_stats(self, path: Path) -> None:
        """Writes the statistics of the pictures, if there are any."""
        if self.stats_lines:
            write_text(path, "".join(self.stats_lines))
