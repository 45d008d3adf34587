"""`ThinLens`: the cone, compared with a thin lens of many rays, and its cost."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.rays import camera_rays
from helpers.traces import SHADER, assert_equal

import gvtorch as gv
from gvtorch.base.constants import CONE_OVERESTIMATE
from gvtorch.tracing.thin_lens import ThroughLens

FOCUS = 2.0  # sides of the box
RAYS = 64  # through the lens, for each pixel: SSIM differs by less than 1e-4 from that of 256


def scene(side: int = 96) -> gv.Volume:
    """Returns balls in front of, in and behind the focus of a camera that looks along -z."""
    z, y, x = np.mgrid[0:side, 0:side, 0:side].astype(np.float32) / side * 2 - 1
    value = np.zeros_like(x)
    for cx, cy, cz, r in ((-0.5, -0.3, -0.7, 0.22), (0.1, 0, 0, 0.25), (0.5, 0.4, 0.7, 0.22)):
        distance = np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2)
        stripes = 0.75 + 0.25 * np.sin(40 * (x + y))
        value = np.maximum(value, np.clip((r - distance) / 0.04, 0, 1) * stripes)
    return gv.Volume(torch.from_numpy((255 * value).astype(np.uint8)))


@pytest.fixture(scope="module")
def tree() -> gv.N3Tree:
    return gv.N3Tree.from_volume(scene())


def camera(size: int) -> gv.Camera:
    return gv.Camera.orbit(0, 0, FOCUS, 32, size, size)


def medium(opacity: float) -> gv.TransferFunction:
    return gv.TransferFunction.from_points(
        [(0, 0), (255, opacity)], [(0, 1, 0.6, 0.3), (255, 1, 0.6, 0.3)]
    )


def thin_lens(tree, camera, shader, aperture: float, rays_a_pixel: int) -> torch.Tensor:
    """Returns the mean of pinhole pictures from points all over the lens, with one focus."""
    placed = camera.placed(tree.box)
    rays, rotation = placed.rays(), placed.viewmats[0, :3, :3]
    side = float((tree.box[1] - tree.box[0]).max())
    sharp = rays.origin + FOCUS * side * rays.direction
    total = torch.zeros_like(rays.origin)
    for number in range(rays_a_pixel):
        radius = aperture / 2 * side * math.sqrt((number + 0.5) / rays_a_pixel)
        turn = number * math.pi * (3 - math.sqrt(5))
        origin = rays.origin + radius * (
            math.cos(turn) * rotation[0] + math.sin(turn) * rotation[1]
        )
        direction = torch.nn.functional.normalize(sharp - origin)
        total += gv.trace(
            tree, dataclasses.replace(rays, origin=origin, direction=direction), shader
        ).color
    return (total / rays_a_pixel).reshape(camera.height, camera.width, 3)


def similarity(a: torch.Tensor, b: torch.Tensor) -> float:
    from kornia.metrics import ssim

    planes = [t.float().movedim(-1, 0)[None].clamp(0, 1) for t in (a, b)]
    return float(ssim(*planes, window_size=11).mean())


@functools.cache
def grains(side: int = 96, count: int = 150) -> gv.Volume:
    """Returns small balls all over the box."""
    generator = np.random.default_rng(1)
    grid = np.mgrid[0:side, 0:side, 0:side].astype(np.float32) / side * 2 - 1
    value = np.zeros((side,) * 3, np.float32)
    for _ in range(count):
        center, r = generator.uniform(-0.9, 0.9, 3), generator.uniform(0.05, 0.13)
        ends = [((center[::-1] + way * r + 1) / 2 * side).astype(int) for way in (-1, 1)]
        box = tuple(slice(max(low, 0), high + 2) for low, high in zip(*ends, strict=True))
        z, y, x = grid[:, *box]
        cx, cy, cz = center
        distance = np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2)
        ball = np.clip((r - distance) / 0.03, 0, 1) * generator.uniform(0.3, 1)
        value[box] = np.maximum(value[box], ball)
    return gv.Volume(torch.from_numpy((255 * value).astype(np.uint8)))


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(("opacity", "aperture"), [(0.03, 0.3), (0.03, 0.4)])
def test_moderate_blur_agrees_with_64_rays_through_the_lens(opacity, aperture):
    tree, view = gv.N3Tree.from_volume(grains()), gv.Camera.orbit(20, 15, FOCUS, 26, 96, 96)
    colors = [(0, 0.2, 0.4, 1), (128, 1, 0.3, 0.2), (255, 1, 0.9, 0.5)]
    shader = gv.TransferFunction.from_points([(0, 0), (255, opacity)], colors)
    expected = thin_lens(tree, view, shader, aperture, RAYS)
    lens = gv.ThinLens(aperture=aperture, focus=FOCUS, frame="box")
    agreed = similarity(gv.render(tree, view, shader, lens=lens).color, expected)
    sharp = similarity(gv.render(tree, view, shader).color, expected)
    print(f"opacity {opacity}, aperture {aperture}: SSIM {agreed:.4f}, without a lens {sharp:.4f}")
    assert agreed >= 0.95 and 1 - agreed < 0.8 * (1 - sharp)
    assert expected.max() > 0.15, "the test must see something"


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_stored_colours_blur_as_a_lens_does_where_matter_is_opaque():
    """Only stored colours, because a transfer function of mean densities gives other colours."""
    volume, view = grains(), gv.Camera.orbit(20, 15, FOCUS, 26, 96, 96)
    colors = [(0, 0.2, 0.4, 1), (128, 1, 0.3, 0.2), (255, 1, 0.9, 0.5)]
    function = gv.TransferFunction.from_points([(20, 0), (60, 0.1), (255, 0.5)], colors)
    rgba = torch.from_numpy(function(volume.data[..., 0].float().numpy())).float()
    rgba[..., :3] *= rgba[..., 3:]
    lens = gv.ThinLens(aperture=0.2, focus=FOCUS, frame="box")
    agreed = {}
    for name, tree, shader in (
        ("density", gv.N3Tree.from_volume(volume), function),
        (
            "colour",
            gv.N3Tree.from_volume(gv.Volume(rgba.half())),
            gv.StoredColor("value", premultiplied=True),
        ),
    ):
        expected = thin_lens(tree, view, shader, 0.2, RAYS)
        agreed[name] = similarity(gv.render(tree, view, shader, lens=lens).color, expected)
    print("SSIM: " + ", ".join(f"{name} {value:.4f}" for name, value in agreed.items()))
    assert agreed["colour"] >= 0.95 > agreed["density"]


def test_the_cone_is_the_pixels_and_the_circle_of_confusion():
    """Closed form: cone + 0.3 * aperture * |t - focus| / focus, and never below the pixel's."""
    rays = gv.Rays(
        origin=torch.zeros(3, 3, dtype=torch.float64),
        direction=torch.eye(3, dtype=torch.float64),
        cone=torch.tensor([[0.0, 0.01], [0.1, 0.0], [0.0, 0.002]], dtype=torch.float64),
        range=torch.tensor([[0.0, 9.0], [1.0, torch.inf], [6.0, 7.0]], dtype=torch.float64),
    )
    seen = []

    def record(piece: gv.Rays) -> gv.Hits:
        seen.append(piece)
        zero = torch.zeros(3, 1)
        count = torch.zeros(3, dtype=torch.int32)
        return gv.Hits(
            color=torch.zeros(3, 3), alpha=zero, depth=zero, samples=count, missed=count > 0
        )

    lens = gv.ThinLens(aperture=0.6, focus=4.0)
    ThroughLens(record, lens, CONE_OVERESTIMATE)(rays)
    front, back = seen
    assert front.range.tolist() == [[0, 4], [1, 4], [6, 4]]  # the last one is closed
    assert back.range.tolist() == [[4, 9], [4, torch.inf], [6, 7]]
    for piece, distances in ((front, (0, 1, 3.9, 4)), (back, (4, 4.1, 6, 40))):
        for t in distances:
            wide = piece.cone[:, 0] + t * piece.cone[:, 1]
            pixel = rays.cone[:, 0] + t * rays.cone[:, 1]
            blur = 0.3 * 0.6 * abs(t - 4) / 4 / CONE_OVERESTIMATE
            torch.testing.assert_close(wide, pixel + blur, rtol=0, atol=1e-12)


