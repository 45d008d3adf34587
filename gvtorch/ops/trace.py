"""`trace_rays` and `shade_rays`: rays through a tree, shaded inside the kernel.

The ops and their shared checks, which those of `segments.py` use as well, raise ValueError for a
tensor of the wrong shape, dtype or device and for a number out of its range; the message names op,
argument and value. Checks return the size of each letter in the shapes.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base import constants as config
from ..base.volume import CHANNEL_DTYPES
from .arguments import RayArguments, ShadeArguments, TraceArguments
from .reference import march, shaders
from .reference.lit import Lit
from .reference.shaders import SHADER_KINDS
from .registry import Backend, choose_backend, fake_of
from .shading import COLOR_WIDTH, channel_widths


def _fields(record: Any, dtype: torch.dtype, names: str) -> list[check.Field]:
    return [(name, getattr(record, name), check.shape_of(name), dtype) for name in names.split()]


def check_rays(context: str, rays: RayArguments) -> dict[str, int]:
    """Checks rays."""
    names = "origin_r3 direction_r3 cone_r2 range_r2"
    names += "" if rays.clear_r is None else " clear_r"
    sizes = check.tensors(context, rays.origin_r3.device, _fields(rays, torch.float64, names))
    check.integer(context, "width", rays.width, low=0)
    if rays.width and sizes["r"] % rays.width:
        raise ValueError(f"{context}: {sizes['r']} rays are not whole rows of {rays.width} pixels")
    return sizes


def check_channel(context: str, arguments: TraceArguments, device: torch.device) -> dict[str, int]:
    """Checks the fields of `TraceArguments.channel`: placement, bricks and constants."""
    place = arguments.place_33
    if isinstance(place, Tensor) and place.device != device:
        raise ValueError(f"{context}: the rays are on {device}, the tree is on {place.device}")
    n = check.integer(context, "branching", arguments.branching, low=2, high=config.MAX_BRANCHING)
    fields = _fields(arguments, arguments.bricks_bzyxc.dtype, "bricks_bzyxc constant_tnc")
    placement = _fields(arguments, torch.float64, "place_33")
    sizes = check.tensors(context, device, placement + fields)
    depth = check.integer(context, "max_depth", arguments.max_depth, low=0, high=62)
    if n**depth > config.MOST_NODES:
        raise ValueError(f"{context}: branching {n}, max_depth {depth}: over 2^50 nodes a side")
    check.integer(context, "border", arguments.border, low=0, high=(sizes["s"] - 1) // 2)
    check.number(context, "root_voxel", arguments.root_voxel, low=0, open_low=True)
    check.number(context, "step", arguments.step, low=0, open_low=True)
    check.number(context, "cone_scale", arguments.cone_scale, low=0)
    return sizes


def check_voxels(context: str, arguments: TraceArguments) -> None:
    """Checks that the bricks' dtype has a kernel."""
    voxel = arguments.bricks_bzyxc.dtype
    if voxel not in CHANNEL_DTYPES:
        raise ValueError(f"{context}: bricks_bzyxc has dtype {voxel}, which no channel can have")


def check_real(context: str, name: str, tensor: Tensor, shape: str) -> None:
    """Checks that a tensor is float32 or float64; `shape`, as "(k,)", is only for the message."""
    if tensor.dtype not in (torch.float32, torch.float64):
        got = check.describe(tensor)
        raise ValueError(f"{context}: {name} must be {shape} float32 or float64, got {got}")


