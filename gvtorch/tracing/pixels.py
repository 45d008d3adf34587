"""From a camera to the hits of all its pixels, and from these to a picture."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base.records import Hits, Rays, RenderStats
from ..base.stage import Progress, stage
from ..cameras.camera import Camera
from ..ops.shading import pack
from ..pictures.background import Background
from ..pictures.picture import Picture
from .composite import Trace
from .options import RenderOptions

Pixels = slice | Tensor  # some of the pixels of all pictures of a camera, row by row
_RAYS_A_BLOCK = {"cpu": 1 << 16, "cuda": 1 << 22}  # small on the CPU, so that progress shows


def trace_blocks(
    camera: Camera,
    numbers: Tensor,
    trace: Trace,
    options: RenderOptions,
    progress: Progress,
    *,
    pixels: int,
    where: Tensor | None = None,
) -> Iterator[tuple[Pixels, Hits]]:
    """Traces a camera's rays block after block of whole rows, since rays take more memory than the
    picture they make.

    Args:
        camera: Placed in the world.
        numbers: What `camera.numbers` gave, on the device that traces.
        trace: Traces world rays.
        options: Of which the layer counts: voxels are composited with it.
        progress: Told how many rows are done.
        pixels: Of a block.
        where: (p,) bool, which pixels are traced; all if left out.

    Yields:
        The pixels of a block that were traced, and their hits.
    """
    rows, width = len(camera) * camera.height, camera.width
    layer = None if options.layer is None else options.layer.pixels(numbers.device)
    for first, end in camera.blocks(pixels):
        some: Pixels = slice(first * width, end * width)
        with stage("rays"):
            if where is None:
                rays = camera.pixel_rays(numbers, (first, end))
            else:
                which = where[some].nonzero()[:, 0]
                rays = _some_rays(numbers, camera, first, which)
                some = which + first * width
        if len(rays.origin):
            with stage("trace"):
                if layer is None:
                    hits = trace(rays)
                else:
                    hits = layer[some].trace(trace, rays, options.stop_alpha)
            yield some, hits
        progress("rays", end, rows)


def trace_camera(
    camera: Camera,
    device: torch.device,
    trace: Trace,
    options: RenderOptions,
    progress: Progress,
    *,
    again: tuple[Hits, Tensor] | None = None,
    numbers: Tensor | None = None,
) -> Hits:
    """Traces all rays of a camera, or of a batch.

    Args:
        camera: Placed in the world.
        device: Where the rays are traced.
        trace: Traces world rays.
        options: The dtype of the hits, and the layer that voxels are composited with.
        progress: Told how many rows are done.
        again: Hits of an earlier pass, which are overwritten, and which (p,) bool of them are
            traced once more.
        numbers: What `camera.numbers` gave, where it lies on the device already.

    Raises:
        ValueError: The picture is larger than the device's memory.
    """
    count, block = len(camera) * camera.height * camera.width, _RAYS_A_BLOCK[device.type]
    size = count * (8 * options.dtype.itemsize + 5)  # the colour twice
    check.memory("render", f"a picture of {count} pixels", size, device)
    numbers = camera.numbers(device) if numbers is None else numbers
    hits, where = again or (None, None)
    if hits is None and len(list(camera.blocks(block))) > 1:
        hits = empty_hits(device, options.dtype, count)  # too large: fails before the first ray
    given = camera, numbers, trace, options, progress
    for pixels, part in trace_blocks(*given, pixels=block, where=where):
        if hits is None:
            hits = part  # the only block
        else:
            _write(hits, pixels, part, count)
    assert hits is not None
    return hits


def _write(hits: Hits, pixels: Pixels, part: Hits, count: int) -> None:
    """Puts the hits of some pixels among those of all."""
    for name, field in vars(part).items():
        if field is None:
            continue
        if vars(hits)[name] is None:
            vars(hits)[name] = field.new_empty((count, *field.shape[1:]))
        vars(hits)[name][pixels] = field


def _some_rays(numbers: Tensor, camera: Camera, top: int, which: Tensor) -> Rays:
    """Rays of the pixels `which` (k,), rising, counted from row `top`: the rows that hold them are
    made, then they alone are kept.
    """
    width = camera.width
    ends = torch.stack((which[0], which[-1])).tolist() if len(which) else (0, -1)
    first, last = (end // width for end in ends)
    rays = camera.pixel_rays(numbers, (top + first, top + last + 1))
    return rays[which - first * width]


def empty_hits(device: torch.device, dtype: torch.dtype, pixels: int) -> Hits:
    """Takes the memory of a picture."""
    widths = {"color": (3,), "alpha": (1,), "depth": (1,)}
    reals = {n: torch.empty((pixels, *w), dtype=dtype, device=device) for n, w in widths.items()}
    samples = torch.empty(pixels, dtype=torch.int32, device=device)
    return Hits(**reals, samples=samples, missed=torch.empty_like(samples, dtype=torch.bool))


def develop(
    hits: Hits,
    camera: Camera,
    options: RenderOptions,
    stats: RenderStats,
    numbers: Tensor | None = None,
) -> Picture:
    """Puts the hits of a camera's rays over the background, in the camera's shape.

    Args:
        hits: Of all pixels.
        camera: Placed in the world.
        options: What `render_options` gave.
        stats: What the picture cost.
        numbers: What `camera.numbers` gave, where it lies on the device already.
    """
    color, nearest = hits.color, hits.depth
    background: Any = options.background
    if isinstance(background, Background):
        numbers = camera.numbers(color.device) if numbers is None else numbers
        color = color + (1 - hits.alpha) * background.behind(camera, numbers, color.dtype)
    elif background is not None and any(background):
        color = color + (1 - hits.alpha) * pack((background,), color.dtype, color.device)
    if options.layer is not None:
        layer = options.layer.distance(hits.depth.device).to(hits.depth.dtype)
        nearest = torch.minimum(hits.depth, layer)
    columns = {**vars(hits), "color": color, "nearest": nearest}
    images = {name: camera.image(c) for name, c in columns.items() if c is not None}
    return Picture(**images, transparent=background is None, stats=stats)
