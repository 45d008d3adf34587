"""`TransferFunction`: value -> linear RGB and opacity, piecewise linear; and its tables.

Opacity is given per reference length: it is the alpha of a slab of that thickness filled with the
value. Colours are not premultiplied here; the renderer composites premultiplied.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..base import check
from ..base.checked import Check, class_name, optional, positive
from ..base.lasting import lasting
from ..base.messages import one_line
from ..base.whole_file import write_text
from .preset_files import paraview_item, read_preset
from .presets import CT_PRESETS, Points, preset_points
from .shader import LARGEST, ColorTable, Sampling, Shader, alpha_over

_CACHED_TABLES = 8  # cached tables of a function
_FOREIGN_KEYS = {"RGBPoints", "volumeProperties"}  # keys of other programs' files
# Cells of a table.
_MIN_CELLS = 2**10
_MIN_SAMPLED_CELLS = 2**12  # fewest where corners fall between rows
_CELLS_APART = 16  # least distance of two corners that fall between rows
_MANY_CELLS = 2**16  # most with all corners on rows; more only if no other table is possible
_MAX_CELLS = 2**20
_MIN_PAIRED_CELLS, _MAX_PAIRED_CELLS = 128, 256  # along a side of an integrated table
_MIN_PARTS, _MAX_PARTS = 8, 4096  # parts in which each of these cells is integrated


class TransferFunction(Shader):
    """Two piecewise linear functions of a value in data units, constant beyond their end points. By
    itself it is the plain shader; it is a part of most others. Attributes may be edited: the next
    picture uses them (a `TreeTracer` or a captured frame keeps those it was made with).

    Attributes:
        opacity: (k, 2) float64 points (value, alpha per reference length).
        color: (k, 4) float64 points (value, linear r, g, b).
        reference: World units, or None for the smallest spacing of what is rendered.
        relative: Whether its values have no meaning until the function is `stretched` over data.
    """

    opacity: np.ndarray
    color: np.ndarray
    reference: float | None
    relative = False
    checks: ClassVar[Mapping[str, Check]] = {
        "opacity": lambda owner, name, points: _checked_points(class_name(owner), name, points, 2),
        "color": lambda owner, name, points: _checked_points(class_name(owner), name, points, 4),
        "reference": optional(positive),
    }

    def __init__(
        self, opacity: Points, color: Points = ((0, 1, 1, 1),), reference: float | None = None
    ) -> None:
        """Makes a transfer function from its corner points.

        Args:
            opacity: Points (value, alpha), values strictly increasing, alpha in [0, 1] per
                reference length.
            color: Points (value, red, green, blue), linear, in [0, 1]; white if left out.
            reference: World units; the smallest spacing of the volume if left out.

        Raises:
            ValueError: No points, values that do not increase, numbers out of [0, 1] or not finite.
        """
        self.opacity, self.color, self.reference = opacity, color, reference  # type: ignore[assignment]
        self._tables: dict[Any, ColorTable] = {}

    @classmethod
    def from_points(
        cls, opacity: Points, color: Points = ((0, 1, 1, 1),), reference: float | None = None
    ) -> TransferFunction:
        """Same as calling the class."""
        return cls(opacity, color, reference)

    @classmethod
    def from_json(cls, path: str | Path) -> TransferFunction:
        """Reads `{"opacity": [[v, a], ...], "color": [[v, r, g, b], ...], "reference": length}`.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is not such JSON, or `from_points` rejects its points.
        """
        content = check.json_file("transfer function file", path)
        if not isinstance(content, dict) or "opacity" not in content:
            raise ValueError(f'{path}: expected an object with "opacity", "color" and "reference"')
        known = ("opacity", "color", "reference")
        if unknown := sorted(set(content) - set(known)):
            raise ValueError(f"{path}: unknown key {unknown[0]!r}; known: {', '.join(known)}")
        try:
            return cls.from_points(**content)
        except ValueError as error:
            raise ValueError(f"{path}: {one_line(error)}") from None

    @classmethod
    def from_file(cls, path: str | Path, name: str | None = None) -> TransferFunction:
        """Reads a file of `save`, or a preset of another program: ParaView's .json, 3D Slicer's
        .vp, .vp.json or presets.xml. Their colours are converted from sRGB to linear; a warning
        lists what is lost (shading, opacity by gradient). ParaView's values are often only
        relative: `stretched` fits them to data.

        Args:
            path: The file.
            name: Which preset, where the file has several.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is not such a file, has no such preset, or its points are rejected.
        """
        if str(path).endswith(".json") and Path(path).is_file():
            content = check.json_file("transfer function file", path)
            keys = content.keys() if isinstance(content, dict) else ()  # then from_json raises
            if not isinstance(content, list) and _FOREIGN_KEYS.isdisjoint(keys):
                if name is not None:
                    raise ValueError(f"{path}: holds one function, without a name: leave it out")
                return cls.from_json(path)
        (opacity, color), reference, relative = read_preset(path, name)
        try:
            function = cls(opacity, color, reference)
        except ValueError as error:
            raise ValueError(f"{path}: {one_line(error)}") from None
        function.relative = relative
        return function

    @classmethod
    def preset(
        cls, name: str, low: float | None = None, high: float | None = None
    ) -> TransferFunction:
        """Returns a named function, stretched over the values [low, high], which `gv.window` can
        find: gray, hot, vessels, bone, tissue, mr, em, cloud, galaxy, or any colour map of
        matplotlib. Those in Hounsfield units, ct-bone, ct-soft, ct-lung, ct-vessels, keep their
        values if none are given.

        Raises:
            ValueError: The name is unknown, or the preset needs values.
        """
        function = cls(*preset_points(name))
        if (low is None) != (high is None) or (low is None and name not in CT_PRESETS):
            raise ValueError(f"preset {name!r} is stretched over values: give low and high")
        return function if low is None or high is None else function.stretched(low, high)

    def stretched(self, low: float, high: float) -> TransferFunction:
        """Returns the function with its first corner point moved to `low` and its last to `high`; a
        `high` equal to `low` becomes low + max(1, 1e-6 |low|). Raises ValueError if it is below.
        """
        context = "TransferFunction.stretched"
        low = check.number(context, "low", low, low=-LARGEST, high=LARGEST)
        high = check.number(context, "high", high, low=-LARGEST, high=LARGEST)
        if high < low:
            raise ValueError(f"{context}: high must be >= low, got {low:g} and {high:g}")
        if high == low:
            high = low + max(1.0, 1e-6 * abs(low))
        first, last, _ = self.corners()
        parts = []
        for points in (self.opacity, self.color):
            values = low + (points[:, :1] - first) / (last - first) * (high - low)
            parts.append(np.concatenate((values, points[:, 1:]), 1))
        return type(self)(parts[0].tolist(), parts[1].tolist(), self.reference)

    def save(self, path: str | Path) -> None:
        """Writes the .json that `from_file` reads; ValueError if the path has another ending."""
        if Path(path).suffix != ".json":
            raise ValueError(f"TransferFunction.save: path must end in .json, got {str(path)!r}")
        write_text(Path(path), self.to_json() + "\n")

    def to_json(self) -> str:
        """Returns the text that `from_json` reads."""
        content = {"opacity": self.opacity.tolist(), "color": self.color.tolist()}
        return json.dumps({**content, "reference": self.reference} if self.reference else content)

    def to_paraview(self, name: str = "gvtorch") -> str:
        """Returns the text of a ParaView preset (.json), as its colour map editor imports it. Its
        colours are sRGB, in which linear ramps are curves: points are added to follow them.
        """
        item = paraview_item(self.opacity, self.color)
        return json.dumps([{"ColorSpace": "RGB", "Name": name, **item}])

    def __repr__(self) -> str:
        """Returns how many corner points it has, and its first and last value."""
        low, high, _ = self.corners()
        points = f"{len(self.opacity)} opacities, {len(self.color)} colours"
        return f"TransferFunction({points}, from {low:g} to {high:g})"

    def __call__(self, value: np.ndarray) -> np.ndarray:
        """Returns (..., 4) linear RGB and opacity per reference length, exactly, in float64."""
        channels = [np.interp(value, self.color[:, 0], self.color[:, i]) for i in (1, 2, 3)]
        return np.stack([*channels, np.interp(value, *self.opacity.T)], axis=-1)

    @property
    def shows_nothing(self) -> bool:
        return not self.opacity[:, 1].any()

    def corners(self) -> tuple[float, float, np.ndarray]:
        """Returns a table's first and last value, and (k,) positions of corners between, 0 to 1."""
        values = np.unique(np.concatenate((self.opacity[:, 0], self.color[:, 0])))
        low, high = float(values[0]), float(values[-1])
        if high == low:
            high = low + max(1.0, abs(low))
        return low, high, np.unique((values - low) / (high - low))  # rounding may make some equal

    def table(self, sampling: Sampling) -> ColorTable:
        """Returns the function as the kernel reads it: rows at even distances over a domain. The
        last few tables are cached.

        Rows are placed so that every corner point falls on one, if that takes no more than 2^16
        cells; otherwise so densely that corners are at least 16 cells apart. There are at least
        1,024 cells. Between rows, colour and alpha are linear.

        Raises:
            ValueError: Two points are too close to each other.
        """
        return self.kept(TransferFunction._make_table, sampling)

    @lasting
    def kept(
        self, make: Callable[[TransferFunction, Sampling], ColorTable], sampling: Sampling
    ) -> ColorTable:
        """Returns the table `make` computes from the current function; the last few are cached."""
        key = make, self.opacity.tobytes(), self.color.tobytes(), self.reference, sampling
        if key not in self._tables:
            self.check_again()  # points may have been edited in place
            table = make(self, sampling)
            if len(self._tables) == _CACHED_TABLES:
                self._tables.pop(next(iter(self._tables)))
            self._tables[key] = table
        return self._tables[key]

    def rows(self) -> tuple[float, float, np.ndarray]:
        """Returns the first and last value of a table, and its rows (m, 4): linear RGB and opacity
        per reference length, in float64. See `table`.
        """
        low, high, positions = self.corners()
        cells = _cell_count(positions)
        if cells is None:
            index = int(np.diff(positions).argmin())
            first, second = low + positions[index : index + 2] * (high - low)
            raise ValueError(
                f"TransferFunction: values {first:g} and {second:g} are too close "
                f"for a table of {_MAX_CELLS + 1} rows from {low:g} to {high:g}"
            )
        return low, high, self(low + (high - low) * np.arange(cells + 1) / cells)

    def _make_table(self, sampling: Sampling) -> ColorTable:
        low, high, rows = self.rows()
        levels = sampling.fitting(len(rows))
        alpha = alpha_over(sampling.lengths(self.reference, levels)[:, None], rows[:, 3])
        colors = np.broadcast_to(rows[:, :3], (levels, *rows[:, :3].shape))
        table = np.concatenate((colors, alpha[..., None]), 2)
        return ColorTable.of(table, (low, high), rows[:, 3] > 0, sampling)


