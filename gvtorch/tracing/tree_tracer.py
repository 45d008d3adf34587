"""`TreeTracer`: a tree and a shader as one `nn.Module` of plain tensors and one op.

It can be scripted, saved and loaded (also from C++), exported and compiled. Programs that load an
archive import `gvtorch.ops` first; C++ programs open `libgvtorch_cpu.so`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .. import cpp_ext
from ..base import check
from ..base import constants as config
from ..base.lasting import lasting
from ..base.own_dtypes import OwnDtypes
from ..base.records import Rays
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from ..ops import RayArguments, ShadeArguments, TraceArguments
from ..ops.trace import shade_op
from ..pool import N3Tree
from ..shaders.shader import Shader, check_shader
from .options import RenderOptions
from .tracer import Tracer


class TreeTracer(OwnDtypes):
    """Traces world rays through a resident tree, as `render` does. Pools are buffers: `.to(device)`
    moves them. Their dtypes stay as kernels need them, even if `half()`, `bfloat16()` or `double()`
    is called on a net that contains the module. Any number of threads may trace at a time, while
    none writes into its buffers. `DistributedDataParallel` needs `broadcast_buffers=False`: each
    process has the pools, and what sends buffers there knows no 16-bit integers.

    Buffers and numbers are named after the ops' arguments. Light and material of a lit shader are
    the buffer `parameter_54`, see `ops.shade_rays`; it may be edited.
    """

    if TYPE_CHECKING:  # the arguments, which are registered by name

        def __getattr__(self, name: str) -> Any: ...

    @lasting
    def __init__(
        self,
        tree: N3Tree,
        shader: Shader,
        *,
        channel: str | None = None,
        component: int = 0,
        step: float = config.STEP,
        stop_alpha: float = config.STOP_ALPHA,
        depth_alpha: float = config.DEPTH_ALPHA,
        cone_scale: float = config.CONE_OVERESTIMATE,
    ) -> None:
        """Shares the tree's pools, but copies the usage stamps. The shader is the transfer
        function, or another fused one; the rest are fields of `RenderOptions`.

        Raises:
            RuntimeError: The compiled op is missing.
            ValueError: The channel is unknown, or a number is out of its range.
        """
        super().__init__()
        if reason := cpp_ext.load()["cpp"]:
            raise RuntimeError(f"TreeTracer needs the compiled op: {reason}")
        check.instance("TreeTracer", "tree", tree, N3Tree)
        check_shader("TreeTracer", "shader", shader)
        if shader.uses_torch:
            kind = type(shader).__name__
            hint = "hold that in the net instead, and trace with gv.trace"
            raise ValueError(f"TreeTracer: shader must be one of the kernels', got {kind}: {hint}")
        options = RenderOptions(
            step=step,
            stop_alpha=stop_alpha,
            depth_alpha=depth_alpha,
            cone_scale=cone_scale,
            channel=channel,
            component=component,
        )
        tracer = Tracer(tree, shader, options)
        arguments, shading = tracer.arguments, tracer.shading or ShadeArguments()
        width = arguments.bricks_bzyxc.shape[4]
        check.integer("TreeTracer", "component", arguments.component, low=0, high=width - 1)
        arguments = arguments._replace(
            stamp_t=arguments.stamp_t.clone(),  # not the tree's: frames are counted separately
            stamp_b=arguments.stamp_b.clone(),
            frame_1=torch.zeros_like(arguments.frame_1),
        )
        empty = parameters = torch.zeros(0, device=tree.device)
        self.plain = tracer.shading is None  # the kernel of `trace_rays` draws it
        if not self.plain:
            parameters = shader.parameter_tensor(tree, options.dtype)
        self.shade_rays = shade_op(shader.op)
        for name, value in {**arguments._asdict(), **shading._asdict()}.items():
            if isinstance(value, (int, float)):
                setattr(self, name, value)
            else:
                self.register_buffer(name, empty if value is None else value)
        self.register_buffer("parameter_54", parameters)
        self.box = tree.box  # (2, 3) on the CPU, where `rays` places cameras
        self.about = f"{tree!r}, {shader!r}"

    def __repr__(self) -> str:
        return f"TreeTracer({self.about})"

    @torch.jit.unused
    def rays(self, camera: Camera | Rays) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns the rays of a camera's pixels as `forward` takes them, in the shape of its
        picture: origin and direction (h, w, 3), cone and range (h, w, 2), or (n, h, w, ...) for a
        batch. An orbit camera is placed around the tree's box.
        """
        placed = as_camera("TreeTracer.rays", camera).placed(self.box)
        rays = placed.rays(self.place_33.device)
        columns = (rays.origin, rays.direction, rays.cone, rays.range)
        origin, direction, cone, ranges = map(placed.image, columns)
        return origin, direction, cone, ranges

    def __getstate__(self) -> dict[str, Any]:
        """Replaces the op, which can't be pickled, by its name."""
        return {**self.__dict__, "shade_rays": str(self.shade_rays)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Finds the op again.

        Raises:
            RuntimeError: The op of a `CompiledShader` is not loaded in this process.
        """
        namespace, name = state["shade_rays"].split(".")
        op = getattr(getattr(torch.ops, namespace), name, None)
        if op is None:
            hint = "torch.ops.load_library of its shader's libraries first"
            raise RuntimeError(f"TreeTracer: op {name} is not loaded: {hint}")
        super().__setstate__({**state, "shade_rays": op})
        _check_words(self._buffers, "")

    @torch.jit.unused
    def _load_from_state_dict(
        self, state: dict[str, Any], prefix: str, _metadata: Any, strict: bool, *lists: list[str]
    ) -> None:
        """Loads nothing, and reports an error, if words point outside the pools."""
        try:
            _check_words(state, prefix)
        except ValueError as error:
            lists[-1].append(str(error))
            return
        super()._load_from_state_dict(state, prefix, _metadata, strict, *lists)

    def forward(
        self, origin: Tensor, direction: Tensor, cone: Tensor, range: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Traces rays in world units, of any leading shape `...`, the same for all four.

        Args:
            origin: (..., 3) float32 or float64, as the others: rays enter the tree in float64.
            direction: (..., 3) unit length.
            cone: (..., 2) width at the origin and growth per unit distance; zeros: finest level.
            range: (..., 2) first and last distance.

        Returns:
            float32 color (..., 3) premultiplied, alpha and depth (..., 1); int32 samples (...).

        Raises:
            ValueError: A tensor has another shape.
        """
        color, alpha, depth, samples, _, _ = self.hits(origin, direction, cone, range)
        return color, alpha, depth, samples

    @torch.jit.export
    def hits(
        self, origin: Tensor, direction: Tensor, cone: Tensor, range: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """As `forward`; also returns normal (..., 3) and features (..., c), which are (0, 3) and
        (0, 0) where the shader gives none.
        """
        leading = list(origin.shape[:-1])
        rays = RayArguments(
            _rows("origin", origin, leading, 3),
            _rows("direction", direction, leading, 3),
            _rows("cone", cone, leading, 2),
            _rows("range", range, leading, 2),
            0,
            None,
        )
        arguments = self.arguments()
        if self.plain:
            color, alpha, depth, samples, _ = torch.ops.gvtorch.trace_rays(*rays, *arguments)
            normal, features = color.new_zeros((0, 3)), color.new_zeros((0, 0))
        else:
            color, alpha, depth, samples, _, normal, features = self.shade_rays(
                *rays, *arguments, *self.shading(), self.parameter_54
            )
            normal, features = _unflatten(normal, leading), _unflatten(features, leading)
        color, alpha = _unflatten(color, leading), _unflatten(alpha, leading)
        depth, samples = _unflatten(depth, leading), samples.reshape(leading)
        return color, alpha, depth, samples, normal, features

    def arguments(self) -> TraceArguments:
        """Returns the op's arguments on the tree."""
        return TraceArguments(
            place_33=self.place_33,
            branching=self.branching,
            max_depth=self.max_depth,
            border=self.border,
            root_voxel=self.root_voxel,
            cone_scale=self.cone_scale,
            step=self.step,
            bricks_bzyxc=self.bricks_bzyxc,
            constant_tnc=self.constant_tnc,
            range_tn2c=self.range_tn2c,
            component=self.component,
            child_tn=self.child_tn,
            brick_tn=self.brick_tn,
            request_tn=self.request_tn,
            stamp_t=self.stamp_t,
            stamp_b=self.stamp_b,
            frame_1=self.frame_1,
            root=self.root,
            table_lm4=self.table_lm4,
            domain_2=self.domain_2,
            opaque_m=self.opaque_m,
            stop_alpha=self.stop_alpha,
            depth_alpha=self.depth_alpha,
            by_level=self.by_level,
        )

    def shading(self) -> ShadeArguments:
        """Returns the op's arguments on the shader and its channels."""
        return ShadeArguments(
            shader=self.shader,
            features=self.features,
            normal_bzyxc=_none_if_empty(self.normal_bzyxc),
            normal_tnc=_none_if_empty(self.normal_tnc),
            other_bzyxc=_none_if_empty(self.other_bzyxc),
            other_tnc=_none_if_empty(self.other_tnc),
            other_component=self.other_component,
        )


def _check_words(tensors: Mapping[str, Any], prefix: str) -> None:
    """Raises ValueError if words in `tensors` point outside the pools there."""
    names = ("child_tn", "brick_tn", "bricks_bzyxc")
    pools: list[Any] = [tensors.get(prefix + name) for name in names]
    if not all(isinstance(pool, Tensor) for pool in pools):
        return  # only some tensors are loaded: kernels treat such words as absent
    child, brick, bricks = pools
    check.integers_in("TreeTracer", f"{prefix}child_tn", child, config.TERMINAL, len(child) - 1)
    check.integers_in("TreeTracer", f"{prefix}brick_tn", brick, config.CONSTANT, len(bricks) - 1)


def _rows(name: str, column: Tensor, leading: list[int], width: int) -> Tensor:
    """Returns a column of rays (..., width) as float64 rows; ValueError for another shape."""
    shape = leading + [width]  # noqa: RUF005  (TorchScript has no stars here)
    if list(column.shape) != shape:
        raise ValueError(f"TreeTracer: {name} must be {shape}, got {list(column.shape)}")
    return column.to(torch.float64).reshape(-1, width).contiguous()


def _unflatten(rows: Tensor, leading: list[int]) -> Tensor:
    """Returns rows (r, c) as (..., c)."""
    return rows.reshape(leading + [rows.shape[1]])  # noqa: RUF005  (TorchScript has no stars here)


def _none_if_empty(buffer: Tensor) -> Tensor | None:
    """Returns the buffer, or None if it is the empty one that represents None."""
    return buffer if buffer.dim() > 1 else None
