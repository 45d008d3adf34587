"""The command line as a user meets it."""

from __future__ import annotations

import gzip
import itertools
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import DATA, ROOT, gvtorch

import gvtorch as gv

ANEURISM = DATA / "aneurism_256x256x256_uint8.raw.gz"


def test_the_version_is_told():
    done = gvtorch("--version")
    assert done.returncode == 0 and done.stdout.strip() == f"gvtorch {gv.__version__}"


def test_a_process_of_its_own(small):
    """All other tests run commands within the test process. Only the first imports torch."""
    for words, status, lines in ((["info", str(small)], 0, 0), (["convert", str(small)], 2, 1)):
        command = [sys.executable, "-m", "gvtorch", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == status and len(done.stderr.splitlines()) == lines, done.stderr


@pytest.mark.parametrize("stream", ["full", "out", "err"])
def test_standard_output_that_is_full_or_closed(stream):
    """The number of a closed stream is used by the next file that is opened."""
    end = {"full": ">/dev/full", "out": ">&-", "err": "2>&-"}[stream]
    for word, good in (("--version", 0), ("none", 2)):
        command = f"exec {shlex.quote(sys.executable)} -m gvtorch {word} {end}"
        done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
        assert done.returncode == (2 if stream == "full" else good)
        lines = done.stderr.splitlines()
        assert len(lines) == (done.returncode == 2 and stream != "err"), done.stderr
        assert all(line.startswith("gvtorch: error: ") for line in lines)


def test_help_does_not_import_torch():
    code = (
        "import sys; from gvtorch.tools.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print('torch' in sys.modules or 'numpy' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "render" in run.stdout and run.stdout.strip().endswith("False")


@pytest.mark.parametrize(
    "file", sorted((ROOT / "gvtorch" / "tools").glob("*.py")), ids=lambda f: f.stem
)
def test_no_line_of_an_options_help_ends_early(file):
    """tyro breaks a comment where a line of it begins with anything but a letter."""
    lines = file.read_text().splitlines()
    rows = itertools.pairwise(lines)
    broken = [b for a, b in rows if a[:6] == b[:6] == "    # " and not b[6:7].isalpha()]
    assert not broken


def test_info_tells_backends_and_devices():
    content = json.loads(gvtorch("info", "--json").stdout)
    assert content["backends"]["reference"] == "ready" and content["gvtorch"] == gv.__version__
    assert content["devices"][0].startswith("cpu")
    assert "backends" in gvtorch("info").stdout


def test_info_tells_about_a_file():
    content = json.loads(gvtorch("info", ANEURISM, "--json").stdout)
    assert content["extent"] == [256, 256, 256] and content["dtype"] == "uint8"
    assert content["range"] == [0, 255] and sum(content["histogram"]) == 256**3
    assert "256, 256, 256" in gvtorch("info", ANEURISM).stdout


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("shader", ["lit", "preintegrated", "isosurface", "maximum"])
def test_render_takes_other_shaders(small, tmp_path, shader):
    level = ("--value", 100) if shader == "isosurface" else ()
    arrays = {}
    for name in ("plain", shader):
        file, flags = tmp_path / f"{name}.npz", level if name == shader else ()
        colors = () if name == "isosurface" else ("--tf", "gray")
        options = ("--size", "24x24", *colors, "--npz", file, "--shader", name, *flags)
        run = gvtorch("render", small, "-o", tmp_path / "a.png", *options)
        assert run.returncode == 0, run.stderr
        arrays[name] = np.load(file)
    assert "normal" in arrays[shader] and "normal" not in arrays["plain"]
    assert arrays[shader]["color"].max() > 0.1
    assert np.abs(arrays[shader]["color"] - arrays["plain"]["color"]).max() > 1e-3


def test_an_isosurface_needs_its_value(small, tmp_path):
    run = gvtorch("render", small, "-o", tmp_path / "a.png", "--shader", "isosurface")
    assert run.returncode == 2 and "--value and --shader isosurface" in run.stderr


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("camera", ["orbit:10,20,1.5", "look:-12,-10,-40,12,10,8"])
def test_render_writes_picture_arrays_and_stats(small, tmp_path, camera):
    out, npz, stats = (tmp_path / name for name in ("a.png", "a.npz", "a.json"))
    run = gvtorch(
        *("render", small, "-o", out, "--npz", npz, "--stats", stats, "--camera", camera),
        *(
            "--size",
            "40x24",
            "--tf",
            "hot",
            "--lod",
            "finest",
            "--background",
            "0,0,1",
            "--backend",
            "cpp",
        ),
    )
    assert run.returncode == 0, run.stderr
    assert out.read_bytes().startswith(b"\x89PNG") and str(out) in run.stdout
    arrays = np.load(npz)
    assert arrays["color"].shape == (24, 40, 3) and arrays["color"].dtype == np.float32
    assert arrays["alpha"].shape == arrays["depth"].shape == (24, 40, 1)
    assert arrays["alpha"].max() > 0.3 and np.isinf(arrays["depth"]).any()
    assert arrays["color"][0, 0].tolist() == [0, 0, 1]
    content = json.loads(stats.read_text())
    assert content["rays"] == 960 and content["extent"] == [24, 20, 16]
    assert {"milliseconds", "samples", "nodes", "bricks", "bytes"} <= set(content)


@pytest.mark.backend("cpp")
@pytest.mark.backend("reference")
def test_backends_agree_on_the_command_line(small, tmp_path):
    arrays = []
    for backend in ("reference", "cpp"):
        npz = tmp_path / f"{backend}.npz"
        args = ("--npz", npz, "--size", "20x20", "--backend", backend)
        run = gvtorch("render", small, "-o", tmp_path / "a.png", *args)
        assert run.returncode == 0, run.stderr
        arrays.append(np.load(npz))
    for name in ("color", "alpha", "depth"):
        np.testing.assert_allclose(arrays[0][name], arrays[1][name], atol=1e-5)


@pytest.mark.backend("cpp")
def test_raw_options(tmp_path):
    file = tmp_path / "plain.raw"
    file.write_bytes(np.arange(60, dtype=">i2").tobytes())
    args = ("--shape", "5,4,3", "--dtype", ">i2", "--spacing", "1,2,3")
    run = gvtorch("info", file, *args, "--json")
    content = json.loads(run.stdout)
    assert (
        content["extent"] == [5, 4, 3]
        and content["range"] == [0, 59]
        and content["spacing"] == [1, 2, 3]
    )


@pytest.mark.backend("cpp")
def test_cost_pictures(small, tmp_path):
    """Each cost gives another picture; the NPZ and the statistics stay those of the picture."""
    pictures = {}
    for show in ("picture", "samples", "nodes", "lod", "age", "fill"):
        out, npz = tmp_path / f"{show}.png", tmp_path / f"{show}.npz"
        run = gvtorch("render", small, "-o", out, "--npz", npz, "--show", show, "--size", "16x16")
        assert run.returncode == 0, run.stderr
        pictures[show] = out.read_bytes()
        assert npz.read_bytes() == (tmp_path / "picture.npz").read_bytes()
    assert len(set(pictures.values())) >= 4, "age and lod of one level are flat"
    wrong = gvtorch("render", small, "-o", tmp_path / "x.png", "--show", "heat")
    assert wrong.returncode == 2 and "heat" in wrong.stderr


@pytest.mark.backend("cpp")
def test_all_empty_volume_renders_the_background(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((4, 5, 6), np.float32))
    args = ("--npz", tmp_path / "a.npz", "--size", "8x8", "--background", "0.5,0,0")
    run = gvtorch("render", tmp_path / "a.npy", "-o", tmp_path / "a.png", *args)
    assert run.returncode == 0, run.stderr
    assert (np.load(tmp_path / "a.npz")["color"] == [0.5, 0, 0]).all()


def spoiled(tmp_path, name: str, content: bytes):
    file = tmp_path / name
    file.write_bytes(content)
    return file


def npy(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    return tmp_path / "a.npy"


TF = '{"opacity": [[5, 0], [1, 1]]}'


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda t, s: ["nowhere.raw"], "volume not found: nowhere.raw"),
        (
            lambda t, s: [spoiled(t, "a_4x4x4_uint8.raw.gz", gzip.compress(bytes(range(64)))[:-9])],
            "can't be read as RAW",
        ),
        (lambda t, s: [s, "--shape", "24,20,17"], "takes 8160 bytes, the file has 7680"),
        (lambda t, s: [s, "--shape", "24,20"], "--shape must be 3 whole numbers"),
        (lambda t, s: [s, "--shape", "2048,2048,2048"], "more than the 2147483648"),
        (lambda t, s: [s, "--dtype", "rainbow"], "dtype must be a NumPy dtype"),
        (lambda t, s: [s, "--spacing", "1,-1,1"], "spacing must be positive"),
        (lambda t, s: [s, "--spacing=-1,1,1"], "spacing must be positive"),
        (lambda t, s: [s, "--camera", "orbit:nan,0,2"], "azimuth must be finite"),
        (lambda t, s: [s, "--camera", "look:0,0,inf,0,0,0"], "eye must be finite"),
        (lambda t, s: [s, "--camera", "look:0,0,1,0,0"], "--camera look must be 6 numbers"),
        (
            lambda t, s: [s, "--camera", "fish:1"],
            "--camera must be orbit:AZ,EL, orbit:AZ,EL,DIST, look:ex,ey,ez,tx,ty,tz or file:PATH",
        ),
        (lambda t, s: [s, "--fov", "nan"], "fov must be finite"),
        (lambda t, s: [s, "--size", "0x5"], "--size must be WIDTHxHEIGHT"),
        (lambda t, s: [s, "--size", "99999x5"], "width must be an int >= 1 and <= 65536"),
        (lambda t, s: [s, "--tf", "lungs"], "unknown preset 'lungs'; known: bone"),
        (lambda t, s: [s, "--tf", "lungs.json"], "transfer function file not found"),
        (lambda t, s: [s, "--tf", ""], "unknown preset ''"),
        (lambda t, s: [s, "--window", ""], "--window must be LO,HI, P%,P%, auto or full, got ''"),
        (
            lambda t, s: [s, "--tf", spoiled(t, "tf.json", TF.encode())],
            "opacity values must increase",
        ),
        (lambda t, s: [s, "--step", "0"], "step must be finite and > 0"),
        (lambda t, s: [s, "--step", "1e-20"], "intervals"),
        (lambda t, s: [s, "--background", "1,1"], "--background must be 3 numbers"),
        (lambda t, s: [s, "--clip", "ball:1"], "--clip must hold plane:, box:, cut: or caps"),
        (lambda t, s: [s, "--clip", "plane:1,0,0"], "--clip plane must be 4 numbers"),
        (lambda t, s: [s, "--clip", "plane:nan,0,0,1"], "planes[0] must be finite"),
        (lambda t, s: [s, "--clip", "box:0,0,0,1,0,1"], "boxes[0] must have its low corner below"),
        (lambda t, s: [s, "--lens", "0.1"], "--lens must be 2 numbers"),
        (lambda t, s: [s, "--lens", "0.1,0"], "focus must be finite and > 0"),
        (lambda t, s: [s, "--lighting", "moon:1"], "--lighting must hold sun:, lamp:, sky:,"),
        (lambda t, s: [s, "--lighting", "sun:0,-1,0"], "--lighting sun must be 4 numbers"),
        (lambda t, s: [s, "--lighting", "sun:0,0,0,1"], "direction must not be zero"),
        (lambda t, s: [s, "--lighting", "occlusion:2"], "occlusion must be finite and >= 0"),
        (lambda t, s: [s, "--lighting", "occlusion:1"], "lighting needs normals"),
        (lambda t, s: [s, "--brick-size", "1"], "brick_size must be an int >= 2"),
        (lambda t, s: [s, "--threshold", "nan"], "threshold must be finite"),
        (lambda t, s: [s, "--backend", "cuda"], "backend 'cuda' can't be used here"),
        (lambda t, s: [npy(t, np.zeros((0, 4, 4)))], "at least 1 in every direction"),
        (lambda t, s: [npy(t, np.full((4, 4, 4), np.nan))], "NaN or infinite"),
        (lambda t, s: [s, "--npz", "a.txt"], "--npz: path must end in .npz"),
        (lambda t, s: [s, "--heat", "1"], "gvtorch: error: Unrecognized options: --heat"),
        (lambda t, s: [s, "--npz", "no/such/folder/a.npz"], "folder not found: no/such/folder"),
    ],
)
def test_a_mistake_gets_one_line_and_status_2(small, tmp_path, make, message):
    import torch

    if "cuda" in message and torch.cuda.is_available():
        pytest.skip("CUDA can be used here")
    run = gvtorch("render", *make(tmp_path, small), "-o", "a.png", cwd=tmp_path)
    lines = run.stderr.splitlines()
    assert run.returncode == 2 and len(lines) == 1, run.stderr
    assert lines[0].startswith("gvtorch: error: ") and message in lines[0]
    assert not (tmp_path / "a.png").exists()


