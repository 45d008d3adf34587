"""`Clip`: which pieces of a ray it keeps, that the rest costs nothing, and its caps."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.clips import CLIPS, inside, is_kept, turned_box
from helpers.rays import camera_rays, rays_along
from helpers.traces import SHADER, assert_equal, trace
from helpers.trees import with_holes

import gvtorch as gv
from gvtorch.tracing.clip import Clipped

UNIT = torch.tensor([[-0.5] * 3, [0.5] * 3], dtype=torch.float64)


def rays_through(count: int, seed: int) -> gv.Rays:
    generator = torch.Generator().manual_seed(seed)
    origin, to = torch.rand(2, count, 3, generator=generator, dtype=torch.float64) * 4 - 2
    direction = to * 0.3 - origin
    direction[0] = torch.tensor([0.0, 0.0, 1.0])
    return rays_along(origin, direction)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("boxes", range(4))
@pytest.mark.parametrize("cuts", range(4))
def test_pieces_hold_what_is_kept_and_nothing_else(boxes, cuts, seed):
    generator = np.random.default_rng([boxes, cuts, seed])

    def some(count: int, scale: float) -> list:
        turned = []
        for _ in range(count):
            centre = tuple(generator.uniform(-0.6, 0.6, 3))
            if generator.random() < 0.5:
                turned.append(
                    turned_box(generator.uniform(0, 90), scale * generator.uniform(0.3, 1), centre)
                )
            else:
                half = scale * generator.uniform(0.1, 0.6, 3)
                turned.append((np.array(centre) - half, np.array(centre) + half))
        return [box if isinstance(box, torch.Tensor) else tuple(map(tuple, box)) for box in turned]

    kept, cut, plane = some(boxes, 1.0), some(cuts, 0.6), (0.3, -0.4, 0.5, 0.6)
    clip = gv.Clip(planes=[plane], boxes=kept, without=cut)
    rays = rays_through(80, seed)
    pieces = (
        Clipped(lambda _: None, clip, UNIT, step=0.1, depth_alpha=0.1).meet(rays).pieces(rays.range)
    )
    assert len(pieces) == max(1, boxes) + cuts
    spans = torch.stack(pieces).numpy()  # (k, r, 2)
    assert (spans[..., 0] <= spans[..., 1]).all()
    t = np.arange(0.0005, 5, 0.013)
    positions = rays.origin.numpy()[:, None] + t[:, None] * rays.direction.numpy()[:, None]
    flat = positions.reshape(-1, 3)
    expected = is_kept(clip, flat)
    within = (spans[..., :1] < t) & (t < spans[..., 1:])  # (k, r, t)
    assert (within.sum(0) <= 1).all(), "pieces do not overlap"
    assert np.array_equal(within.any(0).ravel(), expected)
    real = spans[..., 0] < spans[..., 1]
    for near, far in itertools.pairwise(spans):  # nearest first, none that touch
        both = (near[:, 0] < near[:, 1]) & (far[:, 0] < far[:, 1])
        assert (near[both, 1] < far[both, 0]).all()
    assert expected.any() and real.any()


def test_boxes_that_touch_are_one_piece():
    clip = gv.Clip(boxes=[((-1, -1, -1), (0.3, 1, 1)), ((0.3, -1, -1), (1, 1, 1))], frame="box")
    box = torch.tensor([[3.0, 4, 5], [3.7, 5.3, 5.9]], dtype=torch.float64)
    rays = rays_through(100, 1)
    rays = dataclasses.replace(rays, origin=rays.origin + torch.tensor([3.3, 4.6, 5.4]))
    first, second = (
        Clipped(lambda _: None, clip, box, step=0.1, depth_alpha=0.1).meet(rays).pieces(rays.range)
    )
    assert (first[:, 0] < first[:, 1]).sum() > 50
    assert torch.equal(second[:, 0], second[:, 1])


@pytest.mark.parametrize("caps", [False, True])
@pytest.mark.parametrize("name", CLIPS)
def test_compiled_equals_reference_clipped(blobs, compiled, name, caps):
    tree = gv.N3Tree.from_volume(blobs, 4)
    clip = dataclasses.replace(CLIPS[name], caps=caps)
    rays, step = camera_rays(tree, distance=1.2), 2.3  # in voxels: the twin's time
    result, *_ = assert_equal(tree, compiled, rays, clip=clip, step=step)
    whole, _ = trace(tree, compiled, rays, step=step)
    assert 0.3 < result["alpha"].max() and 0.05 < (whole["alpha"] - result["alpha"]).abs().max()


EVEN = gv.Volume(torch.full((37, 29, 45), 0.5), (1.0, 0.8, 1.5), (5.0, -3.0, 2.0))


@functools.cache
def closed_form(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns alphas and depths (r,) of a medium that absorbs a hundredth of the light per unit:
    alpha follows from the length that is kept, depth from where that length suffices.
    """
    tree = gv.N3Tree.from_volume(EVEN, 8)
    rays, step = camera_rays(tree, 20, distance=1.2), 0.01
    t = 20 + step * (np.arange(10000) + 0.5)
    positions = rays.origin.numpy()[:, None] + t[:, None] * rays.direction.numpy()[:, None]
    low, high = tree.box.numpy()
    kept = ((positions >= low) & (positions <= high)).all(-1)
    kept &= is_kept(CLIPS[name], positions.reshape(-1, 3)).reshape(kept.shape)
    length = step * kept.cumsum(1)
    enough = length >= math.log(0.9) / math.log(0.99)
    return 1 - 0.99 ** length[:, -1], np.where(enough.any(1), t[enough.argmax(1)], np.inf)


