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
from .budget import MOST_PACKED, header_budget
from .packed import is_packed_fits
from .resources import amount, memory_free
from .source import number_type, told_as

ENDINGS = ("npz", "ply", "fits", "fit", "fits.gz")
_ALL = 2**62  # points
_PLACES = ("position", "pos", "xyz", "points", "coord")
_VALUES = ("value", "mass", "lumin", "intensit", "weight", "flux", "bright", "densit")
_COLORS = ("color", "colour", "rgb")
_RADII = ("radius", "radii", "smoothing")
_FITS_TYPES = tuple("BIJKEDF")  # codes of columns with a number or an array of numbers per row
_MOST_HEADER = 65536  # bytes


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
        check.known("read_points", names, ColumnNames)
        self.path = Path(path)
        self.columns = _columns(self.path)
        radius = names.get("radius")
        self._constant = radius if isinstance(radius, (int, float)) else None
        self.used = _chosen(self.path, self.columns, names)

    def __len__(self) -> int:
        return len(self.columns[self.used["positions"][0]])

    def blocks(self, count: int) -> Iterator[Points]:
        """Yields all points, `count` at a time; raises ValueError if a number is not finite."""
        for start in range(0, len(self), count):
            part = slice(start, start + count)
            with told_as(ValueError, str(self.path), "can't be read"):
                found = {name: self._joined(used, part) for name, used in self.used.items()}
                if "colors" in found:
                    kinds = {self.columns[name].dtype for name in self.used["colors"]}
                    found["colors"] = _linear(found["colors"][:, :3], kinds)
                radius = found["radius"][:, 0] if "radius" in found else self._constant
                yield Points(found["positions"], found.get("values"), found.get("colors"), radius)

    def _joined(self, names: Sequence[str], part: slice) -> np.ndarray:
        columns = [np.asarray(self.columns[name][part]) for name in names]
        return np.concatenate([one[:, None] if one.ndim == 1 else one for one in columns], 1)


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
    return next(PointFile(path, **names).blocks(_ALL))


def _columns(path: Path) -> dict[str, np.ndarray]:
    name = path.name.lower()
    ending = next((one for one in ENDINGS if name.endswith("." + one)), None)
    if ending is None:
        raise ValueError(f"{path}: a name of points must end in {', '.join(ENDINGS)}")
    if not path.is_file():
        raise FileNotFoundError(f"file not found: {path}")
    read = {"npz": _read_npz, "ply": _read_ply}.get(ending, _read_fits)
    with told_as(ValueError, str(path), f"can't be read as {ending}"):
        found = {n: one for n, one in read(path).items() if one.dtype.kind in "iuf" and one.ndim}
    sizes = [len(one) for one in found.values()]
    count = max(sizes, key=sizes.count) if sizes else 0  # the length that most columns have
    if not count:
        raise ValueError(f"{path}: holds no columns of numbers")
    meant = _PLACES + _COLORS + _VALUES + _RADII  # columns of other names may have any length
    others = [
        f"{name} ({len(one)})"
        for name, one in found.items()
        if len(one) != count and name.lower().startswith(meant)
    ]
    if others:
        told = f"{path}: not read, since others have {count} rows: {', '.join(others)}"
        warnings.warn(told, stacklevel=4)
    return {n: one for n, one in found.items() if len(one) == count and one.ndim <= 2}


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        size, free = sum(one.file_size for one in archive.infolist()), memory_free()
    if size > free:
        raise ValueError(f"it unpacks to {amount(size)}, {amount(free)} of memory are free")
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
                units = stack.enter_context(fits.open(file, memmap=not packed))
                tables = (u for u in units if isinstance(u, fits.BinTableHDU | fits.TableHDU))
                table = next((u for u in tables if u.header["NAXIS2"]), None)
            if table is None:
                raise ValueError("it has no table with rows")
            begin, size = int(table.fileinfo()["datLoc"]), path.stat().st_size
            most = min(size * MOST_PACKED, memory_free()) if packed else size - begin
            if table.size > most:
                raise ValueError(f"its rows take {table.size} bytes, at most {most} can be there")
            kinds = zip(table.columns.names, table.columns.formats, strict=True)
            return {
                name: np.asarray(table.data[name])
                for name, kind in kinds
                if kind.lstrip("0123456789")[:1] in _FITS_TYPES
            }


