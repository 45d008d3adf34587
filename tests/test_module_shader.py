"""`ModuleShader`: a transfer function as a module draws what the kernel draws; modules get the
documented inputs; gradients reach parameters and voxels.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers import DATA, DEVICES
from helpers.pictures import assert_close_picture
from helpers.traces import SHADER

import gvtorch as gv
from gvtorch.tracing.tracer import Tracer

SOFT = gv.TransferFunction.from_points(  # never fully opaque: a power of 0 has no slope
    opacity=[(0, 0), (0.2, 0), (0.6, 0.4), (1, 0.95)],
    color=[(0, 1, 0, 0), (0.5, 0.2, 0.8, 0.1), (1, 1, 1, 1)],
)


def twin(shader: gv.TransferFunction, spacing, device="cpu", **options) -> gv.ModuleShader:
    return gv.ModuleShader(gv.TransferModule(shader, min(spacing)).to(device), **options)


@torch.no_grad()
@pytest.mark.parametrize("brick_size", [4, 8, 16])
@pytest.mark.parametrize("lod", ["auto", "finest"])
@pytest.mark.parametrize("distance", [0.4, 1.3, 5.0])
def test_a_transfer_function_as_module_equals_the_fused_one(
    blobs, compiled, brick_size, lod, distance
):
    tree = gv.N3Tree.from_volume(blobs, brick_size, device=DEVICES[compiled])
    camera = gv.Camera.orbit(30, 20, distance, width=24, height=24)
    for shader in (twin(SOFT, tree.spacing, tree.device), twin(SOFT, tree.spacing, tree.device,
                                                               hidden_by=SOFT)):  # fmt: skip
        fused = gv.render(tree, camera, SOFT, lod=lod)
        if distance < 1:
            assert (gv.render(tree, camera, shader, lod=lod).color - fused.color).abs().max() < 1e-4
        else:
            assert_close_picture(gv.render(tree, camera, shader, lod=lod), fused)


@torch.no_grad()
def test_a_module_equals_the_fused_one_on_scans(aneurism, stent, compiled):
    vessels = gv.TransferFunction.preset("vessels", *aneurism.value_range)
    for volume, shader in (
        (aneurism, vessels),
        (stent, gv.TransferFunction.from_json(DATA / "stent.json")),
    ):
        tree = gv.N3Tree.from_volume(volume, device=DEVICES[compiled])
        module = twin(shader, tree.spacing, tree.device, hidden_by=shader, samples=1 << 16)
        camera = gv.Camera.orbit(30, 20, 1.6, width=64, height=64)
        assert_close_picture(gv.render(tree, camera, module), gv.render(tree, camera, shader))


@torch.no_grad()
@pytest.mark.parametrize("lod", ["auto", "finest"])
@pytest.mark.parametrize("lit", [False, True])
def test_stored_colours_and_normals_as_module_equal_the_fused_ones(blobs, compiled, lod, lit):
    """The formulas of `StoredColor`, with Blinn-Phong light, in torch."""
    generator, device = torch.Generator().manual_seed(4), DEVICES[compiled]
    placement = blobs.spacing, blobs.origin
    shape = blobs.data.shape[:3]
    rgba = torch.cat((torch.rand(*shape, 3, generator=generator), 0.4 * blobs.data), -1)
    normal = torch.rand(*shape, 3, generator=generator) - 0.5
    volumes = {"rgba": gv.Volume(rgba, *placement), "normal": gv.Volume(normal, *placement)}
    tree = gv.N3Tree.from_volume(volumes, 4, device=device)
    to_sun = torch.nn.functional.normalize(torch.tensor([2.0, -1, 2]), dim=0).to(device)
    phong = {"ambient": 0.2, "diffuse": 0.6, "specular": 0.3, "shininess": 9.0}

    def shade(values, positions, directions, lengths):
        color, opacity, n = values[:, :3], values[:, 3:4], values[:, 4:]
        alpha = 1 - (1 - opacity) ** (lengths / min(tree.spacing))
        if not lit:
            return color, alpha
        unit, sun = torch.nn.functional.normalize, to_sun.to(values)
        n = unit(n, dim=1) * -(n * directions).sum(1, keepdim=True).sign()
        half = unit(sun - directions, dim=1)
        facing = (n * sun).sum(1, keepdim=True).clamp(min=0)
        highlight = (n * half).sum(1, keepdim=True).clamp(min=0) ** phong["shininess"]
        highlight = highlight * (facing > 0)
        shaded = (
            color * (phong["ambient"] + phong["diffuse"] * facing) + phong["specular"] * highlight
        )
        return shaded, alpha

    light = {"normals": "normal", "light": gv.DirectionalLight((-2, 1, -2)), **phong} if lit else {}
    camera = gv.Camera.orbit(30, 20, 1.3, width=24, height=24)
    fused = gv.render(tree, camera, gv.StoredColor("rgba", **light), lod=lod)
    module = gv.ModuleShader(shade, ["rgba", "normal"])
    options = {"lod": lod, "component": 3}
    assert_close_picture(gv.render(tree, camera, module, **options), fused)


@torch.no_grad()
def test_a_module_streams_what_the_fused_shader_streams(blobs, compiled):
    """The same bricks are requested, and the converged pictures are the same."""
    camera = gv.Camera.orbit(30, 20, 1.3, width=24, height=24)
    results = {}
    for name in ("fused", "module"):
        with gv.Engine(
            gv.VolumeProducer(blobs), brick_size=4, node_pool="1 MB", brick_pool="4 MB",
            device=DEVICES[compiled],
        ) as engine:  # fmt: skip
            spacing = next(iter(engine.trees.values())).tree.spacing
            shader = twin(SOFT, spacing, engine.device, hidden_by=SOFT)
            picture = engine.render(camera, SOFT if name == "fused" else shader)
            engine.validate()
            results[name] = (picture, int((engine.cache.bricks.owner_b >= 0).sum()))
            assert picture.stats.converged
    assert_close_picture(results["module"][0], results["fused"][0])
    assert results["fused"][1] <= results["module"][1] <= 1.2 * results["fused"][1], (
        "a ray that ends inside a part has walked a little farther"
    )


@torch.no_grad()
def test_modules_and_transfer_functions_share_a_scene(blobs):
    camera = gv.Camera.orbit(30, 20, 1.3, width=16, height=16)
    far = gv.Volume(blobs.data, blobs.spacing, (105.0, -3.0, 2.0))
    scene = {"a": gv.VolumeProducer(blobs), "b": gv.VolumeProducer(far)}
    with gv.Engine(scene, brick_size=4, node_pool="1 MB", brick_pool="4 MB") as engine:
        both = engine.render(camera, {"a": SOFT, "b": SOFT})
        mixed = engine.render(camera, {"a": SOFT, "b": twin(SOFT, blobs.spacing)})
    assert_close_picture(mixed, both)


@torch.no_grad()
def test_the_module_sees_places_directions_and_lengths(blobs, backend):
    """A module that uses positions draws a ball that no voxel holds."""
    volume = gv.Volume(torch.rand(16, 16, 16, generator=torch.Generator().manual_seed(0)))
    tree = gv.N3Tree.from_volume(volume, 8, device=DEVICES[backend])
    centre, seen = tree.box.mean(0).to(tree.device), []

    def ball(values, positions, directions, lengths):
        seen.append((positions, directions, lengths))
        inside = ((positions - centre).norm(dim=1, keepdim=True) < 5).to(values)
        alpha = 1 - torch.exp(-0.3 * lengths * inside)
        return directions.abs(), alpha.to(values)

    camera = gv.Camera.orbit(0, 0, 4, width=33, height=33, fov=30)
    picture = gv.render(tree, camera, gv.ModuleShader(ball), lod="finest", backend=backend,
                        step=0.25, stop_alpha=1.0)  # fmt: skip
    middle = picture.alpha[16, 16, 0]
    assert abs(float(middle) - (1 - math.exp(-0.3 * 10))) < 0.01, "its diameter is 10"
    colour = picture.color[16, 16] / middle
    assert (colour - torch.tensor([0.0, 0.0, 1.0]).to(colour)).abs().max() < 0.05
    for positions, directions, lengths in seen:
        assert (directions.norm(dim=1) - 1).abs().max() < 1e-5
        assert positions.min() > -0.6 and positions.max() < 15.6 and lengths.max() <= 0.2501
    assert picture.alpha[0, 0] == 0


@torch.no_grad()
def test_a_far_camera_costs_no_precision(blobs):
    """Positions are computed from where the ray enters the box: float32 is too coarse outside."""
    volume = gv.Volume(torch.ones(8, 8, 8))
    tree, calls = gv.N3Tree.from_volume(volume, 8), []

    def note(values, positions, directions, lengths):
        calls.append((positions[:, 2], lengths))
        return values.expand(-1, 3), torch.zeros_like(lengths)

    noise = gv.Volume(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(0)))
    tree = gv.N3Tree.from_volume(noise, 8)
    camera = gv.Camera.look_at((3.5, 3.5, 1e8), (3.5, 3.5, 3.5), (0, 1, 0), 1e-8, 1, 1)
    gv.render(tree, camera, gv.ModuleShader(note), lod="finest")
    depth, length = (torch.cat(column) for column in zip(*calls, strict=True))
    expected = 7.5 - 0.5 * (torch.arange(16) + 0.5)
    assert (depth - expected).abs().max() < 1e-5 and (length - 0.5).abs().max() < 1e-5


@torch.no_grad()
def test_several_channels_stand_side_by_side(blobs, compiled):
    other = gv.Volume(torch.cat((1 - blobs.data, blobs.data * 3), -1), blobs.spacing, blobs.origin)
    tree = gv.N3Tree.from_volume({"a": blobs, "b": other}, 4, device=DEVICES[compiled])
    seen = []

    def function(values, positions, directions, lengths):
        seen.append(values)
        return values, torch.full_like(lengths, 0.02)

    camera = gv.Camera.orbit(width=16, height=16, distance=1.5)
    gv.render(tree, camera, gv.ModuleShader(function, ["a", "b"]))
    values = torch.cat(seen)
    assert values.shape[1] == 3 and values[:, 0].max() > 0.5
    assert (values[:, 0] + values[:, 1] - 1).abs().max() < 1e-5
    assert (values[:, 2] - 3 * values[:, 0]).abs().max() < 1e-5


def test_gradients_reach_parameters_and_voxels(blobs, compiled):
    """Against finite differences of the picture."""
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    camera = gv.Camera.orbit(width=8, height=8, distance=1.3)
    module = gv.TransferModule(SOFT, min(tree.spacing)).to(tree.device)
    shader = gv.ModuleShader(module)
    weight = torch.linspace(-1, 1, 8 * 8 * 3, device=tree.device).reshape(8, 8, 3)

    def loss() -> torch.Tensor:
        return (gv.render(tree, camera, shader, dtype=torch.float64).color * weight).sum()

    pool = tree.bricks.bricks["value"].requires_grad_()
    loss().backward()
    smooth = (module.rows[:, 3:] > 0.05) & (module.rows[:, 3:] < 0.9)  # away from the clamps
    for leaf, mask in ((module.rows, smooth.expand(-1, 4)), (pool, torch.ones_like(pool) > 0)):
        grad = leaf.grad
        index = int((grad.abs() * mask).argmax())
        with torch.no_grad():
            flat, ends = leaf.view(-1), []
            value = float(flat[index])
            for sign in (1, -1):
                flat[index] = value + sign * 1e-3
                ends.append(float(loss()))
            flat[index] = value
        slope = (ends[0] - ends[1]) / 2e-3
        assert abs(slope) > 1e-2 and abs(float(grad.view(-1)[index]) - slope) < 0.02 * abs(slope)


def test_bricks_made_of_voxels_by_index_have_their_whole_gradients(blobs):
    """As docs/custom_shaders.md says; those of the bricks themselves lack the borders' share."""
    data, view = blobs.data, gv.Camera.orbit(width=5, height=5, distance=1.3)
    shader = gv.ModuleShader(gv.TransferModule(SOFT, 1.0))
    options = {"lod": "finest", "dtype": torch.float64, "stop_alpha": 1.0}

    def loss(tree: gv.N3Tree) -> torch.Tensor:
        return gv.render(tree, view, shader, **options).color.sum()

    count = torch.arange(float(data.numel())).view_as(data)
    tree, voxels = gv.N3Tree.from_volume(gv.Volume(count)), data.clone().requires_grad_()
    index = tree.bricks["value"].long()
    bricks = data.flatten()[index].requires_grad_()
    tree.bricks["value"] = bricks
    (by_bricks,) = torch.autograd.grad(loss(tree), bricks)
    tree.bricks["value"] = voxels.flatten()[index]
    (by_voxels,) = torch.autograd.grad(loss(tree), voxels)
    assert by_voxels.sum() == pytest.approx(float(by_bricks.sum()), rel=1e-4)
    inner = by_bricks[:, 1:-1, 1:-1, 1:-1]
    assert inner.abs().sum() < 0.95 * by_bricks.abs().sum()
    move = 1e-3 * by_voxels.sign() * (by_voxels.abs() > 0.1 * by_voxels.abs().max())
    with torch.no_grad():
        ends = [loss(gv.N3Tree.from_volume(gv.Volume(data + s * move))) for s in (1, -1)]
    assert float(ends[0] - ends[1]) / 2 == pytest.approx(float((by_voxels * move).sum()), rel=0.02)