def test_flags_clip_and_blur(small, tmp_path):
    """The middle of the picture shows the volume, unless all of it is cut away."""
    alpha = {}
    for name, flags in (
        ("all", []),
        ("half", ["--clip", "plane:1,0,0,0;caps"]),
        ("none", ["--clip", "box:-1,-1,-1,1,1,1;cut:-1,-1,-1,1,1,1"]),
        ("blurred", ["--lens", "0.5,2.4"]),
    ):
        file = tmp_path / f"{name}.npz"
        args = ("--npz", file, "--size", "24x24", *flags, "-o", tmp_path / "a.png")
        assert gvtorch("render", small, *args).returncode == 0
        alpha[name] = np.load(file)["alpha"]
    assert alpha["none"].max() == 0 < alpha["all"].max()
    assert 0.1 < (alpha["half"] > 0).sum() / (alpha["all"] > 0).sum() < 0.9
    assert np.abs(alpha["blurred"] - alpha["all"]).max() > 0.001


def test_flags_give_light(small, tmp_path):
    """Each item removes light, or adds some."""
    mean = {}
    sun = "sun:1,-1,0,3"
    for name, light in (
        ("sun", f"{sun};shadows:0"),
        ("shadow", sun),
        ("sky", f"{sun};shadows:0;sky:4,4,4"),
        ("occluded", f"{sun};shadows:0;sky:4,4,4;occlusion:1;reach:0.3"),
        ("lamp", "lamp:-50,60,0,2;shadows:0;indirect:1"),
    ):
        file = tmp_path / f"{name}.npz"
        args = ("--npz", file, "--size", "24x24", "--shader", "lit", "--lighting", light)
        args = (*args, "-o", tmp_path / "a.png")
        run = gvtorch("render", small, *args)
        assert run.returncode == 0, run.stderr
        mean[name] = float(np.load(file)["color"].mean())
    assert mean["shadow"] < mean["sun"] < mean["occluded"] < mean["sky"]
    assert mean["lamp"] > 0.01


