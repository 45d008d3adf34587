"""Films, flights and flags of the command line: what each does, and what is refused."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tyro
from helpers import ROOT, gvtorch

import gvtorch as gv
from gvtorch.tools import cli


def keys_file(folder: Path, text: str) -> Path:
    (folder / "keys.json").write_text(text)
    return folder / "keys.json"


@pytest.mark.backend("cpp")
def test_films_of_a_volume_loop(small, tmp_path):
    """GIF and WebP of a RAW file: each picture equals that of `render` with the same camera."""
    from PIL import Image, ImageSequence

    picture = tmp_path / "a.npz"
    flags = ("--size", "32x24", "--tf", "hot", "--up", "+z")
    for name, fps in (("a.gif", 30), ("a.webp", 10)):
        out = tmp_path / name
        run = gvtorch("fly", small, "-o", out, "--turntable", "0.4", "--fps", fps, *flags)
        assert run.returncode == 0, run.stderr
        with Image.open(out) as film:
            assert film.info["loop"] == 0
            frames = [
                (np.array(f.convert("RGB")), f.info.get("duration"))
                for f in ImageSequence.Iterator(film)
            ]
        assert len(frames) == round(0.4 * fps)
        if name == "a.gif":
            assert sum(duration for _, duration in frames) == 400
        path = gv.CameraPath.orbit(
            gv.N3Tree.from_volume(gv.read_volume(small)).box, up="+z", fit_size=(32, 24)
        )
        volume = gv.read_volume(small)
        shader = gv.TransferFunction.preset("hot", *gv.window(volume))
        tree = gv.N3Tree.from_volume(volume)
        for number in (0, len(frames) // 3):
            camera = path.camera(number / len(frames), 32, 24)
            expected = gv.render(tree, camera, shader).to_srgb8().numpy().astype(int)
            error = np.abs(frames[number][0] - expected)
            assert error.mean() < 4 and expected.max() > 150, (name, error.mean())
    assert not picture.exists() and not list(tmp_path.glob("tmp*")), "nothing half-written is left"


@pytest.mark.backend("cpp")
def test_the_first_picture_of_a_flight_is_whole(scan_store, tmp_path):
    flags = ("--size", "40x32", "--tf", "gray", "--loading", "levels")
    stats = ("--stats", tmp_path / "s.jsonl")
    run = gvtorch("fly", scan_store, "-o", tmp_path / "f", "--frames", "2", *flags, *stats)
    assert run.returncode == 0, run.stderr
    lines = (tmp_path / "s.jsonl").read_text().splitlines()
    assert all(json.loads(line)["converged"] for line in lines)
    run = gvtorch(
        *("fly", scan_store.with_name("ball.npy"), "-o", tmp_path / "v", "--frames", "2"),
        *(*flags[:4], "--spacing", "1,1,2"),
    )
    assert run.returncode == 0, run.stderr
    for name in ("0000.png", "0001.png"):
        pictures = [(tmp_path / folder / name).read_bytes() for folder in "fv"]
        assert pictures[0] == pictures[1], "streamed = resident, with the same window and camera"


@pytest.mark.backend("cpp")
def test_pictures_of_a_longer_flight_are_told(small, tmp_path):
    """They stay, and who makes a film of the folder would not notice them."""
    args = ("fly", small, "-o", tmp_path / "f", "--size", "8x8", "--frames")
    assert "older" not in gvtorch(*args, "3").stderr
    (tmp_path / "f" / "1.png").touch()
    shorter = gvtorch(*args, "1").stderr
    assert (
        "holds older pictures as well: 0001.png, 2 in all" in shorter and "\n" not in shorter[:-1]
    )
    assert "older" not in gvtorch(*args, "3").stderr


@pytest.mark.backend("cpp")
def test_up_turns_orbits_flights_and_keys(small, tmp_path):
    """By default the whole ball is visible, in the middle."""
    seen = {}
    for up in (None, "+y", "+z", "0,0,1", "-x"):
        file = tmp_path / "a.npz"
        flags = () if up is None else ("--up", up)
        run = gvtorch("render", small, "-o", file, "--size", "48x32", *flags)
        assert run.returncode == 0, run.stderr
        seen[up] = np.load(file)["alpha"]
        border = np.concatenate([seen[up][(0, -1), :, 0].ravel(), seen[up][:, (0, -1), 0].ravel()])
        assert not border.any() and seen[up].max() > 0.3
    assert np.array_equal(seen[None], seen["+y"]) and np.array_equal(seen["+z"], seen["0,0,1"])
    keys = [{"eye": [60, 20, 8], "target": [12, 10, 8]}, {"eye": [70, 0, 8], "target": [12, 10, 8]}]
    path = keys_file(tmp_path, json.dumps(keys))
    pictures = set()
    for number, flags in enumerate(((), ("--up", "+z"), ("--fov", "15"))):
        folder = tmp_path / str(number)
        args = ("--path", path, "--frames", "1", "--size", "24x24", *flags)
        run = gvtorch("fly", small, "-o", folder, *args)
        assert run.returncode == 0, run.stderr
        pictures.add((folder / "0000.png").read_bytes())
    assert len(pictures) == 3


def test_a_misspelt_word_gets_the_right_one(small, tmp_path):
    for args, message in (
        (["rendr", small], "unknown command 'rendr'; known: info, view, render, fly"),
        (["rendr", small], "(did you mean render?)"),
        (["render", small, "-o", "a.png", "--camra", "orbit:1,2"], "(did you mean --camera?)"),
        (["slice", small, "-o", "a.png", "--axiz", "z"], "Unrecognized options: --axiz"),
        (["slice", small, small, "-o", "a.png"], f"options: {small}; gvtorch COMMAND --help"),
        (["slice", small, "-o", "a.png", "--scale", "x"], "float: 'x'; gvtorch COMMAND --help"),
        (["info", small, "--size", "8x8"], "Unrecognized options: --size 8x8; gvtorch COMMAND"),
        (["render", small, "-o", "a.png", "--tf", "bnoe"], "(did you mean bone"),
        (["render", small, "-o", "a.png", "--tf", "virids"], "(did you mean viridis"),
    ):
        run = gvtorch(*args, cwd=tmp_path)
        assert run.returncode == 2 and len(run.stderr.splitlines()) == 1, run.stderr
        assert message in run.stderr, run.stderr


OWN_KEYS = '[{"eye": [1, 2, 3], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 20}]'


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda t: ["fly", "S", "-o", t / "f", "--fps", "30"],
            "--fps is for a film or --turntable",
        ),
        (
            lambda t: ["fly", "S", "-o", t / "f", "--turntable", "2", "--frames", "3"],
            "--turntable and --frames both set the number",
        ),
        (
            lambda t: ["fly", "S", "-o", t / "f", "--turntable", "2", "--path", "k.json"],
            "--turntable goes once around",
        ),
        (lambda t: ["fly", "S", "-o", t / "f", "--turntable", "0"], "--turntable must be finite"),
        (
            lambda t: ["fly", "S", "-o", t / "f", "--orbit", "1,2", "--path", "k.json"],
            "--orbit is for --path orbit",
        ),
        (lambda t: ["fly", "S", "-o", t / "f", "--orbit", "1"], "--orbit must be AZ,EL or AZ,EL,"),
        (lambda t: ["fly", "S", "-o", t / "f", "--orbit", "1,2,3,fit"], "--orbit must be AZ,EL or"),
        (
            lambda t: ["fly", "S", "-o", t / "f", "--up", "+z", "--path", keys_file(t, OWN_KEYS)],
            "each key has its own up",
        ),
        (
            lambda t: ["fly", "S", "-o", t / "f", "--fov", "9", "--path", keys_file(t, OWN_KEYS)],
            "each key has its own fov",
        ),
        (
            lambda t: ["fly", "S", "-o", t / "a.gif", "--background", "transparent"],
            "--background transparent is for pictures",
        ),
        (
            lambda t: ["fly", "S", "-o", t / "a.gif", "--fps", "60"],
            "fps must be an int >= 1 and <= 50",
        ),
        (
            lambda t: ["fly", "S", "-o", t / "f", "--brick-pool", "1 GB"],
            "--brick-pool is for stores",
        ),
        (lambda t: ["fly", "STORE", "-o", t / "f", "--shape", "1,2,3"], "--shape is for volume"),
        (
            lambda t: ["fly", "STORE", "-o", t / "f", "--threshold", "3"],
            "--threshold is for volumes",
        ),
        (
            lambda t: (
                ["render", "STORE", "-o", t / "a.png", "--mode", "balanced", "--max-frames", "5"]
            ),
            "--max-frames is for --mode converge",
        ),
        (lambda t: ["render", "S", "-o", t / "a.png", "--up", "up"], "--up must be +x, -x"),
        (lambda t: ["render", "S", "-o", t / "a.png", "--up", "+w"], "up must be one of +x, -x"),
        (
            lambda t: ["render", "S", "-o", t / "a.png", "--show", "lod", "--tone", "aces"],
            "--tone is for pictures, not for --show lod",
        ),
        (
            lambda t: [
                *("render", "S", "-o", t / "a.png"),
                *("--shader", "isosurface", "--value", "9", "--tf", "hot"),
            ],
            "--tf is for values: an isosurface has one",
        ),
        (
            lambda t: (
                ["render", "S", "-o", t / "a.png", "--shader", "maximum", "--stop-alpha", "0.5"]
            ),
            "--stop-alpha is for what adds up",
        ),
        (
            lambda t: ["render", "S", "-o", t / "a.png", "--lod", "finest", "--cone-scale", "2"],
            "--cone-scale is for --lod auto, or for the cones of --lighting",
        ),
        (lambda t: ["render", "S", "-o", t / "a.png", "--value", "9"], "--value and --shader iso"),
        (lambda t: ["render", "S", "-o", t / "a.png", "--window", "5,1"], "LO,HI with LO < HI"),
        (lambda t: ["info", "--shape", "1,2,3"], "--shape is for volume files: name one"),
        (lambda t: ["info", "S", "--shape", ""], "--shape must be 3 whole numbers"),
    ],
)
def test_flags_that_would_do_nothing_are_refused(small, scan_store, tmp_path, make, message):
    paths = {"S": small, "STORE": scan_store}
    run = gvtorch(*(paths.get(arg, arg) for arg in make(tmp_path)))
    assert run.returncode == 2 and len(run.stderr.splitlines()) == 1, run.stderr
    assert message in run.stderr and not [*tmp_path.glob("*.png"), *tmp_path.glob("a.*")]


def test_a_flight_does_not_overwrite_its_background(small, tmp_path):
    from PIL import Image

    Image.new("RGB", (8, 4)).save(tmp_path / "0001.png")
    before = (tmp_path / "0001.png").read_bytes()
    flags = ("--frames", 2, "--size", "8x8", "--background", tmp_path / "0001.png")
    run = gvtorch("fly", small, "-o", tmp_path, *flags)
    assert run.returncode == 2 and "would be written over what --background reads" in run.stderr
    assert (tmp_path / "0001.png").read_bytes() == before


def test_a_component_that_is_not_there_names_what_is(small, scan_store, tmp_path):
    np.save(tmp_path / "two.npy", np.zeros((5, 6, 7, 2), np.uint8))
    for command in ("render", "slice"):
        for path, message in (
            (small, "one number: 0"),
            (scan_store, "one number: 0"),
            (tmp_path / "two.npy", "2 numbers: 0, 1"),
        ):
            run = gvtorch(command, path, "-o", tmp_path / "a.png", "--component", "2")
            assert run.returncode == 2 and len(run.stderr.splitlines()) == 1, run.stderr
            assert f"--component 2: a voxel has {message}" in run.stderr, run.stderr


def test_help_offers_what_a_command_takes(scan_store, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    for command in ("info", "surface", "slice", "view", "render", "fly", "convert"):
        text = gvtorch(command, "--help").stdout
        assert ("a store takes only --time" in text) == (command != "convert")
        assert ("a store takes only --time and --key" in text) == (command == "info")
        assert ("--size WxH" in text) == (command in ("render", "fly"))
    run = gvtorch("info", scan_store, "--time", "0", "--key", "0")
    assert run.returncode == 0, run.stderr


def test_values_may_begin_with_a_minus(small, tmp_path):
    run = gvtorch("info", small, "--spacing", "-1,1,1")
    assert run.returncode == 2 and "spacing must be positive" in run.stderr
    for flags in (("--position", "-0.5mm"), ("--up", "-y"), ("--up", "+y")):
        run = gvtorch("slice", small, "-o", tmp_path / "a.png", *flags)
        assert run.returncode == 0, run.stderr


def test_commands_in_the_docs_are_commands():
    """Each line of a listing is parsed, and nothing runs."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    listed = re.compile(rf"^gvtorch (?:{'|'.join(cli._COMMANDS)}) .*", re.M)
    lines = [line for page in pages for line in listed.findall(page.read_text())]
    commands = [shlex.split(line, comments=True)[1:] for line in lines]
    assert len(commands) > 30 and {command[0] for command in commands} == {*cli._COMMANDS}
    for command in commands:
        if "--help" not in command:
            config = (tyro.conf.CascadeSubcommandArgs,)
            tyro.extras.subcommand_cli_from_dict(cli._COMMANDS, args=command, config=config)
