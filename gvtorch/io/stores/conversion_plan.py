"""The plan of a conversion and an estimate of its cost, made before anything is written."""

from __future__ import annotations

import dataclasses
import math
import os
import pickle
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ...base import check
from ...base.volume import Volume, movable
from .. import resources
from ..label_source import IndexSource
from ..oblique import Oblique, StraightSource
from ..reading import (
    FormatSettings,
    ObjectSource,
    open_source,
    read_time_points,
    with_placement,
)
from ..source import MemorySource, VolumeSource, check_time
from . import shard, unfinished
from .level_reader import pool_of
from .store_layout import BLOCKS, DTYPES, StoreLayout
from .tensorstores import context, kvstore

_FEW_TASKS = 4  # up to this many tasks of level 0, starting processes does not pay
_PROCESS_BYTES = 400 << 20  # bytes of a worker process without data
_COPIES = 12  # copies of its cube that a task holds at its peak
_COARSE_COST = 4  # cost of a coarser level's voxel, in finest voxels
_DISK_FACTOR = 2.0  # time of writing to disk, relative to memory
_SAMPLE_CUBES = 3  # cubes that are converted for an estimate
_SAMPLE_SECONDS = 2.0  # seconds after which no further cube is converted for an estimate


@dataclass(frozen=True, kw_only=True, repr=False)
class Estimate:
    """The estimated cost of a conversion."""

    extent: tuple[int, int, int]  # x y z
    dtype: str
    channels: int
    levels: int
    tasks: int
    source_bytes: int  # size of the values, uncompressed
    disk_bytes: int  # size of the store
    temporary_bytes: int  # further bytes on disk during the conversion
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
        """Returns the fields as plain values."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, kw_only=True)
class Plan:
    target: Path
    task: shard.Conversion
    settings: dict[str, Any]  # must be equal to resume a half-written store
    labels: np.ndarray | None  # (k,) int64, the table of indexed labels, or None
    workers: int
    uses_processes: bool
    source_files: list[Any]  # sizes and times of change of the files that are read

    def check_source(self) -> None:
        """Raises ValueError if a file of the source has changed since the plan was made."""
        if self.source_files != _source_files(self.task.source, self.target):
            raise ValueError(
                f"{self.settings['source']}: has changed while it was converted; remove "
                f"{self.target} and convert it again"
            )


def source_of(
    source: str | Path | Volume | Any,
    spacing: Sequence[float] | None,
    origin: Sequence[float] | None,
    time: int | None,
    oblique: Oblique | None,
    labels: bool,
    options: FormatSettings,
    *,
    read: bool = True,
) -> VolumeSource:
    """Opens the source. One that can only be read as a whole is read here, once, unless `read` is
    False; it then holds only the time points to be written.
    """
    check.known_options("convert", options, FormatSettings)
    given = [name for name, value in options.items() if value is not None]
    if given and isinstance(source, (VolumeSource, Volume)):
        raise ValueError(f"convert: {', '.join(given)} is for files and arrays, not for volumes")
    if isinstance(source, VolumeSource):
        return source
    if isinstance(source, Volume):
        check_time(source.name, 0 if time is None else time, 1)
        if labels and not source.info.labels:
            raise ValueError("convert: the volume must hold labels: gv.Volume(data, labels=True)")
        if source.filter == "directional":
            raise ValueError(
                "convert: a store's levels are means: a volume seen from six directions "
                "is rendered with N3Tree.from_volume or VolumeProducer"
            )
        if str(source.data.dtype).removeprefix("torch.") not in DTYPES:
            raise ValueError(f"{source.name}: {source.data.dtype} can't be stored")
        fields = {"path": source.name, "info": source.info}
        fields |= {"spacing": source.spacing, "origin": source.origin}
        values = MemorySource.of(source.data.cpu().numpy(), **fields)
        opened = with_placement("convert", values, spacing, origin)
        if source.label_values is None:
            return opened
        # The volume's labels are indexed already.
        return IndexSource.of(opened, source.label_values.numpy(), indexed=True)
    placement: dict[str, Any] = {"spacing": spacing, "origin": origin, "oblique": oblique}
    opened = open_source(source, time=time, labels=labels, **placement, **options)
    if not (opened.whole and read):
        return opened
    first, times = (0, opened.times) if time is None else (time, 1)
    needed_bytes = opened.peak_bytes + (times - 1) * opened.nbytes
    resources.check_memory(f"{source}: can only be read as a whole; unpack it first", needed_bytes)
    fields = {name: getattr(opened, name) for name in ("path", "spacing", "origin", "info")}
    return MemorySource.of(read_time_points(opened, first, times), **fields)


def plan_of(
    user_source: str | Path | Volume | Any,
    source: VolumeSource,
    target: Path,
    block: int,
    threshold: float | None,
    nan: float | None,
    time: int | None,
    workers: int | None,
) -> Plan:
    check.one_of("convert", "block", block, BLOCKS)
    if threshold is not None:
        threshold = check.number("convert", "threshold", threshold)
    if nan is not None:
        is_float = np.dtype(source.dtype).kind == "f"
        limit = float(np.finfo(source.dtype).max) if is_float else math.inf
        nan = check.number("convert", "nan", nan, low=-limit, high=limit)
    if source.info.labels and threshold is not None:
        raise ValueError("convert: threshold is for values; labels are hidden by the shader")
    labels = source.labels if isinstance(source, IndexSource) else None
    label_values = None if isinstance(labels, str) else labels
    layout = StoreLayout(
        extent=source.extent,
        dtype=source.dtype,
        width=source.width,
        block=block,
        threshold=threshold,
        times=source.times if time is None else 1,
        label_count=None if label_values is None else len(label_values),
    )
    named = len(source.info.channels)
    if named not in (0, source.width):
        raise ValueError(f"{source.path}: its info names {named} channels, it has {source.width}")
    workers = resources.cores() if workers is None else workers
    workers = check.integer("convert", "workers", workers, low=1)
    tasks = [layout.times * math.prod(layout.shards(level)) for level in range(layout.levels)]
    settings = {
        "source": source.path,
        "fingerprint": _fingerprint(user_source, source, target),
        **{name: getattr(source, name) for name in ("extent", "dtype", "spacing", "origin")},
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
    root, pool = kvstore(target), pool_of(source.info, label_values)
    return Plan(
        target=target,
        task=shard.Conversion(root=root, layout=layout, source=source, nan=nan, pool=pool),
        settings=settings,
        labels=label_values,
        workers=min(workers, tasks[0]),
        uses_processes=tasks[0] > _FEW_TASKS and _can_be_sent(source),
        source_files=_source_files(source, target),
    )


def estimate_of(plan: Plan) -> Estimate:
    layout, source = plan.task.layout, plan.task.source
    voxels = layout.times * math.prod(layout.extent)
    coarse_voxels = layout.voxels - voxels
    pyramid_bytes, other_bytes, sampled_voxels, seconds = _sample(plan.task)
    scale = (voxels + coarse_voxels) / sampled_voxels
    worker_bytes, source_bytes = _task_bytes(plan)
    staged_bytes = source_bytes if plan.uses_processes else 0
    cost, start_seconds = voxels + _COARSE_COST * coarse_voxels, 3.0 * plan.uses_processes
    target = plan.target.absolute()
    folder = next(path for path in (target, *target.parents) if path.exists())
    return Estimate(
        extent=layout.extent,
        dtype=layout.dtype,
        channels=layout.width,
        levels=layout.levels,
        tasks=plan.settings["tasks"],
        source_bytes=layout.times * source.nbytes,
        disk_bytes=int((pyramid_bytes + other_bytes) * scale),
        temporary_bytes=int(2 * pyramid_bytes * coarse_voxels / sampled_voxels) + staged_bytes,
        memory_bytes=_PROCESS_BYTES + plan.workers * worker_bytes + source_bytes,
        seconds=_DISK_FACTOR * seconds * cost / sampled_voxels / plan.workers + start_seconds,
        workers=plan.workers,
        disk_free=shutil.disk_usage(folder).free,
        memory_free=resources.memory_free() + source_bytes,
    )


def _task_bytes(plan: Plan) -> tuple[int, int]:
    """Returns the most bytes of memory a worker uses, and the bytes of a source in memory."""
    layout, source = plan.task.layout, plan.task.source
    copies = _COPIES * (layout.shard + 2) ** 3 * layout.voxel_bytes
    cube_fraction = min(1.0, math.prod(layout.extent) / layout.shard**3)
    source = _innermost(source)
    source_bytes = source.data.nbytes if isinstance(source, MemorySource) else 0
    fixed_bytes = (_PROCESS_BYTES if plan.uses_processes else 0) + 2 * source.unpacked_bytes
    return fixed_bytes + int(copies * cube_fraction), source_bytes


def fit_workers(plan: Plan, memory: int | str | None, workers: int | None) -> Plan:
    """Returns the plan with at most the workers that fit into `memory`; None: into free memory, or
    all of them if their number was given.
    """
    if memory is None and workers is not None:
        return plan
    worker_bytes, source_bytes = _task_bytes(plan)
    free = resources.memory_free() + source_bytes
    limit = free if memory is None else check.nbytes("convert", "memory", memory)
    fitting = (limit - _PROCESS_BYTES - source_bytes) // worker_bytes
    if fitting < 1 and memory is not None:
        needed = resources.amount(_PROCESS_BYTES + source_bytes + worker_bytes)
        raise ValueError(
            f"{plan.target}: memory of {resources.amount(limit)} is too little, one worker takes "
            f"{needed}"
        )
    return dataclasses.replace(plan, workers=max(1, min(plan.workers, fitting)))


def _sample(task: shard.Conversion) -> tuple[int, int, int, float]:
    """Converts a few cubes into memory; returns pyramid bytes, other bytes, voxels, seconds."""
    import tensorstore as ts

    layout = task.layout
    indices = list(layout.shard_indices(0))  # the picks are spread over space and time
    middles = [(2 * i + 1) * len(indices) // (2 * _SAMPLE_CUBES) for i in range(_SAMPLE_CUBES)]
    root = {"driver": "memory", "path": f"gvtorch-estimate-{id(task)}/"}
    store = ts.KvStore.open(root, context=context()).result()
    trial = dataclasses.replace(task, root=root, nan=0.0 if task.nan is None else task.nan)
    shard.create_arrays(trial, 0)
    start, voxels = perf_counter(), 0
    for index in dict.fromkeys(indices[middle] for middle in middles):
        voxels += shard.write_shard(trial, 0, index).voxels
        if perf_counter() - start > _SAMPLE_SECONDS:
            break
    seconds = perf_counter() - start
    sizes = {name: len(store.read(name).result().value) for name in store.list().result()}
    store.delete_range(ts.KvStore.KeyRange()).result()
    pyramid_bytes = sum(size for name, size in sizes.items() if name.startswith(b"0/"))
    return pyramid_bytes, sum(sizes.values()) - pyramid_bytes, voxels, seconds


def check_room(target: Path, estimate: Estimate) -> None:
    """Raises OSError if disk or memory are too small."""
    disk = estimate.disk_bytes + estimate.temporary_bytes
    if disk > estimate.disk_free:
        raise OSError(
            f"{target}: the store takes about {resources.amount(disk)}, "
            f"{resources.amount(estimate.disk_free)} are free on the disk"
        )
    if estimate.memory_bytes > estimate.memory_free:
        raise OSError(
            f"{target}: converting with {estimate.workers} workers takes up to "
            f"{resources.amount(estimate.memory_bytes)} of memory, "
            f"{resources.amount(estimate.memory_free)} are free; fewer --workers take less"
        )


def _fingerprint(user_source: Any, source: VolumeSource, target: Path) -> list[Any]:
    """Returns values that are equal while a source, and what is read of it, are unchanged."""
    fingerprint = source.fingerprint()
    if fingerprint is not None:
        return fingerprint
    if isinstance(user_source, Volume):
        data = movable(user_source.data).cpu().numpy()
        return [list(data.shape), str(user_source.data.dtype), unfinished.checksum([data])]
    is_file = isinstance(user_source, (str, Path))
    fields: list[Any] = [list(source.shape), source.stored]
    fields = unfinished.fingerprint(source.path, target) if is_file else fields
    source = _innermost(source)
    if isinstance(source, MemorySource):
        return [*fields, unfinished.checksum([source.data])]
    if not Path(source.path).is_dir():  # files beside the one that was named
        files = {getattr(source, "file", source.path), *getattr(source, "files", ())}
        for file in sorted(files - {source.path}):
            fields += unfinished.fingerprint(file)
    # What is read of it: the chosen array, its axes, byte order, ...
    return [*fields, zlib.crc32(repr(source).replace(source.path, "").encode())]


def _can_be_sent(source: VolumeSource) -> bool:
    """Returns whether other processes can be given a source: h5py's data sets can't be pickled."""
    inner = _innermost(source)
    if not isinstance(inner, ObjectSource):
        return True
    try:
        with open(os.devnull, "wb") as nowhere:  # what it holds in memory may be large
            pickle.dump(inner, nowhere)
    except Exception:  # of any type, as the array's library raises it
        return False
    return True


def _innermost(source: VolumeSource) -> VolumeSource:
    while isinstance(source, (IndexSource, StraightSource)):
        source = source.inner
    return source


def _source_files(source: VolumeSource, target: Path) -> list[Any]:
    """Returns sizes and times of change of the files that a source reads later; of a folder, if it
    does not name them, those of all its files.
    """
    source = _innermost(source)
    if isinstance(source, (MemorySource, ObjectSource)) or source.fingerprint() is not None:
        return []
    files = getattr(source, "files", ()) or {getattr(source, "file", source.path)}
    return [unfinished.fingerprint(f, target) for f in sorted(files) if os.path.exists(f)]
