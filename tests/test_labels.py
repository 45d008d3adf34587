"""Labels: kept exactly, sampled by the nearest voxel, never blended, coarse by majority, picked;
from arrays and files through stores to pictures, against a dense marcher that shares nothing.
"""

from __future__ import annotations

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from helpers import DEVICES, gvtorch
from helpers.marcher import box_of, orbit_rays
from helpers.rays import camera_rays, rays_along
from helpers.traces import run
from helpers.trees import on

import gvtorch as gv
from gvtorch.base import labels as base
from gvtorch.io import label_source
from gvtorch.pool.downsample import pool_majority
from gvtorch.pool.pyramid import volume_levels
from gvtorch.shaders.colors import distinct_colors, from_srgb, linear_color

WIDE = 2**24 + 1
SPACING, ORIGIN = (1.0, 0.8, 1.3), (2.0, -1.0, 0.5)
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def numbers(*shape: int, most: int = 5, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, most, shape)


def cells(shape, count: int, seed: int = 0, dtype=np.int64) -> np.ndarray:
    """The number of the nearest of some places: connected labels from 0 on."""
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    places = np.random.default_rng(seed).random((count, 3)) * shape
    return ((grid[..., None, :] - places) ** 2).sum(-1).argmin(-1).astype(dtype)


def balls(a: int, b: int) -> gv.Volume:
    """Two balls side by side in the background."""
    z, y, x = np.mgrid[0:24, 0:24, 0:40]
    label = np.where((x - 11) ** 2 + (y - 12) ** 2 + (z - 12) ** 2 < 64, a, 0)
    label = np.where((x - 28) ** 2 + (y - 12) ** 2 + (z - 12) ** 2 < 64, b, label)
    return gv.Volume(label, labels=True)


def kept(volume: gv.Volume) -> np.ndarray:
    """The labels that a volume stands for."""
    data = volume.data[..., 0].to(torch.int64)
    return (data if volume.label_values is None else volume.label_values[data]).numpy()


# --- what a volume keeps


@pytest.mark.parametrize(
    ("dtype", "low", "high"),
    [
        ("bool", 0, 1),
        ("uint8", 0, 255),
        ("int8", -128, 127),
        ("uint16", 0, 65535),
        ("int16", -32768, 32767),
        ("int32", -(2**31), 2**31 - 1),
        ("uint32", 0, 2**32 - 1),
        ("int64", -(2**63), 2**63 - 1),
        ("uint64", 0, 2**63 - 1),
        (">i4", -(2**31), 2**31 - 1),
        ("float64", -(2**53), 2**53),
    ],
)
def test_labels_of_every_dtype_are_kept_exactly(dtype, low, high):
    whole = np.array([low, high, high - 1, low + 1, 0, *range(min(20, high))]).astype(dtype)
    data = np.resize(whole, (5, 6, 7))
    volume = gv.Volume(data, labels=True)
    assert np.array_equal(kept(volume), data.astype(np.int64)) and volume.filter == "majority"
    narrow = np.dtype(dtype).itemsize <= 2
    assert (volume.label_values is None) == narrow
    assert volume.info.labels and volume.data.dtype.itemsize == (data.itemsize if narrow else 1)
    if not narrow:
        assert torch.equal(volume.label_values, torch.from_numpy(np.unique(data.astype(np.int64))))
    if np.dtype(dtype).isnative:
        again = gv.Volume(torch.from_numpy(data), info=gv.ImageInfo(labels=True))
        assert torch.equal(again.data, volume.data)


@pytest.mark.parametrize("count", [256, 257, 65536, 65537, 70000])
def test_as_few_bits_as_the_labels_need(count):
    data = np.arange(count).repeat(2)[: 2 * count].reshape(2, count, 1) * 7 + 2**40
    volume = gv.Volume(data, labels=True)
    assert volume.data.dtype == getattr(torch, base.index_dtype(count).name)
    assert volume.data.dtype.itemsize == (1 if count <= 256 else 2 if count <= 65536 else 4)
    assert np.array_equal(kept(volume), data)


