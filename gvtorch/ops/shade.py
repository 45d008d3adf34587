"""`shade_rays`: rays through an N3 tree with any of the fused shaders or a user's own, checked and
sent to a backend.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base import constants as config
from .reference import shaders as reference_shaders
from .shading import ShaderKind
from .trace import Backend, check_arguments, choose_backend

_TENSORS = (
    *("origin_r3", "direction_r3", "cone_r2", "range_r2", "place_33"),
    *("child_tn", "brick_tn", "request_tn", "stamp_t"),
    *("bricks_bzyxc", "constant_tnc", "range_tn2c", "stamp_b"),
    *("table_lm4", "domain_2", "opaque_m", "frame_1"),
)
_NUMBERS = ("branching", "root", "max_depth", "border", "component")


def shade_rays(
    *,
    shader: int | str,
    parameter_54: Tensor,
    normal_bzyxc: Tensor | None = None,
    normal_tnc: Tensor | None = None,
    other_bzyxc: Tensor | None = None,
    other_tnc: Tensor | None = None,
    features: int = 0,
    other_component: int = 0,
    width: int = 0,
    cone_scale: float,
    root_voxel: float,
    step: float,
    stop_alpha: float = config.STOP_ALPHA,
    depth_alpha: float = config.DEPTH_ALPHA,
    by_level: bool = False,
    clear_r: Tensor | None = None,
    backend: Backend = "auto",
    **shared: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Traces rays through a tree and shades what they meet with a fused shader, or a user's.

    Args:
        shader: A `shading.ShaderKind`, or the name of a user's op, see `cpp_ext.user`.
        parameter_54: (5, 4) in the table's dtype, as `shading.ShadeParameters` packs them. For a
            user's op (20 + k,): the same and its own k numbers.
        normal_bzyxc: (b, s, s, s, 3) channel of normals; None takes the gradient's.
        normal_tnc: (t, n, 3) its constants.
        other_bzyxc: (b, s, s, s, c) a second channel: the value that colours an isosurface, or
            features.
        other_tnc: (t, n, c) its constants.
        features: How many the shader gives: c for features, 1 (the value) for projections, else 0;
            a user's op checks it.
        other_component: Which number of the second channel colours an isosurface.
        width: See `trace_rays`, as all that follow and all tensors not named here. Where the shader
            integrates, the table is (l, m, m, 4): premultiplied colour and alpha by the value in
            front (rows) and behind.

    Returns:
        color, alpha, depth, samples, missed as `trace_rays`; normal (r, 3) in the world, towards
        the eye, unit or zero; features (r, c).

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.

    Source: Blinn, SIGGRAPH 1977; Engel, Kraus, Ertl, Graphics Hardware 2001.
    """
    where = "shade_rays"
    unknown = sorted(set(shared) ^ {*_TENSORS, *_NUMBERS})
    if unknown:
        raise ValueError(f"{where}: argument {unknown[0]!r} is missing or unknown")
    tensors = {name: shared[name] for name in _TENSORS}
    whole = tuple(shared[name] for name in _NUMBERS)
    reals = (cone_scale, root_voxel, step, stop_alpha, depth_alpha)
    own = isinstance(shader, str)
    number = 0 if own else check.whole(where, "shader", shader, low=0, high=max(ShaderKind))
    kind = ShaderKind(number)
    rows = tensors["table_lm4"].shape[1] if tensors["table_lm4"].dim() > 1 else 0
    square = ("l", rows, rows, 4) if shader == ShaderKind.PRE_INTEGRATED else ("l", "m", 4)
    check_arguments(where, tensors, (width, *whole, *reals), square, clear_r)
    table, like = tensors["table_lm4"], tensors["bricks_bzyxc"]
    device = table.device
    numbers = ("20 + k",) if own else (5, 4)
    check.tensor(where, "parameter_54", parameter_54, numbers, table.dtype, device)
    for name, bricks, constants, count in (
        ("normal", normal_bzyxc, normal_tnc, 3),
        ("other", other_bzyxc, other_tnc, "c"),
    ):
        if (bricks is None) != (constants is None):
            raise ValueError(f"{where}: {name}_bzyxc and {name}_tnc belong together")
        if bricks is None or constants is None:
            continue
        check.tensor(where, f"{name}_bzyxc", bricks, (*like.shape[:4], count), bricks.dtype, device)
        shape = (*tensors["child_tn"].shape, bricks.shape[4])
        check.tensor(where, f"{name}_tnc", constants, shape, bricks.dtype, device)
        if not (bricks.is_contiguous() and constants.is_contiguous()):
            raise ValueError(f"{where}: {name}_bzyxc and {name}_tnc must be contiguous")
    if kind.stores_color and (like.shape[4] not in (4, 24) or shared["component"] != 3):
        raise ValueError(
            f"{where}: stored colour needs a channel of 4 or 24 numbers and component 3"
        )
    if shader == ShaderKind.FEATURES and other_bzyxc is None:
        raise ValueError(f"{where}: features need other_bzyxc")
    others = 0 if other_bzyxc is None else other_bzyxc.shape[4]
    if own:
        check.whole(where, "features", features, low=0)
    else:
        given = {ShaderKind.FEATURES: others, ShaderKind.PROJECTION: 1}.get(kind, 0)
        check.whole(where, "features", features, low=given, high=given)
    check.whole(where, "other_component", other_component, low=0, high=max(0, others - 1))

    args = (
        *tensors.values(),
        *(parameter_54.contiguous(), normal_bzyxc, normal_tnc, other_bzyxc, other_tnc),
        *(int(kind), features, other_component, width),
        *whole,
        *(float(real) for real in reals),
        *(by_level, clear_r),
    )
    if choose_backend(backend, device) == "reference":
        if own:
            raise ValueError(f"{where}: a shader in C++ has no reference: write a ModuleShader")
        return reference_shaders.shade_rays(*args)
    return op_of(shader)(*args)


def op_of(shader: int | str) -> Any:
    """Returns the op of a shader, as `shade_rays` numbers or names it."""
    if isinstance(shader, str):
        return getattr(torch.ops.gvtorch_user, shader)
    return torch.ops.gvtorch.shade_rays
