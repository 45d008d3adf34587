"""Voxels combined with another renderer's colour and depth, against closed forms, a marcher and
analytically rasterised planes.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers import DEVICES, marcher
from helpers.layers import BLUE, SOLID, ball, layer_of, plane_distances, seam_error
from helpers.pictures import FIELDS, GRAY, assert_same_picture, camera
from helpers.trees import copy_to
from helpers.waits import nobody_waits

import gvtorch as gv
from gvtorch.base import constants as config
from gvtorch.ops import unavailable
from gvtorch.tracing import pixels

HAZE = gv.TransferFunction.from_points([(0, 0.03)], [(0, 0.9, 0.5, 0.2)])


def middle(volume: gv.Volume) -> torch.Tensor:
    return gv.N3Tree.from_volume(volume).box.mean(0)


@pytest.fixture
def fog() -> gv.Volume:
    """One value everywhere."""
    return gv.Volume(torch.full((24, 24, 24), 0.5), spacing=(1.0, 1.0, 1.0))


@pytest.mark.parametrize("alpha", [None, 0.0, 0.4, 1.0])
def test_a_homogeneous_medium_has_its_closed_form(backend, fog, alpha):
    """exp(-length) before the layer, the layer, exp(-length) behind it; depths vary by pixel."""
    device = DEVICES[backend]
    tree = gv.N3Tree.from_volume(fog, device=device)
    view = camera(24, distance=1.8).placed(tree.box)
    depth = torch.rand(24, 24, 1, generator=torch.Generator().manual_seed(3)).double() * 90
    depth[:4] = math.inf
    opacity = None if alpha is None else torch.full_like(depth, alpha)
    layer = layer_of(depth, opacity)
    picture = gv.render(tree, view, HAZE, backend=backend, stop_alpha=1.0, layer=layer)
    rays, box = view.rays(), tree.box.cpu()
    a, b = (box[0] - rays.origin) / rays.direction, (box[1] - rays.origin) / rays.direction
    first, last = torch.fmin(a, b).amax(1), torch.fmax(a, b).amin(1)
    last = torch.maximum(first, last)
    cut = depth.reshape(-1).clamp(first, last)
    clear_1, clear_2 = 0.97 ** (cut - first), 0.97 ** (last - cut)
    coverage = (depth.reshape(-1) < math.inf) * (1.0 if alpha is None else alpha)
    body = torch.tensor([0.9, 0.5, 0.2], dtype=torch.float64)
    color = (1 - clear_1)[:, None] * body
    color = color + (clear_1 * coverage)[:, None] * torch.tensor(BLUE, dtype=torch.float64)
    color = color + (clear_1 * (1 - coverage) * (1 - clear_2))[:, None] * body
    total = 1 - clear_1 * (1 - coverage) * clear_2
    total = torch.where((coverage == 1), torch.ones_like(total), total)
    assert (picture.color.cpu().reshape(-1, 3) - color).abs().max() < 2e-6
    assert (picture.alpha.cpu().reshape(-1) - total).abs().max() < 2e-6
    assert 0.2 < float(clear_1.min()) < 0.8, "the test must see something"


@pytest.mark.parametrize("alpha", [None, 0.35])
def test_a_volume_is_cut_as_a_dense_marcher_cuts_it(backend, blobs, alpha):
    device, step = DEVICES[backend], 1.1
    tree = gv.N3Tree.from_volume(blobs, device=device)
    view = camera(32, distance=1.6).placed(tree.box)
    depth = plane_distances(view, middle(blobs), (0.3, 0.2, 1.0))
    opacity = None if alpha is None else torch.full_like(depth, alpha)
    layer = layer_of(depth, opacity)
    picture = gv.render(
        tree, view, GRAY, backend=backend, lod="finest", step=step, stop_alpha=1.0, layer=layer
    )
    rays, cut = view.rays(), depth.reshape(-1).numpy()
    dense = (
        *(blobs.data[..., 0].double().numpy(), blobs.spacing, blobs.origin),
        *((rays.origin.numpy(), rays.direction.numpy()), GRAY, GRAY.reference or 0.8),
    )
    front, front_alpha, _ = marcher.march(*dense, step=step * 0.8, last=cut)
    behind, behind_alpha, _ = marcher.march(*dense, step=step * 0.8, first=cut)
    solid = np.isfinite(cut) * (1.0 if alpha is None else alpha)
    clear = 1 - front_alpha
    color = front + (clear * solid)[:, None] * np.array(BLUE)
    color += (clear * (1 - solid))[:, None] * np.where(np.isfinite(cut)[:, None], behind, 0)
    total = 1 - clear * (1 - solid) * np.where(np.isfinite(cut), 1 - behind_alpha, 1)
    errors = (
        np.abs(picture.color.cpu().reshape(-1, 3).numpy() - color).max(),
        np.abs(picture.alpha.cpu().reshape(-1).numpy() - total).max(),
    )
    assert max(errors) < 5e-3, f"largest errors of colour and alpha: {errors}"
    assert front_alpha.max() > 0.5 and behind_alpha.max() > 0.5, "the test must see something"


def test_alpha_of_one_is_opaque_and_of_zero_nothing(compiled, blobs):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    view = camera(32).placed(tree.box)
    depth = plane_distances(view, middle(blobs), (0, 0, 1))
    plain = gv.render(tree, view, GRAY)
    solid = gv.render(tree, view, GRAY, layer=layer_of(depth))
    full = gv.render(tree, view, GRAY, layer=layer_of(depth, torch.ones_like(depth)))
    assert_same_picture(full, solid)
    assert torch.equal(full.nearest, solid.nearest) and bool((solid.alpha == 1).any())
    assert not torch.equal(plain.color, solid.color)
    for nothing in (
        layer_of(torch.full_like(depth, math.inf)),
        layer_of(depth, torch.zeros_like(depth)),
        layer_of(torch.full_like(depth, math.inf), torch.ones_like(depth)),
    ):
        picture = gv.render(tree, view, GRAY, layer=nothing)
        assert_same_picture(picture, plain)
        assert torch.equal(picture.nearest, plain.depth)


def test_normals_count_by_what_each_part_takes_of_the_light(compiled, blobs):
    tree = copy_to(gv.N3Tree.from_volume(blobs, 8), DEVICES[compiled])
    view = gv.Camera.orbit(30, 20, 1.3, width=24, height=20).placed(tree.box)
    far = float((tree.box.mean(0) - view.rays().origin[0]).norm())
    shader, color = gv.Lit(GRAY), torch.zeros(20, 24, 3)
    alone = gv.render(tree, view, shader)
    layers = {
        alpha: gv.Layer(color, torch.full((20, 24, 1), far), torch.full((20, 24, 1), alpha))
        for alpha in (0.0, 0.4)
    }
    clear = gv.render(tree, view, shader, layer=layers[0.0])
    assert torch.equal(clear.normal, alone.normal) and alone.normal.any()
    mixed = gv.render(tree, view, shader, layer=layers[0.4], stop_alpha=1.0)
    rays = view.rays(tree.device)
    near, behind = rays.range.clone(), rays.range.clone()
    near[:, 1] = behind[:, 0] = far
    front, back = (
        gv.trace(tree, dataclasses.replace(rays, range=part), shader, stop_alpha=1.0)
        for part in (near, behind)
    )
    share = (1 - front.alpha) * (1 - 0.4) * back.alpha
    both = front.normal * front.alpha + back.normal * share
    expected = torch.nn.functional.normalize(both, dim=1).view(20, 24, 3)
    torch.testing.assert_close(mixed.normal, expected, rtol=0, atol=1e-5)
    assert (mixed.normal - alone.normal).abs().max() > 0.01


def behind_nodes(tree: gv.N3Tree, point: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    """Returns (t, n) bool: true for nodes that lie completely behind a plane."""
    pointers = tree.nodes.child_tn
    loc = tree.loc(torch.arange(pointers.numel()))
    size = tree.place[1] / float(tree.branching) ** loc[:, 3:].double()
    near = tree.place[0] + (loc[:, :3] + (normal < 0)) * size  # the corner nearest to the camera
    return (((near - point) @ normal) > 0).view_as(pointers)


@pytest.mark.parametrize("backend_name", ["reference", "cpp"])
@pytest.mark.parametrize("lod", ["finest", "auto"])
def test_nothing_behind_an_opaque_layer_is_used_or_asked_for(blobs, backend_name, lod):
    if unavailable()[backend_name]:
        pytest.skip(unavailable()[backend_name])
    whole = gv.N3Tree.from_volume(blobs, 4)
    bare = copy_to(whole, "cpu")
    leaf = whole.nodes.loc_t4[:, 3:] == whole.depth
    bare.nodes.brick_tn[(bare.nodes.brick_tn >= 0) & leaf] = config.ABSENT
    side = 24 if backend_name == "reference" else 32
    view = camera(side, distance=1.5).placed(whole.box)
    normal = -torch.tensor([0.469846, 0.342020, 0.813798], dtype=torch.float64)  # towards the box
    point = middle(blobs)
    depth = plane_distances(view, point, tuple(normal.tolist()))
    behind = behind_nodes(whole, point, normal)
    thin = torch.full_like(depth, 0.5)
    options = {"backend": backend_name, "lod": lod, "step": 2.5}  # the twin's time is its steps'
    seen = {}
    for name, layer in (
        ("none", None),
        ("opaque", layer_of(depth)),
        ("alpha 1", layer_of(depth, torch.ones_like(depth))),
        ("translucent", layer_of(depth, thin)),
    ):
        used, asked = copy_to(whole, "cpu"), copy_to(bare, "cpu")
        gv.render(used, view, GRAY, layer=layer, **options)
        gv.render(asked, view, GRAY, layer=layer, **options)
        brick = used.nodes.brick_tn
        stamped = (brick >= 0) & (used.bricks.stamp_b[brick.clamp(min=0).long()] == used.frame)
        marked = asked.nodes.request_tn != 0
        passed = (used.nodes.stamp_t == used.frame)[:, None] & (used.nodes.loc_t4[:, 3:] > 0)
        parents = behind.flatten()[used.nodes.parent_t.clamp(min=0).long()][:, None]
        seen[name] = [int((marks & behind).sum()) for marks in (stamped, marked)]
        seen[name] += [int((passed & parents).sum())]
        assert (stamped & ~behind).any() and (marked & ~behind).any(), "the test must see something"
    assert seen["opaque"] == seen["alpha 1"] == [0, 0, 0]
    assert min(seen["none"]) > 0
    for through, alone in zip(seen["translucent"], seen["none"], strict=True):
        assert through > 0.8 * alone, "behind it, samples lie elsewhere, but all is asked for"


def test_depth_goes_out(compiled, fog):
    """`depth` is that of the voxels, as far as rays see them; `nearest` includes the layer."""
    tree = gv.N3Tree.from_volume(fog, device=DEVICES[compiled])
    view = gv.Camera.look_at((11.5, 11.5, 60), (11.5, 11.5, 0), fov=10, width=8, height=8)
    shader = gv.TransferFunction.from_points([(0, 0.5)])
    cosine = view.rays().direction[:, 2].neg().reshape(8, 8, 1)
    first = (60 - 23.5) / cosine
    plain = gv.render(tree, view, shader)
    torch.testing.assert_close(plain.nearest, plain.depth, rtol=0, atol=0)
    surface = plain.depth.double().cpu()
    assert ((surface - first).abs() < 0.3).all()
    nothing = torch.full_like(surface, math.inf)
    for near, expected in ((first - 3, nothing), (first + 20, surface)):
        picture = gv.render(tree, view, shader, layer=layer_of(near))
        depth = picture.depth.double().cpu()
        torch.testing.assert_close(depth, expected, rtol=0, atol=5e-3)
        both = torch.minimum(depth, near)
        torch.testing.assert_close(picture.nearest.double().cpu(), both, rtol=1e-6, atol=0)
        thin = torch.full_like(near, 0.01)  # voxels behind a translucent layer are seen
        picture = gv.render(tree, view, shader, layer=layer_of(near, thin))
        torch.testing.assert_close(picture.depth.double().cpu(), surface, rtol=0, atol=5e-3)
        nearer = torch.minimum(surface, near)
        torch.testing.assert_close(picture.nearest.double().cpu(), nearer, rtol=0, atol=5e-3)


def test_batches_and_blocks_of_rays_change_nothing(monkeypatch, blobs):
    tree = gv.N3Tree.from_volume(blobs)
    cameras = gv.Camera.orbit([0, 70, 200], 20, 1.7, width=24, height=18).placed(tree.box)
    depth = torch.stack([plane_distances(cameras[i], middle(blobs), (0.2, 0, 1)) for i in range(3)])
    for alpha in (None, 0.5 * torch.ones_like(depth)):
        layer = layer_of(depth, alpha)
        monkeypatch.setattr(pixels, "_RAYS_PER_BLOCK", 1 << 16)
        whole = gv.render(tree, cameras, GRAY, layer=layer)
        monkeypatch.setattr(pixels, "_RAYS_PER_BLOCK", 24 * 7)  # blocks that span cameras
        assert_same_picture(gv.render(tree, cameras, GRAY, layer=layer), whole)
        for i in range(3):
            single_layer = layer_of(depth[i], None if alpha is None else alpha[i])
            alone = gv.render(tree, cameras[i], GRAY, layer=single_layer)
            for name in (*FIELDS, "nearest"):
                assert torch.equal(getattr(alone, name), getattr(whole, name)[i]), name


@pytest.mark.parametrize("loading", ["straight", "levels"])
@pytest.mark.parametrize("alpha", [None, 0.4])
def test_streamed_pictures_are_those_of_the_whole(compiled, blobs, alpha, loading):
    """In several passes over rays that missed something, in pools for half of the bricks."""
    device = DEVICES[compiled]
    tree = gv.N3Tree.from_volume(blobs, 4, device=device)
    view = camera(32, distance=1.2).placed(tree.box)
    depth = plane_distances(view, middle(blobs), (0.3, 0.3, 1))
    layer = layer_of(depth, None if alpha is None else torch.full_like(depth, alpha))
    whole = gv.render(tree, view, GRAY, layer=layer)
    pool = whole.stats.bricks_used // 2 * 6**3 * 4
    options = {"brick_size": 4, "brick_pool": pool, "device": device, "loading": loading}
    with gv.Engine(gv.VolumeProducer(blobs), **options) as engine:
        picture = engine.render(view, GRAY, layer=layer)
        engine.validate()
        assert picture.stats.converged and picture.stats.frames > 2
        assert_same_picture(picture, whole)
        assert torch.equal(picture.nearest, whole.nearest)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, device=device) as engine:
        for _ in range(20):
            picture, stats = engine.frame(view, GRAY, layer=layer)
            if stats.converged:
                break
        assert_same_picture(picture, whole)


@pytest.mark.backend("cpp")
def test_tensors_are_read_where_they_lie(blobs):
    tree = gv.N3Tree.from_volume(blobs)
    view = camera(24).placed(tree.box)
    depth = plane_distances(view, middle(blobs), (0, 0, 1))
    color = torch.zeros(24, 24, 3)
    layer = gv.Layer(color, depth)
    dark = gv.render(tree, view, GRAY, layer=layer).color
    color += 1
    assert (gv.render(tree, view, GRAY, layer=layer).color - dark).max() > 0.99
    depth[:12] = math.nan  # later edits are not checked: NaN counts as no layer
    plain, picture = gv.render(tree, view, GRAY), gv.render(tree, view, GRAY, layer=layer)
    for name in (*FIELDS, "nearest"):
        assert torch.equal(getattr(picture, name)[:12], getattr(plain, name)[:12]), name


@pytest.mark.backend("cuda")
@pytest.mark.parametrize("alpha", [None, 0.4])
def test_on_cuda_nobody_waits_and_a_graph_reads_the_layer(blobs, alpha):
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, device="cuda") as engine:
        view = camera(64).placed(engine.box)
        depth = plane_distances(view, middle(blobs), (0, 0, 1)).to(engine.device)
        layer = layer_of(depth, None if alpha is None else torch.full_like(depth, alpha))
        engine.render(view, GRAY)
        for move in (5, -5):  # bricks for rays that begin there are loaded, too
            depth += move
            engine.render(view, GRAY, layer=layer)
        graph = engine.capture(view, GRAY, layer=layer)
        with nobody_waits():
            engine.frame(view, GRAY, layer=layer)
            depth += 5
            replayed, _ = graph.replay(view)
        expected, _ = engine.frame(view, GRAY, layer=layer)
        assert_same_picture(replayed, expected)
        assert torch.equal(replayed.nearest, expected.nearest)
        host = gv.Layer(*(None if t is None else t.cpu() for t in vars(layer).values()))
        assert_same_picture(engine.frame(view, GRAY, layer=host)[0], expected)
        with pytest.raises(ValueError, match=r"capture: layer must lie on cuda:0, .* got cpu"):
            engine.capture(view, GRAY, layer=host)


@pytest.mark.parametrize("tilt", [0.0, 25.0])
def test_the_seam_of_a_plane_and_a_ball_is_exact_to_a_pixel(compiled, tilt):
    radius, height = 20.0, 12.0
    tree = gv.N3Tree.from_volume(ball(radius, 48), device=DEVICES[compiled])
    angle = math.radians(tilt)
    eye = (160 * math.sin(angle), 0.0, 160 * math.cos(angle))
    view = gv.Camera.look_at(eye, (0, 0, height), fov=20, width=160, height=160)
    layer = layer_of(plane_distances(view, torch.tensor([0, 0, height]).double(), (0, 0, 1.0)))
    picture = gv.render(tree, view, SOLID, layer=layer, step=0.1, lod="finest")
    error = seam_error(picture, view, height, radius)
    print(f"seam: {error:.3f} pixels")
    assert error <= 1.0


def test_what_is_wrong_is_named(blobs):
    color, depth = torch.zeros(18, 24, 3), torch.ones(18, 24, 1)
    gone, back, bright = depth.clone(), depth.clone(), color.clone()
    gone[3, 4], back[3, 4], bright[3, 4] = math.nan, -2.0, math.inf
    for parts, message in (
        ((color, gone), "Layer: depth must be >= 0, .* got NaN"),
        ((color, back), "Layer: depth must be >= 0, .* got -2"),
        ((bright, depth), "Layer: color must be finite"),
        ((color, depth, depth * 2), "Layer: alpha must be finite and >= 0 and <= 1"),
        ((color, depth, gone), "Layer: alpha must be finite"),
        ((color, depth[:9]), r"Layer: depth must have the pixels of color, \(18, 24, 3\)"),
        ((color, depth[..., 0]), r"Layer: depth must be \(h, w, 1\) or \(n, h, w, 1\) floats"),
        ((color, depth.int()), r"Layer: depth must be .* floats, got \(18, 24, 1\) int32"),
        ((color[..., :2], depth), r"Layer: color must be \(h, w, 3\)"),
        ((color, None), "Layer: depth must be .* got NoneType"),
    ):
        with pytest.raises(ValueError, match=message):
            gv.Layer(*parts)
    layer, tree = gv.Layer(color, depth), gv.N3Tree.from_volume(blobs)
    with gv.Engine(gv.VolumeProducer(blobs)) as engine:
        for call in (
            lambda view, what: gv.render(tree, view, GRAY, layer=what),
            lambda view, what: engine.frame(view, GRAY, layer=what),
            lambda view, what: engine.render(view, GRAY, layer=what),
        ):
            for view in (camera(24), gv.Camera.orbit([0, 1], width=24, height=18)):
                with pytest.raises(ValueError, match=r"layer must have the camera's \(.*\) pixels"):
                    call(view, layer)
            with pytest.raises(ValueError, match="layer must be a Layer, got Tensor"):
                call(gv.Camera.orbit(width=24, height=18), color)
