"""Plots what host and device do in frames of a flight through a store: above, the stages of some
frames (`gv.Timeline`, whose file Perfetto shows as well); below, the kernels of one frame on the
device, grouped by purpose (`torch.profiler`; CUDA).
"""

from __future__ import annotations

import json
import tempfile
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fly_through
import torch
import tyro
from matplotlib import pyplot

import gvtorch as gv

# A kernel belongs to the first kind of which its name contains a word.
KINDS = {
    "march": ("ShadeRay", "HideShaded"),
    "order of use": ("SplitByUse", "PackUse", "FlagUse"),
    "requests": ("ListRequests", "add_chunks"),
    "sorting requests": ("Radix", "radix", "sort"),
    "write and link": ("Put", "Link", "Take", "Clear", "WritePointer", "Lacking"),
    "copies": ("Memcpy", "Memset"),
    "small torch ops": ("",),
}


@dataclass
class Settings:
    """What to fly."""

    output: Path = Path("flight.png")
    trace: Path = Path("flight.json")
    """what Perfetto reads"""
    frames: int = 8
    """that are drawn"""
    before: int = 400
    """frames flown before these"""
    flight: fly_through.Settings = field(
        default_factory=lambda: fly_through.Settings(
            frames=1200, size=(1920, 1080), pools=("512 MB",), device="cuda"
        )
    )


def kernel_kind(kernel: str) -> str:
    """Returns the kind that a kernel belongs to."""
    return next(kind for kind, parts in KINDS.items() if any(part in kernel for part in parts))


def fly(settings: Settings, store: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Returns the trace events of the frames, and those of one frame's kernels."""
    flight = settings.flight
    shader, cameras = fly_through.scene(flight)
    producer = fly_through.source(flight, store)
    options = {"brick_pool": flight.pools[0], "node_pool": "64 MB", "device": flight.device}
    with gv.Engine(producer, **options) as engine:
        engine.render(cameras[0], shader)
        graph = engine.capture(cameras[0], shader, batch=flight.batch)
        drawn = settings.before + settings.frames
        for camera in cameras[: settings.before]:
            graph.replay(camera)
        with gv.Timeline(settings.trace, engine.device):
            for camera in cameras[settings.before : drawn]:
                graph.replay(camera)
        activities = [torch.profiler.ProfilerActivity.CUDA]
        with torch.profiler.profile(activities=activities) as profiler:
            for camera in cameras[drawn : drawn + 12]:
                graph.replay(camera)
            torch.cuda.synchronize()
        profiler.export_chrome_trace(str(store.with_suffix(".kernels.json")))
    kernels = json.loads(store.with_suffix(".kernels.json").read_text("utf-8"))["traceEvents"]
    stages = json.loads(settings.trace.read_text("utf-8"))["traceEvents"]
    return stages, last_frame(kernels)


def is_march(kernel: str) -> bool:
    """Returns whether a kernel traces rays through bricks, and not only through nodes."""
    return "ShadeRay" in kernel and "HideShaded" not in kernel


def last_frame(events: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the device's events from the end of the last march but one to the end of the last."""
    ours = [e for e in events if e.get("cat") in ("kernel", "gpu_memcpy", "gpu_memset")]
    begin, end = sorted(e["ts"] + e["dur"] for e in ours if is_march(e["name"]))[-2:]
    return [event for event in ours if begin <= event["ts"] <= end]


def draw(stages: list[dict[str, Any]], kernels: list[dict[str, Any]], output: Path) -> None:
    """Draws the stages above, the kernels below."""
    figure, (above, below) = pyplot.subplots(2, 1, figsize=(11, 6.5), constrained_layout=True)
    tracks = {e["tid"]: e["args"]["name"] for e in stages if e["ph"] == "M"}
    spans = [e for e in stages if e["ph"] == "X" and (e["tid"] or e["name"] != "read")]
    spans.sort(key=lambda event: -event["dur"])
    names = list(dict.fromkeys(e["name"] for e in spans))
    rows = {tid: y for y, tid in enumerate(sorted(tracks, reverse=True))}
    for event in spans:
        y, color = rows[event["tid"]], f"C{names.index(event['name']) % 10}"
        span = [(event["ts"] / 1e3, event["dur"] / 1e3)]
        above.broken_barh(span, (y - 0.4, 0.8), color=color, edgecolor="white", linewidth=0.3)
    above.set_yticks(list(rows.values()), [tracks[tid] for tid in rows])
    marks = [pyplot.Rectangle((0, 0), 1, 1, color=f"C{i % 10}") for i in range(len(names))]
    above.legend(marks, names, fontsize=8, ncols=4, loc="upper right")
    above.set_xlabel("milliseconds")
    spent: dict[str, float] = defaultdict(float)
    counted: dict[str, int] = defaultdict(int)
    first = min(event["ts"] for event in kernels)
    for event in kernels:
        kind = kernel_kind(event["name"])
        spent[kind], counted[kind] = spent[kind] + event["dur"], counted[kind] + 1
    order = sorted(spent, key=lambda kind: spent[kind])
    for event in kernels:
        y = order.index(kernel_kind(event["name"]))
        span = [((event["ts"] - first) / 1e3, event["dur"] / 1e3)]
        below.broken_barh(span, (y - 0.4, 0.8), color=f"C{y}")
    labels = [f"{kind}\n{counted[kind]}, {spent[kind]:.0f} us" for kind in order]
    below.set_yticks(range(len(order)), labels, fontsize=8)
    below.set_xlabel("milliseconds of one frame on the device, after the march of the one before")
    figure.savefig(output, dpi=110, metadata={"Software": None})


def main(settings: Settings) -> None:
    """Flies, traces and draws."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store, raw = folder / "worn.zarr", folder / "worn.raw"
        fly_through.write_volume(raw, settings.flight.side)
        gv.convert(raw, store, shape=(settings.flight.side,) * 3, dtype="uint8")
        draw(*fly(settings, store), settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
