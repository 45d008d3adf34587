"""`slice_picture`: a plane of voxels as a picture, exact to the voxel.

Nothing is interpolated: a voxel is a rectangle of pixels of one colour. From a store, only the
voxels of the plane are read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from ..base import check
from ..base.constants import MAX_PICTURE_SIDE
from ..base.digits import finite_number
from ..base.records import RenderStats
from ..base.units import length_unit, metres
from ..base.volume import Volume, to_numpy
from ..io.stores.store import Store
from ..io.window import window
from ..pictures.letters import draw_letters
from ..pictures.picture import Picture
from ..shaders.labels import Labels
from ..shaders.presets import display_grays
from ..shaders.transfer_function import TransferFunction

_NAME = "slice_picture"  # in messages
Position = float | int | str
Colors = Callable[[np.ndarray], np.ndarray]
#: Up in the picture of the plane across each axis: rows of files run down, and heads are up.
UP = {"x": "+z", "y": "+z", "z": "-y"}
#: Letters of the words for an axis' direction in `ImageInfo.space`.
_DIRECTION_LETTERS = {"right": "R", "left": "L", "anterior": "A", "posterior": "P"}
_DIRECTION_LETTERS |= {"superior": "S", "inferior": "I"}
_OPPOSITE = dict(zip("RASLPI", "LPIRAS", strict=True))
#: Radiological planes, by the letter of the axis across them: name, what is up, what is left.
_RADIOLOGICAL_PLANES = {
    "S": ("axial", "A", "R"),
    "A": ("coronal", "S", "R"),
    "R": ("sagittal", "S", "A"),
}
GAP = 4  # pixels between planes that are shown together


def slice_picture(
    data: Volume | Store,
    axis: str = "z",
    position: Position | tuple[Position, Position, Position] = 0.5,
    *,
    span: tuple[float, float] | None = None,
    colors: Colors | None = None,
    component: int = 0,
    level: int = 0,
    scale: float = 1.0,
    up: str | None = None,
    radiological: bool = False,
    letters: bool = False,
) -> Picture:
    """Returns a plane of voxels across an axis as a picture; where voxels are not cubes, the
    picture keeps their proportions.

    Args:
        data: A volume, or a store, of which only the plane is read.
        axis: x, y, z, or all: the planes across y and x above the one across z, aligned so that
            rows and columns in line show the same position.
        position: A share of the extent, 0 to 1 or "50%"; an int, the index of a voxel of the finest
            level; or world units, "12.5mm". For all axes one, or three (x, y, z).
        span: The values shown black and white, with visually even grays between them: if it is
            (0, 255), the values of 8-bit voxels are their sRGB numbers. If left out, what `window`
            finds, with the background.
        colors: Instead of grays, the colours of values (not their opacity): a transfer function,
            `Labels`, or another function from values (...) to linear red, green, blue (..., 3). Of
            wide labels voxels hold indices: `Labels` is given the labels, others the indices.
        component: Which number of a voxel.
        level: Level of a store; 0 is the finest.
        scale: Pixels along the shortest side of a voxel.
        up: Axis that is up in the picture of one plane, as in "+y"; if left out, -y across z (rows
            run down, as in files), else +z. The other axis runs to the right.
        radiological: Shows patients as radiologists view them: an axial plane from the feet (front
            up), a coronal one from the front, a sagittal one from their left; so their right is on
            the left. Needs data whose `info.space` names the axes' directions, and no `up`.
        letters: Draws letters (R, L, A, P, S, I) at the edges of radiological planes, over voxels.

    Raises:
        ValueError: An argument is unknown, or out of its range.
        OSError: The store can't be read.
    """
    check.one_of(_NAME, "axis", axis, ("x", "y", "z", "all"))
    check.instance(_NAME, "data", data, Volume, Store)
    scale = check.number(_NAME, "scale", scale, low=0, high=MAX_PICTURE_SIDE, open_low=True)
    reader = _PlaneReader(data, component, level)
    colors = _colors(data, span, colors, component)
    views = _views(data.info.space, up, radiological=radiological, letters=letters)
    if axis == "all":
        if up is not None:
            raise ValueError(f"{_NAME}: up is for one plane, not for axis 'all'")
        positions = position if isinstance(position, tuple) else (position,) * 3
        if len(positions) != 3:
            wanted = "one or three, for x, y and z"
            raise ValueError(f"{_NAME}: position must be {wanted}, got {position!r}")
        position_of = dict(zip("xyz", positions, strict=True))
        pixel = min(reader.spacing.values()) / scale
        planes = [reader.colored(n, position_of[n], views[n], pixel, colors) for n in "xyz"]
        _draw_all_letters(planes, [views[n] for n in "xyz"])
        return _picture(_arranged(*planes))
    if isinstance(position, tuple):
        raise ValueError(f"{_NAME}: position must be one for axis {axis}, got {position!r}")
    pixel = min(reader.spacing[n] for n in "xyz" if n != axis) / scale
    view = views[axis] if up is None else PlaneView("", up)
    plane = reader.colored(axis, position, view, pixel, colors)
    _draw_all_letters([plane], [view])
    return _picture(plane)


def _draw_all_letters(planes: Sequence[np.ndarray], views: Sequence[PlaneView]) -> None:
    """Draws the letters of planes that are shown together, all of one size."""
    shortest_side = min(side for plane in planes for side in plane.shape[:2])
    for plane, view in zip(planes, views, strict=True):
        if view.letters:
            draw_letters(plane, view.letters, shortest_side)


def _colors(
    data: Volume | Store, span: tuple[float, float] | None, colors: Colors | None, component: int
) -> Colors:
    """Returns the colours of values: those given, or grays over a span."""
    if colors is None:
        black_white = window(data, component=component, background=True) if span is None else span
        if not isinstance(black_white, (tuple, list)) or len(black_white) != 2:
            raise ValueError(f"{_NAME}: span must be the values of black and white, got {span!r}")
        return TransferFunction(*display_grays()).stretched(*black_white)
    if span is not None:
        raise ValueError(f"{_NAME}: span is for grays; colors have their own values")
    if not callable(colors) or isinstance(colors, type):
        kind = type(colors).__name__
        raise ValueError(f"{_NAME}: colors must be a function of values or Labels, got a {kind}")
    if data.label_values is None or not isinstance(colors, Labels):
        return colors
    labels, looks = to_numpy(data.label_values), colors
    return lambda indices: looks(labels[indices])  # which the voxels hold


def _views(
    space: str | None, up: str | None, *, radiological: bool, letters: bool
) -> dict[str, PlaneView]:
    """Returns the view of the plane across each axis."""
    if not radiological:
        if letters:
            raise ValueError(f"{_NAME}: letters are for radiological planes")
        return {axis: PlaneView("", up_axis) for axis, up_axis in UP.items()}
    if up is not None:
        raise ValueError(f"{_NAME}: radiological planes have a fixed up")
    views = radiological_views(space)
    if not views:
        raise ValueError(f"{_NAME}: the data does not say where its axes point (info.space)")
    return views if letters else {axis: view._replace(letters="") for axis, view in views.items()}


def _arranged(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Joins three planes: those across y and x, side by side, above the one across z."""
    (top, left), (bottom, right) = y.shape[:2], (z.shape[0], x.shape[1])
    image = np.zeros((top + GAP + bottom, left + GAP + right, 3), np.float32)
    image[:top, :left], image[:top, left + GAP :], image[top + GAP :, :left] = y, x, z
    return image


