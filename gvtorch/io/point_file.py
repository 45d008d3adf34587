"""`read_points`: reads points from arrays (NPZ), PLY files and FITS tables, by names of columns.

PLY: Turk, "The PLY polygon file format", 1994. Its rows are memory-mapped, since a scan may be
larger than memory; FITS tables are read with astropy.
"""

from __future__ import annotations

import itertools
import math
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from ..base import check
from ..base.image_info import array_from_srgb
from ..base.messages import need_library
from ..points.points import Points
from .budget import MAX_UNPACK_RATIO, header_budget
from .packed import is_packed_fits
from .resources import check_memory, memory_free
from .source import convert_errors, number_type

ENDINGS = ("npz", "ply", "fits", "fit", "fits.gz")
_ALL_POINTS = 2**62
_VALUE_NAMES = ("value", "mass", "lumin", "intensit", "weight", "flux", "bright", "densit")
#: Usual names: of several columns, or how that of a single one begins, and its numbers per row.
_USUAL: dict[str, tuple[tuple[str, ...], tuple[str, ...], tuple[int, ...]]] = {
    "positions": (("x y z",), ("position", "pos", "xyz", "points", "coord"), (3,)),
    "colors": (("red green blue", "r g b"), ("color", "colour", "rgb"), (3, 4)),
    "values": ((), _VALUE_NAMES, (1, 2, 3, 4)),
    "radius": ((), ("radius", "radii", "smoothing"), (1,)),
}
_SPLAT_NAMES = {"f_dc_0", "scale_0", "rot_0", "opacity"}  # of 3D Gaussian splatting
_FITS_TYPES = tuple("BIJKEDF")  # codes of columns with a number or an array of numbers per row
_MAX_HEADER_BYTES = 65536


class ColumnNames(TypedDict, total=False):
    """Which columns hold what; those that are left out are found by their usual names."""

    positions: str | Sequence[str]  # one column of three numbers, or three columns
    values: str | Sequence[str]
    colors: str | Sequence[str]  # one column of three or four numbers, or several columns
    radius: str | float  # a column, or one number for all points; world units


class PointFile:
    """A file of points that is read in parts.

    Attributes:
        path: The file.
        columns: All columns of numbers, by name, (n,) or (n, k), mapped where the format allows.
        used: The names of the columns that make up positions, values, colors and radius.
    """

    def __init__(self, path: str | Path, **names: Unpack[ColumnNames]) -> None:
        """Opens the file, see `read_points`."""
        check.known_options("read_points", names, ColumnNames)
        self.path = Path(path)
        self.columns = _read_columns(self.path)
        radius = names.get("radius")
        self._constant = radius if isinstance(radius, (int, float)) else None
        self.used = _choose_columns(self.path, self.columns, names)

    def __len__(self) -> int:
        return len(self.columns[self.used["positions"][0]])

    def __repr__(self) -> str:
        return f"PointFile({str(self.path)!r}: {len(self)} points, {', '.join(self.used)})"

    def blocks(self, count: int) -> Iterator[Points]:
        """Yields all points, `count` at a time; raises ValueError if a number is not finite."""
        for start in range(0, len(self), count):
            part = slice(start, start + count)
            with convert_errors(ValueError, str(self.path), "can't be read"):
                fields = {name: self._join_columns(used, part) for name, used in self.used.items()}
                if "colors" in fields:
                    colors = fields["colors"][:, :3]
                    dtypes = {self.columns[name].dtype for name in self.used["colors"]}
                    if all(dtype.kind in "iu" for dtype in dtypes):  # whole numbers are sRGB
                        colors = array_from_srgb(colors / max(np.iinfo(d).max for d in dtypes))
                    fields["colors"] = colors
                radius = fields["radius"][:, 0] if "radius" in fields else self._constant
                yield Points(**{**fields, "radius": radius})

    def _join_columns(self, names: Sequence[str], part: slice) -> np.ndarray:
        columns = (np.asarray(self.columns[name][part]) for name in names)
        return np.concatenate([column.reshape(len(column), -1) for column in columns], 1)


def read_points(path: str | Path, **names: Unpack[ColumnNames]) -> Points:
    """Reads points from an archive of arrays (.npz), a PLY file or the first table of a FITS file.

    Args:
        path: The file.
        **names: Which columns are positions, values, colors and radius: a name, or several in a
            list or with commas between them ("x,y,z"). If left out, positions are x, y and z, or
            a column of three numbers whose name begins with position, pos, xyz, points or coord;
            values one that begins with value, mass, lumin, intensit, weight, flux, bright or
            densit; colors red, green and blue, or r, g and b, or one that begins with color, colour
            or rgb; radius one that begins with radius, radii or smoothing. `radius` may also be one
            number for all points.

    Returns:
        The points. Colours that are whole numbers are read as sRGB, others as linear.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file has another format or is damaged, a column is missing or ambiguous, or
            a number is not finite.
        ImportError: astropy is not installed.
    """
    return next(PointFile(path, **names).blocks(_ALL_POINTS))


