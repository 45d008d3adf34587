"""What reading a header may take. The libraries that read files parse what they are told, for as
long and into as much memory as it says; a header that takes more than its file can be worth is
damaged.

A second thread watches the one that reads. It counts the processor time of that thread alone, so a
busy machine makes no difference. Memory is that of the whole process, other threads included: so it
is looked at only after a while, and the limit is far beyond what a file holds.
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
MOST_PACKED = 1032  # bytes that DEFLATE makes of one, at most
_PATIENCE = 0.5  # seconds of processor time before memory counts
_LOOK = 0.05  # seconds


class _TooMuch(BaseException):
    """Ends the reading thread's work; libraries swallow what is an `Exception`."""


def check_regular(path: str | Path) -> None:
    """Raises ValueError for a pipe, a device or a socket, which may never end."""
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise ValueError(f"{path}: is no regular file")


def check_beside(path: str, other: str) -> None:
    """Raises ValueError for a file that `path` names and that lies neither in its folder nor below,
    or is no regular file.
    """
    folder = os.path.realpath(os.path.dirname(path))
    place = os.path.join(folder, other)
    if os.path.commonpath([folder, os.path.realpath(place)]) != folder:
        raise ValueError(f"{path}: names {other}, which lies in another folder")
    if os.path.lexists(place):
        check_regular(place)


def check_files(source: object) -> None:
    """Raises ValueError if a source would read what is no regular file."""
    for file in (getattr(source, "file", None), *getattr(source, "files", ())):
        if isinstance(file, str) and os.path.exists(file):
            check_regular(file)


@contextmanager
def header_budget(path: str) -> Iterator[None]:
    """Raises ValueError if the block, which reads a header, takes more than its file allows."""
    try:
        size = os.stat(path).st_size if os.path.isfile(path) else 0
    except (OSError, ValueError):
        size = 0
    if not hasattr(time, "pthread_getcpuclockid"):
        yield
        return
    seconds = SECONDS + SECONDS_A_BYTE * size
    most = MEMORY + MEMORY_A_BYTE * size
    watch = _Watch(seconds, most)
    try:
        with watch:
            yield
    except _TooMuch:
        raise ValueError(
            f"{path}: damaged: its header takes more than {seconds:.0f} s of processor time or "
            f"{amount(most)}, which is too much for {size} bytes"
        ) from None


class _Watch:
    """Watches the thread that enters, and raises in it once a limit is passed."""

    def __init__(self, seconds: float, most: int) -> None:
        self._seconds, self._most = seconds, most
        self._reader = threading.get_ident()
        self._clock = time.pthread_getcpuclockid(self._reader)
        self._begin, self._memory = time.clock_gettime(self._clock), _resident()
        self._over, self._lock = threading.Event(), threading.Lock()
        self._sent = self._ended = False

    def __enter__(self) -> None:
        threading.Thread(target=self._look, daemon=True, name="gvtorch-budget").start()

    def __exit__(self, *_error: object) -> None:
        while not self._ended:
            with suppress(_TooMuch):  # one more, that came before the lock was held
                with self._lock:
                    self._ended = True  # no exception is sent from here on
        self._over.set()
        if self._sent:
            # One may be on its way still. It can't be withdrawn: Python 3.11 would then look for it
            # for ever, and hang under a profiler. So one more takes its place, and is met here.
            with suppress(_TooMuch):
                self._send()
                while True:
                    time.sleep(0)

    def _send(self) -> None:
        """Has `_TooMuch` raised in the thread that reads."""
        reader, error = ctypes.c_ulong(self._reader), ctypes.py_object(_TooMuch)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(reader, error)

    def _look(self) -> None:
        pause = _LOOK
        while not self._over.wait(pause):
            with self._lock:
                if self._ended:
                    return
                spent = time.clock_gettime(self._clock) - self._begin
                greedy = spent > _PATIENCE and _resident() - self._memory > self._most
                if spent > self._seconds or greedy:
                    self._sent = True
                    self._send()
                    pause *= 2  # it may be swallowed; or be met already, and on its way out


def _resident() -> int:
    """Bytes of memory that this process holds; 0 where it is not told."""
    if not sys.platform.startswith("linux"):
        return 0
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