def check_trace(
    context: str, rays: RayArguments, arguments: TraceArguments, table_shape: str = "lm4"
) -> dict[str, int]:
    """Checks rays, tree, pools and transfer function."""
    table, device = arguments.table_lm4, rays.origin_r3.device
    check_real(context, "table_lm4", table, f"({', '.join(table_shape)})")
    check_voxels(context, arguments)
    fields = [
        *_fields(arguments, arguments.bricks_bzyxc.dtype, "range_tn2c"),
        ("table_lm4", table, table_shape, table.dtype),
        *_fields(arguments, table.dtype, "domain_2"),
        *_fields(arguments, torch.int32, "child_tn brick_tn stamp_t stamp_b"),
        *_fields(arguments, torch.int16, "request_tn"),
        *_fields(arguments, torch.int32, "opaque_m frame_1"),
    ]
    sizes = check_rays(context, rays) | check_channel(context, arguments, device)
    sizes = check.tensors(context, device, fields, sizes)
    if sizes["n"] < arguments.branching**3:
        wanted = f"{arguments.branching}^3 nodes a tile"
        raise ValueError(f"{context}: child_tn must hold {wanted}, got {sizes['n']}")
    if sizes["l"] < 1 or sizes["m"] < 2:
        got = check.describe(table)
        raise ValueError(f"{context}: table_lm4 needs at least 1 length and 2 rows, got {got}")
    check.integer(context, "root", arguments.root, low=0, high=sizes["t"] * sizes["n"] - 1)
    check.integer(context, "component", arguments.component, low=0, high=sizes["c"] - 1)
    check.number(context, "stop_alpha", arguments.stop_alpha, low=0, high=1)
    check.number(context, "depth_alpha", arguments.depth_alpha, low=0, high=1)
    return sizes


def check_shade(
    rays: RayArguments,
    arguments: TraceArguments,
    shading: ShadeArguments,
    parameter_54: Tensor,
    user_op: bool,
) -> None:
    """Checks everything that a shader reads; `user_op` is true for a user's shader."""
    context = "shade_rays"
    kinds = [Lit] if user_op else [kind.twin for kind in SHADER_KINDS.values()]
    twin = kinds[check.integer(context, "shader", shading.shader, low=0, high=len(kinds) - 1)]
    sizes = check_trace(context, rays, arguments, "lmm4" if twin.integrates else "lm4")
    device, shape = rays.origin_r3.device, "k" if user_op else "54"
    parameters = ("parameter_54", parameter_54, shape, arguments.table_lm4.dtype)
    check.tensors(context, device, [parameters])
    # Filtered colours are those of coarse slots only, so there are fewer.
    other_width, other_slots = 0, "e" if twin.filtered else "b"
    for name, bricks, constants, slots, width in (
        ("normal", shading.normal_bzyxc, shading.normal_tnc, "b", "3"),
        ("other", shading.other_bzyxc, shading.other_tnc, other_slots, "d"),
    ):
        if (bricks is None) != (constants is None) and slots == "b":
            raise ValueError(f"{context}: {name}_bzyxc and {name}_tnc belong together")
        if bricks is not None:
            fields = [(f"{name}_bzyxc", bricks, f"{slots}sss{width}", bricks.dtype)]
            if constants is not None:
                fields.append((f"{name}_tnc", constants, f"tn{width}", bricks.dtype))
            other_width = check.tensors(context, device, fields, sizes).get("d", 0)
            check.integer(context, f"bricks of {name}_bzyxc", len(bricks), low=0, high=sizes["b"])
    one, by_direction = channel_widths(COLOR_WIDTH)
    if twin.colored and not (sizes["c"] in (one, by_direction) and arguments.component == 3):
        wanted = f"a channel of {one} or {by_direction} numbers and component 3"
        raise ValueError(f"{context}: stored colour needs {wanted}")
    if twin.feature_count is None and not other_width:
        raise ValueError(f"{context}: features need other_bzyxc")
    one, by_direction = channel_widths(twin.filtered)
    if twin.filtered and other_width not in (one, by_direction):
        wanted = f"an other_bzyxc of {one} or {by_direction} numbers"
        raise ValueError(f"{context}: filtered colours need {wanted}")
    features = other_width if twin.feature_count is None else twin.feature_count
    limits = {} if user_op else {"high": features}
    check.integer(context, "features", shading.features, low=features, **limits)
    high = max(0, other_width - 1)
    check.integer(context, "other_component", shading.other_component, low=0, high=high)