class PlaneView(NamedTuple):
    """The orientation of the plane across an axis in its picture."""

    name: str  # axial, coronal or sagittal; empty where unknown
    up: str  # as in "+z"
    mirrored: bool = False  # the other axis runs to the left
    letters: str = ""  # directions above, to the right, below and to the left, as in ALPR


def radiological_views(space: str | None) -> dict[str, PlaneView]:
    """Returns radiologists' views of the planes across x, y and z, given `ImageInfo.space`; {} if
    that does not name the axes' directions.
    """
    words = (space or "").split("-")
    if len(words) != 3 or not _DIRECTION_LETTERS.keys() >= set(words):
        return {}
    towards = {axis: _DIRECTION_LETTERS[word] for axis, word in zip("xyz", words, strict=True)}
    views = {}
    for axis, letter in towards.items():
        across = letter if letter in _RADIOLOGICAL_PLANES else _OPPOSITE[letter]
        name, above, left = _RADIOLOGICAL_PLANES[across]
        axis_of = {direction: n for n, direction in towards.items() if n != axis}
        rows = axis_of.get(above) or axis_of.get(_OPPOSITE[above])
        columns = axis_of.get(left) or axis_of.get(_OPPOSITE[left])
        if not rows or not columns:
            return {}
        up = ("+" if towards[rows] == above else "-") + rows
        letters = above + _OPPOSITE[left] + _OPPOSITE[above] + left
        views[axis] = PlaneView(name, up, towards[columns] == left, letters)
    return views


