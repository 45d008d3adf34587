"""`trace_rays`: the compiled backends equal the torch twin; integers exactly."""

from __future__ import annotations

import dataclasses
import math
import typing

import pytest
import torch
from helpers import DEVICES
from helpers.rays import camera_rays
from helpers.traces import SHADER, arguments, assert_equal, changed, trace
from helpers.trees import copy_to, with_holes
from hypothesis import given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base import constants as config
from gvtorch.ops.reference import exact
from gvtorch.tracing.tracer import Tracer


@pytest.mark.parametrize(
    ("brick_size", "branching", "lod"),  # each pair of values
    [
        *((2, 2, "auto"), (2, 3, "finest"), (2, 4, "auto")),
        *((4, 2, "finest"), (4, 3, "auto"), (4, 4, "finest")),
        *((8, 2, "auto"), (8, 3, "finest"), (8, 4, "auto")),
    ],
)
def test_compiled_equals_reference(blobs, compiled, brick_size, branching, lod):
    tree = gv.N3Tree.from_volume(blobs, brick_size, branching=branching)
    for distance in (0.2, 1.3, 6.0):
        rays = camera_rays(tree, 24 if distance > 2 else 14, distance=distance)
        result, marks, _ = assert_equal(tree, compiled, rays, lod=lod)
        if distance > 1:
            assert result["alpha"].max() > 0.3, "the test must see something"
            assert (marks["brick"] == 1).any()
    assert not marks["request"].any(), "a resident tree misses nothing"


@pytest.mark.parametrize(
    ("step", "border", "dtype"),  # each pair of values
    [
        *((0.3, 0, torch.float32), (0.3, 1, torch.float64), (0.3, 2, torch.float32)),
        *((1.0, 0, torch.float64), (1.0, 1, torch.float32), (1.0, 2, torch.float64)),
        *((3.0, 0, torch.float32), (3.0, 1, torch.float64), (3.0, 2, torch.float32)),
    ],
)
def test_compiled_equals_reference_for_steps_borders_and_dtypes(
    blobs, compiled, border, step, dtype
):
    tree = gv.N3Tree.from_volume(blobs, 4, border)
    assert_equal(tree, compiled, camera_rays(tree, 14), step=step, dtype=dtype)


@pytest.mark.parametrize(
    "dtype", ["uint8", "int8", "int16", "uint16", "float16", "bfloat16", "float32"]
)
def test_every_channel_dtype(blobs, compiled, dtype):
    data = (blobs.data * 100).to(getattr(torch, dtype))
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4)
    shader = gv.TransferFunction.from_points([(10, 0), (90, 0.8)], [(0, 0, 0, 1), (100, 1, 1, 0)])
    result, *_ = assert_equal(tree, compiled, camera_rays(tree), shader)
    assert result["alpha"].max() > 0.5


def test_second_channel_and_second_component(blobs, compiled):
    ramp = torch.stack((blobs.data[..., 0] * 0, blobs.data[..., 0]), -1)
    other = gv.Volume(ramp, blobs.spacing, blobs.origin)
    tree = gv.N3Tree.from_volume(
        {"air": gv.Volume(blobs.data * 0, blobs.spacing, blobs.origin), "two": other}
    )
    rays = camera_rays(tree)
    assert trace(tree, compiled, rays)[0]["alpha"].max() == 0
    result, *_ = assert_equal(tree, compiled, rays, channel="two", component=1)
    single, _ = trace(gv.N3Tree.from_volume(blobs), compiled, rays)
    assert torch.equal(result["alpha"], single["alpha"])


@pytest.fixture(scope="module")
def tree(blobs) -> gv.N3Tree:
    """Each trace is of a copy."""
    return gv.N3Tree.from_volume(blobs, 4)


@settings(max_examples=15, deadline=None)
@given(
    share=st.floats(0, 1),
    seed=st.integers(0, 2**31),
    lod=st.sampled_from(["auto", "finest"]),
    step=st.sampled_from([1.0, 2.5]),
    distance=st.floats(0.1, 8),
    azimuth=st.floats(-180, 180),
    elevation=st.floats(-90, 90),
)
@pytest.mark.backend("cpp")
def test_missing_nodes_give_equal_pictures_and_requests(
    tree, share, seed, lod, step, distance, azimuth, elevation
):
    rays = camera_rays(tree, 12, distance=distance, azimuth=azimuth, elevation=elevation)
    assert_equal(with_holes(tree, share, seed), "cpp", rays, lod=lod, step=step)