def _read_columns(path: Path) -> dict[str, np.ndarray]:
    file_name = path.name.lower()
    ending = next((candidate for candidate in ENDINGS if file_name.endswith("." + candidate)), None)
    if ending is None:
        raise ValueError(f"{path}: a name of points must end in {', '.join(ENDINGS)}")
    if not path.is_file():
        raise FileNotFoundError(f"file not found: {path}")
    reader = {"npz": _read_npz, "ply": _read_ply}.get(ending, _read_fits)
    with convert_errors(ValueError, str(path), f"can't be read as {ending}"):
        read = reader(path).items()
        columns = {name: part for name, part in read if part.dtype.kind in "iuf" and part.ndim}
    lengths = [len(column) for column in columns.values()]
    count = max(lengths, key=lengths.count) if lengths else 0  # the length that most columns have
    if not count:
        raise ValueError(f"{path}: holds no columns of numbers")
    # Columns of other names may have any length.
    usual_names = tuple(itertools.chain(*(beginnings for _, beginnings, _ in _USUAL.values())))
    other_lengths = [
        f"{name} ({len(column)})"
        for name, column in columns.items()
        if len(column) != count and name.lower().startswith(usual_names)
    ]
    if other_lengths:
        message = f"{path}: not read, since others have {count} rows: {', '.join(other_lengths)}"
        warnings.warn(message, stacklevel=4)
    if columns.keys() >= _SPLAT_NAMES:
        message = "of 3D Gaussians only the centres are read, as points: no size, colour or opacity"
        warnings.warn(f"{path}: {message}", stacklevel=4)
    return {n: column for n, column in columns.items() if len(column) == count and column.ndim <= 2}


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        check_memory(str(path), sum(member.file_size for member in archive.infolist()))
    with path.open("rb") as file, np.load(file, allow_pickle=False) as content:
        return dict(content)


def _read_fits(path: Path) -> dict[str, np.ndarray]:
    """Returns the numeric columns of the first table that has rows, without those of lists."""
    fits = need_library(f"{path}: FITS", "astropy.io.fits", "astropy")
    packed = is_packed_fits(str(path))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*truncated.*")
        with ExitStack() as stack:
            file = stack.enter_context(path.open("rb"))
            with header_budget(str(path)):
                hdus = stack.enter_context(fits.open(file, memmap=not packed))
                tables = (hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU))
                table = next((hdu for hdu in tables if hdu.header["NAXIS2"]), None)
            if table is None:
                raise ValueError("it has no table with rows")
            start, size = int(table.fileinfo()["datLoc"]), path.stat().st_size
            limit = min(size * MAX_UNPACK_RATIO, memory_free()) if packed else size - start
            if table.size > limit:
                raise ValueError(f"its rows take {table.size} bytes, at most {limit} can be there")
            return {
                column.name: _with_gaps(np.asarray(table.data[column.name]), column)
                for column in table.columns
                if column.format.lstrip("0123456789")[:1] in _FITS_TYPES
            }


def _with_gaps(values: np.ndarray, column: Any) -> np.ndarray:
    """Returns the values of a column, NaN where they are missing: where `null` is stored, if given,
    which is scaled as they are.
    """
    null = column.null
    if not isinstance(null, int):
        return values
    if values.dtype.kind == "f":
        null = null * (column.bscale or 1) + (column.bzero or 0)
    return np.where(values == null, np.nan, values) if (values == null).any() else values


