"""`window`: the values that a picture shows dark and bright, from percentiles of the data.

The full range of the data is seldom useful: one hot voxel makes all others dark, and most of a scan
is the air around it. The background, if there is one, is the highest peak of the histogram.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ..base import check
from ..base.boxes import Zyx
from ..base.downsample import pool_mean
from ..base.volume import Volume, to_numpy
from .stores.store import Store

_SAMPLE_VOXELS = 2**22  # voxels in the sample
_BOXES_PER_AXIS = 4  # boxes of the sample along each axis
_MAX_BINS = 64  # of the histogram, at most: values of a scan may have gaps
_BACKGROUND_FRACTION = 0.25  # share of all values that makes the highest peak the background
_TAIL_PERCENT = 1.0  # percent of the values that lie beyond each end of the window


def window(
    data: Volume | Store,
    percent: tuple[float, float] | None = None,
    *,
    component: int = 0,
    background: bool = False,
) -> tuple[float, float]:
    """Returns the values to show dark and bright, for `TransferFunction.preset` for example.

    Large data is sampled: a coarse level of at most 4 million voxels, or boxes with as many voxels
    in total. A volume and a store made from it have the same window.

    Args:
        data: A volume, or a store, of which only the sample is read.
        percent: Percentiles of all values, as in (1, 99). If left out, a background is looked for:
            a quarter or more of the values, close together in the lower half. The window goes from
            the end of the background to the 99th percentile of the values above; without a
            background, from the 1st to the 99th percentile of all values.
        component: Index of the component, if voxels hold several numbers.
        background: Shows the background too: the low end is the 1st percentile of all values, as
            pictures of slices need it.

    Raises:
        ValueError: There is no such component, or the percentiles are out of range or order.
    """
    check.instance("window", "data", data, Volume, Store)
    if percent is not None:
        is_pair = isinstance(percent, (tuple, list)) and len(percent) == 2
        ends = percent if is_pair else (0, 0)
        low, high = (check.number("window", "percent", p, low=0, high=100) for p in ends)
        if low >= high:
            raise ValueError(f"window: percent must be a low and a high one, got {percent!r}")
    check.integer("window", "component", component, low=0, high=data.width - 1)
    values = sample_values(data)[..., component].ravel()
    if percent is not None:
        return _nonempty_window(*np.percentile(values, percent))
    low, high = np.percentile(values, (_TAIL_PERCENT, 100 - _TAIL_PERCENT))
    edge = _background(values)
    if edge is not None:
        low = low if background else edge
        high = np.percentile(values[values > edge], 100 - _TAIL_PERCENT)
    return _nonempty_window(low, high)


def windows(
    data: Volume | Store, percent: tuple[float, float], components: Sequence[int]
) -> list[tuple[float, float]]:
    """Returns the `window` of several components, between the same percentiles (not checked). If
    both percentiles of a component are the same value, its window ends at its largest value.
    """
    values, spans = sample_values(data), []
    for component in components:
        low, high = np.percentile(values[..., component], percent)
        spans.append(_nonempty_window(low, high if high > low else values[..., component].max()))
    return spans


def value_range(data: Volume | Store) -> tuple[float, float]:
    """Returns the smallest and the largest value. Images that were not written by gvtorch do not
    store them: for these the sample of `window` is read, whose range is a little narrower.
    """
    if isinstance(data, Volume):
        return data.value_range
    if data.value_range is not None:
        return min(low for low, _ in data.value_range), max(high for _, high in data.value_range)
    values = sample_values(data)
    return float(values.min()), float(values.max())


def _nonempty_window(low: float, high: float) -> tuple[float, float]:
    """Returns the window, widened if it is empty."""
    low, high = float(low), float(high)
    return (low, high) if high > low else (low, low + max(1.0, 1e-6 * abs(low)))


def sample_values(data: Volume | Store) -> np.ndarray:
    """Returns a sample of the values, (..., c)."""
    if isinstance(data, Volume):
        values = to_numpy(data.data)
        while values[..., 0].size > _SAMPLE_VOXELS:
            values = pool_mean(values, 2)
        return values
    sizes = [data.level_extent(level)[::-1] for level in range(data.levels)]
    fitting = (level for level, size in enumerate(sizes) if np.prod(size) <= _SAMPLE_VOXELS)
    # Others than stored levels would be averaged from all of a finer level.
    level = data.stored_level(next(fitting, data.levels - 1))
    parts = [data.read_region(level, *box) for box in _boxes(sizes[level])]
    return np.concatenate([part.reshape(-1, data.width) for part in parts])


def _boxes(size: Zyx) -> list[tuple[Zyx, Zyx]]:
    """Returns a box that is all of a level, or evenly spaced ones of `_SAMPLE_VOXELS` in total."""
    if np.prod(size) <= _SAMPLE_VOXELS:
        return [((0, 0, 0), size)]
    fraction = (_SAMPLE_VOXELS / np.prod(size)) ** (1 / 3)
    spans = []
    for n in size:
        side = max(1, int(n * fraction / _BOXES_PER_AXIS))
        middles = [(2 * i + 1) * n // (2 * _BOXES_PER_AXIS) for i in range(_BOXES_PER_AXIS)]
        spans.append([(max(0, m - side // 2), max(0, m - side // 2) + side) for m in middles])
    corners = (zip(*box, strict=True) for box in itertools.product(*spans))
    return [(low, high) for low, high in corners]


def _background(values: np.ndarray) -> float | None:
    """Returns the value at which the background ends: twice as far above the peak of the histogram
    as the value where the count is down to half; None if there is no background, or nothing else.
    """
    low, high = (float(end) for end in np.percentile(values, (0.01, 99.99)))
    step = (high - low) / int(np.clip(values.size**0.5 / 2, 16, _MAX_BINS))
    if values.dtype.kind in "iu":
        step = max(1.0, np.ceil(step))
    if high > low:
        bins = int((high - low) / step) + 1
        counts = np.bincount(np.clip((values - low) / step, 0, bins - 1).astype(np.int64))
        peak = int(counts.argmax())
        if peak > bins / 2:
            return None
        below_half = np.flatnonzero(counts[peak:] < counts[peak] / 2)
        half_width = int(below_half[0]) if len(below_half) else bins
        edge = low + (peak + 2 * half_width - 1) * step
    else:
        edge = low
    fraction = np.count_nonzero(values <= edge) / values.size
    return edge if _BACKGROUND_FRACTION <= fraction < 1 else None
