"""OpenGL's matrices and depth against closed forms, and a real rasteriser that crosses a volume."""

from __future__ import annotations

import importlib
import math
import sys

import pytest
import torch
from helpers import ROOT
from helpers.layers import SOLID, ball, layer_of, plane_distances, seam_error
from helpers.opengl import no_vtk

import gvtorch as gv
from gvtorch.opengl import ClipDepth, matrices, ray_distance, window_depth
from gvtorch.ops import unavailable

EYES = torch.tensor([[3.0, 2.0, 5.0], [-4.0, 1.0, 2.0]])


def off_centre(batched: bool = False) -> gv.Camera:
    """Returns a camera with an off-centre principal point and unequal focal lengths."""
    eyes = EYES if batched else EYES[0]
    camera = gv.Camera.look_at(eyes, (0.5, 0, 0), fov=35, width=23, height=14)
    K = camera.Ks.clone()
    K[:, 0, 0] *= 1.3
    K[:, 0, 2] += 2.7
    K[:, 1, 2] -= 1.9
    return gv.Camera(*((camera.viewmats, K) if batched else (camera.viewmats[0], K[0])), *(23, 14))


def pipeline(projection, modelview, points, clip_depth):
    """Returns OpenGL's window coordinates (k, 3) of points in 23 x 14 pixels: x, y up, depth."""
    clip = torch.cat((points, torch.ones_like(points[:, :1])), 1) @ (projection @ modelview).mT
    ndc = clip[:, :3] / clip[:, 3:]
    size = torch.tensor([23, 14], dtype=torch.float64)
    zero_to_one = clip_depth is ClipDepth.ZERO_TO_ONE
    depth = ndc[:, 2:] if zero_to_one else (ndc[:, 2:] + 1) / 2
    return torch.cat(((ndc[:, :2] + 1) / 2 * size, depth), 1)


@pytest.mark.parametrize("far", [12.0, math.inf])
@pytest.mark.parametrize("reversed_z", [False, True])
@pytest.mark.parametrize("clip_depth", ClipDepth)
def test_opengl_draws_what_our_rays_see(clip_depth, reversed_z, far):
    """A point on the ray of a pixel is drawn at that pixel's centre, with the depth that
    `window_depth` gives; to float64's rounding."""
    camera = off_centre()
    projection, modelview = matrices(
        camera, 0.25, far, clip_depth=clip_depth, reversed_z=reversed_z
    )
    rays = camera.rays()
    distance = torch.rand(14, 23, 1, generator=torch.Generator().manual_seed(1)).double() * 8 + 1
    points = rays.origin + distance.reshape(-1, 1) * rays.direction
    window = pipeline(projection, modelview, points, clip_depth).reshape(14, 23, 3)
    row, column = torch.meshgrid(torch.arange(14.0), torch.arange(23.0), indexing="ij")
    assert (window[..., 0] - (column + 0.5)).abs().max() < 1e-12
    assert (14 - window[..., 1] - (row + 0.5)).abs().max() < 1e-12
    depth = window_depth(distance, projection, clip_depth=clip_depth)
    assert (depth - window[..., 2:]).abs().max() < 1e-14
    again = ray_distance(window[..., 2:], projection, clip_depth=clip_depth)
    assert (again / distance - 1).abs().max() < 1e-13


@pytest.mark.parametrize("reversed_z", [False, True])
@pytest.mark.parametrize("clip_depth", ClipDepth)
def test_near_and_far_planes_have_the_depths_of_the_book(clip_depth, reversed_z):
    camera = gv.Camera.look_at((0, 0, 5), (0, 0, 0), width=1, height=1)
    projection, _ = matrices(camera, 0.5, 20, clip_depth=clip_depth, reversed_z=reversed_z)
    near, far = (1.0, 0.0) if reversed_z else (0.0, 1.0)
    depths = {0.5: near, 20.0: far, 0.1: near, 50.0: far, math.inf: far, 0.0: near}
    for distance, expected in depths.items():
        image = torch.full((1, 1, 1), distance, dtype=torch.float64)
        assert float(window_depth(image, projection, clip_depth=clip_depth)) == pytest.approx(
            expected, abs=1e-14
        )
    cleared = torch.full((1, 1, 1), far)
    assert float(ray_distance(cleared, projection, clip_depth=clip_depth)) == math.inf
    # The book's formula: z_ndc = (f + n) / (f - n) - 2 f n / ((f - n) z).
    if clip_depth is ClipDepth.NEGATIVE_ONE_TO_ONE and not reversed_z:
        book = torch.tensor([-20.5 / 19.5, -20 / 19.5], dtype=torch.float64)
        torch.testing.assert_close(projection[2, 2:], book)


