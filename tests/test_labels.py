"""Pictures of labels: sampled at the nearest voxel, never blended, lit and picked; against an
independent dense marcher.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.labels import SPACING, WIDE, cells, numbers
from helpers.marcher import box_of, orbit_rays
from helpers.rays import camera_rays, rays_along
from helpers.traces import trace
from helpers.trees import copy_to

import gvtorch as gv
from gvtorch.base.image_info import array_from_srgb
from gvtorch.shaders.colors import distinct_colors, linear_color

ORIGIN = (2.0, -1.0, 0.5)
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def balls(a: int, b: int) -> gv.Volume:
    """Two balls side by side in the background."""
    z, y, x = np.mgrid[0:24, 0:24, 0:40]
    label = np.where((x - 11) ** 2 + (y - 12) ** 2 + (z - 12) ** 2 < 64, a, 0)
    label = np.where((x - 28) ** 2 + (y - 12) ** 2 + (z - 12) ** 2 < 64, b, label)
    return gv.Volume(label, labels=True)


# --- pictures: against a dense marcher


def dense(data, rays, colors, alphas, reference, step, depth_alpha=0.1):
    """Marches rays by nearest voxels in float64; returns colour, alpha, label by the depth rule
    (-1: none), depth, and the least distance of a sample from a face between voxels, in voxels.
    `colors` and `alphas` have a row for each number in `data` (z, y, x).
    """
    eye, direction = rays
    spacing, origin = np.array(SPACING), np.array(ORIGIN)
    box = box_of(data.shape, spacing, origin)
    a, b = (box[0] - eye) / direction, (box[1] - eye) / direction
    near, far = np.minimum(a, b).max(1).clip(0), np.maximum(a, b).min(1)
    color, clear = np.zeros_like(direction), np.ones(len(direction))
    label, depth = np.full(len(direction), -1), np.full(len(direction), math.inf)
    edge_distance = np.full(len(direction), math.inf)
    for k in range(math.ceil((far - near).clip(0).max() / step) + 1):
        start = near + k * step
        end = np.minimum(start + step, far)
        here = np.nonzero(start < far)[0]
        middle = (start + (end - start) / 2)[here]
        index = (eye[here] + middle[:, None] * direction[here] - box[0]) / spacing
        edge_distance[here] = np.minimum(edge_distance[here], np.abs(index - np.rint(index)).min(1))
        x, y, z = np.minimum(np.floor(index).astype(int), np.array(data.shape[::-1]) - 1).T
        number = data[z, y, x]
        lengths = (end - start)[here] / reference
        alpha = 1 - (1 - alphas[number]) ** lengths
        color[here] += (clear[here] * alpha)[:, None] * colors[number]
        left = clear[here] * (1 - alpha)
        hit = (left < 1 - depth_alpha) & (clear[here] >= 1 - depth_alpha)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.log((1 - depth_alpha) / clear[here]) / np.log(1 - alpha)
        part = np.where(alpha < 1, part, 0)
        label[here[hit]] = number[hit]
        depth[here[hit]] = (start[here] + part * (end - start)[here])[hit]
        clear[here] = left
    return color, 1 - clear, label, depth, edge_distance


SCENES = {
    "noise": lambda: numbers(13, 17, 11, count=6, seed=3),
    "cells": lambda: cells((18, 21, 25), 12, seed=4),
    "many": lambda: numbers(11, 12, 13, count=1000, seed=5),
}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", SCENES)
def test_a_picture_is_that_of_a_dense_nearest_marcher(backend, name, dtype):
    """In float64 at every pixel; in float32 wherever no sample comes within 1e-4 of a face between
    two voxels, because rounding may move it across.
    """
    data = SCENES[name]()
    count = int(data.max()) + 1
    random = np.random.default_rng(1)
    colors, alphas = random.random((count, 3)), random.random(count).clip(0.05) * 0.6
    alphas[0] = 0
    alphas[1] = 1
    wide = data * 3_000_000_019 - 5  # labels that float32 merges
    shader = gv.Labels(
        {label * 3_000_000_019 - 5: color for label, color in enumerate(colors)},
        {label * 3_000_000_019 - 5: alpha for label, alpha in enumerate(alphas)},
        "all",
        reference=0.9,
        lit=False,
    )
    volume = gv.Volume(wide, SPACING, ORIGIN, labels=True)
    assert len(volume.label_values) == len(np.unique(data))
    tree = gv.N3Tree.from_volume(volume, 4, device=DEVICES[backend])
    camera = gv.Camera.orbit(40, 25, 1.5, 30, 32, 24)
    options = {"lod": "finest", "dtype": dtype, "stop_alpha": 1.0, "step": 0.87, "backend": backend}
    picture = gv.render(tree, camera, shader, **options)
    rays = orbit_rays(box_of(data.shape, SPACING, ORIGIN), 40, 25, 1.5, 30, 32, 24)
    step = 0.87 * min(SPACING)
    color, alpha, label, depth, edge_distance = dense(data, rays, colors, alphas, 0.9, step)
    sure = edge_distance > (1e-10 if dtype == torch.float64 else 1e-4)
    assert sure.mean() > (0.99 if dtype == torch.float64 else 0.9) and (label >= 0).mean() > 0.2
    actual = picture.label.cpu().numpy().reshape(-1)
    assert np.array_equal(actual[sure], np.where(label >= 0, label * 3_000_000_019 - 5, -1)[sure])
    tolerance = 1e-9 if dtype == torch.float64 else 2e-5
    for ours, theirs in (
        (picture.color.reshape(-1, 3), color),
        (picture.alpha.reshape(-1), alpha),
        (picture.depth.reshape(-1), depth),
    ):
        np.testing.assert_allclose(ours.cpu().numpy()[sure], theirs[sure], tolerance, tolerance)


def test_a_face_between_two_voxels_belongs_to_the_upper_one(backend):
    """Also where two bricks meet, or a brick and a region of one label."""
    data = np.arange(24).reshape(1, 1, 24).repeat(24, 0).repeat(24, 1)
    data[:, :, 16:] = 16
    tree = gv.N3Tree.from_volume(gv.Volume(data + WIDE, labels=True), 4, device=DEVICES[backend])
    xs = torch.arange(0, 24, 0.5, dtype=torch.float64)
    origin = torch.stack((xs - 0.5, torch.full_like(xs, 9.3), torch.full_like(xs, -9)))
    rays = rays_along(origin.T.contiguous(), (0.0, 0.0, 1.0), device=DEVICES[backend])
    hits = gv.trace(tree, rays, gv.Labels(), backend=backend)
    assert (hits.label[:, 0].cpu() - WIDE).tolist() == [min(int(x), 16) for x in xs.tolist()]


@pytest.mark.parametrize("brick", [2, 4, 8])
@pytest.mark.parametrize("distance", [0.8, 2.0, 7.0])
def test_no_pixel_shows_a_label_that_is_not_there(backend, brick, distance):
    """Interpolating 1 and 3 would give 2, which is green, as would the mean in a coarse level."""
    data = cells((24, 20, 28), 30) % 2 * 2 + 1
    colors = {1: RED, 2: GREEN, 3: BLUE}
    tree = gv.N3Tree.from_volume(gv.Volume(data, labels=True), brick, device=DEVICES[backend])
    camera = gv.Camera.orbit(30, 20, distance, width=20, height=16)
    for opacity in (1.0, 0.3):
        shader = gv.Labels(colors, opacity, lit=False)
        picture = gv.render(tree, camera, shader, backend=backend, step=1.3)
        assert float(picture.color[..., 1].max()) == 0 and float(picture.color[..., 0].max()) > 0.2
        total = picture.color.sum(-1, keepdim=True)
        torch.testing.assert_close(total, picture.alpha, rtol=1e-4, atol=1e-5)
        assert set(picture.label.unique().tolist()) <= {-1, 1, 3}


def test_labels_beyond_float32_stay_apart(backend):
    tree = gv.N3Tree.from_volume(balls(WIDE, WIDE + 1), 4, device=DEVICES[backend])
    shader = gv.Labels({WIDE: RED, WIDE + 1: BLUE}, lit=False)
    picture = gv.render(tree, gv.Camera.orbit(0, 0, 1.2, 40, 40, 20), shader, backend=backend)
    label, color = picture.label[..., 0].cpu(), picture.color.cpu()
    assert set(label.unique().tolist()) == {-1, WIDE, WIDE + 1}
    assert (color[label == WIDE][:, 2] < color[label == WIDE][:, 0]).all()
    assert torch.equal(label[:, :20].unique(), torch.tensor([-1, WIDE]))
    assert torch.equal(label < 0, picture.depth[..., 0].cpu() == math.inf)


# --- what is skipped, and what is edited


def test_what_shows_no_visible_label_is_not_sampled(compiled):
    """Also where numerically close labels are visible: 5 is hidden, 4 and 6 are not."""
    data = np.full((32, 32, 32), 5)
    data[0, 0, 0], data[-1, -1, -1] = 4, 6
    tree = gv.N3Tree.from_volume(gv.Volume(data, labels=True), 4, device=DEVICES[compiled])
    rays = rays_along(torch.tensor([[16.2, 13.7, -9.0]]).double(), (0.01, 0.02, 1.0))
    samples = {
        str(visible): int(
            trace(tree, compiled, rays, gv.Labels(opacity=0.01, visible=visible))[0][
                "samples"
            ].sum()
        )
        for visible in ([4, 6], [5], [99], [])
    }
    assert samples["[5]"] > 0 and samples["[4, 6]"] == samples["[99]"] == samples["[]"] == 0


def test_looks_are_edited_between_pictures(compiled):
    tree = gv.N3Tree.from_volume(balls(7, 9), 4, device=DEVICES[compiled])
    camera = gv.Camera.orbit(0, 0, 1.2, 40, 40, 20)
    shader = gv.Labels({7: "red"}, lit=False)

    def seen() -> tuple[list[int], torch.Tensor]:
        picture = gv.render(tree, camera, shader)
        there = sorted({*picture.label.unique().tolist()} - {-1})
        return there, picture.color[10, 10].cpu()

    first, red = seen()
    assert first == [7, 9] and torch.allclose(red, torch.tensor(linear_color("", "red")))
    shader.colors[7] = GREEN
    assert torch.equal(seen()[1], torch.tensor(GREEN))
    shader.visible = {9}
    assert seen()[0] == [9]
    shader.visible = None
    shader.opacity = {7: 0.0}
    assert seen()[0] == [9]
    shader.opacity[7] = 1
    assert seen()[0] == [7, 9]
    shader.visible = "all"
    assert seen()[0] == [0]
    shader.visible = None
    shader.lit = True
    assert not torch.equal(seen()[1], torch.tensor(GREEN))
    shader.opacity = 2
    with pytest.raises(ValueError, match="opacity must be finite and >= 0 and <= 1"):
        seen()


def test_colours_in_every_form():
    labels = np.array([-4, 0, 1, 2, 3, 2**40])
    auto = distinct_colors(labels)
    assert ((auto >= 0) & (auto <= 1)).all()
    table = np.array([[255, 0, 0], [0, 128, 0], [7, 8, 9]], np.uint8)
    for colors, expected in (
        (None, auto),
        ({1: RED, 2**40: "#0000ff", 77: "tan"}, [auto[0], auto[1], RED, auto[3], auto[4], BLUE]),
        ([RED, GREEN, "blue"], [auto[0], RED, GREEN, linear_color("", "blue"), auto[4], auto[5]]),
        (table, [auto[0], *array_from_srgb(table / 255), auto[4], auto[5]]),
        (torch.tensor([GREEN]), [auto[0], GREEN, *auto[2:]]),
    ):
        actual = gv.Labels(colors)._appearance().colors_of(labels)
        np.testing.assert_allclose(actual, np.array(expected), atol=1e-7)
    np.testing.assert_allclose(linear_color("", "#bc8f00"), (0.50289, 0.27468, 0), atol=1e-5)


def test_colours_of_few_labels_differ():
    """In sRGB, pairwise; a label's colour does not depend on the other labels."""
    colors = distinct_colors(np.arange(1, 13))
    srgb = np.where(colors <= 0.0031308, 12.92 * colors, 1.055 * colors ** (1 / 2.4) - 0.055)
    distances = np.linalg.norm(srgb[:, None] - srgb[None], axis=-1) + 9 * np.eye(12)
    assert distances.min() > 0.12 and (srgb.max(1) > 0.55).all()
    assert np.array_equal(distinct_colors(np.array([5])), colors[4:5])
    for step in (100_003, 2**20, 10**9, 700_000_000_001):
        many = distinct_colors(step * np.arange(1, 65))
        assert len(np.unique(many.round(1), axis=0)) > 40, "multiples of a number differ, too"


