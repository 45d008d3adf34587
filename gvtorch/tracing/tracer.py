"""`Tracer`: one frame of a tree and a shader, from rays to hits."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..base.records import Hits, Rays
from ..ops import RayArguments, ShadeArguments, TraceArguments, shade_rays, trace_rays
from ..ops.trace import choose_backend, most_intervals
from ..pool import N3Tree
from ..shaders.fused import FusedShader, Intervals, Shader, plain_table
from ..shaders.transfer_function import TransferFunction, interval_levels
from .module_shader import ModuleShader, ModuleTracer
from .options import RenderOptions

AnyShader = FusedShader | ModuleShader


def tracer_of(
    tree: N3Tree,
    shader: AnyShader,
    options: RenderOptions,
    **frame: Any,
) -> Tracer | ModuleTracer:
    """Returns what traces a frame of a tree with a shader; `frame` as for `Tracer`.

    Raises:
        ValueError: It is no shader, or see `Tracer`.
    """
    if isinstance(shader, ModuleShader):
        walls = Tracer(tree, shader.walls, options, **frame)
        channel = options.channel or tree.channel_names[0]
        return ModuleTracer(tree, shader, walls.arguments, channel, options.backend)
    check_shader("render", "shader", shader)
    return Tracer(tree, shader, options, **frame)


class Tracer:
    """One frame of a tree, `tree.frame`: traces any number of batches of rays."""

    def __init__(
        self,
        tree: N3Tree,
        shader: FusedShader,
        options: RenderOptions,
        *,
        by_level: bool = False,
        frame_1: Tensor | None = None,
    ) -> None:
        """Lays the op's arguments ready; see `trace` and, for `by_level`, `trace_rays`. `frame_1`
        (1,) int32 is the frame's number on the device, if it lies there already.
        """
        choose_backend(options.backend, tree.device)
        own = shader if isinstance(shader, Shader) else None
        channel = (own and own.channel) or options.channel or tree.channel_names[0]
        if channel not in tree.bricks.bricks:
            known = ", ".join(tree.channel_names)
            raise ValueError(f"render: unknown channel {channel!r}; the tree has {known}")
        step = options.step * min(tree.spacing)
        most_intervals(float((tree.box[1] - tree.box[0]).norm()), step)
        self.tree = tree
        if frame_1 is None:
            frame_1 = torch.full((1,), tree.frame, dtype=torch.int32, device=tree.device)
        scale = options.cone_scale * tree.flatness if options.lod == "auto" else 0.0
        levels = interval_levels(tree.root_voxel, step) if scale else 1
        intervals = Intervals(
            smallest_spacing=min(tree.spacing), step=step, levels=levels, dtype=options.dtype
        )
        self.shader = None if own is None or own.kind is None else own
        self.shading: ShadeArguments | None = None
        if own is not None and own.kind is not None:
            self.shading = own.arguments("render", tree, intervals)
        if isinstance(shader, TransferFunction):
            table = plain_table(shader, tree, intervals)
        else:
            table = shader.table(tree, intervals)
        component = own.component if own and own.component is not None else options.component
        self.dtype, self.backend = options.dtype, options.backend
        self.arguments = TraceArguments(
            place_33=tree.place,
            branching=tree.branching,
            max_depth=tree.depth,
            border=tree.bricks.border,
            root_voxel=tree.root_voxel,
            cone_scale=scale,
            step=step,
            bricks_bzyxc=tree.bricks.bricks[channel],
            constant_tnc=tree.nodes.constants[channel],
            range_tn2c=tree.nodes.ranges[channel],
            component=component,
            child_tn=tree.nodes.child_tn,
            brick_tn=tree.nodes.brick_tn,
            request_tn=tree.nodes.request_tn,
            stamp_t=tree.nodes.stamp_t,
            stamp_b=tree.bricks.stamp_b,
            frame_1=frame_1,
            root=tree.root,
            **vars(table),
            stop_alpha=options.stop_alpha,
            depth_alpha=options.depth_alpha,
            by_level=by_level,
        )

    def seeing(self, shader: FusedShader, options: RenderOptions) -> Tracer:
        """Returns what traces the same frame with another shader."""
        frame: dict[str, Any] = {"by_level": self.arguments.by_level}
        return Tracer(self.tree, shader, options, frame_1=self.arguments.frame_1, **frame)

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units."""
        given = RayArguments.of(rays)
        if self.shader is None or self.shading is None:
            fields = trace_rays(given, self.arguments, backend=self.backend)
            return Hits(**dict(zip(_FIELDS, fields, strict=False)))
        parameters = self.shader.parameters(self.tree, self.dtype)
        own = (self.arguments, self.shading, parameters)
        found = shade_rays(given, *own, op=self.shader.op, backend=self.backend)
        return Hits(**dict(zip(_FIELDS, found, strict=True)))


_FIELDS = ("color", "alpha", "depth", "samples", "missed", "normal", "features")


def check_shader(where: str, name: str, value: Any) -> None:
    """Raises ValueError unless a user's argument is a transfer function or another fused shader."""
    if not isinstance(value, (Shader, TransferFunction)):
        kind = type(value).__name__
        raise ValueError(
            f"{where}: {name} must be a TransferFunction or another shader, got {kind}"
        )