def test_requests_name_what_is_missing(tree, backend):
    rays = camera_rays(tree, distance=1.2)
    options = {"lod": "finest", "step": 2.5}
    _, full = trace(tree, backend, rays, **options)
    seen = (full["brick"] == 1).nonzero()[:, 0]
    gone = copy_to(tree, "cpu")
    slot = int(seen[-1])  # finest bricks come last
    node = int(tree.bricks.owner_b[slot])
    gone.nodes.brick_tn.view(-1)[node] = config.ABSENT
    _, marks = trace(gone, backend, rays, **options)
    word = int(marks["request"].view(-1)[node])
    assert word & config.REQUEST_LOAD and not word & config.REQUEST_SUBDIVIDE
    assert word & config.REQUEST_PRIORITY == config.REQUEST_PRIORITY, (
        "finest: no cone, top priority"
    )
    marks["request"].view(-1)[node] = 0
    assert not marks["request"].any(), "nothing else is missing"

    gone = copy_to(tree, "cpu")
    gone.nodes.child_tn.view(-1)[tree.root] = config.ABSENT
    _, marks = trace(gone, backend, rays, **options)
    assert int(marks["request"].view(-1)[tree.root]) & config.REQUEST_SUBDIVIDE
    assert (marks["request"] != 0).sum() == 1


