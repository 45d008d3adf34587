"""Headers, compilers and environment variables that are nonsense: one line says what is wrong."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from helpers import ROOT
from helpers.compiled import HEADER

from gvtorch.cpp_ext import compilers, user

pytestmark = pytest.mark.backend("cpp")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path / "cache"))


@pytest.mark.parametrize(
    "header", [HEADER.read_text(), "x" * 300, "~nobody-of-this-name/a.h", "a\nb.h"], ids=len
)
def test_a_header_that_is_no_file_has_one_line(header):
    """Such as its text instead of its path."""
    with pytest.raises(ValueError, match="CompiledShader: there is no header") as caught:
        user.load_op(header, "mine::Plain")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("included", ["z" * 300, "a\0b", "loop.h"])
def test_an_include_that_is_no_file_is_left_to_the_compiler(tmp_path, included):
    (tmp_path / "loop.h").symlink_to(tmp_path / "loop.h")
    header = tmp_path / "mine.h"
    (tmp_path / "inner.h").write_text(f'#include "{included}"\n')
    header.write_text('#include "inner.h"\n' + HEADER.read_text())
    source = user.ShaderSource.read(header, "mine::Plain")
    assert {file.name for file in source.header_files} == {"mine.h", "inner.h"}


@pytest.mark.parametrize(
    "entries", [[1], [None], [[]], [True], ["x" * 5000], ["a\0b"], {"a": 1}, 7], ids=repr
)
def test_a_damaged_list_of_files_is_no_error(entries):
    source = user.ShaderSource.read(HEADER, "mine::Plain")
    source.list_path.write_text(json.dumps(entries))
    again = user.ShaderSource.read(HEADER, "mine::Plain")
    assert again.header_files == source.header_files and again.list_path == source.list_path


def test_a_compiler_s_name_may_be_blank_and_must_end_its_quotes(monkeypatch):
    monkeypatch.setenv("CXX", "  ")
    assert compilers.find_cxx() == ["g++"]
    monkeypatch.setenv("CXX", "g++ 'a")
    with pytest.raises(RuntimeError, match='CXX must be a command, got "g\\+\\+ \'a": No closing'):
        user.load_op(HEADER, "mine::Plain")


@pytest.mark.long
def test_an_unknown_instruction_set_is_told(monkeypatch):
    monkeypatch.setenv("GVTORCH_CPU", "avx3")
    code = "from gvtorch import cpp_ext; print(cpp_ext.instructions())"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert run.stdout == "baseline\n" and "GVTORCH_CPU='avx3' means baseline" in run.stderr
