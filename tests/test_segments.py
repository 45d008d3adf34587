"""Segments, their samples, and compositing: compiled backends equal the twin, and the results equal
what `trace_rays` draws.
"""

from __future__ import annotations

import math

import pytest
import torch
from helpers import DEVICES
from helpers.rays import camera_rays, rays_of_cameras
from helpers.traces import SHADER, arguments, changed, packed
from helpers.trees import copy_to, with_holes
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import gvtorch as gv
from gvtorch.ops import (
    RayArguments,
    TraceArguments,
    composite,
    list_samples,
    sample_bricks,
    trace_rays,
    trace_segments,
)
from gvtorch.ops import segments as segments_ops
from gvtorch.shaders.shader import Sampling
from gvtorch.tracing.tracer import Tracer

MARKS = ("request_tn", "stamp_t", "stamp_b")


def tracing(
    tree, backend, rays, shader=SHADER, *, stop_alpha=0.99, hides=True, **options
) -> tuple[RayArguments, TraceArguments]:
    """Returns arguments of `trace_rays` for rays through a clean copy of a tree."""
    copy = copy_to(tree, DEVICES[backend])
    copy.frame += 1
    chosen = gv.RenderOptions(backend=backend, stop_alpha=stop_alpha, **options)
    traced = Tracer(copy, shader, chosen).arguments
    if not hides:
        rows = len(traced.opaque_m)
        none = torch.arange(1, rows + 1, dtype=torch.int32, device=copy.device)
        traced = traced._replace(opaque_m=none)
    return RayArguments.of(rays.to(copy.device)), traced


LISTED = ("ray_index", "node", "brick", "depth", "interval", "distance")
NEAR_AND_FAR = (0.2, 1.3, 6.0)


def tensors(segments) -> dict[str, torch.Tensor]:
    return {name: value.cpu() for name, value in segments._asdict().items()}


def assert_same_walk(tree, compiled, rays, *, hides=True, limit=0, by_node=False, **options):
    """Asserts that segments, marks and samples of the twin and of a kernel are equal."""
    walks = []
    for backend in ("reference", compiled):
        ray_args, traced = tracing(tree, backend, rays, hides=hides, **options)
        part = {"limit": limit, "by_node": by_node, "backend": backend}
        segments = trace_segments(ray_args, traced, **part)
        samples = list_samples(segments)
        values = sample_bricks(ray_args, traced, segments, samples, backend=backend)
        marks = {name: getattr(traced, name).cpu() for name in MARKS}
        walks.append({**tensors(segments), **marks, "values": values.cpu()})
    expected, actual = walks
    for name in expected:
        assert torch.equal(actual[name], expected[name]), name
    return expected


@pytest.mark.parametrize(
    ("brick_size", "branching", "lod", "hides"),
    [  # any two of the options meet in every way
        *((2, 2, "auto", True), (2, 3, "finest", False), (8, 2, "finest", False)),
        *((8, 3, "auto", False), (8, 3, "finest", True)),
    ],
)
def test_compiled_equals_reference(blobs, compiled, brick_size, branching, lod, hides):
    tree = gv.N3Tree.from_volume(blobs, brick_size, branching=branching)
    rays = rays_of_cameras(tree, 24, *NEAR_AND_FAR)
    for limit in (5, 0):
        result = assert_same_walk(tree, compiled, rays, lod=lod, hides=hides, limit=limit)
    samples = result["counts"][:, 1].view(3, -1).sum(1)
    assert samples[1:].min() > 100, "from afar as well"
    begin = len(result["values"]) - int(samples[2])
    assert min(values.max() for values in result["values"].split([begin, int(samples[2])])) > 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("voxel", ["uint8", "uint16", "int16", "float16", "bfloat16"])
def test_compiled_equals_reference_for_dtypes(blobs, compiled, voxel, dtype):
    data = (blobs.data * 100).to(getattr(torch, voxel))
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4, 2)
    rays = camera_rays(tree, distance=1.3)
    result = assert_same_walk(tree, compiled, rays, dtype=dtype, by_node=True, step=2.5)
    assert result["values"].dtype == dtype and result["values"].max() > 50


