"""The ops for shaders outside the kernel: `trace_segments` lists the runs of samples that rays take
in bricks, `sample_bricks` reads any channel there, and `composite` sums the shader's colours. The
last two are differentiable. They raise as those of `trace.py` do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .. import cpp_ext
from ..base import check
from .arguments import RayArguments, Samples, Segments, TraceArguments
from .reference import segments as twins
from .registry import Backend, argument_names, choose_backend, fake_of, runs_twin
from .trace import check_channel, check_rays, check_real, check_trace, check_voxels

_SEGMENT_BYTES = 84  # at most, in float64
_PORTION_ENTRIES = 256  # most entries of a portion; see `_spreading_order`
#: Arguments of `sample_bricks` that have gradients.
_DIFFERENTIABLE = ("bricks_bzyxc", "constant_tnc")


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

    It visits, stamps, requests and skips the same nodes and takes the same samples, but rays do not
    end early, which only a shader can decide: with `limit` rays are walked in parts, and the caller
    can drop those that have ended. Lists have exactly the needed size: rays are walked twice, and
    the host waits for the count in between. The lists carry no gradients: those of colours and
    voxels flow through `sample_bricks` and `composite`.

    Args:
        rays: The rays; their transmittance does not matter.
        arguments: Tree, pools and transfer function, of whose table only the number of lengths
            matters; mutated as by `trace_rays`.
        state_r3: `Segments.state` of the previous part; None: from the start.
        limit: A ray pauses after the visit in which it reaches this many samples; 0: never.
        by_node: A region counts as constant only where no two nodes blend, for shaders that read
            more than `component`.

    Raises:
        ValueError: An argument is invalid, or the segments do not fit into the device's memory.
    """
    context, device = "trace_segments", rays.origin_r3.device
    sizes = check_trace(context, rays, arguments)
    if state_r3 is not None:
        fields = [("state_r3", state_r3, "r3", arguments.table_lm4.dtype)]
        check.tensors(context, device, fields, sizes)
    check.integer(context, "limit", limit, low=0, high=2**31 - 1)
    op_arguments = (*rays, *arguments, state_r3, limit, by_node)
    with torch.no_grad():
        if choose_backend(backend, device) == "reference":
            return twins.walk_segments(rays, arguments, state_r3, limit, by_node)
        op = torch.ops.gvtorch
        count, state, missed = op.count_segments(*op_arguments)
        ends = count[:, 0].cumsum(0, dtype=torch.int64)
        total = int(ends[-1]) if sizes["r"] else 0
        check.memory(context, f"a list of {total} segments", total * _SEGMENT_BYTES, device)
        lists = op.write_segments(*op_arguments, ends - count[:, 0], total)
        return Segments._make((*lists, count, state, missed))


