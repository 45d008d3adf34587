"""Camera models and custom rays: directions and cones in closed form, kornia's models, pictures."""

from __future__ import annotations

import dataclasses
import math
import typing

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.pictures import GRAY
from helpers.waits import nobody_waits
from kornia.geometry.camera import distort_points_kannala_brandt, project_points_orthographic

import gvtorch as gv
from gvtorch.cameras.models import (
    MODELS,
    CameraModel,
    distort,
    last_rising_angle,
    undistort,
)

BEND = [0.08, -0.03, 0.004, -0.0005]
WIDTH, HEIGHT = 14, 10


def view() -> torch.Tensor:
    """Returns world-to-camera of a camera in a general pose."""
    return gv.Camera.look_at((3, 2, 5), (0.5, 0.2, -1), (0.1, 1, 0.3)).viewmats[0]


def askew(model: str, **options) -> gv.Camera:
    """Returns a camera whose parameters all differ."""
    f = {"pinhole": (11.0, 13.0), "ortho": (2.0, 2.5), "fisheye": (4.0, 4.5), "panorama": (2.2, 3)}
    fx, fy = f[model]
    K = torch.tensor([[fx, 0, 6.6], [0, fy, 5.3], [0, 0, 1]], dtype=torch.float64)
    return gv.Camera(view(), K, WIDTH, HEIGHT, model=model, **options)


def local_ray(model: str, x: float, y: float) -> tuple[list[float], list[float]]:
    """Returns the origin and direction of one pixel in camera axes."""
    r = math.hypot(x, y)
    if model == "pinhole":
        return [0, 0, 0], [part / math.sqrt(x * x + y * y + 1) for part in (x, y, 1)]
    if model == "ortho":
        return [x, y, 0], [0, 0, 1]
    if model == "fisheye":
        return [0, 0, 0], [math.sin(r) * x / r, math.sin(r) * y / r, math.cos(r)]
    return [0, 0, 0], [math.sin(x) * math.cos(y), math.sin(y), math.cos(x) * math.cos(y)]


def test_editors_know_every_model():
    assert typing.get_args(CameraModel) == tuple(MODELS)


@pytest.mark.parametrize("model", MODELS)
def test_rays_follow_the_formula_of_their_model(model):
    camera = askew(model)
    rays, K = camera.rays(), camera.Ks[0]
    rotation, move = camera.viewmats[0, :3, :3].numpy(), camera.viewmats[0, :3, 3].numpy()
    for row in range(HEIGHT):
        for column in range(WIDTH):
            x, y = (
                float((column + 0.5 - K[0, 2]) / K[0, 0]),
                float((row + 0.5 - K[1, 2]) / K[1, 1]),
            )
            origin, direction = local_ray(model, x, y)
            index = row * WIDTH + column
            actual = rays.origin[index].numpy(), rays.direction[index].numpy()
            np.testing.assert_allclose(rotation @ actual[0] + move, origin, atol=1e-12)
            np.testing.assert_allclose(rotation @ actual[1], direction, atol=1e-12)
    assert rays.width == WIDTH


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_cones_are_as_wide_as_pixels_are_apart(model, bent):
    """The larger singular value of the derivative of the ray by the pixel's position, by
    differences of a thousandth of a pixel. A pinhole's cone is that of the axis."""
    if bent and model != "fisheye":
        pytest.skip("only a fisheye is bent")
    camera = askew(model, radial_coeffs=BEND) if bent else askew(model)
    h = 1e-3
    slopes = []
    for dx, dy in ((h, 0), (0, h)):
        ahead, back = camera.shifted(dx, dy).rays(), camera.shifted(-dx, -dy).rays()
        pairs = ((ahead.origin, back.origin), (ahead.direction, back.direction))
        slopes.append(torch.stack([(a - b) / (2 * h) for a, b in pairs], 1))  # (r, 2, 3)
    widest = torch.linalg.svdvals(torch.stack(slopes, -1))[..., 0]  # (r, 2): origin, direction
    rays = camera.rays()
    inside = rays.range[:, 1] > 0
    if model in ("ortho", "panorama"):
        torch.testing.assert_close(rays.cone[inside], widest[inside], atol=1e-6, rtol=1e-6)
    elif model == "pinhole":
        axis = widest[:, 1].argmax()
        assert bool((widest[:, 1] <= rays.cone[:, 1] * (1 + 1e-6)).all())
        assert float(widest[axis, 1]) == pytest.approx(float(rays.cone[axis, 1]), rel=5e-3)
    else:  # fx and fy differ: the cone is that of the shorter
        assert bool((widest[inside, 1] <= rays.cone[inside, 1] * (1 + 1e-6)).all())
        even = gv.Camera(
            *(view(), torch.tensor([[4.0, 0, 7.3], [0, 4, 5.2], [0, 0, 1]]), WIDTH, HEIGHT),
            model="fisheye",
            radial_coeffs=BEND if bent else None,
        )
        slopes = [
            (even.shifted(dx, dy).rays().direction - even.shifted(-dx, -dy).rays().direction)
            / (2 * h)
            for dx, dy in ((h, 0), (0, h))
        ]
        widest = torch.linalg.svdvals(torch.stack(slopes, -1))[..., 0]
        even_rays = even.rays()
        inside = even_rays.range[:, 1] > 0
        assert inside.sum() > 100
        torch.testing.assert_close(even_rays.cone[inside, 1], widest[inside], atol=0, rtol=1e-3)
    assert bool((rays.cone[:, 0] == 0).all()) == (model != "ortho")