def test_a_loss_can_be_taken_backward_where_no_ray_has_a_sample(blobs):
    """Then gradients are 0: a batch of rays may miss, and DDP waits for all parameters."""
    tree, view = gv.N3Tree.from_volume(blobs, 8), gv.Camera.orbit(width=4, height=4, distance=1.3)
    shader = gv.ModuleShader(gv.TransferModule(SOFT, min(tree.spacing)))
    pool = tree.bricks["value"].requires_grad_()
    rays = view.placed(tree.box).rays()
    behind = dataclasses.replace(rays, origin=rays.origin + 1e3 * rays.direction)
    for scene in (tree, {"a": tree, "b": tree}):
        for missing in (behind, rays[:0]):
            hits = gv.trace(scene, missing, shader)
            for field in (hits.color, hits.alpha):
                leaves = [shader.module.rows, pool]
                grads = torch.autograd.grad(field.sum(), leaves, retain_graph=True)
                assert [grad.shape for grad in grads] == [leaf.shape for leaf in leaves]
                assert not any(grad.any() for grad in grads)
            assert not hits.color.any()
        with torch.no_grad():
            assert not gv.trace(scene, behind, shader).color.requires_grad


@torch.no_grad()
def test_rays_that_have_ended_mark_and_request_nothing(blobs, compiled):
    device = DEVICES[compiled]
    tree = gv.N3Tree.from_volume(blobs, 8, device=device)
    rays = gv.Camera.orbit(width=16, height=12, distance=1.3).placed(tree.box).rays(device)
    clear = torch.where(torch.arange(len(rays.origin)) % 2 == 0, 0.0, 0.5).to(device)
    shader, options = twin(SOFT, blobs.spacing, device), gv.RenderOptions(stop_alpha=1.0)
    tree.frame = 1
    whole = Tracer(tree, shader, options)(rays)
    tree.frame = 2
    hits = Tracer(tree, shader, options)(dataclasses.replace(rays, transmittance=clear))
    ended = clear == 0
    assert not hits.samples[ended].any() and not hits.color[ended].any()
    torch.testing.assert_close(hits.alpha[ended], 1 - clear[ended, None])
    assert torch.equal(hits.samples[~ended], whole.samples[~ended])
    torch.testing.assert_close(hits.color[~ended], 0.5 * whole.color[~ended])
    tree.frame = 3
    none = dataclasses.replace(rays, transmittance=torch.zeros_like(clear))
    Tracer(tree, shader, options)(none)
    assert not (tree.nodes.stamp_t == 3).any() and (tree.nodes.stamp_t == 2).any()


