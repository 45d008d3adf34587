"""`trace_rays`: rays through an N3 tree, checked and sent to a backend."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from ..base import check
from ..base import constants as config
from ..base.volume import CHANNEL_DTYPES
from .reference import march as reference
from .registry import available

Backend = Literal["auto", "reference", "cpp", "cuda"]


def choose_backend(backend: str, device: torch.device) -> str:
    """Returns the backend that runs on `device`: `auto` takes the compiled one where there is one.

    Raises:
        ValueError: The backend is unknown, can't be used here, or does not run on `device`.
    """
    if backend not in ("auto", "reference", "cpp", "cuda"):
        raise ValueError(f"backend must be auto, reference, cpp or cuda, got {backend!r}")
    compiled = {"cpu": "cpp", "cuda": "cuda"}.get(device.type)
    if backend == "auto":
        return compiled if compiled and not available()[compiled] else "reference"
    reason = available()[backend]
    if reason:
        raise ValueError(f"backend {backend!r} can't be used here: {reason}")
    if backend not in ("reference", compiled):
        raise ValueError(f"backend {backend!r} does not run on device {device}")
    return backend


def trace_rays(
    origin_r3: Tensor,
    direction_r3: Tensor,
    cone_r2: Tensor,
    range_r2: Tensor,
    place_33: Tensor,
    child_tn: Tensor,
    brick_tn: Tensor,
    request_tn: Tensor,
    stamp_t: Tensor,
    bricks_bzyxc: Tensor,
    constant_tnc: Tensor,
    range_tn2c: Tensor,
    stamp_b: Tensor,
    table_lm4: Tensor,
    domain_2: Tensor,
    opaque_m: Tensor,
    frame_1: Tensor,
    *,
    width: int = 0,
    branching: int,
    root: int,
    max_depth: int,
    border: int,
    component: int,
    cone_scale: float,
    root_voxel: float,
    step: float,
    stop_alpha: float = config.STOP_ALPHA,
    depth_alpha: float = config.DEPTH_ALPHA,
    by_level: bool = False,
    clear_r: Tensor | None = None,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Traces rays through a tree and shades what they meet with a transfer function.

    Mutates `request_tn` (what rays missed), `stamp_t` and `stamp_b` (what rays used). Every tensor
    is contiguous and on one device; rays are float64, words int32. The table's dtype, float32 or
    float64, is the one in which rays are traced.

    Args:
        origin_r3: (r, 3) ray origins, world units.
        direction_r3: (r, 3) ray directions of unit length.
        cone_r2: (r, 2) cone width at distance 0 and its growth, world units; zeros ask for the
            finest level.
        range_r2: (r, 2) first and last distance, world units.
        place_33: (3, 3) float64: low corner of the scene and size of the root cube in the world,
            high corner of the scene in tree units.
        child_tn: (t, n) tile of a node's children, or ABSENT, TERMINAL.
        brick_tn: (t, n) a node's brick slot, or ABSENT, EMPTY, CONSTANT.
        request_tn: (t, n) request words, written.
        stamp_t: (t,) last frame that used a tile, written.
        bricks_bzyxc: (b, s, s, s, c) one channel of the brick pool, s = brick size + 2 border.
        constant_tnc: (t, n, c) the value of CONSTANT nodes (and the mean of EMPTY ones), same
            dtype.
        range_tn2c: (t, n, 2, c) smallest and largest value in reach of the node's brick, same
            dtype: a node that shows nothing is neither entered, sampled nor requested.
        stamp_b: (b,) last frame that used a brick, written.
        table_lm4: (l, m, 4) transfer function: linear RGB, and the alpha of an interval of
            step * 2^l; m >= 2. Its memory begins at a multiple of 16 bytes.
        domain_2: (2,) value of the first row, value of the last row.
        opaque_m: (m,) int32, how many rows of the table up to this one have an opacity.
        frame_1: (1,) int32 number of this frame.
        width: Pixels of a row, if the rays are whole rows of a picture (which are then traced in
            tiles), else 0.
        branching: N, nodes of a tile along an axis.
        root: Index of the root node.
        max_depth: Depth of the finest level.
        border: Voxels of border on each side of a brick.
        component: Which of the c values the transfer function reads.
        cone_scale: Factor on cones.
        root_voxel: World size of a depth-0 voxel: a cone this wide wants depth 0.
        step: World length of the shortest interval between samples.
        stop_alpha: A ray ends at this alpha; 1 integrates to the end.
        depth_alpha: Depth is where alpha passes this.
        by_level: A node's brick is requested before its children; else the wanted level at once.
        clear_r: (r,) float64 transmittance with which each ray begins, for a ray that is traced in
            pieces; 1 if left out. Colour is what this piece adds, alpha is the ray's so far.
        backend: auto, reference, cpp or cuda.

    Returns:
        color (r, 3) premultiplied linear RGB, alpha (r, 1), depth (r, 1) world units or +inf, in
        the table's dtype; samples (r,) int32, missed (r,) bool: something that the ray saw was not
        there.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.

    Source: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels", I3D 2009, sections 3 and 4.
    """
    tensors = {
        "origin_r3": origin_r3,
        "direction_r3": direction_r3,
        "cone_r2": cone_r2,
        "range_r2": range_r2,
        "place_33": place_33,
        "child_tn": child_tn,
        "brick_tn": brick_tn,
        "request_tn": request_tn,
        "stamp_t": stamp_t,
        "bricks_bzyxc": bricks_bzyxc,
        "constant_tnc": constant_tnc,
        "range_tn2c": range_tn2c,
        "stamp_b": stamp_b,
        "table_lm4": table_lm4,
        "domain_2": domain_2,
        "opaque_m": opaque_m,
        "frame_1": frame_1,
    }
    numbers = (
        *(width, branching, root, max_depth, border, component),
        *(cone_scale, root_voxel, step, stop_alpha, depth_alpha),
    )
    check_arguments("trace_rays", tensors, numbers, ("l", "m", 4), clear_r)
    args = (
        *(origin_r3, direction_r3, cone_r2, range_r2, place_33),
        *(child_tn, brick_tn, request_tn, stamp_t, bricks_bzyxc, constant_tnc, range_tn2c),
        *(stamp_b, table_lm4, domain_2, opaque_m, frame_1),
        *(width, branching, root, max_depth, border, component),
        *(float(cone_scale), float(root_voxel), float(step)),
        *(float(stop_alpha), float(depth_alpha), by_level, clear_r),
    )
    if choose_backend(backend, origin_r3.device) == "reference":
        return reference.trace_rays(*args)
    return torch.ops.gvtorch.trace_rays(*args)


