"""The fused shaders: reference = C++ = CUDA, the op's contract, and golden images."""

from __future__ import annotations

import io
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import DEVICES, ROOT
from helpers.rays import camera_rays, rays_along, rays_of_cameras, world_rays
from helpers.shaders import POINT, SHADERS
from helpers.traces import SHADER, assert_equal, changed, op_arguments, trace
from helpers.trees import copy_to, with_holes

import gvtorch as gv
from gvtorch import cpp_ext
from gvtorch.ops import shade_rays
from gvtorch.ops.reference.shaders import SHADER_KINDS, shader_number
from gvtorch.ops.shading import FAINT
from gvtorch.shaders import built_in
from gvtorch.shaders.coarse_colors import mean_of_directions
from gvtorch.tracing.tracer import Tracer

GOLDEN = {
    name: image
    for file in sorted((ROOT / "tests").glob("golden_shaders*.npz"))
    for name, image in np.load(file).items()
}


POOLS = {"node_pool": "1 MB", "brick_pool": "16 MB"}


@pytest.fixture(scope="module")
def trees(channels, tree_of_channels) -> dict[int, gv.N3Tree]:
    """Trees by N."""
    return {2: tree_of_channels, 3: gv.N3Tree.from_volume(channels, 4, branching=3)}


@pytest.fixture(scope="module")
def tree(trees) -> gv.N3Tree:
    return trees[2]


@pytest.fixture(scope="module")
def tree_of_bricks_of_8(channels) -> gv.N3Tree:
    return gv.N3Tree.from_volume(channels, 8)


@pytest.fixture(scope="module")
def with_and_without_ranges(
    channels, tree_of_channels
) -> dict[float | None, tuple[gv.N3Tree, gv.N3Tree]]:
    """Trees, and copies in which any node may hold any value, by threshold."""
    pairs = {}
    trees = {None: tree_of_channels, 0.2: gv.N3Tree.from_volume(channels, 4, threshold=0.2)}
    for threshold, ranged in trees.items():
        unknown = copy_to(ranged, "cpu")
        for channel, ranges in unknown.nodes.ranges.items():
            ranges[:, :, 0], ranges[:, :, 1] = ranged.bricks.channels[channel].limits
        pairs[threshold] = ranged, unknown
    return pairs


@pytest.mark.parametrize("lod", ["finest", "auto"])
@pytest.mark.parametrize("name", SHADERS)
def test_compiled_equals_reference(tree, compiled, name, lod):
    few = "shadows" in name or lod == "finest"  # the twin is slow: a cone from each sample
    distances, size = ((1.3,), 6) if few else ((1.3, 0.2, 6.0), 10)
    rays, step = rays_of_cameras(tree, size, *distances), 2.3 if few else 1.3
    expected, _, actual = assert_equal(tree, compiled, rays, SHADERS[name], lod=lod, step=step)
    if compiled == "cpp":
        for field in ("color", "alpha", "depth", "normal", "features"):
            assert torch.equal(actual[field], expected[field]), field
    assert expected["alpha"][: size * size].max() > 0.3, "the test must see something"


@pytest.mark.parametrize("name", SHADERS)
def test_compiled_equals_reference_in_every_bit_of_float64(tree, compiled, name):
    rays, options = camera_rays(tree, 6, distance=1.3), {"dtype": torch.float64, "step": 1.7}
    expected, _, actual = assert_equal(tree, compiled, rays, SHADERS[name], **options)
    for field in ("color", "alpha", "depth", "normal", "features"):
        assert torch.equal(actual[field].cpu(), expected[field].cpu()), field


@pytest.mark.parametrize(
    ("dtype", "branching", "step"),  # each pair of values
    [
        (torch.float32, 2, 0.8),
        (torch.float32, 3, 2.9),
        (torch.float64, 2, 2.9),
        (torch.float64, 3, 0.8),
    ],
)
@pytest.mark.parametrize("name", SHADERS)
def test_compiled_equals_reference_for_steps_and_dtypes(
    trees, compiled, name, dtype, branching, step
):
    tree = trees[branching]
    assert_equal(tree, compiled, camera_rays(tree, 6), SHADERS[name], dtype=dtype, step=step)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("ends", [[(0.5, 0), (0.6, 0.9)], [(0.3, 0), (0.4, 0.5), (0.5, 0)]])
