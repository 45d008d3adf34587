"""Named stages of a frame: `with stage("trace"):` reports to the timer, torch's profiler, an open
`Timeline`, and as NVTX ranges to NVIDIA's tools. `Timeline`: when each stage ran, in all threads
and on the device, as a file for Perfetto (ui.perfetto.dev) or chrome://tracing.

Times are differences of marks. On CUDA a mark is an event in the stream: recording one does not
make the host wait, reading the time between two does.

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
from typing import Any, NamedTuple

import torch

from . import check
from .whole_file import whole_file

#: Called with (what, done, total) by long work, for a progress bar.
Progress = Callable[[str, int, int], None]
Mark = float | torch.cuda.Event


def no_progress(what: str, done: int, total: int) -> None:
    """Shows nothing."""


def check_progress(context: str, progress: Any) -> None:
    """Raises ValueError unless a user's `progress` can be called."""
    if not callable(progress):
        got = type(progress).__name__
        raise ValueError(f"{context}: progress must be a function, got {got}")


def mark(device: torch.device) -> Mark:
    """Returns a mark of now: the host's time, or on CUDA an event recorded in the stream."""
    if device.type != "cuda":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record(torch.cuda.current_stream(device))
    return event


def milliseconds(start: Mark, end: Mark) -> float:
    """Returns the time between two marks of one device; waits for the device to reach `end`."""
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
        """Returns milliseconds by stage; waits for the device to reach the end of the last one."""
        total: dict[str, float] = {}
        for name, start, end in self.spans:
            total[name] = total.get(name, 0.0) + milliseconds(start, end)
        return total


_timings: ContextVar[Timings | None] = ContextVar("gvtorch_timings", default=None)
_timelines: list[Timeline] = []  # those that are open, in all threads
#: Nsight Systems and Compute set the first variable; users set the second to get ranges anyway.
_NVTX_ENABLED = torch.version.cuda is not None and bool(
    {"NVTX_INJECTION64_PATH", "GVTORCH_NVTX"} & set(os.environ)
)


class stage:  # not a generator-based context manager, which is slower: a frame has several stages
    """Names the stage that the block runs, for `collect_timings`, torch's profiler, NVTX and open
    `Timeline`s; costs next to nothing where none of them is active.
    """

    __slots__ = ("_began", "_name", "_ranges", "_start", "_timings")

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        self._ranges = None
        if _NVTX_ENABLED or torch.autograd._profiler_enabled():
            self._ranges = _open_ranges(f"gvtorch.{self._name}")
        self._began = [(timeline, timeline.begin()) for timeline in _timelines]
        self._timings = timings = _timings.get()
        self._start = None if timings is None else mark(timings.device)

    def __exit__(self, *error: object) -> None:
        timings, start = self._timings, self._start
        if timings is not None and start is not None:
            timings.spans.append((self._name, start, mark(timings.device)))
        for timeline, began in self._began:
            timeline.end(self._name, began)
        if self._ranges is not None:
            self._ranges.close()


def _open_ranges(name: str) -> ExitStack:
    """Opens a range in torch's profiler and in NVIDIA's tools, if they are active."""
    with ExitStack() as ranges:
        if torch.autograd._profiler_enabled():
            ranges.enter_context(torch.profiler.record_function(name))
        if _NVTX_ENABLED:
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


_DEVICE_TRACK = 0  # the track of the device; tracks of threads are numbered from 1


class _Span(NamedTuple):
    name: str
    track: int
    begin: int  # nanoseconds of the host's clock
    end: int
    marks: tuple[torch.cuda.Event, torch.cuda.Event] | None  # begin and end on the device


