"""Users' shaders compiled by nvcc, which needs no GPU for that: what is cached, what counts as
changed, and that no user-given name gets to the shell to which nvcc passes its arguments.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from helpers.compiled import ADD, write_header

from gvtorch.cpp_ext import compilers, user

pytestmark = pytest.mark.skipif(compilers.find_nvcc() is None, reason="nvcc is not here")
ARCHS = ("90",)


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """A separate cache, and an nvcc that does not optimise. If there is a file `scan`, it removes
    that and only lists what is included, beside an empty library.
    """
    nvcc = tmp_path / "nvcc"
    change = 'case "$a" in -MD) a=-M;; shader.so) a=shader.d;; esac'
    scan = f'touch shader.so; for a; do shift; {change}; set -- "$@" "$a"; done'
    nvcc.write_text(
        f'#!/bin/sh\nif rm "{tmp_path}/scan" 2>&-; then {scan}; fi\n'
        f'exec {compilers.find_nvcc()} "$@" -O0 -Xptxas=-O0\n'
    )
    nvcc.chmod(0o755)
    monkeypatch.setenv("NVCC", str(nvcc))
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "shaders"


@pytest.mark.long
def test_what_only_cuda_includes_counts_and_no_name_comes_to_a_shell(tmp_path, cache, monkeypatch):
    """A file that is included by a macro, and only in CUDA code."""
    folder = tmp_path / "a b;touch $(touch beside)`touch beside`"
    folder.mkdir()
    header = write_header(folder, ADD.replace("COLOR", "kColor"), "own $(touch here);'\".h")
    part = folder / "part.h"
    part.write_text("constexpr float kColor = 0.5f;\n")
    branches = '#ifdef __CUDACC__\n#define PART "part.h"\n#include PART\n#else\n'
    header.write_text(f"{branches}constexpr float kColor = 0.25f;\n#endif\n" + header.read_text())
    monkeypatch.chdir(tmp_path)
    before = user.ShaderSource.read(header, "Own")
    (tmp_path / "scan").touch()  # the first library goes, because it lists a file not known before
    library = user.compiled(before, ARCHS)
    assert not (tmp_path / "scan").exists()
    after = user.ShaderSource.read(header, "Own")
    assert library.parent == cache and b"Own_" in library.read_bytes()
    assert json.loads(after.list_path.read_text()) == [str(part)]
    assert after.digest != before.digest and after.op in library.name
    assert sorted(os.listdir(cache)) == sorted([library.name, after.list_path.name])
    assert user.compiled(after, ARCHS) == library, "it is kept"
    part.write_text("constexpr float kColor = 0.75f;\n")
    assert user.ShaderSource.read(header, "Own").digest not in (before.digest, after.digest)
    assert not [file for file in tmp_path.rglob("*") if file.name in ("beside", "here")]


@pytest.mark.long
def test_what_nvcc_says_names_the_file(tmp_path, cache):
    header = write_header(tmp_path, "  int broken = nothing;")
    with pytest.raises(user.CompileError, match="did not compile for CUDA") as caught:
        user.compiled(user.ShaderSource.read(header, "Own"), ARCHS)
    assert f"{header}" in str(caught.value) and "nothing" in str(caught.value)
    assert os.listdir(cache) == []
