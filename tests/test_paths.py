"""A store opens by any path by which the system finds it, and leaves no files next to itself."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers import ROOT
from helpers.stores import assert_holds, noise

import gvtorch as gv
from gvtorch.io.stores.conversion import convert
from gvtorch.io.stores.store import Store
from gvtorch.io.stores.store_layout import WORK
from gvtorch.tools import cli
from gvtorch.tools.cli import main

NAMES = [
    "a b",
    "q?u",
    "st*r",
    "ha#sh",
    "per%20cent",
    "Ünï—コ",
    "a'b\"c",
    "[1]",
    "a:b&c;$d",
    "tab\t",
    "back\\slash",
    "a.__lock",
    "-x",
    "~",
    "$HOME",
    "esc\x1b[2J",
]


@pytest.fixture(scope="module")
def data() -> np.ndarray:
    return noise((9, 20, 30, 1))


@pytest.mark.parametrize("name", NAMES)
def test_any_name_opens(tmp_path, data, name, capsys):
    folder = tmp_path / name
    folder.mkdir()
    target = folder / f"{name}.zarr"
    np.save(folder / "in.npy", data)
    for form in (str(target), str(folder / ".." / name / "." / "twice.zarr")):
        main(["convert", str(folder / "in.npy"), form])
        main(["info", form, "--json"])
        assert json.loads(capsys.readouterr().out.splitlines()[-1])["extent"] == [30, 20, 9]
        assert_holds(Store.open(form), data)
    assert sorted(os.listdir(folder)) == sorted(["in.npy", target.name, "twice.zarr"])
    assert sorted(os.listdir(tmp_path)) == [name]
    assert not (target / WORK).exists()
    assert np.array_equal(gv.read_volume(target).data.numpy(), data)
    assert Store.open(target.as_uri()).extent == (30, 20, 9)


@pytest.mark.backend("cpp")
def test_up_a_folder_and_through_links(tmp_path, data, monkeypatch, capsys):
    (tmp_path / "deep/er").mkdir(parents=True)
    (tmp_path / "work").mkdir()
    convert(gv.Volume(data), tmp_path / "scan.zarr")
    (tmp_path / "link.zarr").symlink_to("scan.zarr")
    (tmp_path / "work/elsewhere").symlink_to(tmp_path / "deep/er")
    monkeypatch.chdir(tmp_path / "work")
    for path in (
        *("../scan.zarr", "../link.zarr", "..//scan.zarr/", "./../work/../scan.zarr"),
        "elsewhere/../../scan.zarr",  # the parent of the link's target
    ):
        assert_holds(Store.open(path), data)
        main(["info", path])
        size = ["--size", "8x8", "--brick-pool", "9 MB"]
        main(["render", path, "-o", "a.png", *size])
        main(["fly", path, "-o", "flight", "--frames", "1", *size])
    convert("../scan.zarr", "elsewhere/../new.zarr")
    assert (tmp_path / "deep/new.zarr/zarr.json").exists()
    assert sorted(os.listdir(tmp_path)) == ["deep", "link.zarr", "scan.zarr", "work"]
    assert sorted(os.listdir(tmp_path / "work")) == ["a.png", "elsewhere", "flight"]
    capsys.readouterr()


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    "name", [b"\xff\xfe", b"back\\s", b"a b?*#%41", b"new\nline", b"../in", b"link"]
)
def test_every_command_takes_any_path(tmp_path, data, name, monkeypatch, capsys):
    """Bytes that are not UTF-8, special characters of shells and URLs, ".." and links."""
    folder = tmp_path / os.fsdecode(b"in" if name.startswith(b"..") else name)
    if name == b"link":
        (tmp_path / "real").mkdir()
        folder.symlink_to("real")
    else:
        folder.mkdir()
    end = os.fsdecode(name.rpartition(b"/")[2])
    path = folder / ".." / folder.name / end if b".." in name else folder / end

    def file(ending: str) -> str:
        return f"{path}{ending}"

    np.save(file(".npy"), data)
    np.savez(file(".npz"), position=np.random.default_rng(0).random((50, 3)))
    Path(file(".obj")).write_text(TETRAHEDRON)
    size, few = ["--size", "16x16"], ["--frames", "2"]
    looked: list[str] = []
    monkeypatch.setattr("gvtorch.viewer.view", lambda volume, *_, **__: looked.append(volume.name))
    written = [".zarr", "v.zarr", "p.zarr", ".png", "t.png", ".exr", ".tif", "fly", ".mp4", ".gif"]
    for command in (
        ["convert", file(".npy"), file(".zarr")],
        ["voxelize", file(".obj"), "-o", file("v.zarr"), "--resolution", "16"],
        ["splat", file(".npz"), "-o", file("p.zarr"), "--extent", "16"],
        *(["info", file(ending)] for ending in (".npy", ".zarr", "v.zarr", "p.zarr")),
        *(["render", file(".zarr"), "-o", file(ending), *size] for ending in (".png", ".exr")),
        ["render", file(".npy"), "-o", file(".tif"), *size],
        *(["fly", file(".zarr"), "-o", file(to), *few, *size] for to in ("fly", ".mp4", ".gif")),
        ["slice", file(".zarr"), "-o", file("t.png")],
        ["view", file(".zarr"), "--no-browser"],
        ["view", file(".npy"), "--no-browser"],
    ):
        main(command)
    assert looked == [end, f"{end}.npy"]
    assert_holds(Store.open(file(".zarr")), data)
    inputs = [".npy", ".npz", ".obj"]
    assert sorted(os.listdir(folder)) == sorted(f"{end}{ending}" for ending in (*inputs, *written))
    assert sorted(os.listdir(tmp_path)) == sorted(
        {folder.name} | ({"real"} & {*os.listdir(tmp_path)})
    )
    capsys.readouterr()


@pytest.mark.long
def test_links_to_names_that_are_no_text_go_with_the_process(tmp_path, data):
    """In a separate process and its workers, which print to a terminal that can't show bytes."""
    bad = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.zarr")
    np.save(tmp_path / "in.npy", data)
    (tmp_path / "tmp").mkdir()
    for command in (
        ("convert", "in.npy", bad, "--workers", "2"),
        ("info", bad),
        ("info", bad + "x"),
    ):
        run = subprocess.run(
            [sys.executable, "-m", "gvtorch", *command],
            env=os.environ | {"TMPDIR": str(tmp_path / "tmp"), "PYTHONPATH": str(ROOT)},
            cwd=tmp_path,
            capture_output=True,
            check=False,
        )
        missing = command[1].endswith("x")
        assert run.returncode == (2 if missing else 0), run.stderr
        assert run.stderr.count(b"\n") == 1 or not missing
        assert b"Traceback" not in run.stderr and not os.listdir(tmp_path / "tmp")
    assert_holds(Store.open(bad), data)


