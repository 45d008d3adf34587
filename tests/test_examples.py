"""Every example runs and writes its picture."""

from __future__ import annotations

import runpy
import sys

import pytest
from helpers import ROOT
from helpers.opengl import IN_OPENGL

# Options that make them short.
SHORT = {
    "clip": ["--samples", "2"],
    "cloud": ["--voxels", "48"],
    "clouds": ["--voxels", "48"],
    "combine": ["--extent", "64"],
    "compiled_shader": ["--samples", "2"],
    "ct_scan": ["--samples", "2"],
    "depth_of_field": ["--samples", "2"],
    "distance_fields": ["--extent", "64"],
    "galaxy": ["--stars", "2000"],
    "halo": ["--samples", "2"],
    "hypertexture": ["--extent", "64"],
    "labels": ["--side", "32"],
    "lattice": ["--extent", "64"],
    "mandelbulb": ["--extent", "64"],
    "mandelbulb_film": ["--frames", "3"],
    "meshes": ["--resolution", "64"],
    "stars": ["--extent", "64"],
    "surface": ["--size", "48"],  # it has a level 3
    "thin_wall": ["--samples", "2"],
    "voxelize": ["--resolution", "64"],
}
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.backend("cpp")
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    "example",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.backend("opengl")] * opengl)
        for path in EXAMPLES
        for opengl in [path.stem in IN_OPENGL]
    ],
)
def test_example_writes_a_picture(example, tmp_path, monkeypatch, capsys, quick):
    """Runs within this process, because a new one would have to import torch."""
    if example.stem in IN_OPENGL and (reason := IN_OPENGL[example.stem]()):
        pytest.skip(reason)
    out = tmp_path / "picture.png"
    monkeypatch.setenv("CXX", quick)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(example.parent))  # as when a script is run
    arguments = ["--size", "24", "--output", str(out), *SHORT.get(example.stem, ())]
    monkeypatch.setattr(sys, "argv", [str(example), *arguments])
    runpy.run_path(str(example), run_name="__main__")
    assert out.read_bytes().startswith(b"\x89PNG") and str(out) in capsys.readouterr().out
    assert 20 <= len(example.read_text().splitlines()) <= 80


@pytest.mark.parametrize(
    ("example", "package", "message"),
    [
        ("mixed_triangles", "vtk", "needs VTK: pip install 'gvtorch[triangles]'"),
        ("opengl_frame", "moderngl", "needs moderngl: pip install moderngl"),
    ],
)
def test_an_example_tells_what_to_install(monkeypatch, example, package, message):
    monkeypatch.setitem(sys.modules, package, None)  # not installed
    monkeypatch.setattr(sys, "argv", [example])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(ROOT / "examples" / f"{example}.py"), run_name="__main__")
    assert message in stop.value.code and "\n" not in stop.value.code, "text: status 1, one line"


def test_a_producer_of_ones_own_takes_at_most_40_lines():
    assert len((ROOT / "examples" / "hello_sphere.py").read_text().splitlines()) <= 40


def test_there_are_examples():
    assert EXAMPLES