def test_pre_integration_skips_what_its_function_does_not_show(ends):
    values = 0.2 * torch.rand((32, 32, 32), generator=torch.Generator().manual_seed(3))
    values[:, :, 16:] += 0.7  # beyond the second function's domain
    values[12:20, 12:20, 4:12] = 0.45 if ends[-1][1] == 0 else 1.0
    tree = gv.N3Tree.from_volume(gv.Volume(values), 4)
    rays, transfer = camera_rays(tree, 16), gv.TransferFunction(ends)
    plain, integrated = (
        gv.trace(tree, rays, shader, lod="finest", stop_alpha=1.0)
        for shader in (transfer, gv.PreIntegrated(transfer))
    )
    assert 0 < int(integrated.samples.sum()) <= 1.1 * int(plain.samples.sum())


@pytest.mark.parametrize(
    "dtype", ["uint8", "int8", "int16", "uint16", "float16", "bfloat16", "float32"]
)
def test_every_channel_dtype(blobs, compiled, dtype):
    data = (blobs.data * 100).to(getattr(torch, dtype))
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4)
    rays = camera_rays(tree, 12)
    hits, *_ = assert_equal(tree, compiled, rays, gv.Isosurface(50), step=1.7)
    assert hits["alpha"].max() == 1 and hits["normal"].norm(dim=1).max() > 0.99
    function = gv.TransferFunction([(20, 0), (80, 0.7)], [(20, 1, 0.5, 0.1), (80, 1, 1, 1)])
    for lod in ("finest", "auto"):
        hits, *_ = assert_equal(tree, compiled, rays, gv.Lit(function), lod=lod, step=1.7)
        assert hits["alpha"].max() > 0.7 and hits["normal"].norm(dim=1).max() > 0.9


@pytest.mark.parametrize("name", SHADERS)
def test_missing_nodes_give_equal_pictures_and_requests(tree, compiled, name):
    for seed, share in ((1, 0.3), (2, 0.7)):
        holes = with_holes(tree, share, seed)
        rays = camera_rays(holes, 8, distance=1.4)
        _, marks, _ = assert_equal(holes, compiled, rays, SHADERS[name], step=1.7)
        assert marks["request"].any()


@pytest.mark.parametrize("threshold", [None, 0.2])
@pytest.mark.parametrize("name", SHADERS)
def test_what_ranges_hide_changes_no_bit(with_and_without_ranges, name, threshold):
    ranged, unknown = with_and_without_ranges[threshold]
    rays = camera_rays(ranged, 10 if "shadows" in name else 16, distance=1.6)
    for lod in ("finest", "auto"):
        options = gv.RenderOptions(lod=lod)
        few, many = (vars(Tracer(t, SHADERS[name], options)(rays)) for t in (ranged, unknown))
        assert few["samples"].sum() <= many["samples"].sum()
        for field in ("color", "alpha", "depth", "normal", "features"):
            assert torch.equal(few[field], many[field]), field
    if name in ("isosurface", "maximum", "lit"):
        assert few["samples"].sum() < many["samples"].sum()


@pytest.mark.parametrize("name", SHADERS)
def test_rays_that_have_lost_light_bring_back_the_rest(tree, compiled, name):
    """Also for the twin, which `test_pieces` compares."""
    rays = camera_rays(tree, 16, distance=1.6)
    dimmed = replace(rays, transmittance=torch.full((len(rays.origin),), 0.25))
    options = gv.RenderOptions(stop_alpha=1.0, backend=compiled)
    tracer = Tracer(copy_to(tree, DEVICES[compiled]), SHADERS[name], options)
    full, rest = (tracer(some.to(DEVICES[compiled])) for some in (rays, dimmed))
    torch.testing.assert_close(rest.color, 0.25 * full.color)
    torch.testing.assert_close(1 - rest.alpha, 0.25 * (1 - full.alpha))
    assert full.alpha.max() > 0.3


