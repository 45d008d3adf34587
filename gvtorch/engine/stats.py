"""Statistics of frames: `FrameStats` of one, the `Readback` that completes it, and the `Report` of
the last ones. On CUDA a frame's counts are copied to pinned memory while the host goes on: its
requests are served once its readback has arrived.
"""

from __future__ import annotations

import statistics
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..base.records import RenderStats, add
from ..cache import KINDS, RequestList
from ..cache.requests import extra_levels

_MAX_FRAMES_AHEAD = 3  # most frames that the host may be ahead of the device
COARSER_UNIT = 1 << 20  # 1.0 in `Counts.coarser`, which is fixed-point
_settle_lock = threading.RLock()  # one thread completes statistics, others wait for it


class _Waits:
    """A field of `FrameStats` that is known when the device has finished the frame: reading it
    waits for that.
    """

    def __init__(self, default: Any) -> None:
        self.default = default

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = "_" + name

    def __get__(self, stats: FrameStats | None, owner: type) -> Any:
        return self if stats is None else vars(stats.settle())[self.name]

    def __set__(self, stats: FrameStats, value: Any) -> None:
        vars(stats)[self.name] = copy(self.default) if value is self else value


def waits(default: Any) -> Any:
    """Declares a field of `FrameStats` that waits for the device when it is read."""
    return _Waits(default)


@dataclass(kw_only=True, repr=False)
class FrameStats(RenderStats):
    """What a frame of the engine cost, and what it requested.

    Times (on CUDA the device's) and what rays used and missed are known when the device has
    finished the frame: reading one of these fields, declared by `waits`, waits for it, as `settle`
    does. `produced` counts answers to requests of the previous frame and of this frame's scouts,
    and answers that came late. `requests` and `deferred` include those of scouts; use, misses and
    samples are those of the picture alone.
    """

    milliseconds: float = waits(0.0)  # from the first stage to the last, on CUDA the device's
    stages: dict[str, float] = waits({})  # milliseconds by stage
    samples: int = waits(0)  # positions at which the shader was evaluated
    tiles_used: int = waits(0)  # node tiles that rays passed through
    bricks_used: int = waits(0)  # bricks that rays sampled
    requests: dict[str, int] = waits({})  # by kind: load, subdivide
    misses: int = waits(0)  # nodes that rays missed, including pending ones
    overflow: int = waits(0)  # requested nodes that did not fit into the list
    converged: bool = waits(False)  # nothing that could be served was missing
    ahead: int = waits(0)  # nodes that only look-ahead rays missed; see `Engine.capture`
    coarser: float = waits(1.0)  # factor by which cones were wider, so that the view fits the pools

    frame: int = 0  # number of the frame, from 1
    frames: int = 1  # frames that this picture took
    produced: dict[str, int] = field(  # node tiles, bricks, nodes that need no brick
        default_factory=lambda: {"tiles": 0, "bricks": 0, "constant": 0}
    )
    evicted: dict[str, int] = field(  # replaced by others
        default_factory=lambda: {"tiles": 0, "bricks": 0}
    )
    bytes_uploaded: int = 0  # voxels moved into the brick pool
    stale: int = 0  # answers whose node was gone, served already, or known to fail
    pending: int = 0  # nodes whose answers are on their way
    deferred: int = 0  # requests that the budgets put off
    failed: int = 0  # nodes that could not be produced, and whose failure is not forgotten
    capacity_exceeded: bool = False  # a request found no slot: all were in use

    def __post_init__(self) -> None:
        self._completions: tuple[Callable[[], None], ...] = ()
        self._is_settling = False  # a thread is completing them

    def later(self, complete: Callable[[], None]) -> None:
        """Lets `settle` call `complete`, which waits for the device and sets fields."""
        self._completions = (*self._completions, complete)

    def settle(self) -> FrameStats:
        """Waits until the device has finished the frame; returns the statistics, now complete."""
        if not (self._completions or self._is_settling):
            return self
        with _settle_lock:
            if self._completions:
                self._is_settling = True
                completions, self._completions = self._completions, ()
                try:
                    for complete in completions:
                        complete()
                finally:
                    self._is_settling = False
        return self

    def following(self, before: FrameStats) -> FrameStats:
        """Returns the statistics of a picture up to this frame: its own, with times and production
        summed with the frames `before`, and the maximum of tiles and bricks used in one frame.
        """
        return replace(
            self,
            milliseconds=before.milliseconds + self.milliseconds,
            bytes_uploaded=before.bytes_uploaded + self.bytes_uploaded,
            tiles_used=max(before.tiles_used, self.tiles_used),
            bricks_used=max(before.bricks_used, self.bricks_used),
            stages=add(dict(before.stages), self.stages),
            produced=add(dict(before.produced), self.produced),
            evicted=add(dict(before.evicted), self.evicted),
        )

    def after(self, before: RenderStats) -> RenderStats:
        """See `RenderStats.after`; frames and what they made are added, too, and the whole has
        converged if both parts have.
        """
        if not isinstance(before, FrameStats):
            return super().after(before)
        return replace(
            self.following(before),
            rays=before.rays + self.rays,
            samples=before.samples + self.samples,
            frames=before.frames + self.frames,
            converged=before.converged and self.converged,
            capacity_exceeded=before.capacity_exceeded or self.capacity_exceeded,
        )

    @property
    def miss_rate(self) -> float:
        """Requested bricks over requested and used ones. A pending brick counts once."""
        requested = self.requests.get("load", 0)
        return requested / max(1, requested + self.bricks_used)

    def as_dict(self) -> dict[str, object]:
        """Returns plain values, ready for JSON."""
        return {**asdict(self), "miss_rate": self.miss_rate}

    def __repr__(self) -> str:
        produced = ", ".join(f"{number} {name}" for name, number in self.produced.items())
        state = (
            "not read back" if self._completions else "converged" * self.converged or "misses some"
        )
        failures = f"; {self.failed} nodes failed: Engine.failures" if self.failed else ""
        return f"FrameStats(frame {self.frame}: produced {produced}; {state}{failures})"

    def __getstate__(self) -> dict[str, Any]:
        return vars(self.settle())