def _refuse_gradients(context: str, *records: Any) -> None:
    """Makes twins refuse the gradients that the ops refuse, see `registry.py`."""
    for record in records:
        for name, value in record._asdict().items():
            check.no_gradient(context, name, value)


def trace_rays(
    rays: RayArguments, arguments: TraceArguments, *, backend: Backend = "auto"
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Traces rays through a tree and shades what they meet with a transfer function.

    Mutates `request_tn` (what rays missed), `stamp_t` and `stamp_b` (what rays used).

    Where rays begin with a transmittance, colour is only what this piece of the ray adds, and alpha
    that of the whole ray so far.

    Returns:
        color (r, 3) premultiplied linear RGB, alpha (r, 1), depth (r, 1) world units or +inf, in
        the table's dtype; samples (r,) int32, missed (r,) bool: a node or brick that the ray needed
        was absent.

    Source: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels", I3D 2009, sections 3 and 4.
    """
    check_trace("trace_rays", rays, arguments)
    if choose_backend(backend, rays.origin_r3.device) == "reference":
        _refuse_gradients("trace_rays", rays, arguments)
        return march.trace_rays(rays, arguments)
    return torch.ops.gvtorch.trace_rays(*rays, *arguments)


def shade_rays(
    rays: RayArguments,
    arguments: TraceArguments,
    shading: ShadeArguments,
    parameter_54: Tensor,
    *,
    op: str | None = None,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Traces rays through a tree and shades what they meet with a fused shader, or a user's.

    Args:
        rays: The rays.
        arguments: Tree, pools and transfer function; mutated as by `trace_rays`.
        shading: The shader and its channels.
        parameter_54: (5, 4) in the table's dtype, as `shading.ShadeParameters` packs them. For a
            user's op (20 + k,): the same, then k custom numbers.
        op: Name of a user's op, see `cpp_ext.user`; None: the fused shader `shading.shader`.

    Returns:
        color, alpha, depth, samples, missed as `trace_rays`; normal (r, 3) in the world, towards
        the eye, unit or zero; features (r, c).

    Source: Blinn, SIGGRAPH 1977; Engel, Kraus, Ertl, Graphics Hardware 2001.
    """
    check_shade(rays, arguments, shading, parameter_54, user_op=op is not None)
    if choose_backend(backend, rays.origin_r3.device) != "reference":
        return shade_op(op)(*rays, *arguments, *shading, parameter_54)
    if op is not None:
        raise ValueError("shade_rays: a shader in C++ has no reference: write a ModuleShader")
    _refuse_gradients("shade_rays", rays, arguments, shading)
    check.no_gradient("shade_rays", "parameter_54", parameter_54)
    return shaders.shade_rays(rays, arguments, shading, parameter_54)


def shade_op(name: str | None) -> Any:
    """Returns the op of a user's shader, or for None that of the fused shaders."""
    if name is None:
        return torch.ops.gvtorch.shade_rays
    return getattr(torch.ops.gvtorch_user, name)


@fake_of("trace_rays", gradients=False)
def _fake_hits(*, origin_r3: Tensor, table_lm4: Tensor, **_: Any) -> tuple[Tensor, ...]:
    rays = origin_r3.shape[0]
    return (
        *(table_lm4.new_empty((rays, width)) for width in (3, 1, 1)),
        table_lm4.new_empty((rays,), dtype=torch.int32),
        table_lm4.new_empty((rays,), dtype=torch.bool),
    )


@fake_of("shade_rays", gradients=False)
def _fake_shaded_hits(*, table_lm4: Tensor, features: int, **arguments: Any) -> tuple[Tensor, ...]:
    hits = _fake_hits(table_lm4=table_lm4, **arguments)
    rays = hits[0].shape[0]
    return (*hits, *(table_lm4.new_empty((rays, width)) for width in (3, features)))
