"""`gvtorch render` and `gvtorch fly`: a volume or a store to a picture, or to many.

A volume file is built into a tree in memory; a store is streamed by the engine.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from ..io.ngff import is_zarr
from .common import Bar, ReadOptions, given, numbers, refuse_for_store, size, volume_formats
from .image import KINDS, STRIPS, Develop, parse_background
from .light import parse_lighting

if TYPE_CHECKING:
    import torch

    from ..base.records import RenderStats
    from ..cameras import Camera
    from ..cameras.models import CameraModel
    from ..cameras.path import CameraPath
    from ..engine import Engine, FrameStats
    from ..pictures import Picture
    from ..shaders import Shader, TransferFunction
    from ..tracing import Clip, Cost, ThinLens
else:
    CameraModel = str  # checked by the camera, since its module would load torch

_RANGE_VOXELS = 128**3  # of a foreign image that are read to learn its range


@dataclass(frozen=True, kw_only=True)
class Look:
    """How it is shown."""

    camera_model: Annotated[CameraModel, arg(metavar="MODEL")] = "pinhole"
    """pinhole, ortho (parallel), fisheye (equidistant) or panorama (equirectangular)"""
    fov: Annotated[float | None, arg(metavar="DEG")] = None
    """vertical field of view; 30, or 180 of a fisheye or panorama, if left out"""
    size: Annotated[str, arg(metavar="WxH")] = "512x512"
    """pixels"""
    tf: Annotated[str, arg(metavar="FILE|PRESET")] = "gray"
    """transfer function: a JSON file, or a preset over the data's range: gray, hot, vessels, bone,
    tissue"""
    shader: Literal["plain", "lit", "preintegrated", "isosurface", "maximum", "minimum", "mean"] = (
        "plain"
    )
    """what is made of the values"""
    value: Annotated[float | None, arg(metavar="VALUE")] = None
    """of the isosurface"""
    step: Annotated[float, arg(metavar="VOXELS")] = 0.5
    """distance between samples"""
    lod: Literal["auto", "finest"] = "auto"
    """auto: voxels as wide as a pixel's cone; finest: the data as it is"""
    background: Annotated[str, arg(metavar="R,G,B|FILE")] = "0,0,0"
    """linear, 0 to 1; R,G,B/R,G,B from top to bottom; transparent; or an environment map, PNG, EXR,
    TIFF or NPY"""
    stop_alpha: Annotated[float, arg(metavar="ALPHA")] = 0.99
    """a ray ends at this alpha; 1 integrates to the end"""
    clip: Annotated[str | None, arg(metavar="KIND:NUMBERS;...")] = None
    """what is kept: plane:A,B,C,D where A x + B y + C z + D >= 0; box:X,Y,Z,X,Y,Z (low corner, high
    corner); cut:X,Y,Z,X,Y,Z goes; caps draws the cut as a surface; in largest sides of the box,
    its centre is 0"""
    lens: Annotated[str | None, arg(metavar="APERTURE,FOCUS")] = None
    """depth of field: diameter of the lens and distance that is sharp, in largest sides of the
    box"""
    lighting: Annotated[str | None, arg(metavar="KIND:NUMBERS;...")] = None
    """of the lit shaders: sun:X,Y,Z,DEGREES (the way it shines, how wide it looks);
    lamp:X,Y,Z,RADIUS (world units); sky:R,G,B; shadows:, occlusion:, indirect:, factors; reach:, of
    the last two, in largest sides of the box"""
    component: Annotated[int, arg(metavar="N")] = 0
    """which number of a voxel is shown"""
    brick_size: Annotated[int, arg(metavar="VOXELS")] = 8
    """side of a brick"""
    border: Annotated[int, arg(metavar="VOXELS")] = 1
    """voxels around a brick"""
    backend: Literal["auto", "reference", "cpp", "cuda"] = "auto"
    """what traces the rays"""

    def options(self) -> dict[str, Any]:
        """Fields of `RenderOptions`."""
        return {
            "step": self.step,
            "lod": self.lod,
            "background": parse_background(self.background),
            "stop_alpha": self.stop_alpha,
            "clip": parse_clip(self.clip) if self.clip else None,
            "lens": parse_lens(self.lens) if self.lens else None,
            "lighting": parse_lighting(self.lighting) if self.lighting else None,
            "component": self.component,
            "backend": self.backend,
        }

    def device(self) -> torch.device:
        """CUDA where the backend runs there."""
        import torch

        from ..ops import available
        from ..ops.trace import choose_backend

        wants_cuda = self.backend == "cuda" or (self.backend == "auto" and not available()["cuda"])
        device = torch.device("cuda" if wants_cuda else "cpu")
        choose_backend(self.backend, device)
        return device

    def chosen(self, low: float, high: float) -> TransferFunction | Shader:
        """Returns the shader asked for, its transfer function read or spanned over the range."""
        from ..shaders import Isosurface, Lit, PreIntegrated, Projection, TransferFunction

        if self.tf.endswith(".json") or Path(self.tf).is_file():
            transfer = TransferFunction.from_json(self.tf)
        else:
            transfer = TransferFunction.preset(self.tf, low, high)
        if (self.value is None) == (self.shader == "isosurface"):
            raise ValueError("--value and --shader isosurface belong together")
        if self.shader == "isosurface":
            return Isosurface(float(self.value or 0))
        if self.shader in ("maximum", "minimum", "mean"):
            return Projection(self.shader, transfer)
        if self.shader == "plain":
            return transfer
        return Lit(transfer) if self.shader == "lit" else PreIntegrated(transfer)