def list_samples(segments: Segments) -> Samples:
    """Lists the samples of segments. The host waits for their number.

    Raises:
        ValueError: There are more than int32 can count, or than the device has memory for.
    """
    count, device = segments.interval[:, 1].to(torch.int64), segments.interval.device
    offset = torch.zeros(len(segments.counts) + 1, dtype=torch.int64, device=device)
    torch.cumsum(segments.counts[:, 1], 0, dtype=torch.int64, out=offset[1:])
    total = int(offset[-1])
    check.memory("list_samples", f"a list of {total} samples", 8 * total, device)
    check.integer("list_samples", "the number of samples", total, low=0, high=2**31 - 1)
    first = count.cumsum(0) - count
    segment_index = torch.arange(len(count), device=device)
    segment = torch.repeat_interleave(segment_index, count, output_size=total)
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
    """Reads all numbers of a channel at samples: trilinear, two levels blended, in the same bits as
    `trace_rays` reads one of them. Differentiable by bricks and constants that are floats, with the
    same bits in every run; the reference also in forward mode and twice. It therefore runs under
    the transforms of `torch.func` if `backend` is auto.

    Args:
        rays: The rays that were walked.
        arguments: The arguments of the walk, with the bricks and constants of any channel.
        segments: Result of `trace_segments`.
        samples: Result of `list_samples`, or some of its samples. A sample whose segment does not
            exist, or whose segment names a ray, node or slot that does not, is 0.

    Returns:
        (k, c) in the segments' dtype.
    """
    context, device = "sample_bricks", rays.origin_r3.device
    voxels = (arguments.bricks_bzyxc, arguments.constant_tnc)
    is_twin = runs_twin(backend, *voxels, has_backward=True)
    if not is_twin:  # the reference also reads float64
        check_voxels(context, arguments)
        _refuse_tangents(context, _DIFFERENTIABLE, voxels)
    check_rays(context, rays)
    check_channel(context, arguments, device)
    check_real(context, "distance", segments.distance, "(s, 3)")
    tensors = (*segments[:6], samples.segment, samples.number)
    names = (*Segments._fields[:6], "segment", "number")
    shapes = ("s", "s2", "s2", "s3", "s3", "s3", "k", "k")
    dtypes = (*[torch.int32] * 5, segments.distance.dtype, torch.int32, torch.int32)
    check.tensors(context, device, zip(names, tensors, shapes, dtypes, strict=True))
    if is_twin:
        return twins.sample_bricks(rays, arguments, segments, samples)
    return torch.ops.gvtorch.sample_bricks(*rays, *arguments.channel, *tensors)


def composite(
    alpha_k: Tensor,
    feature_kc: Tensor,
    offset_r: Tensor,
    clear_r: Tensor | None = None,
    *,
    stop_alpha: float = 1.0,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor, Tensor]:
    """Composites samples along rays, front to back: a sample's weight is its alpha times the
    transmittance before it. Differentiable by alpha, features and `clear_r`, also at an alpha of 1;
    the reference also in forward mode and twice. It therefore runs under the transforms of
    `torch.func` if `backend` is auto.

    Args:
        alpha_k: (k,) float32 or float64 in [0, 1].
        feature_kc: (k, c) same dtype: colour, or any numbers; not premultiplied.
        offset_r: (r + 1,) int64 `Samples.offset`, rising from 0 to k.
        clear_r: (r,) transmittance before a ray's first sample; None: 1.
        stop_alpha: A ray ends at this alpha.

    Returns:
        Sums (r, c), transmittance that is left (r,), and the transmittance before each sample (k,),
        0 behind the end of a ray; the third has no gradient.
    """
    context = "composite"
    alpha_k = check.instance(context, "alpha_k", alpha_k, Tensor)
    device, dtype = alpha_k.device, alpha_k.dtype
    check_real(context, "alpha_k", alpha_k, "(k,)")
    length = len(offset_r) if check.instance(context, "offset_r", offset_r, Tensor).dim() else 0
    rays = check.integer(context, "offset_r's length", length, low=1) - 1
    clear = alpha_k.new_ones(rays) if clear_r is None else clear_r
    fields = (
        ("alpha_k", alpha_k, "k", dtype),
        ("feature_kc", feature_kc, "kc", dtype),
        ("offset_r", offset_r, "o", torch.int64),
        ("clear_r", clear, "r", dtype),
    )
    check.tensors(context, device, fields, {"r": rays, "o": rays + 1})
    stop_clear = 1 - check.number(context, "stop_alpha", stop_alpha, low=0, high=1, open_low=True)
    op_arguments = (alpha_k, feature_kc, offset_r, clear, stop_clear)
    if runs_twin(backend, alpha_k, feature_kc, clear, has_backward=True):
        total, remaining, before = twins.composite(*op_arguments)
        return total, remaining, before.detach()
    _refuse_tangents(context, ("alpha_k", "feature_kc", "clear_r"), (alpha_k, feature_kc, clear))
    return torch.ops.gvtorch.composite(*op_arguments)


def _refuse_tangents(context: str, names: Sequence[str], tensors: Sequence[Tensor]) -> None:
    """Raises RuntimeError for gradients of forward mode, which the compiled ops would lose."""
    for name, tensor in zip(names, tensors, strict=True):
        if check.has_tangent(tensor):
            hint = "backend must be auto or reference for those of forward mode"
            raise RuntimeError(f"{context}: gradients by {name} would be lost: {hint}")


