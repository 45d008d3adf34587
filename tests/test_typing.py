"""Type checkers see gvtorch's types from another folder, in a strict project, with an editable
install, because that is a path, not an import hook that only Python can use.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tomllib

import pytest
from helpers import ROOT

import gvtorch as gv
from gvtorch.cameras import camera
from gvtorch.shaders import built_in

USE = """
import gvtorch as gv
import torch

tree = gv.N3Tree.from_volume(gv.Volume(torch.rand(8, 8, 8)))
shader = gv.TransferFunction([(0, 0), (1, 0.5)])
reveal_type(gv.render(tree, gv.Camera.orbit(), shader, step=0.5, lod="finest").color)
reveal_type(tree.to_volume())
gv.render(tree, gv.Camera.orbit(), shader, stp=1)
gv.DistanceField(offset=1.0, filled=False, diffus=1.0)
"""

# Of what gvtorch imports, only torch's Tensor is read: two thirds of the time went into the rest.
OPTIONS = """
[mypy-torch.*,kornia.*,IPython.*,zarr.*]
follow_imports = skip
[mypy-torch,torch._tensor,torch._C.*]
follow_imports = normal
"""


@pytest.mark.long
def test_a_strict_project_sees_the_types(tmp_path):
    pytest.importorskip("mypy")
    site = tmp_path / "venv" / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    (site / "gvtorch.pth").write_text(f"{ROOT}\n{sysconfig.get_path('purelib')}\n")
    (tmp_path / "use.py").write_text(USE)
    (tmp_path / "mypy.ini").write_text(f"[mypy]\n{OPTIONS}")
    python = str(tmp_path / "venv" / "bin" / "python")
    call = [sys.executable, "-m", "mypy", "--strict", "--python-executable", python, "use.py"]
    call += ["--no-incremental", "--cache-dir", os.devnull]  # to write one takes seconds
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
    lines = [line.partition(": ")[2] for line in done.stdout.splitlines()]
    assert [line for line in lines if line and "defined in" not in line] == [
        'note: Revealed type is "torch._tensor.Tensor"',
        'note: Revealed type is "gvtorch.base.volume.Volume"',
        'error: Unexpected keyword argument "stp" for "render"; did you mean "step"?  [call-arg]',
        'error: Unexpected keyword argument "diffus" for "DistanceField"; did you mean "diffuse"?  '
        "[call-arg]",
    ], done.stdout + done.stderr
    assert "Found 2 errors" in done.stdout


def test_an_editable_install_is_a_path():
    """setuptools writes a path if the folder of packages is specified, else an import hook."""
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert tool["package-dir"] == {"": "."} and (ROOT / "gvtorch" / "py.typed").is_file()


def test_every_public_name_is_there():
    """`*` in `__init__.pyi` stands for what rooms hand on, and for the `__all__` of a module."""
    values = {name: getattr(gv, name) for name in gv.__all__}
    assert {"Camera", "Engine", "Isosurface", "N3Tree", "render", "sdf"} <= set(values)
    assert values["Lit"] is built_in.Lit and values["Camera"] is camera.Camera
    assert not [name for name in values if name.startswith("_") or name not in dir(gv)]
