"""Cameras: their positions, what their rays hit, and the conventions of other libraries."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from helpers import DEVICES
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.depth import unproject_meshgrid

import gvtorch as gv
from gvtorch import ops
from gvtorch.base.volume import DIRECTIONS
from gvtorch.cameras.custom import CustomCamera
from gvtorch.tracing import pixels
from gvtorch.tracing.tracer import Tracer

BOX = torch.tensor([[1.0, 2.0, 3.0], [5.0, 4.0, 4.0]], dtype=torch.float64)


def centre_of(camera: gv.Camera) -> torch.Tensor:
    return -(camera.viewmats[:, :3, :3].mT @ camera.viewmats[:, :3, 3:])[..., 0]


@pytest.mark.parametrize("elevation", [-90.0, -30.0, 0.0, 20.0, 90.0, 130.0])
@pytest.mark.parametrize("azimuth", [0.0, 30.0, 200.0])
def test_orbit_stands_where_the_formula_says(azimuth, elevation):
    camera = gv.Camera.orbit(azimuth, elevation, 2.4, 30, 64, 48).placed(BOX)
    az, el = math.radians(azimuth), math.radians(elevation)
    out = [math.sin(az) * math.cos(el), math.sin(el), math.cos(az) * math.cos(el)]
    out = torch.tensor(out, dtype=torch.float64)
    expected = BOX.mean(0) + 2.4 * 4 * out
    torch.testing.assert_close(centre_of(camera)[0], expected)
    rays = camera.rays()
    middle = rays.direction.reshape(48, 64, 3)[23:25, 31:33].mean((0, 1))
    torch.testing.assert_close(middle / middle.norm(), -out, atol=1e-12, rtol=0)


def test_up_is_up_and_right_is_right():
    rays = gv.Camera.orbit(0, 0, 2, 40, 9, 9).placed(BOX).rays()
    direction = rays.direction.reshape(9, 9, 3)
    assert direction[0, 4, 1] > 0 > direction[8, 4, 1]
    assert direction[4, 8, 0] > 0 > direction[4, 0, 0]


def test_vertical_field_of_view_and_cone():
    camera = gv.Camera.look_at((0, 0, 5), (0, 0, 0), fov=40, width=200, height=100)
    rays = camera.rays()
    edge = rays.direction.reshape(100, 200, 3)[0, 99]
    slope = -float(edge[1] / edge[2])
    half_pixel = math.tan(math.radians(20)) / 100
    assert slope == pytest.approx(math.tan(math.radians(20)) - half_pixel, rel=1e-9)
    assert rays.cone[0].tolist() == pytest.approx([0, 2 * half_pixel])
    assert torch.allclose(rays.direction.norm(dim=1), torch.ones(20000, dtype=torch.float64))


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1)])
def test_look_at_survives_a_parallel_up(up):
    eye = torch.tensor(up) * 3.0
    camera = gv.Camera.look_at(eye, (0, 0, 0), up, 30, 8, 8)
    assert torch.isfinite(camera.viewmats).all()
    torch.testing.assert_close(centre_of(camera)[0], eye.double())


def test_kornia_projects_our_rays_back_onto_their_pixels():
    camera = gv.Camera.look_at((3, 2, 5), (0.5, 0, 0), fov=35, width=12, height=8)
    rays = camera.rays()
    kornia = camera.to_kornia()
    pixels = kornia.project((rays.origin + 2.5 * rays.direction)[None])[0].reshape(8, 12, 2)
    v, u = torch.meshgrid(torch.arange(8.0), torch.arange(12.0), indexing="ij")
    torch.testing.assert_close(pixels, torch.stack((u, v), -1).double(), atol=1e-9, rtol=0)


def test_from_kornia_and_back():
    camera = gv.Camera.orbit([0, 40], 10, 2.0, 30, 16, 12).placed(BOX)
    again = gv.Camera.from_kornia(camera.to_kornia())
    assert (again.width, again.height, len(again)) == (16, 12, 2)
    torch.testing.assert_close(again.viewmats, camera.viewmats)
    torch.testing.assert_close(again.Ks, camera.Ks)
    ours, theirs = camera.rays(), again.rays()
    torch.testing.assert_close(ours.direction, theirs.direction)


def test_from_kornia_takes_its_own_constructor():
    intrinsics = torch.eye(4)[None].clone()
    intrinsics[0, 0, 0] = intrinsics[0, 1, 1] = 20
    intrinsics[0, :2, 2] = torch.tensor([7.5, 5.5])  # kornia: the middle of 16 x 12 pixels
    kornia = PinholeCamera(intrinsics, torch.eye(4)[None], torch.tensor([12]), torch.tensor([16]))
    rays = gv.Camera.from_kornia(kornia).rays()
    middle = rays.direction.reshape(12, 16, 3)[5:7, 7:9].mean((0, 1))
    torch.testing.assert_close(middle[:2], torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)


def test_from_viewmat_K_is_opencv():
    """A camera at (0, 0, -2) that looks along +z, x right, y down; pixel centres at +0.5."""
    view = torch.eye(4)
    view[2, 3] = 2
    K = torch.tensor([[50.0, 0, 16], [0, 50, 8], [0, 0, 1]])
    rays = gv.Camera.from_viewmat_K(view, K, 32, 16).rays()
    assert torch.equal(rays.origin[0], torch.tensor([0, 0, -2], dtype=torch.float64))
    corner = rays.direction[0] / rays.direction[0, 2]
    assert corner.tolist() == pytest.approx([-15.5 / 50, -7.5 / 50, 1])


def test_up_is_plus_y_beyond_the_pole():
    camera = gv.Camera.orbit(30, 120, 2, 40, 9, 9).placed(BOX)
    other = gv.Camera.look_at(centre_of(camera)[0], BOX.mean(0), fov=40, width=9, height=9)
    torch.testing.assert_close(camera.rays().direction, other.rays().direction)


@pytest.mark.parametrize("up", [*DIRECTIONS, (1.0, 2.0, -0.5)])
def test_orbits_around_any_axis_are_turned_ones(up):
    """The eye's elevation is about that axis, and the picture is upright; right is +x."""
    angles = torch.linspace(-180, 180, 13), 25.0, 2.0
    camera = gv.Camera.orbit(*angles, 30, 9, 9, up=up).placed(BOX)
    axis = torch.tensor(up, dtype=torch.float64) if isinstance(up, tuple) else None
    if axis is None:
        axis = torch.zeros(3, dtype=torch.float64)
        axis["xyz".index(up[1])] = 1 if up[0] == "+" else -1
    axis = axis / axis.norm()
    eye = centre_of(camera) - BOX.mean(0)
    height = torch.full((13,), 8 * math.sin(math.radians(25)), dtype=torch.float64)
    torch.testing.assert_close(eye @ axis, height)
    other = gv.Camera.look_at(centre_of(camera), BOX.mean(0), axis, 30, 9, 9)
    torch.testing.assert_close(camera.viewmats, other.viewmats)
    right = gv.Camera.orbit(0, 0, 2.0, up=up).viewmats[0, 0, :3]
    assert right[0] > 0.5 or (up[1] == "x" and right[1] == 1)
    turning = gv.Camera.orbit([0, 90], 0, 2.0, up=up)
    across = torch.linalg.cross(*centre_of(turning))
    torch.testing.assert_close(across / 4, axis)