@pytest.mark.backend("cpp")
def test_mistakes_have_one_clear_message(blobs):
    tree = gv.N3Tree.from_volume(blobs, 8)
    camera = gv.Camera.orbit(width=8, height=8, distance=1.3)

    def wide(values, *_rest):
        return values.expand(-1, 4), values

    def too_opaque(values, *_rest):
        return values.expand(-1, 3), values + 5

    def nan(values, *_rest):
        return values.expand(-1, 3), values * math.nan

    def dark(values, *_rest):
        return values.expand(-1, 3) * math.nan, values

    def alone(values, *_rest):
        return values

    for shader, message in (
        (gv.ModuleShader(dark), "the module's colour must be finite"),
        (gv.ModuleShader(alone), "the module must give colour and alpha, got Tensor"),
        (gv.ModuleShader(lambda *four: four), "must give colour and alpha, got 4 parts"),
        (gv.ModuleShader(wide), "ModuleShader: the module's colour must be ("),
        (gv.ModuleShader(too_opaque), "the module's alpha must lie in [0, 1]"),
        (gv.ModuleShader(nan), "the module's alpha must lie in [0, 1]"),
        (gv.ModuleShader(wide, ["heat"]), "unknown channel 'heat'; the tree has value"),
        ("bright", "shader must be a TransferFunction"),
    ):
        with pytest.raises(ValueError) as caught:
            gv.render(tree, camera, shader)
        assert message in str(caught.value) and "\n" not in str(caught.value)
    for args, message in (
        ((3,), "module must be callable"),
        ((wide, "value"), "channels must be names"),
        ((wide, []), "channels must be names"),
    ):
        with pytest.raises(ValueError, match=message):
            gv.ModuleShader(*args)
    with pytest.raises(ValueError, match="hidden_by must be a TransferFunction"):
        gv.ModuleShader(wide, hidden_by=wide)
    with pytest.raises(ValueError, match="samples must be an int >= 64"):
        gv.ModuleShader(wide, samples=1)


