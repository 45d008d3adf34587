"""The axes of an array: identified by name, by coordinates along them, or by the user.

torch is not imported here, since readers of headers need it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .units import length_unit, spacing_of, time_unit

#: A last axis of at most this size holds channels unless the user says otherwise.
MAX_CHANNEL_AXIS = 4
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
    named = letters.replace("-", "")
    identified = "?" not in letters and len(set(named)) == len(named) and {"y", "x"} <= set(named)
    return letters if identified else None


def ask_axes(path: str, shape: Sequence[int], axes: str | None = None) -> str:
    """Returns a letter for each axis of an array without names: `axes` if given, else (z, y, x), or
    (z, y, x, c) where the last axis has a size of at most 4 and the first a larger one.

    Raises:
        ValueError: The axes are ambiguous, and the message asks for them; or `axes` does not fit.
    """
    sizes = "(" + ", ".join(map(str, shape)) + ")"
    if axes is not None:
        valid = isinstance(axes, str) and set(axes) <= set("tczyx") and {"y", "x"} <= set(axes)
        if not valid or len(set(axes)) != len(axes) or len(axes) != len(shape):
            raise ValueError(
                f"{path}: axes must be {len(shape)} letters among t, c, z, y, x for the shape "
                f"{sizes}, each once, y and x among them, got {axes!r}"
            )
        return axes
    if len(shape) == 3:
        return "zyx"
    if len(shape) == 4 and shape[3] <= MAX_CHANNEL_AXIS < shape[0]:
        return "zyxc"
    examples = {2: "'yx'", 4: "'zyxc', 'czyx' or 'tzyx'", 5: "'tczyx'"}.get(len(shape))
    if examples is None:
        raise ValueError(f"{path}: expected 2 to 5 axes, got shape {sizes}")
    raise ValueError(
        f"{path}: what are the axes of shape {sizes}? Name them with axes (--axes), a letter each: "
        f"{examples}"
    )


def even_steps(name: str, coordinates: Any, dropped: list[str]) -> tuple[float, float] | None:
    """Returns step and first of the coordinates along an axis; None if they are not numbers, such
    as text, or not evenly spaced, which is added to `dropped`, the metadata that is not kept.
    """
    values = np.asarray(coordinates)
    if values.dtype.kind not in "iuf":
        return None
    if values.ndim == 1 and np.isfinite(values).all():
        if len(values) < 2:
            return (1.0, float(values[0])) if len(values) else None
        step = (float(values[-1]) - float(values[0])) / (len(values) - 1)
        if step and np.abs(np.diff(values.astype(np.float64)) / step - 1).max() < 1e-2:
            return step, float(values[0])
    dropped.append(f"that coordinates along {name} are not evenly spaced")
    return None


def axes_placement(
    axes: str,
    shape: Sequence[int],
    steps: Steps,
    units: Sequence[str | None],
    dropped: list[str],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns spacing, origin and flips of a grid from the coordinates along its axes, and the
    unit, time_step, time_origin and time_unit of its `ImageInfo`. Units of x, y and z that can't be
    compared are added to `dropped`, the metadata that is not kept.
    """
    by_letter = dict(zip(axes, zip(steps, units, shape, strict=True), strict=True))
    xyz_axes = [by_letter.get(letter, (None, None, 1)) for letter in "xyz"]
    sizes = [abs(step[0]) if step else None for step, *_ in xyz_axes]
    length_units = [length_unit(unit) for _, unit, _ in xyz_axes]
    lacks_unit = any(size and not name for size, name in zip(sizes, length_units, strict=True))
    spacing, unit = spacing_of(sizes, length_units)
    if unit is None or lacks_unit:  # degrees, pressure levels, ...: no common unit of length
        unit, (x, y, z) = None, (size or 1.0 for size in sizes)
        spacing = (x, y, z)
        told = [told_unit for step, told_unit, _ in xyz_axes if step and told_unit]
        if len({length_unit(name) or name[:6] for name in told}) > 1:  # not degrees_north and _east
            listing = ", ".join(dict.fromkeys(told))
            dropped.append(f"units of the axes ({listing}): spacings are their plain numbers")
    origin, flips = [0.0, 0.0, 0.0], ""
    for axis, (step, _, count) in enumerate(xyz_axes):
        if step:
            first = step[1] + (step[0] * (count - 1) if step[0] < 0 else 0.0)
            origin[axis] = first * (spacing[axis] / abs(step[0]))
            flips += "xyz"[axis] if step[0] < 0 else ""
    time_steps, raw_time_unit, _ = by_letter.get("t", (None, None, 1))
    info_fields: dict[str, Any] = {"unit": unit}
    if time_steps and time_steps[0] > 0:
        info_fields |= {"time_step": time_steps[0], "time_origin": time_steps[1]}
        info_fields["time_unit"] = time_unit((raw_time_unit or "").split(" since ")[0])
    return {"spacing": spacing, "origin": tuple(origin), "flips": flips}, info_fields
