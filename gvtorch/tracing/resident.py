"""`render` and `trace`: a resident tree, from a camera to a picture and from rays to hits."""

from __future__ import annotations

import time
from typing import Unpack

import torch

from ..base import check
from ..base.records import Hits, Rays, RenderStats
from ..base.stage import Progress, collect_timings, no_progress, stage
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from ..ops.trace import choose_backend
from ..pictures.picture import Picture
from ..pool import N3Tree
from ..shaders.shader import Shader
from .around import around
from .options import RenderOptions, RenderSettings, render_options
from .pixels import develop, trace_camera
from .tracer import Tracer


def render(
    tree: N3Tree,
    camera: Camera | Rays,
    shader: Shader,
    *,
    progress: Progress = no_progress,
    **options: Unpack[RenderSettings],
) -> Picture:
    """Renders a resident tree.

    Args:
        tree: What to render, on the device that renders it; its stamps and request words are
            written.
        camera: One camera or a batch; an orbit camera stands around the tree's box. Or rays in
            world units, which make a picture as wide as `Rays.width`, or of one row.
        shader: The transfer function, in data units, or another shader.
        progress: Told how many rows are done.
        **options: Fields of `RenderOptions`.

    Returns:
        The picture, (h, w, c) for one camera and (n, h, w, c) for a batch.

    Raises:
        ValueError: An option is unknown or out of its range, or the backend can't be used.
    """
    camera = as_camera("render", camera)
    chosen = render_options("render", options, camera)
    check.instance("render", "tree", tree, N3Tree)
    start = time.perf_counter()
    with collect_timings(tree.device) as timings:
        with stage("prepare"):
            tree.frame += 1
            trace = around(Tracer(tree, shader, chosen), chosen, tree.box)
        placed = camera.placed(tree.box)
        hits = trace_camera(placed, tree.device, trace, chosen, progress)
        with stage("picture"):
            stats = tree_stats(tree, chosen, hits.samples)
            stats.tiles_used = int((tree.nodes.stamp_t == tree.frame).sum())
            stats.bricks_used = int((tree.bricks.stamp_b == tree.frame).sum())
            picture = develop(hits, placed, chosen, stats)
    stats.stages = timings.as_dict()
    stats.milliseconds = 1e3 * (time.perf_counter() - start)
    return picture


def trace(tree: N3Tree, rays: Rays, shader: Shader, **options: Unpack[RenderSettings]) -> Hits:
    """Traces any world rays through a resident tree, as one frame.

    Args:
        tree: The tree; its stamps and request words are written.
        rays: Rays in world units, on the tree's device.
        shader: The transfer function, or another shader.
        **options: Fields of `RenderOptions`; background and layer belong to pictures and have no
            part in it.

    Returns:
        Colour, alpha, depth and samples of each ray, in the options' dtype.

    Raises:
        ValueError: An option is unknown or out of its range, the channel is unknown, or the backend
            can't be used.
    """
    chosen = render_options("trace", options)
    check.instance("trace", "tree", tree, N3Tree)
    check.instance("trace", "rays", rays, Rays)
    tree.frame += 1
    return around(Tracer(tree, shader, chosen), chosen, tree.box)(rays)


def tree_stats(tree: N3Tree, options: RenderOptions, samples: torch.Tensor) -> RenderStats:
    """Returns the statistics of a picture, given the samples (r,) of its rays."""
    return RenderStats(
        backend=choose_backend(options.backend, tree.device),
        rays=samples.numel(),
        samples=int(samples.sum(dtype=torch.int64)),
        nodes=tree.nodes.child_tn.numel(),
        bricks=tree.bricks.capacity,
        bytes=tree.nbytes,
    )
