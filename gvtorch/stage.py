"""Names for the steps of a frame: `with stage("trace"):` feeds timer and profiler."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

#: Told (what, done, total) by work that can be long; the command line draws its progress bar from
#: it.
Progress = Callable[[str, int, int], None]

_timings: ContextVar[dict[str, float] | None] = ContextVar("gvtorch_timings", default=None)


def no_progress(what: str, done: int, total: int) -> None:
    """Listens to nothing."""


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Names a step: adds its milliseconds to the open `collect_timings()` and shows it to torch's
    profiler. It does nothing where neither listens.
    """
    timings = _timings.get()
    if timings is None and not torch.autograd._profiler_enabled():
        yield
        return
    with torch.profiler.record_function(f"gvtorch.{name}"):
        if timings is None:
            yield
            return
        start = time.perf_counter()
        try:
            yield
        finally:
            if torch.cuda.is_initialized():
                torch.cuda.synchronize()
            elapsed = 1e3 * (time.perf_counter() - start)
            timings[name] = timings.get(name, 0.0) + elapsed


@contextmanager
def collect_timings() -> Iterator[dict[str, float]]:
    """Yields a dict that fills with milliseconds by stage while the block runs."""
    timings: dict[str, float] = {}
    token = _timings.set(timings)
    try:
        yield timings
    finally:
        _timings.reset(token)
