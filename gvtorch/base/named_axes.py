"""The axes of an array: identified by name, by coordinates along them, or by the user.

torch is not imported here, since readers of headers need it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .units import length_unit, spacing_of, time_unit

FEW = 4  # a last axis of at most this size holds channels unless the user says otherwise
_NAMES = {
    "z": "z depth lev level plane planes slice slices altitude pln",
    "y": "y lat latitude row rows height",
    "x": "x lon longitude column columns col cols width",
    "t": "t time frame frames",
    "c": "c channel channels band bands component components ch",
}
_LETTERS = {name: letter for letter, names in _NAMES.items() for name in names.split()}
Steps = Sequence[tuple[float, float] | None]  # for each axis: step and first coordinate, if known


def letter_of(name: str) -> str:
    """Returns the letter of an axis by its name, "?" for an unknown one."""
    return _LETTERS.get(name.lower(), "?")


def named_axes(names: Sequence[str], shape: Sequence[int]) -> str | None:
    """Returns a letter for each axis, - for an unknown one of size 1; None if the names do not
    identify all others.
    """
    pairs = list(zip(map(letter_of, names), shape, strict=True))
    letters = "".join("-" if letter == "?" and size == 1 else letter for letter, size in pairs)
    bare = letters.replace("-", "")
    known = "?" not in letters and len(set(bare)) == len(bare) and {"y", "x"} <= set(bare)
    return letters if known else None


def ask_axes(path: str, shape: Sequence[int], axes: str | None = None) -> str:
    """Returns a letter for each axis of an array without names: `axes` if given, else (z, y, x), or
    (z, y, x, c) where the last axis has a size of at most 4 and the first a larger one.

    Raises:
        ValueError: The axes are ambiguous, and the message asks for them; or `axes` does not fit.
    """
    sizes = "(" + ", ".join(map(str, shape)) + ")"
    if axes is not None:
        known = isinstance(axes, str) and set(axes) <= set("tczyx") and {"y", "x"} <= set(axes)
        if not known or len(set(axes)) != len(axes) or len(axes) != len(shape):
            raise ValueError(
                f"{path}: axes must be {len(shape)} letters among t, c, z, y, x for the shape "
                f"{sizes}, each once, y and x among them, got {axes!r}"
            )
        return axes
    if len(shape) == 3:
        return "zyx"
    if len(shape) == 4 and shape[3] <= FEW < shape[0]:
        return "zyxc"
    which = {2: "'yx'", 4: "'zyxc', 'czyx' or 'tzyx'", 5: "'tczyx'"}.get(len(shape))
    if which is None:
        raise ValueError(f"{path}: expected 2 to 5 axes, got shape {sizes}")
    raise ValueError(
        f"{path}: what are the axes of shape {sizes}? Name them with axes (--axes), a letter each: "
        f"{which}"
    )


def even_steps(places: Any) -> tuple[tuple[float, float] | None, bool]:
    """Returns step and first of evenly spaced coordinates (None if they are not, or not numbers),
    and whether they are even; also true for what can't be uneven, such as text.
    """
    found = np.asarray(places)
    if found.ndim != 1 or found.dtype.kind not in "iuf" or not np.isfinite(found).all():
        return None, found.dtype.kind not in "iuf"
    if len(found) < 2:
        return (1.0, float(found[0])) if len(found) else None, True
    step = (float(found[-1]) - float(found[0])) / (len(found) - 1)
    even = bool(step and np.abs(np.diff(found.astype(np.float64)) / step - 1).max() < 1e-2)
    return ((step, float(found[0])) if even else None), even


def place_named(
    axes: str, shape: Sequence[int], steps: Steps, units: Sequence[str | None]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns spacing, origin and flips of a grid from the coordinates along its axes, and the
    unit, time_step, time_origin and time_unit of its `ImageInfo`.
    """
    told = dict(zip(axes, zip(steps, units, shape, strict=True), strict=True))
    found = [told.get(letter, (None, None, 1)) for letter in "xyz"]
    sizes = [abs(step[0]) if step else None for step, *_ in found]
    names = [length_unit(unit) for _, unit, _ in found]
    bare = any(size and not name for size, name in zip(sizes, names, strict=True))
    spacing, unit = spacing_of(sizes, names)
    if unit is None or bare:  # degrees, pressure levels, ...: no common unit of length
        unit, (x, y, z) = None, (size or 1.0 for size in sizes)
        spacing = (x, y, z)
    origin, flips = [0.0, 0.0, 0.0], ""
    for at, (step, _, count) in enumerate(found):
        if step:
            first = step[1] + (step[0] * (count - 1) if step[0] < 0 else 0.0)
            origin[at] = first * (spacing[at] / abs(step[0]))
            flips += "xyz"[at] if step[0] < 0 else ""
    time, of_time, _ = told.get("t", (None, None, 1))
    moments: dict[str, Any] = {"unit": unit}
    if time and time[0] > 0:
        moments |= {"time_step": time[0], "time_origin": time[1]}
        moments["time_unit"] = time_unit((of_time or "").split(" since ")[0])
    return {"spacing": spacing, "origin": tuple(origin), "flips": flips}, moments