def test_what_float32_keeps():
    """The relative error of a distance d: forward up to 2^-24 d / near, reversed 2^-23, with a far
    plane at infinity."""
    camera = off_centre()
    distance = torch.logspace(-0.9, 4, 14 * 23, dtype=torch.float64).reshape(14, 23, 1)
    errors = {}
    for reversed_z in (False, True):
        projection, _ = matrices(
            camera, 0.1, clip_depth=ClipDepth.ZERO_TO_ONE, reversed_z=reversed_z
        )
        depth = window_depth(distance, projection, clip_depth=ClipDepth.ZERO_TO_ONE).float()
        again = ray_distance(depth, projection, clip_depth=ClipDepth.ZERO_TO_ONE)
        error = (again / distance - 1).abs()
        limit = 2.0**-23 if reversed_z else 2.0**-24 * (distance / 0.1).clamp(min=1) * 1.2
        assert (error <= limit).all()
        errors[reversed_z] = float(error.max())
    print(f"relative error to 10^5 near: {errors[False]:.1e} forward, {errors[True]:.1e} reversed")
    assert errors[False] > 1e-4, "the test must see something"


def test_orthographic_depth_is_linear():
    ortho = torch.diag(torch.tensor([0.2, 0.4, -2 / 9, 1], dtype=torch.float64))
    ortho[2, 3] = -11 / 9  # near 1, far 10
    depth = torch.linspace(0, 1, 10).double().reshape(2, 5, 1)
    distance = ray_distance(depth, ortho)
    assert distance.flatten()[:-1].tolist() == pytest.approx([float(n) for n in range(1, 10)])
    assert float(distance[1, 4]) == math.inf
    assert torch.allclose(window_depth(distance, ortho), depth)
    flipped = ortho.clone()
    flipped[2] = torch.tensor([0, 0, 1 / 9, 10 / 9], dtype=torch.float64)  # reversed, zero to one
    turned = ray_distance(1 - depth, flipped, clip_depth=ClipDepth.ZERO_TO_ONE)
    torch.testing.assert_close(turned, distance)


@pytest.mark.parametrize("batched", [False, True])
def test_cameras_come_back(batched):
    camera = off_centre(batched)
    again = gv.opengl.camera(*matrices(camera, 0.1, 9), 23, 14)
    assert again.batched == batched and len(again) == len(camera)
    torch.testing.assert_close(again.Ks, camera.Ks, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(again.viewmats, camera.viewmats, rtol=0, atol=0)
    depth = torch.rand(*((2,) if batched else ()), 14, 23, 1)
    projection, _ = matrices(camera, 0.1, 9)
    whole = ray_distance(depth, projection)
    if batched:
        for i in range(2):
            assert torch.equal(whole[i], ray_distance(depth[i], projection[i]))


def test_perspective_of_the_book_is_our_camera():
    """gluPerspective(40 degrees, 2, ...) at the origin looks along -z, y up."""
    tall = 1 / math.tan(math.radians(20))
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1], projection[3, 2] = tall / 2, tall, -1
    projection[2, 2], projection[2, 3] = -1.1, -2.1
    ours = gv.Camera.look_at((0, 0, 0), (0, 0, -1), fov=40, width=64, height=32)
    rays = gv.opengl.camera(projection, torch.eye(4), 64, 32).rays()
    torch.testing.assert_close(rays.direction, ours.rays().direction, rtol=0, atol=1e-7)