def test_a_wrong_flag_gets_status_2(small):
    for args in (
        ["render"],
        ["render", small],
        ["fly"],
        ["render", small, "-o", "a.png", "--lod", "best"],
    ):
        run = gvtorch(*args)
        assert run.returncode == 2 and len(run.stderr.splitlines()) == 1, run.stderr
        assert run.stderr.startswith("gvtorch: error: ")


def test_package_runs_as_a_module():
    assert "usage: gvtorch" in gvtorch("--help").stdout
    assert (ROOT / "gvtorch" / "py.typed").exists()


@pytest.mark.backend("cpp")
def test_a_store_renders_as_its_volume_does(scan_store, tmp_path):
    """Through a pool of a few bricks, in every mode, with its cost."""
    arrays = {}
    options = ("--size", "64x48", "--tf", "gray", "--camera", "orbit:30,20,1.5")
    small_pool = ("--brick-pool", "40 kB", "--node-pool", "20 kB", "--loading", "levels")
    for name, path, extra in (
        ("volume", scan_store.with_name("ball.npy"), ("--spacing", "1,1,2")),
        ("store", scan_store, ()),
        ("small", scan_store, small_pool),
        ("once", scan_store, ("--mode", "interactive")),
    ):
        out, npz, stats = (tmp_path / f"{name}.{end}" for end in ("png", "npz", "json"))
        run = gvtorch(
            *("render", path, "-o", out, "--npz", npz, "--stats", stats, *options, *extra),
        )
        assert run.returncode == 0, run.stderr
        arrays[name] = np.load(npz)
        content = json.loads(stats.read_text())
        assert content["extent"] == [40, 48, 56]
        if name != "volume":
            assert content["converged"] == (name != "once") and content["failed"] == 0
            assert {"requests", "misses", "produced", "evicted", "miss_rate"} <= set(content)
        if name == "small":
            assert "rays took turns" in run.stdout and content["bricks"] == 40
    for name in ("store", "small"):
        for part in ("color", "alpha", "depth"):
            assert np.array_equal(arrays[name][part], arrays["volume"][part])
    assert not np.array_equal(arrays["once"]["color"], arrays["volume"]["color"])
    assert arrays["volume"]["alpha"].max() > 0.9


