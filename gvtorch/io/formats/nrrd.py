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
from ..source import ArraySource, VolumeSource, number_type, place_axes, time_fields
from ..text_source import TextSource
from .format import Format

_ENCODINGS = {
    **{"raw": "raw"},
    **dict.fromkeys(("txt", "text", "ascii"), "text"),
    **dict.fromkeys(("gz", "gzip"), "gzip"),
    **dict.fromkeys(("bz2", "bzip2"), "bz2"),
}
_MAX_SKIPPED_BYTES = 1 << 24  # of one line, or of unpacked data
_SPACES = {"ras": "right-anterior-superior", "las": "left-anterior-superior"}
_SPACES["lps"] = "left-posterior-superior"
_SPATIAL_KINDS = ("domain", "space")
_UNCLEAR_KINDS = ("???", "none", "list", "stub")  # they do not say what an axis counts
#: Fields of the format; others are key/value pairs of the file's writer.
_FIELDS = {
    *("type", "dimension", "sizes", "encoding", "endian", "data file", "block size", "byte skip"),
    *("line skip", "content", "sample units", "number", "space", "space dimension", "space units"),
    *("space origin", "space directions", "spacings", "kinds", "units", "labels", "centers"),
    *("thicknesses", "axis mins", "axis maxs", "measurement frame", "min", "max", "old min"),
    *("old max",),
}
_OTHER_SPELLINGS = {name.replace(" ", ""): name for name in _FIELDS} | {"centerings": "centers"}
_DROPPED_FIELDS = ("measurement frame", "old min", "old max")


@Format("NRRD", ".nrrd", ".nhdr", options=("axes",), library="nrrd", package="pynrrd")
def open_nrrd(path: str, axes: str | None = None) -> VolumeSource:
    """Opens a file; `axes` as in `ask_axes`, the slowest first."""
    import nrrd

    with open(path, "rb") as file:
        fields = nrrd.read_header(file)
        offset = file.tell()
    header = {_OTHER_SPELLINGS.get(name, name): value for name, value in fields.items()}
    shape = tuple(int(n) for n in header["sizes"])
    if header.get("dimension") != len(shape):
        raise ValueError(f"{path}: {len(shape)} sizes, dimension {header.get('dimension')}")
    number_dtype = number_type(str(header["type"]))
    if number_dtype is None:
        raise ValueError(f"{path}: type {header['type']!r} is unknown")
    encoding = _ENCODINGS.get(str(header["encoding"]).lower())
    if encoding is None:
        known = ", ".join(sorted(_ENCODINGS))
        raise ValueError(f"{path}: encoding {header['encoding']!r} is unknown; known: {known}")
    if np.dtype(number_dtype).itemsize > 1 and encoding != "text" and "endian" not in header:
        raise ValueError(f"{path}: endian is missing, and its numbers have several bytes")
    if header.get("endian", "little") not in ("little", "big"):
        raise ValueError(f"{path}: endian {header['endian']!r} is neither little nor big")
    axis_roles = _axis_roles(path, header, shape, axes)
    info, dropped = _info(header, axis_roles, shape)
    fields = {
        "path": path,
        "shape": shape,
        "stored": np.dtype((">" if header.get("endian") == "big" else "<") + number_dtype).str,
        "info": info,
        "dropped": tuple(dropped),
        **place_axes(
            *(path, _affine(header, axis_roles), shape),
            *(axis_roles.index(role) if role in axis_roles else None for role in "ct"),
        ),
    }
    data_name = header.get("data file")
    skip_bytes = int(header.get("byte skip", 0))
    skip_lines = int(header.get("line skip", 0))
    if data_name is not None and (
        not isinstance(data_name, str)
        or data_name.startswith("LIST")
        or ("%" in data_name and not (Path(path).parent / data_name).exists())
    ):
        raise ValueError(f"{path}: its numbers lie in several files (data file: {data_name})")
    if skip_bytes < -1 or skip_lines < 0 or (skip_bytes == -1 and encoding != "raw"):
        raise ValueError(f"{path}: byte skip {skip_bytes}, line skip {skip_lines}")
    data_file, start = path, offset
    if data_name is not None:
        data_file, start = str(Path(path).parent / data_name), 0
    size = os.stat(data_file).st_size
    # Lines are skipped in the file; then bytes, in the unpacked data.
    max_skipped = size if encoding in ("raw", "text") else _MAX_SKIPPED_BYTES
    if skip_bytes > max_skipped:
        raise ValueError(f"{path}: byte skip must be at most {max_skipped}, got {skip_bytes}")
    data_start = _skip_lines(data_file, start, skip_lines)
    if encoding == "raw":
        array_start = data_start + skip_bytes
        if skip_bytes == -1:  # the numbers are at the end of the file
            needed_bytes = math.prod(shape) * np.dtype(number_dtype).itemsize
            array_start = max(start, size - needed_bytes)
        return ArraySource(file=data_file, offset=array_start, fortran=True, exact=True, **fields)
    if encoding == "text":
        return TextSource(file=data_file, offset=data_start + skip_bytes, fortran=True, **fields)
    fields |= {"codec": encoding, "start": data_start, "offset": skip_bytes, "whole": True}
    return ArraySource(file=data_file, fortran=True, exact=True, **fields)


