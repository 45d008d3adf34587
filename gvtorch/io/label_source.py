"""Prepares labels for a store: finds the distinct ones region by region, and makes sources of their
indices.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..base import boxes
from ..base.labels import NARROW, as_whole, distinct, index_dtype, indices
from .resources import cores, run_ahead
from .source import Index, MemorySource, VolumeSource

if TYPE_CHECKING:  # not at run time: it imports torch, which workers of a conversion do without
    from ..base.stage import Progress

LABELS = "labels.npy"  # in the hidden folder of an unfinished store
_CUBE_SIDE = 128  # voxels along a side of a region that is read at once


@dataclass(frozen=True, kw_only=True)
class IndexSource(VolumeSource):
    """A source of labels, (t, z, y, x, c), each replaced by its index among the distinct ones."""

    inner: VolumeSource
    labels: np.ndarray | str  # (k,) int64, or the .npy file that holds them
    indexed: bool  # the inner source holds indices already

    @classmethod
    def of(cls, inner: VolumeSource, labels: np.ndarray, *, indexed: bool = False) -> IndexSource:
        """Returns the source of the indices of a source's labels."""
        x, y, z = inner.extent
        copied = ("path", "spacing", "origin", "info", "time")
        return cls(
            shape=(inner.times, z, y, x, inner.width),
            axes="tzyxc",
            stored=index_dtype(len(labels)).name,
            inner=inner,
            labels=labels,
            indexed=indexed,
            **{name: getattr(inner, name) for name in copied},
        )

    def staged(self, folder: Path) -> IndexSource:
        """Returns a source that reads its labels from the existing file `LABELS` in the folder."""
        return replace(self, inner=self.inner.staged(folder), labels=str(folder / LABELS))

    def read_stored(self, index: Index) -> np.ndarray:
        times, (low, high) = index[0], boxes.box_of(index[1:4])
        values = self.inner.read_box(low, high, (times.start, times.stop))[..., index[4]]
        if self.indexed:
            return values
        labels = _load_labels(self.labels) if isinstance(self.labels, str) else self.labels
        values = as_whole(self.path, values)
        try:
            label_indices = indices(values, labels)
            is_unchanged = labels[label_indices.astype(np.int64)] == values
        except IndexError:
            is_unchanged = np.array(False)
        if not is_unchanged.all():
            raise OSError(f"{self.path}: changed while it was read: a label is new")
        return label_indices


_load_labels = functools.lru_cache(maxsize=2)(np.load)


def indexed_source(
    source: VolumeSource, time: int | None, workers: int | None, folder: Path, progress: Progress
) -> VolumeSource:
    """Returns a source of values as a store holds them: indices of labels; or the source itself if
    its values are no labels, are indexed already, or have at most 16 bits.

    Args:
        source: Any source.
        time: The time point that is wanted; None: all.
        workers: Threads that read, up to 8; None: one per core.
        folder: Holds `LABELS`, if that has been written before; else the whole source is read once.
        progress: Called with ("labels", regions done, regions in all).

    Raises:
        ValueError: The labels are no whole numbers, or too many.
        OSError: The source can't be read.
    """
    if not source.info.labels or isinstance(source, IndexSource) or source.dtype in NARROW:
        return source
    if isinstance(source, MemorySource):
        source = replace(source, data=as_whole(source.path, source.data))
        source = replace(source, stored=source.data.dtype.str)
    if (folder / LABELS).exists():
        return IndexSource.of(source, np.load(folder / LABELS))
    times = (0, source.times) if time is None else (source.time, source.time + 1)
    threads = min(8, cores() if workers is None else workers)
    return IndexSource.of(source, _distinct_labels(source, times, threads, progress))


def _distinct_labels(
    source: VolumeSource, times: tuple[int, int], workers: int, progress: Progress
) -> np.ndarray:
    x, y, z = source.extent
    spans = [range(*times), *(range(0, n, _CUBE_SIDE) for n in (z, y, x))]
    total = int(np.prod([len(span) for span in spans]))

    def read(corner: tuple[int, ...]) -> np.ndarray:
        time, *low = corner
        high = [min(a + _CUBE_SIDE, n) for a, n in zip(low, (z, y, x), strict=True)]
        part = source.at_time(time).read_region(low, high)
        return np.unique(as_whole(source.path, part))

    def parts() -> Iterator[np.ndarray]:
        progress("labels", 0, total)
        corners = itertools.product(*spans)
        with (
            ThreadPoolExecutor(workers) as pool,
            closing(run_ahead(pool, read, corners, 4 * workers)) as results,
        ):
            for done, part in enumerate(results, 1):
                yield part
                progress("labels", done, total)

    return distinct(source.path, parts())
