"""What the machine has, cores and memory, and how a worker process begins."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def amount(nbytes: float) -> str:
    """Bytes for people: "3.2 MB", "1.50 GB"."""
    return f"{nbytes / 1e9:.2f} GB" if nbytes >= 1e9 else f"{nbytes / 1e6:.1f} MB"


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_free() -> int:
    """Bytes of memory that can be had without swapping; half of all where it is not told."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


@contextmanager
def worker_processes(count: int) -> Iterator[Executor]:
    """Starts worker processes, which leave Ctrl-C to this one from their first moment on."""
    spawn = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        with _interrupts_later():  # a semaphore that is half made would be left behind
            pool = stack.enter_context(ProcessPoolExecutor(count, spawn, begin_worker))
            before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # making it unblocks
            try:
                for _ in range(count):  # each task starts a process, which inherits what is blocked
                    pool.submit(int)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        yield pool


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Starts processes in one piece: Ctrl-C, which any thread may receive, comes behind."""
    if threading.current_thread() is not threading.main_thread():
        yield  # never interrupted
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        raise KeyboardInterrupt


def begin_worker() -> None:
    """Sets up a worker process, which leaves Ctrl-C to its parent and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def run_ahead(
    pool: Executor, task: Callable[[Item], Result], items: Iterable[Item], ahead: int
) -> Generator[Result, None, None]:
    """Runs a task for each item, a bounded number at a time, and yields what they return, as they
    end.
    """
    waiting, running = iter(items), set[Future[Result]]()
    try:
        while True:
            for item in itertools.islice(waiting, ahead - len(running)):
                running.add(pool.submit(task, item))
            if not running:
                return
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in sorted(finished, key=lambda future: future.exception() is not None):
                yield future.result()  # first what is done, then what failed
    finally:
        for future in running:
            future.cancel()
