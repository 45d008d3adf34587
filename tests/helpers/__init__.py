"""Code that several test files share. Test files import from here, never from one another."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import warnings
from pathlib import Path

import pytest

from gvtorch.tools.cli import main

ROOT = Path(__file__).parents[2]
TESTS = ROOT / "tests"
DATA = ROOT / "examples" / "data"
SHARED = ROOT.parent / "shared" / "data"
#: Device of each backend.
DEVICES = {"reference": "cpu", "cpp": "cpu", "cuda": "cuda"}
#: A skip whose reason begins like this is listed in the summary.
ABSENT = "shared test data is not here: "


def shared(path: str) -> Path:
    """Returns a file of the shared test data, or skips the test, which the summary reports."""
    file = SHARED / path
    if not file.exists():
        pytest.skip(ABSENT + path)
    return file


def resident_bytes() -> int:
    """Returns the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def gvtorch(*args: object, cwd: str | Path = ".") -> subprocess.CompletedProcess[str]:
    """Runs the command line within this process (another would import torch for each call), with
    the default warnings of a new process.
    """
    out, error = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    status = 0
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(error),
        contextlib.chdir(cwd),
        warnings.catch_warnings(),
    ):
        warnings.resetwarnings()
        for unseen in (DeprecationWarning, PendingDeprecationWarning, ResourceWarning):
            warnings.simplefilter("ignore", unseen)
        try:
            main([str(arg) for arg in args])
        except SystemExit as end:
            status = int(end.code or 0)
    for stream in (out, error):
        stream.seek(0)
    return subprocess.CompletedProcess(args, status, out.read(), error.read())


def run(capsys, *args: object) -> tuple[int, str, str]:
    """Runs the command line within this process, with the tests' warning filters, which raise
    errors; returns exit status, output and errors.
    """
    try:
        main([str(arg) for arg in args])
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    out, err = capsys.readouterr()
    return code, out, err
