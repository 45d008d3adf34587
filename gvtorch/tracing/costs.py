"""`cost`: what each ray of a picture cost and sampled (Crassin, PhD thesis 2011, chapter 6)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal, Unpack, get_args

import torch
from torch import Tensor

from ..base import check
from ..base.explicit import explicit
from ..base.records import Hits, Rays, RenderStats
from ..base.stage import Progress, check_progress, no_progress
from ..base.volume import movable
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from ..pictures.picture import Picture
from ..pool import N3Tree
from ..shaders.module import TransferModule
from ..shaders.shader import Shader
from ..shaders.transfer_function import TransferFunction
from .effects import TreeTrace
from .options import RenderOptions, RenderSettings, render_options
from .pixels import View, tree_stats, using
from .pose import pose_alone
from .tracer import Batch, Tracer, march

Image = Literal["samples", "nodes", "lod", "age", "fill"]
IMAGES = get_args(Image)

_RAYS_PER_BLOCK = 1 << 16
_BRICKS_PER_BATCH = 1024


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Images of one camera (h, w, 1) or of a batch (n, h, w, 1).

    `lod`, `age` and `fill` are means along a ray, weighted by what each sample adds to alpha; NaN
    where nothing was seen, and for `age` and `fill` also where no brick was.
    """

    samples: Tensor  # int32 number of evaluations of the shader
    nodes: Tensor  # int32 nodes visited, including those that were skipped
    lod: Tensor  # depth of the nodes whose bricks were sampled, 0 for the root
    age: Tensor  # frames since the bricks were written
    fill: Tensor  # share of the bricks' voxels that the transfer function makes visible
    stats: RenderStats

    def __repr__(self) -> str:
        *_, height, width, _ = self.samples.shape
        return f"Cost({width}x{height}, {self.stats.samples} samples)"

    def picture(
        self, name: Image, *, low: float = 0.0, high: float | None = None, colormap: str = "viridis"
    ) -> Picture:
        """Shows one of the images in false colours; black where it is NaN.

        Args:
            name: samples, nodes, lod, age or fill.
            low: Value of the colour map's first colour.
            high: Value of its last colour; the largest in the image if left out.
            colormap: A name of `kornia.color.ColorMapType`.

        Raises:
            ValueError: There is no such image or colour map.
        """
        from kornia.color import ColorMap, ColorMapType, rgb_to_linear_rgb

        check.one_of("Cost", "image", name, IMAGES)
        low = check.number("Cost", "low", low)
        if not isinstance(colormap, str) or colormap not in ColorMapType.__members__:
            names = ", ".join(sorted(ColorMapType.__members__))
            raise ValueError(f"Cost: unknown colormap {colormap!r}; known: {names}")
        image = getattr(self, name).to("cpu", torch.float32)
        valid = ~image.isnan()
        if high is None:
            high = float(image[valid].max()) if valid.any() else 1.0
        high = check.number("Cost", "high", high)
        position = ((image - low) / max(high - low, 1e-6)).clamp(0, 1)
        colors = rgb_to_linear_rgb(ColorMap(colormap, 256).colors[:, :, None])[:, :, 0].T
        color = colors[torch.where(valid, position * 255, 0).round().long()[..., 0]] * valid
        no_depth = torch.full_like(image, torch.inf)
        return Picture(
            color=color,
            alpha=valid.float(),
            depth=no_depth,
            nearest=no_depth,
            samples=self.samples.cpu(),
            stats=self.stats,
        )


@explicit(RenderOptions)
@torch.no_grad()
def cost(
    tree: N3Tree,
    camera: Camera | Rays,
    shader: Shader,
    *,
    progress: Progress = no_progress,
    **options: Unpack[RenderSettings],
) -> Cost:
    """Counts what the rays of a picture do; writes neither stamps nor requests.

    For an engine's tree (`engine.trees[NAME].tree`) it shows the last frame. Rays are walked node
    by node outside the kernel, which takes many times as long as the picture itself. There is no
    lighting, since transfer functions have no normals.

    Args:
        tree: The tree.
        camera: See `render`.
        shader: The transfer function.
        progress: Receives the number of finished rows.
        **options: Fields of `RenderOptions`.

    Returns:
        What each pixel's ray did.

    Raises:
        ValueError: See `render`.
    """
    check_progress("cost", progress)
    camera = as_camera("cost", camera)
    chosen = render_options("cost", options, camera)
    check.instance("cost", "tree", tree, N3Tree)
    transfer = check.instance("cost", "shader", shader, TransferFunction)
    pose_alone("cost", chosen.pose)
    start = time.perf_counter()
    counter = _Counter(tree, transfer, chosen)
    counted = TreeTrace.of(counter, chosen)
    numbered = replace(counted, trace=lambda rays: counted.trace(counter.begin(rays)))
    view = View.of(camera, [numbered], chosen)
    with using("cost", [tree]):
        blocks = view.blocks(_RAYS_PER_BLOCK, progress)
        columns = [(hits.samples, counter.take_nodes(), *_means(hits)) for _, hits in blocks]
    joined = [torch.cat(parts) for parts in zip(*columns, strict=True)]
    stats = tree_stats([tree], chosen, joined[0])
    stats.milliseconds = 1e3 * (time.perf_counter() - start)
    images = {name: camera.image(column) for name, column in zip(IMAGES, joined, strict=True)}
    return Cost(**images, stats=stats)


