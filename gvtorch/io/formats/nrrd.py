"""NRRD, attached or detached; pynrrd reads the header. Axes parallel to the world's are reordered
and flipped to x, y, z. The world's axes stay those of the file's space, see `ImageInfo.space`.

Source: "Definition of NRRD File Format" (teem.sourceforge.net/nrrd/format.html).
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from ...base.image_info import ChannelInfo, ImageInfo, color_channels
from ...base.named_axes import ask_axes
from ...base.units import length_unit, time_unit
from ..budget import check_regular
from ..packed import PackedSource
from ..source import ArraySource, VolumeSource, number_type, place_axes
from .format import Format

_ENCODINGS = {
    **{"raw": "raw"},
    **dict.fromkeys(("txt", "text", "ascii"), "text"),
    **dict.fromkeys(("gz", "gzip"), "zlib"),
    **dict.fromkeys(("bz2", "bzip2"), "bz2"),
}
_MOST_SKIPPED = 1 << 24  # bytes to skip at most: of one line, or of unpacked data
_SPACES = {"ras": "right-anterior-superior", "las": "left-anterior-superior"}
_SPACES["lps"] = "left-posterior-superior"
_SPATIAL = ("domain", "space")
#: Fields of the format; others are key/value pairs of the file's writer.
_FIELDS = {
    *("type", "dimension", "sizes", "encoding", "endian", "data file", "datafile", "block size"),
    *("byte skip", "byteskip", "line skip", "lineskip", "content", "sample units", "number"),
    *("space", "space dimension", "space units", "space origin", "space directions", "spacings"),
    *("kinds", "units", "labels", "centers", "centerings", "thicknesses", "axis mins", "axismins"),
    *("axis maxs", "axismaxs", "sampleunits", "blocksize", "measurement frame", "min", "max"),
    *("old min", "oldmin", "old max", "oldmax"),
}
_UNKEPT = ("measurement frame", "old min", "oldmin", "old max", "oldmax")


@Format("NRRD", ".nrrd", ".nhdr", options=("axes",), library="nrrd", package="pynrrd")
def open_nrrd(path: str, axes: str | None = None) -> VolumeSource:
    """Opens a file; `axes` as in `ask_axes`, the slowest first."""
    import nrrd

    with open(path, "rb") as file:
        header = nrrd.read_header(file)
        offset = file.tell()
    shape = tuple(int(n) for n in header["sizes"])
    if header.get("dimension") != len(shape):
        raise ValueError(f"{path}: {len(shape)} sizes, dimension {header.get('dimension')}")
    kind = number_type(str(header["type"]))
    if kind is None:
        raise ValueError(f"{path}: type {header['type']!r} is unknown")
    encoding = _ENCODINGS.get(str(header["encoding"]).lower())
    if encoding is None:
        known = ", ".join(sorted(_ENCODINGS))
        raise ValueError(f"{path}: encoding {header['encoding']!r} is unknown; known: {known}")
    if np.dtype(kind).itemsize > 1 and encoding != "text" and "endian" not in header:
        raise ValueError(f"{path}: endian is missing, and its numbers have several bytes")
    if header.get("endian", "little") not in ("little", "big"):
        raise ValueError(f"{path}: endian {header['endian']!r} is neither little nor big")
    letters = _letters(path, header, shape, axes)
    info, lost = _info(header, letters, shape)
    told: dict[str, Any] = {
        "path": path,
        "shape": shape,
        "stored": np.dtype((">" if header.get("endian") == "big" else "<") + kind).str,
        "info": info,
        "lost": tuple(lost),
        **place_axes(
            *(path, _affine(header, letters), shape),
            *(letters.index(letter) if letter in letters else None for letter in "ct"),
        ),
    }
    data = header.get("data file", header.get("datafile"))
    skip = int(header.get("byte skip", header.get("byteskip", 0)))
    lines = int(header.get("line skip", header.get("lineskip", 0)))
    if data is not None and (not isinstance(data, str) or data.startswith("LIST") or "%" in data):
        raise ValueError(f"{path}: its numbers lie in several files (data file: {data})")
    if skip < -1 or lines < 0 or (skip == -1 and encoding != "raw"):
        raise ValueError(f"{path}: byte skip {skip}, line skip {lines}")
    data_file, at = (path, offset) if data is None else (str(Path(path).parent / data), 0)
    size = os.stat(data_file).st_size
    if max(skip, lines) > size and encoding in ("raw", "text"):
        raise ValueError(f"{path}: skips {max(skip, lines)} bytes or lines of {size} bytes")
    if skip > _MOST_SKIPPED and encoding not in ("raw", "text"):
        raise ValueError(f"{path}: byte skip {skip} of what is packed, at most {_MOST_SKIPPED}")
    at = _behind_lines(data_file, at, lines)
    if encoding == "raw":
        need = math.prod(shape) * np.dtype(kind).itemsize
        begin = max(at, size - need) if skip < 0 else at + skip  # -1: numbers are at the end
        return ArraySource(file=data_file, offset=begin, fortran=True, exact=True, **told)
    return PackedSource(file=data_file, offset=at, skip=skip, codec=encoding, fortran=True, **told)


def _behind_lines(file: str, at: int, lines: int) -> int:
    """Returns the offset behind `lines` lines of a file that begin at `at`."""
    if lines:
        check_regular(file)
        with open(file, "rb") as stream:
            stream.seek(at)
            for number in range(lines):
                line = stream.readline(_MOST_SKIPPED)
                if not line.endswith(b"\n"):
                    raise ValueError(
                        f"{file}: has {number} of {lines} lines to skip, of at most "
                        f"{_MOST_SKIPPED} bytes"
                    )
            at = stream.tell()
    return at


def _letters(path: str, header: dict[str, Any], shape: tuple[int, ...], axes: str | None) -> str:
    """Returns the meaning of each axis: "s" space, "t" times, "c" components."""
    rank, kinds = len(shape), [str(kind).lower() for kind in header.get("kinds", ())]
    if rank < 3:
        raise ValueError(f"{path}: expected 3 axes of space, got {rank} axes")
    if axes is None:
        if len(kinds) == rank and set(kinds) - {"???", "none"}:
            found = ["s" if k in _SPATIAL else "t" if k == "time" else "c" for k in kinds]
        else:  # axes of space are those with a direction, else those with a step
            places = _directions(header, rank), _steps(header, rank)[0][:, None]
            table = next((one for one in places if np.isfinite(one).any()), np.zeros((rank, 1)))
            found = ["s" if np.isfinite(row[:3]).all() else "c" for row in table]
        if found.count("s") == 3 and found.count("t") <= 1 and found.count("c") <= 1:
            return "".join(found)
    letters = ask_axes(path, shape[::-1], axes)[::-1]
    if sum(letter in "zyx" for letter in letters) != 3:
        raise ValueError(f"{path}: expected three axes of space, got {letters[::-1]}")
    return "".join("s" if letter in "zyx" else letter for letter in letters)


def _directions(header: dict[str, Any], rank: int) -> np.ndarray:
    """Returns (axes, 3 or 4) a step along each axis in space and, if given, time; NaN for none."""
    told = np.asarray(header.get("space directions", np.zeros((0, 3))), dtype=np.float64)
    fits = told.ndim == 2 and len(told) == rank and told.shape[1] in (3, 4)
    return told if fits else np.full((rank, 3), np.nan)


def _numbers(header: dict[str, Any], rank: int, *names: str) -> np.ndarray:
    """Returns (axes,) the numbers of the first field of `names` that the header has; NaN if it has
    none, or not a number for each axis.
    """
    field = next((header[name] for name in names if name in header), np.zeros(0))
    told = np.asarray(field, dtype=np.float64)
    return told if told.shape == (rank,) else np.full(rank, np.nan)


def _steps(header: dict[str, Any], rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns (axes,) the step along each axis and (axes,) the position of its first value; NaN for
    none.

    Source: NRRD format, sections "axis mins" and "centers"; values whose centering is not given
        count as those of cells, as in Teem.
    """
    low = _numbers(header, rank, "axis mins", "axismins")
    high = _numbers(header, rank, "axis maxs", "axismaxs")
    told = header.get("centers", header.get("centerings", ""))
    told = (told if isinstance(told, str) else " ".join(map(str, told))).lower().split()
    told = told if len(told) == rank else ["cell"] * rank
    in_cells = np.array([one != "node" for one in told])
    count = np.asarray(header["sizes"]) - ~in_cells
    step = _numbers(header, rank, "spacings")
    step = np.where(np.isnan(step), (high - low) / np.maximum(count, 1), step)
    return step, low + np.where(in_cells, 0.5 * step, 0)


