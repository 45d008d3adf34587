"""The engine with its cache: `frame` (steady and from a cold start), `deep` (a surface in a deep
tree) and `stream` (bricks from host memory into the pool).
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal

import torch

from ..cameras import Camera
from ..engine import Engine, FrameStats
from ..fields import sdf
from ..pictures import Picture
from ..pool import Channel, N3Tree
from ..pool.staging import mapped
from ..producers import Bricks, FieldProducer, Nodes, Producer, VolumeProducer
from ..shaders import TransferFunction
from ..tracing import render
from .record import Record, Settings, Timing, clock, summarize, synchronize
from .scenes import BenchScene, scan_or_fog, worn

#: Stages of a frame that belong to the cache: a resident tree does not need them.
CACHE_STAGES = ("requests", "lru", "schedule", "produce", "write", "count")
_MAX_FRAMES = 1000  # frames within which a view must converge
_POOLS = {"node_pool": "16 MB", "brick_pool": "384 MB"}  # hold all of 512^3 uint8
_Frame = tuple[Picture, FrameStats]
_Setup = Callable[[Engine], Callable[[], list[Any]]]  # untimed setup; returns the timed call
_QUICK_POOLS = {"node_pool": "1 MB", "brick_pool": "2 MB"}


def frame(record: Record) -> None:
    """Measures steady frames, compared with a resident tree, then cold starts."""
    quick = record.settings.quick
    width, height = (24, 16) if quick else (1920, 1080)
    scene = scan_or_fog(32 if quick else 256, record.note)
    if record.wants("steady"):
        _steady(record, scene, (width, height))
    if record.wants("cold start"):
        record.settings.tell("frame: making the worn sphere")
        scene = worn(32 if quick else 512)
        for budget in (4096, 65536):
            _cold(record, scene, (width, height), budget)


def deep(record: Record) -> None:
    """Measures steady frames of a patch of a thin shell, in a tree of the patch and a wider one."""
    settings = record.settings
    size = (1920, 1080) if settings.device.type == "cuda" else (480, 270)
    patch, size = (64, (24, 16)) if settings.quick else (4096, size)
    pools: dict[str, Any] = {"node_pool": "256 MB", "brick_pool": "2 GB"}
    pools |= _QUICK_POOLS if settings.quick else {}
    radius, half_patch = 6.5 * patch, patch / 2  # in voxels, which are world units
    shell = sdf.Shell(sdf.Sphere(radius), 3.0)
    shader = TransferFunction.from_points([(0.3, 0), (0.6, 1)])
    target = (half_patch, half_patch, math.sqrt(radius**2 - 2 * half_patch**2))
    boxes = {  # nodes of both trees are aligned
        patch: ((0.0, 0.0, 6.0 * patch), (patch, patch, 7.0 * patch)),
        16 * patch: ((-8.0 * patch,) * 3, (8.0 * patch,) * 3),
    }
    for view_name, offset in (("from above", (0.0, 0.01, 0.4)), ("obliquely", (0.0, -0.28, 0.28))):
        eye = [t + patch * o for t, o in zip(target, offset, strict=True)]
        camera = Camera.look_at(eye, target, (0, 1, 0), size[1] / 36, *size)  # pixel-sized voxels
        first_picture, first_median = torch.empty(0, device="cpu"), 0.0
        for side, box in boxes.items():
            case, who = f"shell, {view_name}, {size[0]}x{size[1]}", f"a tree of {side}^3"
            if not record.wants(case):
                continue
            settings.tell(f"{case}: {who}")
            producer = FieldProducer(shell, side, box=box)
            with Engine(producer, monitor=False, device=settings.device, **pools) as engine:
                picture = _converge(engine, camera, shader).cpu()
                timing, stats = _clock_frames(engine, camera, shader, settings)
                if settings.device.type == "cuda":
                    graph = engine.capture(camera, shader)
                    timing = clock(partial(graph.replay, camera), settings, calls=20)
            if not first_median:
                first_picture, first_median = picture, timing.median
            record.add(
                *(case, who, timing),
                samples=stats[-1].samples,
                samples_per_second=1e3 * stats[-1].samples / timing.median,
                times=timing.median / first_median,
                bricks=stats[-1].bricks_used,
                max_difference=float((picture - first_picture).abs().max()),
            )
    record.note("times: relative to the frame in the smaller tree")


def _steady(record: Record, scene: BenchScene, size: tuple[int, int]) -> None:
    settings, camera = record.settings, scene.camera(*size)
    case = f"steady, {scene.name}, {size[0]}x{size[1]}"
    pools: dict[str, Any] = _QUICK_POOLS if settings.quick else {}
    for monitor in (False, True):
        settings.tell(f"{case}: monitor {monitor}")
        producer = VolumeProducer(scene.volume)
        with Engine(producer, device=settings.device, monitor=monitor, **pools) as engine:
            picture = _converge(engine, camera, scene.shader)
            timing, stats = _clock_frames(engine, camera, scene.shader, settings)
            if not stats[-1].converged or any(s.requests["load"] for s in stats):
                record.note(f"{case}: bricks were still requested while it was timed")
            figures = _stage_figures(stats[1:]) if monitor else {}
            record.add(case, "gvtorch, monitored" if monitor else "gvtorch", timing, **figures)
            if settings.device.type == "cuda" and not monitor:
                _captured(record, case, engine, camera, scene.shader)
    settings.tell(f"{case}: resident")
    tree = N3Tree.from_volume(scene.volume, device=settings.device)
    timing = clock(lambda: render(tree, camera, scene.shader), settings)
    difference = float((timing.last.color - picture).abs().max())
    times = record.relative_to_first(case, timing)
    record.add(case, "resident tree", timing, **times, max_difference=difference)
    record.note(
        f"cache share: of a monitored frame, time in the stages {', '.join(CACHE_STAGES)}; "
        "monitored: the host waits for the device after each stage"
    )


def _captured(
    record: Record, case: str, engine: Engine, camera: Camera, shader: TransferFunction
) -> None:
    """Measures the same frame as a CUDA graph, and its cache stages as a separate graph."""
    settings, calls = record.settings, 20
    graph = engine.capture(camera, shader)
    timing = clock(lambda: graph.replay(camera), settings, calls=calls)
    samples = torch.zeros(1, dtype=torch.int32, device=settings.device)
    cache_graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(cache_graph):
        outputs = engine.collect_requests_and_use(samples)
    cache_ms = clock(cache_graph.replay, settings, calls=calls).median
    del outputs  # a graph's memory stays in use until then
    figures = {"cache_ms": cache_ms, "cache_share": cache_ms / timing.median}
    record.add(case, "gvtorch, captured", timing, **figures)
    record.note(
        "captured: frames replayed as a CUDA graph; cache share: listing requests, sorting by use"
    )


def _clock_frames(
    engine: Engine, camera: Camera, shader: TransferFunction, settings: Settings
) -> tuple[Timing, list[FrameStats]]:
    stats: list[FrameStats] = []
    timing = clock(lambda: stats.append(engine.frame(camera, shader)[1]), settings)
    return timing, stats


def _stage_figures(stats: list[FrameStats]) -> dict[str, Any]:
    names = dict.fromkeys(name for s in stats for name in s.stages)
    medians = {n: statistics.median(s.stages.get(n, 0.0) for s in stats) for n in names}
    cache_ms = sum(medians.get(name, 0.0) for name in CACHE_STAGES)
    return {
        "trace_ms": medians.get("trace", 0.0),
        "cache_ms": cache_ms,
        "cache_share": cache_ms / sum(medians.values()),
        "stages": medians,
    }


def until_converged(render_frame: Callable[[], _Frame]) -> Iterator[_Frame]:
    """Yields frames up to the first that has converged, at most `_MAX_FRAMES`."""
    for _ in range(_MAX_FRAMES):
        picture, stats = render_frame()
        yield picture, stats
        if stats.settle().converged:
            return


def _converge(engine: Engine, camera: Camera, shader: TransferFunction) -> torch.Tensor:
    """Renders frames until one misses nothing; returns its colour."""
    for picture, stats in until_converged(partial(engine.frame, camera, shader)):
        if stats.converged:
            return picture.color
    raise ValueError(f"bench: nothing converged within {_MAX_FRAMES} frames")


def _cold(record: Record, scene: BenchScene, size: tuple[int, int], budget: int) -> None:
    """Measures the time from an engine that holds only the root to a picture that misses nothing:
    by `Engine.frame`, which draws every frame, and by `Engine.render`, which returns only the last;
    on CUDA also by a captured graph, with a volume that the device reads in place.
    """
    settings, camera = record.settings, scene.camera(*size)
    side = scene.volume.extent[0]
    case = f"cold start, {scene.name} {side}^3, {size[0]}x{size[1]}, {budget:,} bricks a frame"

    def by_frame(engine: Engine) -> Callable[[], list[Any]]:
        render_frame = partial(engine.frame, camera, scene.shader)
        return lambda: [stats for _, stats in until_converged(render_frame)]

    def by_render(engine: Engine) -> Callable[[], list[Any]]:
        return lambda: [engine.render(camera, scene.shader, max_frames=_MAX_FRAMES).stats]

    def by_graph(engine: Engine) -> Callable[[], list[Any]]:
        graph = engine.capture(camera, scene.shader, batch=budget)
        for tree in engine.trees.values():
            tree.producer.changed()
        engine.renew()  # drops all bricks and tiles but the root
        return lambda: [stats for _, stats in until_converged(partial(graph.replay, camera))]

    setups: dict[str, tuple[Literal["voxels", "mapped"], _Setup]] = {
        "gvtorch, frames": ("voxels", by_frame),
        "gvtorch, render": ("voxels", by_render),
    }
    if settings.device.type == "cuda":
        setups["gvtorch, mapped, captured"] = ("mapped", by_graph)
    for name, (hold, setup) in setups.items():
        times, began, all_stats = [], time.perf_counter(), list[Any]()
        for number in range(settings.repeats + 1):
            settings.tell(f"{case}, {name}: {number}")
            options: dict[str, Any] = {**(_QUICK_POOLS if settings.quick else _POOLS)}
            options |= {"load_budget": budget, "subdivide_budget": budget}
            producer = VolumeProducer(scene.volume, hold=hold)
            with Engine(producer, monitor=False, device=settings.device, **options) as engine:
                run, frames_before = setup(engine), engine.frames
                synchronize(settings.device)
                start = time.perf_counter()
                all_stats = run()
                synchronize(settings.device)
                times.append(1e3 * (time.perf_counter() - start))
                frame_count = engine.frames - frames_before
            if number and time.perf_counter() - began > settings.seconds:
                break
        if not all_stats[-1].converged:
            record.note(f"{case}: the picture did not converge within {_MAX_FRAMES} frames")
        timing = summarize(times[1:])
        bricks = sum(stats.produced["bricks"] for stats in all_stats)
        record.add(
            *(case, name, timing),
            frames=frame_count,
            bricks=bricks,
            moved_bytes=sum(stats.bytes_uploaded for stats in all_stats),
            bricks_per_second=1e3 * bricks / timing.median,
        )


class ReadyProducer(Producer):
    """A producer whose bricks are already in host memory: `fill` returns rows of one tensor."""

    def __init__(self, side: int, pinned: bool) -> None:
        """Makes as many rows as one frame may request."""
        super().__init__(side, channels={"value": Channel(torch.uint8)})
        rows = (
            torch.arange(_FRAME_ROWS, dtype=torch.int32, device="cpu")
            .remainder(251)
            .to(torch.uint8)
        )
        bricks = rows[:, None, None, None, None].expand(_FRAME_ROWS, 10, 10, 10, 1).contiguous()
        self.bricks = bricks.pin_memory() if pinned else bricks

    def fill(self, nodes: Nodes) -> Bricks:
        return Bricks(data={"value": self.bricks[: len(nodes)]})


_FRAME_ROWS, _REPLAY_ROWS = 1 << 16, 1 << 18


class MappedProducer(ReadyProducer):
    """A `ReadyProducer` whose rows the device reads from host memory, for recorded frames."""

    on_device = True

    def __init__(self, side: int, device: torch.device) -> None:
        """Page-locks and maps as many rows as a replay may request."""
        super().__init__(side, pinned=False)
        self.bricks = mapped(self.bricks.repeat(_REPLAY_ROWS // _FRAME_ROWS, 1, 1, 1, 1), device)


def stream(record: Record) -> None:
    """Measures how fast all bricks of a scene, which its producer has ready, get into an engine's
    pool: the time of the stages produce and write, or of recorded frames the stage serve. For
    comparison, one large copy from the same kind of memory.
    """
    settings = record.settings
    side = 64 if settings.quick else 512
    device = settings.device
    for pinned in (False, True) if device.type == "cuda" else (False,):
        memory = "pinned" if pinned else "pageable"
        case = f"10^3-voxel bricks, {memory} memory"
        if not record.wants(case):
            continue
        settings.tell(f"stream: {memory}")
        copy_timing, copy_rate, copy_bytes = _clock_copy(record, pinned)
        cold_starts: list[list[tuple[float, int]]] = []
        began = time.perf_counter()
        for _ in range(settings.repeats + 1):
            cold_starts.append(_load_all(side, pinned, device))
            if len(cold_starts) > 1 and time.perf_counter() - began > settings.seconds:
                break
        all_frames, without_tiles = ([run[part] for run in cold_starts[1:]] for part in (0, 1))
        results = {"gvtorch": all_frames, "gvtorch, frames without tiles": without_tiles}
        if pinned:
            producer = MappedProducer(side, device)
            repeats = range(len(cold_starts))
            results["gvtorch, recorded frames"] = [_replay(producer, device) for _ in repeats][1:]
        for who, measured in results.items():
            moved_bytes = measured[-1][1]
            if moved_bytes:
                timing: Timing = summarize([run[0] for run in measured])
                rate = 1e3 * moved_bytes / timing.median
                figures = {"moved_bytes": moved_bytes, "bytes_per_second": rate}
                record.add(case, who, timing, **figures, copy_share=rate / copy_rate)
        record.add(
            *(case, f"one {memory} copy", copy_timing),
            moved_bytes=copy_bytes,
            bytes_per_second=copy_rate,
        )
    record.note(
        "ms: the stages produce and write, over the frames of a monitored cold start that moved "
        "bricks (frames without tiles: only those that made no tiles); for recorded frames the "
        "stage serve, which also chooses the requests; copy share: the rate relative to the copy's"
    )


_VIEW = (
    Camera.orbit(30, 20, 2.0, 35, 256, 256),
    TransferFunction.from_points([(0, 0), (255, 1e-4)]),
)


def _load_options(side: int) -> dict[str, Any]:
    """Returns the options of an engine that may load all bricks of a scene at once."""
    pools = _POOLS if side > 64 else _QUICK_POOLS
    return {"load_budget": _FRAME_ROWS, "subdivide_budget": _FRAME_ROWS, **pools}


def _clock_copy(record: Record, pinned: bool) -> tuple[Timing, float, int]:
    """Returns the time, the bytes per second, and the bytes of one copy from the host."""
    settings = record.settings
    size = 1 << (20 if settings.quick else 28)
    source = torch.ones(size, dtype=torch.uint8, device="cpu")
    source = source.pin_memory() if pinned else source
    target = torch.zeros(size, dtype=torch.uint8, device=settings.device)
    timing = clock(lambda: target.copy_(source, non_blocking=pinned), settings)
    return timing, 1e3 * size / timing.median, size


def _load_all(side: int, pinned: bool, device: torch.device) -> list[tuple[float, int]]:
    """Returns (milliseconds of produce and write, bytes moved) until the view has converged: over
    the frames that moved any bytes, and over those of them that made no tiles.
    """
    milliseconds, moved = [0.0, 0.0], [0, 0]
    with Engine(ReadyProducer(side, pinned), device=device, **_load_options(side)) as engine:
        for _, stats in until_converged(partial(engine.frame, *_VIEW, lod="finest", step=2.0)):
            stage_ms = sum(stats.stages.get(name, 0.0) for name in ("produce", "write"))
            for part in (0, 1) if not stats.produced["tiles"] else (0,):
                if stats.bytes_uploaded:
                    milliseconds[part] += stage_ms
                    moved[part] += stats.bytes_uploaded
            if stats.converged:
                return [*zip(milliseconds, moved, strict=True)]
    raise ValueError(f"bench: nothing converged within {_MAX_FRAMES} frames")


def _replay(producer: MappedProducer, device: torch.device) -> tuple[float, int]:
    """Returns (milliseconds of serve, bytes moved), as `_load_all`, over the recorded frames that
    made any bricks.
    """
    with Engine(producer, device=device, **_load_options(producer.extent[0])) as engine:
        graph = engine.capture(*_VIEW, batch=_REPLAY_ROWS, lod="finest", step=2.0)
        frames: list[FrameStats] = []
        while len(frames) < 4 or not engine.steady:
            frames.append(graph.replay(_VIEW[0])[1])
            if len(frames) > _MAX_FRAMES:
                raise ValueError(f"bench: nothing converged within {_MAX_FRAMES} frames")
        producing = [s for s in frames if s.produced["bricks"]]
        brick_bytes = sum(bricks[0].nbytes for bricks in engine.cache.bricks.bricks.values())
        moved_bytes = brick_bytes * sum(s.produced["bricks"] for s in producing)
        return sum(s.stages["serve"] for s in producing), moved_bytes