def integrated_table(transfer: TransferFunction, sampling: Sampling) -> ColorTable:
    """Integrates a transfer function over pairs of values, in float64: the colour of an interval in
    which the value changes linearly from the one in front to the one behind. Within each cell of
    the table the function is replaced by its mean, so a peak thinner than a cell keeps its opacity.

    Returns:
        (l, m, m, 4): premultiplied colour and alpha by the values in front and behind.

    Source: Engel, Kraus, Ertl, "High-quality pre-integrated volume rendering using
    hardware-accelerated pixel shading", Graphics Hardware 2001.
    """
    low, high, positions = transfer.corners()
    exact = _common_cells(positions, _MAX_PAIRED_CELLS)
    cells = exact * math.ceil(_MIN_PAIRED_CELLS / exact) if exact else _MAX_PAIRED_CELLS
    gap = float(np.diff(positions, append=2.0).min())
    parts = min(_MAX_PARTS, max(_MIN_PARTS, math.ceil(4 / (gap * cells))))
    middles = (np.arange(cells * parts) + 0.5) / (cells * parts)
    samples = transfer(low + (high - low) * middles).reshape(cells, parts, 4)
    density = -np.log1p(-np.minimum(samples[..., 3], 1 - 1e-16))  # per reference length
    thickness = density.mean(1)
    weight = density / np.maximum(density.sum(1, keepdims=True), 1e-300)
    color = (weight[..., None] * samples[..., :3]).sum(1)
    rows = transfer(low + (high - low) * np.arange(cells + 1) / cells)
    lengths = sampling.lengths(transfer.reference, sampling.fitting(len(rows) ** 2))
    table = np.stack([_pairs(rows, thickness, color, length) for length in lengths])
    # A range that reaches into a cell is tested with both of the cell's rows, so it is enough to
    # mark one of them: not the first or last row, which also represent values beyond the domain.
    visible = rows[:, 3] > 0
    visible[1:-1] |= thickness[:-1] > 0
    visible[-2] |= thickness[-1] > 0
    return ColorTable.of(table, (low, high), visible, sampling)


