"""Names for the steps of a frame: `with stage("trace"):` feeds timer, profiler, an open `Trace`
(base/trace.py), and under NVIDIA's tools the NVTX ranges that these show.

Times are differences of marks. On CUDA a mark is an event in the stream: taking one does not make
the host wait, reading the time between two does.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch

#: Told (what, done, total) by work that can take long, as a progress bar needs it.
Progress = Callable[[str, int, int], None]
Mark = float | torch.cuda.Event


def no_progress(what: str, done: int, total: int) -> None:
    """Shows nothing."""


def mark(device: torch.device) -> Mark:
    """Notes the time: the host's, or on CUDA the moment at which the device comes to this place."""
    if device.type != "cuda":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record(torch.cuda.current_stream(device))
    return event


def milliseconds(start: Mark, end: Mark) -> float:
    """Returns the time between two marks of one device; waits until it has come to the second."""
    if isinstance(start, float) or isinstance(end, float):
        return 1e3 * (end - start)  # type: ignore[operator]
    end.synchronize()
    return start.elapsed_time(end)


@dataclass
class Timings:
    """Times of stages on one device."""

    device: torch.device
    spans: list[tuple[str, Mark, Mark]] = field(default_factory=list)

    def as_dict(self) -> dict[str, float]:
        """Returns milliseconds by stage; waits until the device has come to the last one's end."""
        total: dict[str, float] = {}
        for name, start, end in self.spans:
            total[name] = total.get(name, 0.0) + milliseconds(start, end)
        return total


class Recorder(Protocol):
    """What is told of all stages of all threads."""

    def begin(self) -> Any:
        """Notes that one begins; what it returns comes back at the end."""

    def end(self, name: str, began: Any) -> None:
        """Notes that it ends."""


_timings: ContextVar[Timings | None] = ContextVar("gvtorch_timings", default=None)
_recorders: list[Recorder] = []
#: Nsight Systems and Compute name their library in the first; the second asks for ranges by hand.
_RANGES = torch.version.cuda is not None and bool(
    {"NVTX_INJECTION64_PATH", "GVTORCH_NVTX"} & set(os.environ)
)


class stage:  # no generator, which takes longer: a frame has several
    """Names the step that the block does, for the open `collect_timings()`, torch's profiler and
    whoever else listens; costs next to nothing where nobody does.
    """

    __slots__ = ("_began", "_name", "_ranges", "_start", "_timings")

    def __init__(self, name: str) -> None:
        """Takes the step's name."""
        self._name = name

    def __enter__(self) -> None:
        self._ranges = None
        if _RANGES or torch.autograd._profiler_enabled():
            self._ranges = _open_ranges(f"gvtorch.{self._name}")
        self._began = [(one, one.begin()) for one in _recorders]
        self._timings = timings = _timings.get()
        self._start = None if timings is None else mark(timings.device)

    def __exit__(self, *error: object) -> None:
        timings, start = self._timings, self._start
        if timings is not None and start is not None:
            timings.spans.append((self._name, start, mark(timings.device)))
        for one, what in self._began:
            one.end(self._name, what)
        if self._ranges is not None:
            self._ranges.close()


def _open_ranges(name: str) -> ExitStack:
    """Opens a range of torch's profiler and of NVIDIA's tools, where they listen."""
    with ExitStack() as ranges:
        if torch.autograd._profiler_enabled():
            ranges.enter_context(torch.profiler.record_function(name))
        if _RANGES:
            ranges.enter_context(torch.cuda.nvtx.range(name))
        return ranges.pop_all()


@contextmanager
def record_stages(recorder: Recorder) -> Iterator[None]:
    """Tells a recorder of all stages, of all threads, while the block runs."""
    _recorders.append(recorder)
    try:
        yield
    finally:
        _recorders.remove(recorder)


@contextmanager
def collect_timings(device: torch.device) -> Iterator[Timings]:
    """Yields the times of the stages that the block runs."""
    timings = Timings(device)
    token = _timings.set(timings)
    try:
        yield timings
    finally:
        _timings.reset(token)
