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
from tyro.conf import Positional, arg

from ..base.messages import printable
from ..base.whole_file import write_whole
from .common import Bar, check_outputs, size, volume_formats
from .drawn import Drawn
from .image import KINDS, STRIPS, Develop, in_strips
from .look import parse_camera
from .scene import RenderedScene, SceneFlags
from .streaming import cost_in_words

if TYPE_CHECKING:
    from ..base.records import RenderStats
    from ..cameras import Camera
    from ..pictures import Overlay, Picture
    from ..viewer.state import Eye, ViewState


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render a volume or a store to a picture."""

    path: Positional[Annotated[str, arg(metavar="PATH", help=f"a volume: {volume_formats()}")]]
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT.png")]
    """the picture: .png, .exr, .tif, .npy or .npz; .png, .tif and .npy may be larger than memory"""
    bits: Annotated[int | None, arg(metavar="N")] = None
    """of a number in the file: 8 or 16 of .png, and 32 (float) of .tif; 32 or 16 of .exr"""
    npz: Annotated[Path | None, arg(metavar="OUT.npz")] = None
    """float32 color, alpha and depth, int32 samples"""
    stats: Annotated[Path | None, arg(metavar="FILE.json")] = None
    """milliseconds, rays, samples, nodes, bricks, bytes; of stores requests and misses too"""
    state: Annotated[Path | None, arg(metavar="FILE.json")] = None
    """what gvtorch view saved: camera, shader and all that says how it is shown; a picture of
    --size"""
    camera: Annotated[str | None, arg(metavar="CAMERA")] = None
    """orbit:AZIMUTH,ELEVATION (degrees; +x runs to the right at azimuth 0), from where the whole
    box is in the picture; orbit:AZIMUTH,ELEVATION,DISTANCE (largest sides of the box); or
    look:ex,ey,ez,tx,ty,tz (world units); file:PATH or file:PATH,NAME, of ParaView (.pvcc), Blender
    or NeRF (.json) or COLMAP (a folder); if left out orbit:30,20, of patients from the front"""
    show: Literal["picture", "samples", "nodes", "lod", "age", "fill"] = "picture"
    """the picture, or what each ray cost: samples, nodes visited; or what it saw: depth of the
    nodes, age of the bricks in frames, share of their voxels that is not transparent"""
    scene: tyro.conf.OmitArgPrefixes[SceneFlags] = SceneFlags()
    develop: tyro.conf.OmitArgPrefixes[Develop] = Develop()
    drawn: tyro.conf.OmitArgPrefixes[Drawn] = Drawn()

    def run(self) -> None:
        """Reads, renders, writes."""
        look = self.scene.look
        width, height = size(look.size)
        self._check()
        parse_camera(self.camera, look, width, height)
        options = look.options()
        flags = self._at_saved_time()
        with Bar() as bar, flags.open(self.path, options, bar) as opened:
            if self.state is None:
                camera = parse_camera(self.camera, look, width, height, opened.space)
                stats = self._take(opened, camera, self._overlay(opened, camera, None), bar)
            else:
                now = opened.state(options).read(self.state)
                stats = self._take_saved(opened, now, width, height, bar)
        if self.stats is not None:
            content = {**stats.as_dict(), "extent": opened.extent}
            write_whole(self.stats, json.dumps(content, indent=2) + "\n")
        print(f"{printable(self.output)}: {width}x{height}, {cost_in_words(stats)}")

    def _at_saved_time(self) -> SceneFlags:
        """The flags of the scene, of the time point that a saved state tells."""
        source = self.scene.source
        if self.state is None or source.time is not None:
            return self.scene
        from ..base import check
        from ..viewer.state import saved_state

        told = saved_state(self.state).get("time", 0.0)
        time = check.number(f"{self.state}: state", "time", told)
        if time != int(time):
            raise ValueError(f"{self.state}: time must be the number of a time point, got {time:g}")
        return replace(self.scene, source=replace(source, time=int(time))) if time else self.scene

    def _take_saved(
        self, opened: RenderedScene, now: ViewState, width: int, height: int, bar: Bar
    ) -> RenderStats:
        """Takes the picture of a saved state, as a page shows it."""
        own = {"shader": now.shader, **now.settings()}
        render, cost = partial(opened.render, **own), partial(opened.cost, **own)
        scene = replace(opened, shader=now.shader, render=render, cost=cost)
        taking = replace(self, show=now.show, develop=Develop(**vars(now.develop)))
        if now.composed:
            return taking._take_composed(scene, now, width, height, bar)
        camera = self._saved_camera(scene, now, width, height)
        return taking._take(scene, camera, taking._overlay(scene, camera, now.camera), bar)

    def _saved_camera(
        self, scene: RenderedScene, now: ViewState, width: int, height: int
    ) -> Camera:
        """The camera of a saved state, for a picture of this size."""
        if now.camera is None:
            return parse_camera(None, self.scene.look, width, height, scene.space)
        return now.camera.camera(width, height, scene.box)

    def _take_composed(
        self, scene: RenderedScene, now: ViewState, width: int, height: int, bar: Bar
    ) -> RenderStats:
        """Takes a picture with planes beside it or costs over it."""
        from ..viewer.slices import Planes, panes
        from ..viewer.state import blended

        if self.drawn.given():
            raise ValueError(
                f"{self.drawn.given()[0]} is for a picture alone: {self.state} has slices or costs"
            )
        part = (width, height) if now.slices is None else panes(width, height)["view"][2:]
        camera = self._saved_camera(scene, now, *part)
        picture = self.develop.wrap(partial(scene.render, progress=bar))(camera)
        whole = picture
        if now.show != "picture":
            whole = blended(picture, scene.cost(camera).picture(now.show), now.blend)
        if now.slices is not None:
            planes = Planes(scene.data, lambda problem: None)
            whole = planes.composed(whole, now, width, height, wait=True).picture
            planes.close()
        whole.save(self.output, bits=self.bits)
        if self.npz is not None:
            picture.save(self.npz)
        return picture.stats

    def _check_state(self) -> None:
        """Raises ValueError where a flag tells what a saved state does."""
        if self.state is None:
            return
        from ..viewer.state import saved_state

        state = saved_state(self.state)
        flags = self.scene.look.told_by(state) + self.develop.given()
        flags += ["--camera"] * (self.camera is not None) + ["--show"] * (self.show != "picture")
        if flags:
            raise ValueError(f"--state tells what {flags[0]} does: leave one out")

    def _check(self) -> None:
        """Raises what is wrong with files and flags before the volume is read."""
        self._check_state()
        from ..pictures.files import checked_path

        _check_suffix("--output", self.output, *KINDS)
        if self.npz is not None:
            if self.output.suffix in STRIPS:
                raise ValueError(f"--npz holds a whole picture: not with {self.output.suffix}")
            _check_suffix("--npz", self.npz, ".npz")
        for file in (self.output, self.npz, self.stats):
            if file is not None and not file.parent.is_dir():
                raise FileNotFoundError(f"folder not found: {file.parent}")
        checked_path("--output", self.output, self.bits, KINDS)
        check_outputs(
            {"PATH": self.path, "--state": self.state, **self.scene.look.files()},
            {"--output": self.output, "--npz": self.npz, "--stats": self.stats},
        )
        if self.show != "picture":
            flags = (self.develop.given() if self.npz is None else []) + self.drawn.given()
            if flags:
                raise ValueError(f"{flags[0]} is for pictures, not for --show {self.show}")

    def _overlay(self, scene: RenderedScene, camera: Camera, eye: Eye | None) -> Overlay | None:
        """What is drawn over the picture."""
        from ..viewer.state import Eye

        placed, component = camera.placed(scene.box), self.scene.look.component
        eye = Eye.of(camera, scene.box) if eye is None else eye
        return self.drawn.overlay(scene.shader, scene.info, component, placed, eye)

    def _take(
        self, scene: RenderedScene, camera: Camera, overlay: Overlay | None, bar: Bar
    ) -> RenderStats:
        """Renders and writes the files, strip by strip where the kind of file lets it."""
        from ..pictures import render_tiles

        whole = self.npz is not None or self.show != "picture"
        if not whole and in_strips(self.output.suffix, camera.width, camera.height):
            seen = _Seen(self.develop.wrap(scene.render))
            stats = render_tiles(
                *(seen, camera, self.output), bits=self.bits, overlay=overlay, progress=bar
            )
            seen.warn_of_nothing(scene)
            return stats
        seen = _Seen(self.develop.wrap(partial(scene.render, progress=bar)))
        picture = seen(camera)
        if self.show == "picture":
            seen.warn_of_nothing(scene)
        shown = picture if self.show == "picture" else scene.cost(camera).picture(self.show)
        shown = shown if overlay is None else overlay.over(shown)
        shown.save(self.output, bits=self.bits)
        if self.npz is not None:
            picture.save(self.npz)
        return picture.stats


class _Seen:
    """Renders, and knows whether anything was seen."""

    def __init__(self, render: Callable[[Camera], Picture]) -> None:
        self._render, self._any = render, False

    def __call__(self, camera: Camera) -> Picture:
        """Renders a picture or a strip of one."""
        picture = self._render(camera)
        self._any = self._any or bool(picture.alpha.any())
        return picture

    def warn_of_nothing(self, scene: RenderedScene) -> None:
        """Warns where nothing was seen."""
        if not self._any:
            ends = scene.values
            known = "" if ends is None else f": values range from {ends[0]:g} to {ends[1]:g}"
            warnings.warn(f"nothing is seen{known}", stacklevel=3)


def _check_suffix(flag: str, path: Path, *kinds: str) -> None:
    if path.suffix not in kinds:
        raise ValueError(f"{flag} must end in {', '.join(kinds)}, got {str(path)!r}")
