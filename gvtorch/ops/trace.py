"""The ops on rays: they check their arguments and call a backend. `trace_rays` and `shade_rays`
shade inside the kernel. Shaders outside it use three ops: `trace_segments` lists the runs of
samples that rays take in bricks, `sample_bricks` reads any channel there, and `composite` sums the
shader's colours. The last two are differentiable.

The ops and their shared checks raise ValueError for a tensor of the wrong shape, dtype or device
and for a number out of its range; the message names op, argument and value. Checks return the size
of each letter in the shapes.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base import constants as config
from ..base.volume import CHANNEL_DTYPES
from .arguments import RayArguments, Samples, Segments, ShadeArguments, TraceArguments
from .reference import march, shaders
from .reference import segments as twins
from .registry import Backend, choose_backend
from .shading import COLOR_WIDTH, SHADER_KINDS, ShaderFacts, channel_widths

_SEGMENT_BYTES = 84  # at most, in float64


def _fields(record: Any, dtype: torch.dtype, names: str) -> list[check.Field]:
    return [(name, getattr(record, name), check.shape_of(name), dtype) for name in names.split()]


def check_rays(context: str, rays: RayArguments) -> dict[str, int]:
    """Checks rays."""
    names = "origin_r3 direction_r3 cone_r2 range_r2"
    names += "" if rays.clear_r is None else " clear_r"
    fields = _fields(rays, torch.float64, names)
    sizes = check.tensors(context, rays.origin_r3.device, fields)
    check.integer(context, "width", rays.width, low=0)
    if rays.width and sizes["r"] % rays.width:
        raise ValueError(f"{context}: {sizes['r']} rays are not whole rows of {rays.width} pixels")
    return sizes


def check_channel(context: str, arguments: TraceArguments, device: torch.device) -> dict[str, int]:
    """Checks the fields of `TraceArguments.channel`: placement, bricks and constants."""
    n = check.integer(context, "branching", arguments.branching, low=2, high=config.MAX_BRANCHING)
    fields = _fields(arguments, arguments.bricks_bzyxc.dtype, "bricks_bzyxc constant_tnc")
    placement = _fields(arguments, torch.float64, "place_33")
    sizes = check.tensors(context, device, placement + fields)
    depth = check.integer(context, "max_depth", arguments.max_depth, low=0, high=62)
    if n**depth > config.MOST_NODES:
        raise ValueError(
            f"{context}: branching {n} and max_depth {depth} make more than 2^50 nodes a side"
        )
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
    kinds = [ShaderFacts()] if user_op else [*SHADER_KINDS.values()]
    facts = kinds[check.integer(context, "shader", shading.shader, low=0, high=len(kinds) - 1)]
    sizes = check_trace(context, rays, arguments, "lmm4" if facts.integrates else "lm4")
    device, shape = rays.origin_r3.device, "k" if user_op else "54"
    parameters = ("parameter_54", parameter_54, shape, arguments.table_lm4.dtype)
    check.tensors(context, device, [parameters])
    # Filtered colours are those of coarse slots only, so there are fewer.
    other_width, other_slots = 0, "e" if facts.filtered else "b"
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
    if facts.colored and not (sizes["c"] in (one, by_direction) and arguments.component == 3):
        wanted = f"a channel of {one} or {by_direction} numbers and component 3"
        raise ValueError(f"{context}: stored colour needs {wanted}")
    if facts.features is None and not other_width:
        raise ValueError(f"{context}: features need other_bzyxc")
    one, by_direction = channel_widths(facts.filtered)
    if facts.filtered and other_width not in (one, by_direction):
        wanted = f"an other_bzyxc of {one} or {by_direction} numbers"
        raise ValueError(f"{context}: filtered colours need {wanted}")
    features = other_width if facts.features is None else facts.features
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
    `trace_rays` reads one of them. Differentiable by bricks and constants that are floats.

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
    chosen_backend = choose_backend(backend, device)
    if chosen_backend != "reference":  # the reference also reads float64
        check_voxels(context, arguments)
    check_rays(context, rays)
    check_channel(context, arguments, device)
    check_real(context, "distance", segments.distance, "(s, 3)")
    tensors = (*segments[:6], samples.segment, samples.number)
    names = (*Segments._fields[:6], "segment", "number")
    shapes = ("s", "s2", "s2", "s3", "s3", "s3", "k", "k")
    dtypes = (*[torch.int32] * 5, segments.distance.dtype, torch.int32, torch.int32)
    check.tensors(context, device, zip(names, tensors, shapes, dtypes, strict=True))
    if chosen_backend == "reference":
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
    transmittance before it. Differentiable by alpha, features and `clear_r`, also at an alpha of 1.

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
    if choose_backend(backend, device) == "reference":
        total, remaining, before = twins.composite(*op_arguments)
        return total, remaining, before.detach()
    return torch.ops.gvtorch.composite(*op_arguments)


def shade_op(name: str | None) -> Any:
    """Returns the op of a user's shader, or for None that of the fused shaders."""
    if name is None:
        return torch.ops.gvtorch.shade_rays
    return getattr(torch.ops.gvtorch_user, name)
