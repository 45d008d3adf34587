"""`gvtorch render`: a picture of a volume or of a store."""

from __future__ import annotations

import json
import warnings
from contextlib import closing
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
    from ..pictures import Picture
    from ..viewer.state import Development, ViewState

STRIP_SUFFIXES = (".npy", ".tif")  # written strip by strip: the picture may be larger than memory


@dataclass(frozen=True, kw_only=True)
class DevelopmentFlags:
    """Rays per pixel, exposure and tone curve."""

    # rays per pixel, at different positions in it
    samples: Annotated[int, option(metavar="N")] = 1
    # tone mapping curve, from scene light to the display
    tone: Literal["none", "reinhard", "aces"] = "none"
    # multiply the light by 2^STOPS
    exposure: Annotated[float, option(metavar="STOPS")] = 0.0

    def checked(self) -> Development:
        """Returns the flags as a part of a state; raises ValueError if one is out of its range."""
        from ..base import check
        from ..viewer.state import Development

        check.integer("render", "--samples", self.samples, low=1)
        return Development(**vars(self))


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
        options, development = look.options(), self.development.checked()
        flags = self._at_saved_time()
        with Bar() as bar, flags.open(self.path, options, bar) as scene:
            state = scene.state(options)
            if self.state is None:
                state = replace(state, develop=development, show=self.show)
            else:
                state = state.read(self.state)
                name = f"{self.state}: component"
                scene.info.check_component(name, state.component, scene.data.width)
            stats = self._write_picture(scene, state, (width, height), bar)
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

    def _check(self) -> None:
        """Raises ValueError or FileNotFoundError for wrong flags before the volume is read."""
        from ..pictures.files import checked_path
        from ..viewer.state import saved_state

        if self.state is not None:
            flags = given_flags(self.development) + ["--show"] * (self.show != "picture")
            fields = saved_state(self.state)
            self.scene.look.check_state("--state", fields, flags, self.camera)
        checked_path("--output", self.output, self.bits)
        if self.npz is not None:
            if self.output.suffix in STRIP_SUFFIXES:
                raise ValueError(f"--npz holds a whole picture: not with {self.output.suffix}")
            checked_path("--npz", self.npz, suffixes=(".npz",))
        camera = (self.camera or "").removeprefix("file:")
        inputs = {"PATH": self.path, "--state": self.state, "--camera": camera}
        check_outputs(
            {**inputs, **self.scene.look.files()},
            {"--output": self.output, "--npz": self.npz, "--stats": self.stats},
        )
        if self.show != "picture":
            flags = given_flags(self.annotation)
            if self.npz is None:
                flags = given_flags(self.development) + flags
            if flags:
                raise ValueError(f"{flags[0]} is for pictures, not for --show {self.show}")

    def _camera(self, scene: RenderedScene, state: ViewState, size: tuple[int, int]) -> Camera:
        """Returns the camera of the state, or else that of --camera."""
        from ..viewer.slices import panes

        width, height = size if state.slices is None else panes(*size)["view"][2:]
        if state.camera is None:
            return parse_camera(self.camera, self.scene.look, width, height, scene.info.space)
        return state.camera.camera(width, height, scene.box)

    def _write_picture(
        self, scene: RenderedScene, state: ViewState, size: tuple[int, int], bar: Bar
    ) -> RenderStats:
        """Renders and writes what the state shows, strip by strip where the file format allows
        it; a saved state may add slices beside the picture and costs over it.
        """
        from ..pictures import render_tiles
        from ..viewer.state import Eye

        camera = self._camera(scene, state, size)
        needs_whole = self.npz is not None or not state.is_plain
        strips = not needs_whole and in_strips(self.output.suffix, camera.width, camera.height)
        render = scene.render if strips else partial(scene.render, progress=bar)
        anything_seen = False

        def take(camera: Camera) -> Picture:
            nonlocal anything_seen
            picture = state.taken(render, camera)
            anything_seen = anything_seen or bool(picture.alpha.any())
            return picture

        placed = camera.placed(scene.box)
        eye = Eye.of(placed, scene.box) if state.camera is None else state.camera
        overlay = self.annotation.overlay(replace(state, camera=eye), scene.info, placed)
        if strips:
            stats = render_tiles(
                *(take, camera, self.output), bits=self.bits, overlay=overlay, progress=bar
            )
        else:
            picture = take(camera)
            canvas = scene.picture(state, camera, picture)
            if state.slices is not None:
                from ..viewer.slices import Planes

                with closing(Planes(scene.data, lambda problem: None)) as planes:
                    canvas = planes.composed(canvas, state, *size, wait=True).picture
            canvas = canvas if overlay is None else overlay.over(canvas)
            canvas.save(self.output, bits=self.bits)
            if self.npz is not None:
                picture.save(self.npz)
            stats = picture.stats
        if state.is_plain and not anything_seen:
            limits = getattr(scene.data, "value_range", None)
            if isinstance(limits, list):  # a store has one for each channel
                limits = limits[state.component]
            note = "" if limits is None else f": values range from {limits[0]:g} to {limits[1]:g}"
            warnings.warn(f"nothing is seen{note}", stacklevel=2)
        return stats


def in_strips(suffix: str, width: int, height: int) -> bool:
    """Returns whether a picture is written strip by strip; a PNG if it is larger than a strip."""
    from ..base import check
    from ..pictures.progressive import STRIP, strip_rows

    rows = strip_rows(check.nbytes("render", "memory", STRIP), width, height)
    return suffix in STRIP_SUFFIXES or (suffix == ".png" and rows < height)
