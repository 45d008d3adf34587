"""`render` and `trace`: a resident tree, from a camera to a picture and from rays to hits."""

from __future__ import annotations

import time
from typing import Any

import torch

from ..base.records import Hits, Rays, RenderStats
from ..base.stage import Progress, collect_timings, no_progress, stage
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from ..ops.trace import choose_backend
from ..pictures.picture import Picture
from ..pool import N3Tree
from .around import around
from .options import RenderOptions, check_type, render_options
from .pixels import develop, trace_camera
from .tracer import AnyShader, tracer_of


def render(
    tree: N3Tree,
    camera: Camera | Rays,
    shader: AnyShader,
    *,
    progress: Progress = no_progress,
    **options: Any,
) -> Picture:
    """Renders a resident tree.

    Args:
        tree: What to render, on the device that renders it; its stamps and request words are
            written.
        camera: One camera or a batch; an orbit camera stands around the tree's box. Or rays in
            world units, which make a picture as wide as they tell, or of one row.
        shader: The transfer function, in data units, or another shader.
        progress: Told how many rays are done.
        **options: Fields of `RenderOptions`.

    Returns:
        The picture, (h, w, c) for one camera and (n, h, w, c) for a batch.

    Raises:
        ValueError: An option is unknown or out of its range, or the backend can't be used.
    """
    camera = as_camera("render", camera)
    chosen = render_options("render", camera, options)
    check_type("render", "tree", tree, N3Tree)
    start = time.perf_counter()
    with collect_timings(tree.device) as timings:
        with stage("prepare"):
            tree.frame += 1
            trace = around(tracer_of(tree, shader, chosen), chosen, tree.box)
        placed = camera.placed(tree.box)
        hits = trace_camera(placed, tree.device, trace, chosen, progress)
        with stage("picture"):
            stats = RenderStats(
                backend=choose_backend(chosen.backend, tree.device),
                rays=hits.alpha.shape[0],
                samples=int(hits.samples.sum(dtype=torch.int64)),
                nodes=tree.nodes.child_tn.numel(),
                bricks=tree.bricks.capacity,
                bytes=tree.nbytes,
                tiles_used=int((tree.nodes.stamp_t == tree.frame).sum()),
                bricks_used=int((tree.bricks.stamp_b == tree.frame).sum()),
            )
            picture = develop(hits, placed, chosen, stats)
    stats.stages = timings.as_dict()
    stats.milliseconds = 1e3 * (time.perf_counter() - start)
    return picture


def trace(
    tree: N3Tree, rays: Rays, shader: AnyShader, options: RenderOptions | None = None
) -> Hits:
    """Traces any world rays through a tree as one frame.

    Args:
        tree: The tree; its stamps and request words are written.
        rays: Rays in world units, on the tree's device.
        shader: The transfer function, or another shader.
        options: Lod, step and the like; `background` is not used.

    Returns:
        Colour, alpha, depth and samples of each ray, in `options.dtype`.

    Raises:
        ValueError: The channel is unknown, the step too short, or the backend can't be used.
    """
    tree.frame += 1
    chosen = options or RenderOptions()
    return around(tracer_of(tree, shader, chosen), chosen, tree.box)(rays)