@pytest.mark.parametrize("lod", ["finest", "auto"])
@pytest.mark.parametrize("name", CLIPS)
def test_a_medium_of_one_value_has_its_closed_form(backend, name, lod):
    tree = gv.N3Tree.from_volume(EVEN, 8, device=DEVICES[backend])
    shader = gv.TransferFunction.from_points([(0, 0.01)], [(0, 1, 0.5, 0.2)], reference=1.0)
    rays = camera_rays(tree, 20, distance=1.2)
    options = {"clip": CLIPS[name], "stop_alpha": 1.0, "lod": lod, "backend": backend}
    options["step"] = 3.0  # the form holds for any
    hits = gv.trace(tree, rays.to(tree.device), shader, **options)
    alpha, depth = closed_form(name)
    np.testing.assert_allclose(hits.alpha[:, 0].cpu(), alpha, atol=6e-4)
    np.testing.assert_allclose(
        hits.color.cpu(), alpha[:, None] * np.array([1, 0.5, 0.2]), atol=6e-4
    )
    sure = np.abs(alpha - 0.1) > 1e-3
    actual = hits.depth[:, 0].cpu().numpy()
    assert np.array_equal(np.isfinite(actual)[sure], np.isfinite(depth)[sure])
    both = sure & np.isfinite(depth)
    np.testing.assert_allclose(actual[both], depth[both], atol=0.1)
    assert both.sum() > 20


@pytest.fixture(scope="module")
def marks_of_trees(blobs):
    """A tree, by clip's name what it cuts off wholly, and by backend and clip the marks in it, and
    in one with holes, of a haze.
    """
    thin = gv.TransferFunction.from_points([(0, 0.001), (1, 0.002)])
    tree = gv.N3Tree.from_volume(blobs, 2)
    poor = with_holes(tree, 0.4, 7)

    @functools.cache
    def marks(backend: str, clip: gv.Clip | None = None) -> list[dict[str, torch.Tensor]]:
        rays = camera_rays(tree, 12 if backend == "reference" else 60, distance=1.1)
        options = {"lod": "finest", "step": 2.0} | ({"clip": clip} if clip else {})
        return [trace(seen, backend, rays, thin, **options)[1] for seen in (tree, poor)]

    return functools.cache(lambda name: wholly_clipped(tree, CLIPS[name])), tree, marks


@pytest.mark.parametrize("name", CLIPS)
def test_nothing_that_is_clipped_is_sampled_or_asked_for(marks_of_trees, backend, name):
    """Checked by the stamps of bricks and tiles, and by the nodes that have a request."""
    clip = dataclasses.replace(CLIPS[name], caps=True)
    gone_of, tree, marks_of = marks_of_trees
    gone = gone_of(name)
    assert len(gone) > 50, "the test must clip something"
    (whole, poor_whole), (marks, poor) = marks_of(backend), marks_of(backend, clip)
    brick, parent = tree.nodes.brick_tn.flatten().tolist(), tree.nodes.parent_t.tolist()
    for used, sees_gone in ((whole, True), (marks, False)):
        stamps, stamp_of_tile = used["brick"].tolist(), used["tile"].tolist()
        bricks = {n for n in gone if brick[n] >= 0 and stamps[brick[n]] == 1}
        tiles = {t for t, n in enumerate(parent) if n in gone and stamp_of_tile[t] == 1}
        assert bool(bricks) == sees_gone and bool(tiles) == sees_gone
    assert (marks["brick"] == 1).sum() > 10
    requested, of_whole = (
        set(each["request"].flatten().nonzero()[:, 0].tolist()) for each in (poor, poor_whole)
    )
    assert requested and not requested & gone
    assert of_whole & gone