def test_whole_floats_are_labels_and_nan_can_be_replaced():
    data = np.array([[[0.0, 3.0, np.nan, 2.0**60]]])
    volume = gv.Volume(data, labels=True, nan=0)
    assert kept(volume).tolist() == [[[0, 3, 0, 2**60]]]
    with pytest.raises(ValueError, match="must be whole numbers, got nan"):
        gv.Volume(data, labels=True)
    with pytest.raises(ValueError, match=r"must be whole numbers, got 0\.5"):
        gv.Volume(np.full((2, 2, 2), 0.5), labels=True)


def test_what_does_not_fit_is_one_clear_error():
    with pytest.raises(ValueError, match=r"below 2\^63, got 9223372036854775808: number them anew"):
        gv.Volume(np.full((2, 2, 2), 2**63, np.uint64), labels=True)
    with pytest.raises(ValueError, match="holds 16777217 labels or more, at most 16777216 fit"):
        base.check_count("Volume", 2**24 + 1)
    base.check_count("Volume", 2**24)
    for what in (np.zeros((2, 2, 2), complex), np.zeros(3, int), "labels", np.zeros((0, 2, 2))):
        with pytest.raises(ValueError, match="Volume: ") as caught:
            gv.Volume(what, labels=True)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("dtype", ["int32", "uint32", "int64", "uint64"])
def test_wide_integers_never_merge_in_silence(dtype):
    data = np.full((3, 3, 3), WIDE, dtype)
    for given in (data, torch.from_numpy(data)):
        with pytest.raises(ValueError, match=r"16777217.*labels=True \(--labels\)") as caught:
            gv.Volume(given)
        assert "\n" not in str(caught.value)
    assert gv.Volume(data - 1).data.unique().tolist() == [2**24]
    if dtype.startswith("int"):
        with pytest.raises(ValueError, match="-16777217"):
            gv.Volume(-data)
    assert gv.Volume(data.astype(np.float64)).data.unique().tolist() == [2**24]


# --- coarse levels