# --- light


@pytest.mark.parametrize(("border", "mean"), [(1, 13), (2, 6), (3, 4), (4, 4)])
def test_normals_are_those_of_a_smooth_boundary(compiled, border, mean):
    """For a ball of 14 voxels: the wider the border, the smoother its normals."""
    grid = np.stack(np.meshgrid(*[np.arange(32.0)] * 3, indexing="ij"), -1)[..., ::-1]
    data = (np.linalg.norm(grid - 15.5, axis=-1) < 14).astype(np.int64) * WIDE
    volume = gv.Volume(data, labels=True)
    tree = gv.N3Tree.from_volume(volume, 8, border, device=DEVICES[compiled])
    rays = camera_rays(tree, 24, distance=1.5)
    hits, _ = trace(tree, compiled, rays, gv.Labels(), lod="finest", step=0.1)
    hit = hits["depth"][:, 0] < math.inf
    hit_positions = rays.origin + hits["depth"].double() * rays.direction
    outward = torch.nn.functional.normalize(hit_positions - 15.5, dim=1)[hit]
    normal = hits["normal"][hit].double()
    assert (normal.norm(dim=1) - 1).abs().max() < 1e-6 and hit.sum() > 150
    angle = torch.rad2deg(torch.acos((normal * outward).sum(1).abs().clamp(max=1)))
    assert angle.mean() < mean and angle.quantile(0.95) < 2.5 * mean
    assert ((normal * rays.direction[hit]).sum(1) <= 1e-6).all(), "towards the eye"
    assert (hits["normal"][~hit] == 0).all()


