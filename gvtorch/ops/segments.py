"""The open road: what a shader that is no kernel is made of. `trace_segments` lists the runs of
samples that rays take in bricks, `sample_bricks` reads any channel there, and `composite` adds up
what the shader makes of it. All but the walk is differentiable.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..base import check
from .arguments import RayArguments, Samples, Segments, TraceArguments
from .reference import segments as reference
from .registry import Backend, choose_backend
from .trace import check_channel, check_rays, check_real, check_trace, check_voxels

_SEGMENT_BYTES = 84  # at most, in float64


def trace_segments(
    rays: RayArguments,
    arguments: TraceArguments,
    state_r3: Tensor | None = None,
    *,
    limit: int = 0,
    by_node: bool = False,
    backend: Backend = "auto",
) -> Segments:
    """Walks rays through a tree as `trace_rays` does, and lists what they would sample.

    The same nodes are visited, stamped, requested and skipped, and the same samples taken, but for
    the early end of a ray, which only a shader can tell: `limit` walks rays by parts instead, and
    what is behind the point where a ray ends need not be walked. Lists have exactly the size that
    is needed: rays are walked twice, and the host waits for the count in between.

    Args:
        rays: The rays; no matter with which transmittance they begin.
        arguments: What they go through; of the table only the lengths of its intervals matter.
        state_r3: `Segments.state` of the part before; None: rays begin.
        limit: A ray pauses behind the visit in which it has taken so many samples; 0: never.
        by_node: A region counts as one of one value only where one node answers: for shaders that
            read more than `component`.

    Raises:
        ValueError: See `trace_rays`; or there are more segments than the device has memory for.
    """
    where, device = "trace_segments", rays.origin_r3.device
    sizes = check_trace(where, rays, arguments)
    if state_r3 is not None:
        wanted = [("state_r3", state_r3, "r3", arguments.table_lm4.dtype)]
        check.tensors(where, device, wanted, sizes)
    check.whole(where, "limit", limit, low=0, high=2**31 - 1)
    given = (*rays, *arguments, state_r3, limit, by_node)
    with torch.no_grad():
        if choose_backend(backend, device) == "reference":
            return reference.walk_segments(rays, arguments, state_r3, limit, by_node)
        op = torch.ops.gvtorch
        count, state, missed = op.count_segments(*given)
        ends = count[:, 0].cumsum(0, dtype=torch.int64)
        total = int(ends[-1]) if sizes["r"] else 0
        check.memory(where, f"a list of {total} segments", total * _SEGMENT_BYTES, device)
        found = op.write_segments(*given, ends - count[:, 0], total)
        return Segments._make((*found, count, state, missed))


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
    rays: RayArguments,
    arguments: TraceArguments,
    segments: Segments,
    samples: Samples,
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Reads all numbers of a channel at samples, to the bit as `trace_rays` reads one of them:
    trilinear, two levels blended. Differentiable by bricks and constants that are floats.

    Args:
        rays: The rays that were walked.
        arguments: What they went through, with the bricks and constants of any channel.
        segments: What `trace_segments` gave.
        samples: What `list_samples` gave, or any of them. A sample of no segment, or of one that
            names what is not there, is 0.

    Returns:
        (k, c) in the segments' dtype.
    """
    where, device = "sample_bricks", rays.origin_r3.device
    chosen = choose_backend(backend, device)
    if chosen != "reference":  # which also reads float64
        check_voxels(where, arguments)
    check_rays(where, rays)
    check_channel(where, arguments, device)
    check_real(where, "distance", segments.distance, "s3")
    places = (*segments[:6], samples.segment, samples.number)
    names = (*Segments._fields[:6], "segment", "number")
    shapes = ("s", "s2", "s2", "s3", "s3", "s3", "k", "k")
    dtypes = (*[torch.int32] * 5, segments.distance.dtype, torch.int32, torch.int32)
    check.tensors(where, device, zip(names, places, shapes, dtypes, strict=True))
    if chosen == "reference":
        return reference.sample_bricks(rays, arguments, segments, samples)
    return torch.ops.gvtorch.sample_bricks(*rays, *arguments.channel, *places)


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
        stop_alpha: A ray ends at this alpha.

    Returns:
        Sums (r, c), light that is left (r,), and what of it came to each sample (k,), 0 behind
        the end of a ray; the last one has no gradient.
    """
    where, device, real = "composite", alpha_k.device, alpha_k.dtype
    check_real(where, "alpha_k", alpha_k, "k")
    rays = check.whole(where, "offset_r's length", offset_r.shape[0], low=1) - 1
    clear = alpha_k.new_ones(rays) if clear_r is None else clear_r
    fields = (
        ("alpha_k", alpha_k, "k", real),
        ("feature_kc", feature_kc, "kc", real),
        ("offset_r", offset_r, "o", torch.int64),
        ("clear_r", clear, "r", real),
    )
    check.tensors(where, device, fields, {"r": rays, "o": rays + 1})
    stop_clear = 1 - check.number(where, "stop_alpha", stop_alpha, low=0, high=1, open_low=True)
    args = (alpha_k, feature_kc, offset_r, clear, stop_clear)
    if choose_backend(backend, device) == "reference":
        total, left, before = reference.composite(*args)
        return total, left, before.detach()
    return torch.ops.gvtorch.composite(*args)
