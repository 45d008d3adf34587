"""`Trace`: when which stage ran, of all threads and of the device, as a file for Perfetto
(ui.perfetto.dev) or chrome://tracing.

Source: "Trace Event Format" (the Chromium project).
"""

from __future__ import annotations

import json
import os
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import torch

from . import check
from .stage import record_stages
from .whole_file import whole_file

_ON_DEVICE = 0  # the track of the device; threads have theirs from 1 on


class _Span(NamedTuple):
    name: str
    track: int
    begin: int  # nanoseconds of the host's clock
    end: int
    marks: tuple[torch.cuda.Event, torch.cuda.Event] | None  # when the device did it


class Trace:
    """Writes down the stages that run while it is open:

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
        self._stack = ExitStack()
        self._stack.enter_context(record_stages(self))
        return self

    def __exit__(self, *_error: object) -> None:
        """Writes the file."""
        self._stack.close()
        with whole_file(self._path) as part, part.open("w", encoding="utf-8") as file:
            json.dump({"traceEvents": self._events(), "displayTimeUnit": "ms"}, file)

    def count(self, name: str, **values: float) -> None:
        """Notes numbers of now, which are drawn as curves over time."""
        self._counts.append((name, time.perf_counter_ns(), values))

    def begin(self) -> tuple[int, torch.cuda.Event | None]:
        """See `Recorder`."""
        return time.perf_counter_ns(), self._event()

    def end(self, name: str, began: tuple[int, torch.cuda.Event | None]) -> None:
        """See `Recorder`."""
        (begin, first), last, end = began, self._event(), time.perf_counter_ns()
        marks = None if first is None or last is None else (first, last)
        self._spans.append(_Span(name, self._track(), begin, end, marks))

    def _event(self) -> torch.cuda.Event | None:
        """A mark in the device's stream; none in what is being captured."""
        if self._device.type != "cuda" or torch.cuda.is_current_stream_capturing():
            return None
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
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
            events += [
                {
                    "ph": "X",
                    "name": name,
                    "cat": "stage",
                    "tid": tid,
                    "ts": at,
                    "dur": dur,
                    **common,
                }
                for tid, at, dur in rows
            ]
        for name, when, values in self._counts:
            at = (when - self._zero) / 1e3
            events.append({"ph": "C", "name": name, "ts": at, "args": values, **common})
        return events