def _affine(header: dict[str, Any], letters: str) -> np.ndarray:
    """Returns (4, 4) the affine of the three axes of space."""
    spatial = [axis for axis, letter in enumerate(letters) if letter == "s"]
    directions = _directions(header, len(letters))[spatial, :3]
    spacings, first = (one[spatial] for one in _steps(header, len(letters)))
    affine = np.eye(4)
    if not np.isnan(directions).all():
        affine[:3, :3] = directions.T
    elif not np.isnan(spacings).all():
        affine[:3, :3] = np.diag(np.where(np.isnan(spacings), 1, spacings))
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    if origin.shape in ((3,), (4,)) and not np.isnan(origin[:3]).all():
        affine[:3, 3] = origin[:3]
    if "space origin" not in header and np.isfinite(first).all():
        affine[:3, 3] = first
    return affine  # `place_axes` refuses NaN and infinity


def _info(
    header: dict[str, Any], letters: str, shape: tuple[int, ...]
) -> tuple[ImageInfo, list[str]]:
    """Returns the header's metadata of the values, and which metadata is not kept."""
    own = [str(name) for name in header if str(name).lower() not in _FIELDS]
    lost = [f"the field {name!r}" for name in header if str(name).lower() in _UNKEPT]
    if own:
        more = f" and {len(own) - 3} more" if len(own) > 3 else ""
        lost.append(f"key/value pairs {', '.join(own[:3])}{more}")
    units = [str(unit) for unit in header.get("units", ())]
    units = units if len(units) == len(letters) else [""] * len(letters)
    spatial = [str(unit) for unit in header.get("space units", ())][:3]
    spatial = spatial or [u for u, letter in zip(units, letters, strict=True) if letter == "s"]
    known = {length_unit(unit) for unit in spatial}
    unit = known.pop() if len(known) == 1 else None
    if unit is None and any(spatial):
        lost.append(f"units of space {', '.join(spatial)}")
    step: float | None = None
    period = None
    if "t" in letters:
        at = letters.index("t")
        steps = (*_directions(header, len(letters))[at, 3:], _steps(header, len(letters))[0][at])
        step = next((float(one) for one in steps if np.isfinite(one) and one > 0), None)
        period = time_unit(units[at]) if step else None
    space = str(header.get("space", "")).lower().removesuffix("-time")
    info = ImageInfo(
        unit=unit,
        channels=_channels(header, letters, shape),
        quantity=str(header.get("sample units", header.get("sampleunits", ""))) or None,
        labels=any(str(name).startswith("Segment0_") for name in header),
        space=_SPACES.get(space, space) or None,
        time_step=step,
        time_unit=period,
    )
    return info, lost


def _channels(
    header: dict[str, Any], letters: str, shape: tuple[int, ...]
) -> tuple[ChannelInfo, ...]:
    """Returns the names of the components, if the kind of their axis defines them."""
    kinds = [str(kind).lower() for kind in header.get("kinds", ())]
    at = letters.find("c")
    kind = kinds[at] if 0 <= at < len(kinds) else ""
    if kind in ("rgb-color", "rgba-color") and shape[at] == len(kind) - 6:
        return color_channels(shape[at])
    if kind == "complex" and shape[at] == 2:
        return (ChannelInfo(name="real"), ChannelInfo(name="imaginary"))
    return ()