def wholly_clipped(tree: gv.N3Tree, clip: gv.Clip) -> set[int]:
    """Returns the nodes whose box, slightly shrunk, lies beyond a plane, in a box that is cut away,
    or outside of every box that is kept, beyond one of its faces.
    """
    n, size = tree.branching, np.array(tree.spacing) * tree.side
    loc, child = tree.nodes.loc_t4.numpy()[:, None], np.arange(n**3)
    depth = np.broadcast_to(loc[..., 3], (len(loc), n**3))
    position = loc[..., :3] * n + np.stack((child % n, child // n % n, child // n**2), -1)
    bits = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)]) * 0.998 + 0.001
    cell = size / float(n) ** depth[..., None, None]
    corners = tree.box[0].numpy() + (position[:, :, None] + bits) * cell  # (t, n^3, 8, 3)
    beyond = np.zeros(depth.shape, bool)
    for *normal, offset in clip.planes:
        beyond |= (corners @ np.array(normal) + offset < 0).all(-1)
    flat = corners.reshape(-1, 3)
    for box in clip.without:
        beyond |= inside(box, flat).reshape(corners.shape[:3]).all(-1)
    if clip.boxes:
        beyond |= np.all([beside(box, corners) for box in clip.boxes], 0)
    return set(np.flatnonzero(beyond & (depth >= 1)).tolist())


def beside(box, corners: np.ndarray) -> np.ndarray:
    """Returns (t, n): true if all corners (t, n, 8, 3) of a node lie beyond one face of the box."""
    if len(box) == 2:
        (low, high), local = np.array(box), corners
    else:
        local = (corners - box[:3, 3].numpy()) @ np.linalg.inv(box[:3, :3].numpy()).T
        low, high = 0, 1
    return (local < low).all(-2).any(-1) | (local > high).all(-2).any(-1)


def test_a_ray_that_has_ended_takes_no_sample_behind_a_gap(backend):
    volume = gv.Volume(torch.linspace(0.9, 1, 32).expand(32, 32, 32).contiguous())
    tree = gv.N3Tree.from_volume(volume, 8, device=DEVICES[backend])
    shader = gv.TransferFunction.from_points([(0, 0.9), (1, 0.9)])
    near = gv.Clip(boxes=[((-1, -1, 20), (40, 40, 40))])
    both = gv.Clip(boxes=[((-1, -1, 20), (40, 40, 40)), ((-1, -1, -1), (40, 40, 10))])
    camera = gv.Camera.orbit(0, 0, 2.0, 20, 8, 8)
    first, second = (gv.render(tree, camera, shader, clip=c, backend=backend) for c in (near, both))
    assert first.stats.samples == second.stats.samples > 0
    assert torch.equal(first.color, second.color)


CUT = gv.Clip(planes=[(0, 0, -1, 20.0)], caps=True, cap_light=0.6)  # what lies at z > 20 is gone


