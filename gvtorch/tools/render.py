"""`gvtorch render`: a picture of a volume or of a store."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from .common import Bar, given, size, volume_formats
from .image import KINDS, STRIPS, Develop
from .look import parse_camera
from .scene import Scene, SceneFlags
from .streaming import told

if TYPE_CHECKING:
    from ..base.records import RenderStats
    from ..cameras import Camera


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render a volume or a store to a picture."""

    path: Positional[Annotated[str, arg(metavar="PATH", help=f"a volume: {volume_formats()}")]]
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT.png")]
    """the picture: .png, .exr, .tif, .npy or .npz; .tif and .npy may be larger than memory"""
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
    look:ex,ey,ez,tx,ty,tz (world units); if left out orbit:30,20, of patients from the front"""
    show: Literal["picture", "samples", "nodes", "lod", "age", "fill"] = "picture"
    """the picture, or what each ray cost: samples, nodes visited; or what it saw: depth of the
    nodes, age of the bricks in frames, share of their voxels that is not transparent"""
    scene: tyro.conf.OmitArgPrefixes[SceneFlags] = SceneFlags()
    develop: tyro.conf.OmitArgPrefixes[Develop] = Develop()

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
                stats = self._take(opened, camera, bar)
            else:
                stats = self._take_saved(opened, options, bar)
        if self.stats is not None:
            content = {**stats.as_dict(), "extent": opened.extent}
            self.stats.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        print(f"{self.output}: {width}x{height}, {told(stats)}")

    def _at_saved_time(self) -> SceneFlags:
        """The flags of the scene, of the time point that a saved state tells."""
        source = self.scene.source
        if self.state is None or source.time is not None:
            return self.scene
        from ..viewer.state import saved_time

        time = saved_time(self.state)
        if time != int(time):
            raise ValueError(f"{self.state}: time must be the number of a time point, got {time:g}")
        return replace(self.scene, source=replace(source, time=int(time))) if time else self.scene

    def _take_saved(self, scene: Scene, options: dict[str, Any], bar: Bar) -> RenderStats:
        """Takes the picture of a saved state, as a page shows it."""
        from ..tracing import RenderOptions
        from ..viewer.slices import Planes, panes
        from ..viewer.state import ViewState, blended

        assert self.state is not None
        component = options["component"]
        now = ViewState(
            shader=scene.shader, options=RenderOptions(**options), component=component
        ).read(self.state)
        own = {"shader": now.shader, **now.settings()}
        shown = replace(scene, render=partial(scene.render, **own), cost=partial(scene.cost, **own))
        taking = replace(self, show=now.show, develop=Develop(**vars(now.develop)))
        width, height = size(self.scene.look.size)
        part = (width, height) if now.slices is None else panes(width, height)["view"][2:]
        if now.camera is None:
            camera = parse_camera(None, self.scene.look, *part, scene.space)
        else:
            camera = now.camera.camera(*part, scene.box)
        if now.slices is None and now.blend == 1:
            return taking._take(shown, camera, bar)
        picture = taking.develop.wrap(partial(shown.render, progress=bar))(camera)
        whole = picture
        if now.show != "picture":
            whole = blended(picture, shown.cost(camera).picture(now.show), now.blend)
        if now.slices is not None:
            planes = Planes(scene.data, lambda problem: None)
            whole = planes.composed(whole, now, width, height, wait=True).picture
        whole.save(self.output, bits=self.bits)
        if self.npz is not None:
            picture.save(self.npz)
        return picture.stats

    def _check_state(self) -> None:
        """Raises ValueError where a flag tells what a saved state does."""
        if self.state is None:
            return
        if not self.state.is_file():
            raise FileNotFoundError(f"state not found: {self.state}")
        free = ("--size", "--backend", "--brick-size", "--border", "--component", "--up")
        flags = [one for one in given(self.scene.look) if one not in free] + self.develop.given()
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
        if self.show != "picture" and self.npz is None:
            flags = self.develop.given()
            if flags:
                raise ValueError(f"{flags[0]} is for pictures, not for --show {self.show}")

    def _take(self, scene: Scene, camera: Camera, bar: Bar) -> RenderStats:
        """Renders and writes the files, strip by strip where the kind of file lets it."""
        from ..pictures import render_tiles

        if self.output.suffix in STRIPS and self.show == "picture":
            developed = self.develop.wrap(scene.render)
            return render_tiles(developed, camera, self.output, bits=self.bits, progress=bar)
        picture = self.develop.wrap(partial(scene.render, progress=bar))(camera)
        if self.show == "picture" and not bool(picture.alpha.any()):
            ends = scene.values
            known = "" if ends is None else f": values range from {ends[0]:g} to {ends[1]:g}"
            warnings.warn(f"nothing is seen{known}", stacklevel=2)
        shown = picture if self.show == "picture" else scene.cost(camera).picture(self.show)
        shown.save(self.output, bits=self.bits)
        if self.npz is not None:
            picture.save(self.npz)
        return picture.stats


def _check_suffix(flag: str, path: Path, *kinds: str) -> None:
    if path.suffix not in kinds:
        raise ValueError(f"{flag} must end in {', '.join(kinds)}, got {str(path)!r}")