@dataclass(frozen=True, kw_only=True)
class Streaming:
    """Stores: what is kept, and how it is loaded."""

    node_pool: Annotated[str, arg(metavar="BYTES")] = "8 MB"
    """memory of node tiles"""
    brick_pool: Annotated[str, arg(metavar="BYTES")] = "256 MB"
    """memory of bricks, on the device that renders"""
    host_cache: Annotated[str, arg(metavar="BYTES")] = "512 MB"
    """memory of decoded blocks"""
    mode: Literal["interactive", "balanced", "converge"] | None = None
    """one frame, a few, or until nothing is missing"""
    max_frames: Annotated[int, arg(metavar="N")] = 1000
    """most frames of a picture that converges"""
    loading: Literal["straight", "levels"] = "straight"
    """to the wanted level at once, or level by level"""
    time: Annotated[int, arg(metavar="N")] = 0
    """time point"""
    image: Annotated[str | None, arg(metavar="NAME")] = None
    """which image, where a store has several"""
    strict: tyro.conf.FlagCreatePairsOff[bool] = False
    """a block that can't be read ends the work"""

    @contextmanager
    def open(self, path: str, look: Look) -> Iterator[tuple[Engine, TransferFunction | Shader]]:
        """Opens a store: the engine over it, and the transfer function."""
        from ..engine.engine import Engine
        from ..io.store import Store
        from ..producers import StoredProducer

        store = Store.open(path, image=self.image, time=self.time)
        producer = StoredProducer(store, host_cache=self.host_cache)
        shader = look.chosen(*value_range(store))
        with Engine(
            producer,
            node_pool=self.node_pool,
            brick_pool=self.brick_pool,
            brick_size=look.brick_size,
            border=look.border,
            loading=self.loading,
            strict=self.strict,
            device=look.device(),
        ) as engine:
            yield engine, shader


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
    camera: Annotated[str, arg(metavar="CAMERA")] = "orbit:30,20,2.4"
    """orbit:AZIMUTH,ELEVATION,DISTANCE (degrees, and largest sides of the box) or
    look:ex,ey,ez,tx,ty,tz (world units)"""
    show: Literal["picture", "samples", "nodes", "lod", "age", "fill"] = "picture"
    """the picture, or what each ray cost: samples, nodes visited; or what it saw: depth of the
    nodes, age of the bricks in frames, share of their voxels that is not transparent"""
    up: Annotated[str, arg(metavar="X,Y,Z")] = "0,1,0"
    """what a look camera takes for up"""
    threshold: Annotated[float | None, arg(metavar="VALUE")] = None
    """volumes: regions with no value above it are never drawn"""
    look: tyro.conf.OmitArgPrefixes[Look] = Look()
    streaming: tyro.conf.OmitArgPrefixes[Streaming] = Streaming()
    source: tyro.conf.OmitArgPrefixes[ReadOptions] = ReadOptions()
    develop: tyro.conf.OmitArgPrefixes[Develop] = Develop()

    def run(self) -> None:
        """Reads, renders, writes."""
        from ..pictures.files import checked_path

        width, height = size(self.look.size)
        _check_suffix("--output", self.output, *KINDS)
        if self.npz is not None:
            if self.output.suffix in STRIPS:
                raise ValueError(f"--npz holds a whole picture: not with {self.output.suffix}")
            _check_suffix("--npz", self.npz, ".npz")
        for file in (self.output, self.npz, self.stats):
            if file is not None and not file.parent.is_dir():
                raise FileNotFoundError(f"folder not found: {file.parent}")
        checked_path("--output", self.output, self.bits, KINDS)
        model = self.look.camera_model
        camera = parse_camera(self.camera, self.up, self.look.fov, width, height, model)
        options = self.look.options()
        with Bar() as bar:
            bar("reading", 0, 0)
            if is_zarr(self.path):
                stats, extent = self._stream(camera, options, bar)
            else:
                stats, extent = self._resident(camera, options, bar)
        if self.stats is not None:
            content = {**stats.as_dict(), "extent": extent}
            self.stats.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        print(f"{self.output}: {width}x{height}, {told(stats)}")

    def _take(
        self,
        render: Callable[..., Picture],
        cost: Callable[[Camera], Cost],
        camera: Camera,
        bar: Bar,
    ) -> RenderStats:
        """Renders and writes the files, strip by strip where the kind of file lets it."""
        from ..pictures import render_tiles

        if self.output.suffix in STRIPS and self.show == "picture":
            developed = self.develop.wrap(render)
            return render_tiles(developed, camera, self.output, bits=self.bits, progress=bar)
        picture = self.develop.wrap(partial(render, progress=bar))(camera)
        shown = picture if self.show == "picture" else cost(camera).picture(self.show)
        shown.save(self.output, bits=self.bits)
        if self.npz is not None:
            picture.save(self.npz)
        return picture.stats

    def _resident(
        self, camera: Camera, options: dict[str, Any], bar: Bar
    ) -> tuple[RenderStats, tuple[int, ...]]:
        """Builds the whole tree of a volume file."""
        from ..pool import N3Tree
        from ..tracing import cost, render

        flags = given(self.streaming)
        if flags:
            raise ValueError(
                f"{flags[0]} is for stores; make one: gvtorch convert {self.path} STORE.zarr"
            )
        volume = self.source.read(Path(self.path))
        shader, look = self.look.chosen(*volume.value_range), self.look
        tree = N3Tree.from_volume(
            *(volume, look.brick_size, look.border),
            threshold=self.threshold,
            device=look.device(),
            progress=bar,
        )
        stats = self._take(
            partial(render, tree, shader=shader, **options),
            partial(cost, tree, shader=shader, **options),
            *(camera, bar),
        )
        return stats, volume.extent

    def _stream(
        self, camera: Camera, options: dict[str, Any], bar: Bar
    ) -> tuple[RenderStats, tuple[int, ...]]:
        """Streams a store."""
        from ..tracing import cost

        if self.threshold is not None:
            raise ValueError("--threshold is for volumes; a store's is set by gvtorch convert")
        refuse_for_store(self.source)
        streaming = self.streaming
        with streaming.open(self.path, self.look) as (engine, shader):
            (source,) = engine.trees.values()
            mode, most = streaming.mode or "converge", streaming.max_frames
            stats = self._take(
                partial(engine.render, shader=shader, mode=mode, max_frames=most, **options),
                partial(cost, source.tree, shader=shader, **options),
                *(camera, bar),
            )
            _tell_failures(engine)
            return stats, source.tree.extent


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
            engine, shader = stack.enter_context(self.streaming.open(self.path, self.look))
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
            _tell_failures(engine)
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