@pytest.mark.parametrize("opacity", [1.0, 0.25])
def test_a_cap_has_the_colour_of_the_cut_and_faces_the_eye(backend, opacity):
    """Lambert shading with a headlight on a plane, at the cut: colour * (1 - s + s cos)."""
    data = torch.zeros(32, 32, 32)
    data[:, :, 16:] = 1.0  # empty on the left, solid on the right
    tree = gv.N3Tree.from_volume(gv.Volume(data), 8, device=DEVICES[backend])
    shader = gv.TransferFunction.from_points([(0, 0), (0.9, 0), (1, 0.02)], [(0, 1, 0.5, 0.2)])
    clip = dataclasses.replace(CUT, cap_opacity=opacity)
    camera = gv.Camera.orbit(20, 30, 2.2, 30, 32, 32)
    options = {"lod": "finest", "backend": backend, "stop_alpha": 1.0}
    cap = gv.render(tree, camera, shader, clip=clip, **options)
    bare = gv.render(tree, camera, shader, clip=dataclasses.replace(clip, caps=False), **options)
    rays = camera.placed(tree.box).rays()
    t = (20 - rays.origin[:, 2]) / rays.direction[:, 2]
    hit = rays.origin + t[:, None] * rays.direction
    margin = 1.0
    face = ((hit[:, :2] > -0.5 + margin) & (hit[:, :2] < 31.5 - margin)).all(1)
    solid, empty = face & (hit[:, 0] > 17.5), face & (hit[:, 0] < 10)
    assert solid.sum() > 20 and empty.sum() > 20
    light = 1 - 0.6 + 0.6 * rays.direction[:, 2].abs()
    rgb = torch.tensor([1, 0.5, 0.2], dtype=torch.float64)
    color, alpha, depth = (
        getattr(cap, n).cpu().double().flatten(0, 1) for n in ("color", "alpha", "depth")
    )
    behind = bare.alpha.cpu().double().flatten(0, 1)
    expected = opacity * light[:, None] * rgb + (1 - opacity) * behind * rgb
    torch.testing.assert_close(color[solid], expected[solid], rtol=0, atol=2e-3)
    torch.testing.assert_close(
        alpha[solid], (opacity + (1 - opacity) * behind)[solid], rtol=0, atol=1e-5
    )
    torch.testing.assert_close(depth[solid, 0], t[solid], rtol=0, atol=1e-4)
    torch.testing.assert_close(alpha[empty], behind[empty], rtol=0, atol=1e-6)


def test_a_cap_has_features_and_a_normal(backend):
    """A solid's second channel holds 7 and 3: its cap shows them, and its normal faces the eye."""
    value = torch.rand(24, 24, 24, generator=torch.Generator().manual_seed(5)) * 0.1 + 0.5
    pair = torch.tensor([7.0, 3.0]).expand(24, 24, 24, 2)
    volumes = {"value": gv.Volume(value), "pair": gv.Volume(pair)}
    tree = gv.N3Tree.from_volume(volumes, 8, device=DEVICES[backend])
    thin = gv.TransferFunction.from_points([(0, 0.02)])
    camera = gv.Camera.orbit(0, 0, 2.0, None, 20, 20, "ortho")
    inside = camera.placed(tree.box).rays().origin[:, :2] - 11.5
    inside = (inside.abs() < 11).all(1).view(20, 20)
    options = {"clip": gv.Clip(planes=[(0, 0, -1, 15.0)], caps=True), "backend": backend}
    features = gv.render(tree, camera, gv.Features(thin, "pair"), **options).features.cpu()
    torch.testing.assert_close(features[inside], pair[0, 0, 0].expand_as(features[inside]))
    normal = gv.render(tree, camera, gv.Lit(thin), **options).normal.cpu()
    torch.testing.assert_close(
        normal[inside], torch.tensor([0.0, 0, 1]).expand(normal[inside].shape)
    )


@functools.cache
def ball_of_radius_11(device: str) -> tuple[gv.N3Tree, torch.Tensor]:
    """Returns a tree with the channels of all kinds of surfaces, and their colour."""
    axis = torch.arange(40.0) - 19.5
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    radius = (x * x + y * y + z * z).sqrt()
    base = torch.tensor([0.2, 0.4, 0.6])
    sided = torch.cat((torch.where(x[..., None] < 0, 0.0, base), torch.ones_like(x[..., None])), -1)
    channels = {"distance": radius - 11, "height": 20 - radius, "x": x, "rgba": 0.5 * sided}
    volumes = {name: gv.Volume(data) for name, data in channels.items()}
    return gv.N3Tree.from_volume(volumes, 8, device=device), base