class Counts(NamedTuple):
    """The counts of a frame that are copied to the host."""

    listed: int  # requested nodes in the list
    not_pending: int  # requested nodes that are not pending
    misses: int  # requested nodes, pending or not
    load: int  # requests of each kind in the list
    subdivide: int
    tiles_unused: int
    tiles_used: int
    bricks_unused: int
    bricks_used: int
    coarse_unused: int  # of the unused bricks
    samples: int
    # What a recorded frame made; other frames count it on the host.
    tiles: int = 0
    bricks: int = 0
    constant: int = 0
    tiles_evicted: int = 0
    bricks_evicted: int = 0
    failed: int = 0
    ahead: int = 0  # nodes that only look-ahead rays missed
    subdivisions: int = 0  # of picture and look-ahead, if a frame may deepen by several levels
    one_deeper: int = 0  # of these, those that want at least one more level
    two_deeper: int = 0  # and at least two
    coarser: int = COARSER_UNIT  # factor by which cones were wider than the camera's

    def by_kind(self) -> dict[str, int]:
        """Returns the number of requests by the name of their kind."""
        return {name: getattr(self, name) for name in KINDS}


class Collected(NamedTuple):
    """What a traced frame leaves on the device."""

    requests: RequestList
    numbers: Tensor  # (11,) or (22,) int64 `Counts`, then the argument of `ask`
    ask: Callable[[Tensor], int] | None = None  # called on the host; returns the number of nodes


class Readback:
    """A frame whose counts are on their way to the host; completes its statistics."""

    def __init__(
        self, stats: FrameStats, collected: Collected, earlier: Iterable[Readback] = ()
    ) -> None:
        """Starts the copy. `earlier`: readbacks of frames whose nodes are pending already, although
        producers may not have been asked for them yet.
        """
        self.stats, (self.requests, numbers, self._ask_producers) = stats, collected
        self._earlier_readbacks = tuple(earlier)
        self._asked_count: int | None = None
        self.pending = stats.pending > 0  # answers were on their way while it was traced
        self._numbers, self._event = numbers, None
        self._counts: Counts | None = None
        if numbers.is_cuda:
            self._numbers = torch.empty(
                numbers.shape, dtype=numbers.dtype, pin_memory=True, device="cpu"
            )
            self._numbers.copy_(numbers, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(numbers.device))
        stats.later(self._complete)

    def __repr__(self) -> str:
        return f"Readback({self.stats!r})"

    @property
    def arrived(self) -> bool:
        """Whether the counts have arrived."""
        return self._event is None or self._event.query()

    def wait(self) -> Counts:
        """Returns the counts; waits until they have arrived."""
        if self._counts is None:
            if self._event is not None:
                self._event.synchronize()
            self._counts = Counts(*self._numbers[: len(Counts._fields)].tolist())
        return self._counts

    def ask(self) -> int:
        """Asks producers for the nodes that the device chose, once; returns how many. Waits."""
        with _settle_lock:  # only one of the threads that render and settle asks
            if self._asked_count is None:
                self.wait()
                ask_producers, numbers = self._ask_producers, self._numbers[len(Counts._fields) :]
                self._asked_count = 0 if ask_producers is None else ask_producers(numbers)
        return self._asked_count

    def converged(self) -> bool:
        """Returns whether nothing that could be served was missing; waits for the counts."""
        # This frame did not list what earlier ones are to ask for: it was pending already.
        for readback in self._earlier_readbacks:
            self.pending |= readback.ask() > 0
        self._earlier_readbacks = ()
        return not (self.wait().not_pending or self.pending)

    def _complete(self) -> None:
        stats, counts = self.stats, self.wait()
        add(stats.requests, counts.by_kind())
        stats.overflow, stats.converged = counts.not_pending - counts.listed, self.converged()
        for name in stats.produced:
            stats.produced[name] += getattr(counts, name)
        for name in stats.evicted:
            stats.evicted[name] += getattr(counts, f"{name}_evicted")
        for name in ("misses", "tiles_used", "bricks_used", "samples", "ahead"):
            setattr(stats, name, getattr(counts, name))
        stats.coarser = counts.coarser / COARSER_UNIT