def test_kornia_bends_the_rays_of_a_fisheye_back_to_their_pixels():
    camera = gv.Camera(
        *(torch.eye(4), torch.tensor([[9.0, 0, 7.2], [0, 8.0, 5.1], [0, 0, 1]]), WIDTH, HEIGHT),
        model="fisheye",
        radial_coeffs=BEND,
    )
    x, y, z = camera.rays().direction.unbind(1)
    assert z.min() > 0.3
    K = camera.Ks[0]
    numbers = [K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5, *BEND]
    pixels = distort_points_kannala_brandt(
        torch.stack((x / z, y / z), 1), torch.tensor(numbers, dtype=torch.float64).expand(140, 8)
    )
    v, u = torch.meshgrid(torch.arange(10.0), torch.arange(14.0), indexing="ij")
    torch.testing.assert_close(
        pixels.reshape(10, 14, 2), torch.stack((u, v), -1).double(), atol=1e-9, rtol=0
    )


def test_kornia_projects_parallel_rays_back_onto_their_pixels():
    camera = askew("ortho")
    rays = camera.rays()
    points = rays.origin + 3.7 * rays.direction
    local = points @ camera.viewmats[0, :3, :3].mT + camera.viewmats[0, :3, 3]
    flat = project_points_orthographic(local)
    K = camera.Ks[0]
    pixels = flat * K[(0, 1), (0, 1)] + K[:2, 2] - 0.5
    v, u = torch.meshgrid(torch.arange(10.0), torch.arange(14.0), indexing="ij")
    torch.testing.assert_close(
        pixels.reshape(10, 14, 2), torch.stack((u, v), -1).double(), atol=1e-9, rtol=0
    )


@pytest.mark.parametrize("k", [[0.0] * 4, BEND, [0.3, 0, 0, 0], [-0.1, 0, 0, 0], [0, 0, 0, -0.01]])
def test_bending_is_undone_up_to_where_it_rises(k):
    coefficients = torch.tensor([k], dtype=torch.float64)
    last = last_rising_angle(coefficients[0])
    if k == [-0.1, 0, 0, 0]:
        assert last == pytest.approx(math.sqrt(1 / 0.3))
    if k[0] >= 0 and k != BEND and k[3] == 0:
        assert last == math.pi
    angle = torch.linspace(0, last * 0.999, 500, dtype=torch.float64)[None]
    limit = torch.tensor([[last]], dtype=torch.float64)
    again = undistort(distort(angle, coefficients), coefficients, limit)
    torch.testing.assert_close(again, angle, atol=1e-9, rtol=0)