def test_a_surface_has_the_colour_that_its_voxels_hold(tree, compiled):
    """Each component against a function that draws it as grey; also premultiplied by opacity."""
    rays, flat = camera_rays(tree, 16), {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0}
    ramp = gv.TransferFunction.from_points([(0, 1)], [(0, 0, 0, 0), (255, 1, 1, 1)])
    stored = gv.Isosurface(0.4, None, color_channel="rgba", **flat)
    hits, _ = trace(tree, compiled, rays, stored)
    for number in range(3):
        grey = gv.Isosurface(0.4, ramp, color_channel="rgba", color_component=number, **flat)
        by_function, _ = trace(tree, compiled, rays, grey)
        assert (hits["color"][:, number] - by_function["color"][:, 0]).abs().max() < 2e-3
    assert hits["color"].std(0).min() > 0.05, "of many colours"
    times, _ = trace(tree, compiled, rays, gv.Isosurface(
        0.4, None, color_channel="premultiplied", premultiplied=True, **flat
    ))  # fmt: skip
    difference = (times["color"] - hits["color"]).abs()  # there, voxels are weighted by opacity
    assert difference.max() < 0.1 and difference.mean() < 0.01
    with pytest.raises(ValueError, match="stored colour needs 4 numbers a voxel, 'normal' has 3"):
        trace(tree, compiled, rays, gv.Isosurface(0.4, None, color_channel="normal"))


@pytest.mark.parametrize("name", ["lit", "stored colour"])
def test_a_region_of_one_value_is_lit_as_bricks_are(compiled, name):
    even = {
        "value": torch.full((20, 20, 20), 0.3),
        "rgba": torch.full((20, 20, 20, 4), 0.2),
        "normal": torch.tensor([1.0, 0.0, 0.0]).expand(20, 20, 20, 3),
    }
    light = gv.PointLight((10.0, 10.0, 10.0))  # in the middle: every place sees it elsewhere
    shader: gv.Lit | gv.StoredColor = gv.Lit(SHADER, normals="normal", light=light)
    if name == "stored colour":
        shader = gv.StoredColor("rgba", normals="normal", light=light, reference=10.0)
    results = []
    for noise in (0.0, 1e-7):  # one region, without any brick; bricks
        rough = {**even, "value": even["value"] + noise * torch.rand(20, 20, 20)}
        tree = gv.N3Tree.from_volume({n: gv.Volume(data) for n, data in rough.items()}, 4)
        assert bool(tree.bricks.capacity) is (noise > 0)
        rays = camera_rays(tree, 12, distance=1.6)
        *_, actual = assert_equal(tree, compiled, rays, shader, lod="finest")
        results.append(actual)
    assert results[0]["color"].max() > 0.05
    for field in ("color", "alpha", "normal"):
        torch.testing.assert_close(results[0][field], results[1][field], rtol=1e-4, atol=1e-4)


def test_lights_are_tensors_that_may_be_edited(tree):
    position, ambient = torch.tensor([0.0, 40.0, 60.0]), torch.tensor(0.1)
    shader = gv.Isosurface(0.5, light=gv.PointLight(position), ambient=ambient)
    tracer = Tracer(tree, shader, gv.RenderOptions())
    rays = camera_rays(tree, 16)
    before = tracer(rays).color
    position[:] = torch.tensor([60.0, -40.0, 0.0])
    moved = tracer(rays).color
    assert (moved - before).abs().max() > 0.1
    ambient.fill_(0.5)
    assert (tracer(rays).color - moved).max() > 0.2


