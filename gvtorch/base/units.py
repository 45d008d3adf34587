"""Units of length and time as files spell them, and as OME-NGFF does.

Source: OME-NGFF 0.5, "axes" metadata (names of units are those of UDUNITS-2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

#: NGFF's name, length in metres, and other spellings in files, of which the first is the symbol.
_LENGTHS: tuple[tuple[str, float, str], ...] = (
    ("meter", 1.0, "m meters metre metres"),
    ("decimeter", 1e-1, "dm decimetre"),
    ("centimeter", 1e-2, "cm centimeters centimetre centimetres"),
    ("millimeter", 1e-3, "mm millimeters millimetre millimetres"),
    ("micrometer", 1e-6, "\u00b5m um \u03bcm micron microns micrometers micrometre micrometres"),
    ("nanometer", 1e-9, "nm nanometers nanometre nanometres"),
    ("angstrom", 1e-10, "\u00c5 \u212b a angstroms"),
    ("picometer", 1e-12, "pm picometers picometre"),
    ("kilometer", 1e3, "km kilometers kilometre kilometres"),
    ("inch", 0.0254, "in inches"),
    ("foot", 0.3048, "ft feet"),
)
_TIMES: tuple[tuple[str, float, str], ...] = (
    ("second", 1.0, "s sec secs seconds"),
    ("millisecond", 1e-3, "ms msec milliseconds"),
    ("microsecond", 1e-6, "us \u00b5s \u03bcs usec microseconds"),
    ("nanosecond", 1e-9, "ns nanoseconds"),
    ("minute", 60.0, "min minutes"),
    ("hour", 3600.0, "h hr hours"),
    ("day", 86400.0, "d days"),
)


def _table(rows: tuple[tuple[str, float, str], ...]) -> dict[str, tuple[str, float]]:
    return {
        spelling: (name, size)
        for name, size, spellings in rows
        for spelling in (name, *spellings.split())
    }


_LENGTH_BY_SPELLING, _TIME_BY_SPELLING = _table(_LENGTHS), _table(_TIMES)


def length_unit(text: str | None) -> str | None:
    """Returns NGFF's name of a unit of length; None if it is not a known one."""
    return _look_up(_LENGTH_BY_SPELLING, text)[0]


def time_unit(text: str | None) -> str | None:
    """Returns NGFF's name of a unit of time; None if it is not a known one."""
    return _look_up(_TIME_BY_SPELLING, text)[0]


def metres(name: str | None) -> float | None:
    """Returns the metres in a unit that `length_unit` returned; None for any other name."""
    return next((size for unit, size, _ in _LENGTHS if unit == name), None)


def unit_symbol(text: str | None) -> str:
    """Returns the symbol of a unit of length, as in "\u00b5m"; an unknown unit as it is."""
    name = length_unit(text)
    if name is None:
        return text or ""
    return next(spellings.split()[0] for unit, _, spellings in _LENGTHS if unit == name)


#: The note for files that store the width of pixels, but not the distance between slices.
NO_DEPTH = "how far slices are apart, which is not told: as far as pixels"


def spacing_of(
    sizes: Sequence[float | None], units: Sequence[str | None]
) -> tuple[tuple[float, float, float], str | None]:
    """Returns (x, y, z) voxel sizes in one unit, and its name. The first axis that has a positive
    size and a known unit gives the unit, and its size to axes that lack either. If all lack one,
    sizes are returned as they are, 1 unless positive, with None as the unit.
    """
    known_units = [_look_up(_LENGTH_BY_SPELLING, unit) for unit in units]
    usable = [
        size is not None and math.isfinite(size) and size > 0 and unit[0] is not None
        for size, unit in zip(sizes, known_units, strict=True)
    ]
    if not any(usable):
        plain_sizes = [s if s is not None and math.isfinite(s) and s > 0 else 1.0 for s in sizes]
        return (plain_sizes[0], plain_sizes[1], plain_sizes[2]), None
    first = usable.index(True)
    name, scale = known_units[first]
    converted = [
        float(size) * (1.0 if unit[0] == name else unit[1] / scale) if is_usable and size else None
        for size, unit, is_usable in zip(sizes, known_units, usable, strict=True)
    ]
    x, y, z = (converted[first] if size is None else size for size in converted)
    return (x or 1.0, y or 1.0, z or 1.0), name


def _look_up(table: dict[str, tuple[str, float]], text: str | None) -> tuple[str | None, float]:
    spelling = (text or "").strip()
    return table.get(spelling) or table.get(spelling.lower()) or (None, 1.0)