@pytest.mark.parametrize("fov", [60.0, 180.0, 300.0, 360.0])
def test_rays_outside_the_circle_are_closed(fov):
    camera = gv.Camera.look_at((0, 0, 0), (0, 0, -1), fov=fov, width=40, height=30, model="fisheye")
    rays = camera.rays()
    v, u = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    radius = torch.hypot(u + 0.5 - 20, v + 0.5 - 15).flatten()
    opened = rays.range[:, 1] > rays.range[:, 0]
    assert torch.equal(opened, radius <= 15)
    angle = torch.acos(-rays.direction[:, 2].clamp(-1, 1))
    torch.testing.assert_close(
        angle[opened], (radius * math.radians(fov) / 30)[opened].double(), atol=1e-6, rtol=1e-6
    )


def test_a_closed_ray_shows_the_background_and_takes_no_sample(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, device=DEVICES[backend])
    camera = gv.Camera.orbit(distance=0.2, fov=200, width=16, height=12, model="fisheye")
    sky = (0.2, 0.4, 0.6)
    picture = gv.render(tree, camera, GRAY, backend=backend, background=sky)
    outside = (camera.placed(tree.box).rays().range[:, 1] == 0).reshape(12, 16)
    assert outside.sum() > 40 and (~outside).sum() > 80
    seen = picture.color.cpu()[outside]
    assert torch.equal(seen, torch.tensor(sky).expand_as(seen))
    assert picture.samples.cpu()[outside].max() == 0 < picture.samples.max()


@pytest.mark.parametrize("model", MODELS)
def test_a_batch_is_its_cameras_one_by_one(blobs, compiled, model):
    tree = gv.N3Tree.from_volume(blobs, device=DEVICES[compiled])
    batch = gv.Camera.orbit([0, 90, 180], 10, [0.4, 1, 2.0], None, 12, 8, model)
    pictures = gv.render(tree, batch, GRAY, backend=compiled)
    assert pictures.alpha.max() > 0
    for index in range(3):
        single = gv.render(tree, batch[index], GRAY, backend=compiled)
        assert torch.equal(single.color, pictures.color[index])


@pytest.mark.parametrize("model", MODELS)
def test_one_set_of_numbers_serves_every_camera_of_a_form(model):
    """As in a CUDA graph: another camera's numbers are copied over those of the first one."""
    bend = {"radial_coeffs": BEND} if model == "fisheye" else {}
    first, other = askew(model, **bend), askew(model, **bend)
    other = other.shifted(0.3, -2)
    other.viewmats[:, :3, 3] += 1
    numbers = first.numbers()
    numbers.copy_(other.numbers())
    replayed, expected = first.pixel_rays(numbers, (2, 7)), other.rays(rows=(2, 7))
    assert first.form == other.form and not first.same(other)
    for name in ("origin", "direction", "cone", "range"):
        assert torch.equal(getattr(replayed, name), getattr(expected, name))


def test_an_orthographic_orbit_is_a_pinhole_from_afar():
    box = torch.tensor([[1.0, 2, 3], [5, 4, 4]], dtype=torch.float64)
    near = gv.Camera.orbit(30, 20, 2.4, 30, 16, 12, "ortho").placed(box)
    far = 1e7
    angle = 2 * math.degrees(math.atan(2.4 * math.tan(math.radians(15)) / far))
    pinhole = gv.Camera.orbit(30, 20, far, angle, 16, 12).placed(box).rays()
    rays = near.rays()
    # Both cross the plane through the middle of the box at the same points.
    points = [
        ortho.origin
        + ((box.mean(0) - ortho.origin) * rays.direction).sum(1, keepdim=True)
        / (ortho.direction * rays.direction).sum(1, keepdim=True)
        * ortho.direction
        for ortho in (rays, pinhole)
    ]
    torch.testing.assert_close(points[0], points[1], atol=1e-5, rtol=0)
    assert float(rays.cone[0, 0]) == pytest.approx(2 * 2.4 * 4 * math.tan(math.radians(15)) / 12)
    at_target = gv.Camera.look_at((0, 0, 7), (0, 0, 0), fov=40, width=8, height=8, model="ortho")
    assert float(8 / at_target.Ks[0, 1, 1]) == pytest.approx(2 * 7 * math.tan(math.radians(20)))