@pytest.mark.backend("cpp")
def test_what_is_in_focus_stays_sharp_and_what_is_not_blurs(tree):
    """Edges of three slabs, 10 % to 90 %, are as wide as the disc of confusion, or a third."""
    side, size = 96, 192
    pixel = 2 * math.tan(math.radians(16)) / size  # a distance of 1
    for z, shift in ((0.06, 0.44), (0.5, 0.0), (0.94, -0.44)):
        data = torch.zeros(side, side, side, dtype=torch.uint8)
        data[int(z * side) - 2 : int(z * side) + 3, :, : side // 2 + 3] = 200
        edge = gv.N3Tree.from_volume(gv.Volume(data))
        widths = []
        for aperture in (0.0, 0.6):
            lens = gv.ThinLens(aperture=aperture, focus=FOCUS, frame="box")
            image = gv.render(edge, camera(size), medium(0.01), lens=lens).color
            profile = image[size // 2 - 20 : size // 2 + 20, :, 0].mean(0)
            profile = profile / profile[size // 2 - 25 : size // 2 - 15].mean()
            first = int((profile[size // 2 - 20 :] < 0.9).nonzero()[0])
            widths.append(int((profile[size // 2 - 20 :] < 0.1).nonzero()[0]) - first)
        disc = 0.6 * abs(shift) / FOCUS / (pixel * (FOCUS + shift))
        assert widths[0] <= 4
        if shift:
            assert disc / 3 <= widths[1] <= 1.2 * disc and widths[1] >= 2 * widths[0]
        else:
            assert widths[1] <= widths[0] + 1


@pytest.mark.parametrize("aperture", [0.05, 0.4])
def test_compiled_equals_reference_through_a_lens(blobs, compiled, aperture):
    tree = gv.N3Tree.from_volume(blobs, 4)
    lens = gv.ThinLens(aperture=aperture, focus=1.3, frame="box")
    result, *_ = assert_equal(tree, compiled, camera_rays(tree, distance=1.3), lens=lens)
    assert result["alpha"].max() > 0.3


def test_more_blur_needs_fewer_bricks_and_samples(compiled):
    """The engine never loads details that the blur hides."""
    used, samples, pictures = [], [], []
    for aperture in (0.0, 0.1, 0.4, 1.6):
        lens = gv.ThinLens(aperture=aperture, focus=1.2, frame="box")
        producer = gv.VolumeProducer(scene(64))
        with gv.Engine(
            producer, node_pool="1 MB", brick_pool="4 MB", device=DEVICES[compiled]
        ) as engine:
            picture = engine.render(camera(32), SHADER_255, lens=lens)
        assert picture.stats.converged
        used.append(picture.stats.produced["bricks"])
        samples.append(picture.stats.samples)
        pictures.append(picture.color)
        resident = gv.N3Tree.from_volume(scene(64), device=DEVICES[compiled])
        same = gv.render(resident, camera(32), SHADER_255, lens=lens)
        torch.testing.assert_close(picture.color, same.color, rtol=0, atol=1e-6)
    assert used == sorted(used, reverse=True) and used[-1] < used[0] / 3
    assert samples[-1] < samples[0]


SHADER_255 = medium(0.3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"aperture": -1.0, "focus": 1.0}, "aperture must be finite and >= 0"),
        ({"aperture": math.nan, "focus": 1.0}, "aperture must be finite"),
        ({"aperture": 0.1, "focus": 0.0}, "focus must be finite and > 0"),
        ({"aperture": 0.1, "focus": 1.0, "frame": "moon"}, "frame must be 'world' or 'box'"),
    ],
)
def test_a_wrong_lens_is_one_clear_error(options, message):
    with pytest.raises(ValueError, match=message):
        gv.ThinLens(**options)


def test_a_lens_needs_levels_of_detail(tree):
    lens = gv.ThinLens(aperture=0.1, focus=1.0)
    with pytest.raises(ValueError, match="lod must be 'auto'"):
        gv.render(tree, camera(8), SHADER, lens=lens, lod="finest")
    with pytest.raises(ValueError, match="lens must be a ThinLens, got float"):
        gv.render(tree, camera(8), SHADER, lens=0.1)
