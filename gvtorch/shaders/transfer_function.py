"""`TransferFunction`: value -> linear RGB and opacity, piecewise linear.

Opacity is given per reference length: a slab that long, filled with the value, has that alpha. The
colour of a value is its own (not premultiplied); the renderer composites premultiplied.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base import check

Points = Sequence[Sequence[float]]

#: Presets over [0, 1], which stands for the range of the data: opacity (v, a) and colour (v, r, g,
#: b).
PRESETS: dict[str, tuple[Points, Points]] = {
    "gray": ([(0, 0), (0.05, 0), (1, 0.5)], [(0, 0, 0, 0), (1, 1, 1, 1)]),
    "hot": (
        [(0, 0), (0.1, 0), (0.4, 0.05), (1, 0.6)],
        [(0, 0.1, 0, 0), (0.35, 0.9, 0.1, 0), (0.7, 1, 0.6, 0.05), (1, 1, 1, 0.8)],
    ),
    "vessels": (
        [(0, 0), (0.15, 0), (0.3, 0.25), (0.6, 0.9), (1, 0.95)],
        [(0, 0.3, 0.02, 0.02), (0.3, 0.55, 0.05, 0.03), (0.6, 0.9, 0.45, 0.25), (1, 1, 0.95, 0.8)],
    ),
    "bone": (
        [(0, 0), (0.45, 0), (0.55, 0.02), (0.65, 0.4), (1, 0.9)],
        [(0, 0.3, 0.1, 0.05), (0.5, 0.6, 0.25, 0.15), (0.65, 0.9, 0.8, 0.6), (1, 1, 1, 0.95)],
    ),
    "tissue": (
        [(0, 0), (0.3, 0), (0.45, 0.03), (0.6, 0.2), (0.8, 0.8), (1, 0.9)],
        [(0, 0.4, 0.15, 0.1), (0.3, 0.8, 0.4, 0.25), (0.6, 0.95, 0.75, 0.5), (1, 1, 1, 0.95)],
    ),
}

# Cells of a table: at least; at least, where corners fall beside rows; how many of them two corners
# are then apart; most where corners fall on rows and there could be fewer; most at all.
_FEWEST_CELLS, _FEWEST_SAMPLED, _CELLS_APART, _MANY_CELLS, _MOST_CELLS = (
    2**10,
    2**12,
    16,
    2**16,
    2**20,
)
_MOST_BYTES = 64 * 2**20  # of a table in float32
_KEPT_TABLES = 4


class TransferFunction:
    """Two piecewise linear functions of a value in data units; constant beyond their end points.

    Attributes may be edited: the next picture is made with them (a `TreeTracer` or a captured
    frame keeps those it was made with).

    Attributes:
        opacity: (k, 2) float64 points (value, alpha per reference length).
        color: (k, 4) float64 points (value, linear r, g, b).
        reference: World units, or None for the smallest spacing of what is rendered.
    """

    def __init__(self, opacity: Points, color: Points, reference: float | None = None) -> None:
        """See `from_points`."""
        self.opacity = _points("opacity", opacity, 2)
        self.color = _points("color", color, 4)
        if reference is not None:
            reference = check.number(
                "TransferFunction", "reference", reference, low=0, open_low=True
            )
        self.reference = reference
        self._tables: dict[tuple[Any, ...], Table] = {}

    @classmethod
    def from_points(
        cls, opacity: Points, color: Points = ((0, 1, 1, 1),), reference: float | None = None
    ) -> TransferFunction:
        """Makes a transfer function from its corner points.

        Args:
            opacity: Points (value, alpha), values strictly increasing, alpha in [0, 1] per
                reference length.
            color: Points (value, red, green, blue), linear, in [0, 1]; white if left out.
            reference: World units; the smallest spacing of the volume if left out.

        Raises:
            ValueError: No points, values that do not increase, numbers out of [0, 1] or not finite.
        """
        return cls(opacity, color, reference)

    @classmethod
    def from_json(cls, path: str | Path) -> TransferFunction:
        """Reads `{"opacity": [[v, a], ...], "color": [[v, r, g, b], ...], "reference": length}`.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is no such JSON, or its points are refused by `from_points`.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"transfer function file not found: {path}")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ValueError(f"{path}: not a JSON file: {error}") from None
        if not isinstance(content, dict) or "opacity" not in content:
            raise ValueError(f'{path}: expected an object with "opacity", "color" and "reference"')
        unknown = sorted(set(content) - {"opacity", "color", "reference"})
        if unknown:
            raise ValueError(
                f"{path}: unknown key {unknown[0]!r}; known: opacity, color, reference"
            )
        try:
            return cls.from_points(**content)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @classmethod
    def preset(cls, name: str, low: float, high: float) -> TransferFunction:
        """Stretches a named preset over the data range [low, high].

        Raises:
            ValueError: The name is unknown.
        """
        if name not in PRESETS:
            raise ValueError(f"unknown preset {name!r}; known: {', '.join(sorted(PRESETS))}")
        if not high > low:
            high = low + max(1.0, 1e-6 * abs(low))
        opacity, color = PRESETS[name]
        return cls(
            [(low + v * (high - low), a) for v, a in opacity],
            [(low + point[0] * (high - low), *point[1:]) for point in color],
        )

    def to_json(self) -> str:
        """Returns the text that `from_json` reads."""
        content = {"opacity": self.opacity.tolist(), "color": self.color.tolist()}
        return json.dumps({**content, "reference": self.reference} if self.reference else content)

    def __call__(self, value: np.ndarray) -> np.ndarray:
        """Returns (..., 4) linear RGB and opacity per reference length, exactly, in float64."""
        channels = [np.interp(value, self.color[:, 0], self.color[:, i]) for i in (1, 2, 3)]
        return np.stack([*channels, np.interp(value, *self.opacity.T)], axis=-1)

    def table(
        self,
        smallest_spacing: float,
        step: float,
        levels: int,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> Table:
        """Returns the function as the kernel reads it: rows at even distances over a domain.

        Rows are laid so that every corner point falls on one, where that takes no more than 2^16
        cells; else so densely that corners are at least 16 cells apart. There are at least 1,024
        cells. Between rows, colour and alpha are linear.

        Args:
            smallest_spacing: World units; opacity's reference length where none was given.
            step: World length of the shortest interval.
            levels: How many lengths of intervals, each twice the one before; fewer where tables
                would take more than 64 MB.
            dtype: Of table and domain.
            device: Where they lie. The last tables are kept: asking again costs nothing.

        Raises:
            ValueError: Two points are too close to each other.
        """
        number = self.reference or smallest_spacing
        key = (
            self.opacity.tobytes(),
            self.color.tobytes(),
            number,
            step,
            levels,
            dtype,
            str(device),
        )
        if key not in self._tables:
            table = self._make_table(step / number, levels, dtype, torch.device(device))
            if len(self._tables) == _KEPT_TABLES:
                self._tables.pop(next(iter(self._tables)))
            self._tables[key] = table
        return self._tables[key]

    def _make_table(
        self, length: float, levels: int, dtype: torch.dtype, device: torch.device
    ) -> Table:
        """`length`: of the shortest interval, in reference lengths."""
        corners = np.unique(np.concatenate((self.opacity[:, 0], self.color[:, 0])))
        low, high = float(corners[0]), float(corners[-1])
        if high == low:
            high = low + max(1.0, abs(low))
        cells = _grid((corners - low) / (high - low))
        if cells is None:
            gap = np.diff(corners)
            at = int(gap.argmin())
            raise ValueError(
                f"TransferFunction: values {corners[at]:g} and {corners[at + 1]:g} are too close "
                f"for a table of {_MOST_CELLS + 1} rows from {low:g} to {high:g}"
            )
        rows = self(low + (high - low) * np.arange(cells + 1) / cells)
        levels = max(1, min(levels, _MOST_BYTES // (16 * len(rows))))
        lengths = length * 2.0 ** np.arange(levels)
        with np.errstate(divide="ignore"):
            alpha = -np.expm1(lengths[:, None] * np.log1p(-rows[:, 3]))
        table = np.concatenate(
            (np.broadcast_to(rows[:, :3], (levels, *rows[:, :3].shape)), alpha[..., None]), 2
        )
        return Table(
            table_lm4=torch.tensor(table, dtype=dtype, device=device),
            domain_2=torch.tensor([low, high], dtype=dtype, device=device),
            opaque_m=torch.tensor(np.cumsum(rows[:, 3] > 0), dtype=torch.int32, device=device),
        )


@dataclass(frozen=True, kw_only=True)
class Table:
    """A transfer function as the kernel reads it."""

    table_lm4: Tensor  # (l, m, 4) linear RGB, alpha of an interval of step * 2^l
    domain_2: Tensor  # (2,) value of the first row, of the last row
    opaque_m: Tensor  # (m,) int32, how many rows up to this one have an opacity


def interval_levels(root_voxel: float, step: float) -> int:
    """Returns how many lengths of intervals a tree needs: up to that of a voxel of its root."""
    return max(1, math.ceil(math.log2(root_voxel / step)) + 1)


def corner_cells(
    transfer: TransferFunction, fewest: int, most: int
) -> tuple[float, float, int, float]:
    """Returns the first and last value of a coarse table, its cells, and the smallest distance of
    two corner points as a part of it. Corners fall on rows where `most` cells allow it.
    """
    corners = np.unique(np.concatenate((transfer.opacity[:, 0], transfer.color[:, 0])))
    low, high = float(corners[0]), float(corners[-1])
    if high == low:
        high = low + max(1.0, abs(low))
    places = (corners - low) / (high - low)
    gap = float(np.diff(places, append=2.0).min())
    exact = 1
    for place in places:
        exact = math.lcm(exact, Fraction(float(place)).limit_denominator(most).denominator)
        if exact > most:
            return low, high, most, gap
    return low, high, exact * math.ceil(fewest / exact), gap


def _grid(places: np.ndarray) -> int | None:
    """A number of cells of [0, 1] fine enough for corners at these places; None: there is none."""
    exact = 1
    for place in places:
        fraction = Fraction(float(place)).limit_denominator(_MOST_CELLS)
        exact = math.lcm(exact, fraction.denominator)
        if abs(float(fraction) - place) > 1e-9 or exact > _MOST_CELLS:
            exact = 0
            break
    gap = float(np.diff(places, append=2.0).min())
    dense = max(_FEWEST_SAMPLED, 2 ** math.ceil(math.log2(_CELLS_APART / gap)))
    if exact and (exact <= _MANY_CELLS or dense > _MOST_CELLS):
        return exact * math.ceil(_FEWEST_CELLS / exact)
    return dense if dense <= _MOST_CELLS else None


def _points(name: str, points: Points, width: int) -> np.ndarray:
    where = "TransferFunction"
    names = "(value, alpha)" if width == 2 else "(value, red, green, blue)"
    try:
        array = np.array([[float(number) for number in point] for point in points])
    except (TypeError, ValueError):
        raise ValueError(f"{where}: {name} must be a list of points {names}") from None
    if array.ndim != 2 or array.shape[0] == 0 or array.shape[1] != width:
        raise ValueError(f"{where}: {name} must be a list of points {names}, got {points!r}")
    if not np.isfinite(array).all():
        raise ValueError(f"{where}: {name} must be finite, got {points!r}")
    steps = np.diff(array[:, 0])
    if (steps <= 0).any():
        at = int(np.argmax(steps <= 0))
        raise ValueError(
            f"{where}: {name} values must increase, "
            f"got {array[at, 0]:g} before {array[at + 1, 0]:g} "
            "(for a jump use two values close to each other)"
        )
    if (array[:, 1:] < 0).any() or (array[:, 1:] > 1).any():
        raise ValueError(f"{where}: {name} numbers must lie in [0, 1], got {points!r}")
    return array
