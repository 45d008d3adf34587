"""Cameras, backgrounds, tone curves, refinement and files of the command line."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
import torch
from helpers import gvtorch
from PIL import Image

import gvtorch as gv
from gvtorch.tools.annotations import Annotations
from gvtorch.viewer.state import ViewState

LOOK = ("--size", "24x16", "--tf", "hot", "--camera", "orbit:20,10,0.8")


def picture(path, camera, **options) -> gv.Picture:
    volume = gv.read_volume(path)
    shader = gv.TransferFunction.preset("hot", *gv.window(volume))
    return gv.render(gv.N3Tree.from_volume(volume), camera, shader, **options)


def run(*args: object) -> str:
    done = gvtorch("render", *args, *LOOK)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("model", ["ortho", "fisheye", "panorama"])
def test_camera_models(small, tmp_path, model):
    run(small, "-o", tmp_path / "a.npy", "--camera-model", model, "--fov", "100")
    camera = gv.Camera.orbit(20, 10, 0.8, 100, 24, 16, model)
    expected = picture(small, camera)
    np.testing.assert_allclose(np.load(tmp_path / "a.npy")[..., :3], expected.color, atol=1e-6)
    assert expected.alpha.max() > 0


@pytest.mark.backend("cpp")
def test_filtered(small, tmp_path):
    far = ("--shader", "filtered", "--size", "24x16", "--tf", "hot", "--camera", "orbit:20,10,9")
    done = gvtorch("render", small, "-o", tmp_path / "a.npy", *far)
    assert done.returncode == 0, done.stderr
    volume = gv.read_volume(small)
    tree = gv.N3Tree.from_volume(volume)
    shader = gv.Filtered.of(tree, volume, gv.TransferFunction.preset("hot", *gv.window(volume)))
    camera = gv.Camera.orbit(20, 10, 9, None, 24, 16)
    expected = gv.render(tree, camera, shader)
    np.testing.assert_allclose(np.load(tmp_path / "a.npy")[..., :3], expected.color, atol=1e-6)
    plain = picture(small, camera)
    assert not torch.equal(plain.color, expected.color)


@pytest.mark.backend("cpp")
def test_backgrounds_tone_and_samples(small, tmp_path):
    camera = gv.Camera.orbit(20, 10, 0.8, None, 24, 16)
    sky = torch.rand(8, 16, 3)
    np.save(tmp_path / "sky.npy", sky.numpy())
    sky = gv.Environment(sky)
    for text, background in (
        (tmp_path / "sky.npy", sky),
        ("1,0,0/0,0,1", gv.Gradient((1, 0, 0), (0, 0, 1))),
        ("transparent", None),
    ):
        run(small, "-o", tmp_path / "a.npz", "--background", text)
        expected = picture(small, camera, background=background)
        np.testing.assert_allclose(np.load(tmp_path / "a.npz")["color"], expected.color, atol=1e-6)
    run(
        *(small, "-o", tmp_path / "a.png", "--bits", "16", "--background", tmp_path / "sky.npy"),
        *("--samples", "5", "--cone-scale", "0.6", "--tone", "aces", "--exposure", "0.5"),
        *("--stats", tmp_path / "a.json"),
    )
    assert '"rays": 1920' in (tmp_path / "a.json").read_text(), "of all five samples"
    render = partial(picture, small, background=sky, cone_scale=0.6)
    expected = gv.Progressive(render).refine(camera, 5).tone_map("aces", exposure=0.5)
    torch.testing.assert_close(gv.read_image(tmp_path / "a.png"), expected.color, atol=1e-4, rtol=0)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("name", "bits"), [("a.tif", "8"), ("a.tif", "32"), ("a.exr", "16"), ("a.png", "8")]
)
def test_files_of_every_kind(small, tmp_path, name, bits):
    told = run(small, "-o", tmp_path / name, "--bits", bits, "--stats", tmp_path / "a.json")
    expected = picture(small, gv.Camera.orbit(20, 10, 0.8, None, 24, 16))
    actual = gv.read_image(tmp_path / name)[..., :3]
    torch.testing.assert_close(actual, expected.color, atol=0.01, rtol=0)
    stats = json.loads((tmp_path / "a.json").read_text())
    assert stats["rays"] == 384 and f"{stats['samples']:,} samples in" in told


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["-o", "a.jpg"], "--output: path must end in .png, .tif, .exr, .npy or .npz, got 'a.jpg'"),
        (["-o", "a.png", "--npz", "a.png"], "--npz: path must end in .npz, got 'a.png'"),
        (["-o", "no/a.png"], "--output: folder not found: no"),
        (["-o", "a.png", "--npz", "no/a.npz"], "--npz: folder not found: no"),
        (["-o", "a.png", "--stats", "no/a.json"], "--stats: folder not found: no"),
        (["-o", "a.png", "--bits", "7"], ".png has 8 or 16 bits, got 7"),
        (["-o", "a.tif", "--npz", "a.npz"], "--npz holds a whole picture: not with .tif"),
        (["-o", "a.png", "--samples", "0"], "--samples must be an int >= 1, got 0"),
        (["-o", "a.png", "--cone-scale", "0"], "cone_scale must be finite and > 0, got 0"),
        (["-o", "a.png", "--exposure", "nan"], "exposure must be finite"),
        (["-o", "a.png", "--background", "sky.exr"], "image not found: sky.exr"),
        (["-o", "a.png", "--background", "1,1,1/0"], "--background must be 3 numbers"),
        (["-o", "a.png", "--background", "sky.tiff"], "path must end in .png, .exr, .npy, .tif"),
        (["-o", "a.png", "--camera-model", "panorama", "--fov", "200"], "fov must be finite"),
    ],
)
def test_a_mistake_gets_one_line(small, tmp_path, args, message):
    done = gvtorch("render", small, *args, cwd=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert message in done.stderr and not list(tmp_path.iterdir())


@pytest.fixture
def others(small, tmp_path):
    """A volume, a file of how it was shown, and a volume as a folder of pictures."""
    np.save(tmp_path / "v.npy", gv.read_volume(small).data[..., 0].numpy())
    (tmp_path / "s.json").write_text('{"component": 0, "camera": {"eye": [9, 9, 9]}}')
    ViewState(shader=gv.TransferFunction.preset("hot", 0, 200)).save(tmp_path / "t.json")
    (tmp_path / "fourth.json").write_text('{"component": 3}')
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "costs.json").write_text('{"show": "samples"}')
    (tmp_path / "time.json").write_text('{"time": 0}')
    (tmp_path / "sky.exr").touch()
    (tmp_path / "stack").mkdir()
    for number in range(3):
        gray = np.full((8, 8), 80 * number, np.uint8)
        Image.fromarray(gray).save(tmp_path / "stack" / f"{number:04d}.png")
    return tmp_path


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("render v.npy -o v.npy", "--output v.npy would be written over what PATH reads"),
        ("render v.npy -o ./v.npy", "--output v.npy would be written over what PATH reads"),
        ("render v.npy -o a.png --stats v.npy", "--stats v.npy would be written over"),
        ("render v.npy -o a.npz --npz a.npz", "--npz and --output are one file: a.npz"),
        ("render v.npy -o a.png --stats a.png", "--stats and --output are one file: a.png"),
        ("render v.npy -o a.png --state s.json --stats s.json", "what --state reads"),
        ("render stack -o stack/0003.png", "would be written over what PATH reads"),
        ("slice v.npy -o v.npy", "--output v.npy would be written over what PATH reads"),
        ("fly stack -o stack --frames 2", "--output stack would be written over what PATH reads"),
        ("fly v.npy -o f --stats v.npy --frames 2", "--stats v.npy would be written over"),
        ("fly v.npy -o f --poses s.json --trace s.json", "are one file: s.json"),
        ("render v.npy -o a.png --state s.json --component 1", "--state sets what --component"),
        ("render v.npy -o a.png --state s.json --up +z", "--state sets what --up sets"),
        ("fly v.npy -o f --state s.json --component 1", "--state sets what --component sets"),
        ("render v.npy -o a.png --state t.json --shader lit", "--state sets what --shader sets"),
        ("view v.npy --state t.json --tf hot", "--state sets what --tf sets"),
        ("view v.npy --state t.json --step 1", "--state sets what --step sets"),
        ("view v.npy --state s.json --component 1", "--state sets what --component sets"),
        ("render v.npy -o a.png --state list.json", "list.json: not a state"),
        ("fly v.npy -o f --state list.json", "list.json: not a state"),
        ("view v.npy --state list.json", "list.json: not a state"),
        ("render v.npy -o a.png --state fourth.json", "fourth.json: component 3: a voxel has one"),
        ("fly v.npy -o f --frames 2 --state fourth.json", "fourth.json: component 3: a voxel"),
        ("view v.npy --no-browser --state fourth.json", "state: component 3: a voxel has one"),
        ("render v.npy -o sky.exr --background sky.exr", "written over what --background reads"),
        ("view v.npy --state s.json --camera orbit:0,0", "--state sets what --camera sets"),
        ("render v.npy -o a.png --state s.json --camera orbit:0,0", "--state sets what --camera"),
        ("render v.npy -o a.png --state t.json --samples 2", "--state sets what --samples sets"),
        ("view a.py --threshold 3", "--threshold is for files: the script sets it"),
        ("view v.npy --port 99999 --no-browser", "port must be an int >= 0 and <= 65535"),
        ("render v.npy -o a.png --camera file:c.pvcc --camera-model fisheye", "--camera-model"),
        ("render v.npy -o a.png --clip=", "--clip must hold plane:"),
        ("render v.npy -o a.png --camera=", "--camera must be orbit:"),
        ("render v.npy -o a.png --state costs.json --bar", "--bar is for a picture alone"),
        ("fly v.npy -o a.gif --state costs.json --frames 2 --bar", "--bar is for a picture alone"),
        ("fly v.npy -o f --turntable 1e300", "--turntable must be finite and > 0 and <= 8.58"),
        ("fly v.npy -o f --poses no/c.json", "--poses: folder not found: no"),
        ("fly v.npy -o f --stats no/c.json", "--stats: folder not found: no"),
        ("view v.npy --no-browser --state time.json --time 1", "--state sets what --time sets"),
        ("view v.npy --no-browser --mode balanced", "--mode is for single pictures"),
        ("view v.npy --no-browser --max-frames 5", "--max-frames is for single pictures"),
        ("view v.npy --no-browser --image x", "--image is for stores; make one: gvtorch convert"),
        ("view v.npy --no-browser --host-cache 1MB", "--host-cache is for stores; make one"),
        ("convert v.npy stack --dry-run", "exists and is not a store"),
        ("convert v.npy a.zarr --dry-run --spacing 0,2,2", "spacing"),
        ("convert v.npy a.zarr --dry-run --memory much", "--memory"),
        ("convert v.npy a.zarr --dry-run --memory 1MB", "a.zarr: memory of 1.0 MB is too little"),
    ],
)
def test_nothing_is_overwritten_and_no_flag_is_without_effect(others, args, message):
    before = {file: file.read_bytes() for file in others.rglob("*") if file.is_file()}
    done = gvtorch(*args.split(), cwd=others)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert message in done.stderr
    assert before == {file: file.read_bytes() for file in others.rglob("*") if file.is_file()}


def test_a_state_leaves_the_flags_be_that_it_does_not_tell(others):
    (others / "part.json").write_text('{"develop": {"samples": 1}}')
    lit = ["--shader", "lit", "--step", "0.25"]
    pictures = []
    for flags in (["--state", "part.json", *lit], lit, []):
        done = gvtorch("render", "v.npy", "-o", "a.png", "--size", "48x32", *flags, cwd=others)
        assert done.returncode == 0, done.stderr
        pictures.append(np.asarray(Image.open(others / "a.png")))
    assert np.array_equal(*pictures[:2]) and not np.array_equal(*pictures[1:])


def test_a_state_without_a_camera_takes_that_of_the_flags(others, monkeypatch):
    """t.json has `camera: null`, part.json does not name it."""
    (others / "part.json").write_text('{"develop": {"samples": 1}}')
    for state in ("t.json", "part.json"):
        pictures = []
        for camera in ("orbit:80,20", "orbit:10,50,0.7"):
            flags = ("--state", state, "--camera", camera, "--size", "24x16")
            done = gvtorch("render", "v.npy", "-o", "a.png", *flags, cwd=others)
            assert done.returncode == 0, done.stderr
            pictures.append(np.asarray(Image.open(others / "a.png")))
        assert pictures[0].std() > 5 and not np.array_equal(*pictures)
    cameras = []
    monkeypatch.setattr("gvtorch.viewer.view", lambda *args, **_: cameras.append(args[2]))
    for state in ("t.json", "part.json"):
        done = gvtorch(
            "view", "v.npy", "--state", state, "--camera", "look:9,9,9,1,2,3", cwd=others
        )
        assert done.returncode == 0, done.stderr
    expected = gv.Camera.look_at((9, 9, 9), (1, 2, 3), "+y", None, 16, 9)
    assert len(cameras) == 2 and all(camera.same(expected) for camera in cameras)


def test_a_saved_component_is_that_of_the_bar_and_of_warnings(tmp_path, monkeypatch):
    """The second channel is shown: the bar is named after it, and a store warns of its range."""
    data = np.zeros((2, 8, 8, 8), np.float32)
    data[1, 2:6, 2:6, 2:6] = 7
    np.save(tmp_path / "v.npy", data)
    done = gvtorch("convert", "v.npy", "v.zarr", "--axes", "czyx", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    shader = gv.TransferFunction([(100, 0), (200, 1)])
    ViewState(shader=shader, component=1).save(tmp_path / "s.json")
    seen, overlay = [], Annotations.overlay
    monkeypatch.setattr(
        Annotations,
        "overlay",
        lambda self, *args: seen.append(args[0].component) or overlay(self, *args),
    )
    common = ("--state", "s.json", "--size", "96x64", "-o", "a.png")
    done = gvtorch("render", "v.zarr", *common, "--bar", cwd=tmp_path)
    assert done.returncode == 0 and seen == [1], done.stderr
    assert "nothing is seen: values range from 0 to 7" in done.stderr