@pytest.mark.parametrize("opacity", [1.0, 0.5])
@pytest.mark.parametrize("kind", ["isosurface", "by function", "by voxel", "distance field"])
def test_a_cut_through_a_surface_is_filled(backend, kind, opacity):
    """Half a ball of radius 11, seen from the cut: a disc, and behind it the inside of the ball."""
    tree, base = ball_of_radius_11(DEVICES[backend])
    shading = {"light": gv.DirectionalLight((0, 0, 1)), "ambient": 1.0, "specular": 0.0}
    shading["diffuse"] = 0.0  # the surface behind has the same colour everywhere
    options = {"backend": backend, "background": None, "channel": "height", "step": 2.0}
    if kind == "isosurface":
        shader = gv.Isosurface(9.0, base, **shading)
    elif kind == "by voxel":
        stored = {"color_channel": "rgba", "premultiplied": True}
        shader = gv.Isosurface(9.0, None, **stored, **shading)
    elif kind == "by function":
        sides = gv.TransferFunction.from_points([(0, 1)], [(-1, 0, 0, 0), (1, *base.tolist())])
        shader = gv.Isosurface(9.0, sides, color_channel="x", **shading)
    else:
        shader, options["channel"] = gv.DistanceField(base, **shading), "distance"
    cut = {"planes": [(0, 0, -1, 0)], "frame": "box", "cap_light": 1.0}
    clip = gv.Clip(**cut, caps=True, cap_opacity=opacity)
    camera = gv.Camera.orbit(0, 0, 1.6, None, 48, 48, "ortho")
    clipped = gv.render(tree, camera, shader, clip=clip, **options)
    bare = gv.render(tree, camera, shader, clip=gv.Clip(**cut), **options)
    origin = camera.placed(tree.box).rays().origin[:, :2] - 19.5
    off = origin.norm(dim=1).reshape(48, 48) - 11
    inside, outside = off < -0.1, off > 0.1
    right = origin[:, 0].reshape(48, 48) > 1.1
    color, depth = clipped.color.cpu(), clipped.depth.cpu()[..., 0]
    assert bool((clipped.alpha.cpu()[inside] == 1).all()) and not clipped.alpha.cpu()[outside].any()
    if kind.startswith("by "):
        inside = inside & right
        assert not color[~right & (origin[:, 0].reshape(48, 48) < -1.1)].any()
    torch.testing.assert_close(color[inside], base.expand_as(color[inside]))
    torch.testing.assert_close(depth[inside], torch.full_like(depth[inside], 1.6 * 40))
    assert bool((bare.depth.cpu()[..., 0][inside] > 1.6 * 40 + 1).all()), "an open shell"


def test_what_is_not_cut_has_no_cap(backend):
    """The camera looks at faces of the volume, and the cut is on the far side."""
    tree = gv.N3Tree.from_volume(gv.Volume(torch.rand(16, 16, 16)), 8, device=DEVICES[backend])
    clip = gv.Clip(planes=[(0, 0, 1, -4.0)])
    camera = gv.Camera.orbit(10, 10, 2.2, 30, 12, 12)
    bare, cap = (
        gv.render(tree, camera, SHADER, backend=backend, clip=dataclasses.replace(clip, caps=caps))
        for caps in (False, True)
    )
    torch.testing.assert_close(cap.color, bare.color, rtol=0, atol=1e-6)
    assert cap.stats.samples == bare.stats.samples