@settings(max_examples=12, deadline=None)
@given(
    share=st.floats(0, 1),
    seed=st.integers(0, 2**31),
    lod=st.sampled_from(["auto", "finest"]),
    limit=st.integers(0, 40),
    distance=st.floats(0.1, 8),
    azimuth=st.floats(-180, 180),
    elevation=st.floats(-90, 90),
)
@pytest.mark.backend("cpp")
def test_missing_nodes_give_equal_segments_and_requests(
    blobs, share, seed, lod, limit, distance, azimuth, elevation
):
    tree = with_holes(gv.N3Tree.from_volume(blobs, 4), share, seed)
    rays = camera_rays(tree, 12, distance=distance, azimuth=azimuth, elevation=elevation)
    assert_same_walk(tree, "cpp", rays, lod=lod, limit=limit)


@pytest.mark.parametrize("lod", ["finest", "auto"])
def test_segments_are_what_trace_rays_samples(blobs, backend, lod):
    """Same number of samples, same marks, same requests, in a tree with missing parts."""
    tree = with_holes(gv.N3Tree.from_volume(blobs, 4), 0.3, 7)
    rays = rays_of_cameras(tree, 24, *NEAR_AND_FAR)
    ray_args, drawn = tracing(tree, backend, rays, stop_alpha=1.0, lod=lod)
    haze = gv.TransferFunction.from_points([(0, 0), (0.2, 0), (1, 0.1)])  # nothing is opaque
    sampling = Sampling(
        smallest_spacing=min(tree.spacing),
        step=drawn.step,
        levels=len(drawn.table_lm4),
        dtype=torch.float32,
        device=drawn.child_tn.device,
    )
    drawn = drawn._replace(**vars(haze.table(sampling)))
    walked = drawn._replace(**{name: getattr(drawn, name).clone() for name in MARKS})
    *_, samples, missed = trace_rays(ray_args, drawn, backend=backend)
    segments = trace_segments(ray_args, walked, backend=backend)
    assert torch.equal(segments.counts[:, 1], samples)
    assert samples.view(3, -1).amax(1).min() > 10, "from each distance"
    assert torch.equal(segments.missed, missed) and missed.view(3, -1).any(1).all()
    for name in MARKS:
        assert torch.equal(getattr(walked, name), getattr(drawn, name)), name


def table_colors(values_k, level_k, table) -> torch.Tensor:
    """Returns rows (k, 4) of a transfer function's table, by its formula."""
    low, high = table.domain_2
    last = table.table_lm4.shape[1] - 1
    position = ((values_k - low) / (high - low) * last).clamp(0, last)
    row = position.long().clamp(max=last - 1)
    rows = table.table_lm4[level_k.long()]
    a = rows.gather(1, row[:, None, None].expand(-1, 1, 4))[:, 0]
    b = rows.gather(1, row[:, None, None].expand(-1, 1, 4) + 1)[:, 0]
    return a + (position - row)[:, None] * (b - a)


@pytest.mark.parametrize("lod", ["finest", "auto"])
def test_sampled_and_composited_segments_are_the_picture(blobs, backend, lod):
    """The pipeline of separate ops against the fused one, at once and in parts."""
    tree = gv.N3Tree.from_volume(blobs, 8)
    rays = camera_rays(tree, distance=1.3)
    ray_args, traced = tracing(tree, backend, rays, lod=lod, step=1.5)
    drawn = trace_rays(ray_args, traced, backend=backend)
    for limit in (0, 10):
        assert_segments_are_the_picture(ray_args, traced, drawn, limit, backend)


def assert_segments_are_the_picture(ray_args, traced, drawn, limit: int, backend: str) -> None:
    color, alpha, _, samples, _ = drawn
    count = len(samples)
    total, clear = torch.zeros_like(color), torch.ones_like(alpha[:, 0])
    taken, state, rounds = torch.zeros_like(samples), None, 0
    while True:
        segments = trace_segments(ray_args, traced, state, limit=limit, backend=backend)
        state, listed = segments.state, list_samples(segments)
        if not len(listed.segment):
            break
        rounds += 1
        values = sample_bricks(ray_args, traced, segments, listed, backend=backend)[:, 0]
        segment = listed.segment.long()
        level = segments.interval[segment, 2]
        piece = level < 0
        rgba = table_colors(values, level.clamp(min=0), traced)
        length = (segments.t1 - segments.t0)[segment] / traced.step
        alpha_k = torch.where(piece, 1 - (1 - rgba[:, 3]) ** length, rgba[:, 3])
        part, clear, before = composite(
            *(alpha_k, rgba[:, :3].contiguous(), listed.offset, clear),
            stop_alpha=0.99, backend=backend,
        )  # fmt: skip
        total = total + part
        ray = segments.ray_index.long()[segment]
        taken.index_add_(0, ray, (before > 0).to(torch.int32))
        if limit == 0:
            break
    assert rounds == 1 if limit == 0 else rounds > 3
    assert (total - color).abs().max() < 1e-5 and color.max() > 0.5
    assert (1 - clear - alpha[:, 0]).abs().max() < 1e-5
    assert (taken != samples).sum() <= count // 100, "rounding may move an end"


