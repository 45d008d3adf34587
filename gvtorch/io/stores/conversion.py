"""`convert`: any volume -> a store, out of core, on all cores, resumable; `estimate`: its cost.

One task writes one cube of one level (shard.py); levels are written one after the other, the finest
first. A journal in the store's folder lists the finished tasks (unfinished.py).
"""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any, Unpack

from ...base.stage import Progress, no_progress
from ...base.volume import Volume
from ...base.whole_file import durable_file, write_npy
from .. import resources
from ..label_source import LABELS, indexed_source
from ..oblique import Oblique
from ..reading import FormatSettings
from ..source import VolumeSource
from . import shard, unfinished
from .conversion_plan import (
    Estimate,
    Plan,
    check_room,
    estimate_of,
    fit_workers,
    plan_of,
    source_of,
)
from .store import Store
from .store_layout import JOURNAL, RESUME_ADVICE, WORK
from .tensorstores import LOCAL_TIMEOUT, Deadline, open_array

_TASKS_AHEAD = 64  # tasks submitted at a time to an executor whose number of workers is unknown


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
    """Writes a store: a mean pyramid, blocks with borders, and the range of every cell, for all
    time points, with the file's metadata on channels and units. Larger conversions start worker
    processes: a script that calls this needs the usual `if __name__ == "__main__":`.

    Args:
        source: A file or folder that `read_volume` reads, an OME-Zarr image, a volume, or an array
            as for `as_volume`; dask, zarr and h5py arrays are computed or read part by part. Or a
            `VolumeSource`, used as it is.
        store: The folder to create.
        block: Voxels along a side of a block, 32 or 64.
        threshold: Blocks with no value above it are not written; see `N3Tree.from_volume`.
        spacing, origin: (x, y, z) world units; override the file's.
        nan: Value for voxels that are NaN or infinite; they are an error if left out.
        time: The one time point to write; all if left out.
        oblique: As for `read_volume`.
        labels: Values are label numbers, kept exactly; also if the file says so. Labels wider than
            16 bits are indexed: the whole source is read once before, to list them.
        executor: Runs the tasks, such as a dask client's `get_executor()`; all of its workers must
            see the store's folder under the same path. A pool of processes if left out.
        workers: Number of processes in that pool. If left out, one per core, as memory permits.
        memory: Most bytes of all processes, as in "2 GB"; limits the workers. Left out, all free.
        resume: Continue a half-written store. A finished one is returned as it is, if its grid,
            times, dtype, block and threshold are those requested; its voxels are not compared.
        progress: Called with ("converting", bytes done, bytes in all).
        **options: shape, dtype, offset, key and axes, as for `read_volume`.

    Returns:
        The store, open.

    Raises:
        FileExistsError: There is something at `store` already.
        ValueError: The source is damaged, holds NaN or changes meanwhile, an argument is invalid,
            or `resume` finds a store of other settings or of a source that has changed.
        OSError: The disk is full, or a file can't be read or written; `resume` continues.
        KeyboardInterrupt: It was interrupted; `resume` continues, as the message says.
    """
    target = Path(store)
    make_source = partial(source_of, source, spacing, origin, time, oblique, labels, options)
    if resume and (finished := _finished(target, make_source, time, block, threshold)):
        return finished
    begun = unfinished.is_begun(target, resume=resume)
    prepared = indexed_source(make_source(), time, workers, target / WORK, progress)
    plan = plan_of(source, prepared, target, block, threshold, nan, time, workers)
    if executor is None:
        plan = fit_workers(plan, memory, workers)
    if not begun:
        check_room(target, estimate_of(plan))
    _write_store(plan, begun, executor, progress)
    return Store.open(target)


def _finished(
    target: Path,
    make_source: Callable[..., VolumeSource],
    time: int | None,
    block: int,
    threshold: float | None,
) -> Store | None:
    """Returns the store if it is finished; raises ValueError if another one would be written."""
    if not unfinished.is_finished(target) or not (store := Store.open(target)).has_blocks:
        return None
    with suppress(FileNotFoundError):  # the source may be gone once the store is finished
        source = make_source(read=False)
        _check_same(store, source, source.times if time is None else 1, block, threshold)
    shutil.rmtree(target / WORK, ignore_errors=True)  # left if it was killed in its last step
    return store


def _check_same(
    store: Store, source: VolumeSource, times: int, block: int, threshold: float | None
) -> None:
    """Raises ValueError if a finished store differs from the one that would be written."""
    is_labels = source.info.labels
    for name, stored, requested in (
        ("extent", store.layout.extent, source.extent),
        ("spacing", store.spacing, source.spacing),
        ("origin", store.origin, source.origin),
        ("times", store.times, times),
        ("channels", store.layout.width, source.width),
        ("labels", store.info.labels, is_labels),
        ("dtype", None if is_labels else store.layout.dtype, None if is_labels else source.dtype),
        ("block", store.block, block),
        ("threshold", store.threshold, threshold),
    ):
        if stored != requested:
            raise ValueError(
                f"{store.location}: is finished, with {name} {stored!r}, now it is {requested!r}; "
                "remove the store to make it again"
            )


