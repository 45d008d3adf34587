"""Points as a volume that is read region by region (`SplatSource`), and `splat`, which writes it
into a store with the writer of `convert`.
"""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from ..base import check
from ..base.boxes import box_of
from ..base.image_info import PREMULTIPLIED, ImageInfo
from ..base.stage import Progress, no_progress
from ..points.points import Points
from ..points.sorted import PointSource, SortedPoints, sort_points
from ..points.splat import region
from .point_file import ColumnNames, PointFile
from .source import Index, VolumeSource
from .stores.conversion import convert
from .stores.store import Store
from .stores.store_layout import WORK
from .stores.unfinished import as_json, checksum, fingerprint, is_begun, write_json

CHANNELS = ("value", "color")
_RECORD_NAME = "made_of.json"


@dataclass(frozen=True, kw_only=True)
class SplatSource(VolumeSource):
    """Sorted points, summed in the finest voxels."""

    folder: str
    identity: tuple[Any, ...]  # of points and settings: equal while these are unchanged

    @classmethod
    def of(cls, folder: Path, channel: str, **fields: Any) -> SplatSource:
        """Returns the sorted points of a folder as a volume; `fields` are path and identity."""
        _open_sorted.cache_clear()  # other points may have been there
        points = _open_sorted(str(folder))
        x, y, z = points.grid.extent
        dx, dy, dz = points.grid.spacing_3.tolist()
        channels = PREMULTIPLIED if channel == "color" else ()
        return cls(
            shape=(z, y, x, points.width),
            axes="zyxc",
            stored="float32",
            spacing=(dx, dy, dz),
            origin=points.grid.origin,
            info=ImageInfo(channels=channels, quantity=channel),
            folder=str(folder),
            **fields,
        )

    def fingerprint(self) -> list[Any]:
        return list(self.identity)

    def read_stored(self, index: Index) -> np.ndarray:
        low, high = box_of(index[:3])
        sums = region(_open_sorted(self.folder), low, high)[..., index[3]]
        with np.errstate(over="ignore"):
            return sums.astype(np.float32)


_open_sorted = functools.lru_cache(maxsize=2)(SortedPoints.open)


@dataclass(frozen=True)
class _LitPoints:
    """Points that `Points.lit` has turned into light."""

    points: PointSource
    opacity: float

    def __len__(self) -> int:
        return len(self.points)

    def blocks(self, count: int) -> Iterator[Points]:
        for part in self.points.blocks(count):
            yield part.lit(self.opacity)


def splat(
    points: str | Path | Points,
    store: str | Path,
    *,
    extent: int | Sequence[int] = 1024,
    channel: str = "value",
    opacity: float = 1e-4,
    box: Sequence[Sequence[float]] | None = None,
    memory: int | str = "1 GB",
    block: int = 32,
    executor: Executor | None = None,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress = no_progress,
    **names: Unpack[ColumnNames],
) -> Store:
    """Writes points into a store, out of core: they are sorted on disk, in the folder of the
    unfinished store, and read from there part by part. Large stores are written by worker
    processes, see `convert`.

    Args:
        points: A file as in `read_points`, or `Points`.
        store: The folder to create.
        extent, box: As in `sort_points`.
        channel: value: sums of the values in a finest voxel; color: light, as in `Points.lit`.
        opacity: Opacity of a point, for color.
        memory: Bytes that sorting takes, roughly.
        block, executor, workers, resume, progress: As in `convert`.
        **names: As in `read_points`.

    Returns:
        The open store, float32.

    Raises:
        ValueError, OSError, KeyboardInterrupt: As in `read_points`, `sort_points` and `convert`.
    """
    check.instance("splat", "store", store, str, PathLike)
    target = Path(store)
    check.one_of("splat", "channel", channel, CHANNELS)
    begun = is_begun(target, resume=resume)
    source: Any = points
    if isinstance(points, Points):
        columns = (points.positions, points.values, points.colors, points.radius)
        path, version = "points", [len(points), checksum(c for c in columns if c is not None)]
    else:
        source, path, version = PointFile(points, **names), str(points), fingerprint(points)
    settings = {"extent": extent, "box": box, "channel": channel}
    identity: list[Any] = [version, {**settings, "opacity": opacity, **names}]
    if channel == "color":
        source = _LitPoints(source, check.number("splat", "opacity", opacity, low=0, high=1))
    folder = target / WORK / "points"
    _sort(source, folder, identity, begun, extent=extent, box=box, memory=memory, progress=progress)
    volume = SplatSource.of(folder, channel, path=path, identity=tuple(identity))
    options: dict[str, Any] = {"block": block, "executor": executor, "workers": workers}
    return convert(volume, target, resume=resume, progress=progress, **options)


def _sort(
    source: PointSource, folder: Path, identity: list[Any], begun: bool, **options: Any
) -> None:
    """Sorts the points into a folder, unless it holds them already."""
    record = folder / _RECORD_NAME
    identity_json = as_json(identity)
    if record.exists() and json.loads(record.read_text(encoding="utf-8")) == identity_json:
        return
    if begun:
        raise ValueError(
            f"{folder.parent.parent}: was begun with other points or settings; "
            "remove the store to begin again"
        )
    shutil.rmtree(folder, ignore_errors=True)
    try:
        sort_points(source, folder=folder, **options)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # not empty: another process is converting to it
            folder.parent.rmdir()
            folder.parent.parent.rmdir()
        raise
    write_json(record, identity_json)