@pytest.mark.backend("cpp")
def test_fly_writes_pictures_and_what_each_cost(scan_store, tmp_path):
    folder = tmp_path / "flight"
    args = ("--frames", "4", "--size", "32x24", "--tf", "gray", "--mode", "converge")
    stats = tmp_path / "stats.jsonl"
    run = gvtorch("fly", scan_store, "-o", folder, *args, "--stats", stats)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip().endswith("4 pictures")
    pictures = sorted(folder.glob("*.png"))
    assert [file.name for file in pictures] == [f"{n:04d}.png" for n in range(4)]
    assert pictures[0].read_bytes() != pictures[1].read_bytes(), "the camera moves"
    lines = [json.loads(line) for line in stats.read_text().splitlines()]
    assert [line["picture"] for line in lines] == [0, 1, 2, 3]
    assert all(line["converged"] and line["milliseconds"] > 0 for line in lines)


@pytest.mark.backend("cpp")
def test_fly_along_keys_to_a_video(scan_store, tmp_path):
    av = pytest.importorskip("av")
    keys = [
        {"eye": [20, 24, 200], "target": [20, 24, 56], "fov": 40},
        {"eye": [90, 24, 160], "target": [20, 24, 56]},
        {"eye": [120, 60, 56], "target": [20, 24, 56], "up": [0, 1, 0.2]},
    ]
    (tmp_path / "path.json").write_text(json.dumps(keys))
    out = tmp_path / "flight.mp4"
    args = ("--path", tmp_path / "path.json", "--frames", "6", "--size", "64x48", "--fps", "12")
    run = gvtorch("fly", scan_store, "-o", out, "--tf", "gray", *args)
    assert run.returncode == 0, run.stderr
    with av.open(str(out)) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        assert file.streams.video[0].average_rate == 12
    assert len(frames) == 6 and frames[0].shape == (48, 64, 3)
    assert frames[-1].max() > 100 and not np.array_equal(frames[0], frames[-1])
    assert not [*tmp_path.glob(".*"), *tmp_path.glob("*.jsonl")], "and nothing else is written"
    once = gvtorch("fly", scan_store, "-o", tmp_path / "f", "--frames", 2, "--mode", "interactive")
    assert once.returncode == 0 and "of them are not complete" in once.stdout