# --- Ctrl-C


INTERRUPTED = """
if __name__ == "__main__":
    import signal, sys, time
    signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
    from gvtorch.io.stores import conversion_plan, shard
    from gvtorch.tools.cli import main
    original = shard.write_shard
    def slow(task, level, place):
        if task.root["driver"] == "file":
            time.sleep(0.3)
        return original(task, level, place)
    if WORKERS == 1:
        shard.write_shard = slow
    else:
        conversion_plan._FEW_TASKS = 0
    main(["convert", sys.argv[1], sys.argv[2], "--workers", str(WORKERS)])
"""


@pytest.mark.parametrize(("workers", "delay"), [(1, 0.5), (2, 0.0), (2, 0.1)])
def test_ctrl_c_ends_in_one_line_that_tells_how_to_go_on(tmp_path, workers, delay):
    """With two workers it arrives while these start, which takes a few tenths of a second."""
    data = noise((300, 280, 270, 1)) if workers > 1 else noise((9, 20, 600, 1))
    source, target = tmp_path / "my scan.npy", tmp_path / "a.zarr"
    np.save(source, data)
    script = tmp_path / "script.py"
    script.write_text(INTERRUPTED.replace("WORKERS", str(workers)))
    process = subprocess.Popen(
        [sys.executable, str(script), str(source), str(target)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    journal = target / WORK / "journal.jsonl"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not journal.exists():
        time.sleep(0.02)
    time.sleep(delay)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the whole group
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert err.count("\n") == 1 and "Traceback" not in err
    assert "interrupted, " in err and "the same command with --resume" in err
    assert_holds(convert(source, target, resume=True, workers=1), data)
    assert sorted(os.listdir(tmp_path)) == ["a.zarr", "my scan.npy", "script.py"]
    assert not [file for file in Path(target).rglob("*") if "__lock" in file.name]


STARTING = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
from gvtorch.__main__ import main
print(flush=True)
main()
"""


def test_ctrl_c_while_a_command_starts_says_nothing():
    """Most of a short command's time is imports: tries several moments before it does anything."""
    for delay in (0.02, 0.1, 0.3):
        process = subprocess.Popen(
            [sys.executable, "-c", STARTING, "render", "none.npy", "-o", "none.png"],
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(delay)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
        assert process.returncode in (-signal.SIGINT, 130) and not err


def test_ctrl_c_within_an_import_that_swallows_it_comes_behind_it(tmp_path, monkeypatch):
    """As numpy.f2py does, which a command imports indirectly."""
    (tmp_path / "swallowing.py").write_text(
        "import signal\n"
        "try:\n    signal.raise_signal(signal.SIGINT)\nexcept BaseException:\n    pass\n"
        "whole = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        with pytest.raises(KeyboardInterrupt), cli._interruptible():
            assert importlib.import_module("swallowing").whole
            time.sleep(5)
            pytest.fail("it was swallowed")
    finally:
        signal.signal(signal.SIGINT, before)
