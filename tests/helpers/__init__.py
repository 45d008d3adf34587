"""What several test files share. Test files import from here, never from one another."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TESTS = ROOT / "tests"
DATA = ROOT / "examples" / "data"
SHARED = ROOT.parent / "shared" / "data"
#: By backend.
DEVICES = {"reference": "cpu", "cpp": "cpu", "cuda": "cuda"}
#: How the reason of a skip begins that the summary tells of.
ABSENT = "shared test data is not here: "


def shared(path: str) -> Path:
    """A file of the shared test data, or a skip that the summary tells of."""
    file = SHARED / path
    if not file.exists():
        pytest.skip(ABSENT + path)
    return file


def gvtorch(*args: object, cwd=None) -> subprocess.CompletedProcess[str]:
    """Runs the command line in a process of its own."""
    command = [sys.executable, "-m", "gvtorch", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)