class Timeline:
    """Records the stages of all threads while it is open:

    with gv.Timeline("frames.json"):
        engine.render(camera, shader)

    The names are those of `FrameStats.stages`. On CUDA a stage appears twice: when the host issued
    it, and when the device ran it.
    """

    def __init__(self, path: str | Path, device: torch.device | str = "cpu") -> None:
        """Takes the file, which is written when the block ends, even by an exception.

        Args:
            path: Ends in .json.
            device: If CUDA, times on its current stream are recorded in addition to the host's.

        Raises:
            ValueError: The path ends differently, or there is no such device.
            FileNotFoundError: The folder does not exist.
        """
        check.instance("Timeline", "path", path, str, os.PathLike)
        self._path, self._device = Path(path), check.device("Timeline", device)
        if self._path.suffix != ".json":
            raise ValueError(f"Timeline: path must end in .json, got {str(path)!r}")
        if not self._path.parent.is_dir():
            raise FileNotFoundError(f"Timeline: folder not found: {self._path.parent}")
        self._spans: list[_Span] = []
        self._counts: list[tuple[str, int, dict[str, float]]] = []
        self._tracks: dict[int, tuple[int, str]] = {}  # number and name, by thread
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        return f"Timeline({str(self._path)!r}, {len(self._spans)} stages)"

    def __enter__(self) -> Timeline:
        """Starts recording, anew if it was opened before; RuntimeError while it is open."""
        if self in _timelines:
            raise RuntimeError("Timeline: it is open already")
        self._spans, self._counts, self._tracks = [], [], {}
        self._start_ns = time.perf_counter_ns()
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
            self._start_ns, self._start_event = time.perf_counter_ns(), self._event()
        _timelines.append(self)
        return self

    def __exit__(self, *_error: object) -> None:
        """Stops recording and writes the file."""
        _timelines.remove(self)
        with whole_file(self._path) as draft, draft.open("w", encoding="utf-8") as file:
            json.dump({"traceEvents": self._events(), "displayTimeUnit": "ms"}, file)

    def count(self, name: str, **values: float) -> None:
        """Records current values, which are drawn as curves over time."""
        self._counts.append((name, time.perf_counter_ns(), values))

    def begin(self) -> tuple[int, torch.cuda.Event | None]:
        """Returns when a stage begins, to be passed to `end`."""
        return time.perf_counter_ns(), self._event()

    def end(self, name: str, began: tuple[int, torch.cuda.Event | None]) -> None:
        """Records a stage that ends now; `began` is what `begin` returned."""
        (begin, begin_event), end_event, end = began, self._event(), time.perf_counter_ns()
        marks = None if begin_event is None or end_event is None else (begin_event, end_event)
        self._spans.append(_Span(name, self._track(), begin, end, marks))

    def _event(self) -> torch.cuda.Event | None:
        """Returns a mark in the device's stream; None on a CPU or during graph capture."""
        if self._device.type != "cuda" or torch.cuda.is_current_stream_capturing():
            return None
        event = mark(self._device)
        assert isinstance(event, torch.cuda.Event)
        return event

    def _track(self) -> int:
        thread = threading.current_thread()
        with self._lock:
            new_track = (len(self._tracks) + 1, thread.name)
            return self._tracks.setdefault(threading.get_ident(), new_track)[0]

    def _events(self) -> list[dict[str, object]]:
        """Returns all events of the file; waits for the device."""
        common = {"pid": os.getpid()}
        track_names = [(number, f"host: {name}") for number, name in self._tracks.values()]
        if any(span.marks for span in self._spans):
            torch.cuda.synchronize(self._device)
            track_names.append((_DEVICE_TRACK, str(self._device)))
        events: list[dict[str, object]] = [
            {"ph": "M", "name": "thread_name", "tid": number, "args": {"name": name}, **common}
            for number, name in track_names
        ]
        for name, track, begin, end, marks in self._spans:
            rows = [(track, (begin - self._start_ns) / 1e3, (end - begin) / 1e3)]
            if marks is not None and self._start_event is not None:
                start_us = 1e3 * self._start_event.elapsed_time(marks[0])
                rows.append((_DEVICE_TRACK, start_us, 1e3 * marks[0].elapsed_time(marks[1])))
            stage_event = {"ph": "X", "name": name, "cat": "stage", **common}
            events += [
                {**stage_event, "tid": tid, "ts": start_us, "dur": dur}
                for tid, start_us, dur in rows
            ]
        for name, count_ns, values in self._counts:
            start_us = (count_ns - self._start_ns) / 1e3
            events.append({"ph": "C", "name": name, "ts": start_us, "args": values, **common})
        return events
