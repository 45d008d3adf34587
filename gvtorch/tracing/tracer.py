"""`Tracer`: one frame of a tree and a shader, from rays to hits."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..base.records import Hits, Rays
from ..ops import RayArguments, TraceArguments, shade_rays, trace_rays
from ..ops.trace import choose_backend, most_intervals
from ..pool import N3Tree
from ..shaders.module import ModuleShader
from ..shaders.shader import Shader, check_shader
from ..shaders.tables import Sampling, interval_levels
from .module_march import march_module
from .options import RenderOptions

_FIELDS = ("color", "alpha", "depth", "samples", "missed", "normal", "features")


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
        """Lays the op's arguments ready; see `trace` and, for `by_level`, `trace_rays`. `frame_1`
        (1,) int32 is the frame's number on the device, if it lies there already.

        Raises:
            ValueError: It is no shader, the channel is unknown, the step too short, or the backend
                can't be used.
        """
        check_shader("render", "shader", shader)
        choose_backend(options.backend, tree.device)
        channel = shader.channel or options.channel or tree.channel_names[0]
        if channel not in tree.bricks.bricks:
            known = ", ".join(tree.channel_names)
            raise ValueError(f"render: unknown channel {channel!r}; the tree has {known}")
        step = options.step * min(tree.spacing)
        most_intervals(float((tree.box[1] - tree.box[0]).norm()), step)
        self.tree, self.shader, self.channel = tree, shader, channel
        if frame_1 is None:
            frame_1 = torch.full((1,), tree.frame, dtype=torch.int32, device=tree.device)
        scale = options.cone_scale * tree.flatness if options.lod == "auto" else 0.0
        levels = interval_levels(tree.root_voxel, step) if scale else 1
        sampling = Sampling(
            smallest_spacing=min(tree.spacing),
            step=step,
            levels=levels,
            dtype=options.dtype,
            device=tree.device,
        )
        self.dtype, self.backend = options.dtype, options.backend
        self.shading = shader.shading("render", tree)
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
            component=options.component if shader.component is None else shader.component,
            child_tn=tree.nodes.child_tn,
            brick_tn=tree.nodes.brick_tn,
            request_tn=tree.nodes.request_tn,
            stamp_t=tree.nodes.stamp_t,
            stamp_b=tree.bricks.stamp_b,
            frame_1=frame_1,
            root=tree.root,
            **vars(shader.table(sampling)),
            stop_alpha=options.stop_alpha,
            depth_alpha=options.depth_alpha,
            by_level=by_level,
        )

    def seeing(self, shader: Shader, options: RenderOptions) -> Tracer:
        """Returns what traces the same frame with another shader."""
        frame: dict[str, Any] = {"by_level": self.arguments.by_level}
        return Tracer(self.tree, shader, options, frame_1=self.arguments.frame_1, **frame)

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units."""
        if isinstance(self.shader, ModuleShader):
            frame = (self.tree, self.arguments, self.channel, self.backend)
            return march_module(self.shader, rays, *frame)
        given = RayArguments.of(rays)
        fields: tuple[Tensor, ...]
        if self.shading is None:
            fields = trace_rays(given, self.arguments, backend=self.backend)
        else:
            own = (self.shading, self.shader.parameter_tensor(self.tree, self.dtype))
            fields = shade_rays(
                given, self.arguments, *own, op=self.shader.op, backend=self.backend
            )
        return Hits(**dict(zip(_FIELDS, fields, strict=False)))