def _pairs(rows: np.ndarray, thickness: np.ndarray, color: np.ndarray, length: float) -> np.ndarray:
    """Returns (m, m, 4) for intervals of one length."""
    count = len(rows)
    out = np.zeros((count, count, 4))
    diagonal = np.arange(count)
    alpha = alpha_over(length, rows[:, 3])
    out[diagonal, diagonal] = np.concatenate((rows[:, :3] * alpha[:, None], alpha[:, None]), 1)
    opaque_color = np.concatenate((color, np.ones((len(color), 1))), 1)
    for distance in range(1, count):
        # Transmittance of each cell in between.
        transmittance = np.exp(-thickness * (length / distance))
        emission = opaque_color * (1 - transmittance)[:, None]
        low = np.arange(count - distance)
        for backwards in (False, True):
            step = -1 if backwards else 1
            transmittance_w = sliding_window_view(transmittance, distance)[:, ::step]
            # Shape (w, 4, distance).
            emission_w = sliding_window_view(emission, distance, axis=0)[:, :, ::step]
            clear = np.ones_like(transmittance_w)
            np.cumprod(transmittance_w[:, :-1], axis=1, out=clear[:, 1:])
            colors = np.matmul(emission_w, clear[:, :, None])[:, :, 0]
            out[(low + distance, low) if backwards else (low, low + distance)] = colors
    return out