def _skip_lines(file: str, start: int, count: int) -> int:
    """Returns the offset behind `count` lines of a file that begin at `start`."""
    if count:
        check_regular(file)
        with open(file, "rb") as stream:
            stream.seek(start)
            for number in range(count):
                line = stream.readline(_MAX_SKIPPED_BYTES)
                if not line.endswith(b"\n"):
                    raise ValueError(
                        f"{file}: has {number} of {count} lines to skip, of at most "
                        f"{_MAX_SKIPPED_BYTES} bytes"
                    )
            start = stream.tell()
    return start


def _axis_roles(path: str, header: dict[str, Any], shape: tuple[int, ...], axes: str | None) -> str:
    """Returns the meaning of each axis: "x", "y", "z" space, "t" times, "c" components."""
    rank, kinds = len(shape), [str(kind).lower() for kind in header.get("kinds", ())]
    if rank < 3:
        raise ValueError(f"{path}: expected 3 axes of space, got {rank} axes")
    if axes is None:
        if len(kinds) == rank and set(kinds) - {"???", "none"}:
            known_roles = {**dict.fromkeys(_SPATIAL_KINDS, "s"), "time": "t"}
            roles = [known_roles.get(kind, "c") for kind in kinds]
        else:  # axes of space are those with a direction, else those with a step
            tables = _directions(header, rank), _steps(header, rank)[0][:, None]
            known = (candidate for candidate in tables if np.isfinite(candidate).any())
            table = next(known, np.zeros((rank, 1)))
            roles = ["s" if np.isfinite(row[:3]).all() else "c" for row in table]
        if roles.count("s") == 3 and roles.count("t") <= 1 and roles.count("c") <= 1:
            letters = iter("xyz")
            return "".join(next(letters) if role == "s" else role for role in roles)
        if set(kinds) - {*_SPATIAL_KINDS, *_UNCLEAR_KINDS}:
            raise ValueError(
                f"{path}: expected three axes of space, got kinds {', '.join(kinds)}; axes "
                "(--axes) may name them otherwise"
            )
    axis_order = ask_axes(path, shape[::-1], axes)[::-1]
    if sum(letter in "zyx" for letter in axis_order) != 3:
        raise ValueError(f"{path}: expected three axes of space, got {axis_order[::-1]}")
    in_order = "xyz" in axis_order.replace("c", "").replace("t", "")
    if not in_order and np.isfinite(_directions(header, rank)).any():
        raise ValueError(f"{path}: axes must be z, y, x in this order: its header directs them")
    return axis_order


def _directions(header: dict[str, Any], rank: int) -> np.ndarray:
    """Returns (axes, 3 or 4) a step along each axis in space and, if given, time; NaN for none."""
    directions = np.asarray(header.get("space directions", np.zeros((0, 3))), dtype=np.float64)
    is_valid = directions.ndim == 2 and len(directions) == rank and directions.shape[1] in (3, 4)
    return directions if is_valid else np.full((rank, 3), np.nan)


def _numbers(header: dict[str, Any], rank: int, name: str) -> np.ndarray:
    """Returns (axes,) the numbers of a field; NaN if the header lacks it, or not one per axis."""
    values = np.asarray(header.get(name, ()), dtype=np.float64)
    return values if values.shape == (rank,) else np.full(rank, np.nan)