def test_what_is_wrong_is_named():
    camera, image = off_centre(), torch.ones(14, 23, 1)
    projection, modelview = matrices(camera, 0.1, 9)
    skewed, flat, mirrored = (projection.clone() for _ in range(3))
    skewed[0, 1], flat[2, 3], mirrored[1, 1] = 0.1, 0, -1
    ortho = torch.diag(torch.tensor([1.0, 1, -1, 1]))
    fisheye = gv.Camera.look_at((0, 0, 0), (0, 0, -1), fov=90, model="fisheye")
    for call, message in (
        (lambda: matrices(gv.Camera.orbit(), 0.1), "matrices: an orbit camera has no position yet"),
        (lambda: matrices(fisheye, 0.1), "matrices: camera must be a pinhole camera, got Camera"),
        (lambda: matrices(camera, 0), "near must be finite and > 0"),
        (lambda: matrices(camera, 2, 1), "far must be finite and > 2"),
        (lambda: matrices(camera, 1, math.nan), "far must be finite"),
        (lambda: matrices(camera, 1, clip_depth="zero"), "clip_depth must be a ClipDepth"),
        (lambda: ray_distance(image[..., 0], projection), r"window_depth must be \(h, w, 1\)"),
        (lambda: ray_distance(image.int(), projection), "window_depth must be .* floats"),
        (lambda: window_depth(image, projection[None]), r"distance must be \(1, h, w, 1\)"),
        (lambda: ray_distance(image, projection[:3]), r"projection must be \(4, 4\)"),
        (lambda: ray_distance(image, skewed), "projection must be without skew"),
        (lambda: ray_distance(image, flat), "keep depths apart"),
        (lambda: ray_distance(image, mirrored), "by more than 0"),
        (lambda: ray_distance(image, projection * math.nan), "projection must be finite"),
        (lambda: gv.opengl.camera(ortho, modelview, 2, 2), "must be perspective"),
        (lambda: gv.opengl.camera(projection, 2 * modelview, 2, 2), "viewmats"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.fixture(scope="module")
def vtk():
    """The example that draws with VTK; skips the test where VTK can't draw."""
    if reason := no_vtk():
        pytest.skip(reason)
    sys.path.insert(0, str(ROOT / "examples"))
    try:
        return importlib.import_module("mixed_triangles")
    finally:
        sys.path.pop(0)


def square(vtk, corners):
    """Returns two triangles of a parallelogram with three given corners: source, position and
    colour.
    """
    plane = vtk.vtk.vtkPlaneSource()
    plane.SetOrigin(*corners[0])
    plane.SetPoint1(*corners[1])
    plane.SetPoint2(*corners[2])
    return plane, (0, 0, 0), (0.1, 0.2, 0.9)


@pytest.mark.backend("opengl")
def test_vtk_draws_our_pixels_at_our_distances(vtk):
    """A tilted square: the pixels that it covers, and its distances, computed from its plane."""
    camera = gv.Camera.look_at((30, 20, 80), (3, -2, 1), fov=30, width=200, height=150)
    K = camera.Ks.clone()
    K[:, 0, 2] += 13.25
    camera = gv.Camera(camera.viewmats[0], K[0], 200, 150)
    corners = torch.tensor([[-12, -10, 3], [14, -12, -4], [-10, 11, 0]], dtype=torch.float64)
    sides = corners[1:] - corners[0]
    layer = vtk.rasterise([square(vtk, corners.tolist())], camera, near=40, far=160)
    normal = torch.linalg.cross(sides[0], sides[1])
    distance = plane_distances(camera, corners[0], tuple(normal.tolist()))
    rays = camera.rays()
    offset = rays.origin + distance.reshape(-1, 1) * rays.direction - corners[0]
    share = torch.linalg.lstsq(sides.T, offset.T).solution.T.reshape(150, 200, 2)  # 0 to 1 inside
    margin = torch.minimum(share, 1 - share).amin(-1)
    drawn = (layer.depth < math.inf)[..., 0]
    assert drawn.sum() > 3000
    edge = margin.abs() < 1e-3  # of a side, about 0.1 pixel: fixed-point coordinates of OpenGL
    assert torch.equal(drawn[~edge], (margin > 0)[~edge])
    error = (layer.depth - distance)[drawn].abs().max()
    print(f"depth of VTK: off by {float(error):.2e} of about 85")
    assert error < 1e-3
    assert (layer.color[drawn][:, 2] > layer.color[drawn][:, 0]).all()


@pytest.mark.backend("opengl")
@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("tilt", [0.0, 25.0])
def test_the_seam_of_vtks_triangles_and_a_ball_is_exact_to_a_pixel(vtk, tilt, device):
    if device == "cuda" and (reason := unavailable()["cuda"]):
        pytest.skip(f"backend cuda: {reason}")
    radius, height, far = 20.0, 12.0, 60
    angle = math.radians(tilt)
    eye = (160 * math.sin(angle), 0.0, 160 * math.cos(angle))
    view = gv.Camera.look_at(eye, (0, 0, height), fov=20, width=160, height=160)
    corners = [(-far, -far, height), (far, -far, height), (-far, far, height)]
    layer = vtk.rasterise([square(vtk, corners)], view, near=80, far=300, device=device)
    tree = gv.N3Tree.from_volume(ball(radius, 48), device=device)
    picture = gv.render(tree, view, SOLID, layer=layer, step=0.1, lod="finest")
    error = seam_error(picture, view, height, radius)
    exact = layer_of(plane_distances(view, torch.tensor([0, 0, height]).double(), (0, 0, 1.0)))
    other = gv.render(tree, view, SOLID, layer=exact, step=0.1, lod="finest")
    print(f"seam: {error:.3f} pixels; drawn analytically {seam_error(other, view, height, radius)}")
    assert error <= 1.0
