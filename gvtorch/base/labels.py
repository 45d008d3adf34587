"""Labels: integers of any width, stored exactly in the dtypes that bricks can have.

Labels of at most 16 bits are stored as they are. Wider ones are indexed: a voxel holds the index of
its label in a table of all labels.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

#: The dtypes of labels that are stored as they are.
NARROW = ("uint8", "int8", "uint16", "int16")
#: float32 represents all whole numbers up to this one.
MAX_EXACT_INTEGER = 2**24
#: Labels in a range below this are looked up in a table, others by bisection.
_MAX_TABLE_RANGE = 2**22


def as_whole(context: str, values: np.ndarray) -> np.ndarray:
    """Returns labels as integers: whole floats become int64, bool becomes uint8. Raises ValueError
    if a label is not a whole number, or beyond int64.
    """
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            is_whole = (np.rint(values) == values) & (np.abs(values) < 2.0**63)
        if not is_whole.all():
            bad = values[~is_whole].flat[0]
            raise ValueError(f"{context}: labels must be whole numbers, got {bad:g}")
        return values.astype(np.int64)
    if values.dtype.kind not in "iu":
        raise ValueError(f"{context}: labels must be whole numbers, got {values.dtype}")
    largest = int(values.max(initial=0)) if values.dtype == np.uint64 else 0
    if largest > np.iinfo(np.int64).max:
        raise ValueError(f"{context}: labels must be below 2^63, got {largest}: renumber them")
    return values


def distinct(context: str, parts: Iterable[np.ndarray]) -> np.ndarray:
    """Returns (k,) int64 the sorted distinct labels of arrays of integers; raises ValueError if
    there are more than 2^24.
    """
    labels, pending, count = np.zeros(0, np.int64), [], 0
    for part in parts:
        pending.append(np.unique(part).astype(np.int64))
        count += len(pending[-1])
        if count > max(2**20, len(labels)):
            labels, pending, count = np.unique(np.concatenate((labels, *pending))), [], 0
            check_count(context, len(labels))
    labels = np.unique(np.concatenate((labels, *pending)))
    check_count(context, len(labels))
    return labels


def check_count(context: str, count: int) -> None:
    """Raises ValueError if there are more labels than bricks can hold."""
    if count > MAX_EXACT_INTEGER:
        raise ValueError(
            f"{context}: holds {count} labels or more, at most {MAX_EXACT_INTEGER} fit: crop it, "
            "or join some of them"
        )


def index_dtype(count: int) -> np.dtype:
    """Returns the smallest dtype of bricks that holds `count` indices."""
    return np.dtype("uint8" if count <= 2**8 else "uint16" if count <= 2**16 else "float32")


def indices(values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Returns the index of each value in the sorted `labels` (k,), which hold all values."""
    dtype = index_dtype(len(labels))
    low, high = int(labels[0]), int(labels[-1])
    if high - low < max(_MAX_TABLE_RANGE, values.size):
        table = np.zeros(high - low + 1, dtype)
        table[labels - low] = np.arange(len(labels), dtype=dtype)
        # To int64 first: NumPy may turn uint64 mixed with int64 into float64.
        return table[values.astype(np.int64, copy=False) - low]
    return np.searchsorted(labels, values.astype(np.int64, copy=False)).astype(dtype)


def stored_labels(context: str, values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns labels as bricks hold them, and (k,) int64 the label of each index; None where they
    are stored as they are. Raises ValueError as `as_whole` and `distinct`.
    """
    values = as_whole(context, values)
    if values.dtype.name in NARROW:
        return values, None
    labels = distinct(context, values)  # plane by plane
    return indices(values, labels), labels


def counted(labels: Any) -> str:
    """Returns the number and range of labels (k,), without background 0, as "12, 1 to 40"."""
    foreground = labels[labels != 0]
    if not len(foreground):
        return "0"
    return f"{len(foreground)}, {int(foreground.min())} to {int(foreground.max())}"


def background(labels: np.ndarray | None) -> int | None:
    """Returns the stored value of label 0, the background; None if `labels` has no 0."""
    if labels is None:
        return 0
    index = int(np.searchsorted(labels, 0))
    return index if index < len(labels) and labels[index] == 0 else None


def check_narrowed(context: str, values: np.ndarray) -> None:
    """Raises ValueError if integers lie beyond 2^24, where float32 does not hold all of them."""
    if values.dtype.kind not in "iu" or values.dtype.itemsize < 4 or not values.size:
        return
    low, high = int(values.min()), int(values.max())
    extreme = high if high > -low else low
    if abs(extreme) > MAX_EXACT_INTEGER:
        raise ValueError(
            f"{context}: {values.dtype.name} values reach {extreme}, and float32 keeps whole "
            f"numbers apart up to {MAX_EXACT_INTEGER}: labels=True (--labels) keeps labels "
            "exactly, and measurements can be rounded before: data.astype('float32')"
        )
