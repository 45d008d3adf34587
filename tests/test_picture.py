"""Pictures against an independent dense marcher (helpers/marcher.py), and against closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import DEVICES, marcher, shared
from kornia.metrics import psnr
from torch.utils._python_dispatch import TorchDispatchMode

import gvtorch as gv

SIZE = 96
PLACE = {"azimuth": 30.0, "elevation": 20.0, "distance": 2.4, "fov": 30.0}


def dense(volume: gv.Volume, shader: gv.TransferFunction, step: float, size: int = SIZE, **place):
    place = {**PLACE, **place}
    data = volume.data[..., 0].double().numpy()
    rays = marcher.orbit_rays(
        marcher.box_of(data.shape, volume.spacing, volume.origin), **place, width=size, height=size
    )
    reference = shader.reference or min(volume.spacing)
    color, alpha, depth = marcher.march(
        *(data, volume.spacing, volume.origin, rays, shader, reference),
        step=step * min(volume.spacing),
        stop_alpha=0.9999,
    )
    return color.reshape(size, size, 3), alpha.reshape(size, size), depth.reshape(size, size)


def ours(
    volume, shader, backend, size=SIZE, brick_size=8, border=1, branching=2, place=None, **options
):
    tree = gv.N3Tree.from_volume(
        volume, brick_size, border, branching=branching, device=DEVICES[backend]
    )
    camera = gv.Camera.orbit(**{**PLACE, **(place or {})}, width=size, height=size)
    return gv.render(tree, camera, shader, backend=backend, **options)


def assert_agrees(picture: gv.Picture, color: np.ndarray, alpha: np.ndarray) -> None:
    for mine, dense_one in ((picture.color, color), (picture.alpha, alpha[..., None])):
        theirs = torch.from_numpy(dense_one).float()
        error = (mine.cpu() - theirs).abs().max()
        quality = float(psnr(mine.cpu(), theirs, 1.0))
        assert quality >= 45 and error <= 0.02, f"PSNR {quality:.1f} dB, largest error {error:.4f}"
    assert alpha.max() > 0.5 and alpha.min() < 0.5, "the test must see something"


VESSELS = gv.TransferFunction.from_points(
    [(20, 0), (60, 0.3), (120, 0.9)], [(0, 0.5, 0, 0), (60, 0.8, 0.3, 0.1), (255, 1, 1, 0.8)]
)
STENT = gv.TransferFunction.from_points(
    [(900, 0), (1200, 0.2), (1800, 0.9)], [(0, 0.2, 0.1, 0), (1200, 0.9, 0.6, 0.3), (2000, 1, 1, 1)]
)
TOOTH = gv.TransferFunction.preset("tissue", 0, 255)


@pytest.mark.parametrize("step", [0.5, 1.0])
@pytest.mark.parametrize("name", ["aneurism", "stent", "tooth", "blobs", "brain"])
def test_finest_lod_agrees_with_the_dense_marcher(request, compiled, name, step):
    if name == "tooth":
        volume = gv.read_volume(shared("volumes/tooth_103x94x161_uint8.raw.gz"))
    elif name == "brain":
        volume = gv.read_volume(shared("volumes/mni_icbm152_t1_197x233x189_uint8.nii.gz"))
    else:
        volume = request.getfixturevalue(name)
    shader = {"aneurism": VESSELS, "stent": STENT, "tooth": TOOTH}.get(name)
    shader = shader or gv.TransferFunction.preset("hot", *volume.value_range)
    color, alpha, _ = dense(volume, shader, step)
    assert_agrees(ours(volume, shader, compiled, lod="finest", step=step), color, alpha)


@pytest.mark.backend("reference")
def test_reference_agrees_with_the_dense_marcher(blobs):
    shader = gv.TransferFunction.preset("hot", *blobs.value_range)
    color, alpha, _ = dense(blobs, shader, 0.5, 48)
    assert_agrees(ours(blobs, shader, "reference", 48, 4, lod="finest"), color, alpha)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("distance", [0.2, 0.6, 5.0])
def test_agrees_from_inside_and_from_afar(blobs, distance):
    shader = gv.TransferFunction.preset("hot", *blobs.value_range)
    place = {"distance": distance, "azimuth": -140.0, "elevation": -35.0}
    color, _, _ = dense(blobs, shader, 0.5, **place)
    picture = ours(blobs, shader, "cpp", place=place, lod="finest", stop_alpha=1.0)
    theirs = torch.from_numpy(color).float()
    assert (picture.color - theirs).abs().max() < 2e-3


def test_agrees_with_background_and_a_coarse_opaque_pyramid_level(aneurism, compiled):
    shader = VESSELS
    color, alpha, _ = dense(aneurism, shader, 0.5)
    background = (0.2, 0.4, 0.6)
    color = color + (1 - alpha[..., None]) * np.array(background)
    picture = ours(aneurism, shader, compiled, lod="finest", background=background)
    assert (picture.color.cpu() - torch.from_numpy(color).float()).abs().max() <= 0.02


@pytest.mark.parametrize("brick_size", [4, 8, 16])
def test_no_seam_at_brick_faces(compiled, brick_size):
    """Along a smooth ramp the error is no larger near a brick's face than elsewhere."""
    z, y, x = np.mgrid[0:64, 0:64, 0:64].astype(np.float32)
    volume = gv.Volume((x + 0.5 * y + 0.25 * z) / 112)
    tree = gv.N3Tree.from_volume(volume, brick_size, device=DEVICES[compiled])
    shader = gv.TransferFunction.from_points([(0, 0.001), (1, 0.02)], [(0, 1, 0, 0), (1, 0, 0, 1)])
    n = 512
    across = torch.linspace(-0.4, 63.4, n, dtype=torch.float64)
    origin = torch.stack((across, across.flip(0) * 0.5 + 20, torch.full_like(across, -5)), 1)
    direction = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).repeat(n, 1)
    rays = {"origin": origin, "direction": direction}
    limits = torch.tensor([[0.0, 1e9]], dtype=torch.float64).repeat(n, 1)
    device = tree.device
    hits = gv.trace(
        tree,
        gv.Rays(
            **{name: t.to(device) for name, t in rays.items()},
            cone=torch.zeros(n, 2, dtype=torch.float64, device=device),
            range=limits.to(device),
        ),
        shader,
        lod="finest",
        dtype=torch.float64,
        stop_alpha=1.0,
    )
    color, _, _ = marcher.march(
        volume.data[..., 0].double().numpy(),
        *((1, 1, 1), (0, 0, 0), (origin.numpy(), direction.numpy()), shader, 1.0, 0.5),
    )
    error = (hits.color.cpu() - torch.from_numpy(color)).abs().amax(1).numpy()
    face = np.abs(
        (across.numpy() + 0.5) / brick_size - np.round((across.numpy() + 0.5) / brick_size)
    )
    near = face * brick_size < 0.5
    assert error.max() < 1e-6
    assert error[near].mean() <= error[~near].mean() * 1.5 + 1e-12