def estimate(
    source: str | Path | Volume | Any,
    store: str | Path,
    *,
    block: int = 32,
    threshold: float | None = None,
    spacing: Sequence[float] | None = None,
    nan: float | None = None,
    time: int | None = None,
    oblique: Oblique | None = None,
    labels: bool = False,
    workers: int | None = None,
    memory: int | str | None = None,
    **options: Unpack[FormatSettings],
) -> Estimate:
    """Returns the estimated cost of `convert`, from a few cubes converted in memory. Writes
    nothing. Reads the whole source to list its labels if they are wider than 16 bits.

    Args, Raises: as `convert`.
    """
    target = Path(store)
    prepared = source_of(source, spacing, None, time, oblique, labels, options)
    prepared = indexed_source(prepared, time, workers, target / WORK, no_progress)
    plan = plan_of(source, prepared, target, block, threshold, nan, time, workers)
    return estimate_of(fit_workers(plan, memory, workers))


def _write_store(plan: Plan, begun: bool, executor: Executor | None, progress: Progress) -> None:
    """Writes what is missing: levels, labels, and last the metadata that completes the store."""
    task, settings = plan.task, plan.settings
    with (
        _explain_resume(plan),
        unfinished.claimed(plan.target, settings, resume=begun) as unfinished_store,
    ):
        if plan.labels is not None:
            with durable_file(plan.target / WORK / LABELS) as file:
                write_npy(file, plan.labels)
        with _open_executor(executor, plan) as pool:
            if not isinstance(pool, ThreadPoolExecutor):  # other processes have to read the source
                source = task.source.staged(plan.target / WORK)
                task = dataclasses.replace(task, source=source)
            _write_levels(plan, task, unfinished_store, pool, progress)
        plan.check_source()
        if plan.labels is not None:
            shard.write_label_array(task, plan.labels)
        layout = dataclasses.replace(task.layout, value_range=_value_range(task))
        unfinished_store.finish(layout, task.source.info, settings)


def _open_executor(executor: Executor | None, plan: Plan) -> AbstractContextManager[Executor]:
    if executor is not None:
        return nullcontext(executor)
    if plan.uses_processes and plan.workers > 1:
        return resources.worker_processes(plan.workers)
    return ThreadPoolExecutor(plan.workers)


@contextmanager
def _explain_resume(plan: Plan) -> Iterator[None]:
    """Adds how to resume to the error when a worker ends or the user interrupts."""
    target = plan.target
    try:
        yield
    except BrokenExecutor:
        raise OSError(
            f"{target}: a worker process ended (killed, out of memory, or started by a script "
            f'that converts outside of `if __name__ == "__main__":`); {RESUME_ADVICE}'
        ) from None
    except KeyboardInterrupt:
        journal = target / WORK / JOURNAL
        done = journal.read_bytes().count(b"\n") if journal.exists() else 0
        raise KeyboardInterrupt(
            f"{target}: interrupted, {done} of {plan.settings['tasks']} shards are done; "
            f"{RESUME_ADVICE}"
        ) from None


def _write_levels(
    plan: Plan,
    task: shard.Conversion,
    unfinished_store: unfinished.UnfinishedStore,
    pool: Executor,
    progress: Progress,
) -> None:
    layout = task.layout
    total = layout.voxels * layout.voxel_bytes
    done = sum(finished.voxels for finished in unfinished_store.done.values()) * layout.voxel_bytes
    progress("converting", done, total)
    knows_workers = isinstance(pool, (ProcessPoolExecutor, ThreadPoolExecutor))
    ahead = 2 * plan.workers + 2 if knows_workers else _TASKS_AHEAD
    for level in range(layout.levels):
        tasks, done_tasks = layout.shard_indices(level), unfinished_store.done
        indices = [index for index in tasks if (level, *index) not in done_tasks]
        if not indices:
            continue
        shard.create_arrays(task, level)
        bad_values, write = 0, partial(shard.write_shard, task, level)
        with closing(resources.run_ahead(pool, write, indices, ahead)) as results:
            for result in results:
                bad_values += result.bad_values
                if not result.bad_values:
                    unfinished_store.record({(level, *result.shard_index): result})
                    done += result.voxels * layout.voxel_bytes
                    progress("converting", done, total)
        if bad_values:
            unfinished_store.discard()
            raise ValueError(
                f"{plan.settings['source']}: {bad_values} values are NaN or infinite (of "
                f"{layout.times * math.prod(layout.extent) * layout.width}); pass nan=VALUE "
                "(--nan VALUE) to replace them"
            )
        for spec in layout.bounds(level - 1):  # those of the level below are no longer needed
            shutil.rmtree(plan.target / spec["path"], ignore_errors=True)


def _value_range(task: shard.Conversion) -> list[list[float]]:
    """Returns [low, high] of each channel over all times, from the last level: a single cell."""
    spec = task.layout.cells(task.layout.levels - 1)
    future = open_array(task.root, spec).read()
    cells = Deadline(LOCAL_TIMEOUT).wait(future, f"{task.root['path']}{spec['path']}")
    cells = cells.reshape(-1, 3, task.layout.width)
    lows, highs = cells[:, 0].min(0), cells[:, 1].max(0)
    return [[low.item(), high.item()] for low, high in zip(lows, highs, strict=True)]
