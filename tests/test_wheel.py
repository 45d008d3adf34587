"""How the libraries of a wheel are compiled; .ci/run builds a wheel and checks its tag."""

from __future__ import annotations

import runpy
import tomllib

import pytest
from helpers import ROOT


@pytest.fixture
def build(monkeypatch):
    """libraries.py, which is run by its path from the root."""
    monkeypatch.chdir(ROOT)
    return runpy.run_path("gvtorch/cpp_ext/libraries.py")


@pytest.mark.parametrize(
    ("release", "flag"),
    [("12.4", "-Xfatbin=-compress-all"), ("13.0", "--compress-mode=size")],
)
def test_machine_code_is_compressed_as_drivers_read_it(build, tmp_path, monkeypatch, release, flag):
    nvcc = tmp_path / "nvcc"
    nvcc.write_text(f"#!/bin/sh\necho 'Cuda compilation tools, release {release}, V{release}.1'\n")
    nvcc.chmod(0o755)
    monkeypatch.setenv("NVCC", str(nvcc))
    monkeypatch.delenv("GVTORCH_CUDA", raising=False)
    monkeypatch.delenv("GVTORCH_CUDA_ARCHS", raising=False)
    calls = build["commands"](tmp_path)
    (call,) = calls[tmp_path / "libgvtorch_cuda.so"]
    assert call[0] == str(nvcc) and flag in call
    codes = [part for part in call if part.startswith("-gencode")]
    archs = build["ARCHS"].split(";")
    assert len(codes) == len(archs) + 1 and codes[-1].endswith(f"code=compute_{archs[-1]}")
    monkeypatch.setenv("GVTORCH_CUDA_ARCHS", "80;90")
    (call,) = build["commands"](tmp_path)[tmp_path / "libgvtorch_cuda.so"]
    assert sum(part.startswith("-gencode") for part in call) == 3


def test_every_room_is_packed():
    names = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    rooms = {path.parent.relative_to(ROOT) for path in (ROOT / "gvtorch").rglob("__init__.py")}
    assert sorted(names) == sorted(".".join(room.parts) for room in rooms)
