"""The time limit for reading a header: it ends the work of its own thread, and nothing else."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import pytest

from gvtorch.io import budget


class _Slow:
    """A lock that its reader gets only after 0.4 s, so that the watching thread comes first."""

    def __init__(self, lock: threading.Lock) -> None:
        self._lock, self._reader = lock, threading.get_ident()

    def __enter__(self) -> None:
        if threading.get_ident() == self._reader:
            end = time.monotonic() + 0.4  # the watcher's exception is raised here
            while time.monotonic() < end:
                pass
        self._lock.acquire()

    def __exit__(self, *_error: object) -> None:
        self._lock.release()


def test_nothing_is_raised_behind_a_budget(tmp_path, monkeypatch):
    """Also if a second exception arrives while the first one propagates."""
    monkeypatch.setattr(budget, "SECONDS", 0.1)
    (tmp_path / "a.npy").write_bytes(b"")
    original = budget._Watch.__init__

    def slow(self, *args) -> None:
        original(self, *args)
        self._lock = _Slow(self._lock)

    monkeypatch.setattr(budget._Watch, "__init__", slow)
    with pytest.raises(ValueError, match="takes more than"):
        with budget.header_budget(str(tmp_path / "a.npy")):
            while True:
                pass
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        pass
    assert not [thread for thread in threading.enumerate() if thread.name == "gvtorch-budget"]


def test_a_budget_ends_the_work_of_its_thread_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "SECONDS", 0.2)
    (tmp_path / "a.npy").touch()
    ended = threading.Event()

    def other() -> None:
        while not ended.wait(0.01):
            pass

    thread = threading.Thread(target=other)
    thread.start()
    with pytest.raises(ValueError, match=r"a\.npy: damaged: its header takes more than 0 s"):
        with budget.header_budget(str(tmp_path / "a.npy")):
            while True:
                try:
                    sum(range(1000))
                except Exception:  # as some libraries do
                    pass
    assert thread.is_alive()
    ended.set()
    thread.join()
    with budget.header_budget(str(tmp_path / "a.npy")):
        time.sleep(0.5)  # waiting takes no processor time
    begin = time.process_time()
    while time.process_time() - begin < 0.5:
        sum(range(1000))


PROFILED = """
import cProfile, sys
from gvtorch.io import budget

budget.SECONDS = 0.2
with cProfile.Profile():
    for refused in (False, True, False):
        try:
            with budget.header_budget(sys.argv[0]):
                while refused:
                    sum(range(1000))
            print("read")
        except ValueError:
            print("refused")
"""


def test_a_budget_ends_under_a_profiler():
    run = subprocess.run(
        [sys.executable, "-c", PROFILED], capture_output=True, text=True, timeout=60, check=False
    )
    assert run.stdout.split() == ["read", "refused", "read"], run.stderr[-2000:]
