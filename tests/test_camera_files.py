"""Camera files of other programs: what is written is read back, and points fall on the pixels where
those programs draw them.
"""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
import torch
from helpers import gvtorch
from hypothesis import given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.cameras.motion import quaternion_of, rotation_of

EYE, TARGET, UP = (3.0, -4.0, 5.0), (0.5, 0.25, -1.0), (0.1, 0.9, 0.2)
POINTS = torch.tensor([TARGET, (0, 0, 0), (1, 1, 1), (-1, 0.5, 2)], dtype=torch.float64)


def seen(camera: gv.Camera, points: torch.Tensor = POINTS) -> torch.Tensor:
    """Returns (p, 2): columns and rows of points, by the matrices; a fisheye's by its formula."""
    local = points @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
    flat = local[:, :2] if camera.model == "ortho" else local[:, :2] / local[:, 2:]
    if camera.model == "fisheye":
        across = local[:, :2].norm(dim=1, keepdim=True)
        angle = torch.atan2(across, local[:, 2:])
        k = camera.radial_coeffs[0]
        bent = angle * (1 + sum(k[n] * angle ** (2 * n + 2) for n in range(4)))
        flat = local[:, :2] / across.clamp(min=1e-300) * bent
    return flat * camera.Ks[0, (0, 1), (0, 1)] + camera.Ks[0, :2, 2]


def askew(model: str = "pinhole") -> gv.Camera:
    """Returns a camera with an off-centre axis and pixels that are not square."""
    view = gv.Camera.look_at(EYE, TARGET, UP).viewmats[0]
    Ks = torch.tensor([[70.0, 0, 33.5], [0, 65, 20.25], [0, 0, 1]], dtype=torch.float64)
    bends = (0.05, -0.01, 0.002, 0.0005) if model == "fisheye" else None
    return gv.Camera(view, Ks, 64, 48, model=model, radial_coeffs=bends)


def assert_same(read: gv.Camera, camera: gv.Camera) -> None:
    assert (read.width, read.height, read.model) == (camera.width, camera.height, camera.model)
    for name in ("viewmats", "Ks", "radial_coeffs"):
        assert torch.allclose(getattr(read, name), getattr(camera, name), atol=1e-12), name


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.hypot.reduce(q) > 0.1)
)
def test_a_quaternion_comes_back_from_its_rotation(q):
    rotation = rotation_of(q)
    assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-12)
    actual = quaternion_of(rotation)
    expected = np.array(q) / np.linalg.norm(q)
    assert actual[0] >= 0
    same = np.abs(np.array(actual) - expected).max(), np.abs(np.array(actual) + expected).max()
    assert min(same) < 1e-12


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
@pytest.mark.parametrize("name", ["cameras", "t.json"])
def test_cameras_come_back(tmp_path, model, name):
    cameras = {"a.png": askew(model), "b.png": gv.Camera.look_at((1, 2, 9), TARGET, width=20)}
    gv.write_cameras(tmp_path / name, cameras)
    actual = gv.read_cameras(tmp_path / name)
    assert list(actual) == ["a.png", "b.png"]
    for key, camera in cameras.items():
        assert_same(actual[key], camera)
    if name == "cameras":
        files = sorted(file.name for file in (tmp_path / name).iterdir())
        assert files == ["cameras.txt", "images.txt", "points3D.txt"]
    batch = gv.Camera.look_at([EYE, (9, 9, 9)], [TARGET, (0, 0, 0)], width=30, height=20)
    gv.write_cameras(tmp_path / name, batch)
    again = gv.read_cameras(tmp_path / name)
    assert list(again) == ["0000.png", "0001.png"]
    assert_same(again["0001.png"], batch[1])
    half = gv.read_cameras(tmp_path / name, width=15, height=10)["0000.png"]
    assert torch.allclose(seen(half), seen(batch[0]) / 2)


