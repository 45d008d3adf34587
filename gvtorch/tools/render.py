"""`gvtorch render`: a picture of a volume or of a store."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from .common import Bar, given, size, volume_formats
from .drawn import Drawn
from .image import KINDS, STRIPS, Develop, in_strips
from .look import parse_camera
from .scene import Scene, SceneFlags
from .streaming import told

if TYPE_CHECKING:
    from ..base.records import RenderStats
    from ..cameras import Camera
    from ..pictures import Overlay, Picture
    from ..viewer.state import Eye


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
        with Bar() as bar, self.scene.open(self.path, options, bar) as opened:
            scene, eye, taking = self._as_saved(opened, options)
            camera = parse_camera(self.camera, look, width, height, scene.space)
            camera = camera if eye is None else eye.camera(width, height, scene.box)
            stats = taking._take(scene, camera, taking._overlay(scene, camera, eye), bar)
        if self.stats is not None:
            content = {**stats.as_dict(), "extent": scene.extent}
            self.stats.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        print(f"{self.output}: {width}x{height}, {told(stats)}")

    def _as_saved(self, scene: Scene, options: dict[str, Any]) -> tuple[Scene, Eye | None, Render]:
        """The scene as a saved state shows it, its camera, and this command with its flags."""
        if self.state is None:
            return scene, None, self
        now = scene.state(options).read(self.state)
        own = {"shader": now.shader, **now.settings()}
        shown = replace(
            scene,
            shader=now.shader,
            render=partial(scene.render, **own),
            cost=partial(scene.cost, **own),
        )
        return shown, now.camera, replace(self, show=now.show, develop=Develop(**vars(now.develop)))

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
        if self.show != "picture":
            flags = (self.develop.given() if self.npz is None else []) + self.drawn.given()
            if flags:
                raise ValueError(f"{flags[0]} is for pictures, not for --show {self.show}")

    def _overlay(self, scene: Scene, camera: Camera, eye: Eye | None) -> Overlay | None:
        """What is drawn over the picture."""
        from ..viewer.state import Eye

        placed, component = camera.placed(scene.box), self.scene.look.component
        eye = Eye.of(camera, scene.box) if eye is None else eye
        return self.drawn.overlay(scene.shader, scene.info, component, placed, eye)

    def _take(self, scene: Scene, camera: Camera, overlay: Overlay | None, bar: Bar) -> RenderStats:
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

    def warn_of_nothing(self, scene: Scene) -> None:
        """Warns where nothing was seen."""
        if not self._any:
            ends = scene.values
            known = "" if ends is None else f": values range from {ends[0]:g} to {ends[1]:g}"
            warnings.warn(f"nothing is seen{known}", stacklevel=3)


def _check_suffix(flag: str, path: Path, *kinds: str) -> None:
    if path.suffix not in kinds:
        raise ValueError(f"{flag} must end in {', '.join(kinds)}, got {str(path)!r}")
