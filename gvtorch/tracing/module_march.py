"""`march`: rays walked part by part outside of the kernel. The bricks they meet are sampled, a
function in torch turns samples into features and alpha, and these are composited front to back.

The host waits for the number of samples of each part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ..base.records import Hits, Rays
from ..ops import (
    RayArguments,
    Samples,
    Segments,
    TraceArguments,
    composite,
    list_samples,
    sample_bricks,
    trace_segments,
)
from ..ops.trace import Backend
from ..pool import N3Tree
from ..shaders.module import PART_SAMPLES, ModuleShader
from .spans import box_span

_SAMPLES = {"cpu": 1 << 20, "cuda": 1 << 24}  # shaded at once


@dataclass(frozen=True)
class Batch:
    """Samples of rays that were walked, and what can be read there."""

    rays: RayArguments
    tree: N3Tree
    arguments: TraceArguments
    channel: str
    backend: Backend
    segments: Segments
    listed: Samples

    def values(self, channels: Sequence[str] = ()) -> Tensor:
        """(k, c) values of channels side by side; of the options' channel where none are named."""
        found = []
        for name in channels or (self.channel,):
            if name not in self.tree.bricks.bricks:
                known = ", ".join(self.tree.channel_names)
                raise ValueError(f"ModuleShader: unknown channel {name!r}; the tree has {known}")
            arguments = self.arguments._replace(
                bricks_bzyxc=self.tree.bricks.bricks[name],
                constant_tnc=self.tree.nodes.constants[name],
            )
            reads = (arguments, self.segments, self.listed)
            value = sample_bricks(self.rays, *reads, backend=self.backend)
            found.append(value)
        return found[0] if len(found) == 1 else torch.cat(found, 1)

    @cached_property
    def segment(self) -> Tensor:
        """(k,) int64 segment of each sample."""
        return self.listed.segment.to(torch.int64)

    @cached_property
    def ray(self) -> Tensor:
        """(k,) int64 ray of each sample."""
        return self.segments.ray_index.to(torch.int64)[self.segment]

    @cached_property
    def directions(self) -> Tensor:
        """(k, 3) unit length."""
        return self.rays.direction_r3[self.ray].to(self.segments.t0.dtype)

    @cached_property
    def lengths(self) -> Tensor:
        """(k, 1) world length of each interval."""
        base, end, _ = self.segments.distance[self.segment].unbind(1)
        level = self.segments.interval[self.segment, 2]
        whole = self.arguments.step * 2.0 ** level.clamp(min=0).to(base.dtype)
        return torch.where(level < 0, end - base, whole)[:, None]

    @cached_property
    def starts(self) -> Tensor:
        """(k,) where each interval starts, from where the ray enters the tree's box."""
        first, _, level = self.segments.interval[self.segment].unbind(1)
        base, number = self.segments.distance[self.segment, 0], first + self.listed.number
        return base + torch.where(level < 0, 0, number).to(base.dtype) * self.lengths[:, 0]

    @cached_property
    def moved(self) -> Tensor:
        """(r,) float64 distances from the camera to where rays enter the tree's box."""
        corner, size, high = self.arguments.place_33
        near, _ = box_span(corner, corner + size * high, *self.rays[:2])
        return torch.where((near > 0) & (near < torch.inf), near, 0.0)

    @cached_property
    def positions(self) -> Tensor:
        """(k, 3) world places of the samples, the middles of their intervals."""
        t = self.moved[self.ray] + self.starts + 0.5 * self.lengths[:, 0]
        origin, direction = (column[self.ray] for column in self.rays[:2])
        return (origin + t[:, None] * direction).to(self.starts.dtype)


@dataclass
class Marched:
    """What rays brought back from a march."""

    total: Tensor  # (r, c) sums of the features
    clear: Tensor  # (r,) transmittance
    depth: Tensor  # (r,) world units
    count: Tensor  # (r, 2) int32 samples, nodes visited
    missed: Tensor  # (r,) bool


Shade = Callable[[Batch], tuple[Tensor, Tensor]]  # features (k, c) and alpha (k,)