class _PlaneReader:
    """Planes of voxels of one component and level."""

    def __init__(self, data: Volume | Store, component: int, level: int) -> None:
        self.data, self.component = data, component
        check.integer(_NAME, "component", component, low=0, high=data.width - 1)
        self.level = check.integer(_NAME, "level", level, low=0)
        if level and not isinstance(data, Store):
            raise ValueError(f"{_NAME}: level is for stores, a volume has one, got {level}")
        extent = data.level_extent(level) if isinstance(data, Store) else data.extent
        self.extent = dict(zip("xyz", extent, strict=True))
        self.finest = dict(zip("xyz", data.extent, strict=True))
        self.step = dict(zip("xyz", data.spacing, strict=True))
        self.spacing = {axis: step * 2**level for axis, step in self.step.items()}
        self.origin = dict(zip("xyz", data.origin, strict=True))
        self.unit = data.info.unit

    def index(self, axis: str, position: Position) -> int:
        """Returns the index of a voxel of the finest level along an axis."""
        count = self.finest[axis]
        if isinstance(position, str):
            text = position.strip()
            if text.endswith("%"):
                percent = finite_number(text[:-1])
                share = text if percent is None else percent
                position = check.number(_NAME, "position", share, low=0, high=100) / 100
            elif re.fullmatch(r"[+-]?\d+", text):
                position = int(text)
            else:
                return self._index_in_world(axis, text)
        if isinstance(position, (float, np.floating)):
            fraction = check.number(_NAME, "position", position, low=0, high=1)
            return min(int(fraction * count), count - 1)
        return check.integer(_NAME, f"position along {axis}", position, low=0, high=count - 1)

    def _index_in_world(self, axis: str, text: str) -> int:
        """Returns the index of the voxel at a world position, as in "12.5mm"."""
        match = re.fullmatch(
            r"([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([a-z\u00b5\u03bc]+)", text
        )
        unit = None if match is None else length_unit(match[2])
        if match is None or unit is None:
            raise ValueError(
                "slice_picture: position must be a share such as 50%, the index of a voxel, or "
                f"world units such as 12.5mm, got {text!r}"
            )
        position = float(match[1])
        if self.unit is not None and unit != self.unit:
            text_metres, data_metres = metres(unit), metres(self.unit)
            if text_metres is None or data_metres is None:
                raise ValueError(f"slice_picture: the unit of the data is {self.unit}, got {text}")
            position *= text_metres / data_metres
        origin, step, count = self.origin[axis], self.step[axis], self.finest[axis]
        index = np.floor((position - origin) / step + 0.5)
        if not 0 <= index < count:
            low, high = (origin + (n - 0.5) * step for n in (0, count))
            ends = f"{low:g} to {high:g} {self.unit or ''}".rstrip()
            raise ValueError(f"slice_picture: {text} lies beyond the data, {axis} is {ends}")
        return int(index)

    def values(self, axis: str, position: Position) -> np.ndarray:
        """Returns the plane across an axis, with the other two in the order z, y, x."""
        index = self.index(axis, position) >> self.level
        low, high = [0, 0, 0], [self.extent[n] for n in "zyx"]
        dimension = "zyx".index(axis)
        low[dimension], high[dimension] = index, index + 1
        if isinstance(self.data, Store):
            region = self.data.read_region(self.level, low, high)
        else:
            box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
            region = to_numpy(self.data.data[box])
        return region[..., self.component].squeeze(dimension)

    def colored(
        self, axis: str, position: Position, view: PlaneView, pixel: float, colors: Colors
    ) -> np.ndarray:
        """Returns (h, w, 3) float32 linear light of the plane; `pixel`: a pixel's world size."""
        up = view.up
        others = [n for n in "zyx" if n != axis]  # of the rows and columns
        choices = [sign + n for n in others for sign in "+-"]
        if up not in choices:
            wanted = f"{check.either(choices)} across {axis}"
            raise ValueError(f"slice_picture: up must be {wanted}, got {up!r}")
        values = self.values(axis, position)
        if up[1] != others[0]:
            values, others = values.T, others[::-1]
        rows, columns = (_voxel_of_pixels(self.extent[n], self.spacing[n] / pixel) for n in others)
        rows = rows[::-1] if up[0] == "+" else rows
        columns = columns[::-1] if view.mirrored else columns
        colored = np.asarray(colors(values), np.float32)
        if colored.ndim != 3 or colored.shape[:2] != values.shape or colored.shape[2] < 3:
            wanted = "red, green, blue (..., 3) of values (...)"
            got = f"{colored.shape} of {values.shape}"
            raise ValueError(f"slice_picture: colors must return {wanted}, got {got}")
        nbytes = len(rows) * len(columns) * colored.shape[2] * colored.itemsize
        check.memory("slice_picture", "the picture", nbytes, torch.device("cpu"))
        return colored[np.ix_(rows, columns)][..., :3]


def _voxel_of_pixels(count: int, size: float) -> np.ndarray:
    """Returns the voxel of each pixel along an axis, for `count` voxels of `size` pixels each."""
    pixels = max(1, round(count * size))
    if pixels > MAX_PICTURE_SIDE:
        problem = f"{pixels} pixels are more than {MAX_PICTURE_SIDE}"
        raise ValueError(f"slice_picture: {problem}: use a smaller scale")
    return ((np.arange(pixels) + 0.5) * (count / pixels)).astype(np.int64)


def _picture(image: np.ndarray) -> Picture:
    color = torch.from_numpy(np.ascontiguousarray(image))
    ones = torch.ones_like(color[..., :1])
    return Picture(
        color=color,
        alpha=ones,
        depth=0 * ones,
        nearest=0 * ones,
        samples=ones.int(),
        stats=RenderStats(),
    )