def test_within_a_label_there_is_no_normal(backend):
    """And rounding does not look like one: a box of one label is lit evenly."""
    data = cells((24, 24, 24), 6) + WIDE
    tree = gv.N3Tree.from_volume(gv.Volume(data, labels=True), 4, device=DEVICES[backend])
    rays = camera_rays(tree, 24, distance=1.5)
    flat, _ = trace(tree, backend, rays, gv.Labels(lit=False), lod="finest")
    lit, _ = trace(tree, backend, rays, gv.Labels(ambient=0.3, diffuse=0.7), lod="finest")
    inside = lit["normal"].norm(dim=1) == 0
    assert 0.3 < inside.double().mean() < 0.97
    assert torch.allclose(lit["color"][inside], flat["color"][inside], atol=1e-6)


def test_lighting_by_cones(compiled):
    tree = gv.N3Tree.from_volume(balls(5, 6), 4, device=DEVICES[compiled])
    camera = gv.Camera.orbit(30, 30, 1.3, width=32, height=24)
    sun = gv.DirectionalLight((1.0, -0.2, -0.3))
    lit = gv.Lighting(lights=[sun], shadows=1.0, occlusion=0.5, frame="box")
    for shader in (gv.Labels(), gv.Labels(lit=False)):
        bare = gv.render(tree, camera, shader)
        shaded = gv.render(tree, camera, shader, lighting=lit)
        assert torch.equal(shaded.label, bare.label)
        assert shaded.color.mean() < 0.9 * bare.color.mean() and shaded.color.max() > 0.1