def test_a_missing_brick_is_drawn_from_its_ancestor(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera_rays(tree, distance=1.2)
    haze = gv.TransferFunction.from_points([(0, 0), (1, 0.01)])  # so thin that alpha adds up
    full, _ = trace(tree, backend, rays, haze)
    top = copy_to(tree, "cpu")
    top.nodes.child_tn.view(-1)[tree.root] = config.ABSENT
    coarse, _ = trace(top, backend, rays, haze)
    ratio = coarse["alpha"].sum() / full["alpha"].sum()
    assert 0.7 < ratio < 1.3, (
        "the root's brick stands in for all: a mean filter keeps what is absorbed"
    )
    assert (coarse["alpha"] - full["alpha"]).abs().max() > 1e-3, "and it is coarser"
    top.nodes.brick_tn.view(-1)[tree.root] = config.ABSENT
    nothing, marks = trace(top, backend, rays, haze)
    assert nothing["alpha"].max() == 0 and torch.isinf(nothing["depth"]).all()
    assert int(marks["request"].view(-1)[tree.root]) & config.REQUEST_LOAD


@pytest.mark.parametrize("compiled", ["cuda"], indirect=True)
@pytest.mark.parametrize("lod", ["finest", "auto"])
def test_cuda_equals_cpp_on_a_million_rays(aneurism, compiled, lod):
    """Every bit of it: pictures, samples, stamps and requests, with a tenth of the tree missing."""
    tree = with_holes(gv.N3Tree.from_volume(aneurism), 0.1, 0)
    rays = camera_rays(tree, 1024, distance=1.4)
    shader = gv.TransferFunction.preset("vessels", 0, 255)
    expected, expected_marks = trace(tree, "cpp", rays, shader, lod=lod)
    actual, marks = trace(tree, compiled, rays, shader, lod=lod)
    for name in expected:
        assert torch.equal(actual[name], expected[name]), name
    for name in marks:
        assert torch.equal(marks[name], expected_marks[name]), name
    assert (marks["request"] != 0).sum() > 100 and expected["alpha"].max() > 0.9


@pytest.mark.backend("cpp")
def test_threads_give_the_same_bits(aneurism):
    tree = gv.N3Tree.from_volume(aneurism)
    shader = gv.TransferFunction.preset("vessels", 0, 255)
    rays = camera_rays(tree, 96)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        single = trace(tree, "cpp", rays, shader)
        torch.set_num_threads(2)
        several = trace(tree, "cpp", rays, shader)
    finally:
        torch.set_num_threads(before)
    for first, second in zip(single, several, strict=True):
        assert all(torch.equal(first[name], second[name]) for name in first)


def test_skipping_does_not_move_samples(blobs, backend):
    """A second channel makes all nodes DATA, and their ranges are unknown: nothing is skipped, and
    the picture is the same.
    """
    noise = torch.rand(blobs.data.shape, generator=torch.Generator().manual_seed(1))
    dense = {"value": blobs, "noise": gv.Volume(noise, blobs.spacing, blobs.origin)}
    sparse, full = gv.N3Tree.from_volume(blobs, 4), gv.N3Tree.from_volume(dense, 4)
    low, high = gv.Channel(torch.float32).limits
    full.nodes.ranges["value"][:, :, 0], full.nodes.ranges["value"][:, :, 1] = low, high
    rays = camera_rays(sparse, distance=1.3)
    a, _ = trace(sparse, backend, rays, lod="finest", step=2.5)
    b, _ = trace(full, backend, rays, lod="finest", step=2.5)
    assert (a["samples"] < b["samples"]).any()
    assert torch.equal(a["alpha"], b["alpha"]) and torch.equal(a["color"], b["color"])


def test_strange_rays_end(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, 4)
    centre = tree.box.mean(0).tolist()
    zero, inf, nan = 0.0, math.inf, math.nan
    strange = ((zero, zero, zero), (nan, 1, 0), (0, nan, 1), (1, 0, inf), (-inf, 1, 0))
    cases = [
        (centre, (zero, zero, zero), (0, 0), (0, inf)),
        (centre, (nan, nan, nan), (0, 0), (0, inf)),
        ((nan, 0, 0), (1, 0, 0), (0, 0), (0, inf)),
        ((inf, 0, 0), (-1, 0, 0), (0, 0), (0, inf)),
        ((1e30, 0, 0), (-1, 0, 0), (0, 1e-3), (0, inf)),
        (centre, (1, 0, 0), (nan, nan), (0, inf)),
        (centre, (1, 0, 0), (inf, inf), (0, inf)),
        (centre, (1, 0, 0), (0, 0), (5, 1)),
        *((centre, direction, (0, 0), (0, 5)) for direction in strange),
        *(
            (origin, (1, 0, 0), (0, 0), (0, 5))
            for origin in ((nan, *centre[1:]), (*centre[:2], -inf))
        ),
        (centre, (1, 0, 0), (0, 0), (nan, nan)),
        (centre, (1e-30, 1e-30, 1), (0, -1), (0, inf)),
        (centre, (1, 0, 0), (0, 0), (0, inf)),
    ]
    columns = [torch.tensor(column, dtype=torch.float32) for column in zip(*cases, strict=True)]
    rays = gv.Rays(**dict(zip(("origin", "direction", "cone", "range"), columns, strict=True)))
    result, _ = trace(tree, backend, rays)
    assert torch.isfinite(result["color"]).all() and torch.isfinite(result["alpha"]).all()
    finite = torch.isfinite(rays.origin + rays.direction).all(1)
    empty = ~finite | (rays.direction == 0).all(1)
    assert empty.sum() == 11 and result["alpha"][-1] > 0
    assert not result["alpha"][empty].any() and not result["samples"][empty].any()


def test_no_rays(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera_rays(tree)
    none = rays[:0]
    device = DEVICES[backend]
    hits = gv.trace(copy_to(tree, device), none.to(device), SHADER)
    assert hits.color.shape == (0, 3) and hits.samples.shape == (0,)


@pytest.mark.backend("reference")
def test_logarithm_and_power_are_accurate():
    x = torch.cat(
        (
            torch.logspace(-37, 38, 20001, dtype=torch.float64),
            torch.linspace(0.5, 2, 20001).double(),
        )
    )
    x = x.float()
    error = (exact.log2_exact(x).double() - torch.log2(x.double())).abs()
    assert (error / torch.log2(x.double()).abs().clamp(min=1)).max() < 3e-7
    y = torch.linspace(-126, 127, 40001)[:-1]
    y = y[(y > -126) & (y < 126)]
    ratio = exact.exp2_exact(y).double() / torch.exp2(y.double())
    assert (ratio - 1).abs().max() < 3e-7
    assert exact.exp2_exact(torch.tensor([-1000.0, -math.inf])).tolist() == [0, 0]


@pytest.mark.backend("reference")
def test_logarithm_power_and_light_taken_are_accurate_in_float64():
    """Against torch's, which are right to about an ulp, 2.2e-16."""
    wide = torch.float64
    x = torch.cat(
        (torch.logspace(-300, 300, 20001, dtype=wide), torch.linspace(0.5, 2, 20001).to(wide))
    )
    error = (exact.log2_exact(x) - torch.log2(x)).abs() / torch.log2(x).abs().clamp(min=1e-9)
    assert float(error.max()) < 1e-15
    y = torch.linspace(-1021, 1021, 40001, dtype=wide)
    assert float((exact.exp2_exact(y) / torch.exp2(y) - 1).abs().max()) < 1e-15
    assert exact.exp2_exact(torch.tensor([-2000.0, -math.inf], dtype=wide)).tolist() == [0, 0]
    h = torch.logspace(-20, 3, 20001, dtype=wide)
    assert float((exact.absorbed_by(h) / -torch.expm1(h * -math.log(2)) - 1).abs().max()) < 1e-15


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"origin_r3": torch.zeros(4, 2).double()},
            "origin_r3 must be (r, 3) float64 on cpu, got (4, 2)",
        ),
        ({"direction_r3": torch.zeros(4, 3)}, "direction_r3 must be (4, 3) float64"),
        (
            {"table_lm4": torch.zeros(1, 4, 4, dtype=torch.int32)},
            "table_lm4 must be (l, m, 4) float32 or float64",
        ),
        ({"cone_r2": torch.zeros(5, 2)}, "cone_r2 must be (4, 2)"),
        (
            {"table_lm4": torch.zeros(1, 1, 4), "opaque_m": torch.zeros(1, dtype=torch.int32)},
            "table_lm4 needs at least 1 length and 2 rows",
        ),
        ({"opaque_m": torch.zeros(3)}, "opaque_m must be"),
        ({"range_tn2c": torch.zeros(3)}, "range_tn2c must be"),
        ({"frame_1": torch.zeros(1)}, "frame_1 must be (1,) int32"),
        ({"width": 3}, "4 rays are not whole rows of 3 pixels"),
        ({"cone_scale": -1.0}, "cone_scale must be"),
        ({"direction_r3": torch.zeros(3, 4).double().T}, "direction_r3 must be contiguous"),
        ({"branching": 1}, "branching must be an int >= 2"),
        ({"root": -1}, "root must be an int >= 0"),
        ({"component": 1}, "component must be an int >= 0 and <= 0"),
        ({"step": 0.0}, "step must be finite and > 0"),
        ({"step": math.nan}, "step must be finite"),
        ({"stop_alpha": 1.5}, "stop_alpha must be finite and >= 0 and <= 1"),
    ],
)
def test_bad_arguments_have_one_clear_message(blobs, change, message):
    tree = gv.N3Tree.from_volume(blobs, 8)
    with pytest.raises(ValueError) as caught:
        gv.ops.trace_rays(*changed(arguments(tree, 4), change))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_an_unknown_backend_is_one_clear_error(blobs):
    given = arguments(gv.N3Tree.from_volume(blobs, 8), 4)
    with pytest.raises(ValueError, match="backend must be auto, reference, cpp or cuda"):
        gv.ops.trace_rays(*given, backend="opengl")  # type: ignore[arg-type]


