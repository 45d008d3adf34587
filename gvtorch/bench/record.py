"""A workload's settings (`Settings`), its timer (`clock`), and its results (`Record`)."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from ..base import check
from ..ops.registry import choose_backend

#: Peers by their names in `--peers`, and the package that must be installed for each.
PEERS = {
    "grid_sample": "torch",
    "warp": "warp-lang",
    "drjit": "drjit",
    "vtk": "vtk",
    "tensorstore": "zarr",  # zarr writes the chunks that tensorstore reads
    "zarr": "zarr",
    "pyfastnoiselite": "pyfastnoiselite",
    "pyfastnoisesimd": "pyfastnoisesimd",
    "trimesh": "trimesh",
    "igl": "libigl",
    "viser": "viser",
    "trame": "trame-vtk",
}
_MAX_OTHER_SHARE = 0.05  # share of the cores that other processes may use without a note


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How workloads are run."""

    device: torch.device
    quick: bool = False  # tiny sizes, to see that all works; the figures mean nothing
    repeats: int = 7  # timings of each figure
    seconds: float = 10.0  # after it no repeat of a figure begins; one always runs
    peers: tuple[str, ...] | None = None  # None: all that are installed
    only: str = ""  # run only cases whose name contains it
    pictures: Path | None = None  # a folder for the pictures that were compared
    tell: Callable[[str], None] = lambda _: None  # called with each step's name

    def __post_init__(self) -> None:
        check.integer("bench", "repeats", self.repeats, low=1)
        check.number("bench", "seconds", self.seconds, low=0)
        check.one_of("bench", "device", self.device.type, ("cpu", "cuda"))
        if self.device.type == "cuda":
            choose_backend("cuda", self.device)


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Milliseconds of one call."""

    median: float
    low: float
    high: float
    repeats: int
    last: Any = None  # what the last call returned

    def as_dict(self) -> dict[str, Any]:
        """Returns the columns of a row."""
        times = {"ms": self.median, "ms_low": self.low, "ms_high": self.high}
        return {**times, "repeats": self.repeats}


def clock(
    run: Callable[[], object],
    settings: Settings,
    *,
    calls: int = 1,
    prepare: Callable[[], object] | None = None,
) -> Timing:
    """Times a call, after one to warm up, by CUDA events on a CUDA device, else by wall clock.

    Args:
        run: The call to time.
        settings: Device, repeats, seconds.
        calls: Number of calls in a row that are timed together; the figures are per call.
        prepare: Called before each timing, and not timed.
    """
    device = settings.device
    times: list[float] = []
    began, last = 0.0, None
    for number in range(settings.repeats + 1):
        if prepare is not None:
            prepare()
        synchronize(device)
        last = None
        milliseconds, last = time_once(run, device, calls)
        times.append(milliseconds / calls)
        if number == 0:
            times.clear()  # the warm-up
            began = time.perf_counter()
        elif time.perf_counter() - began > settings.seconds:
            break
    return summarize(times, last)


def summarize(milliseconds: list[float], last: Any = None) -> Timing:
    """Returns median, smallest and largest of some times."""
    return Timing(
        last=last,
        median=statistics.median(milliseconds),
        low=min(milliseconds),
        high=max(milliseconds),
        repeats=len(milliseconds),
    )


def time_once(run: Callable[[], Any], device: torch.device, calls: int = 1) -> tuple[float, Any]:
    """Returns the milliseconds of `calls` calls together, and what the last one returned."""
    if device.type == "cuda":
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        with torch.cuda.device(device):
            begin.record()
            for _ in range(calls - 1):
                run()
            result = run()
            end.record()
        end.synchronize()
        return begin.elapsed_time(end), result
    start = time.perf_counter()
    for _ in range(calls - 1):
        run()
    result = run()
    return 1e3 * (time.perf_counter() - start), result


def synchronize(device: torch.device) -> None:
    """Waits until a CUDA device has nothing left to do."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Record:
    """What a workload measured on a machine.

    Attributes:
        workload: Its name.
        rows: A row of plain values for each case and `who` ran it; None where there is no figure.
        peers: For each peer that was wanted, "ran" or why it did not.
        notes: What a reader must know, a sentence each.
    """

    def __init__(self, workload: str, settings: Settings) -> None:
        self.workload, self.settings = workload, settings
        self.rows: list[dict[str, Any]] = []
        self.peers: dict[str, str] = {}
        self.notes: list[str] = []

    def wants(self, case: str) -> bool:
        """Returns whether a case is to be run."""
        return self.settings.only in case

    def add(self, case: str, who: str, timing: Timing | None = None, **figures: Any) -> None:
        self.rows.append(
            {"case": case, "who": who, **(timing.as_dict() if timing else {}), **figures}
        )

    def relative_to_first(self, case: str, timing: Timing) -> dict[str, float]:
        """Returns `times`: the time relative to the case's first row; nothing for that row."""
        first = next((row for row in self.rows if row["case"] == case), None)
        return {} if first is None else {"times": timing.median / first["ms"]}

    def has_peer(self, name: str, module: str = "", why_not: str = "") -> bool:
        """Returns whether a peer is wanted and can run, and stores the result in `peers`; `module`
        is the module it needs if its name differs, `why_not` another reason why it can't run.
        """
        if self.settings.peers is not None and name not in self.settings.peers:
            return False
        installed = importlib.util.find_spec(module or name) is not None
        self.peers[name] = why_not or ("ran" if installed else f"not installed ({PEERS[name]})")
        return self.peers[name] == "ran"

    def compiled(self, label: str, run: Callable[[], Any], **options: Any) -> Any:
        """Returns a function after torch has compiled it; None, with a note, if that fails."""
        function = torch.compile(run, dynamic=False, **options)
        try:
            function()
            synchronize(self.settings.device)
        except Exception as error:  # whatever the compiler finds missing here
            lines = str(error).strip().splitlines()
            self.note(f"{label}: torch.compile fails here: {lines[0] if lines else type(error)}")
            return None
        return function

    def note(self, sentence: str) -> None:
        """Adds a sentence to the notes, unless it is there already."""
        if sentence not in self.notes:
            self.notes.append(sentence)

    def as_dict(self) -> dict[str, Any]:
        """Returns plain values, ready for JSON."""
        return {
            "workload": self.workload,
            "machine": machine(self.settings.device),
            "quick": self.settings.quick,
            "rows": self.rows,
            "peers": self.peers,
            "notes": self.notes,
        }


