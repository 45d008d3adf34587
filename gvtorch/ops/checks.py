"""Checks of the records in `arguments.py`: one line that says which op, argument and value."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base.volume import CHANNEL_DTYPES
from .arguments import RayArguments, ShadeArguments, TraceArguments
from .shading import SHADER_KINDS


def _tensors(record: Any, names: str, dtype: torch.dtype) -> Iterable[check.Field]:
    for name in names.split():
        yield name, getattr(record, name), check.shape_of(name), dtype


def check_rays(where: str, rays: RayArguments) -> dict[str, int]:
    """Raises ValueError unless rays are right; returns r."""
    device, names = rays.origin_r3.device, "origin_r3 direction_r3 cone_r2 range_r2"
    names += "" if rays.clear_r is None else " clear_r"
    sizes = check.tensors(where, device, _tensors(rays, names, torch.float64))
    check.whole(where, "width", rays.width, low=0)
    if rays.width and sizes["r"] % rays.width:
        raise ValueError(f"{where}: {sizes['r']} rays are no whole rows of {rays.width} pixels")
    return sizes


def check_channel(where: str, arguments: TraceArguments, device: torch.device) -> dict[str, int]:
    """Raises ValueError unless what tells where the tree lies, its bricks and constants are right;
    returns b, s, t, n and c.
    """
    check.whole(where, "branching", arguments.branching, low=2, high=16)
    voxel = arguments.bricks_bzyxc.dtype
    sizes = check.tensors(
        where,
        device,
        (
            *_tensors(arguments, "place_33", torch.float64),
            *_tensors(arguments, "bricks_bzyxc constant_tnc", voxel),
        ),
    )
    check.whole(where, "max_depth", arguments.max_depth, low=0, high=62)
    check.whole(where, "border", arguments.border, low=0, high=(sizes["s"] - 1) // 2)
    for name in ("root_voxel", "step"):
        check.number(where, name, getattr(arguments, name), low=0, open_low=True)
    check.number(where, "cone_scale", arguments.cone_scale, low=0)
    return sizes


def check_voxels(where: str, arguments: TraceArguments) -> None:
    """Raises ValueError where the bricks' dtype has no kernel."""
    voxel = arguments.bricks_bzyxc.dtype
    if voxel not in CHANNEL_DTYPES:
        raise ValueError(f"{where}: bricks_bzyxc has dtype {voxel}, which no channel can have")


def check_real(where: str, name: str, tensor: Tensor, shape: str) -> None:
    """Raises ValueError unless a tensor is of float32 or float64."""
    if tensor.dtype not in (torch.float32, torch.float64):
        got = check.describe(tensor)
        raise ValueError(f"{where}: {name} must be {shape} float32 or float64, got {got}")


def check_trace(
    where: str, rays: RayArguments, arguments: TraceArguments, table_shape: str = "lm4"
) -> dict[str, int]:
    """Raises ValueError unless rays and what they go through are right.

    Args:
        where: The op.
        rays: The rays.
        arguments: What they go through.
        table_shape: A letter or digit a dimension.

    Returns:
        The sizes that the letters of shapes stand for.
    """
    table, device = arguments.table_lm4, rays.origin_r3.device
    check_real(where, "table_lm4", table, f"({', '.join(table_shape)})")
    check_voxels(where, arguments)
    sizes = check_rays(where, rays) | check_channel(where, arguments, device)
    words = "child_tn brick_tn request_tn stamp_t stamp_b opaque_m frame_1"
    sizes = check.tensors(
        where,
        device,
        (
            *_tensors(arguments, "range_tn2c", arguments.bricks_bzyxc.dtype),
            ("table_lm4", table, table_shape, table.dtype),
            *_tensors(arguments, "domain_2", table.dtype),
            *_tensors(arguments, words, torch.int32),
        ),
        sizes,
    )
    if sizes["n"] < arguments.branching**3:
        wanted = f"{arguments.branching}^3 nodes a tile"
        raise ValueError(f"{where}: child_tn must hold {wanted}, got {sizes['n']}")
    if sizes["l"] < 1 or sizes["m"] < 2:
        got = check.describe(table)
        raise ValueError(f"{where}: table_lm4 needs at least 1 length and 2 rows, got {got}")
    check.whole(where, "root", arguments.root, low=0, high=sizes["t"] * sizes["n"] - 1)
    check.whole(where, "component", arguments.component, low=0, high=sizes["c"] - 1)
    for name in ("stop_alpha", "depth_alpha"):
        check.number(where, name, getattr(arguments, name), low=0, high=1)
    return sizes


def check_shade(
    where: str,
    rays: RayArguments,
    arguments: TraceArguments,
    shading: ShadeArguments,
    parameter_54: Tensor,
    own: bool,
) -> None:
    """Raises ValueError unless all that a shader reads is right; `own`: it is a user's."""
    known = ("",) if own else SHADER_KINDS
    kind = known[check.whole(where, "shader", shading.shader, low=0, high=len(known) - 1)]
    sizes = check_trace(where, rays, arguments, "lmm4" if kind == "PreIntegrated" else "lm4")
    table, device, shape = arguments.table_lm4, rays.origin_r3.device, "k" if own else "54"
    parameters = ("parameter_54", parameter_54, shape, table.dtype)
    check.tensors(where, device, [parameters])
    others = 0
    for name, bricks, constants, width in (
        ("normal", shading.normal_bzyxc, shading.normal_tnc, "3"),
        ("other", shading.other_bzyxc, shading.other_tnc, "d"),
    ):
        if (bricks is None) != (constants is None):
            raise ValueError(f"{where}: {name}_bzyxc and {name}_tnc belong together")
        if bricks is not None and constants is not None:
            fields = (
                (f"{name}_bzyxc", bricks, f"bsss{width}", bricks.dtype),
                (f"{name}_tnc", constants, f"tn{width}", bricks.dtype),
            )
            others = check.tensors(where, device, fields, sizes).get("d", 0)
    colored = sizes["c"] in (4, 24) and arguments.component == 3
    if kind in ("StoredColor", "ShadowedColor") and not colored:
        raise ValueError(
            f"{where}: stored colour needs a channel of 4 or 24 numbers and component 3"
        )
    if kind == "Features" and not others:
        raise ValueError(f"{where}: features need other_bzyxc")
    if own:
        check.whole(where, "features", shading.features, low=0)
    else:
        given = {"Features": others, "Projection": 1}.get(kind, 0)
        check.whole(where, "features", shading.features, low=given, high=given)
    high = max(0, others - 1)
    check.whole(where, "other_component", shading.other_component, low=0, high=high)
