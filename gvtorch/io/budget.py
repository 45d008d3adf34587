"""Limits on the time and memory that reading a header may take. The libraries that read files trust
the sizes in a header, however large; a header that takes far more than the size of its file
justifies is treated as damaged.

A second thread watches the one that reads. It counts the processor time of that thread alone, so a
busy machine makes no difference. Memory is that of the whole process, other threads included: so it
is checked only after a while, and the limit is far beyond what a file holds.
"""

from __future__ import annotations

import ctypes
import os
import stat
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .resources import amount

SECONDS = 5.0  # of processor time for any header
SECONDS_A_BYTE = 5e-7  # and for each byte of its file
MEMORY = 512 * 10**6  # bytes of memory for any header
MEMORY_A_BYTE = 40  # and for each byte of its file
MAX_UNPACK_RATIO = 1032  # largest ratio of unpacked to packed bytes in DEFLATE
_MEMORY_GRACE_SECONDS = 0.5  # seconds of processor time before memory counts
_CHECK_SECONDS = 0.05  # seconds between two checks


class _OverBudget(BaseException):
    """Ends the reading thread's work; not an `Exception`, because libraries may swallow those."""


def check_regular(path: str | Path) -> None:
    """Raises ValueError for a pipe, a device or a socket, which may never end."""
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise ValueError(f"{path}: is not a regular file")


def check_beside(path: str, referenced: str) -> None:
    """Raises ValueError if `referenced`, a file that the content of `path` refers to, lies outside
    the folder of `path` and the folders below it, or is no regular file.
    """
    folder = os.path.realpath(os.path.dirname(path))
    referenced_path = os.path.join(folder, referenced)
    if os.path.commonpath([folder, os.path.realpath(referenced_path)]) != folder:
        raise ValueError(f"{path}: names {referenced}, which is in another folder")
    if os.path.lexists(referenced_path):
        check_regular(referenced_path)


def check_files(source: object) -> None:
    """Raises ValueError if a file that a source reads is no regular file."""
    for file in (getattr(source, "file", None), *getattr(source, "files", ())):
        if isinstance(file, str) and os.path.exists(file):
            check_regular(file)


@contextmanager
def header_budget(path: str) -> Iterator[None]:
    """Raises ValueError if the `with` block, which reads a header, exceeds the file's limits."""
    size = os.path.getsize(path) if os.path.isfile(path) else 0
    if not hasattr(time, "pthread_getcpuclockid"):
        yield
        return
    seconds = SECONDS + SECONDS_A_BYTE * size
    max_bytes = MEMORY + MEMORY_A_BYTE * size
    try:
        with _Watch(seconds, max_bytes):
            yield
    except _OverBudget:
        raise ValueError(
            f"{path}: damaged: its header takes more than {seconds:.0f} s of processor time or "
            f"{amount(max_bytes)}, which is too much for {size} bytes"
        ) from None


class _Watch:
    """Watches the thread that enters, and raises `_OverBudget` in it once a limit is exceeded."""

    def __init__(self, seconds: float, max_bytes: int) -> None:
        self._seconds, self._max_bytes = seconds, max_bytes
        self._reader = threading.get_ident()
        self._clock = time.pthread_getcpuclockid(self._reader)
        self._start_seconds, self._start_memory = time.clock_gettime(self._clock), _resident_bytes()
        self._finished, self._lock = threading.Event(), threading.Lock()
        self._error_sent = self._has_ended = False

    def __enter__(self) -> None:
        threading.Thread(target=self._watch, daemon=True, name="gvtorch-budget").start()

    def __exit__(self, *_error: object) -> None:
        while not self._has_ended:
            with suppress(_OverBudget):  # one may still arrive until the lock is held
                with self._lock:
                    self._has_ended = True  # no exception is sent from here on
        self._finished.set()
        if self._error_sent:
            # An exception may still be pending. It can't be withdrawn: Python 3.11 would then check
            # for it for ever, and hang under a profiler. So another replaces it and is caught here.
            with suppress(_OverBudget):
                self._raise_in_reader()
                while True:
                    time.sleep(0)

    def _raise_in_reader(self) -> None:
        """Makes Python raise `_OverBudget` in the thread that reads."""
        reader, error = ctypes.c_ulong(self._reader), ctypes.py_object(_OverBudget)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(reader, error)

    def _watch(self) -> None:
        pause = _CHECK_SECONDS
        while not self._finished.wait(pause):
            with self._lock:
                if self._has_ended:
                    return
                used_seconds = time.clock_gettime(self._clock) - self._start_seconds
                used_bytes = 0
                if used_seconds > _MEMORY_GRACE_SECONDS:
                    used_bytes = _resident_bytes() - self._start_memory
                if used_seconds > self._seconds or used_bytes > self._max_bytes:
                    self._error_sent = True
                    self._raise_in_reader()
                    pause *= 2  # a library may have swallowed it, or it is still propagating


def _resident_bytes() -> int:
    """Returns the resident memory of this process, bytes; 0 on systems other than Linux."""
    if not sys.platform.startswith("linux"):
        return 0
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
