"""Every example runs and writes its picture."""

from __future__ import annotations

import functools
import importlib.util
import os
import subprocess
import sys

import pytest
from conftest import ROOT

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
TRIANGLES = ROOT / "examples" / "mixed_triangles.py"


@functools.cache
def no_vtk() -> str:
    """Why VTK can't draw here, or nothing. Without OpenGL it ends its process, so another tries."""
    if not importlib.util.find_spec("vtk"):
        return "VTK is not installed"
    code = "import vtk; w = vtk.vtkRenderWindow(); w.SetOffScreenRendering(True); w.Render()"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    return "VTK finds no OpenGL" if run.returncode else ""


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    "example",
    [
        pytest.param(each, id=each.stem, marks=pytest.mark.backend("opengl"))
        if each == TRIANGLES
        else pytest.param(each, id=each.stem)
        for each in EXAMPLES
    ],
)
def test_example_writes_a_picture(example, tmp_path):
    if example == TRIANGLES and (reason := no_vtk()):
        pytest.skip(reason)
    out = tmp_path / "picture.png"
    command = [sys.executable, str(example), "--size", "48", "--output", str(out)]
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert out.read_bytes().startswith(b"\x89PNG") and str(out) in run.stdout
    assert 20 <= len(example.read_text().splitlines()) <= 120


def test_without_vtk_the_example_tells_what_to_install(tmp_path):
    (tmp_path / "vtk.py").write_text("raise ImportError('no VTK')")  # shadows what there is
    command = [sys.executable, str(TRIANGLES)]
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", str(ROOT))])
    run = subprocess.run(
        command, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path}
    )
    assert run.returncode == 1 and len(run.stderr.splitlines()) == 1
    assert "needs VTK: pip install 'gvtorch[triangles]'" in run.stderr


def test_a_producer_of_ones_own_takes_at_most_40_lines():
    assert len((ROOT / "examples" / "hello_sphere.py").read_text().splitlines()) <= 40


def test_there_are_examples():
    assert EXAMPLES
