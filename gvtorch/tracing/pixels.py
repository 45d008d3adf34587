"""`View`: traces a camera's pixels and makes their picture; `render`, `trace`: resident trees."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from typing import Any, Unpack

import torch
from torch import Tensor

from ..base import check
from ..base.arrays import as_volume
from ..base.explicit import explicit
from ..base.lasting import lasting
from ..base.records import Hits, Rays, RenderStats
from ..base.stage import Progress, check_progress, collect_timings, no_progress, stage
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from ..ops.registry import choose_backend
from ..ops.shading import pack
from ..pictures.background import Background
from ..pictures.picture import Picture
from ..pool import N3Tree
from .composite import nothing_like
from .effects import TreeTrace
from .options import RenderOptions, RenderSettings, render_options
from .pose import pose_alone
from .tracer import Tracer
from .trees import Shaders, box_around, trace_trees, tree_traces

Scene = N3Tree | Mapping[str, N3Tree]

Pixels = slice | Tensor  # some of the pixels of all pictures of a camera, row by row
#: Hits of an earlier pass, which are overwritten, and which (r,) bool of their rays to trace again.
Again = tuple[Hits, Tensor]
_RAYS_PER_BLOCK = 1 << 22  # rays that are traced at once
#: The same on a CPU: progress is reported, and Ctrl-C noticed, after each block.
_RAYS_PER_REPORT = 1 << 16


@explicit(RenderOptions)
def render(
    tree: Scene | Any,
    camera: Camera | Rays,
    shader: Shaders,
    *,
    progress: Progress = no_progress,
    **options: Unpack[RenderSettings],
) -> Picture:
    """Renders a resident tree, or several.

    Several threads may render one tree; `stats` then count the use by all of them.

    Args:
        tree: The tree, on the device that renders it; its stamps and request words are written. Or
            trees by name, on one device: where they overlap, they are composited by sample. A
            volume or array (see `as_volume`) instead of a tree is made into one on the CPU in every
            call; for several pictures make the tree once.
        camera: One camera or a batch; an orbit camera is placed around the scene's box. Or rays in
            world units, which make a picture as wide as `Rays.width`, or of one row.
        shader: The transfer function, in data units, or another shader; or several by tree name.
        progress: Receives the number of finished rows.
        **options: Fields of `RenderOptions`.

    Returns:
        The picture, (h, w, c) for one camera and (n, h, w, c) for a batch.

    Raises:
        ValueError: An option is unknown or out of its range, or the backend can't be used.
        RuntimeError: Another thread refreshes the tree.
    """
    check_progress("render", progress)
    camera = as_camera("render", camera)
    chosen = render_options("render", options, camera)
    scene = _resident("render", tree)
    trees = _trees("render", scene)
    device, start = trees[0].device, time.perf_counter()
    with using("render", trees), collect_timings(device) as timings:
        with stage("prepare"):
            traces = _begin_frame("render", scene, shader, chosen)
            first_frames = [each_tree.frame for each_tree in trees]
        view = View.of(camera, traces, chosen)
        hits = view.hits(progress)
        with stage("picture"):
            stats = tree_stats(trees, chosen, hits.samples, first_frames)
            picture = view.picture(hits, stats)
    stats.stages = timings.as_dict()
    stats.milliseconds = 1e3 * (time.perf_counter() - start)
    return picture


@explicit(RenderOptions)
def trace(tree: Scene, rays: Rays, shader: Shaders, **options: Unpack[RenderSettings]) -> Hits:
    """Traces any world rays through a resident tree, or several, as one frame. Background and layer
    apply to pictures only, and are ignored.

    Args:
        tree: The tree, or trees by name; stamps and request words are written.
        rays: Rays in world units, on the tree's device.
        shader: The transfer function, or another shader; or one for each tree by name.
        **options: Fields of `RenderOptions`.

    Returns:
        Colour, alpha, depth and samples of each ray, in the options' dtype.

    Raises:
        ValueError: An option is unknown or out of its range, a column of the rays has another
            shape, the channel is unknown, or the backend can't be used.
    """
    chosen = render_options("trace", options)
    rays = _numbered(rays, chosen)
    with using("trace", _trees("trace", tree)):
        return trace_trees(_begin_frame("trace", tree, shader, chosen), rays)


def _numbered(rays: Rays, options: RenderOptions) -> Rays:
    """Returns rays with numbers (`Rays.sample`) if there is lighting, which may trace some of them
    separately. Raises ValueError if their optional columns have another shape.
    """
    check.instance("trace", "rays", rays, Rays)
    count, device = len(rays.origin), rays.origin.device
    sample, light = rays.sample, rays.transmittance
    if light is not None:
        check.tensor("trace", "rays.transmittance", light, (count,), light.dtype, device)
    if sample is not None:
        check.tensor("trace", "rays.sample", sample, (count,), torch.int64, device)
    elif options.lighting is not None:
        return replace(rays, sample=torch.arange(count, device=device))
    return rays


def _resident(context: str, scene: Any) -> Scene:
    """Returns the scene with trees made of its volumes and arrays."""

    def as_tree(value: Any) -> N3Tree:
        if isinstance(value, N3Tree):
            return value
        if isinstance(value, (str, PathLike)):
            raise ValueError(f"{context}: {str(value)!r} is a path: gv.read_volume reads it")
        try:
            return N3Tree.from_volume(as_volume(value, context=context))
        except ValueError as error:
            raise ValueError(f"{error}; gv.as_volume takes axes, nan and more") from None

    if isinstance(scene, Mapping):
        return {name: as_tree(value) for name, value in scene.items()}
    return as_tree(scene)


def _trees(context: str, scene: Scene) -> list[N3Tree]:
    """Returns the trees of a scene; raises ValueError if there are none, or not on one device."""
    trees = [*scene.values()] if isinstance(scene, Mapping) else [scene]
    if not trees:
        raise ValueError(f"{context}: there must be a tree, got none")
    for tree in trees:
        check.instance(context, "tree", tree, N3Tree)
    devices = sorted({str(tree.device) for tree in trees})
    if len(devices) > 1:
        raise ValueError(f"{context}: trees must be on one device, got {', '.join(devices)}")
    return trees


def using(context: str, trees: Sequence[N3Tree]) -> ExitStack:
    """Returns a context for rendering trees; raises RuntimeError while a thread changes one."""
    with ExitStack() as stack:
        for tree in trees:
            stack.enter_context(tree.turns.using(context))
        return stack.pop_all()


def _begin_frame(
    context: str, scene: Scene, shaders: Shaders, options: RenderOptions
) -> list[TreeTrace]:
    """Begins a frame of each tree, and returns their tracers."""
    for tree in _trees(context, scene):
        tree.next_frame()
    if isinstance(scene, Mapping):
        channels_by_tree = {name: (tree, tree.channel_names) for name, tree in scene.items()}
        return tree_traces(context, channels_by_tree, shaders, options)
    if isinstance(shaders, Mapping):
        raise ValueError(f"{context}: shaders by name are for trees by name")
    pose_alone(context, options.pose)
    return [TreeTrace.of(Tracer(scene, shaders, options), options)]


def tree_stats(
    trees: Sequence[N3Tree],
    options: RenderOptions,
    samples: Tensor,
    frames: Sequence[int] = (),
) -> RenderStats:
    """Returns the statistics of a picture, given the samples (r,) of its rays; and, if `frames` are
    given, with what each tree used since its frame. Waits for the device once.
    """
    sums = [samples.sum(dtype=torch.int64)]
    for tree, frame in zip(trees, frames, strict=False):
        stamps = (tree.nodes.stamp_t, tree.bricks.stamp_b)
        sums += [torch.count_nonzero(stamp >= frame) for stamp in stamps]
    total, *used = torch.stack(sums).tolist()
    return RenderStats(
        backend=choose_backend(options.backend, trees[0].device),
        rays=samples.numel(),
        samples=total,
        tiles_used=sum(used[::2]),
        bricks_used=sum(used[1::2]),
        nodes=sum(tree.nodes.child_tn.numel() for tree in trees),
        bricks=sum(tree.bricks.capacity for tree in trees),
        bytes=sum(tree.nbytes for tree in trees),
    )


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """A placed camera, the trees that its rays pass through, and the options of its picture."""

    camera: Camera
    numbers: Tensor  # of the camera, on the device that traces; graph replays overwrite them
    trees: Sequence[TreeTrace]
    options: RenderOptions

    @classmethod
    @lasting
    def of(cls, camera: Camera, trees: Sequence[TreeTrace], options: RenderOptions) -> View:
        """Places a camera around the trees, and sends its numbers to their device."""
        placed = camera.placed(box_around([tree.box for tree in trees]))
        return cls(placed, placed.numbers(trees[0].tracer.tree.device), trees, options)

    @cached_property
    def box(self) -> Tensor:
        """(2, 3) world corners of the scene."""
        return box_around([tree.box for tree in self.trees])

    def trace(self, rays: Rays) -> Hits:
        """Traces rays in world units through all trees."""
        return trace_trees(self.trees, rays)

    @property
    def ray_count(self) -> int:
        """Number of rays."""
        return len(self.camera) * self.camera.height * self.camera.width

    def hits(self, progress: Progress = no_progress, *, again: Again | None = None) -> Hits:
        """Makes the camera's rays and traces them, all or some of them `again`; they stamp what
        they use and request what is missing. `progress` receives the number of finished rows.
        Raises ValueError if the picture is larger than the device's memory.
        """
        device = self.numbers.device
        alone = len(self.trees) == 1 and isinstance(self.trees[0].trace, Tracer)
        silent_batch = alone and len(self.camera) > 1 and progress is no_progress
        at_once = device.type == "cuda" or silent_batch
        block = _RAYS_PER_BLOCK if at_once else _RAYS_PER_REPORT
        size = self.ray_count * (8 * self.options.dtype.itemsize + 5)  # the colour twice
        check.memory("render", f"a picture of {self.ray_count} pixels", size, device)
        hits, mask = again or (None, None)
        if hits is None and len(list(self.camera.blocks(block))) > 1:  # allocates before any ray
            hits = empty_hits(device, self.options.dtype, self.ray_count)
        for pixels, block_hits in self.blocks(block, progress, mask):
            if hits is None:
                hits = block_hits  # the only block
            else:
                _write_hits(hits, pixels, block_hits, self.ray_count)
        assert hits is not None
        return hits

    def blocks(
        self, pixels: int, progress: Progress, mask: Tensor | None = None
    ) -> Iterator[tuple[Pixels, Hits]]:
        """Traces all pixels, or those where `mask` (p,) is true, in blocks of whole rows, since
        rays take more memory than their picture. Yields the traced pixels of each block, and their
        hits, composited with the layer.
        """
        camera, numbers, layer = self.camera, self.numbers, self.options.layer
        rows, width = len(camera) * camera.height, camera.width
        layer_pixels = None if layer is None else layer.pixels(numbers.device)
        for first, end in camera.blocks(pixels):
            traced: Pixels = slice(first * width, end * width)
            with stage("rays"):
                if mask is None:
                    rays = self._rows((first, end))
                else:
                    index = mask[traced].nonzero()[:, 0]
                    rays = self._some_rays(first, index)
                    traced = index + first * width
            if len(rays.origin):
                with stage("trace"):
                    if layer_pixels is None:
                        hits = self.trace(rays)
                    else:
                        hits = layer_pixels[traced].trace(self.trace, rays, self.options.stop_alpha)
                yield traced, hits
            progress("rays", end, rows)

    def _rows(self, rows: tuple[int, int]) -> Rays:
        """Returns the rays of whole rows."""
        rays = self.camera.pixel_rays(self.numbers, rows)
        if self.options.lighting is None:
            return rays
        return replace(rays, sample=self.camera.pixel_samples(self.numbers, rows))

    def _some_rays(self, top: int, index: Tensor) -> Rays:
        """Returns the rays of the pixels `index` (k,), rising indices counted from row `top`."""
        width = self.camera.width
        ends = torch.stack((index[0], index[-1])).tolist() if len(index) else (0, -1)
        first, last = (end // width for end in ends)
        return self._rows((top + first, top + last + 1))[index - first * width]

    def picture(self, hits: Hits, stats: RenderStats) -> Picture:
        """Composites the hits of all rays over the background, in the camera's shape."""
        color, nearest, layer = hits.color, hits.depth, self.options.layer
        background: Any = self.options.background
        if isinstance(background, Background):
            behind = background.behind(self.camera, self.numbers, color.dtype)
            color = color + (1 - hits.alpha) * behind
        elif background is not None and any(background):
            color = color + (1 - hits.alpha) * pack((background,), color.dtype, color.device)
        if layer is not None:
            nearest = torch.minimum(nearest, layer.distance(nearest.device).to(nearest.dtype))
        columns = {**vars(hits), "color": color, "nearest": nearest}
        images = {name: self.camera.image(c) for name, c in columns.items() if c is not None}
        return Picture(**images, transparent=background is None, stats=stats)


def _write_hits(hits: Hits, pixels: Pixels, block_hits: Hits, count: int) -> None:
    """Writes the hits of some pixels into those of all; missing fields become `nothing_like`."""
    for name, field in vars(block_hits).items():
        if vars(hits)[name] is None:
            if field is None:
                continue
            vars(hits)[name] = nothing_like(field, count)
        target = vars(hits)[name]
        target[pixels] = nothing_like(target, len(block_hits.alpha)) if field is None else field


def empty_hits(device: torch.device, dtype: torch.dtype, pixels: int) -> Hits:
    """Allocates the hits of a picture before any ray is traced: each ray counts as `missed`."""
    color, alpha, depth = (
        torch.empty((pixels, width), dtype=dtype, device=device) for width in (3, 1, 1)
    )
    samples = torch.zeros(pixels, dtype=torch.int32, device=device)
    missed = torch.ones_like(samples, dtype=torch.bool)
    return Hits(color=color, alpha=alpha, depth=depth, samples=samples, missed=missed)
