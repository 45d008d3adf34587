"""`FrameStats`: what a frame cost. Some of it is known only when the device has finished the frame:
these fields are declared with `waits`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeVar, cast

from ..base.records import RenderStats, add

T = TypeVar("T")


class _Waits:
    """A field that waits for the device when it is read."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make

    def __set_name__(self, _owner: type, name: str) -> None:
        self._name = name

    def __get__(self, stats: FrameStats | None, _owner: type) -> Any:
        return None if stats is None else vars(stats.settle())[self._name]

    def __set__(self, stats: FrameStats, value: Any) -> None:
        vars(stats)[self._name] = self._make() if value is None else value


def waits(make: Callable[[], T]) -> T:
    """Declares a field that is read back from the device, `make()` at first. Reading it waits until
    the device has finished the frame: see `FrameStats.settle`.
    """
    return cast(T, _Waits(make))


@dataclass(kw_only=True, repr=False)
class FrameStats(RenderStats):
    """What a frame of the engine cost, and what it asked for.

    Times, and what rays used and missed, are known when the device has finished the frame: reading
    one of these fields waits for that frame; `settle` waits for all of them. What this frame
    produced are answers to requests of the frame before and of its own scouts, and answers that
    came late. Requests and deferred count those of scouts too; use, misses and samples are those of
    the picture alone.
    """

    milliseconds: float = waits(float)  # of the frame; on CUDA, of the device
    stages: dict[str, float] = waits(dict)  # noqa: RUF009 - milliseconds by stage
    samples: int = waits(int)  # places at which the shader was evaluated
    tiles_used: int = waits(int)  # node tiles that rays passed through
    bricks_used: int = waits(int)  # bricks that rays sampled
    requests: dict[str, int] = waits(dict)  # noqa: RUF009 - by kind: load, subdivide
    misses: int = waits(int)  # nodes that rays missed, those whose answer is pending included
    overflow: int = waits(int)  # nodes with a request that the list had no place for
    converged: bool = waits(bool)  # nothing that could be served was missing

    frame: int = 0  # number of the frame, from 1
    frames: int = 1  # frames that this picture took
    produced: dict[str, int] = field(  # node tiles, bricks, nodes that need no brick
        default_factory=lambda: {"tiles": 0, "bricks": 0, "constant": 0}
    )
    evicted: dict[str, int] = field(  # replaced by others
        default_factory=lambda: {"tiles": 0, "bricks": 0}
    )
    bytes_uploaded: int = 0  # voxels moved into the brick pool
    stale: int = 0  # answers that came when their node was gone
    pending: int = 0  # answers on their way
    deferred: int = 0  # requests that the budgets put off
    failed: int = 0  # nodes that could not be produced, since the engine was made
    capacity_exceeded: bool = False  # a request found no slot that this frame had not used itself

    def __post_init__(self) -> None:
        """Nothing is on its way yet."""
        self._unread: tuple[Callable[[], None], ...] = ()

    def later(self, complete: Callable[[], None]) -> None:
        """Lets `settle` call `complete`, which waits for the device and sets fields."""
        self._unread = (*self._unread, complete)

    def settle(self) -> FrameStats:
        """Waits until the device has finished the frame; returns the statistics, now complete."""
        unread, self._unread = self._unread, ()
        for complete in unread:
            complete()
        return self

    def following(self, before: FrameStats) -> FrameStats:
        """Returns the statistics of a picture up to this frame: its own, with the sums of what the
        frames `before` took, and the most tiles and bricks that one frame used.
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
        """See `RenderStats.after`; the whole has converged if both parts have."""
        whole = super().after(before)
        if isinstance(whole, FrameStats) and isinstance(before, FrameStats):
            whole.converged &= before.converged
            whole.capacity_exceeded |= before.capacity_exceeded
        return whole

    @property
    def miss_rate(self) -> float:
        """Bricks asked for over bricks asked for and bricks used. A brick on its way is asked for
        once, and counts once.
        """
        asked = self.requests.get("load", 0)
        return asked / max(1, asked + self.bricks_used)

    def as_dict(self) -> dict[str, object]:
        """Returns plain values, ready for JSON."""
        return {**asdict(self), "miss_rate": self.miss_rate}

    def __repr__(self) -> str:
        made = ", ".join(f"{number} {name}" for name, number in self.produced.items())
        known = "not read back" if self._unread else "converged" * self.converged or "misses some"
        return f"FrameStats(frame {self.frame}: produced {made}; {known})"

    def __getstate__(self) -> dict[str, Any]:
        return vars(self.settle())