def _read_ply(path: Path) -> dict[str, np.ndarray]:
    """Returns the columns of the vertices; only binary rows of fixed size may precede them."""
    with path.open("rb") as file:
        head = file.read(_MOST_HEADER)
        lines = head.partition(b"end_header")[0].decode("ascii").splitlines()
        start = head.find(b"\n", head.find(b"end_header")) + 1
        if not lines or lines[0].strip() != "ply" or start == 0:
            raise ValueError("it has no header of PLY")
        layout, elements = _ply_header(lines)
        skipped = 0
        for name, count, kinds in elements:
            if count < 0:
                raise ValueError(f"it declares {count} of {name}")
            if name != "vertex":
                if kinds is None or layout == "ascii":
                    raise ValueError(f"its vertices come after {name}")
                skipped += count * np.dtype(kinds).itemsize
                continue
            if kinds is None:
                raise ValueError("its vertices have lists")
            size = path.stat().st_size - start - skipped
            dtype = np.dtype(kinds)
            least = count * (2 * len(kinds) - 1 if layout == "ascii" else dtype.itemsize)
            if not 0 < least <= size:
                raise ValueError(f"{count} vertices take {least} bytes, it has {size}")
            if layout == "ascii":
                file.seek(start)
                lines_of = itertools.islice(file, count)
                table = np.loadtxt(lines_of, np.float64, ndmin=2, usecols=range(len(kinds)))
                if len(table) != count:
                    raise ValueError(f"{count} vertices are declared, {len(table)} are there")
                return {n: table[:, i].astype(k[1:]) for i, (n, k) in enumerate(kinds)}
            rows = np.memmap(path, dtype, "r", start + skipped, (count,))
            return {column: rows[column] for column, _ in kinds}
    raise ValueError("it has no vertices")


def _ply_header(
    lines: Sequence[str],
) -> tuple[str, list[tuple[str, int, list[tuple[str, str]] | None]]]:
    """Returns "ascii", "<" or ">", and the name, the number of rows and the columns of each element
    (None if some are lists).
    """
    order, layout = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}, ""
    elements: list[tuple[str, int, list[tuple[str, str]] | None]] = []
    for words in (line.split() for line in lines[1:]):
        if words[:1] == ["format"]:
            layout = order[words[1]]
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            name, count, kinds = elements[-1]
            if words[1] == "list" or kinds is None:
                elements[-1] = (name, count, None)
            elif (kind := number_type(words[1])) is not None:
                kinds.append((words[2], layout + kind))
            else:
                raise ValueError(f"{words[1]!r} is not a number type")
    if not layout:
        raise ValueError("its header has no format")
    return ("ascii" if layout == "=" else layout), elements


def _chosen(
    path: Path, columns: Mapping[str, np.ndarray], names: ColumnNames
) -> dict[str, list[str]]:
    """Returns the names of the columns that make up positions, values, colors and radius."""
    widths = {name: math.prod(one.shape[1:]) for name, one in columns.items()}
    plain = {name.lower(): name for name in columns}
    found: dict[str, list[str]] = {}
    given: Any
    for what, given in names.items():
        if given is None or isinstance(given, (int, float)):
            continue
        words = given.split(",") if isinstance(given, str) else list(given)
        found[what] = [word.strip() for word in words]
        for word in found[what]:
            if word not in columns:
                raise ValueError(f"{path}: has no column {word!r}; it has {', '.join(columns)}")

    def called(what: str, begins: Sequence[str], sizes: Sequence[int]) -> None:
        fits = [
            name
            for low, name in plain.items()
            if low.startswith(tuple(begins)) and widths[name] in sizes
        ]
        if len(fits) > 1:
            raise ValueError(
                f"{path}: {' or '.join(fits)} may be its {what}: say which, as in {what}={fits[0]}"
            )
        if fits:
            found[what] = fits

    def three(what: str, *groups: str) -> bool:
        for group in groups:
            words = group.split()
            if all(word in plain and widths[plain[word]] == 1 for word in words):
                found[what] = [plain[word] for word in words]
                return True
        return False

    if "positions" not in found and not three("positions", "x y z"):
        called("positions", _PLACES, [3])
    if "positions" not in found:
        told = ", ".join(f"{name} ({width})" for name, width in widths.items())
        raise ValueError(f"{path}: which columns are positions? It has {told}")
    if "colors" not in found and not three("colors", "red green blue", "r g b"):
        called("colors", _COLORS, [3, 4])
    if "values" not in found:
        called("values", _VALUES, [1, 2, 3, 4])
    if names.get("radius") is None:
        called("radius", _RADII, [1])
    for what, sizes in (("positions", (3,)), ("colors", (3, 4)), ("radius", (1,))):
        total = sum(widths[name] for name in found.get(what, ()))
        if what in found and total not in sizes:
            raise ValueError(f"{path}: {what} must be {sizes[0]} numbers, the columns are {total}")
    return found


def _linear(colors: np.ndarray, kinds: set[Any]) -> np.ndarray:
    """Converts whole numbers, which are sRGB, to linear colours; others are linear already."""
    if not all(kind.kind in "iu" for kind in kinds):
        return colors
    return array_from_srgb(colors / max(np.iinfo(kind).max for kind in kinds))