@pytest.mark.parametrize("model", ["pinhole", "ortho"])
def test_paraview_sees_what_we_see(tmp_path, model):
    """VTK's camera, set to the numbers in the file, maps points to the same pixels."""
    camera = gv.Camera.look_at(EYE, TARGET, UP, 40, 64, 48, model)
    file = tmp_path / "c.pvcc"
    with pytest.raises(ValueError, match="distance must be finite and > 0"):
        gv.write_cameras(file, camera, distance=0)
    gv.write_cameras(file, camera, distance=7.0)
    actual = gv.read_cameras(file, width=64, height=48)["camera"]
    assert_same(actual, camera)
    pytest.importorskip("vtkmodules")
    import xml.etree.ElementTree as xml

    from vtkmodules.vtkRenderingCore import vtkCamera

    proxy = {
        element.get("name"): [float(e.get("value")) for e in element]
        for element in xml.parse(file).getroot().iter("Property")
    }
    other = vtkCamera()
    other.SetPosition(proxy["CameraPosition"])
    other.SetFocalPoint(proxy["CameraFocalPoint"])
    other.SetViewUp(proxy["CameraViewUp"])
    other.SetViewAngle(proxy["CameraViewAngle"][0])
    other.SetParallelScale(proxy["CameraParallelScale"][0])
    other.SetParallelProjection(int(proxy["CameraParallelProjection"][0]))
    matrix = other.GetCompositeProjectionTransformMatrix(64 / 48, -1, 1)
    rows = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    clip = np.concatenate((POINTS.numpy(), np.ones((4, 1))), 1) @ rows.T
    pixel = (clip[:, :2] / clip[:, 3:] * (1, -1) + 1) / 2 * (64, 48)
    assert np.allclose(pixel, seen(camera), atol=1e-9)
    assert math.isclose(math.dist(proxy["CameraPosition"], proxy["CameraFocalPoint"]), 7.0)


def test_a_camera_of_blender_looks_along_its_minus_z(tmp_path):
    """By hand: at (0, 0, 4), unturned, x runs right, y up; 90 degrees over 100 pixels."""
    frame = {"file_path": "r_0", "transform_matrix": np.eye(4).tolist()}
    frame["transform_matrix"][2][3] = 4.0
    content = {"camera_angle_x": math.pi / 2, "w": 100, "h": 80, "frames": [frame]}
    (tmp_path / "t.json").write_text(json.dumps(content))
    camera = gv.read_cameras(tmp_path / "t.json")["r_0"]
    points = torch.tensor([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (4, 0, 0)], dtype=torch.float64)
    expected = torch.tensor([(50, 40), (62.5, 40), (50, 27.5), (100, 40)], dtype=torch.float64)
    assert torch.allclose(seen(camera, points), expected)
    del content["w"], content["h"]
    (tmp_path / "t.json").write_text(json.dumps(content))
    assert gv.read_cameras(tmp_path / "t.json", width=100, height=80)["r_0"].width == 100


@pytest.mark.parametrize(
    ("lens", "model", "focal"),
    [
        ({"camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 2}, "pinhole", (50, 40)),
        ({"camera_angle_x": math.pi / 2, "fl_y": 45.0}, "pinhole", (50, 45)),
        ({"fl_x": 60.0, "camera_angle_x": 1.0}, "pinhole", (60, 60)),
        ({"fl_x": 60.0, "is_fisheye": True, "k1": 0.1}, "fisheye", (60, 60)),
        ({"fl_x": 60.0, "is_fisheye": True, "camera_model": "OPENCV"}, "fisheye", (60, 60)),
    ],
)
def test_lenses_of_instant_ngp(tmp_path, lens, model, focal):
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "t.json").write_text(json.dumps({"w": 100, "h": 80, **lens, "frames": [frame]}))
    camera = gv.read_cameras(tmp_path / "t.json")["a"]
    assert camera.model == model and camera.radial_coeffs[0, 0] == lens.get("k1", 0)
    assert camera.Ks[0, (0, 1), (0, 1)].tolist() == pytest.approx(focal)


def test_a_text_model_of_colmap(tmp_path):
    """As documented: q = w x y z, world to camera; a quarter turn around z, by hand."""
    (tmp_path / "cameras.txt").write_text(
        "# Camera list with one line of data per camera:\n"
        "1 SIMPLE_PINHOLE 640 480 500 320 240\n2 SIMPLE_RADIAL 640 480 400 320 240 0\n"
    )
    half = math.sqrt(0.5)
    (tmp_path / "images.txt").write_text(
        "# Image list with two lines of data per image:\n\n"
        f"1 {half} 0 0 {half} 0.5 -1 10 1 first picture.jpg\n2362.39 248.498 58396\n"
        "2 1 0 0 0 0 0 5 2 second.jpg\n\n"
    )
    cameras = gv.read_cameras(tmp_path)
    assert list(cameras) == ["first picture.jpg", "second.jpg"]
    pixel = seen(cameras["first picture.jpg"], torch.tensor([(2.0, 3, 0)], dtype=torch.float64))
    assert torch.allclose(
        pixel, torch.tensor([(320 + 50 * (-3 + 0.5), 240 + 50 * (2 - 1.0))]).double()
    )
    pixel = seen(cameras["second.jpg"], torch.tensor([(1.0, 0, -1)], dtype=torch.float64))
    assert torch.allclose(pixel, torch.tensor([(420.0, 240.0)]).double())


@pytest.mark.parametrize("second", ["b.jpg", "b c.jpg", "b c d.jpg", "a.jpg"])
def test_no_image_of_colmap_is_lost(tmp_path, second):
    """Another program left out the lines of points, or wrote a name twice."""
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    images = ["1 1 0 0 0 0 0 5 1 a.jpg", f"2 1 0 0 0 0 0 6 1 {second}", ""]
    (tmp_path / "images.txt").write_text("\n".join(images))
    with pytest.raises(ValueError, match="after the line of an image comes one of its points"):
        gv.read_cameras(tmp_path)
    (tmp_path / "images.txt").write_text("\n\n".join(images))
    if second == "a.jpg":
        with pytest.raises(ValueError, match=r"there are two images 'a\.jpg'"):
            gv.read_cameras(tmp_path)
    else:
        assert list(gv.read_cameras(tmp_path)) == ["a.jpg", second]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"k6": 0.1}, "distortion of model PINHOLE is not read (k6)"),
        ({"is_fisheye": True, "k1": 0.1, "p2": 0.1}, "OPENCV_FISHEYE is not read (p2): undistort"),
        ({"w": 40.5}, "frame 0: w must be an int >= 1, got 40.5"),
        ({"h": "80"}, "frame 0: h must be an int >= 1, got '80'"),
        ({"h": -80}, "frame 0: h must be an int >= 1, got -80"),
    ],
)
def test_lenses_that_no_camera_has(tmp_path, fields, message):
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    content = {"w": 100.0, "h": 80, "fl_x": 60, "frames": [frame]}
    (tmp_path / "t.json").write_text(json.dumps(content))
    assert gv.read_cameras(tmp_path / "t.json")["a"].width == 100, "some programs write floats"
    (tmp_path / "t.json").write_text(json.dumps(content | fields))
    with pytest.raises(ValueError, match=re.escape(message)):
        gv.read_cameras(tmp_path / "t.json")