def march(
    rays: Rays,
    tree: N3Tree,
    arguments: TraceArguments,
    channel: str,
    backend: Backend,
    shade: Shade,
    features: int,
    *,
    limit: int = PART_SAMPLES,
    by_node: bool = True,
) -> Marched:
    """Walks rays part by part and shades and composites what each part sampled; rays that have
    ended go no further.

    Args:
        rays: World rays.
        tree: The tree.
        arguments: Of a `Tracer`.
        channel: The one that the options name.
        backend: auto, reference, cpp or cuda.
        shade: Gives features and alpha of samples.
        features: How many there are.
        limit: Samples of a ray in one part.
        by_node: See `trace_segments`.
    """
    like, count = arguments.domain_2, len(rays.origin)
    stop_alpha, hit_clear = arguments.stop_alpha, 1 - arguments.depth_alpha
    going_on = RayArguments.of(rays)._replace(clear_r=None)  # a walk has no transmittance
    sums = Marched(
        total=like.new_zeros((count, features)),
        clear=rays.light()[:, 0].to(like.dtype),
        depth=like.new_full((count,), torch.inf),
        count=like.new_zeros((count, 2), dtype=torch.int32),
        missed=like.new_zeros(count, dtype=torch.bool),
    )
    which, state = torch.arange(count, device=like.device), None
    if rays.transmittance is not None:  # some may have ended before
        which = (sums.clear > 1 - stop_alpha).nonzero()[:, 0]
        going_on = going_on.some(which)
    while len(which):
        segments = trace_segments(
            going_on, arguments, state, limit=limit, by_node=by_node, backend=backend
        )
        sums.missed[which] |= segments.missed
        sums.count[which, 1] += segments.counts[:, 2]
        batch = Batch(going_on, tree, arguments, channel, backend, segments, list_samples(segments))
        if not len(batch.segment):
            break  # all have ended
        feature, alpha = shade(batch)
        clear = sums.clear[which]
        total, left, before = composite(
            *(alpha.contiguous(), feature.contiguous(), batch.listed.offset, clear.contiguous()),
            stop_alpha=stop_alpha,
            backend=backend,
        )
        sums.total = sums.total.index_add(0, which, total)
        sums.clear = sums.clear.index_put((which,), left)
        with torch.no_grad():
            sums.count[:, 0].index_add_(0, which[batch.ray], (before > 0).to(torch.int32))
            hit = ((before >= hit_clear) & (before * (1 - alpha) < hit_clear)).nonzero()[:, 0]
            share = torch.log(hit_clear / before[hit]) / torch.log1p(-alpha[hit])
            share = torch.where(alpha[hit] < 1, share.clamp(0, 1), 0.0)
            place = batch.starts[hit] + share * batch.lengths[hit, 0] + batch.moved[batch.ray[hit]]
            sums.depth[which[batch.ray[hit]]] = place.to(like.dtype)
            going = (segments.counts[:, 1] >= limit) & (left > 1 - stop_alpha)
            on = going.nonzero()[:, 0]
        going_on, which, state = going_on.some(on), which[on], segments.state[on]
    return sums


def march_module(
    shader: ModuleShader,
    rays: Rays,
    tree: N3Tree,
    arguments: TraceArguments,
    channel: str,
    backend: Backend,
) -> Hits:
    """Traces world rays with a module, a block at a time; arguments as for `march`."""

    def shade(batch: Batch) -> tuple[Tensor, Tensor]:
        values = batch.values(shader.channels)
        color, alpha = shader(values, batch.positions, batch.directions, batch.lengths)
        return color, alpha[:, 0]

    def block(rays: Rays) -> Hits:
        sums = march(rays, tree, arguments, channel, backend, shade, 3)
        return Hits(
            color=sums.total,
            alpha=(1 - sums.clear)[:, None],
            depth=sums.depth[:, None],
            samples=sums.count[:, 0].contiguous(),
            missed=sums.missed,
        )

    count = len(rays.origin)
    size = (shader.samples or _SAMPLES[rays.origin.device.type]) // PART_SAMPLES
    if count <= size:
        return block(rays)
    parts = [block(rays[at : at + size]) for at in range(0, count, size)]
    fields = {name: [getattr(part, name) for part in parts] for name in vars(parts[0])}
    return Hits(**{name: torch.cat(all_) for name, all_ in fields.items() if all_[0] is not None})
