"""Every example runs and writes its picture."""

from __future__ import annotations

import subprocess
import sys

import pytest
from conftest import ROOT

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_writes_a_picture(example, tmp_path):
    out = tmp_path / "picture.png"
    command = [sys.executable, str(example), "--size", "48", "--output", str(out)]
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert out.read_bytes().startswith(b"\x89PNG") and str(out) in run.stdout
    assert 20 <= len(example.read_text().splitlines()) <= 120


def test_a_producer_of_ones_own_takes_at_most_40_lines():
    assert len((ROOT / "examples" / "hello_sphere.py").read_text().splitlines()) <= 40


def test_there_are_examples():
    assert EXAMPLES