class Readbacks(deque[Readback]):
    """The frames whose counts are on their way, oldest first."""

    _steady = False
    # Of the newest frame read back, if it was recorded:
    failed = False  # whether a node failed
    extra_levels = 0  # by how many levels beyond the first the next frame deepens trees

    def catch_up(self, wait: bool) -> Readback | None:
        """Takes all frames whose counts have arrived. Waits for those of the others if `wait` is
        true, if an arrived frame has requests, or if the host is too far ahead. Returns the newest.
        """
        newest = None
        while self and (
            self[0].arrived
            or (wait or len(self) > _MAX_FRAMES_AHEAD)
            or (newest is not None and newest.wait().listed > 0)
        ):
            newest = self._take()
        return newest

    def take_arrived(self) -> None:
        """Takes the frames whose counts have arrived; does not block."""
        while self and self[0].arrived:
            self._take()

    def hold_back(self) -> None:
        """Waits for the oldest frames while the host is too far ahead of the device."""
        while len(self) > _MAX_FRAMES_AHEAD:
            self._take()

    @property
    def steady(self) -> bool:
        """True if the newest frame read back had converged; does not block."""
        for readback in tuple(self):  # another thread may render
            if readback.arrived:
                self._steady = readback.converged()
        return self._steady

    def _take(self) -> Readback:
        readback = self.popleft()
        readback.ask()
        self._steady = readback.converged()
        counts = readback.wait()
        self.failed = counts.failed > 0
        wanted = counts.subdivisions, counts.one_deeper, counts.two_deeper
        self.extra_levels = extra_levels(wanted)
        readback.stats.settle()
        return readback


@dataclass(frozen=True, repr=False)
class Report:
    """Times and rates of the last frames, as a table and as plain values."""

    frames: Collection[FrameStats]  # the oldest first
    occupancy: dict[str, float]  # for each pool, the share of slots that hold something
    memory: dict[str, int]  # bytes of the pools and of the bookkeeping

    def as_dict(self) -> dict[str, Any]:
        """Returns plain values: milliseconds by stage (median, 95th percentile), rates, misses."""
        frames = list(self.frames)
        seconds = sum(stats.milliseconds for stats in frames) / 1e3
        names = dict.fromkeys(name for stats in frames for name in stats.stages)
        used = sum(stats.bricks_used for stats in frames)
        missed = sum(stats.requests.get("load", 0) for stats in frames)
        amounts = {
            "rays": sum(stats.rays for stats in frames),
            "samples": sum(stats.samples for stats in frames),
            "bricks": sum(stats.produced.get("bricks", 0) for stats in frames),
            "tiles": sum(stats.produced.get("tiles", 0) for stats in frames),
            "megabytes": sum(stats.bytes_uploaded for stats in frames) / 1e6,
        }
        rates = {n: amount / seconds if seconds > 0 else 0.0 for n, amount in amounts.items()}
        return {
            "frames": len(frames),
            "milliseconds": _spread([stats.milliseconds for stats in frames]),
            "stages": {n: _spread([s.stages.get(n, 0.0) for s in frames]) for n in names},
            **{f"{name}_per_second": rate for name, rate in rates.items()},
            "hit_rate": used / max(1, used + missed),
            "miss_rate": missed / max(1, used + missed),
            "failed": frames[-1].failed if frames else 0,
            "occupancy": self.occupancy,
            "memory": self.memory,
        }

    def __rich__(self) -> Any:
        from rich.table import Table

        content = self.as_dict()
        table = Table(title=f"{content['frames']} frames", show_header=True)
        for column in ("", "median", "95 %"):
            table.add_column(column, justify="left" if not column else "right")
        for name, spread in {**content["stages"], "frame": content["milliseconds"]}.items():
            table.add_row(f"{name}, ms", f"{spread['median']:.2f}", f"{spread['p95']:.2f}")
        for name in ("samples", "bricks", "tiles", "megabytes"):
            table.add_row(f"{name} / s", f"{content[f'{name}_per_second']:,.0f}", "")
        table.add_row("bricks missed, of those wanted", f"{content['miss_rate']:.2%}", "")
        for name, fraction in content["occupancy"].items():
            table.add_row(f"{name} in use", f"{fraction:.1%}", "")
        for name, nbytes in content["memory"].items():
            table.add_row(f"{name}, MB", f"{nbytes / 1e6:.1f}", "")
        return table

    def __repr__(self) -> str:
        return f"Report({len(self.frames)} frames)"

    def __str__(self) -> str:
        from rich.console import Console

        console = Console(width=60, color_system=None)
        with console.capture() as capture:
            console.print(self)
        return capture.get()


def _spread(values: list[float]) -> dict[str, float]:
    ordered = sorted(values) or [0.0]
    return {
        "median": statistics.median(ordered),
        "p95": ordered[round(0.95 * (len(ordered) - 1))],
    }