@fake_of("count_segments")
def _fake_counts(*, origin_r3: Tensor, domain_2: Tensor, **_: Any) -> tuple[Tensor, ...]:
    rays = origin_r3.shape[0]
    return (
        domain_2.new_empty((rays, 3), dtype=torch.int32),
        domain_2.new_empty((rays, 3)),
        domain_2.new_empty((rays,), dtype=torch.bool),
    )


@fake_of("write_segments")
def _fake_lists(*, domain_2: Tensor, total: int, **_: Any) -> tuple[Tensor, ...]:
    widths = ((), (2,), (2,), (3,), (3,))
    words = (domain_2.new_empty((total, *width), dtype=torch.int32) for width in widths)
    return (*words, *(domain_2.new_empty((total, *width)) for width in ((3,), (), ())))


@fake_of("sample_bricks")
def _fake_values(
    *, bricks_bzyxc: Tensor, distance_s3: Tensor, segment_k: Tensor, **_: Any
) -> Tensor:
    return distance_s3.new_empty((segment_k.shape[0], bricks_bzyxc.shape[4]))


@fake_of("sample_bricks_backward", gradients=False)
def _fake_brick_gradients(
    *, grad_kc: Tensor, bricks_bzyxc: Tensor, constant_tnc: Tensor, **_: Any
) -> tuple[Tensor, Tensor]:
    return grad_kc.new_empty(bricks_bzyxc.shape), grad_kc.new_empty(constant_tnc.shape)


@fake_of("composite")
def _fake_sums(
    *, alpha_k: Tensor, feature_kc: Tensor, clear_r: Tensor, **_: Any
) -> tuple[Tensor, Tensor, Tensor]:
    total = alpha_k.new_empty((clear_r.shape[0], feature_kc.shape[1]))
    return total, torch.empty_like(clear_r), torch.empty_like(alpha_k)


@fake_of("composite_backward", gradients=False)
def _fake_sum_gradients(
    *, grad_left_r: Tensor, alpha_k: Tensor, feature_kc: Tensor, **_: Any
) -> tuple[Tensor, Tensor, Tensor]:
    return torch.empty_like(alpha_k), torch.empty_like(feature_kc), torch.empty_like(grad_left_r)


def _save_samples(ctx: Any, inputs: tuple, output: Tensor) -> None:
    for name, value in zip(argument_names(torch.ops.gvtorch.sample_bricks), inputs, strict=True):
        if name not in _DIFFERENTIABLE and isinstance(value, Tensor) and value.requires_grad:
            raise check.lost_gradient("sample_bricks", name)
    ctx.save_for_backward(*(value if isinstance(value, Tensor) else None for value in inputs))
    ctx.numbers = [None if isinstance(value, Tensor) else value for value in inputs]


