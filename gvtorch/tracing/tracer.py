"""`Tracer`: one frame of a tree and a shader, from rays to hits.

Module shaders are marched: rays are walked part by part, the bricks on their way are sampled, the
module turns samples into features and alpha, and these are composited front to back. The host waits
for the number of samples of each part.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from .. import ops
from ..base import check
from ..base.constants import MAX_INTERVALS
from ..base.records import Hits, Rays
from ..ops.registry import choose_backend
from ..pool import N3Tree
from ..shaders.module import PART_SAMPLES, ModuleShader
from ..shaders.shader import Sampling, Shader, check_shader, interval_levels
from .composite import merged, reaches_depth, tree_span
from .options import RenderOptions
from .pose import pose_alone

#: What the ops give, in order; `trace_rays` the first five only.
_RESULTS = ("color", "alpha", "depth", "samples", "missed", "normal", "features")
_MAX_SAMPLES = {"cpu": 1 << 20, "cuda": 1 << 24}  # shaded at once


class Tracer:
    """One frame of a tree, `tree.frame`: traces any number of batches of rays."""

    def __init__(
        self,
        tree: N3Tree,
        shader: Shader,
        options: RenderOptions,
        *,
        by_level: bool = False,
        frame_1: Tensor | None = None,
    ) -> None:
        """Prepares the op's arguments; see `trace` and, for `by_level`, `TraceArguments`. `frame_1`
        (1,) int32 is the frame's number, if it is on the device already. Raises ValueError if there
        is no shader, the channel is unknown, the step too short, or the backend can't be used.
        """
        check_shader("render", "shader", shader)
        choose_backend(options.backend, tree.device)
        channel = _checked_channel(tree, shader, options)
        step = options.step * min(tree.spacing)
        _check_step(tree, step, options)
        tree.warn_if_edited(learned=isinstance(shader, ModuleShader))
        self.tree, self.shader, self.channel = tree, shader, channel
        self.pose = pose_alone("render", options.pose)
        if frame_1 is None:
            frame_1 = torch.full((1,), tree.frame, dtype=torch.int32, device=tree.device)
        scale = options.cone_scale * tree.isotropy if options.lod == "auto" else 0.0
        sampling = Sampling(
            smallest_spacing=min(tree.spacing),
            step=step,
            levels=interval_levels(tree.root_voxel, step) if scale else 1,
            dtype=options.dtype,
            device=tree.device,
        )
        self.dtype, self.backend = options.dtype, options.backend
        self.label_names = shader.label_names(tree, channel)
        self.shading = shader.shading("render", tree)
        self.arguments = ops.TraceArguments(
            place_33=tree.place,
            branching=tree.branching,
            max_depth=tree.depth,
            border=tree.bricks.border,
            root_voxel=tree.root_voxel * shader.finer(tree),  # voxels taken for larger are refined
            cone_scale=scale,
            step=step,
            bricks_bzyxc=tree.bricks.bricks[channel],
            constant_tnc=tree.nodes.constants[channel],
            range_tn2c=tree.nodes.ranges[channel],
            component=options.component if shader.component is None else shader.component,
            child_tn=tree.nodes.child_tn,
            brick_tn=tree.nodes.brick_tn,
            request_tn=tree.nodes.request_tn,
            stamp_t=tree.nodes.stamp_t,
            stamp_b=tree.bricks.stamp_b,
            frame_1=frame_1,
            root=tree.root,
            **vars(shader.table_of(tree, channel, sampling)),
            stop_alpha=options.stop_alpha,
            depth_alpha=options.depth_alpha,
            by_level=by_level,
        )

    def with_shader(self, shader: Shader, options: RenderOptions) -> Tracer:
        """Returns a tracer of the same frame with another shader."""
        args = self.arguments
        return Tracer(self.tree, shader, options, by_level=args.by_level, frame_1=args.frame_1)

    def learned(self) -> list[Tensor]:
        """Returns the parameters and voxels by which a module shader gives gradients."""
        if not isinstance(self.shader, ModuleShader):
            return []
        names, bricks = self.shader.channels or (self.channel,), self.tree.bricks.bricks
        tensors = (*self.shader.parameters(), *(bricks[name] for name in names))
        return [tensor for tensor in tensors if tensor.requires_grad]

    def to_tree(self, rays: Rays) -> Rays:
        """Returns world rays in the tree's axes."""
        return rays if self.pose is None else self.pose.to_tree(rays)

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units."""
        hits = self._trace(self.to_tree(rays))
        return hits if self.pose is None else self.pose.to_world(hits)

    def _trace(self, rays: Rays) -> Hits:
        """Traces rays in the tree's axes."""
        if isinstance(self.shader, ModuleShader):
            return self._march_module(self.shader, rays)
        ray_arguments = ops.RayArguments.of(rays)
        fields: tuple[Tensor, ...]
        if self.shading is None:
            fields = ops.trace_rays(ray_arguments, self.arguments, backend=self.backend)
        else:
            parameters = self.shader.parameter_tensor(self.tree, self.dtype)
            if self.pose is not None:
                parameters = self.pose.light_to_tree(parameters)
            reads = (ray_arguments, self.arguments, self.shading, parameters)
            fields = ops.shade_rays(*reads, op=self.shader.op, backend=self.backend)
        hits = Hits(**dict(zip(_RESULTS, fields, strict=False)))
        if self.label_names is None or hits.features is None:
            return hits
        label = self.label_names[hits.features.to(torch.int64)]
        return replace(hits, features=hits.features[:, :0], label=label)

    def _march_module(self, shader: ModuleShader, rays: Rays) -> Hits:
        """Traces rays with a module shader, block by block."""

        def shade(batch: Batch) -> tuple[Tensor, Tensor]:
            values = batch.values(shader.channels)
            positions, directions = batch.positions, batch.directions
            if self.pose is not None:
                positions = self.pose.world_positions(positions)
                directions = self.pose.world_vectors(directions)
            color, alpha = shader(values, positions, directions, batch.lengths)
            return color, alpha[:, 0]

        def trace_block(rays: Rays) -> Hits:
            color, hits, _ = march(self, rays, shade, 3)
            return replace(hits, color=color)

        count = len(rays.origin)
        size = (shader.samples or _MAX_SAMPLES[rays.origin.device.type]) // PART_SAMPLES
        if count <= size:
            return trace_block(rays)
        blocks = [trace_block(rays[start : start + size]) for start in range(0, count, size)]
        return merged(blocks, torch.cat)