def test_an_orthographic_picture_of_a_homogeneous_box(backend):
    volume = gv.Volume(torch.full((6, 10, 10), 1.0), origin=(0.5, 0.5, 0.5))
    tree = gv.N3Tree.from_volume(volume, device=DEVICES[backend])
    shader = gv.TransferFunction.from_points([(1, 0.1)], reference=1.0)
    camera = gv.Camera.look_at((5, 5, 20), (5, 5, 3), width=9, height=9, fov=40, model="ortho")
    picture = gv.render(tree, camera, shader, backend=backend, stop_alpha=1.0)
    rays = camera.rays()
    inside = ((rays.origin[:, :2] > 0) & (rays.origin[:, :2] < 10)).all(1).reshape(9, 9)
    expected = torch.where(inside, 1 - 0.9**6, 0.0).float()
    torch.testing.assert_close(picture.alpha.cpu()[..., 0], expected, atol=2e-6, rtol=0)
    depth = picture.depth.cpu()[..., 0][inside]
    torch.testing.assert_close(depth, torch.full_like(depth, 15.0), atol=0, rtol=1e-5)
    assert 10 < inside.sum() < 81


def test_wide_parallel_pixels_read_coarse_levels(aneurism, compiled):
    tree = gv.N3Tree.from_volume(aneurism, device=DEVICES[compiled])
    shader = gv.TransferFunction.preset("vessels", 0, 255)
    used = [
        gv.render(tree, gv.Camera.orbit(width=n, height=n, model="ortho"), shader).stats.tiles_used
        for n in (16, 64, 256)
    ]
    assert used[0] < 0.2 * used[1] < 0.1 * used[2]


def test_a_panorama_from_the_middle_of_a_shell_has_one_depth(compiled):
    z, y, x = np.mgrid[0:48, 0:48, 0:48] - 23.5
    volume = gv.Volume(np.clip(np.sqrt(x * x + y * y + z * z) - 15.5, 0, 1).astype(np.float32))
    tree = gv.N3Tree.from_volume(volume, device=DEVICES[compiled])
    shader = gv.TransferFunction.from_points([(0.49, 0), (0.51, 1)])
    middle = tree.box.mean(0)
    camera = gv.Camera.look_at(
        middle, middle + torch.tensor([0, 0, -1.0]), width=48, height=24, model="panorama"
    )
    depth = gv.render(tree, camera, shader, step=0.25).depth
    assert (depth - 16).abs().max() < 0.3


@pytest.mark.parametrize("form", ["rays", "custom"])
def test_rays_make_the_picture_of_their_camera(blobs, backend, form):
    tree = gv.N3Tree.from_volume(blobs, device=DEVICES[backend])
    camera = gv.Camera.orbit(width=16, height=12)
    whole = gv.render(tree, camera, GRAY, backend=backend)
    rays = camera.placed(tree.box).rays(tree.device)
    source = rays if form == "rays" else gv.CustomCamera(rays, 16, 12)
    for picture in (
        gv.render(tree, source, GRAY, backend=backend),
        gv.render(tree, gv.CustomCamera(rays[:]), GRAY, backend=backend),
    ):
        assert torch.equal(picture.color.flatten(0, -2), whole.color.flatten(0, -2))
        assert torch.equal(picture.depth.flatten(), whole.depth.flatten())
    assert picture.color.shape == (1, 192, 3) and whole.alpha.max() > 0


