"""A user's C++ goes in packets on the CPU: each bit is that of its rays one by one, for all
instruction sets.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import torch
from conftest import ROOT
from test_compiled_shader import HEADER
from test_packets import INSTRUCTIONS, LAMP, TRANSFER, cut, scene, shaded
from test_trace_rays import camera_rays, run
from torch import Tensor

import gvtorch as gv
from gvtorch.cpp_ext import compilers, instructions

INK = dict(steep=0.05, sharpness=2.0, wash=0.1, near=20.0, far=80.0, paper=0.9)
SHADERS = {
    "plain": ("mine::Plain", {"transfer": TRANSFER}),
    "white": ("mine::Plain", {}),
    "lit": ("mine::LitFeatures", {"transfer": TRANSFER, "other": "rgba"}),
    "stored normals and a lamp": (
        "mine::LitFeatures",
        {"transfer": TRANSFER, "other": "rgba", "normals": "normal", "light": LAMP},
    ),
    "own hiding": ("mine::Above", {"transfer": TRANSFER, "uniforms": {"level": 0.1}}),
    "told": ("mine::PlainAlike", {"transfer": TRANSFER}),
    "own sum": ("mine::Highest", {"transfer": TRANSFER}),
    "ends and surface": (
        "mine::Contours",
        {"uniforms": {"level": 0.3, "gap": 0.06, "least": 0.2}},
    ),
    "ink": ("Ink", {"transfer": TRANSFER, "uniforms": INK}),
}
_SHADED = """
import sys, torch
sys.path.insert(0, {tests!r})
from test_user_packets import SHADERS, given
torch.save({{name: given(name) for name in SHADERS}}, {file!r})
"""


def shader(name: str, folder: Path | None = None) -> gv.CompiledShader:
    """In packets; with a folder, a header in it has the rays go one by one."""
    struct, options = SHADERS[name]
    header = ROOT / "examples" / "ink.h" if struct == "Ink" else HEADER
    if folder is not None:
        alone = folder / header.name
        alone.write_text(f'#define GV_RAY_BY_RAY\n#include "{header}"\n')
        header = alone
    return gv.CompiledShader(header, struct, **options)


def given(name: str, folder: Path | None = None) -> list[Tensor]:
    """All that its traces write; where N is 3, and with one brick, no packet goes."""
    own, found = shader(name, folder), []
    for branching in (2, 4, 3):
        found += shaded(own, "cpp", branching)
    values = torch.rand((6, 6, 6), generator=torch.Generator().manual_seed(1))
    channels = {"value": values, "rgba": values, "normal": values[..., None].expand(6, 6, 6, 3)}
    tree = gv.N3Tree.from_volume({key: gv.Volume(some) for key, some in channels.items()}, 8)
    assert tree.bricks.capacity == 1
    hits, marks = run(tree, "cpp", camera_rays(tree, 9), own)
    return [*found, *hits.values(), *marks.values()]


def quick(folder: Path, level: int) -> str:
    """A compiler that optimises less."""
    real, file = shutil.which(compilers.find_cxx()[0]), folder / f"c++{level}"
    file.write_text(f'#!/bin/sh\nexec {real} "$@" -O{level}\n')
    file.chmod(0o755)
    return str(file)


@pytest.fixture(scope="module")
def of_instructions(tmp_path_factory) -> dict[str, dict[str, list[Tensor]]]:
    """What each instruction set gives, by its name and the shader's; this process's own, as users
    have it.
    """
    folder, runs, found = tmp_path_factory.mktemp("packets"), {}, {}
    for name in INSTRUCTIONS:
        file = str(folder / f"{name}.pt")
        program = _SHADED.format(tests=os.path.dirname(__file__), file=file)
        environment = {**os.environ, "GVTORCH_CPU": name}
        if name != instructions():
            environment["CXX"] = quick(folder, 1)
        runs[file] = name, subprocess.Popen([sys.executable, "-c", program], env=environment)
    for file, (name, process) in runs.items():
        assert process.wait(timeout=600) == 0
        found[name] = torch.load(file, weights_only=True)
    return found


@pytest.fixture(scope="module")
def one_by_one(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")

    @cache
    def expected(name: str) -> list[Tensor]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("CXX", quick(folder, 0))
            return given(name, folder)

    return expected


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", SHADERS)
@pytest.mark.parametrize("set_", INSTRUCTIONS)
def test_every_bit_is_that_of_rays_one_by_one(of_instructions, one_by_one, set_, name):
    found = of_instructions[set_][name]
    for one, other in zip(found, one_by_one(name), strict=True):
        assert torch.equal(one.nan_to_num(7), other.nan_to_num(7))
    assert sum(len(one.unique()) for one in found) > 1000, "the test must see something"


@pytest.mark.backend("cpp")
def test_packets_go_in_float32_and_rays_in_float64(tmp_path, monkeypatch):
    """The library that users have holds the packet, the one of this file's other header does not;
    float64 is the same in both.
    """
    own = shader("ends and surface")
    assert b"UserPacket" in own.libraries[0].read_bytes()
    monkeypatch.setenv("CXX", quick(tmp_path, 0))
    alone = shader("ends and surface", tmp_path)
    assert b"UserPacket" not in alone.libraries[0].read_bytes()
    tree = scene()
    rays = cut(camera_rays(tree, 11, distance=1.5))
    one, other = (run(tree, "cpp", rays, each, dtype=torch.float64)[0] for each in (own, alone))
    assert all(torch.equal(one[key].nan_to_num(7), other[key].nan_to_num(7)) for key in other)
    assert one["color"].unique().numel() > 20


@pytest.mark.backend("cpp")
def test_a_folder_serves_several_instruction_sets(tmp_path, monkeypatch):
    """Each has a library of its own, of one op."""
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path))
    monkeypatch.setenv("CXX", quick(tmp_path, 0))
    program = f"import gvtorch as gv; gv.CompiledShader({str(HEADER)!r}, 'mine::Plain')"
    for name in ("baseline", instructions(), "baseline"):
        environment = {**os.environ, "GVTORCH_CPU": name}
        subprocess.run([sys.executable, "-c", program], env=environment, check=True)
    names = [file.name for file in (tmp_path / "shaders").iterdir()]
    assert len(names) == len({"baseline", instructions()})
    assert len({name.rpartition("_cpu_")[0] for name in names}) == 1