def _read_ply(path: Path) -> dict[str, np.ndarray]:
    """Returns the columns of the vertices; only binary rows of fixed size may precede them."""
    with path.open("rb") as file:
        header = file.read(_MAX_HEADER_BYTES)
        lines = header.partition(b"end_header")[0].decode("latin-1").splitlines()
        start = header.find(b"\n", header.find(b"end_header")) + 1
        if not lines or lines[0].strip() != "ply" or start == 0:
            raise ValueError("it has no header of PLY")
        layout, elements = _ply_header(lines)
        skipped_bytes = 0
        for name, count, fields in elements:
            if count < 0:
                raise ValueError(f"it declares {count} of {name}")
            if name != "vertex":
                if fields is None or layout == "ascii":
                    raise ValueError(f"its vertices come after {name}")
                skipped_bytes += count * np.dtype(fields).itemsize
                continue
            if fields is None:
                raise ValueError("its vertices have lists")
            size = path.stat().st_size - start - skipped_bytes
            dtype = np.dtype(fields)
            needed_bytes = count * (2 * len(fields) - 1 if layout == "ascii" else dtype.itemsize)
            if not 0 < needed_bytes <= size:
                raise ValueError(f"{count} vertices take {needed_bytes} bytes, it has {size}")
            if layout == "ascii":
                file.seek(start)
                rows_text = itertools.islice(file, count)
                table = np.loadtxt(rows_text, np.float64, ndmin=2, usecols=range(len(fields)))
                if len(table) != count:
                    raise ValueError(f"{count} vertices are declared, {len(table)} are there")
                return {n: _text_column(n, table[:, i], k[1:]) for i, (n, k) in enumerate(fields)}
            rows = np.memmap(path, dtype, "r", start + skipped_bytes, (count,))
            return {column: rows[column] for column, _ in fields}
    raise ValueError("it has no vertices")


def _text_column(name: str, values: np.ndarray, kind: str) -> np.ndarray:
    """Returns float64 values in a column's dtype; raises ValueError if an integer does not fit."""
    with np.errstate(all="ignore"):
        column: np.ndarray = values.astype(kind)
    if column.dtype.kind in "iu" and (column != values).any():
        raise ValueError(f"{name} holds numbers that {column.dtype.name} does not")
    return column


def _ply_header(
    lines: Sequence[str],
) -> tuple[str, list[tuple[str, int, list[tuple[str, str]] | None]]]:
    """Returns "ascii", "<" or ">", and the name, the number of rows and the columns of each element
    (None if some are lists).
    """
    byte_orders, layout = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}, ""
    elements: list[tuple[str, int, list[tuple[str, str]] | None]] = []
    for tokens in (line.split() for line in lines[1:]):
        if tokens[:1] == ["format"]:
            layout = byte_orders[tokens[1]]
        elif tokens[:1] == ["element"]:
            elements.append((tokens[1], int(tokens[2]), []))
        elif tokens[:1] == ["property"]:
            name, count, fields = elements[-1]
            if tokens[1] == "list" or fields is None:
                elements[-1] = (name, count, None)
            elif (kind := number_type(tokens[1])) is not None:
                fields.append((tokens[2], layout + kind))
            else:
                raise ValueError(f"{tokens[1]!r} is not a number type")
    if not layout:
        raise ValueError("its header has no format")
    return ("ascii" if layout == "=" else layout), elements


def _choose_columns(
    path: Path, columns: Mapping[str, np.ndarray], names: ColumnNames
) -> dict[str, list[str]]:
    """Returns the names of the columns that make up positions, values, colors and radius."""
    widths = {name: math.prod(column.shape[1:]) for name, column in columns.items()}
    by_lower_name = {name.lower(): name for name in columns}
    singles = {lower: name for lower, name in by_lower_name.items() if widths[name] == 1}
    chosen: dict[str, list[str]] = {}
    argument: Any
    for role, argument in names.items():
        if argument is None or isinstance(argument, (int, float)):
            continue
        column_names = argument.split(",") if isinstance(argument, str) else list(argument)
        chosen[role] = [name.strip() for name in column_names]
        for name in chosen[role]:
            if name not in columns:
                raise ValueError(f"{path}: has no column {name!r}; it has {', '.join(columns)}")

    for role, (groups, beginnings, sizes) in _USUAL.items():
        if role in chosen or (role == "radius" and names.get(role) is not None):
            continue
        group = next((g.split() for g in groups if singles.keys() >= {*g.split()}), None)
        begins = [name for lower, name in by_lower_name.items() if lower.startswith(beginnings)]
        matches = [name for name in begins if widths[name] in sizes]
        if group is None and len(matches) > 1:
            raise ValueError(
                f"{path}: {' or '.join(matches)} may be its {role}: say which, as in "
                f"{role}={matches[0]}"
            )
        if group or matches:
            chosen[role] = [singles[name] for name in group] if group else matches
        if "positions" not in chosen:
            listed = ", ".join(f"{name} ({width})" for name, width in widths.items())
            raise ValueError(f"{path}: which columns are positions? It has {listed}")
    for role, used in chosen.items():
        sizes, total = _USUAL[role][2], sum(widths[name] for name in used)
        if role != "values" and total not in sizes:
            raise ValueError(f"{path}: {role} must be {sizes[0]} numbers, the columns are {total}")
    return chosen