def test_parts_of_a_walk_are_the_walk(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera_rays(tree, distance=1.3)
    ray_args, traced = tracing(tree, backend, rays)
    whole = trace_segments(ray_args, traced, backend=backend)
    parts, state = [], None
    while not parts or len(parts[-1].ray_index):
        parts.append(trace_segments(ray_args, traced, state, limit=1, backend=backend))
        state = parts[-1].state
    assert len(parts) > 5
    joined = [torch.cat([getattr(part, name) for part in parts]) for name in LISTED]
    order = joined[0].argsort(stable=True)
    for name, values in zip(LISTED, joined, strict=True):
        assert torch.equal(values[order], getattr(whole, name)), name
    assert torch.equal(sum(part.counts for part in parts), whole.counts)


def test_distances_cover_the_box(blobs, backend):
    """One node, nothing hidden: a ray's segments reach from its entry to its exit."""
    noise = gv.Volume(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(1)))
    tree = gv.N3Tree.from_volume(noise, 8)
    rays = camera_rays(tree, 8, distance=3, azimuth=0, elevation=0)
    ray_args, traced = tracing(tree, backend, rays, lod="finest", hides=False)
    segments = trace_segments(ray_args, traced, backend=backend)
    assert (segments.t1 > segments.t0).all() and (segments.depth == 0).all()
    ray = segments.ray_index.long()
    covered = torch.zeros(64).to(segments.t0).index_add_(0, ray, segments.t1 - segments.t0)
    near = (3 * 8 - 4) / -ray_args.direction_r3[:, 2]
    inner = ray_args.direction_r3[:, :2].abs() * (3 * 8 + 4) / -ray_args.direction_r3[:, 2:] < 4
    inner = inner.all(1)
    assert inner.sum() >= 4
    expected = 8 / -ray_args.direction_r3[:, 2]
    assert (covered - expected)[inner].abs().max() < 1e-4
    first = (
        torch.full((64,), math.inf).to(near).scatter_reduce_(0, ray, segments.t0.double(), "amin")
    )
    assert (first - near)[inner].abs().max() < 1e-4


# --- gradients
# ------------------------------------------------------------------------------------------


def test_gradient_by_bricks_and_constants(blobs, compiled):
    """Sampling is linear in voxels: the gradient equals the twin's, which is autograd's."""
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera_rays(tree, 16, distance=1.5)
    grads = []
    for backend in ("reference", compiled):
        options = {"dtype": torch.float64, "hides": False, "step": 2.5}
        ray_args, traced = tracing(tree, backend, rays, **options)
        segments = trace_segments(ray_args, traced, backend=backend)
        pool = (traced.bricks_bzyxc, traced.constant_tnc)
        leaves = [tensor.clone().requires_grad_() for tensor in pool]
        traced = traced._replace(bricks_bzyxc=leaves[0], constant_tnc=leaves[1])
        values = sample_bricks(ray_args, traced, segments, list_samples(segments), backend=backend)
        weight = torch.linspace(-1, 1, len(values), dtype=torch.float64).to(values)[:, None]
        (values * weight).sum().backward()
        grads.append([leaf.grad.cpu() for leaf in leaves])
        assert values.grad_fn is not None and all(leaf.grad.abs().max() > 0 for leaf in leaves)
    for expected, actual in zip(*grads, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)


def gradients(walked, weight) -> list[Tensor]:
    """Returns the gradients of the weighted sum of samples by bricks and constants."""
    ray_args, traced, segments, samples = walked
    leaves = [tensor.clone().requires_grad_() for tensor in traced.channel[-2:]]
    traced = traced._replace(bricks_bzyxc=leaves[0], constant_tnc=leaves[1])
    values = sample_bricks(ray_args, traced, segments, samples)
    return list(torch.autograd.grad(values, leaves, weight.to(values)))


