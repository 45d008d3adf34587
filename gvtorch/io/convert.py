"""`convert`: any volume -> a store, out of core, on all cores, resumable; `estimate`: its price.

One task writes one cube of one level (tasks.py); levels follow one another. A journal beside the
data names the tasks that are done. The store's own metadata is written last, so a store that is not
whole is never opened. What lies where is in layout.py, how files are read in sources.py.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..base import check
from ..base.stage import Progress, no_progress
from ..base.volume import Volume
from . import machine, tasks, workplace
from .layout import BLOCKS, WORK, Layout, context, kvstore, opened
from .levels import Deadline
from .sources import Array, Source, open_source
from .store import Store

_FEW = 4  # tasks of level 0 up to which processes are not worth their start
_AHEAD = 64  # tasks handed to an executor that does not tell how many workers it has
_PROCESS = 400 << 20  # bytes of a worker process without data
_COPIES = 12  # of a cube that a task holds at its peak
_BELOW = 4  # a voxel of a coarser level costs so many of the finest
_DISK = 2.0  # writing to disk takes so much longer than to memory
_SAMPLES = 3  # cubes that are converted for an estimate
_SAMPLE_TIME = 2.0  # seconds after which no more are


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What a conversion takes."""

    extent: tuple[int, int, int]  # x y z
    dtype: str
    channels: int
    levels: int
    tasks: int
    source_bytes: int  # of the values, unpacked
    disk_bytes: int  # of the store
    temporary_bytes: int  # beside it, while it is made
    memory_bytes: int  # of all processes together, at most
    seconds: float
    workers: int
    disk_free: int
    memory_free: int

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain values."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, kw_only=True)
class _Plan:
    source: Source | Array
    job: tasks.Job
    settings: dict[str, Any]  # what must be the same to go on with a half-written store
    workers: int


def convert(
    source: str | Path | Volume,
    store: str | Path,
    *,
    block: int = 32,
    threshold: float | None = None,
    shape: Sequence[int] | None = None,
    dtype: str | None = None,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    key: str | None = None,
    nan: float | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress = no_progress,
) -> Store:
    """Writes a store: a mean pyramid, blocks with borders, and the range of every cell.

    Larger conversions start worker processes; a script that calls this needs the usual
    `if __name__ == "__main__":` around its work.

    Args:
        source: A file or folder that `read_volume` knows, an OME-Zarr image, or a volume.
        store: The folder to make.
        block: Voxels along a side of a block, 32 or 64.
        threshold: Blocks with no value above it are not written; see `N3Tree.from_volume`.
        shape: RAW only: (x, y, z) voxels.
        dtype: RAW only: a NumPy dtype.
        spacing: (x, y, z) world units; overrides the file's.
        origin: (x, y, z) world units; overrides the file's.
        key: `.npz` only: which array.
        nan: Value for voxels that are NaN or infinite; they are refused if left out.
        executor: Runs the tasks, such as a dask client's `get_executor()`; the store's folder must
            be the same for all of its workers. A pool of processes if left out.
        workers: Number of processes of that pool; one a core if left out.
        resume: Go on with a half-written store.
        progress: Told ("converting", bytes done, bytes in all).

    Returns:
        The store, open.

    Raises:
        FileExistsError: There is something at `store` already.
        ValueError: The source is damaged or holds NaN, an argument does not fit, or `resume` finds
            a store of other settings or of a source that has changed.
        OSError: The disk is full, or source or store can't be read or written; `resume` goes on
            from there.
    """
    target = Path(store)
    begun = workplace.state(target, resume=resume)
    options = {"shape": shape, "dtype": dtype, "key": key, "nan": nan}
    source_ = _source(source, target, options, spacing, origin)
    plan = _plan(source, source_, target, block, threshold, nan, workers)
    if not begun:
        _check_room(target, _estimate(plan, target))
    with workplace.locked(target, plan.settings, resume=begun) as work:
        with _executor(executor, plan) as pool:
            job = _staged(plan, target, pool)
            try:
                _levels(job, work, pool, plan.workers, progress)
            except workplace.NotFiniteError:
                work.discard()
                raise
            except BrokenExecutor:
                raise OSError(
                    f"{target}: a worker process ended (killed, out of memory, or started by a "
                    'script that converts outside of `if __name__ == "__main__":`); '
                    f"gvtorch convert {plan.settings['source']} {target} --resume goes on"
                ) from None
        work.finish(job.layout, plan.settings, _value_range(job))
    return Store.open(target)


def estimate(
    source: str | Path | Volume,
    store: str | Path,
    *,
    block: int = 32,
    threshold: float | None = None,
    shape: Sequence[int] | None = None,
    dtype: str | None = None,
    key: str | None = None,
    nan: float | None = None,
    workers: int | None = None,
) -> Estimate:
    """Tells what `convert` would take, from a few cubes converted in memory. Writes nothing.

    Args, Raises: as `convert`.
    """
    target = Path(store)
    options = {"shape": shape, "dtype": dtype, "key": key, "nan": nan}
    source_ = _source(source, target, options, None, None)
    plan = _plan(source, source_, target, block, threshold, nan, workers)
    return _estimate(plan, target)


