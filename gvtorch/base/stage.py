"""Names for the steps of a frame: `with stage("trace"):` feeds timer, profiler, an open `Trace`,
and under NVIDIA's tools the NVTX ranges that these show. `Trace`: when which stage ran, of all
threads and of the device, as a file for Perfetto (ui.perfetto.dev) or chrome://tracing.

Times are differences of marks. On CUDA a mark is an event in the stream: taking one does not make
the host wait, reading the time between two does.

Source: "Trace Event Format" (the Chromium project).
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import torch

from . import check
from .whole_file import whole_file

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


_timings: ContextVar[Timings | None] = ContextVar("gvtorch_timings", default=None)
_traces: list[Trace] = []  # that are open, of all threads
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
        self._began = [(one, one.begin()) for one in _traces]
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
def collect_timings(device: torch.device) -> Iterator[Timings]:
    """Yields the times of the stages that the block runs."""
    timings = Timings(device)
    token = _timings.set(timings)
    try:
        yield timings
    finally:
        _timings.reset(token)


_ON_DEVICE = 0  # the track of the device; threads have theirs from 1 on


class _Span(NamedTuple):
    name: str
    track: int
    begin: int  # nanoseconds of the host's clock
    end: int
    marks: tuple[torch.cuda.Event, torch.cuda.Event] | None  # when the device did it


class Trace:
    """Writes down the stages, of all threads, that run while it is open:

    with gv.Trace("frames.json"):
        engine.render(camera, shader)

    The names are those of `FrameStats.stages`. On CUDA a stage is there twice: when the host
    ordered it, and when the device did it.
    """

    def __init__(self, path: str | Path, device: torch.device | str = "cpu") -> None:
        """Takes the file, which is written at the end, also after a mistake.

        Args:
            path: Ends in .json.
            device: Whose time is told beside the host's, if it is CUDA: of its current stream.

        Raises:
            ValueError: The ending is another, or there is no such device.
            FileNotFoundError: The folder does not exist.
        """
        self._path, self._device = Path(path), check.device("Trace", device)
        if self._path.suffix != ".json":
            raise ValueError(f"Trace: path must end in .json, got {str(path)!r}")
        if not self._path.parent.is_dir():
            raise FileNotFoundError(f"Trace: folder not found: {self._path.parent}")
        self._spans: list[_Span] = []
        self._counts: list[tuple[str, int, dict[str, float]]] = []
        self._tracks: dict[int, tuple[int, str]] = {}  # of threads
        self._lock = threading.Lock()

    def __enter__(self) -> Trace:
        """Begins to listen."""
        self._zero = time.perf_counter_ns()
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
            self._zero, self._first = time.perf_counter_ns(), self._event()
        _traces.append(self)
        return self

    def __exit__(self, *_error: object) -> None:
        """Writes the file."""
        _traces.remove(self)
        with whole_file(self._path) as part, part.open("w", encoding="utf-8") as file:
            json.dump({"traceEvents": self._events(), "displayTimeUnit": "ms"}, file)

    def count(self, name: str, **values: float) -> None:
        """Notes numbers of now, which are drawn as curves over time."""
        self._counts.append((name, time.perf_counter_ns(), values))

    def begin(self) -> tuple[int, torch.cuda.Event | None]:
        """Notes that a stage begins; what it returns comes back at the end."""
        return time.perf_counter_ns(), self._event()

    def end(self, name: str, began: tuple[int, torch.cuda.Event | None]) -> None:
        """Notes that a stage ends."""
        (begin, first), last, end = began, self._event(), time.perf_counter_ns()
        marks = None if first is None or last is None else (first, last)
        self._spans.append(_Span(name, self._track(), begin, end, marks))

    def _event(self) -> torch.cuda.Event | None:
        """A mark in the device's stream; none in what is being captured."""
        if self._device.type != "cuda" or torch.cuda.is_current_stream_capturing():
            return None
        event = mark(self._device)
        assert isinstance(event, torch.cuda.Event)
        return event

    def _track(self) -> int:
        thread = threading.current_thread()
        with self._lock:
            known = self._tracks.setdefault(
                threading.get_ident(), (len(self._tracks) + 1, thread.name)
            )
        return known[0]

    def _events(self) -> list[dict[str, object]]:
        """All that is in the file; waits for the device."""
        common = {"pid": os.getpid()}
        names = [(number, f"host: {name}") for number, name in self._tracks.values()]
        if any(span.marks for span in self._spans):
            torch.cuda.synchronize(self._device)
            names.append((_ON_DEVICE, str(self._device)))
        events: list[dict[str, object]] = [
            {"ph": "M", "name": "thread_name", "tid": number, "args": {"name": name}, **common}
            for number, name in names
        ]
        for name, track, begin, end, marks in self._spans:
            rows = [(track, (begin - self._zero) / 1e3, (end - begin) / 1e3)]
            if marks is not None and self._first is not None:
                at = 1e3 * self._first.elapsed_time(marks[0])
                rows.append((_ON_DEVICE, at, 1e3 * marks[0].elapsed_time(marks[1])))
            told = {"ph": "X", "name": name, "cat": "stage", **common}
            events += [{**told, "tid": tid, "ts": at, "dur": dur} for tid, at, dur in rows]
        for name, when, values in self._counts:
            at = (when - self._zero) / 1e3
            events.append({"ph": "C", "name": name, "ts": at, "args": values, **common})
        return events