@pytest.mark.parametrize("real", [torch.float32, torch.float64])
@pytest.mark.parametrize(("branching", "width"), [(2, 1), (3, 1), (2, 2), (2, 5)])
def test_gradients_have_the_same_bits_in_every_run(
    blobs, compiled, branching, width, real, monkeypatch
):
    """Whatever the number of threads, and on a GPU as on a CPU; with bricks in many portions."""
    monkeypatch.setattr("gvtorch.ops.segments._PORTION_ENTRIES", 5)
    numbers = torch.cat([blobs.data / (1 + c) for c in range(width)], -1)
    volume = gv.Volume(numbers, spacing=blobs.spacing, origin=blobs.origin)
    tree = gv.N3Tree.from_volume(volume, 4, branching=branching)
    rays, threads = camera_rays(tree, 24, distance=1.5), torch.get_num_threads()
    results = []
    for backend, number in (("cpp", 1), ("cpp", 3), (compiled, 2), (compiled, 2)):
        torch.set_num_threads(number)
        try:
            ray_args, traced = tracing(tree, backend, rays, dtype=real, hides=False)
            segments = trace_segments(ray_args, traced)
            samples = list_samples(segments)
            weight = torch.linspace(-1, 1.1, len(samples.segment) * width, dtype=real)
            weight = weight.view(-1, width)
            walked = (ray_args, traced, segments, samples)
            results.append([grad.cpu() for grad in gradients(walked, weight)])
        finally:
            torch.set_num_threads(threads)
    assert all((grad != 0).sum() > 100 for grad in results[0])
    for result in results[1:]:
        assert all(map(torch.equal, result, results[0]))
    monkeypatch.undo()  # in whole portions: other roundings
    for grad, expected in zip(gradients(walked, weight), results[0], strict=True):
        torch.testing.assert_close(grad.cpu(), expected, rtol=1e-4, atol=1e-4)