# --- before the work


def _source(
    source: str | Path | Volume,
    target: Path,
    options: dict[str, Any],
    spacing: Sequence[float] | None,
    origin: Sequence[float] | None,
) -> Source | Array:
    if isinstance(source, Volume):
        if source.filter != "mean":
            raise ValueError(
                "convert: a store's levels are means: a volume seen from six directions "
                "is rendered with N3Tree.from_volume or VolumeProducer"
            )
        found: Source | Array = Array.of(source)
    else:
        wants = options["key"] is not None  # an .npz, or a mistake that `read_volume` tells of
        raw = {"shape": options["shape"], "dtype": options["dtype"]}
        opened_ = None if wants else open_source(source, **raw)
        found = opened_ or Array.read(Path(source), options)
    if spacing is not None:
        size = check.triple("convert", "spacing", spacing)
        if min(size) <= 0:
            raise ValueError(f"convert: spacing must be positive, got {size}")
        found = dataclasses.replace(found, spacing=size)
    if origin is not None:
        found = dataclasses.replace(found, origin=check.triple("convert", "origin", origin))
    return found


def _plan(
    given: str | Path | Volume,
    source: Source | Array,
    target: Path,
    block: int,
    threshold: float | None,
    nan: float | None,
    workers: int | None,
) -> _Plan:
    if block not in BLOCKS:
        raise ValueError(f"convert: block must be 32 or 64, got {block!r}")
    if threshold is not None:
        threshold = check.number("convert", "threshold", threshold)
    if nan is not None:
        most = float(np.finfo(source.dtype).max) if np.dtype(source.dtype).kind == "f" else math.inf
        nan = check.number("convert", "nan", nan, low=-most, high=most)
    layout = Layout(extent=source.extent, dtype=source.dtype, width=source.width, block=block)
    if workers is None:
        workers = machine.cores()
    workers = min(check.whole("convert", "workers", workers, low=1), math.prod(_grid(layout, 0)))
    job = tasks.Job(
        root=kvstore(target), layout=layout, source=source, threshold=threshold, nan=nan
    )
    settings = {
        "source": source.path,
        "fingerprint": workplace.fingerprint(given),
        "extent": list(source.extent),
        "dtype": source.dtype,
        "channels": source.width,
        "spacing": list(source.spacing),
        "origin": list(source.origin),
        "unit": source.unit,
        "block": block,
        "threshold": threshold,
        "nan": nan,
        "tasks": sum(math.prod(_grid(layout, level)) for level in range(layout.levels)),
    }
    return _Plan(source=source, job=job, settings=settings, workers=workers)


def _grid(layout: Layout, level: int) -> tuple[int, int, int]:
    return layout.grid(level, layout.shard)


def _places(layout: Layout, level: int) -> Iterator[tuple[int, ...]]:
    return itertools.product(*map(range, _grid(layout, level)))


def _estimate(plan: _Plan, target: Path) -> Estimate:
    layout = plan.job.layout
    voxels = math.prod(layout.extent)
    below = sum(math.prod(layout.shape(level)) for level in range(1, layout.levels))
    plain, beside, seen, seconds = _sample(plan.job)
    share = (voxels + below) / seen
    copies = _COPIES * (layout.shard + 2) ** 3 * layout.width * np.dtype(layout.dtype).itemsize
    cube = min(1.0, voxels / layout.shard**3)
    processes = _uses_processes(layout)
    each = (_PROCESS if processes else 0) + int(copies * cube)
    return Estimate(
        extent=layout.extent,
        dtype=layout.dtype,
        channels=layout.width,
        levels=layout.levels,
        tasks=plan.settings["tasks"],
        source_bytes=plan.source.nbytes,
        disk_bytes=int((plain + beside) * share),
        temporary_bytes=int(2 * plain * below / seen) + _staged_bytes(plan),
        memory_bytes=_PROCESS + plan.workers * each + plan.source.resident,
        seconds=_DISK * seconds * (voxels + _BELOW * below) / seen / plan.workers + 3.0 * processes,
        workers=plan.workers,
        disk_free=shutil.disk_usage(machine.existing(target)).free,
        memory_free=machine.memory_free() + plan.source.resident,
    )


def _staged_bytes(plan: _Plan) -> int:
    return plan.source.resident if _uses_processes(plan.job.layout) else 0