@torch.no_grad()
@pytest.mark.backend("cpp")
def test_memory_is_bounded_by_the_samples_shaded_at_once(blobs):
    tree = gv.N3Tree.from_volume(blobs, 8)
    sizes = []
    fused = gv.TransferModule(SHADER, min(tree.spacing))

    def count(values, *rest):
        sizes.append(len(values))
        return fused(values, *rest)

    camera = gv.Camera.orbit(width=64, height=64, distance=1.3)
    picture = gv.render(tree, camera, gv.ModuleShader(count, samples=4096), stop_alpha=1.0)
    longest = 2 * math.ceil(8 * math.sqrt(3) * max(tree.spacing) / min(tree.spacing))
    assert max(sizes) <= 4096 + 64 * longest and sum(sizes) >= picture.stats.samples > 40000


@pytest.mark.backend("cpp")
def test_a_frame_with_a_module_is_not_captured(blobs):
    with gv.Engine(gv.VolumeProducer(blobs), node_pool="1 MB", brick_pool="4 MB") as engine:
        with pytest.raises(ValueError, match="a ModuleShader can't be recorded"):
            engine.capture(gv.Camera.orbit(width=8, height=8), twin(SOFT, blobs.spacing))


def test_a_module_shader_is_a_module(blobs, compiled):
    """Optimisers, `state_dict` and `.to` reach the module inside; plain functions work as well."""
    tree = gv.N3Tree.from_volume(blobs, 8, device=DEVICES[compiled])
    shader = twin(SOFT, tree.spacing).to(tree.device)
    (rows,) = shader.parameters()
    assert rows is shader.module.rows and [*shader.state_dict()] == ["module.rows"]
    assert shader.channels == () and not [*gv.ModuleShader(lambda *four: four).parameters()]
    camera = gv.Camera.orbit(30, 20, 1.3, width=8, height=8)
    optimizer = torch.optim.SGD(shader.parameters(), lr=1.0)
    before = gv.render(tree, camera, shader).color
    before.sum().backward()
    optimizer.step()
    assert (gv.render(tree, camera, shader).color - before).abs().max() > 1e-3
    copy = twin(SOFT, tree.spacing, tree.device)
    copy.load_state_dict(shader.state_dict())
    assert torch.equal(gv.render(tree, camera, copy).color, gv.render(tree, camera, shader).color)


@pytest.mark.backend("cpp")
def test_a_tree_tracer_takes_no_module(blobs):
    with pytest.raises(ValueError, match="shader must be one of the kernels', got ModuleShader"):
        gv.TreeTracer(gv.N3Tree.from_volume(blobs, 8), gv.ModuleShader(torch.nn.Identity()))
