"""User-defined C++ shaders run in packets on the CPU: each bit equals that of rays one by one, for
all instruction sets.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from helpers import ROOT
from helpers.compiled import ADD, HEADER, only_included, users_shader, write_header
from helpers.packets import INSTRUCTIONS, LAMP, TRANSFER, cut_rays, result, scene, shaded, start
from helpers.rays import camera_rays
from helpers.traces import trace
from torch import Tensor

import gvtorch as gv
from gvtorch.cpp_ext import instructions, user

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


def shader(name: str, folder: Path | None = None) -> gv.CompiledShader:
    """Returns a shader that runs in packets; with a folder, from a header there, ray by ray."""
    struct, options = SHADERS[name]
    header = ROOT / "examples" / "ink.h" if struct == "Ink" else HEADER
    if folder is not None:
        alone = folder / header.name
        alone.write_text(f'#define GV_RAY_BY_RAY\n#include "{header}"\n')
        header = alone
    return users_shader(header, struct, **options)


def given(name: str, folder: Path | None = None) -> list[Tensor]:
    """Returns all that its traces write; N = 3 makes deep trees, and one brick no packets."""
    user_shader, results = shader(name, folder), []
    for branching in (2, 4, 3):
        results += shaded(user_shader, "cpp", branching)
    values = torch.rand((6, 6, 6), generator=torch.Generator().manual_seed(1))
    channels = {"value": values, "rgba": values, "normal": values[..., None].expand(6, 6, 6, 3)}
    tree = gv.N3Tree.from_volume({key: gv.Volume(some) for key, some in channels.items()}, 8)
    assert tree.bricks.capacity == 1
    hits, marks = trace(tree, "cpp", camera_rays(tree, 9), user_shader)
    return [*results, *hits.values(), *marks.values()]


OPTIMISED = ["ink"]  # compiled as users have it: 11 s


def all_given() -> dict[str, list[Tensor]]:
    """Returns that of the shaders named in the environment; only some are compiled optimised."""
    results = {}
    for name in os.environ["SHADERS"].split(";"):
        with pytest.MonkeyPatch.context() as patch:
            if name not in os.environ["OPTIMISED"].split(";"):
                patch.setenv("CXX", os.environ["QUICK"])
            results[name] = given(name)
    return results


@pytest.mark.long
@pytest.mark.backend("cpp")
@pytest.mark.parametrize("set_", INSTRUCTIONS)
def test_every_bit_is_that_of_rays_one_by_one(tmp_path, monkeypatch, quick, set_):
    same_set = set_ == instructions()
    names, optimised = (list(SHADERS), OPTIMISED) if same_set else (OPTIMISED, [])
    environment = {"SHADERS": ";".join(names), "OPTIMISED": ";".join(optimised), "QUICK": quick}
    run = start(all_given, tmp_path, set_, **environment)
    monkeypatch.setenv("CXX", quick)
    expected = {name: given(name, tmp_path) for name in names if name != "told"}
    if same_set:
        expected["told"] = expected["plain"]  # it tells packets more, and draws the same
    actual = result(run)
    for name, tensors in expected.items():
        for a, b in zip(actual[name], tensors, strict=True):
            assert torch.equal(a.nan_to_num(7), b.nan_to_num(7)), name
        assert sum(len(a.unique()) for a in tensors) > 1000, "the test must see something"


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_packets_go_in_float32_and_rays_in_float64(tmp_path, monkeypatch, quick):
    """The usual library contains the packet code, that of this file's ray-by-ray header does not;
    float64 is the same in both.
    """
    user_shader = shader("ink")
    assert b"PacketWalk" in user_shader.libraries[0].read_bytes()
    monkeypatch.setenv("CXX", quick)
    alone = shader("ink", tmp_path)
    assert b"PacketWalk" not in alone.libraries[0].read_bytes()
    tree = scene()
    rays = cut_rays(camera_rays(tree, 11, distance=1.5))
    a, b = (trace(tree, "cpp", rays, each, dtype=torch.float64)[0] for each in (user_shader, alone))
    assert all(torch.equal(a[key].nan_to_num(7), b[key].nan_to_num(7)) for key in b)
    assert a["color"].unique().numel() > 20


@pytest.mark.backend("cpp")
def test_a_folder_serves_several_instruction_sets(tmp_path, monkeypatch):
    """Each has its own library, of one op."""
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path))
    monkeypatch.setenv("CXX", only_included(tmp_path))
    header = write_header(tmp_path, ADD)
    source = user.ShaderSource.read(header, "Own")
    files = []
    for name in ("baseline", "avx512", "baseline"):
        monkeypatch.setattr(user, "instructions", lambda name=name: name)
        files.append(user.compiled(source, ()))
    left = {file for file in (tmp_path / "shaders").iterdir() if file.suffix != ".more"}
    assert files[0] == files[2] != files[1] and {*files} == left
    op = user.ShaderSource.read(header, "Own").op  # of all headers that the compiler named
    assert all(library.name.startswith(f"{op}_cpu_") for library in files)
    assert files[0].read_bytes() != files[1].read_bytes()