NUMBERS = {  # before, after
    "value": (0.5, 0.35),
    "color": ((0.9, 0.4, 0.2), (0.1, 0.8, 0.3)),
    "ambient": (0.1, 0.5),
    "diffuse": (0.7, 0.3),
    "specular": (0.4, 0.0),
    "shininess": (20.0, 2.0),
}


@pytest.mark.parametrize("edited", NUMBERS)
def test_each_parameter_is_a_tensor_that_may_be_edited(tree, compiled, edited):
    """The next frame equals, to the bit, that of a new shader with those numbers. The colour is
    copied to a frame's table; everything else is read while rays are traced.
    """
    tree, rays = copy_to(tree, DEVICES[compiled]), camera_rays(tree, 16).to(DEVICES[compiled])
    numbers = {n: torch.tensor(before, device=tree.device) for n, (before, _) in NUMBERS.items()}
    shader, options = gv.Isosurface(light=POINT, **numbers), gv.RenderOptions()
    tracer = Tracer(tree, shader, options)
    before = tracer(rays).color
    numbers[edited].copy_(torch.tensor(NUMBERS[edited][1]))
    after = (Tracer(tree, shader, options) if edited == "color" else tracer)(rays).color
    plain = {n: pair[n == edited] for n, pair in NUMBERS.items()}
    new = Tracer(tree, gv.Isosurface(light=POINT, **plain), options)(rays)
    assert torch.equal(after, new.color) and (after - before).abs().max() > 0.02


@pytest.mark.parametrize("table", ["opacity", "color"])
@pytest.mark.parametrize("kind", [None, gv.Lit, gv.PreIntegrated])
def test_an_edited_transfer_function_is_the_next_picture_s(tree, compiled, kind, table):
    """It equals that of a new function with those points, without another tree."""
    points = {"opacity": [(0, 0), (1, 0.4)], "color": [(0, 1, 0, 0), (1, 0.2, 0.6, 1)]}
    tree, camera = (
        copy_to(tree, DEVICES[compiled]),
        gv.Camera.orbit(width=16, height=16, distance=1.3),
    )
    function = gv.TransferFunction.from_points(**points)
    shader = kind(function) if kind else function
    before = gv.render(tree, camera, shader).color
    getattr(function, table)[1, 1:] = 0.05
    after = gv.render(tree, camera, shader).color
    points[table][1] = (1, 0.05, 0.05, 0.05) if table == "color" else (1, 0.05)
    new = gv.TransferFunction.from_points(**points)
    assert torch.equal(after, gv.render(tree, camera, kind(new) if kind else new).color)
    assert (after - before).abs().max() > 0.05


@pytest.mark.parametrize("name", SHADERS)
def test_an_engine_draws_the_same(channels, tree_of_bricks_of_8, name):
    shader = SHADERS[name]
    camera = gv.Camera.orbit(width=24, height=18, distance=1.5)
    resident = gv.render(tree_of_bricks_of_8, camera, shader)
    read = {name: channels[name] for name in dict.fromkeys(("value", *shader.channels))}
    with gv.Engine(gv.VolumeProducer(read), brick_size=8, **POOLS) as engine:
        picture = engine.render(camera, shader)
    assert picture.stats.converged
    assert (picture.color - resident.color).abs().max() < 2e-3
    assert picture.normal.shape == (18, 24, 3)
    assert picture.features.shape[:2] == (18, 24)
    torch.testing.assert_close(picture.features, resident.features, atol=2e-3, rtol=1e-3)


@pytest.mark.parametrize("name", SHADERS)
def test_golden_image(tree, name):
    """64 x 64 pixels of colour and alpha; prints the largest error."""
    camera = gv.Camera.orbit(width=64, height=64, distance=1.4)
    picture = gv.render(tree, camera, SHADERS[name])
    expected = torch.from_numpy(GOLDEN[name].astype(np.float32))
    actual = torch.cat((picture.color, picture.alpha), -1)
    error = float((actual - expected).abs().max())
    print(f"{name}: {error:.2e}")
    assert error < 2e-3, "float16 keeps 1e-3 of the colours"


# --- the op's contract