# --- picking, through what options put around a shader


@pytest.fixture(scope="module")
def scene() -> gv.N3Tree:
    data = cells((24, 22, 26), 14).astype(np.int64) * WIDE
    return gv.N3Tree.from_volume(gv.Volume(data, SPACING, labels=True), 4)


def label_at(tree: gv.N3Tree, positions: torch.Tensor) -> torch.Tensor:
    """Returns the labels of the finest voxels in which world positions (r, 3) lie."""
    data = cells((24, 22, 26), 14).astype(np.int64) * WIDE
    voxel = ((positions - tree.box[0]) / torch.tensor(SPACING).double()).floor().long()
    x, y, z = (voxel[:, a].clamp(0, n - 1) for a, n in enumerate((26, 22, 24)))
    return torch.from_numpy(data)[z, y, x]


def test_the_label_is_that_of_the_place_at_the_depth(scene, backend):
    rays = camera_rays(scene, 32, distance=2.4)
    hits, _ = trace(scene, backend, rays, gv.Labels(), lod="finest")
    hit = hits["depth"][:, 0] < math.inf
    place = rays.origin + (hits["depth"].double() + 0.25 * min(SPACING)) * rays.direction
    assert torch.equal(hits["label"][hit, 0], label_at(scene, place[hit]))
    assert (hits["label"][~hit] == -1).all() and 0.2 < hit.double().mean() < 1


