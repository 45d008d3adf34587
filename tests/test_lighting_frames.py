"""Light in frames: twins and kernels, streaming, batches, lens, clip, layer, graphs, errors."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.shading import MATT, grid
from helpers.waits import nobody_waits

import gvtorch as gv

FLOOR = 8.0
LOOKS = {
    "shadow": gv.Lighting(lights=(gv.DirectionalLight((1, -2, 0.5), angle=6),)),
    "occlusion": gv.Lighting(occlusion=1, reach=0.3, frame="box"),
    "indirect": gv.Lighting(
        lights=(gv.PointLight((10.0, 60.0, 60.0), radius=3), gv.Headlight((0.2, 0.2, 0.2))),
        occlusion=0.5,
        indirect=1,
        shadow_cones=2,
    ),
}
SOLID = gv.TransferFunction.from_points([(0.2, 0), (0.6, 0.8)], [(0, 1, 0.3, 0.1), (1, 1, 0.9, 0)])
SURFACES = {
    "isosurface": gv.Isosurface(0.5, (0.9, 0.6, 0.4)),
    "distance": gv.DistanceField((0.9, 0.6, 0.4), offset=0.5),
    "lit": gv.Lit(SOLID, ambient=0.4),
}


def assert_same(a: gv.Picture, b: gv.Picture) -> None:
    for name in ("color", "alpha", "depth", "normal", "samples", "missed"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


@pytest.mark.parametrize("lighting", LOOKS)
@pytest.mark.parametrize("surface", SURFACES)
def test_compiled_equals_reference(blobs, compiled, surface, lighting):
    """In dtypes that alternate: each meets each surface and each lighting."""
    number = [*SURFACES].index(surface) + [*LOOKS].index(lighting)
    dtype = (torch.float32, torch.float64)[number % 2]
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    camera = gv.Camera.orbit(20, 30, 1.2, width=9, height=8)
    options = {"lighting": LOOKS[lighting], "dtype": dtype}
    a, b = (
        gv.render(tree, camera, SURFACES[surface], backend=backend, **options)
        for backend in (compiled, "reference")
    )
    assert a.color.dtype == dtype and a.color.max() > 0.1
    assert torch.equal(a.samples, b.samples)
    torch.testing.assert_close(a.color, b.color, rtol=0, atol=1e-5)
    if compiled == "cpp":  # every bit but the last of colours, which torch sums over cones
        # In float64 log2 and exp2 are torch's, which rounds as the processor's vectors do.
        last = torch.finfo(dtype).eps * (1 if dtype == torch.float32 else 4)
        torch.testing.assert_close(a.color, b.color, rtol=0, atol=last)
        for name in ("alpha", "depth", "normal", "missed"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name


@pytest.mark.parametrize("lighting", LOOKS)
@pytest.mark.parametrize("surface", SURFACES)
def test_a_streamed_picture_is_the_resident_one(blobs, compiled, surface, lighting):
    device = DEVICES[compiled]
    tree = gv.N3Tree.from_volume(blobs, 4, device=device)
    camera = gv.Camera.orbit(20, 30, 1.2, width=24, height=20)
    options = {"lighting": LOOKS[lighting]}
    whole = gv.render(tree, camera, SURFACES[surface], **options)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, device=device) as engine:
        streamed = engine.render(camera, SURFACES[surface], **options)
        assert streamed.stats.converged
        assert_same(streamed, whole)
        again, stats = engine.frame(camera, SURFACES[surface], **options)
        assert stats.converged and not stats.misses
        assert_same(again, whole)


def test_what_is_seen_only_in_a_shadow_is_streamed_at_its_coarser_level(compiled):
    """The ball is outside the picture, but its shadow falls into it."""
    x, y, z = np.moveaxis(grid((128,) * 3), -1, 0)
    body = np.sqrt((x - 40) ** 2 + (y - 96) ** 2 + (z - 40) ** 2) - 12
    value = np.clip(0.5 - np.minimum(body, y - FLOOR) / 2, 0, 1).astype(np.float32)
    camera = gv.Camera.look_at((48, 40, 48), (40, 8, 40), (1, 0, 0), fov=40, width=40, height=40)
    shader = gv.Isosurface(0.5, (1, 1, 1), **MATT)
    sun = gv.DirectionalLight((0, -1, 0), angle=8)
    pictures, depths = {}, {}
    for name, lighting in (
        ("none", gv.Lighting(lights=(sun,), shadows=0)),
        ("shadow", gv.Lighting(lights=(sun,))),
    ):
        producer = gv.VolumeProducer(gv.Volume(value))
        with gv.Engine(producer, brick_size=8, device=DEVICES[compiled]) as engine:
            pictures[name] = engine.render(camera, shader, lighting=lighting)
            assert pictures[name].stats.converged
            tree = engine.trees["scene"].tree
            depths[name] = brick_depths(tree, np.array([40, 96, 40]), 14)
    assert pictures["none"].color.min() > 0.9 and pictures["shadow"].color.min() < 0.01
    print("depths of the ball's bricks:", depths, "of", tree.depth)
    assert max(depths["none"], default=0) <= 1
    assert 1 < max(depths["shadow"]) < tree.depth


def brick_depths(tree: gv.N3Tree, centre: np.ndarray, reach: float) -> set[int]:
    """Returns the depths of bricks within reach of a point, except those of the root."""
    depths: set[int] = set()
    n, size = tree.branching, np.array(tree.spacing) * tree.side
    bricks, locs = tree.nodes.brick_tn.cpu(), tree.nodes.loc_t4.cpu()
    for tile, child in zip(*np.nonzero(bricks.numpy() >= 0), strict=True):
        x, y, z, depth = locs[tile].tolist()
        if depth < 1:
            continue
        corner = np.array([x * n + child % n, y * n + child // n % n, z * n + child // n**2])
        low = tree.box[0].numpy() + corner * size / n**depth
        if (low < centre + reach).all() and (low + size / n**depth > centre - reach).all():
            depths.add(depth)
    return depths


def test_each_camera_of_a_batch_has_its_own_light(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    angles, options = (10.0, 80.0, 200.0), {"lighting": LOOKS["indirect"]}
    batch = gv.Camera.orbit(list(angles), 30, 1.2, width=16, height=12)
    many = gv.render(tree, batch, SURFACES["isosurface"], **options)
    for number, angle in enumerate(angles):
        camera = gv.Camera.orbit(angle, 30, 1.2, width=16, height=12)
        alone = gv.render(tree, camera, SURFACES["isosurface"], **options)
        assert torch.equal(many.color[number], alone.color)
        assert torch.equal(many.samples[number], alone.samples)


def test_rays_that_hit_nothing_go_no_further(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[backend])
    camera = gv.Camera.look_at((0, 0, 500), (0, 300, 500), width=12, height=12)
    fisheye = gv.Camera.orbit(0, 0, 0.8, 180, 24, 24, "fisheye")
    for view in (camera, fisheye):
        plain = gv.render(tree, view, SURFACES["isosurface"], backend=backend)
        options = {"lighting": LOOKS["indirect"], "background": (0.1, 0.2, 0.3)}
        lit = gv.render(tree, view, SURFACES["isosurface"], backend=backend, **options)
        nothing = plain.alpha[..., 0] == 0
        assert nothing.sum() > 40 and torch.isfinite(lit.color).all()
        assert torch.equal(lit.samples[nothing], plain.samples[nothing])
        torch.testing.assert_close(
            lit.color[nothing].cpu(), torch.tensor([0.1, 0.2, 0.3]).expand(int(nothing.sum()), 3)
        )
    assert (lit.samples[~nothing] > plain.samples[~nothing]).any()


def test_lights_are_tensors_that_may_be_edited(blobs, compiled):
    device = DEVICES[compiled]
    tree = gv.N3Tree.from_volume(blobs, 4, device=device)
    rays = gv.Camera.orbit(20, 30, 1.2, width=32, height=32).placed(tree.box).rays(device)
    position, radius = (torch.tensor(n, device=device) for n in ([10.0, 60.0, 60.0], 2.0))
    tint, ambient = torch.ones(3, device=device), torch.ones(3, device=device)
    lighting = gv.Lighting(lights=(gv.PointLight(position, tint, radius),), ambient=ambient)
    shader = SURFACES["isosurface"]

    def draw():
        return gv.trace(tree, rays, shader, lighting=lighting).color

    first = draw()
    for tensor, value in ((position, 100.0), (tint, 0.5), (ambient, 0.3), (radius, 20.0)):
        before = draw()
        tensor.fill_(value)
        assert (draw() - before).abs().max() > 0.01
    assert (draw() - first).abs().max() > 0.1


def test_light_goes_with_lens_clip_and_layer(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    camera = gv.Camera.orbit(20, 30, 1.2, width=32, height=32)
    shader, options = SURFACES["isosurface"], {"lighting": LOOKS["shadow"]}
    sharp = gv.render(tree, camera, shader, **options)
    lens = gv.ThinLens(aperture=0.0, focus=1.2, frame="box")
    seen = gv.render(tree, camera, shader, lens=lens, **options)
    assert (seen.color - sharp.color).abs().median() < 1e-4
    wide = dataclasses.replace(lens, aperture=0.05)
    blurred = gv.render(tree, camera, shader, lens=wide, **options)
    assert (blurred.color - sharp.color).abs().mean() < 0.1
    far = torch.full((32, 32, 1), 1e3)
    layer = gv.Layer(torch.ones(32, 32, 3), far)
    mixed = gv.render(tree, camera, shader, layer=layer, **options)
    torch.testing.assert_close(mixed.color, sharp.color + (1 - sharp.alpha))
    clip = gv.Clip(planes=[(0, 0, -1, 24.0)], caps=True)
    cut = gv.render(tree, camera, shader, clip=clip, **options)
    assert torch.isfinite(cut.color).all() and cut.color.max() <= 1.5


def test_two_trees_have_the_same_light(blobs, compiled):
    other = gv.Volume(blobs.data, blobs.spacing, (60.0, -3.0, 2.0))
    scene = {"one": gv.VolumeProducer(blobs), "two": gv.VolumeProducer(other)}
    camera = gv.Camera.look_at((55, 10, 190), (55, 8, 29), fov=40, width=32, height=16)
    lighting = gv.Lighting(lights=(gv.DirectionalLight((0.2, -1, -1)),), occlusion=1, reach=20.0)
    shader, device = SURFACES["isosurface"], DEVICES[compiled]
    with gv.Engine(scene, device=device) as engine:
        both = engine.render(camera, shader, lighting=lighting)
    alone = [
        gv.render(gv.N3Tree.from_volume(v, device=device), camera, shader, lighting=lighting)
        for v in (blobs, other)
    ]
    torch.testing.assert_close(both.color, alone[0].color + alone[1].color, rtol=0, atol=1e-6)


def test_without_lighting_pictures_keep_every_bit(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    camera = gv.Camera.orbit(width=12, height=12, distance=1.2)
    for shader in SURFACES.values():
        plain = gv.render(tree, camera, shader)
        gv.render(tree, camera, shader, lighting=LOOKS["indirect"])
        assert_same(gv.render(tree, camera, shader, lighting=None), plain)


@pytest.mark.backend("cuda")
@pytest.mark.parametrize("lighting", LOOKS)
def test_on_cuda_nobody_waits_and_a_graph_is_the_frame(blobs, lighting):
    camera = gv.Camera.orbit(20, 30, 1.2, width=64, height=64)
    options = {"lighting": LOOKS[lighting]}
    shader = SURFACES["isosurface"]
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, device="cuda") as engine:
        whole = engine.render(camera, shader, **options)
        engine.frame(camera, shader, **options)
        graph = engine.capture(camera, shader, **options)
        with nobody_waits():
            frame, _ = engine.frame(camera, shader, **options)
            replayed, _ = graph.replay(camera)
        assert_same(frame, whole)
        assert_same(replayed, whole)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gv.Lighting(lights=(3,)), r"lights\[0\] must be a Headlight.*got int"),
        (lambda: gv.Lighting(lights=gv.Headlight()), "must be a sequence of lights, got Headlight"),
        (lambda: gv.Lighting(shadows=1.5), "shadows must be finite and >= 0 and <= 1"),
        (lambda: gv.Lighting(shadow_cones=0), "shadow_cones must be an int >= 1"),
        (lambda: gv.Lighting(occlusion=math.nan), "occlusion must be finite"),
        (lambda: gv.Lighting(indirect=-1), "indirect must be finite and >= 0"),
        (lambda: gv.Lighting(reach=0), "reach must be finite and > 0"),
        (lambda: gv.Lighting(ambient=(1, math.nan, 0)), "ambient must be finite"),
        (lambda: gv.Lighting(frame="moon"), "frame must be 'world' or 'box'"),
        (lambda: gv.DirectionalLight((0, -1, 0), angle=-1), "angle must be finite and >= 0"),
        (lambda: gv.DirectionalLight((0, -1, 0), angle=170), "angle must be .* <= 120"),
        (lambda: gv.PointLight((0, 0, 0), radius=math.nan), "radius must be finite"),
        (lambda: gv.PointLight((0, 0, 0), (1, -1, 1)), "color must be finite and >= 0"),
        (lambda: gv.RenderOptions(lighting=1), "lighting must be a Lighting, got int"),
    ],
)
def test_bad_light_has_one_clear_message(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_shader_without_normals_is_one_clear_error(blobs):
    tree, camera = gv.N3Tree.from_volume(blobs), gv.Camera.orbit(width=4, height=4)
    module = gv.TransferModule(SOLID, 1.0)
    for shader, kind in (
        (SOLID, "TransferFunction"),
        (gv.PreIntegrated(SOLID), "PreIntegrated"),
        (gv.Projection("maximum", SOLID), "Projection"),
        (gv.Features(SOLID, "value"), "Features"),
        (gv.ModuleShader(module), "ModuleShader"),
    ):
        with pytest.raises(ValueError, match=f"lighting needs normals.* got {kind}$") as caught:
            gv.render(tree, camera, shader, lighting=gv.Lighting())
        assert "\n" not in str(caught.value)
    colored = gv.Isosurface(0.5, SOLID, color_channel="value")
    gv.render(tree, camera, colored, lighting=gv.Lighting(occlusion=1))
    with pytest.raises(ValueError, match="indirect light needs a surface of one colour"):
        gv.render(tree, camera, colored, lighting=gv.Lighting(indirect=1))
