"""Smooth interpolation between keys: piecewise cubics that stay between the values of two
neighbouring keys, so that a range that holds at the keys also holds between them.

Source: Fritsch and Butland, "A method for constructing local monotone piecewise cubic
interpolants", 1984.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np


class Smooth:
    """An array of numbers as a smooth function of time."""

    def __init__(self, times: Sequence[float], values: Sequence[np.ndarray], closed: bool) -> None:
        """Takes the keys: increasing times, and for each an array (float64, all of one shape).
        `closed`: the last key equals the first, and the curve passes smoothly through it.
        """
        self._times = list(times)
        self._values = np.stack([np.asarray(value, np.float64) for value in values])
        spans = np.diff(np.asarray(times, np.float64))
        spans = spans.reshape(-1, *[1] * (self._values.ndim - 1))
        steps = np.diff(self._values, axis=0) / spans
        slopes = np.zeros_like(self._values)
        if len(steps) > 1:
            slopes[1:-1] = _slope(steps[:-1], steps[1:], spans[:-1], spans[1:])
        if len(steps):
            ends = steps[0], steps[-1]
            if closed and len(steps) > 1:
                ends = (_slope(steps[-1], steps[0], spans[-1], spans[0]),) * 2
            slopes[0], slopes[-1] = ends
        self._slopes = slopes

    def at(self, time: float) -> np.ndarray:
        """Returns the array at a time; the first before the first key, the last after the last."""
        n = bisect_right(self._times, time) - 1
        if n < 0 or n >= len(self._times) - 1:
            return self._values[max(n, 0)]
        span = self._times[n + 1] - self._times[n]
        s = (time - self._times[n]) / span
        a, b = self._values[n : n + 2]
        slope_a, slope_b = span * self._slopes[n : n + 2]
        bend = s * (1 - s) * ((1 - s) * slope_a - s * slope_b)
        smooth = a + s * s * (3 - 2 * s) * (b - a) + bend
        # Rounding may leave the span.
        return np.clip(smooth, np.minimum(a, b), np.maximum(a, b))


def _slope(
    before: np.ndarray, after: np.ndarray, span_before: np.ndarray, span_after: np.ndarray
) -> np.ndarray:
    """Returns slopes at keys: weighted harmonic means of both sides' slopes, 0 if signs differ."""
    same_sign = before * after > 0
    weight_before, weight_after = 2 * span_after + span_before, span_after + 2 * span_before
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (weight_before + weight_after) / (weight_before / before + weight_after / after)
    return np.where(same_sign, mean, 0.0)