def _sample(job: tasks.Job) -> tuple[int, int, int, float]:
    """Converts a few cubes in memory: bytes of the pyramid, bytes beside it, voxels, seconds."""
    import tensorstore as ts

    layout = job.layout
    places = list(_places(layout, 0))
    picked = [places[(2 * i + 1) * len(places) // (2 * _SAMPLES)] for i in range(_SAMPLES)]
    root = {"driver": "memory", "path": f"gvtorch-estimate-{id(job)}/"}
    store = ts.KvStore.open(root, context=context()).result()
    trial = dataclasses.replace(job, root=root, nan=0.0 if job.nan is None else job.nan)
    for spec in (layout.plain(0), layout.blocks(0), layout.cells(0)):
        opened(root, spec, "create").result()
    start, seen = time.perf_counter(), 0
    for place in dict.fromkeys(picked):
        seen += tasks.write_shard(trial, 0, place).voxels  # type: ignore[arg-type]
        if time.perf_counter() - start > _SAMPLE_TIME:
            break
    seconds = time.perf_counter() - start
    sizes = {name: len(store.read(name).result().value) for name in store.list().result()}
    store.delete_range(ts.KvStore.KeyRange()).result()
    plain = sum(size for name, size in sizes.items() if name.startswith(b"0/"))
    return plain, sum(sizes.values()) - plain, seen, seconds


def _check_room(target: Path, needs: Estimate) -> None:
    """Raises OSError if disk or memory are too small, before anything is written."""
    disk = needs.disk_bytes + needs.temporary_bytes
    if disk > needs.disk_free:
        raise OSError(
            f"{target}: the store takes about {machine.amount(disk)}, "
            f"{machine.amount(needs.disk_free)} are free on the disk"
        )
    if needs.memory_bytes > needs.memory_free:
        raise OSError(
            f"{target}: converting with {needs.workers} workers takes up to "
            f"{machine.amount(needs.memory_bytes)} of memory, "
            f"{machine.amount(needs.memory_free)} are free; fewer --workers take less"
        )


# --- the work


def _uses_processes(layout: Layout) -> bool:
    return math.prod(_grid(layout, 0)) > _FEW


@contextmanager
def _executor(given: Executor | None, plan: _Plan) -> Iterator[Executor]:
    if given is not None:
        yield given
        return
    if _uses_processes(plan.job.layout) and plan.workers > 1:
        import multiprocessing
        import os

        own: Executor = ProcessPoolExecutor(
            plan.workers,
            multiprocessing.get_context("spawn"),
            machine.begin_worker,
            (os.getpid(),),
        )
    else:
        own = ThreadPoolExecutor(plan.workers)
    try:
        yield own
    finally:
        own.shutdown(wait=True, cancel_futures=True)


def _staged(plan: _Plan, target: Path, pool: Executor) -> tasks.Job:
    """Writes a volume that lies in memory to a file, where other processes shall read it."""
    if isinstance(plan.source, Source) or isinstance(pool, ThreadPoolExecutor):
        return plan.job
    file = target / WORK / "source.npy"
    np.save(file, plan.source.data)
    staged = open_source(file)
    assert staged is not None
    return dataclasses.replace(plan.job, source=staged)


def _levels(
    job: tasks.Job, work: workplace.Work, pool: Executor, workers: int, progress: Progress
) -> None:
    layout = job.layout
    value = layout.width * np.dtype(layout.dtype).itemsize
    total = value * sum(math.prod(layout.shape(level)) for level in range(layout.levels))
    done = sum(voxels for voxels in work.done.values()) * value
    progress("converting", done, total)
    ahead = (
        2 * workers + 2 if isinstance(pool, (ProcessPoolExecutor, ThreadPoolExecutor)) else _AHEAD
    )
    for level in range(layout.levels):
        places = [place for place in _places(layout, level) if (level, *place) not in work.done]
        if not places:
            continue
        _create(job, level)
        bad = 0
        for result in _run(pool, job, level, places, ahead):
            bad += result.bad
            if not result.bad:
                work.note((level, *result.place), result.voxels)
                done += result.voxels * value
                progress("converting", done, total)
        if bad:
            raise workplace.NotFiniteError(
                f"{job.source.path}: {bad} values are NaN or infinite (of "
                f"{math.prod(layout.extent) * layout.width}); pass nan=VALUE (--nan VALUE) to "
                "replace them"
            )
        work.forget_bounds(level - 1)


def _create(job: tasks.Job, level: int) -> None:
    layout = job.layout
    specs = [layout.plain(level), layout.blocks(level), layout.cells(level)]
    if 0 < level < layout.levels - 1:
        specs += [layout.bound(which, level) for which in ("low", "high")]
    for spec in specs:
        Deadline(60.0).wait(opened(job.root, spec, "create"), f"{job.root['path']}{spec['path']}")


def _run(
    pool: Executor, job: tasks.Job, level: int, places: Iterable[Any], ahead: int
) -> Iterator[tasks.Done]:
    """Runs the tasks of a level, a bounded number at a time, and yields what they tell."""
    waiting = iter(places)
    running: set[Future[tasks.Done]] = set()
    try:
        while True:
            for place in itertools.islice(waiting, ahead - len(running)):
                running.add(pool.submit(tasks.write_shard, job, level, place))
            if not running:
                return
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in sorted(finished, key=lambda future: future.exception() is not None):
                yield future.result()  # first what is done, then what failed
    finally:
        for future in running:
            future.cancel()


def _value_range(job: tasks.Job) -> list[list[float]]:
    """Smallest and largest value of each channel: those of the one cell of the last level."""
    array = Deadline(60.0).wait(opened(job.root, job.layout.cells(job.layout.levels - 1)), "cells")
    cell = Deadline(60.0).wait(array.read(), "cells")[0, 0, 0]
    return [[low.item(), high.item()] for low, high in cell[:2].T]