def check_arguments(
    where: str,
    tensors: Mapping[str, Tensor],
    numbers: tuple[Any, ...],
    table_shape: tuple[int | str, ...],
    clear_r: Tensor | None,
) -> None:
    """Raises ValueError unless what both ray ops have in common is right.

    Args:
        where: The op.
        tensors: The 17 tensors of `trace_rays`, by name.
        numbers: width, branching, root, max_depth, border, component, cone_scale, root_voxel, step,
            stop_alpha, depth_alpha.
        table_shape: What the table must be.
        clear_r: See `trace_rays`.
    """
    origin_r3, child_tn, bricks_bzyxc = (
        tensors[name] for name in ("origin_r3", "child_tn", "bricks_bzyxc")
    )
    table_lm4, device = tensors["table_lm4"], origin_r3.device
    width, branching, root, max_depth, border, component, *reals = numbers
    cone_scale, root_voxel, step, stop_alpha, depth_alpha = reals
    real = table_lm4.dtype
    if real not in (torch.float32, torch.float64):
        raise ValueError(
            f"{where}: table_lm4 must be (l, m, 4) float32 or float64, "
            f"got {check.describe(table_lm4)}"
        )
    check.whole(where, "branching", branching, low=2, high=16)
    rays, (tiles, nodes) = origin_r3.shape[0], child_tn.shape
    bricks, side = bricks_bzyxc.shape[0], bricks_bzyxc.shape[1]
    channels, voxel = bricks_bzyxc.shape[-1], bricks_bzyxc.dtype
    if voxel not in CHANNEL_DTYPES:
        raise ValueError(f"{where}: bricks_bzyxc has dtype {voxel}, which no channel can have")
    for name, shape, dtype in (
        ("origin_r3", (rays, 3), torch.float64),
        ("direction_r3", (rays, 3), torch.float64),
        ("cone_r2", (rays, 2), torch.float64),
        ("range_r2", (rays, 2), torch.float64),
        ("place_33", (3, 3), torch.float64),
        ("child_tn", (tiles, nodes), torch.int32),
        ("brick_tn", (tiles, nodes), torch.int32),
        ("request_tn", (tiles, nodes), torch.int32),
        ("stamp_t", (tiles,), torch.int32),
        ("bricks_bzyxc", (bricks, side, side, side, channels), voxel),
        ("constant_tnc", (tiles, nodes, channels), voxel),
        ("range_tn2c", (tiles, nodes, 2, channels), voxel),
        ("stamp_b", (bricks,), torch.int32),
        ("table_lm4", table_shape, real),
        ("domain_2", (2,), real),
        ("opaque_m", (table_lm4.shape[1],), torch.int32),
        ("frame_1", (1,), torch.int32),
    ):
        check.tensor(where, name, tensors[name], shape, dtype, device)
        if not tensors[name].is_contiguous():
            raise ValueError(f"{where}: {name} must be contiguous")
    if clear_r is not None:
        check.tensor(where, "clear_r", clear_r, (rays,), torch.float64, device)
        if not clear_r.is_contiguous():
            raise ValueError(f"{where}: clear_r must be contiguous")
    if nodes < branching**3:
        raise ValueError(f"{where}: child_tn must hold {branching}^3 nodes a tile, got {nodes}")
    if table_lm4.shape[0] < 1 or table_lm4.shape[1] < 2:
        raise ValueError(
            f"{where}: table_lm4 needs at least 1 length and 2 rows, "
            f"got {check.describe(table_lm4)}"
        )
    check.whole(where, "width", width, low=0)
    if width and rays % width:
        raise ValueError(f"{where}: {rays} rays are no whole rows of {width} pixels")
    check.whole(where, "root", root, low=0, high=tiles * nodes - 1)
    check.whole(where, "max_depth", max_depth, low=0, high=62)
    check.whole(where, "border", border, low=0, high=(side - 1) // 2)
    check.whole(where, "component", component, low=0, high=channels - 1)
    for name, number in (("root_voxel", root_voxel), ("step", step)):
        check.number(where, name, number, low=0, open_low=True)
    check.number(where, "cone_scale", cone_scale, low=0)
    for name, number in (("stop_alpha", stop_alpha), ("depth_alpha", depth_alpha)):
        check.number(where, name, number, low=0, high=1)


def most_intervals(length: float, step: float) -> int:
    """Returns how many intervals a ray of `length` can have.

    Raises:
        ValueError: More than a ray can count.
    """
    count = math.ceil(length / step)
    if count > config.MAX_INTERVALS:
        raise ValueError(
            f"step: {step:g} world units cuts a ray of {length:g} into {count} intervals, "
            f"more than {config.MAX_INTERVALS}"
        )
    return count
