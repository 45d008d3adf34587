"""A store opens behind whatever path the system finds it by, and leaves nothing beside itself."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.stores import assert_holds, noise

import gvtorch as gv
from gvtorch.io.conversion import convert
from gvtorch.io.store import Store
from gvtorch.io.store_layout import WORK
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
        "elsewhere/../../scan.zarr",  # the link's own parent, which is not its folder here
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


def test_a_name_that_is_no_text_is_one_line(tmp_path, data):
    bad = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.zarr")
    with pytest.raises(ValueError, match=r"a store's path must be UTF-8"):
        convert(gv.Volume(data), bad)
    assert not os.listdir(tmp_path)


# --- Ctrl-C


INTERRUPTED = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
from gvtorch.io import conversion, shard
from gvtorch.tools.cli import main
original = shard.write_shard
def slow(task, level, place):
    if task.root["driver"] == "file":
        time.sleep(0.3)
    return original(task, level, place)
if WORKERS == 1:
    shard.write_shard = slow
else:
    conversion._FEW = 0
if __name__ == "__main__":
    main(["convert", sys.argv[1], sys.argv[2], "--workers", str(WORKERS)])
"""


@pytest.mark.parametrize(("workers", "delay"), [(1, 0.5), (2, 0.0), (2, 0.1), (2, 1.0)])
def test_ctrl_c_ends_in_one_line_that_tells_how_to_go_on(tmp_path, workers, delay):
    """At two workers it comes while these start, which takes them seconds."""
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
    assert f"convert '{source}' {target} --resume goes on" in err
    assert "interrupted, " in err
    assert_holds(convert(source, target, resume=True), data)
    assert sorted(os.listdir(tmp_path)) == ["a.zarr", "my scan.npy", "script.py"]
    assert not [file for file in Path(target).rglob("*") if "__lock" in file.name]