def test_gradients_of_samples_in_any_order(walk):
    """Some samples, shuffled: each run of a segment's samples is an entry of its own."""
    ray_args, traced, segments, samples = walk
    chosen = torch.randperm(len(samples.segment), generator=torch.Generator().manual_seed(1))
    chosen = chosen[: len(chosen) // 2].to(samples.segment.device)
    weight = torch.zeros(len(samples.segment), 1)
    weight[chosen.cpu()] = torch.rand(len(chosen), 1)
    some = samples._replace(segment=samples.segment[chosen], number=samples.number[chosen])
    expected = gradients(walk, weight)
    actual = gradients((ray_args, traced, segments, some), weight[chosen.cpu()])
    for grad, whole in zip(actual, expected, strict=True):
        assert (whole != 0).any()
        torch.testing.assert_close(grad, whole, rtol=1e-4, atol=1e-5)
    none = samples._replace(segment=samples.segment[:0], number=samples.number[:0])
    assert not any(grad.any() for grad in gradients((ray_args, traced, segments, none), weight[:0]))
    absent = samples._replace(segment=torch.full_like(samples.segment, -1))
    assert not any(grad.any() for grad in gradients((ray_args, traced, segments, absent), weight))


def test_an_order_that_names_nothing_is_harmless(walk):
    """Memory accesses stay in bounds, whatever the words are."""
    op, reads = torch.ops.gvtorch.sample_bricks_backward, sampling(*walk)
    samples, device = len(walk[3].segment), reads[0].device
    sizes = len(walk[1].bricks_bzyxc), walk[1].child_tn.numel()
    order = segments_ops._spreading_order(reads[-2], *walk[2][1:3], *sizes)
    grad = torch.ones(samples, 1, device=device)
    assert op(grad, *order, *reads)[0].abs().sum() > 1
    for number, words in enumerate(order):
        ends = torch.iinfo(words.dtype)
        for value in (-1, ends.min, 10**6, ends.max):
            changed_order = [*order]
            changed_order[number] = torch.full_like(words, value)
            assert op(grad, *changed_order, *reads)[0].isfinite().all()
    begin = order[3].clone()
    begin[0] = -(2**63)  # what lies before the first entry is left out
    assert torch.equal(
        op(grad, *order[:3], begin, *order[4:], *reads)[0], op(grad, *order, *reads)[0]
    )
    rows = torch.arange(len(order[4]), device=device)
    for added in (rows, rows.flip(0), rows[:0]):
        assert op(grad, *order[:4], rows, added, *reads)[0].isfinite().all()
    with pytest.raises(RuntimeError, match="needs an end"):
        op(grad, *order[:3], order[3][:0], *order[4:], *reads)


@pytest.mark.filterwarnings("ignore:Input #0 requires gradient")
def test_gradient_by_bricks_against_differences(blobs, backend):
    """gradcheck on a pool of float32: sampling is linear, so a wide step is exact."""
    tree = gv.N3Tree.from_volume(gv.Volume(blobs.data[12:20, 8:16, 10:18].contiguous()), 2)
    rays = camera_rays(tree, 3, distance=1.5)
    ray_args, traced = tracing(tree, backend, rays, dtype=torch.float64, hides=False)
    segments = trace_segments(ray_args, traced, backend=backend)
    samples, pool = list_samples(segments), traced.bricks_bzyxc
    used = segments.brick[:, 0].long()
    rows = used[used >= 0].unique()[:3]

    def read(part: torch.Tensor) -> torch.Tensor:
        changed_args = traced._replace(bricks_bzyxc=pool.index_copy(0, rows, part))
        return sample_bricks(ray_args, changed_args, segments, samples, backend=backend).float()

    part = pool[rows].clone().requires_grad_()
    assert torch.autograd.gradcheck(read, (part,), eps=0.5, atol=1e-4, rtol=1e-4)


# --- the op contract
# ------------------------------------------------------------------------------------


@pytest.fixture
def walk(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4)
    ray_args, traced = tracing(tree, compiled, camera_rays(tree, 6, distance=1.3))
    segments = trace_segments(ray_args, traced)
    return ray_args, traced, segments, list_samples(segments)


def sampling(ray_args, traced, segments, samples) -> list:
    """Arguments of `torch.ops.gvtorch.sample_bricks` in order."""
    return [*ray_args, *traced.channel, *segments[:6], samples.segment, samples.number]


def test_opcheck(walk):
    ray_args, traced, segments, samples = walk
    ops = torch.ops.gvtorch
    args = (*ray_args, *traced, None, 0, False)
    torch.library.opcheck(ops.count_segments.default, args)
    first = (segments.counts[:, 0].cumsum(0) - segments.counts[:, 0]).long()
    torch.library.opcheck(ops.write_segments.default, (*args, first, len(segments.ray_index)))
    leaf_fields = {name: getattr(traced, name).clone() for name in ("bricks_bzyxc", "constant_tnc")}
    leaves = traced._replace(**{name: leaf.requires_grad_() for name, leaf in leaf_fields.items()})
    reads = sampling(ray_args, leaves, segments, samples)
    torch.library.opcheck(ops.sample_bricks.default, tuple(reads))
    grad = torch.ones(len(samples.segment), 1, device=reads[0].device)
    checks = ("test_schema", "test_faketensor")
    reads = sampling(ray_args, traced, segments, samples)
    sizes = len(traced.bricks_bzyxc), traced.child_tn.numel()
    lists = (reads[-2], *segments[1:3], *sizes)
    backward_args = (grad, *segments_ops._spreading_order(*lists), *reads)
    torch.library.opcheck(ops.sample_bricks_backward.default, backward_args, test_utils=checks)
    torch.library.opcheck(segments_ops._spreading_order, lists, test_utils=checks)
    alpha, feature, offset, clear = packed(device=reads[0].device)
    leaves = (alpha.requires_grad_(), feature.requires_grad_(), offset, clear.requires_grad_())
    torch.library.opcheck(ops.composite.default, (*leaves, 0.1))


class Emission(torch.nn.Module):
    """Samples and composites segments; it is scripted, compiled and exported."""

    def forward(
        self,
        rays: RayArguments,
        channel: tuple[Tensor, int, int, int, float, float, float, Tensor, Tensor],
        listed: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor],
        offset: Tensor,
        clear: Tensor,
    ) -> Tensor:
        values = torch.ops.gvtorch.sample_bricks(*rays, *channel, *listed)
        alpha = values[:, 0] * 0.5
        return torch.ops.gvtorch.composite(alpha, values, offset, clear, 0.01)[0]


@pytest.mark.filterwarnings("ignore")
def test_scripts_compiles_and_exports(walk):
    ray_args, traced, segments, samples = walk
    listed = (*segments[:6], samples.segment, samples.number)
    clear = torch.ones(len(segments.counts), device=traced.child_tn.device)
    module = Emission()
    inputs = (ray_args, traced.channel, listed, samples.offset, clear)
    expected = module(*inputs)
    assert expected.max() > 0.3
    assert torch.equal(torch.jit.script(module)(*inputs), expected)
    fast = torch.compile(module, fullgraph=True, backend="aot_eager")
    assert torch.equal(fast(*inputs), expected)
    assert torch.equal(torch.export.export(module, inputs).module()(*inputs), expected)