def test_options_are_checked():
    for change in ({"lod": "best"}, {"step": -1}, {"dtype": torch.float16}, {"background": (0, 0)}):
        with pytest.raises(ValueError, match="render"):
            gv.RenderOptions(**change)
    with pytest.raises(dataclasses.FrozenInstanceError):
        gv.RenderOptions().step = 2  # type: ignore[misc]


def test_settings_are_the_options_that_an_editor_completes():
    assert gv.RenderSettings.__annotations__.keys() == gv.RenderOptions.__annotations__.keys()
    assert typing.get_type_hints(gv.RenderSettings) == typing.get_type_hints(gv.RenderOptions)
    assert not gv.RenderSettings.__required_keys__


def test_trace_checks_what_it_is_given(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera_rays(tree, 4)
    for call, message in (
        (lambda: gv.trace(tree, rays, SHADER, colour=1), "trace: unknown option 'colour'"),
        (lambda: gv.trace(blobs, rays, SHADER), "trace: tree must be a N3Tree, got Volume"),
        (lambda: gv.trace(tree, gv.Camera.orbit(), SHADER), "trace: rays must be a Rays, got Ca"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@settings(max_examples=10, deadline=None)
@given(
    share=st.floats(0, 1),
    seed=st.integers(0, 2**31),
    low=st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.75, 0.9]),
    lod=st.sampled_from(["auto", "finest"]),
    by_level=st.booleans(),
)
@pytest.mark.backend("cpp")
def test_transparent_ranges_ask_for_nothing_and_change_no_bit(
    tree, share, seed, low, lod, by_level
):
    """Nodes whose range is transparent are not requested; a tree with unknown ranges gives the same
    picture in every bit, and requests more."""
    shader = gv.TransferFunction.from_points([(low, 0), (low + 0.1, 0.3)], [(0, 1, 0, 0)])
    ranged = with_holes(tree, share, seed)
    unknown = copy_to(ranged, "cpu")
    limits = gv.Channel(torch.float32).limits
    unknown.nodes.ranges["value"][:, :, 0], unknown.nodes.ranges["value"][:, :, 1] = limits
    rays = camera_rays(ranged, 16, distance=1.6)
    a, a_marks = run_by_level(ranged, rays, shader, lod, by_level)
    b, b_marks = run_by_level(unknown, rays, shader, lod, by_level)
    requested, would_ask = a_marks != 0, b_marks != 0
    assert not (requested & ~would_ask).any()
    if share == 0:
        for name in ("color", "alpha", "depth"):
            assert torch.equal(a[name], b[name]), name


def run_by_level(tree, rays, shader, lod, by_level):
    """Returns hits and request words; asserts that the twin's and the kernel's are equal."""
    runs = []
    for backend in ("reference", "cpp"):
        copy = copy_to(tree, "cpu")
        options = gv.RenderOptions(backend=backend, lod=lod, step=2.0)
        runs.append((vars(Tracer(copy, shader, options, by_level=by_level)(rays)), copy))
    (expected, twin), (actual, kernel) = runs
    for name in ("color", "alpha", "depth", "samples", "missed"):
        assert torch.equal(actual[name], expected[name]), name
    for name, field in twin.nodes.fields.items():
        assert torch.equal(kernel.nodes.fields[name], field), name
    return actual, kernel.nodes.request_tn


def test_level_by_level_asks_for_a_brick_before_its_children(blobs, backend):
    tree = copy_to(gv.N3Tree.from_volume(blobs, 4), DEVICES[backend])
    rays = camera_rays(tree, 8, distance=1.3)
    rays = rays.to(tree.device)
    tree.nodes.child_tn.view(-1)[tree.root] = config.ABSENT
    tree.nodes.brick_tn.view(-1)[tree.root] = config.ABSENT
    kinds = {}
    for by_level in (True, False):
        tree.nodes.request_tn.zero_()
        Tracer(tree, SHADER, gv.RenderOptions(backend=backend), by_level=by_level)(rays)
        kinds[by_level] = int(tree.nodes.request_tn.view(-1)[tree.root]) & config.REQUEST_KINDS
    both = config.REQUEST_KINDS
    assert kinds == {True: config.REQUEST_LOAD, False: both}, "nothing answers for the root"
    tree.nodes.request_tn.zero_()
    tree.nodes.brick_tn.view(-1)[tree.root] = 0
    Tracer(tree, SHADER, gv.RenderOptions(backend=backend), by_level=True)(rays)
    requested = int(tree.nodes.request_tn.view(-1)[tree.root]) & config.REQUEST_KINDS
    assert requested == config.REQUEST_SUBDIVIDE


def test_trees_of_smaller_branching_share_wider_tiles(blobs, compiled):
    """A pool for N=3 holds an N=2 tree: same picture, same marks."""
    narrow = gv.N3Tree.from_volume(blobs, 4)
    nodes = gv.NodePool(narrow.nodes.capacity, narrow.bricks.channels, branching=3)
    wide = gv.N3Tree(
        *(nodes, narrow.bricks),
        branching=2,
        depth=narrow.depth,
        extent=narrow.extent,
        spacing=narrow.spacing,
        origin=tuple((narrow.box[0] + 0.5 * torch.tensor(narrow.spacing)).tolist()),
    )
    nodes.child_tn[:], nodes.brick_tn[:] = config.TERMINAL, config.EMPTY
    for name, field in narrow.nodes.fields.items():
        target = nodes.fields[name]
        (target[:, :8] if target.dim() > 1 and name != "loc_t4" else target).copy_(field)
    rays = camera_rays(narrow)
    expected, _ = trace(narrow, "reference", rays)
    for backend in ("reference", compiled):
        if DEVICES[backend] != "cpu":
            continue
        hits = vars(Tracer(wide, SHADER, gv.RenderOptions(backend=backend))(rays))
        assert all(torch.equal(hits[name], expected[name]) for name in expected)
        used = (wide.nodes.stamp_t == wide.frame).sum()
        assert used > 5