def _means(hits: Hits) -> tuple[Tensor, ...]:
    """Returns (r,) lod, age and fill from a counter's sums."""
    assert hits.features is not None
    seen, lod, bricks, age, fill = hits.features.unbind(1)
    pairs = (lod, seen), (age, bricks), (fill, bricks)
    return tuple(torch.where(weight > 0, total / weight, torch.nan) for total, weight in pairs)


class _Counter(Tracer):
    """Counts along rays of one tree: returns sums as features, and counts visited nodes."""

    def __init__(self, tree: N3Tree, shader: TransferFunction, options: RenderOptions) -> None:
        super().__init__(tree, shader, options)
        copied = ("request_tn", "stamp_t", "stamp_b")
        copies = {name: getattr(self.arguments, name).clone() for name in copied}
        self.arguments = self.arguments._replace(**copies)
        self.component = self.arguments.component
        self.module = TransferModule(shader, min(tree.spacing)).to(tree.device)
        self.fill_b = torch.full_like(tree.bricks.born_b, -1, dtype=torch.float32)
        self._visited_nodes: Tensor | None = None

    def begin(self, rays: Rays) -> Rays:
        """Begins a block, and returns its rays numbered, since some may be traced separately."""
        count, device = len(rays.origin), rays.origin.device
        if self._visited_nodes is None:
            self._visited_nodes = torch.zeros(count, dtype=torch.int32, device=device)
        return replace(rays, sample=torch.arange(count, device=device))

    def take_nodes(self) -> Tensor:
        """Ends a block, and returns (r,) int32 nodes that its rays visited."""
        nodes, self._visited_nodes = self._visited_nodes, None
        assert nodes is not None
        return nodes

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays. Features are sums over a ray's samples, weighted by what they add to alpha,
        of 1, the node's depth, whether it has a brick, and the brick's age and fill.
        """
        sums, hits, nodes = march(self, self.to_tree(rays), self.shade, 5, limit=1, by_node=False)
        assert self._visited_nodes is not None
        assert rays.sample is not None
        self._visited_nodes.index_add_(0, rays.sample, nodes)
        return replace(hits, features=sums)

    def shade(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Returns (k, 5) of samples, which `__call__` sums, and (k,) alpha."""
        values = batch.values()[:, self.component, None]
        _, alpha = self.module(values, values, values, batch.lengths)  # it reads no positions
        slot = batch.segments.brick[batch.segment, 0].to(torch.int64)
        has_brick, valid_slot = slot >= 0, slot.clamp(min=0)
        if not self.tree.bricks.capacity:
            age = fill = torch.zeros_like(alpha[:, 0])
        else:
            self._fill(slot[has_brick & (alpha[:, 0] > 0)])
            age = self.tree.frame - self.tree.bricks.born_b[valid_slot]
            fill = self.fill_b[valid_slot]
        depth = batch.segments.depth[batch.segment, 0]
        columns = (torch.ones_like(depth), depth, has_brick, age * has_brick, fill * has_brick)
        return torch.stack([c.to(alpha.dtype) for c in columns], 1), alpha[:, 0]

    def _fill(self, slots: Tensor) -> None:
        """Computes the fill of bricks, once for each brick."""
        is_wanted = torch.zeros_like(self.fill_b, dtype=torch.bool)
        is_wanted[slots] = True
        missing = (is_wanted & (self.fill_b < 0)).nonzero()[:, 0]
        border, size = self.tree.bricks.border, self.tree.bricks.brick_size
        inner = slice(border, border + size)
        pool = self.tree.bricks.bricks[self.channel]
        for batch in missing.split(_BRICKS_PER_BATCH):
            bricks = movable(pool)[batch].view(pool.dtype)[:, inner, inner, inner]
            voxels = bricks[..., self.component].flatten(1).float()
            self.fill_b[batch] = self.module.shows(voxels).float().mean(1)