def _cell_count(positions: np.ndarray) -> int | None:
    """Returns how many cells of [0, 1] suit corners at these positions; None: too dense."""
    exact_cells = _common_cells(positions, _MAX_CELLS, tolerance=1e-9)
    gap = float(np.diff(positions, append=2.0).min())
    sampled_cells = 2 ** math.ceil(math.log2(_CELLS_APART / max(gap, 1e-9)))
    sampled_cells = max(_MIN_SAMPLED_CELLS, sampled_cells)
    if exact_cells and (exact_cells <= _MANY_CELLS or sampled_cells > _MAX_CELLS):
        return exact_cells * math.ceil(_MIN_CELLS / exact_cells)
    return sampled_cells if sampled_cells <= _MAX_CELLS else None


def _common_cells(
    positions: Iterable[float], limit: int, tolerance: float = math.inf
) -> int | None:
    """Returns the fewest equal cells of [0, 1] with all positions on cell ends; None: it takes more
    than `limit`, or a position is off by more than `tolerance`.
    """
    cells = 1
    for position in positions:
        fraction = Fraction(float(position)).limit_denominator(limit)
        cells = math.lcm(cells, fraction.denominator)
        if cells > limit or abs(float(fraction) - position) > tolerance:
            return None
    return cells


def _checked_points(context: str, name: str, points: Points, width: int) -> np.ndarray:
    names = "(value, alpha)" if width == 2 else "(value, red, green, blue)"

    def refusal(wanted: str) -> ValueError:
        return ValueError(f"{context}: {name} {wanted}, got {check.quoted(points)}")

    try:
        rows = [list(point) for point in points]
        for number in (number for row in rows for number in row):
            check.no_gradient(context, name, number)
        array = np.array([[float(number) for number in row] for row in rows])
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{context}: {name} must be a list of points {names}") from None
    if array.ndim != 2 or array.shape[0] == 0 or array.shape[1] != width:
        raise refusal(f"must be a list of points {names}")
    points = array.tolist()
    if not (np.abs(array) <= LARGEST).all():
        raise refusal(f"must be finite and at most {LARGEST:g}")
    steps = np.diff(array[:, 0])
    if (steps <= 0).any():
        index = int(np.argmax(steps <= 0))
        got = f"{array[index, 0]:g} before {array[index + 1, 0]:g}"
        hint = "for a jump use two values close to each other"
        raise ValueError(f"{context}: {name} values must increase, got {got} ({hint})")
    if (array[:, 1:] < 0).any() or (array[:, 1:] > 1).any():
        raise refusal("numbers must lie in [0, 1]")
    return array
