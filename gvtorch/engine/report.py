"""`Report`: what the last frames took, as a table and as plain values."""

from __future__ import annotations

import statistics
from collections import deque
from typing import Any

from .stats import FrameStats

_KEPT = 1000  # frames


class Report:
    """Statistics of the last 1000 frames.

    Attributes:
        occupancy: For each pool, the share of slots that hold something.
        memory: Bytes of the pools and of the bookkeeping.
    """

    def __init__(self) -> None:
        """Has seen nothing yet."""
        self._frames: deque[FrameStats] = deque(maxlen=_KEPT)
        self.occupancy: dict[str, float] = {}
        self.memory: dict[str, int] = {}

    def add(self, stats: FrameStats) -> None:
        """Takes note of a frame."""
        self._frames.append(stats)

    def as_dict(self) -> dict[str, Any]:
        """Returns plain values: milliseconds by stage (median, 95th percentile), rates, misses."""
        frames = list(self._frames)
        seconds = sum(stats.milliseconds for stats in frames) / 1e3
        names = dict.fromkeys(name for stats in frames for name in stats.stages)
        used = sum(stats.bricks_used for stats in frames)
        missed = sum(stats.requests.get("load", 0) for stats in frames)

        def rate(amount: float) -> float:
            return amount / seconds if seconds > 0 else 0.0

        return {
            "frames": len(frames),
            "milliseconds": _spread([stats.milliseconds for stats in frames]),
            "stages": {n: _spread([s.stages.get(n, 0.0) for s in frames]) for n in names},
            "rays_per_second": rate(sum(stats.rays for stats in frames)),
            "samples_per_second": rate(sum(stats.samples for stats in frames)),
            "bricks_per_second": rate(sum(s.produced.get("bricks", 0) for s in frames)),
            "tiles_per_second": rate(sum(s.produced.get("tiles", 0) for s in frames)),
            "megabytes_per_second": rate(sum(s.bytes_uploaded for s in frames) / 1e6),
            "hit_rate": used / max(1, used + missed),
            "miss_rate": missed / max(1, used + missed),
            "failed": frames[-1].failed if frames else 0,
            "occupancy": dict(self.occupancy),
            "memory": dict(self.memory),
        }

    def __rich__(self) -> Any:
        """Returns the table that rich prints."""
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
        for name, share in content["occupancy"].items():
            table.add_row(f"{name} in use", f"{share:.1%}", "")
        for name, size in content["memory"].items():
            table.add_row(f"{name}, MB", f"{size / 1e6:.1f}", "")
        return table

    def __repr__(self) -> str:
        return f"Report({len(self._frames)} frames)"

    def __str__(self) -> str:
        """Shows the table as plain text."""
        from rich.console import Console

        console = Console(width=60, color_system=None)
        with console.capture() as capture:
            console.print(self)
        return capture.get()


def _spread(values: list[float]) -> dict[str, float]:
    if not values:
        return {"median": 0.0, "p95": 0.0}
    ordered = sorted(values)
    return {
        "median": statistics.median(ordered),
        "p95": ordered[min(len(ordered) - 1, round(0.95 * (len(ordered) - 1)))],
    }
