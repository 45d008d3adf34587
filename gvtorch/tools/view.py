"""`gvtorch view`: opens a volume, a store or a script's scene in an interactive page."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import Positional

from ..io.stores.ngff import is_zarr
from .common import Bar, given_flags, option, refuse_store_flags, volume_formats
from .look import parse_camera
from .scene import SceneFlags

if TYPE_CHECKING:
    from ..cameras import Camera
    from ..producers import Producer
    from ..shaders import Shader
    from ..viewer.scene import Scene

_SCRIPT_NAMES = ("scene", "shader", "camera", "options")  # that a script may set


def _path_help() -> str:
    """Returns what PATH may be, for the help of this command only, since formats load torch."""
    script = (
        "a Python file that sets scene (what gv.view takes) and optionally shader, camera, options"
    )
    return f"a volume: {volume_formats()}; or {script}"


@dataclass(frozen=True, kw_only=True)
class View:
    """Look at a volume or a store in the browser: turn it, and edit how it is shown."""

    path: Positional[Annotated[str, option(metavar="PATH|SCRIPT.py", help=_path_help())]]
    # view that the page saved: sets camera, shader and everything else about the look
    state: Annotated[Path | None, option(metavar="FILE.json")] = None
    # initial camera, as in gvtorch render
    camera: Annotated[str | None, option(metavar="CAMERA")] = None
    # address to serve the page at; 0.0.0.0: also to other machines, if they know the full address
    host: Annotated[str, option(metavar="ADDRESS")] = "127.0.0.1"
    # port to serve the page at; 0: any free one
    port: Annotated[int, option(metavar="N")] = 0
    # further host names under which browsers may reach this machine
    allow: Annotated[str, option(metavar="NAME,NAME")] = ""
    # open the page in a browser; otherwise only print its address
    browser: bool = True

    scene: tyro.conf.OmitArgPrefixes[SceneFlags] = SceneFlags()

    def run(self) -> None:
        from ..viewer import view
        from ..viewer.server import aiohttp_web
        from ..viewer.state import saved_state

        aiohttp_web()
        if self.state is not None:
            state = saved_state(self.state)
            flags = ["--time"] if "time" in state and self.scene.source.time is not None else []
            self.scene.look.check_state("--state", state, flags, self.camera)
        scene, shader, camera, options = self._open_path()
        view(
            *(scene, shader, camera),
            state=self.state,
            host=self.host,
            port=self.port,
            allow=[name for name in self.allow.split(",") if name],
            browser=self.browser,
            wait=True,
            **options,
        )

    def _open_path(self) -> tuple[Any, Shader | None, Camera | None, dict[str, Any]]:
        """Returns the scene, its shader, its camera, and fields of `RenderOptions`."""
        if self.path.endswith(".py"):
            return self._run_script()
        from ..viewer.view import ASPECT

        look = self.scene.look
        parse_camera(self.camera, look, *ASPECT)  # raises before the data are read
        options = look.options()
        source = replace(self.scene.source, time=self.scene.source.time or 0)
        with Bar() as bar:
            bar("reading", 0, 0)
            scene, shader = self._make_scene(replace(self.scene, source=source))
        return scene, shader, parse_camera(self.camera, look, *ASPECT, scene.info.space), options

    def _make_scene(self, flags: SceneFlags) -> tuple[Scene, Shader]:
        """Returns the scene of a page, at a time point, and its shader."""
        from ..base.volume import Volume
        from ..producers import VolumeProducer
        from ..shaders import Filtered
        from ..viewer.scene import series_of, streamed_scene

        look, streaming = flags.look, flags.streaming
        given = given_flags(streaming)
        for flag in ("--mode", "--max-frames"):
            if flag in given:
                raise ValueError(f"{flag} is for single pictures: a page refines its own")
        if is_zarr(self.path):
            data: Any = flags.open_store(self.path)
            shader = streaming.shader(data, look)
            series = series_of(data)
        else:
            store_flags = [flag for flag in given if flag in ("--image", "--host-cache")]
            refuse_store_flags(self.path, store_flags)
            data = flags.source.read(self.path)
            shader = look.make_shader(data)
            series = series_of(self.path, **flags.source.options())
        filtered = shader if isinstance(shader, Filtered) else None

        def remake(data: Any) -> Producer:
            if isinstance(data, Volume):
                return VolumeProducer(data, threshold=flags.threshold, filtered=filtered)
            return streaming.producer(data, shader)

        options = streaming.engine_options(look, data)
        return streamed_scene(data, remake, series, **options), shader

    def _run_script(self) -> tuple[Any, Shader | None, Camera | None, dict[str, Any]]:
        import runpy

        groups = self.scene.look, self.scene.streaming, self.scene.source
        flags = [flag for group in groups for flag in given_flags(group)]
        flags += ["--camera"] * (self.camera is not None)
        flags += ["--threshold"] * (self.scene.threshold is not None)
        if flags:
            raise ValueError(f"{flags[0]} is for files: the script sets it")
        if not Path(self.path).is_file():
            raise FileNotFoundError(f"script not found: {self.path}")
        sys.path.insert(0, str(Path(self.path).resolve().parent))
        namespace = runpy.run_path(self.path)
        if "scene" not in namespace:
            raise ValueError(f"{self.path}: must set scene, as in scene = gv.FieldProducer(...)")
        scene, shader, camera, options = (namespace.get(name) for name in _SCRIPT_NAMES)
        if not isinstance(options or {}, dict):
            raise ValueError(f"{self.path}: options must be a dict, got {type(options).__name__}")
        return scene, shader, camera, dict(options or {})