def test_up_plus_y_has_the_bits_it_had():
    """The name gives the default's bits; a vector is a rotation by nothing, up to rounding."""
    plain = gv.Camera.orbit([10, 200, -30], [20, 95, 0], 1.7)
    named = gv.Camera.orbit([10, 200, -30], [20, 95, 0], 1.7, up="+y")
    assert plain.same(named)
    torch.testing.assert_close(
        plain.viewmats,
        gv.Camera.orbit([10, 200, -30], [20, 95, 0], 1.7, up=(0, 3, 0)).viewmats,
        atol=1e-15,
        rtol=0,
    )


def seen_corners(camera: gv.Camera, box: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the corners of a box in the picture, -1 to 1 in x and y, and their depths."""
    corners = torch.stack([box[ends, (0, 1, 2)] for ends in itertools.product((0, 1), repeat=3)])
    view, K = camera.viewmats[0], camera.Ks[0]
    x, y, z = (corners @ view[:3, :3].T + view[:3, 3]).unbind(1)
    if camera.model == "pinhole":
        plane = torch.stack((x / z, y / z))
    elif camera.model == "ortho":
        plane = torch.stack((x, y))
    elif camera.model == "fisheye":
        angle = torch.atan2(torch.hypot(x, y), z)
        plane = torch.stack((x, y)) * angle / torch.hypot(x, y)
    else:
        plane = torch.stack((torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))))
    pixel = plane * K[(0, 1), (0, 1), None] + K[:2, 2:]
    size = torch.tensor([[camera.width], [camera.height]])
    return 2 * pixel / size - 1, z


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_fitted_box_is_whole_and_fills_the_picture(data):
    model = data.draw(st.sampled_from(["pinhole", "ortho", "fisheye", "panorama"]))
    widest = {"pinhole": 150, "ortho": 150, "fisheye": 360, "panorama": 180}[model]
    fov = data.draw(st.one_of(st.none(), st.floats(2, widest)))
    size = data.draw(st.tuples(st.integers(8, 900), st.integers(8, 900)))
    sides = torch.tensor(data.draw(st.tuples(*[st.floats(0.05, 20)] * 3)), dtype=torch.float64)
    low = torch.tensor(data.draw(st.tuples(*[st.floats(-90, 90)] * 3)), dtype=torch.float64)
    up = data.draw(st.sampled_from([*DIRECTIONS, (1, 1, 3)]))
    angles = data.draw(st.tuples(st.floats(-400, 400), st.floats(-180, 180)))
    box = torch.stack((low, low + sides))
    camera = gv.Camera.orbit(*angles, None, fov, *size, model, up=up, fit=True)
    placed = camera.placed(box)
    corners, depth = seen_corners(placed, box)
    assert corners.abs().max() < 0.985 and depth.min() > 0
    if model in ("pinhole", "ortho"):
        assert corners.abs().max() > 0.95
    else:  # not closer than where the box spans 90 degrees
        half = (fov or 180) / 2
        wide = half * size[0] / size[1] if model == "fisheye" else 2 * half
        x, y, z = _corners_along(placed, box)
        spans = [math.tan(math.radians(min(45, 0.98 * part))) for part in (wide, half)]
        if model == "fisheye":
            filled = torch.hypot(x, y) / z / min(spans)
        else:
            filled = torch.maximum(x / spans[0], y / spans[1]) / z
        assert float(filled.max()) == pytest.approx(1)
    # Strips and samples of a pixel give the same: the whole picture is fitted.
    strip = camera.strip(3, 7).placed(box)
    assert torch.equal(strip.viewmats, placed.viewmats)
    assert torch.equal(camera.shifted(0.3, -0.2).placed(box).viewmats, placed.viewmats)
    fitted = gv.Camera.fit(box, *angles, fov, *size, model, up=up)
    assert fitted.same(placed) and not camera.same(gv.Camera.orbit(*angles, 1.0, fov, *size, model))


def _corners_along(camera: gv.Camera, box: torch.Tensor) -> list[torch.Tensor]:
    corners = torch.stack([box[ends, (0, 1, 2)] for ends in itertools.product((0, 1), repeat=3)])
    view = camera.viewmats[0]
    return list((corners @ view[:3, :3].T + view[:3, 3]).abs().unbind(1))


@pytest.mark.parametrize("model", ["pinhole", "ortho"])
@pytest.mark.parametrize("up", ["+y", "-z"])
def test_a_path_around_a_box_keeps_it_whole_and_its_distance(model, up):
    size = (300, 200)
    path = gv.CameraPath.orbit(BOX, model, 25, elevation=35, up=up, fit_size=size)
    cameras = [path.camera(index / 60, *size, model) for index in range(61)]
    extents = [float(seen_corners(camera, BOX)[0].abs().max()) for camera in cameras]
    assert max(extents) < 1 and max(extents) > 0.95
    eyes = torch.cat([centre_of(camera) for camera in cameras])
    far = (eyes - BOX.mean(0)).norm(dim=1)
    assert far.max() / far.min() < 1.002  # not exactly: the curve is open
    axis = "xyz".index(up[1])
    assert (eyes[:, axis] - eyes[0, axis]).abs().max() < 1e-9


@pytest.mark.parametrize("elevation", [90, -90, 40])
def test_a_path_turns_around_a_box_above_and_below_it_too(elevation):
    path = gv.CameraPath.orbit(BOX, elevation=elevation)
    for key in (0, 9, 20, 36):
        orbit = gv.Camera.orbit(30 + 10 * key, elevation, width=8, height=8).placed(BOX)
        camera = path.camera(key / 36, 8, 8)
        torch.testing.assert_close(camera.viewmats, orbit.viewmats, atol=1e-6, rtol=0)


def test_a_path_keeps_its_fields_of_view_between_those_of_the_keys():
    path = gv.CameraPath([(0, 0, 5)] * 4, [(0, 0, 0)] * 4, fov=[5, 5, 90, 90])
    fovs = []
    for at in torch.linspace(0, 1, 31).tolist():
        fovs.append(2 * math.degrees(math.atan(1 / float(path.camera(at, 2, 2).Ks[0, 1, 1]))))
    assert min(fovs) == pytest.approx(5) and max(fovs) == pytest.approx(90)
    assert fovs[15] == pytest.approx(47.5)


def test_a_camera_keeps_its_own_numbers():
    view, K = torch.eye(4).double(), torch.tensor([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]]).double()
    camera = gv.Camera(view, K, 8, 8)
    before = camera.rays()
    view[0, 3], K[0, 0] = 1.0, 1.0
    assert torch.equal(camera.rays().origin, before.origin)
    assert torch.equal(camera.rays().direction, before.direction)


def test_a_batch_that_fits_has_a_distance_each():
    cameras = gv.Camera.orbit([0, 90], 0, fov=30, fit=True).placed(BOX)
    assert len(cameras) == 2
    far = (centre_of(cameras) - BOX.mean(0)).norm(dim=1)
    assert abs(float(far[0] - far[1])) > 0.5
    assert cameras[1].same(gv.Camera.orbit(90, 0, fov=30, fit=True).placed(BOX))


def test_leading_dimensions_are_one_batch():
    view = torch.eye(4).expand(2, 3, 4, 4)
    camera = gv.Camera.from_viewmat_K(view, torch.eye(3), 4, 4)
    assert len(camera) == 6 and camera.batched


def test_batches_broadcast():
    camera = gv.Camera.look_at(torch.tensor([[1.0, 0, 0], [0, 0, 1]]), (0, 0, 0), width=4, height=3)
    assert len(camera) == 2 and camera.rays().origin.shape == (24, 3)
    single = camera[1].rays()
    assert torch.equal(single.direction, camera.rays().direction[12:])


def test_rays_are_those_of_kornia_to_rounding():
    camera = gv.Camera.look_at((3, 2, 5), (0.5, 0, 0), fov=35, width=13, height=8)
    moved = camera.Ks.clone()
    moved[:, :2, 2] -= 0.5
    local = unproject_meshgrid(8, 13, moved, normalize_points=True, dtype=torch.float64)
    expected = local.reshape(-1, 3) @ camera.viewmats[0, :3, :3]
    rays = camera.rays()
    assert (rays.direction - expected).abs().max() <= 2**-51 and rays.width == 13
    assert torch.equal(rays.range, torch.tensor([[0, math.inf]]).double().expand(104, 2))


AHEAD = {
    "pinhole": gv.Camera.orbit([20, 70], [10, -30], 1.5, None, 15, 9),
    "ortho": gv.Camera.orbit(20, 10, 1.5, None, 15, 9, "ortho"),
    "fisheye": gv.Camera.orbit(20, 10, 0.6, 150, 15, 9, "fisheye"),
    "panorama": gv.Camera.orbit(20, 10, 0.3, None, 15, 9, "panorama"),
}


@pytest.mark.parametrize("model", [*AHEAD, "custom"])
def test_a_thinned_camera_looks_through_the_middle_of_its_pixels_ahead_of_the_motion(model):
    box = torch.tensor([[0.0, 0, 0], [4, 2, 3]], dtype=torch.float64)
    camera = AHEAD["pinhole" if model == "custom" else model].placed(box)
    if model == "custom":
        camera = CustomCamera(camera.rays(), 15, 9)
    now = camera.numbers()
    thin, middle = camera.thinned(3), slice(1, None, 3)
    rays = thin.pixel_rays(camera.numbers_ahead(now, now, 4, 3), (0, len(camera) * 3))
    whole, first = camera.rays(), slice(None, None, 3)
    for name in ("origin", "direction", "cone", "range"):
        every = getattr(whole, name).view(len(camera), 9, 15, -1)
        offset = first if model == "custom" else middle
        part = every[:, offset, offset].reshape(-1, every.shape[-1])
        torch.testing.assert_close(getattr(rays, name), part, rtol=1e-12, atol=1e-12)
    move = slice(0, 3) if model == "custom" else slice(9, 12)
    before = now.clone()
    before[:, move] -= torch.tensor([0.25, -0.5, 1.0], dtype=torch.float64)
    moved = camera.numbers_ahead(now, before, 4, 1)[:, move]
    torch.testing.assert_close(moved, now[:, move] + torch.tensor([1.0, -2.0, 4.0]).double())
    assert torch.equal(camera.numbers_ahead(now, -now, 4, 1)[:, move], now[:, move]), "a cut"


@pytest.mark.parametrize("cameras", [1, 3])
def test_pinhole_rays_are_the_twin_s(compiled, cameras):
    """In every bit, for one camera and for a batch, for all rows and for some."""
    camera = gv.Camera.orbit([0, 40, 80][:cameras], 10, [2.0, 1.0, 3.0][:cameras], 30, 41, 23)
    camera = camera.placed(BOX).shifted(0.3, -4.7)
    numbers = camera.numbers(DEVICES[compiled])
    for first, rows in ((0, 23 * cameras), (5, 23 * cameras - 7), (22, 1), (3, 0)):
        given_ = (first, rows, 41, 23)
        outputs = ops.pinhole_rays(numbers, *given_, backend=compiled)
        twins = ops.pinhole_rays(numbers.cpu(), *given_, backend="reference")
        for output, twin in zip(outputs, twins, strict=True):
            assert torch.equal(output.cpu(), twin) and len(twin) == rows * 41
        assert torch.allclose(twins[1].norm(dim=1), torch.ones(1, dtype=torch.float64))
        assert not rows or torch.equal(twins[0][-1], numbers[(first + rows - 1) // 23, 9:12].cpu())
    torch.library.opcheck(torch.ops.gvtorch.pinhole_rays.default, (numbers, 5, 9, 41, 23))


@pytest.mark.parametrize(
    ("camera", "given_", "message"),
    [
        ((1, 19), (0, 3, 4, 3), "camera_nc must have 20 columns or more, got 19"),
        ((2, 26), (1, 6, 4, 3), "no rows 1 to 7 in 2 cameras of 3 rows"),
        ((1, 26), (0, 0, 4, 0), "no rows 0 to 0 in 1 cameras of 0 rows"),
        ((1, 26), (-1, 1, 4, 3), "first must be an int >= 0"),
        ((1, 26), (0, 2**31, 4, 3), "rows must be an int"),
        ((1, 26), (0, 2, 2**30, 3), "2 rows of 1073741824 are too many at once"),
        ((26,), (0, 3, 4, 3), "camera_nc must be (n, c) float64"),
    ],
)
def test_pinhole_rays_name_what_is_wrong(camera, given_, message):
    numbers = torch.zeros(camera, dtype=torch.float64)
    with pytest.raises(ValueError, match="pinhole_rays: ") as caught:
        ops.pinhole_rays(numbers, *given_)
    assert message in str(caught.value)
    with pytest.raises((ValueError, RuntimeError)):
        torch.ops.gvtorch.pinhole_rays(numbers, *given_)


def test_rows_are_counted_through_the_batch():
    camera = gv.Camera.orbit([0, 40, 80], 10, [2.0, 1.0, 3.0], 30, 6, 5).placed(BOX)
    whole = camera.rays()
    for first, end in ((0, 15), (3, 4), (4, 11), (14, 15)):
        part = camera.rays(rows=(first, end))
        for name, field in vars(part).items():
            if isinstance(field, torch.Tensor):
                assert torch.equal(field, getattr(whole, name)[6 * first : 6 * end]), name


def test_small_cameras_share_calls(monkeypatch):
    """Blocks of rays span cameras, and their size does not change the picture."""
    volume = gv.Volume(torch.arange(16**3).reshape(16, 16, 16).to(torch.int16))
    tree, shader = gv.N3Tree.from_volume(volume), gv.TransferFunction.preset("gray", 0, 4096)
    cameras = gv.Camera.orbit(torch.linspace(0, 300, 20), 20, 1.5, width=16, height=16)
    calls: list[int] = []

    def report(stage, done, total):
        calls.append(done)

    one_call = gv.render(tree, cameras, shader, progress=report)
    assert calls == [320] and one_call.alpha.max() > 0.3
    calls.clear()
    monkeypatch.setattr(pixels, "_RAYS_PER_REPORT", 1000)  # 62 rows, in the middle of a camera
    parts = gv.render(tree, cameras, shader, progress=report)
    assert calls == [62, 124, 186, 248, 310, 320]
    traced, march = [], Tracer.__call__
    monkeypatch.setattr(
        Tracer, "__call__", lambda tracer, rays: traced.append(rays) or march(tracer, rays)
    )
    gv.render(tree, cameras, shader)
    assert len(traced) == 1, "nobody watches: one trace"
    for index in range(20):
        alone = gv.render(tree, cameras[index], shader)
        for name in ("color", "alpha", "depth", "samples"):
            expected = getattr(one_call, name)[index]
            assert torch.equal(getattr(parts, name)[index], expected)
            assert torch.equal(getattr(alone, name), expected.reshape(getattr(alone, name).shape))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gv.Camera.orbit(azimuth=math.nan), "azimuth must be finite"),
        (lambda: gv.Camera.orbit(elevation=math.inf), "elevation must be finite"),
        (lambda: gv.Camera.orbit(distance=0), "distance must be > 0"),
        (lambda: gv.Camera.orbit(distance=2, fit=True), "fit finds the distance: leave it out"),
        (lambda: gv.Camera.orbit(up="z"), r"up must be one of \+x, -x, .* got 'z'"),
        (lambda: gv.Camera.orbit(up=(0, 0, 0)), "up must not be zero"),
        (lambda: gv.Camera.orbit(up=(0, 1)), "up must be three numbers"),
        (lambda: gv.Camera.fit([[0, 0, 0], [1, 0, 1]]), "must have its low corner below"),
        (lambda: gv.CameraPath.orbit(BOX, distance=2, fit_size=(8, 8)), "fit_size finds"),
        (lambda: gv.Camera.orbit(fov=0), "fov must be finite and >= 1e-12 and <= 179"),
        (lambda: gv.Camera.orbit(fov=math.nan), "fov must be finite"),
        (lambda: gv.Camera.orbit(width=0), "width must be an int >= 1"),
        (lambda: gv.Camera.orbit(height=2.5), "height must be an int"),
        (lambda: gv.Camera.orbit("north"), "azimuth must be numbers"),
        (lambda: gv.Camera.look_at((0, 0, 0), (0, 0, 0)), "the same position"),
        (
            lambda: gv.Camera.look_at((0, 0), (0, 0, 0)),
            r"eye must be \(3,\) or \(n, 3\), got \(2,\)",
        ),
        (lambda: gv.Camera.look_at((0, 0, 1), (0, 0, 0), (0, 0, 0)), "up must not be zero"),
        (lambda: gv.Camera.look_at((math.nan, 0, 0), (0, 0, 0)), "eye must be finite"),
        (
            lambda: gv.Camera(torch.eye(3), torch.eye(3), 4, 4),
            r"viewmats must be \(4, 4\) or \(n, 4, 4\)",
        ),
        (lambda: gv.Camera(torch.eye(4) * 2, torch.eye(3), 4, 4), "must hold rotations"),
        (lambda: gv.Camera(torch.eye(4), -torch.eye(3), 4, 4), "positive focal lengths"),
        (
            lambda: gv.Camera(torch.full((4, 4), math.nan), torch.eye(3), 4, 4),
            "viewmats must be finite",
        ),
        (
            lambda: gv.Camera(torch.eye(4).repeat(2, 1, 1), torch.eye(3).repeat(3, 1, 1), 4, 4),
            "do not match",
        ),
        (lambda: gv.Camera.orbit([0, 1], [0, 1, 2]), "different lengths"),
        (
            lambda: gv.Camera(
                torch.eye(4), torch.tensor([[1.0, 5, 0], [0, 1, 0], [0, 0, 1]]), 4, 4
            ),
            "skew",
        ),
        (lambda: gv.Camera(torch.eye(4), torch.diag(torch.tensor([1.0, 1, 2])), 4, 4), "last rows"),
        (lambda: gv.Camera.orbit().rays(), "placed"),
    ],
)
def test_bad_cameras_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
