"""The plan of a conversion and an estimate of its cost, made before anything is written."""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ...base import check
from ...base.labels import background
from ...base.volume import Volume
from ...pool.downsample import pool_majority, pool_mean
from .. import resources
from ..label_source import IndexSource
from ..oblique import Oblique
from ..reading import FormatSettings, at_place, open_source, read_whole
from ..source import MemorySource, VolumeSource, no_time
from . import shard, unfinished
from .level_reader import Pool
from .store_layout import BLOCKS, DTYPES, StoreLayout, context, kvstore

_FEW = 4  # up to this many tasks of level 0, starting processes does not pay
_PROCESS = 400 << 20  # bytes of a worker process without data
_COPIES = 12  # copies of its cube that a task holds at its peak
_BELOW = 4  # cost of a coarser level's voxel, in finest voxels
_DISK = 2.0  # time of writing to disk, relative to memory
_SAMPLES = 3  # cubes that are converted for an estimate
_SAMPLE_TIME = 2.0  # seconds after which no further cube is converted for an estimate


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
            raise ValueError(f"{source.name}: {source.data.dtype} can't be stored")
        told = {"path": source.name, "info": source.info}
        told |= {"spacing": source.spacing, "origin": source.origin}
        found = at_place(
            "convert", MemorySource.of(source.data.cpu().numpy(), **told), spacing, origin
        )
        if source.label_values is None:
            return found
        # The volume's labels are indexed already.
        return IndexSource.of(found, source.label_values.numpy(), indexed=True)
    placement: dict[str, Any] = {"spacing": spacing, "origin": origin, "oblique": oblique}
    found = open_source(source, time=time, labels=labels, **placement, **options)
    if not (found.whole and read):
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


def plan_of(
    given: str | Path | Volume | Any,
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
    return Plan(
        target=target,
        task=shard.Conversion(root=root, layout=layout, source=source, nan=nan, pool=pool),
        settings=settings,
        labels=names,
        workers=min(workers, tasks[0]),
        uses_processes=tasks[0] > _FEW,
    )


def estimate_of(plan: Plan) -> Estimate:
    layout, source = plan.task.layout, plan.task.source
    voxels = layout.times * math.prod(layout.extent)
    below = layout.voxels - voxels
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


def _task_bytes(plan: Plan) -> tuple[int, int]:
    """Returns the most bytes of memory a worker uses, and the bytes of a source in memory."""
    layout, inner = plan.task.layout, plan.task.source
    copies = _COPIES * (layout.shard + 2) ** 3 * layout.voxel_bytes
    cube = min(1.0, math.prod(layout.extent) / layout.shard**3)
    inner = inner.inner if isinstance(inner, IndexSource) else inner
    held = inner.data.nbytes if isinstance(inner, MemorySource) else 0
    own = (_PROCESS if plan.uses_processes else 0) + 2 * inner.unpacked_bytes
    return own + int(copies * cube), held


def within(plan: Plan, memory: int | str | None) -> Plan:
    """Returns the plan with at most the workers that fit into `memory`; None: into free memory."""
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
    """Converts a few cubes into memory; returns pyramid bytes, other bytes, voxels, seconds."""
    import tensorstore as ts

    layout = task.layout
    places = list(layout.places(0))  # the picks are spread over space and time
    picked = [places[(2 * i + 1) * len(places) // (2 * _SAMPLES)] for i in range(_SAMPLES)]
    root = {"driver": "memory", "path": f"gvtorch-estimate-{id(task)}/"}
    store = ts.KvStore.open(root, context=context()).result()
    trial = dataclasses.replace(task, root=root, nan=0.0 if task.nan is None else task.nan)
    shard.create_arrays(trial, 0)
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


def check_room(target: Path, needs: Estimate) -> None:
    """Raises OSError if disk or memory are too small."""
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


def _fingerprint(given: Any, source: VolumeSource) -> list[Any]:
    own = source.fingerprint()
    if own is not None:
        return own
    if isinstance(given, Volume):
        return unfinished.fingerprint(given)
    if isinstance(given, (str, Path)):
        return unfinished.fingerprint(source.path)
    told: list[Any] = [list(source.shape), source.stored]
    return told + ([unfinished.checksum([source.data])] if isinstance(source, MemorySource) else [])