@pytest.mark.backend("cpp")
def test_an_engine_streams_what_any_rays_ask_for(blobs):
    camera = gv.Camera.orbit([0.0, 70.0], distance=1.2, width=16, height=12)
    tree = gv.N3Tree.from_volume(blobs, 4)
    whole = gv.render(tree, camera, GRAY)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        custom = gv.CustomCamera(camera.placed(engine.box).rays(), 16, 12)
        assert len(custom) == 2 and custom.batched
        picture = engine.render(custom, GRAY)
        assert picture.stats.converged and torch.equal(picture.color, whole.color)
        frame, stats = engine.frame(custom[1].placed(engine.box), GRAY)
        assert torch.equal(frame.color, whole.color[1]) and stats.rays == 192


@pytest.mark.parametrize("model", MODELS)
def test_cones_of_custom_rays_come_from_their_neighbours(model):
    camera = gv.Camera.look_at((0, 0, 4), (0, 0, 0), fov=60, width=64, height=48, model=model)
    rays = camera.rays()
    shape = (48, 64, 3)
    custom = gv.CustomCamera.from_directions(
        rays.origin.reshape(shape), 3 * rays.direction.reshape(shape)
    )
    derived = custom.rays().cone.reshape(48, 64, 2)[20:28, 28:36]
    exact = rays.cone.reshape(48, 64, 2)[20:28, 28:36]
    torch.testing.assert_close(derived, exact, atol=1e-9, rtol=0.02)
    with_cone = gv.CustomCamera.from_directions(
        rays.origin[0], rays.direction.reshape(shape), cone=torch.tensor([0.1, 0.2])
    )
    assert bool((with_cone.rays().cone == torch.tensor([0.1, 0.2]).double()).all())
    moved, expected = custom.shifted(0.3, -0.4).rays(), camera.shifted(0.3, -0.4).rays()
    for name in ("origin", "direction"):
        error = getattr(moved, name) - getattr(expected, name)
        middle = error.reshape(shape)[1:-1, 1:-1]
        assert middle.abs().max() < 0.05 * rays.cone.max()


@pytest.mark.parametrize("model", MODELS)
def test_strips_are_rows_of_the_whole(model):
    camera = askew(model)
    strip, whole = camera.strip(3, 8).strip(1, 4), camera.rays(rows=(4, 7))
    assert strip.height == 3 and strip.window == (4, HEIGHT)
    for name in ("origin", "direction", "cone", "range"):
        torch.testing.assert_close(getattr(strip.rays(), name), getattr(whole, name))


def test_gsplat_words_are_taken():
    views, Ks = torch.eye(4).expand(2, 3, 4, 4), torch.eye(3).expand(2, 3, 3, 3) * 1.0
    camera = gv.Camera.from_viewmat_K(
        *(views, Ks, 8, 6), camera_model="fisheye", radial_coeffs=torch.zeros(2, 3, 4) + 0.01
    )
    assert len(camera) == 6 and camera.model == "fisheye" and camera.distorted
    assert gv.Camera.from_viewmat_K(views, Ks, 8, 6, camera_model="ortho").model == "ortho"


