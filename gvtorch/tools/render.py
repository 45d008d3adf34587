"""`gvtorch render`: a picture of a volume, built into a tree in memory, or of a store, streamed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from ..io.ngff import is_zarr
from .common import Bar, ReadOptions, check_component, given, refuse_for_store, size, volume_formats
from .image import KINDS, STRIPS, Develop
from .look import Look, parse_camera
from .streaming import Streaming, tell_failures, told

if TYPE_CHECKING:
    from ..base.records import RenderStats
    from ..cameras import Camera
    from ..pictures import Picture
    from ..tracing import Cost


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
        from ..shaders import Filtered
        from ..tracing import cost, render

        flags = given(self.streaming)
        if flags:
            raise ValueError(
                f"{flags[0]} is for stores; make one: gvtorch convert {self.path} STORE.zarr"
            )
        volume = self.source.read(Path(self.path))
        check_component(self.look.component, volume.data.shape[3], volume.info)
        shader, look = self.look.chosen(*volume.value_range, volume.info.labels), self.look
        tree = N3Tree.from_volume(
            *(volume, look.brick_size, look.border),
            threshold=self.threshold,
            device=look.device(),
            progress=bar,
        )
        if isinstance(shader, Filtered):
            shader = Filtered.of(
                tree, volume, shader.transfer, component=look.component, progress=bar
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
        with streaming.open(self.path, self.look, self.source.time or 0) as (engine, shader):
            (source,) = engine.trees.values()
            mode, most = streaming.mode or "converge", streaming.max_frames
            stats = self._take(
                partial(engine.render, shader=shader, mode=mode, max_frames=most, **options),
                partial(cost, source.tree, shader=shader, **options),
                *(camera, bar),
            )
            tell_failures(engine)
            return stats, source.tree.extent


def _check_suffix(flag: str, path: Path, *kinds: str) -> None:
    if path.suffix not in kinds:
        raise ValueError(f"{flag} must end in {', '.join(kinds)}, got {str(path)!r}")