def module(tree, name, compiled) -> tuple[gv.TreeTracer, tuple[torch.Tensor, ...]]:
    tree = copy_to(tree, DEVICES[compiled])
    return gv.TreeTracer(tree, SHADERS[name]), world_rays(tree.box, 33, tree.device)


def assert_all_same(actual, expected):
    assert len(actual) == len(expected) == 6
    for a, b in zip(actual, expected, strict=True):
        assert torch.equal(a.cpu(), b.cpu())
    assert expected[1].max() > 0.2


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", SHADERS)
def test_script_compile_and_export(tree, compiled, name):
    """Every other one is compiled: that takes longest, and traces the code that export traces."""
    torch._dynamo.reset()  # each tracer is a module of its own
    tracer, rays = module(tree, name, compiled)
    plain = tracer(*rays)
    expected = tracer.hits(*rays)
    for a, b in zip(plain, expected, strict=False):
        assert torch.equal(a, b)
    file = io.BytesIO()
    torch.jit.save(torch.jit.script(tracer), file)
    file.seek(0)
    assert_all_same(torch.jit.load(file).hits(*rays), expected)
    if [*SHADERS].index(name) % 2 == 0:
        fast = torch.compile(tracer.hits, fullgraph=True, backend="aot_eager")
        assert_all_same(fast(*rays), expected)
    program = torch.export.export(tracer, rays).module()
    assert all(torch.equal(a, b) for a, b in zip(program(*rays), plain, strict=True))