def broken_root(folder: Path, store: Path) -> Path:
    copy = shutil.copytree(store, folder / "broken.zarr")
    levels = sorted((copy / "gvtorch/blocks").glob("[0-9]*"))
    shutil.rmtree(levels[-1] / "c")
    return copy


def keys_file(folder: Path, text: str) -> Path:
    (folder / "keys.json").write_text(text)
    return folder / "keys.json"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda t, s: ["fly", s, "-o", t / "a.avi"],
            "--output must be a folder or end in .mp4, .gif, .webp",
        ),
        (lambda t, s: ["fly", s, "-o", t / "x" / "a.mp4"], "folder not found"),
        (lambda t, s: ["fly", s, "-o", t / "a.mp4", "--size", "33x20"], "size must be even"),
        (lambda t, s: ["fly", s, "-o", t / "a", "--frames", "0"], "--frames must be an int >= 1"),
        (lambda t, s: ["fly", t / "no.zarr", "-o", t / "a"], "no.zarr"),
        (lambda t, s: ["fly", s, "-o", t / "a", "--path", "k.json"], "camera path not found"),
        (
            lambda t, s: ["fly", s, "-o", t / "a", "--path", keys_file(t, "[1]")],
            'must be a list of keys {"eye": ..., "target": ...}',
        ),
        (
            lambda t, s: ["fly", s, "-o", t / "a", "--path", keys_file(t, '[{"eye": [1, 2]}]')],
            "key 0: 'target' is missing",
        ),
        (
            lambda t, s: [
                *("fly", s, "-o", t / "a", "--path"),
                keys_file(t, '[{"eye": [1, 2], "target": [0, 0, 0]}]'),
            ],
            "eye must be three numbers, got 2",
        ),
        (
            lambda t, s: ["render", s, "-o", t / "a.png", "--brick-pool", "x"],
            'brick_pool must be bytes, as in "256 MB"',
        ),
        (lambda t, s: ["render", s, "-o", t / "a.png", "--brick-pool", "1 kB"], "at least 2"),
        (lambda t, s: ["render", s, "-o", t / "a.png", "--max-frames", "0"], "max_frames must"),
        (lambda t, s: ["render", s, "-o", t / "a.png", "--time", "3"], "time"),
        (lambda t, s: ["render", s, "-o", t / "a.png", "--key", "a"], "--key is for volume files"),
        (lambda t, s: ["info", s, "--shape", "1,2,3"], "--shape is for volume files"),
        (lambda t, s: ["render", broken_root(t, s), "-o", t / "a.png"], "root of tree 'scene'"),
        (
            lambda t, s: ["render", s, "-o", t / "a.png", "--threshold", "3"],
            "set by gvtorch convert",
        ),
        (
            lambda t, s: [
                "render",
                s.with_name("ball.npy"),
                "-o",
                t / "a.png",
                "--mode",
                "balanced",
            ],
            "--mode is for stores; make one: gvtorch convert",
        ),
    ],
)
def test_mistakes_with_stores_get_one_line(scan_store, tmp_path, make, message):
    run = gvtorch(*make(tmp_path, scan_store))
    lines = run.stderr.splitlines()
    assert run.returncode == 2 and len(lines) == 1, run.stderr
    assert lines[0].startswith("gvtorch: error: ") and message in lines[0]
    assert not list(tmp_path.glob("*.png")) and not list(tmp_path.glob("*.mp4"))