@pytest.mark.backend("cuda")
@pytest.mark.parametrize("model", [*MODELS, "bent", "custom"])
def test_graphs_on_cuda_replay_every_model(blobs, model):
    sky = gv.Environment(torch.rand(8, 16, 3))
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, device="cuda") as engine:
        kind = model if model in MODELS else "fisheye" if model == "bent" else "pinhole"
        views = [
            gv.Camera.orbit(a, 20, 0.8, None, 32, 24, kind).placed(engine.box) for a in (0, 20)
        ]
        if model == "bent":
            views = [
                gv.Camera(v.viewmats[0], v.Ks[0], 32, 24, model=kind, radial_coeffs=BEND)
                for v in views
            ]
        if model == "custom":
            views = [gv.CustomCamera(v.rays("cuda")) for v in views]
        for view in [*views, *views]:
            assert engine.render(view, GRAY, background=sky).stats.converged
        expected = [engine.frame(view, GRAY, background=sky)[0] for view in views]
        graph = engine.capture(views[0], GRAY, background=sky)
        with nobody_waits():
            for view in views:
                engine.frame(view, GRAY, background=sky)
            seen = [graph.replay(view)[0].color.clone() for view in [*views, *views]]
        for replayed, whole in zip(seen, [*expected, *expected], strict=True):
            assert torch.equal(replayed, whole.color)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gv.Camera.orbit(model="wide"), "model must be 'pinhole', 'ortho', 'fisheye'"),
        (lambda: gv.Camera(torch.eye(4), torch.eye(3), 4, 4, model="sphere"), "model must be"),
        (lambda: gv.Camera.orbit(fov=180), "fov must be finite and >= 1e-12 and <= 179"),
        (
            lambda: gv.Camera.orbit(fov=361, model="fisheye"),
            "fov must be finite and >= 1e-12 and <= 360",
        ),
        (lambda: gv.Camera.orbit(fov=181, model="panorama"), "and <= 180"),
        (lambda: askew("pinhole", radial_coeffs=BEND), "radial_coeffs are for a fisheye"),
        (lambda: askew("fisheye", radial_coeffs=[1, 2]), r"must be \(4,\) or \(1, 4\), got \(2,\)"),
        (lambda: askew("fisheye", radial_coeffs=[math.nan] * 4), "radial_coeffs must be finite"),
        (lambda: askew("fisheye", max_angle=0), "max_angle must be finite and > 0"),
        (lambda: askew("ortho").to_kornia(), "must be a pinhole, is 'ortho'"),
        (lambda: gv.Camera.orbit(model="ortho").rays(), "placed"),
        (
            lambda: gv.Camera(torch.eye(4), torch.zeros(3, 3), 4, 4, model="ortho"),
            "positive focal lengths",
        ),
        (
            lambda: gv.CustomCamera(askew("pinhole").rays(), 9, 9),
            "140 rays do not make pictures of 9x9",
        ),
        (
            lambda: gv.CustomCamera(
                gv.Rays(
                    *[], **{n: torch.ones(4, 3) for n in ("origin", "direction", "cone", "range")}
                )
            ),
            r"rays\.cone must be \(4, 2\) float, got \(4, 3\)",
        ),
        (
            lambda: gv.CustomCamera(
                gv.Rays(
                    origin=torch.ones(4, 3),
                    direction=torch.ones(4, 3),
                    cone=torch.ones(4, 2),
                    range=torch.ones(4, 2),
                )
            ),
            "unit length, 4 are not",
        ),
        (
            lambda: gv.CustomCamera.from_directions(
                torch.zeros(3), torch.tensor([[[0.0, 0, 2], [0, 0, 0], [0, 0, 1e-20]]])
            ),
            "unit length, 1 are not",
        ),
        (
            lambda: gv.CustomCamera.from_directions(
                torch.tensor([[[0.0], [math.nan]]]), torch.tensor([0.0, 0, 1]).expand(1, 2, 3)
            ),
            "rays must not be NaN, 2 are",
        ),
        (
            lambda: gv.CustomCamera(
                dataclasses.replace(askew("pinhole").rays(), transmittance=torch.ones(140))
            ),
            "rays of a picture must have no transmittance",
        ),
        (
            lambda: gv.CustomCamera.from_directions(torch.ones(2, 3), torch.ones(5, 4, 3)),
            r"origin must broadcast to \(5, 4, 3\)",
        ),
        (
            lambda: gv.CustomCamera.from_directions(torch.ones(3), torch.ones(0, 4, 3)),
            r"direction must be \(h, w, 3\) or \(n, h, w, 3\), got \(0, 4, 3\)",
        ),
        (
            lambda: gv.CustomCamera.from_directions(torch.ones(3), torch.ones(4, 3)),
            r"direction must be \(h, w, 3\)",
        ),
    ],
)
def test_bad_cameras_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
