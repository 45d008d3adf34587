"""The machine's cores and memory, and starting worker processes."""

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


_PROC, _CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")
# Files of a control group: its limit, its use, and a prefix of names in memory.stat.
_GROUP_V1 = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_"
_GROUP_V2 = "memory.max", "memory.current", ""


def amount(nbytes: float) -> str:
    """Formats a number of bytes for messages: "3.2 kB", "3.2 MB", "1.50 GB"."""
    if nbytes >= 1e9:
        return f"{nbytes / 1e9:.2f} GB"
    return f"{nbytes / 1e6:.1f} MB" if nbytes >= 1e5 else f"{nbytes / 1e3:.1f} kB"


def cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_free() -> int:
    """Returns the memory available without swapping, bytes: the machine's, half of all if that is
    unknown, or what is left of a limit on a container or a batch job.
    """
    return min([_machine_memory_free(), *_limits_left()])


def _machine_memory_free() -> int:
    try:
        for line in (_PROC / "meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def _limits_left() -> Iterator[int]:
    """Yields what is left, bytes, of the limits on this process's control group and on those above
    it; files that the kernel may drop from memory do not count as used.
    Source: Linux kernel documentation, admin-guide, cgroup-v2 and cgroup-v1/memory.
    """
    try:
        lines = (_PROC / "self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        controllers, _, path = line.partition(":")[2].partition(":")
        if controllers and "memory" not in controllers.split(","):
            continue
        folder = _CGROUPS / "memory" if controllers else _CGROUPS
        names = path.strip("/").split("/")  # a container may see its own group in the place of all
        for group in [folder, *(folder.joinpath(*names[: n + 1]) for n in range(len(names)))]:
            yield from _limit_left(group, *(_GROUP_V1 if controllers else _GROUP_V2))


def _limit_left(group: Path, limit: str, usage: str, prefix: str) -> Iterator[int]:
    try:
        bytes_left = int((group / limit).read_text()) - int((group / usage).read_text())
        lines = map(str.split, (group / "memory.stat").read_text().splitlines())
        files = {f"{prefix}{kind}_file" for kind in ("active", "inactive")}
        yield max(0, bytes_left + sum(int(size) for name, size in lines if name in files))
    except (OSError, ValueError):  # there is no such group or no limit ("max")
        return


def check_memory(context: str, nbytes: int) -> None:
    """Raises ValueError if fewer than `nbytes` bytes of memory are available."""
    if nbytes > (free := memory_free()):
        raise ValueError(f"{context}: takes {amount(nbytes)} of memory, {amount(free)} are free")


@contextmanager
def worker_processes(count: int) -> Iterator[Executor]:
    """Starts worker processes, which ignore Ctrl-C from the start and leave it to this process."""
    spawn = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        with _defer_interrupts():  # Ctrl-C here would leave a half-made semaphore behind
            pool = stack.enter_context(ProcessPoolExecutor(count, spawn, begin_worker))
            # Blocked only now, because creating the pool unblocks the signal.
            previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
            try:
                for _ in range(count):  # each task starts a process, which inherits the mask
                    pool.submit(int)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
        yield pool


@contextmanager
def _defer_interrupts() -> Iterator[None]:
    """Defers Ctrl-C, which any thread may receive, to the end of the block."""
    if threading.current_thread() is not threading.main_thread():
        yield  # KeyboardInterrupt is raised in the main thread only
        return
    received: list[int] = []
    previous_handler = signal.signal(signal.SIGINT, lambda number, _frame: received.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous_handler)
    if received:
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
    """Runs a task for each item, at most `ahead` at a time; yields the results as they finish."""
    remaining, running = iter(items), set[Future[Result]]()
    try:
        while True:
            for item in itertools.islice(remaining, ahead - len(running)):
                running.add(pool.submit(task, item))
            if not running:
                return
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in sorted(finished, key=lambda future: future.exception() is not None):
                yield future.result()  # results before failures
    finally:
        for future in running:
            future.cancel()