def test_what_lies_behind_thin_labels_is_picked_by_the_depth_rule(scene, backend):
    """The depth is where alpha reaches 0.1, within the labels; the label is of that interval."""
    rays = camera_rays(scene, 24, distance=1.2)
    options = {"lod": "finest", "depth_alpha": 0.5, "step": 0.25}
    hits, _ = trace(scene, backend, rays, gv.Labels(opacity=0.1, lit=False), **options)
    hit = hits["depth"][:, 0] < math.inf
    first, _ = trace(scene, backend, rays, gv.Labels(lit=False), lod="finest")
    place = rays.origin + hits["depth"].double() * rays.direction
    same = hits["label"][hit, 0] == label_at(scene, place[hit])
    assert same.double().mean() > 0.93, "but where the depth lies beside a face"
    assert (hits["label"] != first["label"])[hit].double().mean() > 0.2


@pytest.mark.parametrize("opacity", [1.0, 0.02])
def test_caps_are_picked_and_drawn(scene, compiled, opacity):
    """Also where labels are so thin that nothing else is hit."""
    tree = copy_to(scene, DEVICES[compiled])
    middle = (scene.box[0] + scene.box[1]) / 2
    clip = gv.Clip(planes=[(0.0, 0.0, -1.0, float(middle[2]))], caps=True)
    camera = gv.Camera.orbit(0, 0, 1.5, width=24, height=24)
    shader = gv.Labels(opacity=opacity, visible="all", lit=False)
    picture = gv.render(tree, camera, shader, clip=clip)
    rays = camera.placed(scene.box).rays()
    depth = picture.depth.cpu().reshape(-1, 1).double()
    cap = (depth[:, 0] - (rays.origin[:, 2] - middle[2]) / -rays.direction[:, 2]).abs() < 1e-3
    assert cap.sum() > 50
    place = rays.origin + (depth + 0.2 * min(SPACING)) * rays.direction
    assert torch.equal(picture.label.cpu().reshape(-1)[cap], label_at(scene, place[cap]))


def test_clips_lenses_and_strips_tell_labels(scene, compiled):
    tree = copy_to(scene, DEVICES[compiled])
    camera, shader = gv.Camera.orbit(30, 20, 1.3, width=24, height=20), gv.Labels()
    plain = gv.render(tree, camera, shader)
    boxes = gv.Clip(boxes=[((-9, -9, -9), (9, 9, 0)), ((-9, -9, 0), (9, 9, 9))], frame="box")
    assert torch.equal(gv.render(tree, camera, shader, clip=boxes).label, plain.label)
    lens = gv.ThinLens(aperture=1e-6, focus=1.2, frame="box")
    same = gv.render(tree, camera, shader, lens=lens).label == plain.label
    assert same.double().mean() > 0.95
    mean = gv.Progressive(partial(gv.render, tree, shader=shader))
    assert torch.equal(mean.refine(camera, 3).label, plain.label)