def _checked_channel(tree: N3Tree, shader: Shader, options: RenderOptions) -> str:
    """Returns the channel that the shader colours; raises ValueError if it does not fit."""
    shader_channel = check.text("render", "channel", shader.channel)
    channel = tree.fine_channel("render", shader_channel or options.channel)
    first_channel = tree.channel_names[0]
    other_channel = tree.bricks.channels.get(str(shader.other))
    if other_channel is not None and other_channel.coarse and channel != first_channel:
        source = f"was made of {first_channel!r}, not of {channel!r}"
        raise ValueError(f"render: channel {shader.other!r} {source}")
    _check_labels(tree, shader, channel)
    return channel


def _check_labels(tree: N3Tree, shader: Shader, channel: str) -> None:
    """Raises ValueError where labels would be blended, or where there are none."""
    if shader.reads_labels:
        if channel not in tree.labels:
            raise ValueError(
                f"render: channel {channel!r} holds no labels but values, whose coarse levels are "
                "means: gv.Volume(data, labels=True) (--labels) makes labels of them"
            )
        return
    for name in (channel, *shader.channels):
        if name in tree.labels:
            problem = f"holds labels, which {type(shader).__name__} would blend"
            hint = "gv.Labels() (--shader labels) shows them"
            raise ValueError(f"render: channel {name!r} {problem}: {hint}")


def _check_step(tree: N3Tree, step: float, options: RenderOptions) -> None:
    """Raises ValueError if a step is so short that rounding makes ends of intervals equal. Cones
    allow more intervals: each is about as long as its cone is wide, far above the rounding.
    """
    length = math.dist(*tree.box.tolist())
    limit, hint = 2**46, "take a longer step"
    if options.lod == "finest":
        limit, hint = 2**50, "lod='auto' takes longer ones where voxels are small"
        if options.dtype == torch.float32:
            limit, hint = MAX_INTERVALS, f"{hint}; dtype=torch.float64 tells more apart"
    if not length / step <= limit:
        count = f"{length / step:.4g} intervals of {step:g}, more than {limit:.4g}"
        raise ValueError(f"render: step cuts a ray of {length:g} into {count} ({hint})")