@torch.library.custom_op("gvtorch::spreading_order", mutates_args=())
def _spreading_order(
    segment_k: Tensor, node_s2: Tensor, brick_s2: Tensor, bricks: int, nodes: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Returns in what order the gradient of `sample_bricks` is added up: (e,) sorted entries, their
    segments (e,) and lengths (e,), the portions' first entries (p + 1,) and rows (p,), and the
    bricks (x,) of rows; see `SpreadGradient` in csrc/shaders/segments.h.
    """
    if not len(node_s2):
        segment_k = segment_k[:0]
    run = _begins(segment_k).nonzero()[:, 0]
    length = run.diff(append=run.new_tensor([len(segment_k)])).to(torch.int32)
    segment = segment_k[run]
    exists = ((segment >= 0) & (segment < len(node_s2)))[:, None]
    index = segment.clamp(0, len(node_s2) - 1).to(torch.int64)
    node, brick = node_s2[index], brick_s2[index]
    exists = exists & (node >= 0) & (node < nodes) & (brick < bricks)
    exists[:, 1] &= node[:, 0] != node[:, 1]
    entry = exists.flatten().nonzero()[:, 0]
    word = torch.int32 if bricks + nodes < 2**31 else torch.int64  # less to sort
    # What an entry adds to: a brick or, behind all of these, a node's constants.
    target = torch.where(brick >= 0, brick.to(word), node.to(word) + bricks).flatten()[entry]
    target, order = target.sort(stable=True)
    entry = entry[order]
    targets = torch.arange(bricks + nodes + 1, dtype=word, device=target.device)
    first = torch.searchsorted(target, targets)  # the first entry of each target, and the end
    portions = (first.diff() + _PORTION_ENTRIES - 1) // _PORTION_ENTRIES
    owner = torch.repeat_interleave(portions)  # the target of each portion
    number = torch.arange(len(owner), device=owner.device) - (portions.cumsum(0) - portions)[owner]
    begin = torch.cat((first[owner] + number * _PORTION_ENTRIES, first[-1:]))
    is_added = number > 0
    row = torch.where(is_added, is_added.cumsum(0) - 1, -1)
    run_index, level = entry // 2, entry % 2
    entry = 2 * run[run_index] + level
    return entry, segment[run_index], length[run_index], begin, row, owner[is_added]


def _begins(values: Tensor) -> Tensor:
    """Returns (k,) bool, which of (k,) values differ from the one before."""
    begins = torch.ones_like(values, dtype=torch.bool)
    begins[1:] = values[1:] != values[:-1]
    return begins


@_spreading_order.register_fake
def _fake_order(segment_k: Tensor, *_: Any) -> tuple[Tensor, ...]:
    size = torch.library.get_ctx().new_dynamic_size
    entries, portions, rows = size(), size(), size()
    words = (segment_k.new_empty(entries, dtype=dtype) for dtype in (torch.int64, None, None))
    counts = (portions + 1, portions, rows)
    return (*words, *(segment_k.new_empty(count, dtype=torch.int64) for count in counts))


def _sample_gradient(ctx: Any, grad_kc: Tensor) -> tuple[Tensor | None, ...]:
    """Returns the gradients by bricks and constants, in their dtype, and None for the rest."""
    pairs = zip(ctx.saved_tensors, ctx.numbers, strict=True)
    inputs = [number if tensor is None else tensor for tensor, number in pairs]
    named = dict(zip(argument_names(torch.ops.gvtorch.sample_bricks), inputs, strict=True))
    bricks, constants = (named[name] for name in _DIFFERENTIABLE)
    lists = (named["segment_k"], named["node_s2"], named["brick_s2"])
    order = _spreading_order(*lists, len(bricks), constants[..., 0].numel())
    backward = torch.ops.gvtorch.sample_bricks_backward
    grads = backward(grad_kc.contiguous(), *order, *inputs)
    by_name = {
        name: grad.to(bricks.dtype) for name, grad in zip(_DIFFERENTIABLE, grads, strict=True)
    }
    return tuple(by_name.get(name) for name in named)


def _save_composite(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
    alpha_k, feature_kc, offset_r, _, ctx.stop_clear = inputs
    ctx.mark_non_differentiable(output[2])
    ctx.save_for_backward(alpha_k, feature_kc, offset_r, output[2])


def _composite_gradient(
    ctx: Any, grad_sum_rc: Tensor, grad_left_r: Tensor, _: Tensor
) -> tuple[Tensor | None, ...]:
    grads = (grad_sum_rc.contiguous(), grad_left_r.contiguous())
    backward = torch.ops.gvtorch.composite_backward
    alpha, feature, clear = backward(*grads, *ctx.saved_tensors, ctx.stop_clear)
    return alpha, feature, None, clear, None


if not cpp_ext.load()["cpp"]:
    register = torch.library.register_autograd
    register("gvtorch::sample_bricks", _sample_gradient, setup_context=_save_samples)
    register("gvtorch::composite", _composite_gradient, setup_context=_save_composite)