def parse_camera(
    text: str,
    up: str,
    fov: float | None,
    width: int,
    height: int,
    model: CameraModel = "pinhole",
) -> Camera:
    """Makes a camera from `orbit:AZ,EL,DIST` or `look:ex,ey,ez,tx,ty,tz`.

    Raises:
        ValueError: The text is neither, or a number is out of its range.
    """
    from ..cameras import Camera

    kind, _, rest = text.partition(":")
    if kind == "orbit":
        azimuth, elevation, distance = numbers("--camera orbit", rest, 3, float)
        return Camera.orbit(azimuth, elevation, distance, fov, width, height, model)
    if kind == "look":
        values = numbers("--camera look", rest, 6, float)
        upward = numbers("--up", up, 3, float)
        return Camera.look_at(values[:3], values[3:], upward, fov, width, height, model)
    raise ValueError(f"--camera must be orbit:AZ,EL,DIST or look:ex,ey,ez,tx,ty,tz, got {text!r}")


def parse_clip(text: str) -> Clip:
    """Makes a clip from items such as `plane:0,0,1,0;cut:0,0,0,1,1,1;caps`.

    Raises:
        ValueError: An item is of no known kind, or its numbers are refused by `Clip`.
    """
    from ..tracing import Clip

    found: dict[str, list[Any]] = {"plane": [], "box": [], "cut": []}
    caps = False
    for item in text.split(";"):
        kind, _, rest = item.strip().partition(":")
        if kind == "caps" and not rest:
            caps = True
        elif kind in found:
            values = numbers(f"--clip {kind}", rest, 4 if kind == "plane" else 6, float)
            found[kind].append(values if kind == "plane" else (values[:3], values[3:]))
        else:
            raise ValueError(f"--clip must hold plane:, box:, cut: or caps, got {item.strip()!r}")
    return Clip(
        planes=found["plane"], boxes=found["box"], without=found["cut"], frame="box", caps=caps
    )