@contextmanager
def noting_other_processes(record: Record) -> Iterator[None]:
    """Adds a note if other processes used much of the cores while a workload ran (Linux)."""
    start, busy_before, own_before = time.perf_counter(), _busy_seconds(), _own_seconds()
    yield
    other_seconds = _busy_seconds() - busy_before - (_own_seconds() - own_before)
    share = other_seconds / (time.perf_counter() - start) / (os.cpu_count() or 1)
    if share > _MAX_OTHER_SHARE:
        record.note(
            f"Other processes took {share:.0%} of this machine's CPU time meanwhile: the times may "
            "be too long"
        )


def _busy_seconds() -> float:
    """Returns the CPU seconds of all processes since the machine started; 0 if not known."""
    try:
        user, nice, system, _idle, _wait, irq, softirq, steal, *_ = (
            int(ticks) for ticks in Path("/proc/stat").read_text().split("\n")[0].split()[1:]
        )
    except (OSError, ValueError):
        return 0.0
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def _own_seconds() -> float:
    """Returns the CPU seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


def machine(device: torch.device) -> dict[str, Any]:
    """Returns the name of the device, the backend, and the versions of torch and gvtorch."""
    versions = {"torch": torch.__version__, "gvtorch": __version__}
    backend = choose_backend("auto", device)
    if device.type == "cuda":
        return {"name": torch.cuda.get_device_name(device), "backend": backend, **versions}
    threads = torch.get_num_threads()
    name = f"{_processor()}, {threads} thread{'s' if threads > 1 else ''}"
    return {"name": name, "backend": backend, **versions}


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = ""
    match = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    name = match[1] if match else platform.processor() or platform.machine()
    return " ".join(re.sub(r"\((R|TM)\)|\bProcessor\b|\bCPU\b", "", name).split())