def test_damaged_and_unknown_files_are_one_line(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 OPENCV 640 480 500 500 320 240 0.1 0 0 0\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 5 1 a.jpg\n\n")
    (tmp_path / "a.json").write_text('{"frames": [{"transform_matrix": [[1]]}]}')
    (tmp_path / "g.json").write_text(
        json.dumps(
            {
                "w": 9,
                "h": 9,
                "fl_x": 9,
                "frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()}] * 2,
            }
        )
    )
    (tmp_path / "b.json").write_text('{"frames": []}')
    (tmp_path / "keys.json").write_text('[{"eye": [0, 0, 1], "target": [0, 0, 0]}]')
    (tmp_path / "c.pvcc").write_text("<a><Property name='CameraPosition'></Property></a>")
    (tmp_path / "d.pvcc").write_text("<a>")
    (tmp_path / "e.txt").write_text("")
    (tmp_path / "empty").mkdir()
    gv.write_cameras(tmp_path / "f.pvcc", gv.Camera.look_at(EYE, TARGET))
    for name, message in (
        (".", "distortion of model OPENCV is not read (k1): undistort first"),
        ("a.json", "frame 0: pose must be (4, 4) numbers"),
        ("b.json", "has no cameras"),
        ("keys.json", "keys.json: must be an object with frames"),
        ("g.json", "frame 1: there is one of 'a' already"),
        ("c.pvcc", "c.pvcc: "),
        ("d.pvcc", "can't be read as cameras"),
        ("e.txt", "must end in .pvcc or .json or be a folder"),
        ("empty", "has no cameras.txt"),
        ("f.pvcc", "does not give the size of the picture"),
        ("no.json", "cameras not found"),
    ):
        with pytest.raises((ValueError, FileNotFoundError)) as caught:
            gv.read_cameras(tmp_path / name)
        assert message in str(caught.value) and "\n" not in str(caught.value), name


@pytest.mark.parametrize(
    ("name", "cameras", "message"),
    [
        ("a.pvcc", askew(), "of square pixels"),
        ("a.pvcc", gv.Camera.look_at([EYE, UP], TARGET), ".pvcc holds one camera, got 2"),
        ("a.json", gv.Camera.look_at(EYE, TARGET, model="ortho"), "pinhole and fisheye"),
        ("a.json", gv.Camera.orbit(), "must be one camera in the world"),
        ("a.json", gv.CustomCamera(askew().rays()), "one camera in the world, of a model"),
        ("a.pvcc", gv.CustomCamera(askew().rays()), "one camera in the world, of a model"),
        ("a.json", {"a b": askew()}, "must not contain blanks"),
        ("a.json", {}, "there are no cameras"),
        ("a.txt", askew(), "must end in .pvcc or .json or be a folder"),
        ("no/a.json", askew(), "folder not found"),
    ],
)
def test_what_a_file_can_not_tell_is_refused(tmp_path, name, cameras, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        gv.write_cameras(tmp_path / name, cameras)
    assert not [*tmp_path.iterdir()]


@pytest.mark.backend("cpp")
def test_flights_tell_their_cameras_and_render_takes_them(small, tmp_path):
    """A picture rendered from the file is the one that the flight took there."""
    flags = ("--size", "40x30", "--tf", "hot")
    for name in ("model", "t.json"):
        run = gvtorch("fly", small, "-o", tmp_path / "f", "--frames", "3", *flags,
                      "--poses", tmp_path / name)  # fmt: skip
        assert run.returncode == 0, run.stderr
        camera_flag = f"file:{tmp_path / name},0001.png"
        run = gvtorch("render", small, "-o", tmp_path / "a.png", *flags, "--camera", camera_flag)
        assert run.returncode == 0, run.stderr
        image, expected = (gv.read_image(tmp_path / file) for file in ("a.png", "f/0001.png"))
        assert (image - expected).abs().max() < 0.02 and image.max() > 0.3
    stats = ("--camera", camera_flag, "--stats", tmp_path / "t.json")
    run = gvtorch("render", small, "-o", tmp_path / "a.png", *stats)
    assert run.returncode == 2 and "would be written over what --camera reads" in run.stderr
    for camera, message in (
        (f"file:{tmp_path / 'model'}", "must name one of 0000.png, 0001.png, 0002.png, got ''"),
        (f"file:{tmp_path / 'no.json'}", "cameras not found"),
    ):
        run = gvtorch("render", small, "-o", tmp_path / "b.png", "--camera", camera)
        assert run.returncode == 2 and message in run.stderr, run.stderr
    for more, message in (
        (("--poses", tmp_path / "a.txt"), "--poses must be a folder or end in .json"),
        (("--poses", tmp_path / "m", "--camera-model", "ortho"), "not ortho"),
    ):
        run = gvtorch("fly", small, "-o", tmp_path / "g", "--frames", "1", *more)
        assert run.returncode == 2 and message in run.stderr and not (tmp_path / "g").exists()


@pytest.mark.parametrize("scale", ["nan", "inf", "-1", "0"])
def test_a_wrong_scale_is_told_with_its_file(tmp_path, scale):
    file = tmp_path / "c.pvcc"
    gv.write_cameras(file, gv.Camera.look_at(EYE, TARGET, width=8, height=8, model="ortho"))
    head, tail = file.read_text().split('name="CameraParallelScale"')
    rest = tail.partition('value="')[2].partition('"')[2]
    file.write_text(f'{head}name="CameraParallelScale"><Element index="0" value="{scale}"{rest}')
    with pytest.raises(ValueError, match=r"c\.pvcc: "):
        gv.read_cameras(file, width=8, height=8)


@pytest.mark.parametrize("name", ["c.pvcc", "t.json", "model/cameras.txt", "model/images.txt"])
def test_damaged_bytes_give_cameras_or_one_line(tmp_path, name):
    gv.write_cameras(tmp_path / "c.pvcc", gv.Camera.look_at(EYE, TARGET, UP, 40, 64, 48))
    for several in ("t.json", "model"):
        gv.write_cameras(tmp_path / several, {"a.png": askew(), "b.png": askew("fisheye")})
    file = tmp_path / name
    whole, rng, refused = file.read_bytes(), np.random.default_rng(3), 0
    letters = np.frombuffer(b'0123456789-+.eE"{}[]<>/: ,\n\xff', np.uint8)
    for number in range(300):
        damaged = np.frombuffer(whole, np.uint8).copy()
        positions = rng.integers(0, len(damaged), 1 + number % 4)
        damaged[positions] = rng.choice(letters, len(positions))
        cut = rng.integers(0, len(damaged)) if number % 3 == 0 else len(damaged)
        file.write_bytes(damaged[:cut].tobytes())
        path = tmp_path / "model" if name.startswith("model") else file
        try:
            assert gv.read_cameras(path, width=64, height=48)
        except ValueError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error), error
            refused += 1
    assert 20 < refused