@pytest.mark.filterwarnings("ignore")
def test_the_walk_compiles_and_exports(walk):
    ray_args, traced, expected, _ = walk

    class Walk(torch.nn.Module):
        def forward(self, origin: torch.Tensor) -> tuple[torch.Tensor, ...]:
            args = (origin, *ray_args[1:], *traced, None, 0, False)
            count, _, _ = torch.ops.gvtorch.count_segments(*args)
            ends = count[:, 0].cumsum(0, dtype=torch.int64)
            total = ends[-1].item()
            torch._check_is_size(total)
            return torch.ops.gvtorch.write_segments(*args, ends - count[:, 0], total)

    program = torch.export.export(Walk(), (ray_args.origin_r3,))
    for name, actual in zip(expected._fields, program.module()(ray_args.origin_r3), strict=False):
        assert torch.equal(actual, getattr(expected, name)), name


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origin_r3": torch.zeros(4, 2).double()}, "origin_r3 must be (r, 3) float64 on cpu"),
        ({"domain_2": torch.zeros(2).int()}, "domain_2 must be (2,) float32"),
        ({"state_r3": torch.zeros(4, 2)}, "state_r3 must be (4, 3) float32"),
        ({"limit": -1}, "limit must be an int >= 0"),
        ({"width": 3}, "4 rays are not whole rows of 3 pixels"),
        ({"step": math.nan}, "step must be finite"),
        ({"component": 1}, "component must be an int >= 0 and <= 0"),
        ({"backend": "opengl"}, "backend must be auto, reference, cpp or cuda"),
    ],
)
def test_bad_arguments_of_trace_segments(blobs, change, message):
    tree = gv.N3Tree.from_volume(blobs, 8)
    with pytest.raises(ValueError) as caught:
        limits = {name: change[name] for name in ("state_r3", "limit", "backend") if name in change}
        trace_segments(*changed(arguments(tree, 4), change), **limits)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.backend("cpp")
def test_bad_arguments_of_sampling_and_compositing(blobs):
    tree = gv.N3Tree.from_volume(blobs, 8)
    ray_args, traced = arguments(tree, 4)
    segments = trace_segments(ray_args, traced)
    good = (ray_args, traced, segments, list_samples(segments))
    for change, message in (
        ({"segment": torch.zeros(3)}, "segment must be (k,) int32"),
        ({"distance": segments.distance.half()}, "distance must be (s, 3) float32 or"),
        ({"constant_tnc": torch.zeros(1, 8, 2)}, "constant_tnc must be (t, n, 1)"),
        ({"bricks_bzyxc": traced.bricks_bzyxc.double()}, "which no channel can have"),
        ({"max_depth": 99}, "max_depth must be an int >= 0"),
    ):
        with pytest.raises(ValueError) as caught:
            sample_bricks(*changed(good, change))
        assert message in str(caught.value) and "\n" not in str(caught.value)
    alpha, feature, offset, clear = packed()
    for args, message in (
        ((alpha.long(), feature, offset), "alpha_k must be (k,) float32 or float64"),
        ((alpha, feature.float(), offset), "feature_kc must be"),
        ((alpha, feature, offset.int()), "offset_r must be (8,) int64"),
        ((alpha, feature, offset, clear[:3]), "clear_r must be (7,) float64"),
    ):
        with pytest.raises(ValueError) as caught:
            composite(*args)
        assert message in str(caught.value) and "\n" not in str(caught.value)


def test_samples_that_name_nothing_are_zero(walk):
    """Memory accesses stay in bounds, whatever the words are."""
    *_, segments, samples = walk
    some = samples.segment.clone()
    some[0], some[1] = -1, 10**6
    for change in (
        {"segment": some},
        {"ray_index": torch.full_like(segments.ray_index, 10**6)},
        {"node": torch.full_like(segments.node, 10**8)},
        {"brick": torch.full_like(segments.brick, 10**6)},
        {"depth": torch.full_like(segments.depth, 60)},
    ):
        sampling_args = changed(walk, change)
        values = sample_bricks(*sampling_args)
        assert (values[:2] == 0).all()
        if "segment" in change or "ray_index" in change:
            assert torch.equal(values, sample_bricks(*sampling_args, backend="reference"))


@pytest.mark.backend("cpp")
def test_a_list_larger_than_memory_is_one_clear_error(blobs, monkeypatch):
    from gvtorch.base import check

    tree = gv.N3Tree.from_volume(blobs, 4)
    monkeypatch.setattr(check.os, "sysconf", lambda name: 64)
    with pytest.raises(ValueError, match=r"trace_segments: a list of \d+ segments takes .* GiB"):
        trace_segments(*arguments(tree, 100))
