"""`gvtorch render`: a picture of a volume or of a store."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional

from ..base.messages import printable
from ..base.whole_file import write_text
from .annotations import Annotations
from .common import Bar, check_outputs, given_flags, option, parse_size, volume_formats
from .look import parse_camera
from .scene import RenderedScene, SceneFlags
from .streaming import cost_summary

if TYPE_CHECKING:
    from ..base.records import RenderStats
    from ..cameras import Camera
    from ..pictures import Overlay, Picture
    from ..viewer.state import Eye, ViewState

PICTURE_SUFFIXES = (".png", ".exr", ".npy", ".npz", ".tif")
STRIP_SUFFIXES = (".npy", ".tif")  # written strip by strip: the picture may be larger than memory


@dataclass(frozen=True, kw_only=True)
class DevelopmentFlags:
    """How the picture is developed."""

    # rays per pixel, at different positions in it
    samples: Annotated[int, option(metavar="N")] = 1
    # tone mapping curve, from scene light to the display
    tone: Literal["none", "reinhard", "aces"] = "none"
    # multiply the light by 2^STOPS
    exposure: Annotated[float, option(metavar="STOPS")] = 0.0

    def wrap(self, render: Callable[[Camera], Picture]) -> Callable[[Camera], Picture]:
        """Returns a function that renders a camera with all samples, tone-mapped."""
        from ..base import check
        from ..pictures import Progressive
        from ..pictures.tone import checked_curve

        check.integer("render", "--samples", self.samples, low=1)
        checked_curve("render", self.tone, self.exposure)

        def developed(camera: Camera) -> Picture:
            if self.samples > 1:
                picture = Progressive(render).refine(camera, self.samples)
            else:
                picture = render(camera)
            if self.tone == "none" and self.exposure == 0:
                return picture
            return picture.tone_map(self.tone, exposure=self.exposure)

        return developed


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render a volume or a store to a picture."""

    path: Positional[Annotated[str, option(metavar="PATH", help=f"a volume: {volume_formats()}")]]
    # picture to write: .png, .exr, .tif, .npy or .npz; .png, .tif and .npy may exceed memory
    output: Annotated[Path, option(aliases=["-o"], metavar="OUT.png")]
    # width and height of the picture in pixels
    size: Annotated[str, option(metavar="WxH")] = "512x512"
    # bits of each number: 8 or 16 for .png; 8, 16 or 32 (float) for .tif; 32 or 16 (float)
    # for .exr; if left out: the first of these
    bits: Annotated[int | None, option(metavar="N")] = None
    # also write arrays: float32 color, alpha and depth, int32 samples; normal, features and label
    # where they exist
    npz: Annotated[Path | None, option(metavar="OUT.npz")] = None
    # write statistics: milliseconds, rays, samples, nodes, bricks, bytes; for stores also requests
    # and misses
    stats: Annotated[Path | None, option(metavar="FILE.json")] = None
    # view that gvtorch view saved: sets camera, shader and everything else about the look
    # but --size
    state: Annotated[Path | None, option(metavar="FILE.json")] = None
    # orbit:AZIMUTH,ELEVATION (degrees; at azimuth 0, +x points to the right), at the distance from
    # which the whole box is in the picture; orbit:AZIMUTH,ELEVATION,DISTANCE (in largest sides of
    # the box); look:ex,ey,ez,tx,ty,tz (eye and target in world units); or file:PATH or
    # file:PATH,NAME (ParaView .pvcc, Blender or NeRF .json, COLMAP folder); if left out:
    # orbit:30,20, for scans of patients from the front
    camera: Annotated[str | None, option(metavar="CAMERA")] = None
    # the picture, or for each pixel: samples taken, nodes visited, lod (mean depth of nodes seen),
    # age (frames since their bricks were made), fill (share of their voxels that is not
    # transparent)
    show: Literal["picture", "samples", "nodes", "lod", "age", "fill"] = "picture"

    scene: tyro.conf.OmitArgPrefixes[SceneFlags] = SceneFlags()
    development: tyro.conf.OmitArgPrefixes[DevelopmentFlags] = DevelopmentFlags()
    annotation: tyro.conf.OmitArgPrefixes[Annotations] = Annotations()

    def run(self) -> None:
        look = self.scene.look
        width, height = parse_size(self.size)
        self._check()
        parse_camera(self.camera, look, width, height)
        options = look.options()
        flags = self._at_saved_time()
        with Bar() as bar, flags.open(self.path, options, bar) as scene:
            if self.state is None:
                camera = parse_camera(self.camera, look, width, height, scene.info.space)
                stats = self._write_picture(scene, camera, None, bar)
            else:
                state = scene.state(options).read(self.state)
                stats = self._write_saved(scene, state, bar)
        if self.stats is not None:
            content = {**stats.as_dict(), "extent": scene.data.extent}
            write_text(self.stats, json.dumps(content, indent=2) + "\n")
        print(f"{printable(self.output)}: {width}x{height}, {cost_summary(stats)}")

    def _at_saved_time(self) -> SceneFlags:
        """Returns the scene's flags; without --time, at the time point of the saved state."""
        source = self.scene.source
        if self.state is None or source.time is not None:
            return self.scene
        from ..base import check
        from ..viewer.state import saved_state

        saved_time = saved_state(self.state).get("time", 0.0)
        time = check.number(f"{self.state}: state", "time", saved_time)
        if time != int(time):
            raise ValueError(f"{self.state}: time must be the number of a time point, got {time:g}")
        return replace(self.scene, source=replace(source, time=int(time))) if time else self.scene

    def _check_state(self) -> None:
        """Raises ValueError if a flag sets what a saved state sets."""
        if self.state is None:
            return
        from ..viewer.state import saved_state

        state = saved_state(self.state)
        flags = self.scene.look.flags_set_by(state) + given_flags(self.development)
        flags += ["--camera"] * (self.camera is not None) + ["--show"] * (self.show != "picture")
        if flags:
            raise ValueError(f"--state sets what {flags[0]} sets: leave one out")

    def _check(self) -> None:
        """Raises ValueError or FileNotFoundError for wrong flags before the volume is read."""
        self._check_state()
        from ..pictures.files import checked_path

        _check_suffix("--output", self.output, *PICTURE_SUFFIXES)
        if self.npz is not None:
            if self.output.suffix in STRIP_SUFFIXES:
                raise ValueError(f"--npz holds a whole picture: not with {self.output.suffix}")
            _check_suffix("--npz", self.npz, ".npz")
        for file in (self.output, self.npz, self.stats):
            if file is not None and not file.parent.is_dir():
                raise FileNotFoundError(f"folder not found: {file.parent}")
        checked_path("--output", self.output, self.bits, PICTURE_SUFFIXES)
        check_outputs(
            {"PATH": self.path, "--state": self.state, **self.scene.look.files()},
            {"--output": self.output, "--npz": self.npz, "--stats": self.stats},
        )
        if self.show != "picture":
            flags = given_flags(self.annotation)
            if self.npz is None:
                flags = given_flags(self.development) + flags
            if flags:
                raise ValueError(f"{flags[0]} is for pictures, not for --show {self.show}")

    def _write_saved(self, scene: RenderedScene, state: ViewState, bar: Bar) -> RenderStats:
        """Renders and writes the picture of a saved state, as a page shows it."""
        from ..viewer.slices import panes

        if state.composed and (flags := given_flags(self.annotation)):
            raise ValueError(f"{flags[0]} is for a picture alone: {self.state} has slices or costs")
        settings = {"shader": state.shader, **state.settings()}
        render, cost = partial(scene.render, **settings), partial(scene.cost, **settings)
        saved_scene = replace(scene, shader=state.shader, render=render, cost=cost)
        development = DevelopmentFlags(**vars(state.develop))
        command = replace(self, show=state.show, development=development)
        width, height = parse_size(self.size)
        if state.slices is not None:
            _, _, width, height = panes(width, height)["view"]
        if state.camera is None:
            camera = parse_camera(None, self.scene.look, width, height, saved_scene.info.space)
        else:
            camera = state.camera.camera(width, height, saved_scene.box)
        return command._write_picture(saved_scene, camera, state, bar)

    def _write_picture(
        self, scene: RenderedScene, camera: Camera, state: ViewState | None, bar: Bar
    ) -> RenderStats:
        """Renders and writes the files, strip by strip where the file format allows it; a saved
        state may add slices beside the picture and costs over it.
        """
        from ..pictures import render_tiles
        from ..viewer.state import blended

        composed = state is not None and state.composed
        needs_whole = self.npz is not None or self.show != "picture" or composed
        strips = not needs_whole and in_strips(self.output.suffix, camera.width, camera.height)
        render = scene.render if strips else partial(scene.render, progress=bar)
        render = self.development.wrap(render)
        anything_seen = False

        def noting_render(camera: Camera) -> Picture:
            nonlocal anything_seen
            picture = render(camera)
            anything_seen = anything_seen or bool(picture.alpha.any())
            return picture

        overlay = self._overlay(scene, camera, None if state is None else state.camera)
        if strips:
            stats = render_tiles(
                *(noting_render, camera, self.output), bits=self.bits, overlay=overlay, progress=bar
            )
        else:
            picture = canvas = noting_render(camera)
            if self.show != "picture":
                cost = scene.cost(camera).picture(self.show)
                canvas = blended(picture, cost, 1 if state is None else state.blend)
            if state is not None and state.slices is not None:
                from ..viewer.slices import Planes

                planes = Planes(scene.data, lambda problem: None)
                canvas = planes.composed(canvas, state, *parse_size(self.size), wait=True).picture
                planes.close()
            canvas = canvas if overlay is None else overlay.over(canvas)
            canvas.save(self.output, bits=self.bits)
            if self.npz is not None:
                picture.save(self.npz)
            stats = picture.stats
        if not (anything_seen or composed or self.show != "picture"):
            limits = getattr(scene.data, "value_range", None)
            if isinstance(limits, list):  # a store has one for each channel
                limits = limits[self.scene.look.component]
            note = "" if limits is None else f": values range from {limits[0]:g} to {limits[1]:g}"
            warnings.warn(f"nothing is seen{note}", stacklevel=2)
        return stats

    def _overlay(self, scene: RenderedScene, camera: Camera, eye: Eye | None) -> Overlay | None:
        from ..viewer.state import Eye

        world_camera, component = camera.placed(scene.box), self.scene.look.component
        eye = Eye.of(camera, scene.box) if eye is None else eye
        return self.annotation.overlay(scene.shader, scene.info, component, world_camera, eye)


def in_strips(suffix: str, width: int, height: int) -> bool:
    """Returns whether a picture is written strip by strip; a PNG if it is larger than a strip."""
    from ..base import check
    from ..pictures.progressive import STRIP, strip_rows

    rows = strip_rows(check.nbytes("render", "memory", STRIP), width, height)
    return suffix in STRIP_SUFFIXES or (suffix == ".png" and rows < height)


def _check_suffix(flag: str, path: Path, *suffixes: str) -> None:
    if path.suffix not in suffixes:
        raise ValueError(f"{flag} must end in {', '.join(suffixes)}, got {str(path)!r}")
