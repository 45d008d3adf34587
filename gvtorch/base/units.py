"""Units of length and time as files spell them, and as OME-NGFF does.

Source: OME-NGFF 0.5, "axes" metadata (names of units are those of UDUNITS-2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

#: NGFF's name, length in metres, and other spellings in files.
_LENGTHS: tuple[tuple[str, float, str], ...] = (
    ("meter", 1.0, "m meters metre metres"),
    ("decimeter", 1e-1, "dm decimetre"),
    ("centimeter", 1e-2, "cm centimeters centimetre centimetres"),
    ("millimeter", 1e-3, "mm millimeters millimetre millimetres"),
    ("micrometer", 1e-6, "um \u00b5m \u03bcm micron microns micrometers micrometre micrometres"),
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
    return {word: (name, size) for name, size, words in rows for word in (name, *words.split())}


_LENGTH, _TIME = _table(_LENGTHS), _table(_TIMES)


def length_unit(text: str | None) -> str | None:
    """Returns NGFF's name of a unit of length; None if it is not a known one."""
    return _find(_LENGTH, text)[0]


def time_unit(text: str | None) -> str | None:
    """Returns NGFF's name of a unit of time; None if it is not a known one."""
    return _find(_TIME, text)[0]


def metres(name: str | None) -> float | None:
    """Returns the metres in a unit that `length_unit` returned; None for any other name."""
    return next((size for known, size, _ in _LENGTHS if known == name), None)


def unit_symbol(text: str | None) -> str:
    """Returns the symbol of a unit of length, as in "\u00b5m"; an unknown unit as it is."""
    name = length_unit(text)
    if name is None:
        return text or ""
    symbols = {"micrometer": "\u00b5m", "angstrom": "\u00c5"}
    return symbols.get(name) or next(words.split()[0] for n, _, words in _LENGTHS if n == name)


#: The note for files that store the width of pixels, but not the distance between slices.
NO_DEPTH = "how far slices are apart, which is not told: as far as pixels"


def spacing_of(
    sizes: Sequence[float | None], units: Sequence[str | None]
) -> tuple[tuple[float, float, float], str | None]:
    """Returns (x, y, z) voxel sizes in one unit, and its name. The first axis that has a positive
    size and a known unit gives the unit, and its size to axes that lack either. If all lack one,
    sizes are returned as they are, 1 unless positive, with None as the unit.
    """
    named = [_find(_LENGTH, unit) for unit in units]
    good = [
        size is not None and math.isfinite(size) and size > 0 and unit[0] is not None
        for size, unit in zip(sizes, named, strict=True)
    ]
    if not any(good):
        plain = [s if s is not None and math.isfinite(s) and s > 0 else 1.0 for s in sizes]
        return (plain[0], plain[1], plain[2]), None
    first = good.index(True)
    name, scale = named[first]
    found = [
        float(size) * (1.0 if unit[0] == name else unit[1] / scale) if told and size else None
        for size, unit, told in zip(sizes, named, good, strict=True)
    ]
    x, y, z = (found[first] if size is None else size for size in found)
    return (x or 1.0, y or 1.0, z or 1.0), name


def _find(table: dict[str, tuple[str, float]], text: str | None) -> tuple[str | None, float]:
    words = (text or "").strip()
    return table.get(words) or table.get(words.lower()) or (None, 1.0)