def brute_majority(values: np.ndarray, factor: int, background: float | None) -> np.ndarray:
    shape = [-(-n // factor) for n in values.shape[:3]]
    out = np.empty((*shape, values.shape[3]), values.dtype)
    for z, y, x, c in np.ndindex(out.shape):
        index = [
            np.minimum(np.arange(factor) + factor * at, n - 1)
            for at, n in zip((z, y, x), values.shape, strict=False)
        ]
        found, counts = np.unique(values[..., c][np.ix_(*index)], return_counts=True)
        order = sorted(zip(-counts, found == background, found, strict=True))
        out[z, y, x, c] = order[0][2]
    return out


@pytest.mark.parametrize("background", [None, 0, 2])
@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32"])
@pytest.mark.parametrize("factor", [2, 3])
def test_majority_is_that_of_every_block(factor, dtype, background):
    for most, seed in ((2, 0), (4, 1), (40, 2)):
        values = numbers(9, 8, 11, 2, most=most, seed=seed).astype(dtype)
        values[:4] = values[0, 0, 0]  # blocks of one label
        found = pool_majority(values, factor, background)
        assert found.dtype == values.dtype
        assert np.array_equal(found, brute_majority(values, factor, background))
        assert np.array_equal(found[1:], pool_majority(values[factor:], factor, background))


def test_a_sheet_one_voxel_thick_stays():
    """Half of each block is background, at every level: ties go to what is there."""
    data = np.zeros((32, 32, 32), np.int64)
    data[13] = WIDE
    volume = gv.Volume(data, labels=True)
    for level in volume_levels(volume, 5, branching=2, brick_size=4, border=1):
        assert (level.values == 1).any((1, 2, 3)).sum() == 1 and level.values.max() == 1


def test_a_tree_holds_no_label_that_the_volume_has_not():
    volume = gv.Volume(numbers(21, 18, 25, most=9).astype(np.int64) ** 20 + 3, SPACING, labels=True)
    there = set(volume.data.unique().tolist())
    for branching, threshold in itertools.product((2, 3), (None, 3.0)):
        channels = {"label": volume, "value": gv.Volume(volume.data.float(), SPACING)}
        tree = gv.N3Tree.from_volume(channels, 4, branching=branching, threshold=threshold)
        assert set(tree.bricks.bricks["label"].unique().tolist()) <= there
        brick = tree.nodes.brick_tn < 0
        assert set(tree.nodes.constants["label"][brick].unique().tolist()) <= there


def test_a_threshold_is_not_for_labels():
    volume = gv.Volume(numbers(8, 8, 8), labels=True)
    for make in (gv.N3Tree.from_volume, gv.VolumeProducer):
        with pytest.raises(ValueError, match="threshold is for values; labels are hidden by"):
            make(volume, threshold=0)


# --- pictures: against a dense marcher


def dense(data, rays, colors, alphas, reference, step, depth_alpha=0.1):
    """Nearest voxels along rays, float64: colour, alpha, label by the depth rule (-1: none), depth,
    and how near any sample comes to a face between voxels, in voxels. `colors` and `alphas` have a
    row for each number in `data` (z, y, x).
    """
    eye, direction = rays
    spacing, origin = np.array(SPACING), np.array(ORIGIN)
    box = box_of(data.shape, spacing, origin)
    a, b = (box[0] - eye) / direction, (box[1] - eye) / direction
    near, far = np.minimum(a, b).max(1).clip(0), np.maximum(a, b).min(1)
    color, clear = np.zeros_like(direction), np.ones(len(direction))
    label, depth = np.full(len(direction), -1), np.full(len(direction), math.inf)
    apart = np.full(len(direction), math.inf)
    for k in range(math.ceil((far - near).clip(0).max() / step) + 1):
        start = near + k * step
        end = np.minimum(start + step, far)
        here = np.nonzero(start < far)[0]
        middle = (start + (end - start) / 2)[here]
        place = (eye[here] + middle[:, None] * direction[here] - box[0]) / spacing
        apart[here] = np.minimum(apart[here], np.abs(place - np.rint(place)).min(1))
        x, y, z = np.minimum(np.floor(place).astype(int), np.array(data.shape[::-1]) - 1).T
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
    return color, 1 - clear, label, depth, apart


SCENES = {
    "noise": lambda: numbers(13, 17, 11, most=6, seed=3),
    "cells": lambda: cells((18, 21, 25), 12, seed=4),
    "many": lambda: numbers(11, 12, 13, most=1000, seed=5),
}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", SCENES)
def test_a_picture_is_that_of_a_dense_nearest_marcher(backend, name, dtype):
    """Exactly: in float64 at every pixel; in float32 wherever no sample comes within 1e-4 of a face
    between two voxels, which is where rounding may take it across.
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
    options = {"lod": "finest", "dtype": dtype, "stop_alpha": 1.0, "step": 0.37, "backend": backend}
    picture = gv.render(tree, camera, shader, **options)
    rays = orbit_rays(box_of(data.shape, SPACING, ORIGIN), 40, 25, 1.5, 30, 32, 24)
    step = 0.37 * min(SPACING)
    color, alpha, label, depth, apart = dense(data, rays, colors, alphas, 0.9, step)
    sure = apart > (1e-10 if dtype == torch.float64 else 1e-4)
    assert sure.mean() > (0.99 if dtype == torch.float64 else 0.9) and (label >= 0).mean() > 0.2
    found = picture.label.cpu().numpy().reshape(-1)
    assert np.array_equal(found[sure], np.where(label >= 0, label * 3_000_000_019 - 5, -1)[sure])
    tolerance = 1e-9 if dtype == torch.float64 else 2e-5
    for ours, theirs in (
        (picture.color.reshape(-1, 3), color),
        (picture.alpha.reshape(-1), alpha),
        (picture.depth.reshape(-1), depth),
    ):
        np.testing.assert_allclose(ours.cpu().numpy()[sure], theirs[sure], tolerance, tolerance)


def test_a_face_between_two_voxels_belongs_to_the_upper_one(backend):
    """Also where two bricks, and where bricks and regions of one label meet."""
    data = np.arange(24).reshape(1, 1, 24).repeat(24, 0).repeat(24, 1)
    data[:, :, 16:] = 16
    tree = gv.N3Tree.from_volume(gv.Volume(data + WIDE, labels=True), 4, device=DEVICES[backend])
    places = torch.arange(0, 24, 0.5, dtype=torch.float64)
    origin = torch.stack((places - 0.5, torch.full_like(places, 9.3), torch.full_like(places, -9)))
    rays = rays_along(origin.T.contiguous(), (0.0, 0.0, 1.0), device=DEVICES[backend])
    hits = gv.trace(tree, rays, gv.Labels(), backend=backend)
    assert (hits.label[:, 0].cpu() - WIDE).tolist() == [min(int(x), 16) for x in places.tolist()]


@pytest.mark.parametrize("brick", [2, 4, 8])
@pytest.mark.parametrize("distance", [0.8, 2.0, 7.0])
def test_no_pixel_shows_a_label_that_is_not_there(backend, brick, distance):
    """Between 1 and 3 interpolation meets 2, which is green; so does the mean of a coarse level."""
    data = cells((24, 20, 28), 30) % 2 * 2 + 1
    colors = {1: RED, 2: GREEN, 3: BLUE}
    tree = gv.N3Tree.from_volume(gv.Volume(data, labels=True), brick, device=DEVICES[backend])
    camera = gv.Camera.orbit(30, 20, distance, width=20, height=16)
    for opacity in (1.0, 0.3):
        shader = gv.Labels(colors, opacity, lit=False)
        picture = gv.render(tree, camera, shader, backend=backend)
        assert float(picture.color[..., 1].max()) == 0 and float(picture.color[..., 0].max()) > 0.2
        shown = picture.color.sum(-1, keepdim=True)
        torch.testing.assert_close(shown, picture.alpha, rtol=1e-4, atol=1e-5)
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
    """Also where the labels beside it are visible: 5 is hidden, 4 and 6 are not."""
    data = np.full((32, 32, 32), 5)
    data[0, 0, 0], data[-1, -1, -1] = 4, 6
    tree = gv.N3Tree.from_volume(gv.Volume(data, labels=True), 4, device=DEVICES[compiled])
    rays = rays_along(torch.tensor([[16.2, 13.7, -9.0]]).double(), (0.01, 0.02, 1.0))
    samples = {
        str(visible): int(
            run(tree, compiled, rays, gv.Labels(opacity=0.01, visible=visible))[0]["samples"].sum()
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
    own = distinct_colors(labels)
    assert ((own >= 0) & (own <= 1)).all()
    table = np.array([[255, 0, 0], [0, 128, 0], [7, 8, 9]], np.uint8)
    for colors, wanted in (
        (None, own),
        ({1: RED, 2**40: "#0000ff", 77: "tan"}, [own[0], own[1], RED, own[3], own[4], BLUE]),
        ([RED, GREEN, "blue"], [own[0], RED, GREEN, linear_color("", "blue"), own[4], own[5]]),
        (table, [own[0], *from_srgb(table / 255), own[4], own[5]]),
        (torch.tensor([GREEN]), [own[0], GREEN, *own[2:]]),
    ):
        found = gv.Labels(colors)._look().colors_of(labels)
        np.testing.assert_allclose(found, np.array(wanted), atol=1e-7)
    np.testing.assert_allclose(linear_color("", "#bc8f00"), (0.50289, 0.27468, 0), atol=1e-5)


def test_colours_of_few_labels_differ():
    """In sRGB, pairwise; and a label has its colour whatever else there is."""
    colors = distinct_colors(np.arange(1, 13))
    srgb = np.where(colors <= 0.0031308, 12.92 * colors, 1.055 * colors ** (1 / 2.4) - 0.055)
    apart = np.linalg.norm(srgb[:, None] - srgb[None], axis=-1) + 9 * np.eye(12)
    assert apart.min() > 0.12 and (srgb.max(1) > 0.55).all()
    assert np.array_equal(distinct_colors(np.array([5])), colors[4:5])


# --- light


@pytest.mark.parametrize(("border", "mean"), [(1, 13), (2, 6), (3, 4), (4, 4)])
def test_normals_are_those_of_a_smooth_boundary(backend, border, mean):
    """Of a ball of 14 voxels, whose voxels are cubes: the wider the border, the smoother."""
    grid = np.stack(np.meshgrid(*[np.arange(32.0)] * 3, indexing="ij"), -1)[..., ::-1]
    data = (np.linalg.norm(grid - 15.5, axis=-1) < 14).astype(np.int64) * WIDE
    volume = gv.Volume(data, labels=True)
    tree = gv.N3Tree.from_volume(volume, 8, border, device=DEVICES[backend])
    rays = camera_rays(tree, 24, distance=1.5)
    hits, _ = run(tree, backend, rays, gv.Labels(), lod="finest", step=0.1)
    hit = hits["depth"][:, 0] < math.inf
    place = rays.origin + hits["depth"].double() * rays.direction
    outward = torch.nn.functional.normalize(place - 15.5, dim=1)[hit]
    normal = hits["normal"][hit].double()
    assert (normal.norm(dim=1) - 1).abs().max() < 1e-6 and hit.sum() > 150
    angle = torch.rad2deg(torch.acos((normal * outward).sum(1).abs().clamp(max=1)))
    assert angle.mean() < mean and angle.quantile(0.95) < 2.5 * mean
    assert ((normal * rays.direction[hit]).sum(1) <= 1e-6).all(), "towards the eye"
    assert (hits["normal"][~hit] == 0).all()


def test_within_a_label_there_is_no_normal(backend):
    """And no rounding that looks like one: a box of one label is lit evenly."""
    data = cells((24, 24, 24), 6) + WIDE
    tree = gv.N3Tree.from_volume(gv.Volume(data, labels=True), 4, device=DEVICES[backend])
    rays = camera_rays(tree, 24, distance=1.5)
    flat, _ = run(tree, backend, rays, gv.Labels(lit=False), lod="finest")
    lit, _ = run(tree, backend, rays, gv.Labels(ambient=0.3, diffuse=0.7), lod="finest")
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


def label_at(tree: gv.N3Tree, place: torch.Tensor) -> torch.Tensor:
    """The labels of the voxels (of the finest level) in which world places (r, 3) lie."""
    data = cells((24, 22, 26), 14).astype(np.int64) * WIDE
    voxel = ((place - tree.box[0]) / torch.tensor(SPACING).double()).floor().long()
    x, y, z = (voxel[:, a].clamp(0, n - 1) for a, n in enumerate((26, 22, 24)))
    return torch.from_numpy(data)[z, y, x]


def test_the_label_is_that_of_the_place_at_the_depth(scene, backend):
    rays = camera_rays(scene, 32, distance=2.4)
    hits, _ = run(scene, backend, rays, gv.Labels(), lod="finest")
    hit = hits["depth"][:, 0] < math.inf
    place = rays.origin + (hits["depth"].double() + 0.25 * min(SPACING)) * rays.direction
    assert torch.equal(hits["label"][hit, 0], label_at(scene, place[hit]))
    assert (hits["label"][~hit] == -1).all() and 0.2 < hit.double().mean() < 1


def test_what_lies_behind_thin_labels_is_picked_by_the_depth_rule(scene, backend):
    """With an alpha of 0.1 the depth is somewhere within; the label is of that interval."""
    rays = camera_rays(scene, 24, distance=1.2)
    options = {"lod": "finest", "depth_alpha": 0.5, "step": 0.25}
    hits, _ = run(scene, backend, rays, gv.Labels(opacity=0.1, lit=False), **options)
    hit = hits["depth"][:, 0] < math.inf
    first, _ = run(scene, backend, rays, gv.Labels(lit=False), lod="finest")
    place = rays.origin + hits["depth"].double() * rays.direction
    same = hits["label"][hit, 0] == label_at(scene, place[hit])
    assert same.double().mean() > 0.93, "but where the depth lies beside a face"
    assert (hits["label"] != first["label"])[hit].double().mean() > 0.2


@pytest.mark.parametrize("opacity", [1.0, 0.02])
def test_caps_are_picked_and_drawn(scene, compiled, opacity):
    """Also where labels are so thin that nothing else is hit."""
    tree = on(scene, DEVICES[compiled])
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
    tree = on(scene, DEVICES[compiled])
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
    tree, shader = on(scene, DEVICES[compiled]), gv.Labels()
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
    """Their tables differ; so do the rows that the kernel gives."""
    one, two = balls(WIDE, 5), balls(9, 2**40)
    two = gv.Volume(two.data, origin=(0, 0, 40), info=one.info)
    two.label_values = torch.tensor([0, 9, 2**40])
    camera = gv.Camera.orbit(0, 0, 1.6, 40, 40, 24)
    device = DEVICES[compiled]
    producers = {"one": gv.VolumeProducer(one), "two": gv.VolumeProducer(two)}
    with gv.Engine(producers, brick_size=4, device=device) as engine:
        picture = engine.render(camera, gv.Labels())
    label, depth = picture.label.cpu(), picture.depth.cpu()
    assert set(label.unique().tolist()) == {-1, WIDE, 5, 9, 2**40}
    behind = (label == WIDE) | (label == 5)
    assert depth[behind].min() > depth[(label > -1) & ~behind].max()


def test_files_hold_the_labels(scene, tmp_path):
    picture = gv.render(scene, gv.Camera.orbit(width=12, height=9), gv.Labels())
    picture.save(tmp_path / "picture.npz")
    with np.load(tmp_path / "picture.npz") as found:
        assert found["label"].dtype == np.int64 and found["label"].max() > 2**24
        assert np.array_equal(found["label"], picture.label.numpy())
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
    hits, _ = run(tree, compiled, rays, gv.Labels(), lod="finest")
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
            resident = gv.render(on(scene, DEVICES[compiled]), camera, shader)
            picture = engine.render(camera, shader)
            assert picture.stats.converged
            for name in ("color", "alpha", "depth", "label", "normal"):
                assert torch.equal(getattr(picture, name), getattr(resident, name)), name


def same_as_resident(store: gv.Store, volume: gv.Volume) -> None:
    shader, cameras = gv.Labels(), [gv.Camera.orbit(30, 20, d, width=24, height=20) for d in (1, 5)]
    tree = gv.N3Tree.from_volume(volume, 8)
    with gv.Engine(gv.StoredProducer(store), brick_size=8) as engine:
        for camera in cameras:
            resident, picture = gv.render(tree, camera, shader), engine.render(camera, shader)
            assert picture.stats.converged and not engine.failures
            for name in ("color", "alpha", "depth", "label", "normal"):
                assert torch.equal(getattr(picture, name), getattr(resident, name)), name


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("kind", ["int64 file", "packed file", "volume", "uint16 file"])
def test_a_store_keeps_labels(tmp_path, kind):
    data = cells((90, 70, 80), 40, dtype=np.uint16 if "uint16" in kind else np.int64)
    data = data if "uint16" in kind else np.where(data % 4 == 0, 0, data * 2**33 - 9)
    file = tmp_path / ("labels.npy" if "packed" not in kind else "labels.npz")
    np.save(file, data) if file.suffix == ".npy" else np.savez_compressed(file, data)
    volume = gv.read_volume(file, labels=True, spacing=SPACING)
    assert np.array_equal(kept(volume), data)
    source = volume if kind == "volume" else file
    place = {} if kind == "volume" else {"spacing": SPACING}
    store = gv.convert(source, tmp_path / "labels.zarr", labels=True, **place)
    assert store.info.labels and (store.label_values is None) == ("uint16" in kind)
    again = gv.read_volume(tmp_path / "labels.zarr")
    assert again.info.labels and np.array_equal(kept(again), data)
    levels = volume_levels(volume, store.levels, branching=2, brick_size=8, border=1)
    for number, level in enumerate(levels):
        z, y, x = level.values.shape[:3]
        stored = store.read_region(number, (0, 0, 0), (z, y, x))
        assert np.array_equal(stored, level.values.numpy()), number
    same_as_resident(store, volume)


@pytest.mark.backend("cpp")
def test_a_store_of_more_labels_than_16_bits_count_by_processes(tmp_path):
    data = np.random.default_rng(0).integers(0, 80_000, (150, 140, 130)) * 2**40 + 5
    np.save(tmp_path / "many.npy", data)
    store = gv.convert(tmp_path / "many.npy", tmp_path / "many.zarr", labels=True, workers=2)
    assert store.dtype == torch.float32 and len(store.label_values) == len(np.unique(data))
    assert np.array_equal(kept(gv.read_volume(tmp_path / "many.zarr")), data)


def test_converting_labels_resumes_without_finding_them_again(tmp_path, monkeypatch):
    data = cells((300, 40, 30), 20) * 2**35
    np.save(tmp_path / "a.npy", data)
    given = {"labels": True, "executor": ThreadPoolExecutor(1), "workers": 1}

    def stop(what: str, done: int, total: int) -> None:
        if what == "converting" and done:
            raise RuntimeError("the power is gone")

    with pytest.raises(RuntimeError, match="the power is gone"):
        gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", progress=stop, **given)
    with pytest.raises(FileExistsError, match="half-written"):
        gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", **given)
    with pytest.raises(ValueError, match="was begun with"):
        gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", resume=True, nan=0, **given)
    monkeypatch.setattr(label_source, "distinct", None)  # to call it would fail
    store = gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", resume=True, **given)
    assert np.array_equal(kept(gv.read_volume(tmp_path / "a.zarr")), data)
    assert store.label_values.tolist() == np.unique(data).tolist()


def test_a_label_that_comes_while_it_is_read_is_an_error(tmp_path):
    np.save(tmp_path / "a.npy", cells((20, 20, 20), 5) * WIDE)
    source = gv.convert.__globals__["open_source"](tmp_path / "a.npy", labels=True)
    for known in ([0, WIDE, 2 * WIDE, 3 * WIDE], [0, 5 * WIDE], [7]):
        counted = label_source.IndexSource.of(source, np.array(known))
        with pytest.raises(OSError, match="changed while it was read: a label is new"):
            counted.read_region((0, 0, 0), (20, 20, 20))


def test_damaged_label_tables_are_told(tmp_path):
    np.save(tmp_path / "a.npy", cells((20, 20, 20), 5) * WIDE)
    gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", labels=True)
    file = tmp_path / "a.zarr" / "zarr.json"
    text = file.read_text()
    for count, said in ((0, "damaged"), (6, "damaged"), ('"x"', "damaged"), (2**25, "damaged")):
        file.write_text(text.replace('"label_count": 5', f'"label_count": {count}'))
        with pytest.raises(ValueError, match=said):
            gv.Store.open(tmp_path / "a.zarr")
    file.write_text(text)
    for part in (tmp_path / "a.zarr" / "gvtorch" / "labels").rglob("c/*"):
        part.write_bytes(part.read_bytes()[:-3])
    with pytest.raises((ValueError, OSError)):
        gv.Store.open(tmp_path / "a.zarr")


def test_files_of_wide_integers_never_merge_in_silence(tmp_path):
    data = cells((40, 30, 20), 5) + WIDE
    np.save(tmp_path / "a.npy", data)
    np.savez(tmp_path / "a.npz", data)
    for name in ("a.npy", "a.npz"):
        for work in (gv.read_volume, lambda file: gv.convert(file, tmp_path / "a.zarr")):
            with pytest.raises((ValueError, OSError), match=r"labels=True \(--labels\)") as caught:
                work(tmp_path / name)
            assert "\n" not in str(caught.value)


def test_what_conversion_refuses(tmp_path):
    volume = gv.Volume(numbers(8, 8, 8), labels=True)
    with pytest.raises(ValueError, match="threshold is for values"):
        gv.convert(volume, tmp_path / "a.zarr", threshold=1)
    with pytest.raises(ValueError, match=r"must hold labels: gv\.Volume\(data, labels=True\)"):
        gv.convert(gv.Volume(numbers(8, 8, 8)), tmp_path / "a.zarr", labels=True)
    np.save(tmp_path / "half.npy", np.full((4, 4, 4), 0.5))
    with pytest.raises((ValueError, OSError), match="labels must be whole numbers"):
        gv.convert(tmp_path / "half.npy", tmp_path / "a.zarr", labels=True)
    assert not (tmp_path / "a.zarr" / "zarr.json").exists()


# --- what a shader is told, and the command line


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
        (lambda: gv.Labels({1: "reddish"}), "'reddish' is no colour; known: #RRGGBB, black"),
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
        (lambda: gv.Labels(normals="n"), "normals are those of the labels"),
        (lambda: gv.Labels(light="sun"), "light must be a Headlight"),
    ],
)
def test_bad_arguments_have_one_clear_message(make, message):
    with pytest.raises(ValueError) as caught:
        make()
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_producer_of_labels(compiled):
    """A user's own, which tells what its values stand for."""

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


@pytest.mark.backend("cpp")
def test_the_command_line_shows_labels(tmp_path):
    np.save(tmp_path / "a.npy", cells((24, 22, 26), 9) * WIDE)
    size = ("--size", "24x20")
    refused = gvtorch("render", "a.npy", "-o", "a.png", *size, cwd=tmp_path)
    assert refused.returncode == 2 and "--labels" in refused.stderr
    done = gvtorch(
        *("render", "a.npy", "--labels", "-o", "a.png", "--npz", "a.npz", *size), cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    made = gvtorch("convert", "a.npy", "a.zarr", "--labels", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    for shader in ((), ("--shader", "labels")):
        done = gvtorch(
            *("render", "a.zarr", "-o", "b.png", "--npz", "b.npz", *size, *shader), cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr
        with np.load(tmp_path / "a.npz") as a, np.load(tmp_path / "b.npz") as b:
            assert np.array_equal(a["label"], b["label"]) and a["label"].max() > WIDE
            assert np.array_equal(a["color"], b["color"])
    for flags in (("--tf", "bone"), ("--shader", "labels", "--tf", "bone"), ("--threshold", "0")):
        done = gvtorch("render", "a.npy", "--labels", "-o", "a.png", *flags, cwd=tmp_path)
        assert done.returncode == 2 and "labels" in done.stderr, flags
        assert len(done.stderr.splitlines()) == 1
    told = gvtorch("info", "a.zarr", cwd=tmp_path).stdout
    assert "labels" in told


def test_replacing_a_label_volume_keeps_its_filter():
    volume = gv.Volume(numbers(4, 4, 4), labels=True, info=gv.ImageInfo(unit="micrometer"))
    assert volume.info == replace(gv.ImageInfo(unit="micrometer"), labels=True)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("dtype", ["uint32", "uint8"])
def test_label_images_that_another_library_wrote(tmp_path, dtype):
    """By zarr, with one level: coarser ones are made by majority; wide ones are counted off."""
    zarr = pytest.importorskip("zarr")
    data = (cells((40, 36, 44), 12) * (2**28 - 1 if dtype == "uint32" else 21)).astype(dtype)
    group = zarr.open_group(tmp_path / "cells.zarr", mode="w", zarr_format=3)
    group.create_array("0", data=data, chunks=(16, 16, 16))
    axes = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    scale = [{"type": "scale", "scale": [1.3, 0.8, 1.0]}]
    datasets = [{"path": "0", "coordinateTransformations": scale}]
    images = [{"name": "cells", "axes": axes, "datasets": datasets}]
    group.attrs["ome"] = {"version": "0.5", "multiscales": images, "image-label": {}}
    volume = gv.read_volume(tmp_path / "cells.zarr")
    assert volume.info.labels and np.array_equal(kept(volume), data.astype(np.int64))
    store = gv.Store.open(tmp_path / "cells.zarr")
    if dtype == "uint8":
        same_as_resident(store, volume)
    else:
        with pytest.raises(ValueError, match=r"labels of <u4 must be counted off first: gvtorch"):
            gv.StoredProducer(store)
    made = gv.convert(tmp_path / "cells.zarr", tmp_path / "own.zarr")
    assert made.info.labels and made.spacing == SPACING
    same_as_resident(made, volume)