def _steps(header: dict[str, Any], rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns (axes,) the step along each axis and (axes,) the position of its first value; NaN for
    none.

    Source: NRRD format, sections "axis mins" and "centers"; values whose centering is not given
        count as those of cells, as in Teem.
    """
    low, high = (_numbers(header, rank, name) for name in ("axis mins", "axis maxs"))
    centers = header.get("centers", "")
    centers = centers if isinstance(centers, str) else " ".join(map(str, centers))
    centerings = centers.lower().split()
    centerings = centerings if len(centerings) == rank else ["cell"] * rank
    in_cells = np.array([centering != "node" for centering in centerings])
    intervals = np.asarray(header["sizes"]) - ~in_cells
    step = _numbers(header, rank, "spacings")
    step = np.where(np.isnan(step), (high - low) / np.maximum(intervals, 1), step)
    return step, low + np.where(in_cells, 0.5 * step, 0)


def _affine(header: dict[str, Any], axis_roles: str) -> np.ndarray:
    """Returns (4, 4) the affine of the three axes of space, in their order."""
    spatial = [axis for axis, role in enumerate(axis_roles) if role in "xyz"]
    world_axis = ["xyz".index(axis_roles[axis]) for axis in spatial]
    directions = _directions(header, len(axis_roles))[spatial, :3]
    spacings, first = (values[spatial] for values in _steps(header, len(axis_roles)))
    affine = np.eye(4)
    affine[:3, :3] = directions.T
    if np.isnan(directions).all():
        affine[:3, :3] = np.eye(3)[:, world_axis] * np.where(np.isnan(spacings), 1, spacings)
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    if origin.shape in ((3,), (4,)) and not np.isnan(origin[:3]).all():
        affine[:3, 3] = origin[:3]
    if "space origin" not in header and np.isfinite(first).all():
        affine[world_axis, 3] = first
    return affine  # `place_axes` refuses NaN and infinity


def _info(
    header: dict[str, Any], axis_roles: str, shape: tuple[int, ...]
) -> tuple[ImageInfo, list[str]]:
    """Returns the header's metadata of the values, and which metadata is not kept."""
    key_values = [str(name) for name in header if str(name).lower() not in _FIELDS]
    dropped = [f"the field {name!r}" for name in header if str(name).lower() in _DROPPED_FIELDS]
    if key_values:
        more = f" and {len(key_values) - 3} more" if len(key_values) > 3 else ""
        dropped.append(f"key/value pairs {', '.join(key_values[:3])}{more}")
    units = [str(unit) for unit in header.get("units", ())]
    units = units if len(units) == len(axis_roles) else [""] * len(axis_roles)
    spatial = [str(unit) for unit in header.get("space units", ())][:3]
    spatial = spatial or [u for u, role in zip(units, axis_roles, strict=True) if role in "xyz"]
    unit_names = {length_unit(unit) for unit in spatial}
    unit = unit_names.pop() if len(unit_names) == 1 else None
    if unit is None and any(spatial):
        dropped.append(f"units of space {', '.join(spatial)}")
    times: dict[str, Any] = {}
    if "t" in axis_roles:
        time_axis = axis_roles.index("t")
        steps, first = (values[time_axis] for values in _steps(header, len(axis_roles)))
        steps = (*_directions(header, len(axis_roles))[time_axis, 3:], steps)
        step = next((float(n) for n in steps if np.isfinite(n) and n > 0), None)
        times = time_fields(step, time_unit(units[time_axis]), float(first))
    space = str(header.get("space", "")).lower().removesuffix("-time")
    info = ImageInfo(
        unit=unit,
        channels=_channels(header, axis_roles, shape),
        quantity=str(header.get("sample units", "")) or None,
        labels=any(str(name).startswith("Segment0_") for name in header),
        space=_SPACES.get(space, space) or None,
        **times,
    )
    return info, dropped


def _channels(
    header: dict[str, Any], axis_roles: str, shape: tuple[int, ...]
) -> tuple[ChannelInfo, ...]:
    """Returns the names of the components, if the kind of their axis defines them."""
    kinds = [str(kind).lower() for kind in header.get("kinds", ())]
    axis = axis_roles.find("c")
    kind = kinds[axis] if 0 <= axis < len(kinds) else ""
    if kind in ("rgb-color", "rgba-color") and shape[axis] == len(kind) - 6:
        return color_channels(shape[axis])
    if kind == "complex" and shape[axis] == 2:
        return (ChannelInfo(name="real"), ChannelInfo(name="imaginary"))
    return ()