def test_the_face_that_is_shaded_is_the_one_that_was_crossed():
    """A corner is cut away: each ray through it leaves it by one of three faces."""
    clip = gv.Clip(without=[((0, 0, 0), (2, 2, 2))], frame="box")
    clipped = Clipped(lambda _: None, clip, UNIT, step=0.1, depth_alpha=0.1)
    origin = torch.tensor([[1.0, 0.9, 1.1]], dtype=torch.float64).expand(64, 3)
    to = torch.rand(64, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 0.5
    to[:22, 0], to[22:44, 1], to[44:, 2] = 0, 0, 0
    direction = torch.nn.functional.normalize(to - origin)
    limits = torch.tensor([0.0, torch.inf], dtype=torch.float64).expand(64, 2)
    rays = gv.Rays(origin=origin, direction=direction, cone=limits, range=limits)
    met = clipped.meet(rays)
    entry = met.pieces(rays.range)[0][:, 0]
    torch.testing.assert_close(entry, (to - origin).norm(dim=1))
    axis = torch.tensor([0] * 22 + [1] * 22 + [2] * 20)
    facing, normal = met.facing(entry)
    torch.testing.assert_close(normal, torch.eye(3, dtype=torch.float64)[axis])
    torch.testing.assert_close(facing, direction.gather(1, axis[:, None]).abs()[:, 0])


def test_the_engine_loads_only_what_is_kept(blobs, compiled):
    clip, camera = CLIPS["cut"], gv.Camera.orbit(width=24, height=24, distance=1.2)
    produced, pictures = [], []
    for region in (None, clip):
        engine = gv.Engine(
            *(gv.VolumeProducer(blobs),),
            brick_size=4,
            node_pool="1 MB",
            brick_pool="4 MB",
            device=DEVICES[compiled],
        )
        with engine:
            picture = engine.render(camera, SHADER, clip=region)
            assert picture.stats.converged
            produced.append(picture.stats.produced["bricks"])
            pictures.append(picture)
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    same = gv.render(tree, camera, SHADER, clip=clip)
    torch.testing.assert_close(pictures[1].color, same.color, rtol=0, atol=1e-6)
    assert produced[1] < produced[0]


def test_a_clip_is_for_each_of_several_trees(blobs, compiled):
    """Two volumes side by side, cut by one plane, look as each one alone."""
    other = gv.Volume(blobs.data, blobs.spacing, (60.0, -3.0, 2.0))
    scene = {"one": gv.VolumeProducer(blobs), "two": gv.VolumeProducer(other)}
    camera = gv.Camera.look_at((55, 10, 190), (55, 8, 29), fov=40, width=48, height=24)
    clip = gv.Clip(planes=[(0, 0, -1, 24.0)], caps=True)
    with gv.Engine(scene, node_pool="1 MB", brick_pool="8 MB", device=DEVICES[compiled]) as engine:
        both = engine.render(camera, SHADER, clip=clip)
    alone = [
        gv.render(gv.N3Tree.from_volume(v, device=DEVICES[compiled]), camera, SHADER, clip=clip)
        for v in (blobs, other)
    ]
    torch.testing.assert_close(both.color, alone[0].color + alone[1].color, rtol=0, atol=1e-5)
    assert both.alpha[:, :24].max() > 0.9 and both.alpha[:, 24:].max() > 0.9


def test_without_clip_and_lens_pictures_keep_every_bit(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    camera = gv.Camera.orbit(width=16, height=16, distance=1.2)
    plain = gv.render(tree, camera, SHADER)
    wide = gv.render(tree, camera, SHADER, clip=gv.Clip())
    far = gv.render(tree, camera, SHADER, clip=gv.Clip(planes=[(1, 0, 0, 1e6)]))
    for name in ("color", "alpha", "depth", "samples"):
        assert torch.equal(getattr(plain, name), getattr(wide, name))
        assert torch.equal(getattr(plain, name), getattr(far, name))


def test_clip_and_lens_go_together(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4)
    lens = gv.ThinLens(aperture=0.1, focus=1.2, frame="box")
    clip = dataclasses.replace(CLIPS["all"], caps=True)
    rays = camera_rays(tree, distance=1.2)
    result, *_ = assert_equal(tree, compiled, rays, clip=clip, lens=lens)
    assert result["alpha"].max() > 0.9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"planes": [(1, 0, 0, math.nan)]}, r"planes\[0\] must be finite"),
        ({"planes": [(1, 0, 0, 1), (0, 0, 0, 1)]}, r"planes\[1\] has a normal of length 0"),
        ({"planes": [(1.7e308, 1.7e308, 0, 1)]}, r"planes\[0\] has a normal of length inf"),
        ({"planes": [(1, 0, 0)]}, r"planes\[0\] must be \(4,\)"),
        ({"planes": (1, 0, 0, 0)}, r"planes\[0\] must be"),
        ({"boxes": [((0, 0, 0), (1, -1, 1))]}, r"boxes\[0\] must have its low corner below"),
        ({"boxes": [((0, 0, 0), (1, math.inf, 1))]}, r"boxes\[0\] must be finite"),
        ({"without": [torch.zeros(4, 4)]}, r"without\[0\] must be an affine matrix"),
        ({"without": [torch.zeros(3, 3)]}, r"without\[0\] must be \(4, 4\)"),
        ({"planes": 3}, "planes must be a list, got int"),
        ({"without": None}, "without must be a list, got NoneType"),
        ({"boxes": ["ab"]}, r"boxes\[0\] must be"),
        ({"boxes": [3]}, r"boxes\[0\] must be"),
        ({"frame": "moon"}, "frame must be 'world' or 'box', got 'moon'"),
        ({"cap_opacity": 0.0}, "cap_opacity must be finite and > 0"),
        ({"cap_light": 1.5}, "cap_light must be finite and >= 0 and <= 1"),
    ],
)
def test_a_wrong_clip_is_one_clear_error(options, message):
    with pytest.raises(ValueError, match=message):
        gv.Clip(**options)


def test_a_clip_that_is_none(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    with pytest.raises(ValueError, match="clip must be a Clip, got list"):
        gv.render(tree, gv.Camera.orbit(width=4, height=4), SHADER, clip=[])
