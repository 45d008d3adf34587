"""From a camera to the hits of all its pixels, and from these to a picture."""

from __future__ import annotations

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

_RAYS_A_BLOCK = {"cpu": 1 << 16, "cuda": 1 << 22}  # small on the CPU, so that progress shows


def trace_camera(
    camera: Camera,
    device: torch.device,
    trace_rays: Trace,
    options: RenderOptions,
    progress: Progress,
    *,
    again: tuple[Hits, Tensor] | None = None,
    numbers: Tensor | None = None,
) -> Hits:
    """Traces all rays of a camera, or of a batch, block after block of whole rows: rays take more
    memory than the picture they make.

    Args:
        camera: Placed in the world.
        device: Where the rays are traced.
        trace_rays: Traces world rays.
        options: The dtype of the hits, and the layer that they are mixed with.
        progress: Told how many rows are done.
        again: Hits of an earlier pass, which are overwritten, and which (pixels,) bool of them
            are traced once more.
        numbers: What `camera.numbers` gave, where it lies on the device already.

    Raises:
        ValueError: The picture is larger than the device's memory.
    """
    rows, width = len(camera) * camera.height, camera.width
    block = max(1, _RAYS_A_BLOCK[device.type] // width)
    size = rows * width * (8 * options.dtype.itemsize + 5)  # the colour twice
    check.memory("render", f"a picture of {rows * width} pixels", size, device)
    numbers = camera.numbers(device) if numbers is None else numbers
    layer = None if options.layer is None else options.layer.pixels(device)
    hits, where = again or (None, None)
    if hits is None and rows > block:
        hits = empty_hits(
            device, options.dtype, rows * width
        )  # too large a one fails before the first ray
    for top in range(0, rows, block):
        end = min(top + block, rows)
        pixels: slice | Tensor = slice(top * width, end * width)
        with stage("rays"):
            if where is None:
                rays = camera.pixel_rays(numbers, (top, end))
            else:
                which = where[pixels].nonzero()[:, 0]
                rays = _some_rays(numbers, camera, top, which)
                pixels = which + top * width
        if len(rays.origin):
            with stage("trace"):
                if layer is None:
                    part = trace_rays(rays)
                else:
                    part = layer[pixels].trace(trace_rays, rays, options.stop_alpha)
            if hits is None:
                hits = part  # the only block
            else:
                for name, field in vars(part).items():
                    if field is None:
                        continue
                    if vars(hits)[name] is None:
                        vars(hits)[name] = field.new_empty((rows * width, *field.shape[1:]))
                    vars(hits)[name][pixels] = field
        progress("rays", end, rows)
    assert hits is not None
    return hits


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
    shape = (len(camera), camera.height, camera.width)
    images = {
        "color": color.reshape(*shape, 3),
        "alpha": hits.alpha.reshape(*shape, 1),
        "depth": hits.depth.reshape(*shape, 1),
        "nearest": nearest.reshape(*shape, 1),
        "samples": hits.samples.reshape(*shape, 1),
        "missed": hits.missed.reshape(*shape, 1),
    }
    for name in ("normal", "features"):
        field = getattr(hits, name)
        if field is not None:
            images[name] = field.reshape(*shape, field.shape[1])
    if not camera.batched:
        images = {name: image[0] for name, image in images.items()}
    return Picture(**images, transparent=background is None, stats=stats)
