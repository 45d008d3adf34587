"""The records that the steps of a frame hand to each other, and what a frame cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Rays:
    """Rays in world units, all float32 or all float64 on one device."""

    origin: Tensor  # (r, 3)
    direction: Tensor  # (r, 3), unit length
    cone: Tensor  # (r, 2) width at the origin, growth of the width per unit distance
    range: Tensor  # (r, 2) first and last distance along the ray; +inf is allowed for the last
    width: int = 0  # pixels of a row, if these are whole rows of a picture: traced in tiles
    transmittance: Tensor | None = None  # (r,) at the first distance; None: 1

    def __getitem__(self, index: Tensor | slice) -> Rays:
        """Some of the rays, which are no rows any more."""
        return self._each(lambda column: column[index], 0)

    def to(self, device: torch.device | str) -> Rays:
        """The rays on a device."""
        return self._each(lambda column: column.to(device), self.width)

    def double(self) -> Rays:
        """The rays in float64, each column contiguous."""
        return self._each(lambda column: column.to(torch.float64).contiguous(), self.width)

    def light(self) -> Tensor:
        """Returns (r, 1) float64 transmittance at the first distance."""
        if self.transmittance is None:
            return torch.ones_like(self.origin[:, :1], dtype=torch.float64)
        return self.transmittance[:, None].to(torch.float64)

    def _each(self, change: Callable[[Tensor], Tensor], width: int) -> Rays:
        columns = (self.origin, self.direction, self.cone, self.range)
        origin, direction, cone, limits = (change(column) for column in columns)
        return Rays(
            origin=origin,
            direction=direction,
            cone=cone,
            range=limits,
            width=width,
            transmittance=None if self.transmittance is None else change(self.transmittance),
        )


@dataclass(frozen=True, kw_only=True)
class Hits:
    """What the rays brought back."""

    color: Tensor  # (r, 3) linear RGB, premultiplied by alpha
    alpha: Tensor  # (r, 1)
    depth: Tensor  # (r, 1) distance along the ray in world units, +inf where nothing was hit
    samples: Tensor  # (r,) int32, places at which the shader was evaluated
    missed: Tensor  # (r,) bool, something that the ray saw was not there
    # What only some shaders give, else None:
    normal: Tensor | None = None  # (r, 3) world, towards the eye, of unit length or 0
    features: Tensor | None = None  # (r, c)


class Counts:
    """Numbers on their way from a device to the host, which does not wait for them."""

    def __init__(self, numbers: Tensor) -> None:
        """Sends (k,) int64 numbers off: by a copy to pinned memory, where the device is CUDA."""
        self._numbers, self._event = numbers, None
        if numbers.is_cuda:
            self._numbers = torch.empty(numbers.shape, dtype=numbers.dtype, pin_memory=True)
            self._numbers.copy_(numbers, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(numbers.device))

    @property
    def here(self) -> bool:
        """Whether they have come."""
        return self._event is None or self._event.query()

    def read(self) -> list[int]:
        """Returns them; waits until they have come."""
        if self._event is not None:
            self._event.synchronize()
        return self._numbers.tolist()


@dataclass(kw_only=True)
class RenderStats:
    """What a picture cost."""

    milliseconds: float = 0.0  # wall time of the whole call
    stages: dict[str, float] = field(default_factory=dict)  # milliseconds by stage
    backend: str = ""
    rays: int = 0
    samples: int = 0  # places at which the shader was evaluated
    nodes: int = 0  # nodes in the pool
    bricks: int = 0  # bricks in the pool
    bytes: int = 0  # memory of the pools
    tiles_used: int = 0  # node tiles that rays passed through
    bricks_used: int = 0  # bricks that rays sampled

    def as_dict(self) -> dict[str, object]:
        """Returns plain values, ready for JSON."""
        return asdict(self)


@dataclass(kw_only=True)
class FrameStats(RenderStats):
    """What a frame of the engine cost, and what it asked for.

    What rays used and missed, and times, are known when the device has come to the frame's end:
    who reads one of these first waits for that frame, nobody else does. What was produced is what
    this call wrote: for wishes of the frame before, for those of scouts that went ahead of the
    picture, and answers that came late. Requests and deferred count the scouts' wishes too; use,
    misses and samples are those of the picture alone.
    """

    frame: int = 0  # number of the frame, from 1
    frames: int = 1  # frames that this picture took
    requests: dict[str, int] = field(default_factory=dict)  # wishes by kind: load, subdivide
    misses: int = 0  # nodes that rays missed, those whose answer is on its way counted too
    produced: dict[str, int] = field(  # node tiles, bricks, nodes that need no brick
        default_factory=lambda: {"tiles": 0, "bricks": 0, "constant": 0}
    )
    evicted: dict[str, int] = field(  # replaced by others
        default_factory=lambda: {"tiles": 0, "bricks": 0}
    )
    bytes_uploaded: int = 0  # voxels moved into the brick pool
    stale: int = 0  # answers that came when their node was gone
    pending: int = 0  # answers on their way
    deferred: int = 0  # wishes that the budgets put off
    overflow: int = 0  # nodes with a wish that the list had no place for
    failed: int = 0  # nodes that could not be produced, since the engine was made
    capacity_exceeded: bool = False  # a wish found no slot that this frame had not used itself
    converged: bool = False  # nothing that could be served was missing

    def later(self, arrive: Callable[[], None]) -> None:
        """Calls `arrive`, which sets fields that come late, before one of them is read."""
        object.__getattribute__(self, "__dict__").setdefault("_late", []).append(arrive)

    def settle(self) -> None:
        """Waits for what comes late."""
        for arrive in object.__getattribute__(self, "__dict__").pop("_late", ()):
            arrive()

    def __getattribute__(self, name: str) -> Any:
        """Fetches what comes late."""
        if name in _LATE:
            object.__getattribute__(self, "settle")()
        return object.__getattribute__(self, name)

    def add(self, stats: FrameStats) -> None:
        """Adds a frame of the same picture: sums what it took, and keeps the most it used."""
        self.milliseconds += stats.milliseconds
        self.bytes_uploaded += stats.bytes_uploaded
        self.tiles_used = max(self.tiles_used, stats.tiles_used)
        self.bricks_used = max(self.bricks_used, stats.bricks_used)
        for name in ("stages", "produced", "evicted"):
            add(getattr(self, name), getattr(stats, name))

    def of_picture(self, total: FrameStats) -> FrameStats:
        """Returns the statistics of a picture: those of its last frame, this one, but for what
        `total` added up over all its frames.
        """
        summed = {name: getattr(total, name) for name in _SUMMED}
        return replace(self, **summed)

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


def add(sums: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Adds numbers by name."""
    for key, value in more.items():
        sums[key] = sums.get(key, 0) + value


_SUMMED = (
    *("frames", "milliseconds", "stages", "rays", "tiles_used", "bricks_used"),
    *("produced", "evicted", "bytes_uploaded", "converged", "capacity_exceeded"),
)
_LATE = {
    *("milliseconds", "stages", "samples", "tiles_used", "bricks_used"),
    *("requests", "misses", "overflow", "converged"),
    *("__dict__", "__getstate__"),  # vars, and copies
}
