"""`convert`: any volume -> a store, out of core, on all cores, resumable; `estimate`: its price.

One task writes one cube of one level (shard.py); levels follow one another. A journal beside the
data names the tasks that are done (unfinished.py).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import shlex
import shutil
import zlib
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Unpack

import numpy as np

from ..base import check
from ..base.labels import background
from ..base.stage import Progress, no_progress
from ..base.volume import Volume
from ..pool.downsample import pool_majority, pool_mean
from . import resources, shard, unfinished
from .label_source import IndexSource, counted_source, write_labels
from .level_reader import Pool, no_time
from .oblique import Oblique
from .reading import FormatSettings, open_source, placed, read_whole
from .source import MemorySource, VolumeSource
from .store import Store
from .store_layout import (
    BLOCKS,
    DTYPES,
    WORK,
    Deadline,
    StoreLayout,
    context,
    kvstore,
    opened,
)
from .unfinished import Done

_FEW = 4  # tasks of level 0 up to which processes are not worth their start
_AHEAD = 64  # tasks handed to an executor that does not tell how many workers it has
_PROCESS = 400 << 20  # bytes of a worker process without data
_COPIES = 12  # of a cube that a task holds at its peak
_BELOW = 4  # a voxel of a coarser level costs so many of the finest
_DISK = 2.0  # writing to disk takes so much longer than to memory
_SAMPLES = 3  # cubes that are converted for an estimate
_SAMPLE_TIME = 2.0  # seconds after which no more are
_OPEN_TIMEOUT = 60.0  # seconds
_LABELS = "labels.npy"  # beside the journal


@dataclass(frozen=True, kw_only=True, repr=False)
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

    def __repr__(self) -> str:
        extent = "x".join(str(n) for n in self.extent)
        disk, memory = resources.amount(self.disk_bytes), resources.amount(self.memory_bytes)
        return (
            f"Estimate({extent} (x, y, z), {self.dtype}x{self.channels}: {disk} on disk, "
            f"{memory} of memory, {self.seconds:.1f} s with {self.workers} workers)"
        )

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain values."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, kw_only=True)
class _Plan:
    target: Path
    task: shard.Conversion
    settings: dict[str, Any]  # what must be the same to go on with a half-written store
    workers: int
    uses_processes: bool

    @property
    def labels(self) -> np.ndarray | None:
        """(k,) int64 labels that are counted off."""
        source = self.task.source
        if not isinstance(source, IndexSource) or isinstance(source.labels, str):
            return None
        return source.labels


def convert(
    source: str | Path | Volume | VolumeSource | Any,
    store: str | Path,
    *,
    block: int = 32,
    threshold: float | None = None,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    nan: float | None = None,
    time: int | None = None,
    oblique: Oblique | None = None,
    labels: bool = False,
    executor: Executor | None = None,
    workers: int | None = None,
    memory: int | str | None = None,
    resume: bool = False,
    progress: Progress = no_progress,
    **options: Unpack[FormatSettings],
) -> Store:
    """Writes a store: a mean pyramid, blocks with borders, and the range of every cell; of all
    time points, with what the file tells of its channels and units.

    Larger conversions start worker processes; a script that calls this needs the usual
    `if __name__ == "__main__":` around its work.

    Args:
        source: A file or folder that `read_volume` knows, an OME-Zarr image, a volume, or an array
            as of `as_volume`; one of dask, zarr or h5py is computed or read part by part. Or a
            `VolumeSource`, as it is.
        store: The folder to make.
        block: Voxels along a side of a block, 32 or 64.
        threshold: Blocks with no value above it are not written; see `N3Tree.from_volume`.
        spacing: (x, y, z) world units; overrides the file's.
        origin: (x, y, z) world units; overrides the file's.
        nan: Value for voxels that are NaN or infinite; they are refused if left out.
        time: The one time point to write; all if left out.
        oblique: As of `read_volume`.
        labels: Values are numbers of things, kept exactly; also where the file says so. Those wider
            than 16 bits are counted off: all is read once before, to find which there are.
        executor: Runs the tasks, such as a dask client's `get_executor()`; the store's folder must
            be the same for all of its workers. A pool of processes if left out.
        workers: Number of processes of that pool; left out, one a core, as far as memory goes.
        memory: Most bytes of all processes, as in "2 GB": fewer workers then. Left out, all free.
        resume: Go on with a half-written store; a finished one is given as it is.
        progress: Told ("converting", bytes done, bytes in all).
        **options: shape, dtype, key and axes, as of `read_volume`.

    Returns:
        The store, open.

    Raises:
        FileExistsError: There is something at `store` already.
        ValueError: The source is damaged or holds NaN, an argument does not fit, or `resume` finds
            a store of other settings or of a source that has changed.
        OSError: The disk is full, or source or store can't be read or written; `resume` goes on
            from there.
        KeyboardInterrupt: It was interrupted; `resume` goes on, as the message says.
    """
    target = Path(store)
    if resume and unfinished.is_finished(target) and (whole := Store.open(target)).has_blocks:
        return whole
    begun = unfinished.is_begun(target, resume=resume)
    found = _source(source, spacing, origin, time, oblique, labels, options)
    found = _counted(found, target, time, workers, progress)
    plan = _plan(source, found, target, block, threshold, nan, time, workers)
    if executor is None and (memory is not None or workers is None):
        plan = _within(plan, memory)
    if not begun:
        _check_room(target, _estimate(plan))
    _write_store(plan, begun, executor, progress)
    return Store.open(target)


def estimate(
    source: str | Path | Volume | Any,
    store: str | Path,
    *,
    block: int = 32,
    threshold: float | None = None,
    nan: float | None = None,
    time: int | None = None,
    oblique: Oblique | None = None,
    labels: bool = False,
    workers: int | None = None,
    **options: Unpack[FormatSettings],
) -> Estimate:
    """Tells what `convert` would take, from a few cubes converted in memory. Writes nothing. Labels
    wider than 16 bits are all read, to find which there are.

    Args, Raises: as `convert`.
    """
    opened_source = _source(source, None, None, time, oblique, labels, options)
    target = Path(store)
    opened_source = _counted(opened_source, target, time, workers, no_progress)
    return _estimate(_plan(source, opened_source, target, block, threshold, nan, time, workers))


# --- before the work


def _source(
    source: str | Path | Volume | Any,
    spacing: Sequence[float] | None,
    origin: Sequence[float] | None,
    time: int | None,
    oblique: Oblique | None,
    labels: bool,
    options: FormatSettings,
) -> VolumeSource:
    """Opens the source; one that can only be read whole is read, once. Its time points are those
    that are written.
    """
    check.known("convert", options, FormatSettings)
    if isinstance(source, VolumeSource):
        return source
    if isinstance(source, Volume):
        if time not in (None, 0):
            raise ValueError(no_time(source.name, time, 1))
        if labels and not source.info.labels:
            raise ValueError("convert: the volume must hold labels: gv.Volume(data, labels=True)")
        if source.filter == "directional":
            raise ValueError(
                "convert: a store's levels are means: a volume seen from six directions "
                "is rendered with N3Tree.from_volume or VolumeProducer"
            )
        if str(source.data.dtype).removeprefix("torch.") not in DTYPES:
            raise ValueError(f"{source.name}: {source.data.dtype} has no place in a store")
        told = {"path": source.name, "info": source.info}
        told |= {"spacing": source.spacing, "origin": source.origin}
        found = placed("convert", MemorySource.of(source.data.numpy(), **told), spacing, origin)
        if source.label_values is None:
            return found
        # They are counted off already.
        return IndexSource.of(found, source.label_values.numpy(), indexed=True)
    placement: dict[str, Any] = {"spacing": spacing, "origin": origin, "oblique": oblique}
    found = open_source(source, time=time, labels=labels, **placement, **options)
    if not found.whole:
        return found
    first, times = (0, found.times) if time is None else (time, 1)
    free, needed = resources.memory_free(), found.peak_bytes + (times - 1) * found.nbytes
    if needed > free:
        raise ValueError(
            f"{source}: can only be read as a whole, which takes {resources.amount(needed)}, and "
            f"{resources.amount(free)} of memory are free: unpack it first"
        )
    told = {name: getattr(found, name) for name in ("path", "spacing", "origin", "info")}
    return MemorySource.of(read_whole(found, first, times), **told)


def _counted(
    source: VolumeSource,
    target: Path,
    time: int | None,
    workers: int | None,
    progress: Progress,
) -> VolumeSource:
    """Counts labels off that are wider than 16 bits."""
    if not source.info.labels or isinstance(source, IndexSource):
        return source
    times = (0, source.times) if time is None else (source.time, source.time + 1)
    threads = min(8, resources.cores() if workers is None else workers)
    return counted_source(source, times, threads, target / WORK / _LABELS, progress)


def _plan(
    given: str | Path | Volume | Any,
    source: VolumeSource,
    target: Path,
    block: int,
    threshold: float | None,
    nan: float | None,
    time: int | None,
    workers: int | None,
) -> _Plan:
    if block not in BLOCKS:
        raise ValueError(f"convert: block must be 32 or 64, got {block!r}")
    if threshold is not None:
        threshold = check.number("convert", "threshold", threshold)
    if nan is not None:
        most = float(np.finfo(source.dtype).max) if np.dtype(source.dtype).kind == "f" else math.inf
        nan = check.number("convert", "nan", nan, low=-most, high=most)
    if source.info.labels and threshold is not None:
        raise ValueError("convert: threshold is for values; labels are hidden by the shader")
    known = source.labels if isinstance(source, IndexSource) else None
    names = None if isinstance(known, str) else known
    layout = StoreLayout(
        extent=source.extent,
        dtype=source.dtype,
        width=source.width,
        block=block,
        threshold=threshold,
        times=source.times if time is None else 1,
        label_count=None if names is None else len(names),
    )
    told_channels = len(source.info.channels)
    if told_channels not in (0, source.width):
        raise ValueError(
            f"{source.path}: its info names {told_channels} channels, it has {source.width}"
        )
    workers = resources.cores() if workers is None else workers
    workers = check.whole("convert", "workers", workers, low=1)
    tasks = [layout.times * math.prod(layout.shards(level)) for level in range(layout.levels)]
    told = ("extent", "dtype", "spacing", "origin")
    settings = {
        "source": source.path,
        "fingerprint": _fingerprint(given, source),
        **{name: getattr(source, name) for name in told},
        "unit": source.info.unit,
        "times": layout.times,
        "time": source.time,
        "channels": source.width,
        "block": block,
        "threshold": threshold,
        "nan": nan,
        "labels": source.info.labels,
        "tasks": sum(tasks),
    }
    pool: Pool = pool_mean
    if source.info.labels:
        pool = partial(pool_majority, background=background(names))
    root = kvstore(target)
    return _Plan(
        target=target,
        task=shard.Conversion(root=root, layout=layout, source=source, nan=nan, pool=pool),
        settings=settings,
        workers=min(workers, tasks[0]),
        uses_processes=tasks[0] > _FEW,
    )


def _places(layout: StoreLayout, level: int) -> Iterator[shard.Place]:
    times = [layout.times] if layout.times > 1 else []
    return itertools.product(*map(range, (*times, *layout.shards(level))))


def _estimate(plan: _Plan) -> Estimate:
    layout, source = plan.task.layout, plan.task.source
    voxels = layout.times * math.prod(layout.extent)
    below = _voxels(layout) - voxels
    plain, beside, seen, seconds = _sample(plan.task)
    share = (voxels + below) / seen
    each, held = _task_bytes(plan)
    staged = held if plan.uses_processes else 0
    start = 3.0 * plan.uses_processes
    target = plan.target.absolute()
    folder = next(path for path in (target, *target.parents) if path.exists())
    return Estimate(
        extent=layout.extent,
        dtype=layout.dtype,
        channels=layout.width,
        levels=layout.levels,
        tasks=plan.settings["tasks"],
        source_bytes=layout.times * source.nbytes,
        disk_bytes=int((plain + beside) * share),
        temporary_bytes=int(2 * plain * below / seen) + staged,
        memory_bytes=_PROCESS + plan.workers * each + held,
        seconds=_DISK * seconds * (voxels + _BELOW * below) / seen / plan.workers + start,
        workers=plan.workers,
        disk_free=shutil.disk_usage(folder).free,
        memory_free=resources.memory_free() + held,
    )


def _task_bytes(plan: _Plan) -> tuple[int, int]:
    """Bytes of memory that a worker takes at most, and those of a source in memory."""
    layout, inner = plan.task.layout, plan.task.source
    copies = _COPIES * (layout.shard + 2) ** 3 * layout.voxel_bytes
    cube = min(1.0, math.prod(layout.extent) / layout.shard**3)
    inner = inner.inner if isinstance(inner, IndexSource) else inner
    held = inner.data.nbytes if isinstance(inner, MemorySource) else 0
    own = (_PROCESS if plan.uses_processes else 0) + 2 * inner.unpacked_bytes
    return own + int(copies * cube), held


def _within(plan: _Plan, memory: int | str | None) -> _Plan:
    """Takes no more workers than fit into some bytes of memory; None: into what is free."""
    each, held = _task_bytes(plan)
    free = resources.memory_free() + held
    limit = free if memory is None else check.nbytes("convert", "memory", memory)
    fitting = (limit - _PROCESS - held) // each
    if fitting < 1 and memory is not None:
        given, least = (resources.amount(n) for n in (limit, _PROCESS + held + each))
        raise ValueError(
            f"{plan.target}: memory of {given} is too little, one worker takes {least}"
        )
    return dataclasses.replace(plan, workers=max(1, min(plan.workers, fitting)))


def _sample(task: shard.Conversion) -> tuple[int, int, int, float]:
    """Converts a few cubes in memory: bytes of the pyramid, bytes beside it, voxels, seconds."""
    import tensorstore as ts

    layout = task.layout
    places = list(_places(layout, 0))  # spread over space, and over time
    picked = [places[(2 * i + 1) * len(places) // (2 * _SAMPLES)] for i in range(_SAMPLES)]
    root = {"driver": "memory", "path": f"gvtorch-estimate-{id(task)}/"}
    store = ts.KvStore.open(root, context=context()).result()
    trial = dataclasses.replace(task, root=root, nan=0.0 if task.nan is None else task.nan)
    _create_arrays(trial, 0)
    start, seen = perf_counter(), 0
    for place in dict.fromkeys(picked):
        seen += shard.write_shard(trial, 0, place).voxels
        if perf_counter() - start > _SAMPLE_TIME:
            break
    seconds = perf_counter() - start
    sizes = {name: len(store.read(name).result().value) for name in store.list().result()}
    store.delete_range(ts.KvStore.KeyRange()).result()
    plain = sum(size for name, size in sizes.items() if name.startswith(b"0/"))
    return plain, sum(sizes.values()) - plain, seen, seconds


def _check_room(target: Path, needs: Estimate) -> None:
    """Raises OSError if disk or memory are too small, before anything is written."""
    disk = needs.disk_bytes + needs.temporary_bytes
    if disk > needs.disk_free:
        raise OSError(
            f"{target}: the store takes about {resources.amount(disk)}, "
            f"{resources.amount(needs.disk_free)} are free on the disk"
        )
    if needs.memory_bytes > needs.memory_free:
        raise OSError(
            f"{target}: converting with {needs.workers} workers takes up to "
            f"{resources.amount(needs.memory_bytes)} of memory, "
            f"{resources.amount(needs.memory_free)} are free; fewer --workers take less"
        )


# --- the work


def _write_store(plan: _Plan, begun: bool, executor: Executor | None, progress: Progress) -> None:
    """Writes what is not there yet: levels, labels, and last the metadata that make it a store."""
    task, settings = plan.task, plan.settings
    with _told_how_to_go_on(plan), unfinished.claimed(plan.target, settings, resume=begun) as work:
        if plan.labels is not None:
            write_labels(plan.target / WORK / _LABELS, plan.labels)
        with _executor(executor, plan) as pool:
            _write_levels(_staged(plan, pool), work, pool, progress)
        if plan.labels is not None:
            _write_label_array(task, plan.labels)
        layout = dataclasses.replace(task.layout, value_range=_value_range(task))
        work.finish(layout, task.source.info, settings)


def _executor(given: Executor | None, plan: _Plan) -> AbstractContextManager[Executor]:
    if given is not None:
        return nullcontext(given)
    if plan.uses_processes and plan.workers > 1:
        return resources.worker_processes(plan.workers)
    return ThreadPoolExecutor(plan.workers)


def _fingerprint(given: Any, source: VolumeSource) -> list[Any]:
    own = source.fingerprint()
    if own is not None:
        return own
    if isinstance(given, Volume):
        return unfinished.fingerprint(given)
    if isinstance(given, (str, Path)):
        return unfinished.fingerprint(source.path)
    told: list[Any] = [list(source.shape), source.stored]
    return told + ([zlib.crc32(source.data.tobytes())] if isinstance(source, MemorySource) else [])


@contextmanager
def _told_how_to_go_on(plan: _Plan) -> Iterator[None]:
    """Tells how to resume where the work is broken off from outside."""
    target = plan.target
    command = shlex.join((*plan.task.source.command(str(target)), "--resume"))
    try:
        yield
    except BrokenExecutor:
        raise OSError(
            f"{target}: a worker process ended (killed, out of memory, or started by a script "
            f'that converts outside of `if __name__ == "__main__":`); {command} goes on'
        ) from None
    except KeyboardInterrupt:
        done = unfinished.count_done(target)
        raise KeyboardInterrupt(
            f"{target}: interrupted, {done} of {plan.settings['tasks']} shards are done; "
            f"{command} goes on"
        ) from None


def _staged(plan: _Plan, pool: Executor) -> _Plan:
    """Writes what lies in memory to files, where other processes shall read it."""
    if isinstance(pool, ThreadPoolExecutor):
        return plan
    source = plan.task.source
    if isinstance(source, IndexSource):
        inner = _in_file(plan, source.inner)
        source = dataclasses.replace(source, inner=inner).in_file(plan.target / WORK / _LABELS)
    else:
        source = _in_file(plan, source)
    return dataclasses.replace(plan, task=dataclasses.replace(plan.task, source=source))


def _in_file(plan: _Plan, source: VolumeSource) -> VolumeSource:
    if not isinstance(source, MemorySource):
        return source.staged(plan.target / WORK)
    file = plan.target / WORK / "source.npy"
    np.save(file, source.data)
    axes = "tzyxc"[-source.data.ndim :]
    return dataclasses.replace(open_source(file, axes=axes), info=source.info)


def _write_levels(
    plan: _Plan, work: unfinished.UnfinishedStore, pool: Executor, progress: Progress
) -> None:
    layout = plan.task.layout
    total = _voxels(layout) * layout.voxel_bytes
    done = sum(one.voxels for one in work.done.values()) * layout.voxel_bytes
    progress("converting", done, total)
    counted = isinstance(pool, (ProcessPoolExecutor, ThreadPoolExecutor))
    ahead = 2 * plan.workers + 2 if counted else _AHEAD
    for level in range(layout.levels):
        places = [place for place in _places(layout, level) if (level, *place) not in work.done]
        if not places:
            continue
        _create_arrays(plan.task, level)
        bad = 0
        with closing(_run(pool, plan.task, level, places, ahead)) as results:
            for result in results:
                bad += result.bad
                if not result.bad:
                    work.note({(level, *result.place): Done(result.voxels, result.files)})
                    done += result.voxels * layout.voxel_bytes
                    progress("converting", done, total)
        if bad:
            shutil.rmtree(plan.target, ignore_errors=True)
            raise ValueError(
                f"{plan.settings['source']}: {bad} values are NaN or infinite (of "
                f"{layout.times * math.prod(layout.extent) * layout.width}); pass nan=VALUE "
                "(--nan VALUE) to replace them"
            )
        for which in ("low", "high"):  # the bounds below are not needed any more
            folder = plan.target / WORK / which / str(level - 1)
            shutil.rmtree(folder, ignore_errors=True)


def _create_arrays(task: shard.Conversion, level: int) -> None:
    layout = task.layout
    arrays = (layout.plain(level), layout.blocks(level), layout.cells(level))
    for spec in (*arrays, *layout.bounds(level)):
        where = f"{task.root['path']}{spec['path']}"
        Deadline(_OPEN_TIMEOUT).wait(opened(task.root, spec, "create"), where)


def _write_label_array(task: shard.Conversion, labels: np.ndarray) -> None:
    spec = task.layout.labels()
    Deadline(_OPEN_TIMEOUT).wait(opened(task.root, spec, "create"), spec["path"])
    shard.finish(shard.write(task.root, spec, [0], labels), task.root.get("path", "store"))


def _run(
    pool: Executor, task: shard.Conversion, level: int, places: Iterable[Any], ahead: int
) -> Generator[shard.ShardResult, None, None]:
    """Runs the tasks of a level, a bounded number at a time, and yields what they tell."""
    waiting = iter(places)
    running: set[Future[shard.ShardResult]] = set()
    try:
        while True:
            for at in itertools.islice(waiting, ahead - len(running)):
                running.add(pool.submit(shard.write_shard, task, level, at))
            if not running:
                return
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in sorted(finished, key=lambda future: future.exception() is not None):
                yield future.result()  # first what is done, then what failed
    finally:
        for future in running:
            future.cancel()


def _value_range(task: shard.Conversion) -> list[list[float]]:
    """Smallest and largest value of each channel, of all times: of the last level's one cell."""
    deadline = Deadline(_OPEN_TIMEOUT)
    spec = task.layout.cells(task.layout.levels - 1)
    cells = deadline.wait(deadline.wait(opened(task.root, spec), "cells").read(), "cells")
    cells = cells.reshape(-1, 3, task.layout.width)
    lows, highs = cells[:, 0].min(0), cells[:, 1].max(0)
    return [[low.item(), high.item()] for low, high in zip(lows, highs, strict=True)]


def _voxels(layout: StoreLayout) -> int:
    """Voxels of all levels and times."""
    return layout.times * sum(math.prod(layout.shape(level)) for level in range(layout.levels))
