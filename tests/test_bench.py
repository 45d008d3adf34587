"""Workloads: each runs and returns finite figures, peers agree, and missing ones are named."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers import DEVICES, ROOT, gvtorch

import gvtorch as gv
from gvtorch import bench
from gvtorch.bench import browser, scenes, tables
from gvtorch.bench import record as record_module
from gvtorch.bench.peers import pages
from gvtorch.bench.peers.peer import Task, find_peers
from gvtorch.bench.record import Record, Settings, clock
from gvtorch.bench.shaders import VARIANTS
from gvtorch.tools.bench import Bench

QUICK = {"quick": True, "repeats": 1}
CPU = Settings(device=torch.device("cpu"), **QUICK)
#: Columns that the rows of a workload must have in addition to times.
FIGURES = {
    "march": {"samples", "samples_per_second", "rays_per_second", "op_ms", "rms_difference"},
    "first_hit": {"rays_per_second", "max_difference", "mean_difference", "times"},
    "calls": {"op_ms", "times", "same"},
    "bricks": {"samples_per_second", "tree_bytes", "brick_size", "border"},
    "opengl": {"host_ms", "same"},
    "view": {"p95_ms", "pictures_per_second", "share", "first_ms", "rest_ms"},
    "frame": {"cache_share", "cache_ms", "stages", "frames", "bricks", "max_difference"},
    "shaders": {"times", "beside", "samples_per_second", "op_ms", "max_difference"},
    "lens": {"aperture", "bricks", "moved_bytes", "brick_bytes", "samples"},
    "deep": {"samples_per_second", "times", "bricks", "max_difference"},
    "lru": {"slots_per_second", "times", "same"},
    "compact": {"words_bytes_per_second", "times", "same"},
    "produce": {"bricks_per_second", "voxels_per_second"},
    "noise": {"values_per_second", "times", "max_difference"},
    "stream": {"bytes_per_second", "copy_share", "moved_bytes"},
    "convert": {"source_bytes_per_second", "memory_bytes", "disk_bytes"},
    "blocks": {"blocks_per_second"},
    "voxelize": {"voxels_per_second", "memory_bytes", "disk_bytes", "max_difference"},
}


def figures(value) -> list[float]:
    """Returns all numbers inside a row."""
    if isinstance(value, dict):
        return [number for item in value.values() for number in figures(item)]
    return [] if value is None or isinstance(value, (str, bool)) else [value]


@pytest.mark.filterwarnings("default")  # torch.compile's own warnings
@pytest.mark.parametrize("name", bench.WORKLOADS)
def test_a_workload_gives_finite_figures_as_json(name, compiled, monkeypatch, quick):
    monkeypatch.setenv("CXX", quick)
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))  # saves minutes
    device = torch.device(DEVICES[compiled])
    chosen = Settings(device=device, peers=("grid_sample", "zarr", "tensorstore"), **QUICK)
    content = json.loads(json.dumps(bench.run(name, chosen).as_dict(), allow_nan=False))
    assert content["workload"] == name and content["quick"] is True
    assert content["machine"]["name"] and content["machine"]["backend"] == compiled
    rows = content["rows"]
    assert FIGURES[name] <= {field for row in rows for field in row}
    for row in rows:
        assert row["case"] and row["who"] and row["repeats"] >= 1
        assert 0 < row["ms_low"] <= row["ms"] <= row["ms_high"]
        assert all(math.isfinite(number) for number in figures(row)), row
        assert row.get("same", True) is True
    assert len({(row["case"], row["who"]) for row in rows}) == len(rows)
    assert len(tables.markdown(content).splitlines()) >= 2 + len(rows)


def test_what_cant_run_here_is_left_out_of_all(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "moderngl", None)
    with pytest.raises(bench.Unavailable, match="opengl needs moderngl"):
        bench.run("opengl", CPU)
    with pytest.raises(bench.Unavailable, match="no case of compact has 'slots' in its name"):
        bench.run("compact", replace(CPU, only="slots"))  # a case of lru
    names = []

    def run_workload(self, name):
        names.append(name)
        if name == "opengl":
            raise bench.Unavailable("no OpenGL")

    monkeypatch.setattr(Bench, "_run_workload", run_workload)
    Bench(name="all").run()
    assert names == [*bench.WORKLOADS]
    assert capsys.readouterr().err == "opengl is left out: no OpenGL\n"
    with pytest.raises(bench.Unavailable):
        Bench(name="opengl").run()


def test_all_workloads_without_a_case_are_a_mistake(monkeypatch):
    def run_workload(self, name):
        raise bench.Unavailable(f"no case of {name} has {self.only!r} in its name")

    monkeypatch.setattr(Bench, "_run_workload", run_workload)
    with pytest.raises(ValueError, match="bench: all workloads were left out"):
        Bench(name="all", only="nothing").run()


def test_twins_and_streamed_shaders_draw_the_same(compiled, monkeypatch, quick):
    monkeypatch.setenv("CXX", quick)
    chosen = Settings(device=torch.device(DEVICES[compiled]), only="aneurism", **QUICK)
    rows = bench.run("shaders", chosen).rows
    twins = [row for row in rows if row["who"] in ("module", "user's header")]
    streamed = [row for row in rows if "engine" in row["case"]]
    assert len(twins) == 4 and len(streamed) == len(VARIANTS) == len(rows) / 2
    assert max(row["max_difference"] for row in twins + streamed) <= 1e-4
    for row in rows:
        (peer,) = (r for r in rows if (r["case"], r["who"]) == (row["case"], row["beside"]))
        assert row["times"] == row["ms"] / peer["ms"]


def test_a_shader_is_timed_with_what_it_stands_beside():
    chosen = Settings(device=CPU.device, only="fog dense, resident, 24x16, pre-", **QUICK)
    names = [row["who"] for row in bench.run("shaders", chosen).rows]
    assert names == ["plain", "plain, step 1", "pre-integrated, step 1"]


@pytest.mark.backend("cpp")
def test_grid_sample_agrees_with_the_picture():
    """Without early stop both integrate the same samples; with it one may take one more."""
    scene = scenes.clouds(48)
    camera = scene.camera(40, 30)
    tree = gv.N3Tree.from_volume(scene.volume)
    marcher = find_peers(Record("march", Settings(device=CPU.device, peers=("grid_sample",))))
    for stop, bound in ((1.0, 1e-5), (0.99, 1e-2)):
        options = {"step": scene.step, "lod": "finest", "stop_alpha": stop}
        picture = gv.render(tree, camera, scene.shader, **options)
        task = Task(
            scene=scene, camera=camera, rays=camera.rays(), stop_alpha=stop, device=CPU.device
        )
        peer = marcher["grid_sample"](task)
        peer.render()
        actual = peer.picture().reshape(30, 40, 4)
        assert (actual[..., :3] - picture.color).abs().max() < bound
        assert (actual[..., 3:] - picture.alpha).abs().max() < bound
    assert picture.alpha.max() > 0.9 and picture.alpha.min() < 0.1


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("name", "bound"), [("grid_sample", 1e-3), ("warp", 1e-3), ("drjit", 1e-3), ("vtk", 2e-2)]
)
def test_a_peer_renders_the_same_picture(name, bound):
    record = bench.run("first_hit", Settings(device=CPU.device, peers=(name,), **QUICK))
    if record.peers[name] != "ran":
        pytest.skip(f"{name}: {record.peers[name]}")
    row = record.rows[-1]
    assert row["who"] == name and row["rms_difference"] < bound
    assert any(note.startswith(f"{name}: ") for note in record.notes)


def test_workloads_and_their_peers_are_known():
    assert {*bench.COMPARED_WITH} <= {*bench.WORKLOADS} >= {*bench.SAVES_PICTURES}
    compared = {name for peers in bench.COMPARED_WITH.values() for name in peers}
    assert compared == {*record_module.PEERS}


@pytest.mark.backend("cpp")
def test_a_peer_that_is_missing_is_named(monkeypatch):
    for module in ("warp", "drjit", "vtkmodules", "vtkmodules.vtkRenderingOpenGL2"):
        monkeypatch.setitem(sys.modules, module, None)
    for module in ("warp_nanovdb", "drjit_loop", "vtk_fixed_point"):
        monkeypatch.delitem(sys.modules, f"gvtorch.bench.peers.{module}", raising=False)
    chosen = Settings(device=CPU.device, only="clouds", peers=("warp", "drjit", "vtk"), **QUICK)
    record = bench.run("march", chosen)
    assert record.peers == {
        "warp": "not installed (warp-lang)",
        "drjit": "not installed (drjit)",
        "vtk": "not installed (vtk)",
    }
    assert {row["who"] for row in record.rows} == {"gvtorch", "gvtorch auto"}
    assert "- vtk: not installed (vtk)." in tables.markdown(record.as_dict())


def test_scenes_are_what_their_names_say():
    dense, sparse = (
        gv.N3Tree.from_volume(make(64).volume) for make in (scenes.fog_dense, scenes.fog_sparse)
    )
    assert dense.bricks.capacity == 1 + 8 + 64 + 512 and sparse.bricks.capacity < 300
    dense, sparse = (
        gv.N3Tree.from_volume(make(64).volume) for make in (scenes.shell_dense, scenes.shell_sparse)
    )
    assert dense.bricks.capacity == 1 + 8 + 64 + 512 and sparse.bricks.capacity < 500
    clouds = scenes.clouds(64)
    visible = clouds.shader(clouds.volume.data[..., 0].numpy())[..., 3] > 0
    assert abs(1 - visible.mean() - 0.68) < 0.01


def test_a_figure_that_takes_long_is_made_of_fewer_timings():
    calls: list[str] = []
    patient = Settings(device=CPU.device, repeats=3)
    timing = clock(lambda: calls.append("run"), patient, calls=2, prepare=lambda: calls.append("p"))
    assert calls == ["p", "run", "run"] * 4 and timing.repeats == 3
    hasty = Settings(device=CPU.device, repeats=3, seconds=0)
    assert clock(lambda: None, hasty).repeats == 1


def test_a_busy_machine_is_noted(monkeypatch):
    for others, noted in ((0.0, False), (1000.0, True)):
        seconds = iter((0.0, others))
        monkeypatch.setattr(record_module, "_busy_seconds", lambda s=seconds: next(s))
        record = Record("lru", CPU)
        with record_module.noting_other_processes(record):
            pass
        assert any("Other processes took" in note for note in record.notes) is noted


def test_the_command_lists_and_names_mistakes():
    listed = gvtorch(
        "bench",
    )
    assert listed.returncode == 0
    assert [line.split()[0] for line in listed.stdout.splitlines()] == [*bench.WORKLOADS]
    assert json.loads(gvtorch("bench", "--json").stdout) == bench.WORKLOADS
    for args, message in (
        (["nonsense"], "unknown workload 'nonsense'; known: march"),
        (["lru", "--peers", "vtk"], "--peers: lru is compared with nothing, not 'vtk'"),
        (["all", "--peers", "nobody"], "all is compared with grid_sample, warp, drjit, vtk, viser"),
        (["lru", "--pictures", "folder"], "--pictures is for march and first_hit"),
        (["lru", "--device", "teapot"], "--device must be cpu, cuda or cuda:N"),
        (["lru", "--quick", "--only", "nothing"], "no case of lru has 'nothing' in its name"),
        (["lru", "--repeats", "0"], "repeats must be an int >= 1"),
    ):
        run = gvtorch("bench", *args)
        assert run.returncode == 2 and message in run.stderr, run.stderr
        assert len(run.stderr.strip().splitlines()) == 1 and not run.stdout


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_the_command_prints_json_and_plots_write_the_page(tmp_path):
    run = gvtorch("bench", "lru", "--quick", "--repeats", 1, "--json", "-o", tmp_path)
    assert run.returncode == 0, run.stderr
    content = json.loads(run.stdout)
    (file,) = tmp_path.glob("lru.*.quick.json")
    assert json.loads(file.read_text()) == content

    page = tmp_path / "page.md"
    script = ROOT / "benchmarks" / "plots.py"
    marks = [line.split('"')[1] for line in script.read_text().splitlines() if '"<!--' in line]
    page.write_text(f"before\n{marks[0]}\nold\n{marks[1]}\nafter\n")
    command = [sys.executable, script, "--records", tmp_path, "--page", page]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 1 and "no records" in run.stderr, "quick sizes are no figures"
    (tmp_path / "lru.json").write_text(json.dumps({**content, "quick": False}))
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert "| torch.sort |" in text and content["machine"]["name"] in text
    assert (tmp_path / "lru.png").exists() == ("(lru.png)" in text)


@pytest.mark.long
@pytest.mark.backend("browser")
def test_a_hand_in_a_browser_sees_its_jump(chromium, viewer):
    """Pictures arrive while the mouse drags, and one that shows the jump of the pointer."""
    page = browser.Page(chromium, viewer.url, pages.PAGES["gvtorch"][1], (320, 200))
    try:
        client_width = page.page.evaluate("() => document.querySelector('.gv-picture').clientWidth")
        result = page.drag(0.3, 1)
    finally:
        page.close()
    assert client_width == 320 and result.rate > 0
    assert len(result.delays) == 1 and 0 < result.delays[0] < 60e3


def test_where_the_scan_is_missing_fog_takes_its_place(monkeypatch, tmp_path):
    monkeypatch.setattr(scenes, "SCAN", tmp_path / "scan_8x8x8_uint8.raw.gz")
    notes: list[str] = []
    assert scenes.scan_or_fog(8, notes.append).name == "fog dense"
    assert "file is missing" in notes[0] and notes[1] == "fog takes the place of the scan"
