"""The open road: what a shader that is no kernel is made of. `trace_segments` lists the runs of
samples that rays take in bricks, `sample_bricks` reads any channel there, and `composite` adds up
what the shader makes of it. All but the walk is differentiable.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..base import check
from ..base.volume import CHANNEL_DTYPES
from .reference import segments as reference_segments
from .trace import Backend, choose_backend

_SEGMENT_BYTES = 84  # at most, in float64


class Segments(NamedTuple):
    """Runs of samples, ray after ray and front to back along each.

    A segment is all the intervals of one length that a ray takes in one node, or one piece: the
    last interval of a ray, cut at the far side, or a region of one value. Where two levels blend,
    two nodes answer, the fine one first; else both are the same.
    """

    ray_index: Tensor  # (s,) int32
    node: Tensor  # (s, 2) int32
    brick: Tensor  # (s, 2) int32 slots, or EMPTY, CONSTANT
    depth: Tensor  # (s, 3) int32 of both nodes, and the one that the cone asked for
    interval: Tensor  # (s, 3) int32 number of the first, how many, level; -1: a piece
    t0: Tensor  # (s,) world distance from the camera at which the first interval starts
    t1: Tensor  # (s,) and at which the last one ends
    distance: Tensor  # (s, 3) from where the ray enters the box: base of the numbers, end, look-up
    counts: Tensor  # (r, 3) int32 segments, samples and nodes visited of each ray
    state: Tensor  # (r, 3) where each ray goes on: base, number and level of its next interval
    missed: Tensor  # (r,) bool, something that the ray saw was not there


def trace_segments(
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
    domain_2: Tensor,
    opaque_m: Tensor,
    frame_1: Tensor,
    state_r3: Tensor | None = None,
    *,
    width: int = 0,
    branching: int,
    root: int,
    max_depth: int,
    border: int,
    component: int,
    levels: int,
    limit: int = 0,
    cone_scale: float,
    root_voxel: float,
    step: float,
    by_level: bool = False,
    by_node: bool = False,
    backend: Backend = "auto",
) -> Segments:
    """Walks rays through a tree as `trace_rays` does, and lists what they would sample.

    The same nodes are visited, stamped, requested and skipped, and the same samples taken, but for
    the early end of a ray, which only a shader can tell: `limit` walks rays by parts instead, and
    what is behind the point where a ray ends need not be walked. Lists have exactly the size that
    is needed: rays are walked twice, and the host waits for the count in between.

    Args:
        origin_r3: To `stamp_b`: see `trace_rays`.
        direction_r3: See there.
        cone_r2: See there.
        range_r2: See there.
        place_33: See there.
        child_tn: See there.
        brick_tn: See there.
        request_tn: See there; written.
        stamp_t: See there; written.
        bricks_bzyxc: See there.
        constant_tnc: See there.
        range_tn2c: See there.
        stamp_b: See there; written.
        domain_2: (2,) float32 or float64, the dtype in which rays are walked; see `trace_rays`.
        opaque_m: (m,) int32 of a transfer function that hides nodes; [1, 2] hides none.
        frame_1: See there.
        state_r3: (r, 3) `Segments.state` of the part before; None: rays begin.
        width: See there.
        branching: See there.
        root: See there.
        max_depth: See there.
        border: See there.
        component: Which number of the channel hides nodes, and tells regions of one value.
        levels: How many lengths of intervals there are, each twice the one before.
        limit: A ray pauses behind the visit in which it has taken so many samples; 0: it goes to
            its end.
        cone_scale: See there.
        root_voxel: See there.
        step: See there.
        by_level: See there.
        by_node: A region counts as one of one value only where one node answers: for shaders that
            read more than `component`.
        backend: auto, reference, cpp or cuda.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, a number out of its range, or
            more segments than the device has memory for.
    """
    where, device, real = "trace_segments", origin_r3.device, domain_2.dtype
    if real not in (torch.float32, torch.float64):
        raise ValueError(
            f"{where}: domain_2 must be (2,) float32 or float64, got {check.describe(domain_2)}"
        )
    check.whole(where, "branching", branching, low=2, high=16)
    rays, (tiles, nodes) = origin_r3.shape[0], child_tn.shape
    bricks, side = bricks_bzyxc.shape[0], bricks_bzyxc.shape[1]
    channels, voxel = bricks_bzyxc.shape[-1], bricks_bzyxc.dtype
    if voxel not in CHANNEL_DTYPES:
        raise ValueError(f"{where}: bricks_bzyxc has dtype {voxel}, which no channel can have")
    _check(
        where,
        device,
        ("origin_r3", origin_r3, (rays, 3), torch.float64),
        ("direction_r3", direction_r3, (rays, 3), torch.float64),
        ("cone_r2", cone_r2, (rays, 2), torch.float64),
        ("range_r2", range_r2, (rays, 2), torch.float64),
        ("place_33", place_33, (3, 3), torch.float64),
        ("child_tn", child_tn, (tiles, nodes), torch.int32),
        ("brick_tn", brick_tn, (tiles, nodes), torch.int32),
        ("request_tn", request_tn, (tiles, nodes), torch.int32),
        ("stamp_t", stamp_t, (tiles,), torch.int32),
        ("bricks_bzyxc", bricks_bzyxc, (bricks, side, side, side, channels), voxel),
        ("constant_tnc", constant_tnc, (tiles, nodes, channels), voxel),
        ("range_tn2c", range_tn2c, (tiles, nodes, 2, channels), voxel),
        ("stamp_b", stamp_b, (bricks,), torch.int32),
        ("domain_2", domain_2, (2,), real),
        ("opaque_m", opaque_m, ("m",), torch.int32),
        ("frame_1", frame_1, (1,), torch.int32),
        *(() if state_r3 is None else (("state_r3", state_r3, (rays, 3), real),)),
    )
    if nodes < branching**3:
        raise ValueError(f"{where}: child_tn must hold {branching}^3 nodes a tile, got {nodes}")
    check.whole(where, "opaque_m's length", opaque_m.shape[0], low=2)
    check.whole(where, "width", width, low=0)
    if width and rays % width:
        raise ValueError(f"{where}: {rays} rays are no whole rows of {width} pixels")
    check.whole(where, "root", root, low=0, high=tiles * nodes - 1)
    check.whole(where, "component", component, low=0, high=channels - 1)
    check.whole(where, "levels", levels, low=1, high=2**31 - 1)
    check.whole(where, "limit", limit, low=0, high=2**31 - 1)
    _check_place(where, max_depth, border, side, cone_scale, root_voxel, step)
    args = (
        *(origin_r3, direction_r3, cone_r2, range_r2, place_33),
        *(child_tn, brick_tn, request_tn, stamp_t, bricks_bzyxc, constant_tnc, range_tn2c),
        *(stamp_b, domain_2, opaque_m, frame_1, state_r3),
        *(width, branching, root, max_depth, border, component, levels, limit),
        *(float(cone_scale), float(root_voxel), float(step), by_level, by_node),
    )
    with torch.no_grad():
        if choose_backend(backend, device) == "reference":
            counted, found = reference_segments.walk_segments(*args)
            return Segments._make((*found, *counted))
        count, state, missed = torch.ops.gvtorch.count_segments(*args)
        ends = count[:, 0].cumsum(0, dtype=torch.int64)
        total = int(ends[-1]) if rays else 0
        check.memory(where, f"a list of {total} segments", total * _SEGMENT_BYTES, device)
        found = torch.ops.gvtorch.write_segments(*args, ends - count[:, 0], total)
        return Segments._make((*found, count, state, missed))


class Samples(NamedTuple):
    """Samples of segments, ray after ray and front to back along each."""

    segment: Tensor  # (k,) int32
    number: Tensor  # (k,) int32 interval of the segment, from 0
    offset: Tensor  # (r + 1,) int64 where each ray's samples begin, and how many there are


def list_samples(segments: Segments) -> Samples:
    """Lists the samples of segments. The host waits for their number.

    Raises:
        ValueError: They are more than int32 can count, or the device has memory for.
    """
    count, device = segments.interval[:, 1].to(torch.int64), segments.interval.device
    offset = torch.zeros(len(segments.counts) + 1, dtype=torch.int64, device=device)
    torch.cumsum(segments.counts[:, 1], 0, dtype=torch.int64, out=offset[1:])
    total = int(offset[-1])
    check.memory("list_samples", f"a list of {total} samples", 8 * total, device)
    check.whole("list_samples", "the number of samples", total, low=0, high=2**31 - 1)
    first = count.cumsum(0) - count
    which = torch.arange(len(count), device=device)
    segment = torch.repeat_interleave(which, count, output_size=total)
    number = torch.arange(total, device=device) - first[segment]
    return Samples(segment.to(torch.int32), number.to(torch.int32), offset)


def sample_bricks(
    origin_r3: Tensor,
    direction_r3: Tensor,
    cone_r2: Tensor,
    range_r2: Tensor,
    place_33: Tensor,
    bricks_bzyxc: Tensor,
    constant_tnc: Tensor,
    ray_s: Tensor,
    node_s2: Tensor,
    brick_s2: Tensor,
    depth_s3: Tensor,
    interval_s3: Tensor,
    distance_s3: Tensor,
    segment_k: Tensor,
    number_k: Tensor,
    *,
    branching: int,
    max_depth: int,
    border: int,
    cone_scale: float,
    root_voxel: float,
    step: float,
    backend: Backend = "auto",
) -> Tensor:
    """Reads all numbers of a channel at samples, to the bit as `trace_rays` reads one of them:
    trilinear, two levels blended. Differentiable by bricks and constants that are floats.

    Args:
        origin_r3: To `range_r2`: the rays that were walked, see `trace_rays`.
        direction_r3: See there.
        cone_r2: See there.
        range_r2: See there.
        place_33: See there.
        bricks_bzyxc: (b, s, s, s, c) any channel of the pool.
        constant_tnc: (t, n, c) its constants.
        ray_s: `Segments.ray_index`.
        node_s2: `Segments.node`.
        brick_s2: `Segments.brick`.
        depth_s3: `Segments.depth`.
        interval_s3: `Segments.interval`.
        distance_s3: `Segments.distance`.
        segment_k: (k,) int32 `Samples.segment`. A sample of no segment, or of one that names what
            is not there, is 0.
        number_k: (k,) int32 `Samples.number`.
        branching: See `trace_rays`, as the rest.
        max_depth: See there.
        border: See there.
        cone_scale: See there.
        root_voxel: See there.
        step: See there.
        backend: auto, reference, cpp or cuda.

    Returns:
        (k, c) in the segments' dtype.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.
    """
    where, device, real = "sample_bricks", origin_r3.device, distance_s3.dtype
    rays, segments, samples = origin_r3.shape[0], ray_s.shape[0], segment_k.shape[0]
    bricks, side = bricks_bzyxc.shape[0], bricks_bzyxc.shape[1]
    channels, voxel = bricks_bzyxc.shape[-1], bricks_bzyxc.dtype
    chosen = choose_backend(backend, device)
    if voxel not in CHANNEL_DTYPES and chosen != "reference":
        raise ValueError(f"{where}: bricks_bzyxc has dtype {voxel}, which no channel can have")
    if real not in (torch.float32, torch.float64):
        raise ValueError(
            f"{where}: distance_s3 must be (s, 3) float32 or float64, "
            f"got {check.describe(distance_s3)}"
        )
    _check(
        where,
        device,
        ("origin_r3", origin_r3, (rays, 3), torch.float64),
        ("direction_r3", direction_r3, (rays, 3), torch.float64),
        ("cone_r2", cone_r2, (rays, 2), torch.float64),
        ("range_r2", range_r2, (rays, 2), torch.float64),
        ("place_33", place_33, (3, 3), torch.float64),
        ("bricks_bzyxc", bricks_bzyxc, (bricks, side, side, side, channels), voxel),
        ("constant_tnc", constant_tnc, ("t", "n", channels), voxel),
        ("ray_s", ray_s, (segments,), torch.int32),
        ("node_s2", node_s2, (segments, 2), torch.int32),
        ("brick_s2", brick_s2, (segments, 2), torch.int32),
        ("depth_s3", depth_s3, (segments, 3), torch.int32),
        ("interval_s3", interval_s3, (segments, 3), torch.int32),
        ("distance_s3", distance_s3, (segments, 3), real),
        ("segment_k", segment_k, (samples,), torch.int32),
        ("number_k", number_k, (samples,), torch.int32),
    )
    check.whole(where, "branching", branching, low=2, high=16)
    _check_place(where, max_depth, border, side, cone_scale, root_voxel, step)
    args = (
        *(origin_r3, direction_r3, cone_r2, range_r2, place_33, bricks_bzyxc, constant_tnc),
        *(ray_s, node_s2, brick_s2, depth_s3, interval_s3, distance_s3, segment_k, number_k),
        *(branching, max_depth, border, float(cone_scale), float(root_voxel), float(step)),
    )
    if chosen == "reference":
        return reference_segments.sample_bricks(*args)
    return torch.ops.gvtorch.sample_bricks(*args)


def composite(
    alpha_k: Tensor,
    feature_kc: Tensor,
    offset_r: Tensor,
    clear_r: Tensor | None = None,
    *,
    stop_alpha: float = 1.0,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor, Tensor]:
    """Adds samples up along rays, front to back: a sample's share is its alpha times what those
    before it let through. Differentiable by alpha, features and `clear_r`; an alpha of 1 too.

    Args:
        alpha_k: (k,) float32 or float64 in [0, 1].
        feature_kc: (k, c) same dtype: colour, or any numbers; not premultiplied.
        offset_r: (r + 1,) int64 `Samples.offset`, rising from 0 to k.
        clear_r: (r,) what is left of the light before a ray's first sample; None: all of it.
        stop_alpha: A ray ends at this alpha; 1: it goes to its end.
        backend: auto, reference, cpp or cuda.

    Returns:
        Sums (r, c), light that is left (r,), and what of it came to each sample (k,), 0 behind
        the end of a ray; the last one has no gradient.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.
    """
    where, device, real = "composite", alpha_k.device, alpha_k.dtype
    if real not in (torch.float32, torch.float64):
        raise ValueError(
            f"{where}: alpha_k must be (k,) float32 or float64, got {check.describe(alpha_k)}"
        )
    samples, rays = alpha_k.shape[0], offset_r.shape[0] - 1
    check.whole(where, "offset_r's length", offset_r.shape[0], low=1)
    clear = alpha_k.new_ones(rays) if clear_r is None else clear_r
    _check(
        where,
        device,
        ("alpha_k", alpha_k, (samples,), real),
        ("feature_kc", feature_kc, (samples, "c"), real),
        ("offset_r", offset_r, (rays + 1,), torch.int64),
        ("clear_r", clear, (rays,), real),
    )
    stop_clear = 1 - check.number(where, "stop_alpha", stop_alpha, low=0, high=1, open_low=True)
    args = (alpha_k, feature_kc, offset_r, clear, stop_clear)
    if choose_backend(backend, device) == "reference":
        total, left, before = reference_segments.composite(*args)
        return total, left, before.detach()
    return torch.ops.gvtorch.composite(*args)


def _check(where: str, device: torch.device, *fields: tuple) -> None:
    for name, tensor, shape, dtype in fields:
        check.tensor(where, name, tensor, shape, dtype, device)
        if not tensor.is_contiguous():
            raise ValueError(f"{where}: {name} must be contiguous")


def _check_place(
    where: str,
    max_depth: int,
    border: int,
    side: int,
    cone_scale: float,
    root_voxel: float,
    step: float,
) -> None:
    check.whole(where, "max_depth", max_depth, low=0, high=62)
    check.whole(where, "border", border, low=0, high=(side - 1) // 2)
    check.number(where, "root_voxel", root_voxel, low=0, open_low=True)
    check.number(where, "step", step, low=0, open_low=True)
    check.number(where, "cone_scale", cone_scale, low=0)