def test_a_layer_hides_labels_and_lets_them_through(scene, compiled):
    tree, shader = copy_to(scene, DEVICES[compiled]), gv.Labels()
    camera = gv.Camera.orbit(30, 20, 1.3, width=24, height=20)
    plain = gv.render(tree, camera, shader)
    depth = torch.full_like(plain.depth, 1.0)
    depth[:, :12] = math.inf
    color = torch.zeros_like(plain.color)
    hidden = gv.render(tree, camera, shader, layer=gv.Layer(color, depth))
    assert torch.equal(hidden.label[:, :12], plain.label[:, :12])
    assert (hidden.label[:, 12:] == -1).all()
    half = gv.Layer(color, depth, torch.full_like(depth, 0.5))
    assert torch.equal(gv.render(tree, camera, shader, layer=half).label, plain.label)


def test_several_trees_tell_the_nearest_label(compiled):
    """Their tables differ, and so do the rows that the kernel returns."""
    first, second = balls(WIDE, 5), balls(9, 2**40)
    second = gv.Volume(second.data, origin=(0, 0, 40), info=first.info)
    second.label_values = torch.tensor([0, 9, 2**40])
    camera = gv.Camera.orbit(0, 0, 1.6, 40, 40, 24)
    device = DEVICES[compiled]
    producers = {"one": gv.VolumeProducer(first), "two": gv.VolumeProducer(second)}
    with gv.Engine(producers, brick_size=4, device=device) as engine:
        picture = engine.render(camera, gv.Labels())
    label, depth = picture.label.cpu(), picture.depth.cpu()
    assert set(label.unique().tolist()) == {-1, WIDE, 5, 9, 2**40}
    behind = (label == WIDE) | (label == 5)
    assert depth[behind].min() > depth[(label > -1) & ~behind].max()


def test_files_hold_the_labels(scene, tmp_path):
    picture = gv.render(scene, gv.Camera.orbit(width=12, height=9), gv.Labels())
    picture.save(tmp_path / "picture.npz")
    with np.load(tmp_path / "picture.npz") as arrays:
        assert arrays["label"].dtype == np.int64 and arrays["label"].max() > 2**24
        assert np.array_equal(arrays["label"], picture.label.numpy())
    picture.save(tmp_path / "picture.png")
    assert "label" in repr(gv.trace(scene, camera_rays(scene, 4), gv.Labels()))


# --- trees, engines and stores


@pytest.mark.parametrize("dtype", ["uint8", "int8", "uint16", "int16", "int64"])
def test_every_dtype_of_bricks(compiled, dtype):
    data = cells((18, 20, 22), 9).astype(dtype) * (-13 if dtype in ("int8", "int16") else 13)
    tree = gv.N3Tree.from_volume(gv.Volume(data, labels=True), 4, device=DEVICES[compiled])
    picture = gv.render(tree, gv.Camera.orbit(width=24, height=20, distance=2.5), gv.Labels())
    there = set(picture.label.unique().tolist()) - {-1}
    assert there <= set(np.unique(data).tolist()) and len(there) > 3


def test_seventy_thousand_labels(compiled):
    """More than uint16 counts: float32 bricks, and a table of as many rows."""
    data = np.arange(42**3).reshape(42, 42, 42) + WIDE
    tree = gv.N3Tree.from_volume(gv.Volume(data, labels=True), 8, device=DEVICES[compiled])
    assert tree.bricks.channels["value"].dtype == torch.float32
    rays = camera_rays(tree, 24, distance=1.3)
    hits, _ = trace(tree, compiled, rays, gv.Labels(), lod="finest")
    hit = hits["depth"][:, 0] < math.inf
    place = rays.origin + (hits["depth"].double() + 0.25) * rays.direction
    x, y, z = ((place[hit] + 0.5).floor().long()[:, a].clamp(0, 41) for a in range(3))
    assert torch.equal(hits["label"][hit, 0], torch.from_numpy(data)[z, y, x])