@pytest.mark.parametrize("name", SHADERS)
def test_opcheck(tree, compiled, name):
    """In one dtype per shader, alternating; test_op_contract.py checks the other op in both. What
    does not depend on what the kernel returns, autograd and graphs, is checked once a dtype.
    """
    tree, number = copy_to(tree, DEVICES[compiled]), [*SHADERS].index(name)
    dtype, checks = (torch.float32, torch.float64)[number % 2], ["test_schema", "test_faketensor"]
    if number < 2:
        checks += ["test_autograd_registration", "test_aot_dispatch_dynamic"]
    rays, traced, shading, parameters = op_arguments(tree, SHADERS[name], dtype)
    op = torch.ops.gvtorch.shade_rays.default
    arguments = (*rays, *traced, *shading, parameters)
    assert set(torch.library.opcheck(op, arguments, test_utils=checks).values()) == {"SUCCESS"}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gv.Lit(SHADER, ambient=-1), "ambient must be finite and >= 0"),
        (lambda: gv.Lit("bone"), "Lit: transfer must be a TransferFunction, got str"),
        (lambda: gv.Lit(SHADER, light=3), "light must be a Headlight"),
        (lambda: gv.DirectionalLight((0, 0, 0)), "direction must not be zero"),
        (lambda: gv.PointLight((0, 0, float("nan"))), "position must be finite"),
        (lambda: gv.Projection("median", SHADER), "which must be 'maximum'"),
        (lambda: gv.Isosurface(float("nan")), "value must be finite"),
        (lambda: gv.Isosurface(torch.tensor(float("nan"))), "value must be finite"),
        (lambda: gv.Isosurface(torch.zeros(2)), "value must be a number or a tensor of one, got ("),
        (lambda: gv.Isosurface(1, torch.zeros(4)), "color must be three numbers, got 4"),
        (lambda: gv.Isosurface(1, torch.tensor([0, 0, 2.0])), "color must be finite and >= 0 and"),
        (lambda: gv.Lit(SHADER, ambient=torch.tensor(float("nan"))), "ambient must be finite"),
        (lambda: gv.Features(SHADER, None), "Features: channel must be a name, got None"),
        (lambda: gv.StoredColor(3), "StoredColor: channel must be a name, got 3"),
        (lambda: gv.Isosurface(1, SHADER), "color_channel belong together"),
        (lambda: gv.StoredColor("rgba", reference=0), "reference must be finite and > 0"),
    ],
)
def test_bad_shaders_have_one_clear_message(make, message):
    with pytest.raises(ValueError) as caught:
        make()
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("shader", "message"),
    [
        (gv.Lit(SHADER, normals="n"), "unknown channel 'n'; the tree has value, rgba"),
        (gv.Lit(SHADER, normals="rgba"), "normals need 3 numbers a voxel, 'rgba' has 4"),
        (
            gv.StoredColor("normal"),
            "needs 4 numbers a voxel, or 24 for six directions, 'normal' has 3",
        ),
        (gv.Features(SHADER, "f"), "unknown channel 'f'"),
        (gv.Isosurface(1, SHADER, color_channel="rgba", color_component=4), "must be an int >= 0"),
    ],
)
def test_a_missing_channel_is_one_clear_error(tree, shader, message):
    with pytest.raises(ValueError, match="render") as caught:
        gv.render(tree, gv.Camera.orbit(width=4, height=4), shader)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_the_op_checks_its_arguments(tree):
    *good, parameters = op_arguments(tree, SHADERS["features"], torch.float32)
    shade_rays(*good, parameters)
    with pytest.raises(ValueError, match=r"parameter_54 must be \(5, 4\)"):
        shade_rays(*good, torch.zeros(5))
    for change, message in (
        ({"shader": 99}, f"shader must be an int >= 0 and <= {len(SHADER_KINDS) - 1}"),
        ({"features": 3}, "features must be an int >= 4"),
        ({"other_tnc": None}, "belong together"),
        ({"other_bzyxc": None, "other_tnc": None}, "features need other_bzyxc"),
        ({"shader": 1}, "table_lm4 must be"),
        ({"shader": 2}, "stored colour needs a channel of 4 or 24 numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            shade_rays(*changed(good, change), parameters)


# --- one base, one registry


def test_every_shader_is_a_shader():
    for shader in (SHADER, *SHADERS.values(), gv.ModuleShader(torch.nn.Identity())):
        assert isinstance(shader, gv.Shader), shader


FACTS = ("integrates", "colored", "filtered", "feature_count")


def facts_of(struct: str, text: str) -> tuple[bool, bool, int, int | None]:
    """Returns the `FACTS` that a C++ struct declares, see `ShaderFacts` in csrc/shaders/plain.h."""
    body = text.partition(f"struct {struct} ")[2].partition("\n};")[0]
    declared = dict(re.findall(r"\bk(\w+) = ([\w<>:]+)", body))
    features = declared.get("Features", "0")
    return (
        "Integrates" in declared,
        "Colored" in declared,
        int(declared.get("Filtered", 0)),
        None if features.endswith("kAsOther") else int(features),
    )


def test_a_kind_has_a_struct_a_twin_and_a_class():
    """It has one name in csrc/shaders, in its twin and among the built-in classes, and C++ requires
    the same of its arguments.
    """
    folder = cpp_ext.SOURCES / "shaders"
    structs = "".join(path.read_text() for path in folder.glob("*.h"))
    listed = (folder / "shaders.h").read_text().partition("#define GV_SHADERS(X)")[2]
    listed = listed.partition("#define GV_KIND")[0]
    kinds = re.findall(r"X\((\w+), (\w+), (\w+)\)", listed)
    assert [kind for kind, _, _ in kinds] == [*SHADER_KINDS]
    for kind, struct, shadows in kinds:
        twin, is_shadowed = SHADER_KINDS[kind]
        declared = tuple(getattr(twin, name) for name in FACTS)
        assert declared == facts_of(struct, structs), kind
        assert is_shadowed == (shadows == "true") and twin.__name__ == struct, kind
    for kind in SHADER_KINDS:
        assert f"struct {kind} " in structs or kind.startswith("Shadowed"), kind
    shaders = [*SHADERS.values(), gv.Filtered(SHADER), gv.Filtered(gv.Lit(SHADER))]
    assert {shader.kind for shader in shaders} == {*SHADER_KINDS}
    with pytest.raises(ValueError, match=r"shader: kind must be 'Lit', .*, got 'Lamp'"):
        shader_number("Lamp")


def test_faint_moments_are_divided_and_multiplied_by_the_same_number():
    """Those that write filtered colours divide by it; the shader and its twin multiply by it."""
    text = (cpp_ext.SOURCES / "shaders" / "light.h").read_text()
    assert re.findall(r"kFaint = (\d+);", text) == [str(FAINT)]
    written = torch.tensor([0.5, 0.5, 0.5, 1.0, *[1.0] * 6] * 6)
    assert mean_of_directions(written)[4:].tolist() == [1 / FAINT] * 6


@pytest.mark.parametrize("name", built_in.BY_NAME)
def test_every_named_shader_draws(tree, name):
    """The shaders of the command line need only a transfer function and a level."""
    shader = built_in.named_shader(name, SHADER, 0.5)
    picture = gv.render(tree, gv.Camera.orbit(width=16, height=16, distance=1.4), shader)
    assert picture.alpha.max() > 0.3 and picture.color.max() > 0.1


def test_what_effects_ask_of_a_shader_without_a_light():
    for shader in (SHADER, gv.Features(SHADER, "rgba"), gv.ModuleShader(torch.nn.Identity())):
        for ask in (shader.unlit, shader.matter, shader.blocker):
            with pytest.raises(ValueError, match=f"lighting needs .*, got {type(shader).__name__}"):
                ask()
        assert shader.cut_surface() is None and shader.projection is None


@pytest.mark.parametrize("kind", ["isosurface", "distance field"])
def test_a_surface_is_filled(backend, kind):
    """Half a ball under the box's top face: from above its cut is seen, from within its matter; in
    a hollow one, the inner side.
    """
    axis = torch.arange(40.0)
    z, y, x = torch.meshgrid(axis[:28], axis, axis, indexing="ij")
    gap = 12 - ((x - 19.5) ** 2 + (y - 19.5) ** 2 + (z - 27.5) ** 2).sqrt()
    field = kind == "distance field"
    tree = gv.N3Tree.from_volume(gv.Volume(-gap if field else gap), 8)
    across = torch.linspace(5, 34, 9, dtype=torch.float64)
    origin = torch.stack((across, torch.full_like(across, 18.0), torch.full_like(across, 60.0)), 1)
    radius = ((origin[:, 0] - 19.5) ** 2 + 1.5**2).sqrt()
    down = rays_along(origin, (0.0, 0.0, -1.0))
    within = rays_along(torch.tensor([[19.0, 19.0, 24.0]]).double(), (0.3, 0.1, -1.0))
    met = {}
    for filled in (True, False):
        shader = gv.DistanceField(filled=filled) if field else gv.Isosurface(0, filled=filled)
        assert shader.opened().filled is False and shader.filled is filled
        for name, rays in (("down", down), ("within", within)):
            result, _ = trace(tree, backend, rays, shader)
            met[name, filled] = result
    cut = radius < 12
    assert 3 < cut.sum() < 9
    depth = met["down", True]["depth"][:, 0]
    assert torch.equal(depth < math.inf, cut)
    assert (depth[cut] - 32.5).abs().max() < 1e-4, "the box's face"
    assert (met["down", True]["color"][cut] > 0.2).all()
    hollow = met["down", False]["depth"][:, 0].double()[cut]
    assert (hollow - (32.5 + (144 - radius[cut] ** 2).sqrt())).abs().max() < 0.1
    assert float(met["within", True]["depth"]) == 0
    assert 8 < float(met["within", False]["depth"]) < 12
    assert float(met["within", True]["alpha"]) == float(met["within", False]["alpha"]) == 1
    bare, _ = trace(tree, backend, down, shader.opened(), clip=gv.Clip(planes=[(0, 0, -1, 20)]))
    clip, _ = trace(tree, backend, down, shader, clip=gv.Clip(planes=[(0, 0, -1, 20)]))
    assert torch.equal(bare["depth"], clip["depth"]), "a clip without caps opens it"