def parse_lens(text: str) -> ThinLens:
    """Makes a lens from `APERTURE,FOCUS`."""
    from ..tracing import ThinLens

    aperture, focus = numbers("--lens", text, 2, float)
    return ThinLens(aperture=aperture, focus=focus, frame="box")


def value_range(store: Any) -> tuple[float, float]:
    """Smallest and largest value of a store. Other people's images do not tell: of them the finest
    level of at most 128^3 voxels is read, which blurs the extremes a little.
    """
    if store.value_range is not None:
        return (
            min(low for low, _ in store.value_range),
            max(high for _, high in store.value_range),
        )
    level = 0
    while level + 1 < store.levels:
        x, y, z = store.level_extent(level)
        if x * y * z <= _RANGE_VOXELS:
            break
        level += 1
    data = store.read_region(level, (0, 0, 0), store.level_extent(level)[::-1])
    return (float(data.min()), float(data.max()))


def told(stats: RenderStats) -> str:
    """What a picture cost, in a few words."""
    from ..engine import FrameStats

    text = f"{stats.samples / 1e6:.1f} M samples in {stats.milliseconds:.0f} ms ({stats.backend})"
    if not isinstance(stats, FrameStats):
        return text
    bricks = f"{stats.bricks_used} bricks of {stats.bricks}"
    return f"{text}, {stats.frames} frames, {bricks}{_shortfall(stats)}"


def _shortfall(stats: FrameStats) -> str:
    if stats.capacity_exceeded and not stats.converged:
        return "; the pools are too small for this picture, parts of it are coarser"
    if stats.capacity_exceeded:
        return " (the pools are too small for all at once: rays took turns)"
    if stats.failed:
        return f"; {stats.failed} nodes failed, parts of it are coarser"
    return "" if stats.converged else "; not converged"


def _tell_failures(engine: Engine) -> None:
    import sys

    for failure in engine.failures[:3]:
        print(f"gvtorch: {failure}", file=sys.stderr)
    if len(engine.failures) > 3:
        print(f"gvtorch: {len(engine.production.failures)} nodes failed in all", file=sys.stderr)


def _check_suffix(flag: str, path: Path, *kinds: str) -> None:
    if path.suffix not in kinds:
        raise ValueError(f"{flag} must end in {', '.join(kinds)}, got {str(path)!r}")