@pytest.mark.parametrize("hold", ["voxels", "bricks"])
def test_streamed_is_resident_in_every_bit(scene, compiled, hold):
    data = cells((24, 22, 26), 14).astype(np.int64) * WIDE
    producer = gv.VolumeProducer(gv.Volume(data, SPACING, labels=True), hold=hold)
    shader = gv.Labels(opacity={WIDE: 0.2})
    options = {"brick_size": 4, "device": DEVICES[compiled], "brick_pool": "60 kB"}
    with gv.Engine(producer, **options) as engine:
        for distance in (0.8, 1.3, 4.0):
            camera = gv.Camera.orbit(30, 20, distance, width=24, height=20)
            resident = gv.render(copy_to(scene, DEVICES[compiled]), camera, shader)
            picture = engine.render(camera, shader)
            assert picture.stats.converged
            for name in ("color", "alpha", "depth", "label", "normal"):
                assert torch.equal(getattr(picture, name), getattr(resident, name)), name


# --- options of the shader


def test_other_shaders_do_not_blend_labels(scene):
    camera = gv.Camera.orbit(width=4, height=4)
    transfer = gv.TransferFunction([(0, 1)])
    module = gv.ModuleShader(torch.nn.Identity(), ["value"])
    for shader in (transfer, gv.Lit(transfer), gv.Isosurface(1), module):
        with pytest.raises(ValueError, match=r"holds labels, which \w+ would blend: gv\.Labels"):
            gv.render(scene, camera, shader)
    values = gv.N3Tree.from_volume(gv.Volume(numbers(8, 8, 8)))
    with pytest.raises(ValueError, match=r"holds no labels but values.*labels=True"):
        gv.render(values, camera, gv.Labels())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gv.Labels({1: "reddish"}), "'reddish' is not a colour; known: #RRGGBB, black"),
        (lambda: gv.Labels({1.5: RED}), "a label must be a whole number below 2^63, got 1.5"),
        (lambda: gv.Labels({1: (0, 0, 2)}), "colour must be finite and >= 0 and <= 1"),
        (lambda: gv.Labels("red"), "colors must be by label, or a list, got 'red'"),
        (lambda: gv.Labels(np.zeros((3, 4))), "colors must be (k, 3)"),
        (lambda: gv.Labels(np.full((3, 3), 2.0)), "colors must lie in [0, 1]"),
        (lambda: gv.Labels(opacity=-1), "opacity must be finite and >= 0"),
        (lambda: gv.Labels(opacity={3: "much"}), "opacity must be a number"),
        (lambda: gv.Labels(visible="some"), "visible must be labels, 'all' or None"),
        (lambda: gv.Labels(visible=5), "visible must be labels, 'all' or None, got 5"),
        (lambda: gv.Labels(visible=[2**63]), "whole number below 2^63"),
        (lambda: gv.Labels(reference=0), "reference must be finite and > 0"),
        (lambda: gv.Labels(lit="no"), "lit must be true or false"),
        (lambda: gv.Labels(normals="n"), "normals are those of the labels"),
        (lambda: gv.Labels(light="sun"), "light must be a Headlight"),
    ],
)
def test_bad_arguments_have_one_clear_message(make, message):
    with pytest.raises(ValueError) as caught:
        make()
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_producer_of_labels(compiled):
    """A user-defined producer, which states the labels of its values."""

    class Slabs(gv.Producer):
        def __init__(self) -> None:
            super().__init__(
                32, channels={"value": gv.Channel(torch.uint8)}, labels={"value": None}
            )

        def fill(self, nodes):
            x, _, _ = nodes.axes
            shape = (len(nodes), *[nodes.layout.side] * 3)
            return {"value": (x >= 16).to(torch.uint8).mul(6).add(1).expand(shape).contiguous()}

    with gv.Engine(Slabs(), brick_size=4, device=DEVICES[compiled]) as engine:
        picture = engine.render(gv.Camera.orbit(0, 0, 2.5, width=16, height=16), gv.Labels())
    assert set(picture.label.unique().tolist()) == {-1, 1, 7}
