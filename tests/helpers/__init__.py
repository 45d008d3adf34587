"""Code that several test files share. Test files import from here, never from one another."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import subprocess
import time
import warnings
from pathlib import Path
from typing import Any

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


class Library:
    """A library that test files name at their top. It is imported when it is first used: each of
    the processes that run tests imports every file, but not many of them use all libraries.
    """

    def __init__(self, name: str) -> None:
        """Skips the test file if the library is not installed."""
        self._name = name
        if importlib.util.find_spec(name.partition(".")[0]) is None:
            pytest.skip(f"{name} is not installed", allow_module_level=True)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # pytest asks every object of a test file
            raise AttributeError(name)
        return getattr(importlib.import_module(self._name), name)


def resident_bytes() -> int:
    """Returns the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def slowness() -> float:
    """Returns how many times longer than usual this machine takes at the moment, from 1 to 10."""
    start = time.perf_counter()
    sum(range(200_000))
    return min(max((time.perf_counter() - start) / 0.004, 1.0), 10.0)


def gvtorch(*args: object, cwd: str | Path = ".") -> subprocess.CompletedProcess[str]:
    """Runs the command line within this process (another would import torch for each call), with
    the default warnings of a new process.
    """
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    status = 0
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        contextlib.chdir(cwd),
        warnings.catch_warnings(),
    ):
        warnings.resetwarnings()
        for category in (DeprecationWarning, PendingDeprecationWarning, ResourceWarning):
            warnings.simplefilter("ignore", category)
        try:
            main([str(arg) for arg in args])
        except SystemExit as stop:
            status = int(stop.code or 0)
    for stream in (out, err):
        stream.seek(0)
    return subprocess.CompletedProcess(args, status, out.read(), err.read())


def run_cli(capsys, *args: object) -> tuple[int, str, str]:
    """Runs the command line within this process, with the tests' warning filters, which raise
    errors; returns exit status, output and errors.
    """
    try:
        main([str(arg) for arg in args])
        code = 0
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capsys.readouterr()
    return code, out, err