def test_border_zero_shows_the_seam_that_borders_remove(compiled):
    x = np.mgrid[0:32, 0:32, 0:32][2].astype(np.float32)
    volume = gv.Volume(np.minimum(x, 31 - x))
    shader = gv.TransferFunction.from_points([(0, 0), (15, 0.05)])
    without = ours(volume, shader, compiled, border=0, lod="finest", brick_size=4).alpha
    with_border = ours(volume, shader, compiled, border=1, lod="finest", brick_size=4).alpha
    _, alpha, _ = dense(volume, shader, 0.5)
    seam = (without.cpu()[..., 0] - torch.from_numpy(alpha).float()).abs().max()
    none = (with_border.cpu()[..., 0] - torch.from_numpy(alpha).float()).abs().max()
    assert none < 1e-5 and seam > 1e-3


def ball(radius: float, n: int = 64, value: float = 1.0) -> gv.Volume:
    """Returns a ball with a one-voxel ramp at its face, the ramp's middle at the radius."""
    z, y, x = np.mgrid[0:n, 0:n, 0:n] - (n - 1) / 2
    distance = np.sqrt(x**2 + y**2 + z**2)
    return gv.Volume((np.clip(radius - distance + 0.5, 0, 1) * value).astype(np.float32))


def chord(camera: gv.Camera, volume: gv.Volume, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the length of each pixel's ray inside the ball, and the distance of its near side
    (NaN for a miss).
    """
    tree = gv.N3Tree.from_volume(volume)
    rays = camera.placed(tree.box).rays()
    to_centre = tree.box.mean(0) - rays.origin
    along = (to_centre * rays.direction).sum(1)
    across2 = (to_centre**2).sum(1) - along**2
    half = torch.sqrt((radius**2 - across2).clamp(min=0))
    shape = (camera.height, camera.width)
    near = torch.where(across2 < radius**2, along - half, math.nan)
    return (2 * half).reshape(shape).numpy(), near.reshape(shape).numpy()


def test_homogeneous_ball_follows_beer_and_lambert(backend):
    radius, opacity = 28.0, 0.005
    size = 32 if backend == "reference" else 96
    volume = ball(radius, 72)
    camera = gv.Camera.orbit(**PLACE, width=size, height=size)
    shader = gv.TransferFunction.from_points([(0, 0), (1, opacity)])
    tree = gv.N3Tree.from_volume(volume, device=DEVICES[backend])
    picture = gv.render(
        tree, camera, shader, backend=backend, lod="finest", step=0.25, stop_alpha=1.0
    )
    length, _ = chord(camera, volume, radius)
    expected = 1 - (1 - opacity) ** length
    # Near the rim a ray runs along the face, where the error is that of the voxels, not of the
    # renderer.
    grazing = (length < 1.5 * radius) & (chord(camera, volume, radius + 1.5)[0] > 0)
    error = np.abs(picture.alpha.cpu()[..., 0].numpy() - expected)[~grazing]
    assert error.max() < 1e-3 and expected.max() > 0.2


def test_homogeneous_box_is_exact(backend):
    """A volume of one value is one CONSTANT region: closed form, whatever the step."""
    volume = gv.Volume(torch.full((20, 30, 25), 7, dtype=torch.uint8), spacing=(1, 1, 2))
    tree = gv.N3Tree.from_volume(volume, device=DEVICES[backend])
    assert tree.bricks.capacity == 0
    shader = gv.TransferFunction.from_points([(7, 0.05)], [(7, 0.2, 0.5, 1)], reference=1.5)
    camera = gv.Camera.orbit(**PLACE, width=40, height=40)
    picture = gv.render(
        tree, camera, shader, backend=backend, step=3.0, stop_alpha=1.0, lod="finest"
    )
    rays = camera.placed(tree.box).rays()
    a, b = ((face - rays.origin) / rays.direction for face in tree.box)
    length = (torch.maximum(a, b).amin(1) - torch.minimum(a, b).amax(1)).clamp(min=0)
    expected = (1 - 0.95 ** (length / 1.5)).reshape(40, 40).float()
    torch.testing.assert_close(picture.alpha.cpu()[..., 0], expected, rtol=0, atol=2e-6)
    assert expected.max() > 0.5 and int(picture.samples.max()) == 1


@pytest.mark.parametrize("step", [0.25, 0.5])
def test_depth_of_an_opaque_sphere(backend, step):
    radius = 20.0
    volume = ball(radius)
    size = 32 if backend == "reference" else 80
    camera = gv.Camera.orbit(**PLACE, width=size, height=size)
    shader = gv.TransferFunction.from_points([(0.499, 0), (0.501, 1)])
    tree = gv.N3Tree.from_volume(volume, device=DEVICES[backend])
    picture = gv.render(tree, camera, shader, backend=backend, lod="finest", step=step)
    length, near = chord(camera, volume, radius)
    depth = picture.depth.cpu()[..., 0].numpy()
    facing = length > 12  # on grazing rays, a fraction of a voxel across is many along
    assert np.abs(depth - near)[facing].max() < 0.5
    outside = chord(camera, volume, radius + 1.5)[0] == 0
    assert np.isinf(depth[outside]).all() and facing.sum() > 20 and outside.sum() > 20


def test_auto_lod_is_close_to_the_finest_and_cheaper(aneurism, compiled):
    place = {"distance": 3.0}
    fine = ours(aneurism, VESSELS, compiled, place=place, lod="finest", step=0.5)
    auto = ours(aneurism, VESSELS, compiled, place=place, lod="auto", step=0.5)
    assert auto.stats.samples < 0.9 * fine.stats.samples
    assert auto.stats.bricks_used < 0.2 * fine.stats.bricks_used
    assert psnr(auto.color.cpu(), fine.color.cpu(), 1.0) > 20


def test_levels_blend_without_a_step(compiled):
    """As the cone widens through three levels, a ray's colour changes smoothly."""
    z, y, x = np.mgrid[0:64, 0:64, 0:64] - 31.5
    volume = gv.Volume(np.exp(-(x**2 + y**2 + z**2) / (2 * 7.0**2)).astype(np.float32))
    tree = gv.N3Tree.from_volume(volume, 8, device=DEVICES[compiled])
    n = 300
    cone = torch.stack((torch.linspace(1.1, 7.9, n), torch.zeros(n)), 1)
    rays = gv.Rays(
        origin=torch.tensor([[33.0, 35.0, -10.0]]).repeat(n, 1).to(tree.device),
        direction=torch.tensor([[0.0, 0.0, 1.0]]).repeat(n, 1).to(tree.device),
        cone=cone.to(tree.device),
        range=torch.tensor([[0.0, math.inf]]).repeat(n, 1).to(tree.device),
    )
    haze = gv.TransferFunction.from_points([(0, 0), (1, 0.01)])
    hits = gv.trace(tree, rays, haze, cone_scale=1.0)
    alpha = hits.alpha.cpu()[:, 0].numpy()
    steps = np.abs(np.diff(alpha))
    assert alpha.max() - alpha.min() > 0.01, "wider cones see a blurred ball"
    assert steps.max() < 0.05 * (alpha.max() - alpha.min())


def test_thresholded_regions_take_no_bricks_and_look_the_same(aneurism, compiled):
    camera = gv.Camera.orbit(**PLACE, width=SIZE, height=SIZE)
    device = DEVICES[compiled]
    full = gv.N3Tree.from_volume(aneurism, device=device)
    cut = gv.N3Tree.from_volume(aneurism, threshold=20, device=device)
    assert cut.bricks.capacity < 0.8 * full.bricks.capacity
    a = gv.render(full, camera, VESSELS, lod="finest")
    b = gv.render(cut, camera, VESSELS, lod="finest")
    assert torch.equal(a.color, b.color), "below 20 this transfer function shows nothing"
    assert b.stats.samples < a.stats.samples


@pytest.mark.parametrize("threshold", [None, 0.0, 5.0])
def test_all_empty_volume_renders_the_background(backend, threshold):
    volume = gv.Volume(np.zeros((9, 17, 33), np.uint8))
    tree = gv.N3Tree.from_volume(volume, threshold=threshold, device=DEVICES[backend])
    shader = gv.TransferFunction.preset("gray", *volume.value_range)
    camera = gv.Camera.orbit(width=16, height=8)
    picture = gv.render(tree, camera, shader, backend=backend, background=(0.1, 0.2, 0.3))
    assert picture.alpha.max() == 0 and torch.isinf(picture.depth).all()
    assert torch.allclose(picture.color.cpu(), torch.tensor([0.1, 0.2, 0.3]))


def test_a_batch_of_cameras_equals_one_by_one(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, device=DEVICES[backend])
    shader = gv.TransferFunction.preset("hot", 0, 1)
    batch = gv.Camera.orbit([0, 90, 180], [10, -20, 90], 2.0, 30, 20, 12)
    pictures = gv.render(tree, batch, shader, backend=backend)
    assert pictures.color.shape == (3, 12, 20, 3) and pictures.depth.shape == (3, 12, 20, 1)
    for index in range(3):
        single = gv.render(tree, batch[index], shader, backend=backend)
        assert single.color.shape == (12, 20, 3)
        assert torch.equal(single.color, pictures.color[index])


def test_stats_count_what_was_used(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[backend])
    camera = gv.Camera.orbit(width=16, height=16)
    picture = gv.render(tree, camera, gv.TransferFunction.preset("hot", 0, 1), backend=backend)
    stats = picture.stats
    assert stats.rays == 256 and stats.samples == int(picture.samples.sum()) > 0
    assert 0 < stats.bricks_used <= stats.bricks == tree.bricks.capacity
    assert 0 < stats.tiles_used <= tree.nodes.capacity and stats.bytes == tree.nbytes
    assert stats.backend == backend and stats.milliseconds > 0


def test_a_picture_larger_than_memory_fails_before_the_first_ray(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, device=DEVICES[backend])
    view = torch.eye(4, dtype=torch.float64).expand(2**12, 4, 4)
    camera = gv.Camera(view, torch.diag(torch.tensor([9.0, 9.0, 1.0])), 65536, 65536)
    shader = gv.TransferFunction.preset("gray", 0, 1)
    with pytest.raises(ValueError, match=r"a picture of 17592186044416 pixels takes .* GiB"):
        gv.render(tree, camera, shader, backend=backend)


def test_wrong_arguments_are_named(blobs):
    tree, camera = gv.N3Tree.from_volume(blobs), gv.Camera.orbit(width=4, height=4)
    shader = gv.TransferFunction.preset("gray", 0, 1)
    with pytest.raises(ValueError, match="unknown option 'stepp'"):
        gv.render(tree, camera, shader, stepp=1)
    with pytest.raises(
        ValueError, match="shader must be a TransferFunction or another shader, got str"
    ):
        gv.render(tree, camera, "gray")
    with pytest.raises(ValueError, match="unknown channel 'density'; the tree has value"):
        gv.render(tree, camera, shader, channel="density")
    with pytest.raises(ValueError, match="intervals"):
        gv.render(tree, camera, shader, step=1e-20)
    with pytest.raises(ValueError, match=r"can't be used here|does not run"):
        gv.render(tree, camera, shader, backend="cuda")


@pytest.mark.parametrize("distance", [1e3, 1e5, 1e7])
def test_far_cameras_with_narrow_views_see_the_same(blobs, compiled, distance):
    fov = math.degrees(2 * math.atan(0.6 / distance))
    shader = gv.TransferFunction.preset("hot", *blobs.value_range)
    place = {"distance": distance, "fov": fov}
    color, alpha, _ = dense(blobs, shader, 0.5, 24, **place)
    picture = ours(blobs, shader, compiled, 24, place=place, lod="finest", stop_alpha=1.0)
    error = np.abs(picture.color.cpu().numpy() - color).max()
    assert error < (2e-3 if distance < 1e6 else 0.02) and alpha.max() > 0.5


def test_a_ray_along_the_high_face_sees_the_volume(backend):
    volume = gv.Volume(np.random.default_rng(0).random((24, 24, 24)).astype(np.float32))
    tree = gv.N3Tree.from_volume(volume, 8, device=DEVICES[backend])
    faces = torch.tensor([[-0.5, 12.0, -9.0], [23.5, 12.0, -9.0]])
    rays = gv.Rays(
        origin=faces.to(tree.device),
        direction=torch.tensor([[0.0, 0.0, 1.0]]).repeat(2, 1).to(tree.device),
        cone=torch.zeros(2, 2, device=tree.device),
        range=torch.tensor([[0.0, math.inf]]).repeat(2, 1).to(tree.device),
    )
    shader = gv.TransferFunction.from_points([(0, 0), (1, 0.2)])
    alpha = gv.trace(tree, rays, shader, backend=backend).alpha
    assert alpha.min() > 0.5


def test_flat_voxels_are_not_undersampled(compiled):
    """Spacing 1, 1, 8: `auto` is no further from a supersampled picture than `finest` is."""
    noise = np.random.default_rng(1).random((8, 64, 64)).astype(np.float32)
    volume = gv.Volume(noise, (1, 1, 8))
    shader = gv.TransferFunction.from_points([(0.3, 0), (1, 0.1)])
    place = {"distance": 2.0}
    fine = ours(volume, shader, compiled, 128, place=place, lod="finest").alpha
    truth = fine.reshape(16, 8, 16, 8).mean((1, 3)).cpu()
    errors = {
        lod: (ours(volume, shader, compiled, 16, place=place, lod=lod).alpha[..., 0].cpu() - truth)
        for lod in ("auto", "finest")
    }
    assert errors["auto"].abs().max() < 1.2 * errors["finest"].abs().max()


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("spacing", [(1, 1, 1), (1, 1, 10), (1e-3, 1e-3, 2e-3), (1e4, 2e4, 1e4)])
@pytest.mark.parametrize("extent", [(1, 1, 1), (1, 7, 3), (33, 2, 18), (65, 9, 30)])
def test_odd_extents_and_spacings_agree_with_the_dense_marcher(extent, spacing):
    z, y, x = np.mgrid[0 : extent[2], 0 : extent[1], 0 : extent[0]]
    data = 100 + 50 * np.sin(0.5 * x + 1) + 40 * np.cos(0.4 * y) * np.sin(0.6 * z + 0.3)
    volume = gv.Volume(data.astype(np.float32), spacing, [3 * s for s in spacing])
    shader = gv.TransferFunction.from_points(
        [(60, 0), (120, 0.05), (200, 0.4)], [(0, 1, 0, 0), (200, 0, 0.3, 1)]
    )
    for place in ({}, {"distance": 0.3}):
        color, _, _ = dense(volume, shader, 0.5, 24, **place)
        for brick_size, border, branching in ((8, 1, 2), (3, 1, 3), (16, 2, 2), (2, 1, 4)):
            picture = ours(
                *(volume, shader, "cpp", 24, brick_size, border, branching, place),
                lod="finest",
                stop_alpha=1.0,
            )
            assert np.abs(picture.color.numpy() - color).max() < 1e-3


class Operations(TorchDispatchMode):
    """Counts torch operations."""

    calls = 0

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # else torch imports its compiler, for seconds, so that it leaves this alone

    def __torch_dispatch__(self, op: Any, types: Any, args: Any = (), named: Any = None) -> Any:
        self.calls += 1
        return op(*args, **(named or {}))


def test_a_picture_takes_few_operations_of_torch(blobs, compiled):
    """Each costs microseconds: 23 on the CPU, a tenth of a millisecond, and 2 for given rays. A GPU
    needs some more to upload the camera.
    """
    tree = gv.N3Tree.from_volume(blobs, device=DEVICES[compiled])
    camera = gv.Camera.orbit(**PLACE, width=64, height=64)
    rays = camera.placed(tree.box).rays(tree.device)
    shader = gv.TransferFunction.preset("gray", 0, 1)
    more = 0 if compiled == "cpp" else 10
    for show, seen, max_calls in ((gv.render, camera, 24), (gv.trace, rays, 3)):
        show(tree, seen, shader)  # prepares the tables
        with Operations() as operations:
            show(tree, seen, shader)
        assert 1 < operations.calls <= max_calls + more
