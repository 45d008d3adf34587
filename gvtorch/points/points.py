"""`Points`: positions with values, and optional colours and radii."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base import check


@dataclass(frozen=True, eq=False)
class Points:
    """Points in the world. Tensors and lists become arrays, of float64 unless given as float32;
    arrays of these dtypes are not copied, so they must not be changed afterwards.

    Attributes:
        positions: (n, 3) x, y, z.
        values: (n, c) numbers that add up, such as mass, light, or premultiplied colour and
            opacity; (n,) counts as (n, 1); 1 each if left out.
        colors: (n, 3) linear red, green, blue, at least 0.
        radius: (n,) world units, or one for all: how far a point extends from its position along
            each axis. 0, or left out: the point lies in one voxel.
    """

    positions: Any
    values: Any = None
    colors: Any = None
    radius: Any = None

    def __post_init__(self) -> None:
        positions = _checked_array("positions", self.positions)
        count = len(positions) if positions.ndim == 2 else 0
        if positions.ndim != 2 or positions.shape[1] != 3 or not count:
            raise ValueError(f"Points: positions must be (n, 3), n >= 1, got {positions.shape}")
        ones = np.ones((count, 1), np.float32)
        value = ones if self.values is None else _checked_array("values", self.values)
        value = value[:, None] if value.ndim == 1 else value
        if value.ndim != 2 or len(value) != count or not value.shape[1]:
            got = value.shape
            raise ValueError(f"Points: values must be ({count},) or ({count}, c), got {got}")
        vars(self).update(positions=positions, values=value)
        for name, shape in (("colors", (count, 3)), ("radius", (count,))):
            if (attribute := getattr(self, name)) is None:
                continue
            array = _checked_array(name, attribute)
            array = np.broadcast_to(array, shape) if name == "radius" and not array.ndim else array
            if array.shape != shape:
                raise ValueError(f"Points: {name} must be {shape}, got {array.shape}")
            if bool((array < 0).any()):
                raise ValueError(f"Points: {name} must be at least 0, got {array.min():g}")
            vars(self)[name] = array

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def width(self) -> int:
        """How many numbers a point's value has."""
        return int(self.values.shape[1])

    def part(self, start: int, stop: int) -> Points:
        """Returns some of the points; nothing is copied."""
        names = ("positions", "values", "colors", "radius")
        arrays = (None if (array := getattr(self, n)) is None else array[start:stop] for n in names)
        return Points(*arrays)

    def blocks(self, count: int) -> Iterator[Points]:
        """Yields all points, `count` at a time."""
        for start in range(0, len(self), count):
            yield self.part(start, start + count)

    def lit(self, opacity: float = 1e-4) -> Points:
        """Returns points whose values are light: red, green, blue (the first value times the
        colour, or times white without colours) and an opacity, as read by
        `gv.StoredColor("value", premultiplied=True)`. ValueError if there are no colours, but
        values of three or more numbers, which are likely to be colours.
        """
        check.number("Points.lit", "opacity", opacity, low=0, high=1, open_low=True)
        if self.colors is None and self.width > 2:
            problem = f"values of {self.width} numbers: light is one number, colours are `colors`"
            raise ValueError(f"Points.lit: {problem}")
        color = np.ones((1, 3)) if self.colors is None else self.colors
        light = self.values[:, :1] * color
        return replace(self, values=np.concatenate((light, np.full_like(light[:, :1], opacity)), 1))

    def __repr__(self) -> str:
        parts = [f"{len(self)}", f"values of {self.width}"]
        parts += [name for name in ("colors", "radius") if getattr(self, name) is not None]
        return f"Points({', '.join(parts)})"


def _checked_array(name: str, value: Any) -> np.ndarray:
    check.no_gradient("Points", name, value)
    try:
        array = check.real_array(value)
        if array.dtype != np.float32:
            array = array.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise ValueError(f"Points: {name} must be numbers, got {check.as_text(value)}") from None
    if not bool(np.isfinite(array).all()):
        raise ValueError(f"Points: {name} must be finite, got NaN or infinity")
    return array