@dataclass(frozen=True)
class Batch:
    """Samples of walked rays, and what can be read there."""

    tracer: Tracer
    rays: ops.RayArguments
    segments: ops.Segments
    samples: ops.Samples

    def values(self, channels: Sequence[str] = ()) -> Tensor:
        """Returns (k, c) values of channels side by side, by default of the tracer's one."""
        columns, tree = [], self.tracer.tree
        for name in channels or (self.tracer.channel,):
            bricks, constants = tree.bricks.bricks[name], tree.nodes.constants[name]
            arguments = self.tracer.arguments._replace(bricks_bzyxc=bricks, constant_tnc=constants)
            reads = (arguments, self.segments, self.samples)
            columns.append(ops.sample_bricks(self.rays, *reads, backend=self.tracer.backend))
        return columns[0] if len(columns) == 1 else torch.cat(columns, 1)

    @cached_property
    def segment(self) -> Tensor:
        """(k,) int64 segment of each sample."""
        return self.samples.segment.to(torch.int64)

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
        full = self.tracer.arguments.step * 2.0 ** level.clamp(min=0).to(base.dtype)
        return torch.where(level < 0, end - base, full)[:, None]

    @cached_property
    def starts(self) -> Tensor:
        """(k,) distance from where the ray enters the tree's box to where each interval starts."""
        first, _, level = self.segments.interval[self.segment].unbind(1)
        base, index = self.segments.distance[self.segment, 0], first + self.samples.number
        return base + torch.where(level < 0, 0, index).to(base.dtype) * self.lengths[:, 0]

    @cached_property
    def entry_distance(self) -> Tensor:
        """(r,) float64 distances from the camera to where rays enter the tree's box."""
        near, _ = tree_span(self.tracer.arguments.place_33, *self.rays[:2])
        return torch.where((near > 0) & (near < torch.inf), near, 0.0)

    @cached_property
    def positions(self) -> Tensor:
        """(k, 3) world positions of the samples, the middles of their intervals."""
        t = self.entry_distance[self.ray] + self.starts + 0.5 * self.lengths[:, 0]
        origin, direction = (column[self.ray] for column in self.rays[:2])
        return (origin + t[:, None] * direction).to(self.starts.dtype)


def march(
    tracer: Tracer,  # its tree and arguments; its shader's table only decides what is hidden
    rays: Rays,
    shade: Callable[[Batch], tuple[Tensor, Tensor]],  # features (k, c) and alpha (k,) of samples
    features: int,  # their number c
    *,
    limit: int = PART_SAMPLES,  # samples of a ray in one part
    by_node: bool = True,  # see `trace_segments`
) -> tuple[Tensor, Hits, Tensor]:
    """Walks rays part by part, and shades and composites the samples of each part; rays that have
    ended are left out of the next part.

    Returns:
        Sums (r, c) of the features, hits without colour, and (r,) int32 nodes that were visited.
    """
    arguments, backend = tracer.arguments, tracer.backend
    like, count = arguments.domain_2, len(rays.origin)
    stop_alpha, hit_clear = arguments.stop_alpha, 1 - arguments.depth_alpha
    open_rays = ops.RayArguments.of(rays)._replace(clear_r=None)  # a walk has no transmittance
    sums = like.new_zeros((count, features))
    clear = rays.light()[:, 0].to(like.dtype)
    depth = like.new_full((count,), torch.inf)
    samples, nodes = like.new_zeros((2, count), dtype=torch.int32)
    missed = like.new_zeros(count, dtype=torch.bool)
    open_index, state = torch.arange(count, device=like.device), None
    if rays.transmittance is not None:  # some may have ended in an earlier piece
        open_index = (clear > 1 - stop_alpha).nonzero()[:, 0]
        open_rays = open_rays.some(open_index)
    walk = partial(ops.trace_segments, limit=limit, by_node=by_node, backend=backend)
    while len(open_index):
        segments = walk(open_rays, arguments, state)
        missed[open_index] |= segments.missed
        nodes[open_index] += segments.counts[:, 2]
        batch = Batch(tracer, open_rays, segments, ops.list_samples(segments))
        if not len(batch.segment):
            break  # all have ended
        feature, alpha = shade(batch)
        part_sums, clear_after, clear_before = ops.composite(
            *(alpha.contiguous(), feature.contiguous(), batch.samples.offset, clear[open_index]),
            stop_alpha=stop_alpha,
            backend=backend,
        )
        sums = sums.index_add(0, open_index, part_sums)
        clear = clear.index_put((open_index,), clear_after)
        with torch.no_grad():
            taken = (clear_before > 0).to(torch.int32)
            samples = samples.index_add(0, open_index[batch.ray], taken)
            passes = reaches_depth(clear_before, clear_before * (1 - alpha), arguments.depth_alpha)
            hit = passes.nonzero()[:, 0]
            fraction = torch.log(hit_clear / clear_before[hit]) / torch.log1p(-alpha[hit])
            fraction = torch.where(alpha[hit] < 1, fraction.clamp(0, 1), 0.0)
            hit_ray, in_tree = batch.ray[hit], batch.starts[hit] + fraction * batch.lengths[hit, 0]
            hit_depth = in_tree + batch.entry_distance[hit_ray]
            depth = depth.index_put((open_index[hit_ray],), hit_depth.to(like.dtype))
            is_open = (segments.counts[:, 1] >= limit) & (clear_after > 1 - stop_alpha)
            left = is_open.nonzero()[:, 0]
        open_rays, open_index, state = open_rays.some(left), open_index[left], segments.state[left]
    colorless = like.new_zeros((count, 3))
    alpha, depth = (1 - clear)[:, None], depth[:, None]
    hits = Hits(color=colorless, alpha=alpha, depth=depth, samples=samples, missed=missed)
    return sums, hits, nodes