def test_patients_stand_upright_and_face_the_camera(tmp_path):
    """A nose on an upright head is at its front, and nearer to the camera than the head."""
    nibabel = pytest.importorskip("nibabel")
    z, y, x = np.meshgrid(*[np.arange(40)] * 3, indexing="ij")
    head = np.hypot(x - 20, y - 18) < 9
    nose = np.hypot(np.hypot(x - 20, y - 30), z - 30) < 4
    values = (100.0 * head + 900.0 * nose).astype(np.float32)
    nibabel.save(nibabel.Nifti1Image(values.T, np.eye(4)), tmp_path / "a.nii")
    flags = ("--size", "64x64", "--tf", "gray", "--window", "0,900", "-o", tmp_path / "a.png")
    run = gvtorch("render", tmp_path / "a.nii", *flags, "--npz", tmp_path / "a.npz")
    assert run.returncode == 0, run.stderr
    color = np.load(tmp_path / "a.npz")["color"][..., 0]
    row, _ = np.unravel_index(color.argmax(), color.shape)
    assert row < 34, "z = 30 of 40 is above the middle"
    turned = gvtorch("render", tmp_path / "a.nii", *flags, "--camera", "orbit:210,20", "--up", "z")
    assert turned.returncode == 0
    again = gvtorch("render", tmp_path / "a.nii", *flags[:-1], tmp_path / "b.png")
    assert again.returncode == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_what_is_left_out_is_told(tmp_path):
    """Warnings name channels that are not shown, and a picture that shows nothing."""
    tifffile = pytest.importorskip("tifffile")
    data = np.random.default_rng(0).integers(0, 99, (5, 2, 9, 9)).astype(np.uint8)
    names = {"axes": "ZCYX", "Channel": {"Name": ["DAPI", "actin"]}}
    tifffile.imwrite(tmp_path / "a.ome.tif", data, metadata=names, ome=True)
    flags = ("--size", "16x16", "-o", tmp_path / "a.png")
    run = gvtorch("render", tmp_path / "a.ome.tif", *flags)
    assert "channel 0 (DAPI) of 2 is shown" in run.stderr
    assert not gvtorch("render", tmp_path / "a.ome.tif", *flags, "--component", 1).stderr
    surface = ("--shader", "isosurface", "--value", "9999", "--component", 1)
    run = gvtorch("render", tmp_path / "a.ome.tif", *flags, *surface)
    assert run.returncode == 0 and "nothing is seen: values range from" in run.stderr
    assert gvtorch("convert", tmp_path / "a.ome.tif", tmp_path / "a.zarr").returncode == 0
    run = gvtorch("render", tmp_path / "a.zarr", *flags, *surface, "--stats", tmp_path / "a.json")
    message = f"values range from {data[:, 1].min()} to {data[:, 1].max()}"
    assert run.returncode == 0 and message in run.stderr and (tmp_path / "a.json").exists()


def test_info_counts_labels(tmp_path):
    values = np.zeros((6, 6, 6), np.int32)
    values[1], values[3] = 7, 2_000_000_001
    np.save(tmp_path / "a.npy", values)
    for flags in ((), ("--labels",)):
        run = gvtorch("info", tmp_path / "a.npy", *flags)
        assert run.returncode == 0 and "2, 7 to 2000000001" in run.stdout
        assert ("shown as labels" in run.stderr) == (not flags)
    gvtorch("convert", tmp_path / "a.npy", tmp_path / "a.zarr", "--labels", "--workers", 1)
    assert "2, 7 to 2000000001" in gvtorch("info", tmp_path / "a.zarr").stdout
