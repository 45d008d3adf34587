"""`TreeTracer`: a tree and a shader as one `nn.Module` of plain tensors and one op.

It can be scripted, saved and loaded (also from C++), exported and compiled. Programs that load an
archive import `gvtorch.ops` first; C++ programs open `libgvtorch_cpu.so`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..base import check
from ..base import constants as config
from ..ops import available
from ..ops.shade import op_of
from ..ops.trace import most_intervals
from ..pool import N3Tree
from ..shaders.fused import FusedShader, Intervals, Shader
from ..shaders.transfer_function import interval_levels
from .tracer import check_shader


class TreeTracer(torch.nn.Module):
    """Traces world rays through a resident tree, as `render` does. Pools are buffers: `.to(device)`
    moves them.

    Light and material of a lit shader are the buffer `parameter`, laid out as `parameter_54` of
    `ops.shade_rays`; it may be edited.
    """

    if TYPE_CHECKING:  # TorchScript would read these as attributes of its own
        place: Tensor
        normals: Tensor
        normal_constant: Tensor
        others: Tensor
        other_constant: Tensor

    def __init__(
        self,
        tree: N3Tree,
        shader: FusedShader,
        *,
        channel: str | None = None,
        component: int = 0,
        step: float = config.STEP,
        stop_alpha: float = config.STOP_ALPHA,
        depth_alpha: float = config.DEPTH_ALPHA,
        cone_scale: float = config.CONE_OVERESTIMATE,
    ) -> None:
        """Shares the tree's pools, but for the usage stamps, which are its own.

        Args:
            tree: The tree.
            shader: The transfer function, or another fused shader.
            channel: Name of the channel it reads; the first if left out.
            component: Which number of the channel.
            step: Shortest interval, in voxels of the finest level.
            stop_alpha: A ray ends at this alpha.
            depth_alpha: Depth is where alpha passes this.
            cone_scale: Factor on the cones of rays, as in `RenderOptions`.

        Raises:
            RuntimeError: The compiled op is missing.
            ValueError: The channel is unknown, or a number is out of its range.
        """
        super().__init__()
        if available()["cpp"]:
            raise RuntimeError(f"TreeTracer needs the compiled op: {available()['cpp']}")
        check_shader("TreeTracer", "shader", shader)
        own = shader if isinstance(shader, Shader) else None
        channel = (own and own.channel) or channel or tree.channel_names[0]
        component = own.component if own and own.component is not None else component
        if channel not in tree.bricks.bricks:
            known = ", ".join(tree.channel_names)
            raise ValueError(f"TreeTracer: unknown channel {channel!r}; the tree has {known}")
        where, width = "TreeTracer", tree.bricks.channels[channel].width
        check.whole(where, "component", component, low=0, high=width - 1)
        check.number(where, "step", step, low=0, open_low=True)
        check.number(where, "stop_alpha", stop_alpha, low=0, high=1, open_low=True)
        check.number(where, "depth_alpha", depth_alpha, low=0, high=1)
        check.number(where, "cone_scale", cone_scale, low=0, open_low=True)
        most_intervals(float((tree.box[1] - tree.box[0]).norm()), step * min(tree.spacing))
        step = step * min(tree.spacing)
        levels = interval_levels(tree.root_voxel, step)
        spacing, real = min(tree.spacing), torch.float32
        lengths = Intervals(smallest_spacing=spacing, step=step, levels=levels, dtype=real)
        if isinstance(shader, Shader):
            laid = shader.arguments(where, tree, lengths)
            laid["parameter"] = shader.parameters(tree, real)
        else:
            laid = vars(shader.table(spacing, step, levels, real, tree.device))
        nothing = torch.zeros(0, device=tree.device)
        nodes, bricks = tree.nodes, tree.bricks
        for name, tensor in (
            ("place", tree.place),
            ("child", nodes.child_tn),
            ("brick", nodes.brick_tn),
            ("request", nodes.request_tn),
            ("stamp_tile", nodes.stamp_t.clone()),  # frames of its own, not the tree's
            ("bricks", bricks.bricks[channel]),
            ("constant", nodes.constants[channel]),
            ("value_range", nodes.ranges[channel]),
            ("stamp_brick", bricks.stamp_b.clone()),
            ("table", laid["table_lm4"]),
            ("domain", laid["domain_2"]),
            ("opaque", laid["opaque_m"]),
            ("parameter", laid.get("parameter", nothing)),
            ("normals", _given(laid, "normal_bzyxc", nothing)),
            ("normal_constant", _given(laid, "normal_tnc", nothing)),
            ("others", _given(laid, "other_bzyxc", nothing)),
            ("other_constant", _given(laid, "other_tnc", nothing)),
            ("frame", torch.zeros(1, dtype=torch.int32, device=tree.device)),
        ):
            self.register_buffer(name, tensor)
        self.branching, self.root, self.depth = tree.branching, tree.root, tree.depth
        self.cone_scale = float(cone_scale * tree.flatness)
        self.border, self.component = bricks.border, component
        self.root_voxel, self.step = float(tree.root_voxel), step
        self.stop_alpha, self.depth_alpha = float(stop_alpha), float(depth_alpha)
        kind = laid.get("shader", -1)  # -1: the plain transfer function
        self.shader, self.shade_rays = 0 if isinstance(kind, str) else int(kind), op_of(kind)
        self.features = int(laid.get("features", 0))
        self.other_component = int(laid.get("other_component", 0))

    def __getstate__(self) -> dict[str, Any]:
        """Names its op, which can't be pickled."""
        return {**self.__dict__, "shade_rays": str(self.shade_rays)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Finds the op again.

        Raises:
            RuntimeError: It is that of a `CompiledShader`, and not loaded in this process.
        """
        namespace, name = state["shade_rays"].split(".")
        op = getattr(getattr(torch.ops, namespace), name, None)
        if op is None:
            raise RuntimeError(
                f"TreeTracer: op {name} is not loaded: torch.ops.load_library of its shader's "
                "libraries first"
            )
        super().__setstate__({**state, "shade_rays": op})

    def forward(
        self, origin: Tensor, direction: Tensor, cone: Tensor, range: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Traces rays in world units.

        Args:
            origin: (r, 3) float32 or float64, as the others: rays enter the tree in float64.
            direction: (r, 3) unit length.
            cone: (r, 2) width at the origin and growth per unit distance; zeros for the finest
                level.
            range: (r, 2) first and last distance.

        Returns:
            color (r, 3) premultiplied, alpha (r, 1), depth (r, 1), all float32; samples (r,) int32.
        """
        color, alpha, depth, samples, _, _ = self.hits(origin, direction, cone, range)
        return color, alpha, depth, samples

    @torch.jit.export
    def hits(
        self, origin: Tensor, direction: Tensor, cone: Tensor, range: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """As `forward`, and returns also normal (r, 3) and features (r, c), (0, 3) and (0, 0) where
        the shader gives none.
        """
        rays = (
            origin.to(torch.float64).contiguous(),
            direction.to(torch.float64).contiguous(),
            cone.to(torch.float64).contiguous(),
            range.to(torch.float64).contiguous(),
        )
        if self.shader < 0:
            color, alpha, depth, samples, _ = torch.ops.gvtorch.trace_rays(
                rays[0],
                rays[1],
                rays[2],
                rays[3],
                self.place,
                self.child,
                self.brick,
                self.request,
                self.stamp_tile,
                self.bricks,
                self.constant,
                self.value_range,
                self.stamp_brick,
                self.table,
                self.domain,
                self.opaque,
                self.frame,
                0,
                self.branching,
                self.root,
                self.depth,
                self.border,
                self.component,
                self.cone_scale,
                self.root_voxel,
                self.step,
                self.stop_alpha,
                self.depth_alpha,
                False,
            )
            return color, alpha, depth, samples, color.new_zeros((0, 3)), color.new_zeros((0, 0))
        with_normals, with_others = len(self.normal_constant) > 0, len(self.other_constant) > 0
        color, alpha, depth, samples, _, normal, features = self.shade_rays(
            rays[0],
            rays[1],
            rays[2],
            rays[3],
            self.place,
            self.child,
            self.brick,
            self.request,
            self.stamp_tile,
            self.bricks,
            self.constant,
            self.value_range,
            self.stamp_brick,
            self.table,
            self.domain,
            self.opaque,
            self.frame,
            self.parameter,
            self.normals if with_normals else None,
            self.normal_constant if with_normals else None,
            self.others if with_others else None,
            self.other_constant if with_others else None,
            self.shader,
            self.features,
            self.other_component,
            0,
            self.branching,
            self.root,
            self.depth,
            self.border,
            self.component,
            self.cone_scale,
            self.root_voxel,
            self.step,
            self.stop_alpha,
            self.depth_alpha,
            False,
        )
        return color, alpha, depth, samples, normal, features


def _given(laid: dict[str, Any], name: str, nothing: Tensor) -> Tensor:
    found = laid.get(name)
    return nothing if found is None else found
