"""`ModuleShader`: any `nn.Module` as a shader. Rays are walked by parts; the bricks they meet are
sampled, the module turns samples into colours, and these are composited front to back.

Slower than a shader in the kernel, by an order of magnitude and more, and open: whatever torch can
compute and differentiate. The host waits for the number of samples of each part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ..base import check
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
from ..shaders.transfer_function import TransferFunction
from .spans import box_span

_LIMIT = 64  # samples of a ray in one part
_SAMPLES = {"cpu": 1 << 20, "cuda": 1 << 24}  # shaded at once


class ModuleShader:
    """A module as a shader: `module(values, positions, directions, lengths)` returns colour and
    opacity of samples.

    The module gets, for k samples, `values` (k, c) of all channels side by side in data units,
    `positions` (k, 3) and `directions` (k, 3) in world units, and `lengths` (k, 1) of the intervals
    that the samples stand for, in world units. It returns linear RGB (k, 3), not premultiplied,
    and the alpha (k, 1) of those lengths, in [0, 1]. Its parameters lie on the tree's device.

    Pictures have gradients by the parameters, and by bricks that are floats and require them.
    Then all samples stay in memory until the backward pass; without gradients (`torch.no_grad`)
    memory is bounded by `samples`.

    Attributes:
        module: The module.
        channels: Names of the channels it reads; None: that of `RenderOptions.channel`.
        hidden_by: A transfer function: what it shows nothing of is neither sampled nor requested.
        samples: About how many samples are shaded at once; None: 2^20 on the CPU and 2^24 on CUDA,
            where each batch waits for the device.
    """

    def __init__(
        self,
        module: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
        channels: Sequence[str] | None = None,
        *,
        hidden_by: TransferFunction | None = None,
        samples: int | None = None,
    ) -> None:
        """See the class.

        Raises:
            ValueError: The module can't be called, or a number is out of its range.
        """
        if not callable(module):
            raise ValueError(f"ModuleShader: module must be callable, got {type(module).__name__}")
        if isinstance(channels, str) or (channels is not None and not len(channels)):
            raise ValueError(f"ModuleShader: channels must be names, got {channels!r}")
        if not (hidden_by is None or isinstance(hidden_by, TransferFunction)):
            kind = type(hidden_by).__name__
            raise ValueError(f"ModuleShader: hidden_by must be a TransferFunction, got {kind}")
        self.module, self.hidden_by = module, hidden_by
        self.channels = None if channels is None else tuple(channels)
        if samples is not None:
            check.whole("ModuleShader", "samples", samples, low=_LIMIT)
        self.samples = samples

    @property
    def walls(self) -> TransferFunction:
        """The transfer function that hides nodes; it hides none where none was given."""
        return self.hidden_by or TransferFunction.from_points([(0, 1)])

    def shade(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Colour (k, 3) and alpha (k,) of samples.

        Raises:
            ValueError: The module gives something of another shape or dtype, a colour that is not
                finite, or no alpha.
        """
        given = (batch.values(self.channels), batch.positions, batch.directions, batch.lengths)
        made = self.module(*given)
        if not (isinstance(made, Sequence) and len(made) == 2):
            got = f"{len(made)} parts" if isinstance(made, Sequence) else type(made).__name__
            raise ValueError(f"ModuleShader: the module must give colour and alpha, got {got}")
        color, alpha = made
        count, real, device = len(given[0]), given[0].dtype, given[0].device
        check.tensor("ModuleShader", "the module's colour", color, (count, 3), real, device)
        check.tensor("ModuleShader", "the module's alpha", alpha, (count, 1), real, device)
        if not bool(((alpha >= 0) & (alpha <= 1)).all()):
            raise ValueError("ModuleShader: the module's alpha must lie in [0, 1]")
        if not bool(torch.isfinite(color).all()):
            raise ValueError("ModuleShader: the module's colour must be finite")
        return color, alpha[:, 0]


class TransferModule(torch.nn.Module):
    """A transfer function as a module, whose rows are parameters: the twin of the kernel's.

    Attributes:
        rows: (m, 4) linear RGB and opacity per reference length, at even distances of values.
    """

    def __init__(self, shader: TransferFunction, spacing: float) -> None:
        """Copies a transfer function.

        Args:
            shader: The function.
            spacing: Smallest spacing of the volume, world units: opacity's reference length where
                the function has none of its own.
        """
        super().__init__()
        self.reference = float(shader.reference or spacing)
        table = shader.table(spacing, self.reference, 1, torch.float32, "cpu")
        self.low, high = table.domain_2.tolist()
        self.scale = (len(table.opaque_m) - 1) / (high - self.low)
        self.rows = torch.nn.Parameter(table.table_lm4[0].clone())

    def shows(self, values: Tensor) -> Tensor:
        """Bool of the same shape: a value has an opacity."""
        place = ((values - self.low) * self.scale).clamp(0, len(self.rows) - 1)
        opaque = self.rows[:, 3] > 0
        return opaque[place.floor().long()] | opaque[place.ceil().long()]

    def forward(
        self, values: Tensor, positions: Tensor, directions: Tensor, lengths: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Colour (k, 3) and alpha (k, 1) of the first value."""
        last = len(self.rows) - 1
        place = ((values[:, :1] - self.low) * self.scale).clamp(0, last)
        row = place.long().clamp(max=last - 1)
        rows = self.rows.to(values.dtype)
        a, b = rows[row[:, 0]], rows[row[:, 0] + 1]
        rgb = a[:, :3] + (place - row) * (b[:, :3] - a[:, :3])
        alpha_a, alpha_b = (
            -torch.expm1(lengths / self.reference * torch.log1p(-side[:, 3:].clamp(0, 1 - 2**-23)))
            for side in (a, b)
        )
        return rgb, alpha_a + (place - row) * (alpha_b - alpha_a)


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

    def values(self, channels: Sequence[str] | None) -> Tensor:
        """(k, c) values of channels side by side; of the options' channel where None are named."""
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
    limit: int = _LIMIT,
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


class ModuleTracer:
    """One frame of a tree through a `ModuleShader`: traces any number of batches of rays."""

    def __init__(
        self,
        tree: N3Tree,
        shader: ModuleShader,
        arguments: TraceArguments,
        channel: str,
        backend: Backend,
    ) -> None:
        """Takes over the arguments of a `Tracer` that draws `shader.walls`."""
        self.tree, self.shader, self.arguments, self.channel = tree, shader, arguments, channel
        self.backend = backend

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units, a block at a time."""
        samples = self.shader.samples or _SAMPLES[rays.origin.device.type]
        count, size = len(rays.origin), samples // _LIMIT
        if count <= size:
            return self._block(rays)
        parts = [self._block(rays[at : at + size]) for at in range(0, count, size)]
        names = vars(parts[0])
        joined = {n: [getattr(part, n) for part in parts] for n in names}
        return Hits(**{n: torch.cat(all_) for n, all_ in joined.items() if all_[0] is not None})

    def _block(self, rays: Rays) -> Hits:
        own = (self.tree, self.arguments, self.channel, self.backend, self.shader.shade, 3)
        sums = march(rays, *own)
        return Hits(
            color=sums.total,
            alpha=(1 - sums.clear)[:, None],
            depth=sums.depth[:, None],
            samples=sums.count[:, 0].contiguous(),
            missed=sums.missed,
        )
