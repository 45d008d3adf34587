"""`Labels`: shows volumes whose voxels hold the numbers of objects, as segmentations do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from typing import Any, Literal, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.image_info import array_from_srgb
from ..ops.shading import LabelNumbers
from ..pool import N3Tree
from .colors import distinct_colors, linear_color
from .lights import LitShader
from .shader import ColorTable, Sampling

BACKGROUND = 0
_MOST_ROWS = 2**24  # of a table, so that float32 can index its rows
_KEPT = 8  # cached tables and label tensors
_Made = TypeVar("_Made")


class Labels(LitShader):
    """Shows each label in its own colour. A sample has the label of its nearest voxel; on the face
    between two voxels, that of the one with the higher index. Labels are never mixed; where two
    levels of detail blend, their colours do. `Hits.label` and `Picture.label` hold what is seen.

    It reads a channel of labels (`Volume(..., labels=True)`). If lit, the normal of a sample is
    the mean direction to voxels of other labels around it, turned towards the eye. They are
    searched as many voxels to each side as bricks have for a border, 1 to 3: for a ball it is off
    by 11 degrees on average with 1, by 4 with 2, by 2 with 3. Without such voxels a sample is lit
    as if it faced the light.

    Attributes may be edited, also in place: the next picture uses them.

    Attributes:
        colors: By label, or in the order 0, 1, 2, ...; other labels get distinct colours.
        opacity: Of all labels, or by label (1 for those left out), per reference length.
        visible: The labels that are shown; None: all but 0, the background; "all": all.
        reference: World units, or None for the smallest spacing.
        lit: Whether they are lit.
    """

    kind = "Labels"
    reads_labels = True

    def __init__(
        self,
        colors: Mapping[int, Any] | Sequence[Any] | np.ndarray | Tensor | None = None,
        opacity: float | Mapping[int, float] = 1.0,
        visible: Iterable[int] | Literal["all"] | None = None,
        *,
        channel: str | None = None,
        reference: float | None = None,
        lit: bool = True,
        **light: Any,
    ) -> None:
        """See the class.

        Args:
            colors: By label, or in the order 0, 1, 2, ...; each is linear red, green, blue, or a
                name or #RRGGBB in sRGB. An array (k, 3) of uint8 holds sRGB. Labels left out get
                distinct colours.
            opacity: Of all labels, or by label (1 for those left out), in [0, 1]; labels with
                opacity 0 are treated as not present.
            visible: The labels that are shown; None: all but 0, the background; "all": all.
            channel: Name of the channel of labels; None: that of the options.
            reference: World units for which opacity is given; None: the smallest spacing.
            lit: False shows flat colours.
            **light: `light`, `ambient`, `diffuse`, `specular` and `shininess` of `LitShader`.

        Raises:
            ValueError: A number is out of its range, or a colour is unknown.
        """
        if "normals" in light:
            raise ValueError("Labels: normals are those of the labels, got normals")
        super().__init__(**{"ambient": 0.3, "diffuse": 0.7, "specular": 0.15, **light})
        if isinstance(visible, Iterator):  # it could be iterated only once
            visible = [*visible]
        self.colors, self.opacity, self.visible = colors, opacity, visible
        self.channel, self.reference, self.lit = channel, reference, lit
        self._kept: dict[Any, tuple[Any, Any]] = {}
        self._look()

    def __repr__(self) -> str:
        """Returns the arguments that differ from the defaults."""
        given = {"colors": self.colors, "visible": self.visible}
        parts = [f"{name}={check.shown(one)}" for name, one in given.items() if one is not None]
        if isinstance(self.opacity, Mapping) or self.opacity < 1:
            parts.append(f"opacity={self.opacity}")
        return f"Labels({', '.join(parts + ['lit=False'] * (not self.lit))})"

    def __call__(self, labels: np.ndarray) -> np.ndarray:
        """Returns (..., 4) linear RGB and opacity per reference length of labels, in float64."""
        look = self._look()
        known, at = np.unique(np.asarray(labels).astype(np.int64), return_inverse=True)
        rows = np.column_stack((look.colors_of(known), look.opacities(known)))
        return rows[at.reshape(np.shape(labels))]

    def own_numbers(self, tree: N3Tree) -> LabelNumbers:
        return LabelNumbers(lit=float(self.lit))

    def feature_count(self, tree: N3Tree) -> int:
        return 1

    def unlit(self) -> Self:
        bare = super().unlit()
        bare.lit = True
        return bare

    def blocker(self) -> Labels:
        bare = copy(self)
        bare.lit = False  # normals would only cost time
        return bare

    def table(self, sampling: Sampling) -> ColorTable:
        raise ValueError("Labels: which rows there are, the tree tells: table_of")

    def table_of(self, tree: N3Tree, channel: str, sampling: Sampling) -> ColorTable:
        """See `Shader`: a row for each label that the channel may hold, in order."""
        look = self._look()

        def make() -> ColorTable:
            return self._make_table(*label_rows(tree, channel), look, sampling)

        return self._once(tree, channel, (look.key, self.reference, sampling), make)

    def label_names(self, tree: N3Tree, channel: str) -> Tensor:
        def make() -> Tensor:
            _, labels = label_rows(tree, channel)
            nothing = torch.full((1,), -1, dtype=torch.int64)
            return torch.cat((nothing, torch.from_numpy(labels))).to(tree.device)

        return self._once(tree, channel, (tree.device,), make)

    def _once(self, tree: N3Tree, channel: str, key: Any, make: Callable[[], _Made]) -> _Made:
        """Returns what `make` returns for a tree's labels; caches the last few, also for copies."""
        labels = tree.labels[channel]
        key = (id(labels), tree.value_range.get(channel), key)
        if key not in self._kept:
            if len(self._kept) == _KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = labels, make()  # the reference to `labels` keeps their id unique
        return self._kept[key][1]

    def _look(self) -> _Look:
        """Returns the current colours, opacities and visibility, checked."""
        if self.reference is not None:
            check.number("Labels", "reference", self.reference, low=0, open_low=True)
        return _Look(self.colors, self.opacity, self.visible)

    def _make_table(
        self, first: float, labels: np.ndarray, look: _Look, sampling: Sampling
    ) -> ColorTable:
        rows = max(2, len(labels))
        levels = sampling.fitting(rows)
        table, opacity = np.zeros((levels, rows, 4)), look.opacities(labels)
        table[:, : len(labels), :3] = look.colors_of(labels)
        length = sampling.step / (self.reference or sampling.smallest_spacing)
        with np.errstate(divide="ignore"):
            thickness = np.log1p(-opacity)
        for level in range(levels):
            table[level, : len(labels), 3] = -np.expm1(length * 2.0**level * thickness)
        seen = np.zeros(rows, bool)
        seen[: len(labels)] = opacity > 0
        return ColorTable.of(table, (first, first + rows - 1), seen, sampling)


def label_rows(tree: N3Tree, channel: str) -> tuple[float, np.ndarray]:
    """Returns the smallest value of a channel of labels, and (m,) int64: the labels of this value
    and the m - 1 values after it. Raises ValueError if they are not known, or are too many.
    """
    labels = tree.labels[channel]
    if labels is not None:
        return 0.0, labels.cpu().numpy()
    kind = tree.bricks.channels[channel].dtype
    known = tree.value_range.get(channel)
    if known is None and kind.is_floating_point:
        raise ValueError(
            f"Labels: channel {channel!r} is {str(kind).removeprefix('torch.')} without a known "
            "range: its producer must set value_range or labels"
        )
    low, high = known or (torch.iinfo(kind).min, torch.iinfo(kind).max)
    if high - low >= _MOST_ROWS:
        raise ValueError(
            f"Labels: channel {channel!r} reaches from {low:g} to {high:g}, a table holds "
            f"{_MOST_ROWS} labels"
        )
    return float(low), np.arange(int(low), int(high) + 1)


class _Look:
    """How each label looks; two looks with equal `key` are the same."""

    def __init__(self, colors: Any, opacity: Any, visible: Any) -> None:
        where = "Labels"
        self.first = np.zeros((0, 3))  # colours of labels 0, 1, ...
        self.colors: dict[int, tuple[float, float, float]] = {}
        if isinstance(colors, Mapping):
            self.colors = {_label(n): linear_color(where, color) for n, color in colors.items()}
        elif colors is not None:
            self.first = _in_order(where, colors)
        self.opacity, self.own_opacity = 1.0, dict[int, float]()
        if isinstance(opacity, Mapping):
            self.own_opacity = {_label(n): _alpha(where, alpha) for n, alpha in opacity.items()}
        else:
            self.opacity = _alpha(where, opacity)
        self.everything = isinstance(visible, str) and visible == "all"
        self.visible: frozenset[int] | None = None
        if isinstance(visible, Iterable) and not isinstance(visible, str):
            self.visible = frozenset(_label(number) for number in visible)
        elif visible is not None and not self.everything:
            raise ValueError(f"{where}: visible must be labels, 'all' or None, got {visible!r}")
        self.key = (
            *(self.first.tobytes(), tuple(self.colors.items())),
            *(self.opacity, tuple(self.own_opacity.items()), self.everything, self.visible),
        )

    def colors_of(self, labels: np.ndarray) -> np.ndarray:
        """Returns colours (m, 3) of labels (m,), which must be sorted."""
        found = distinct_colors(labels)
        told = (labels >= 0) & (labels < len(self.first))
        found[told] = self.first[labels[told]]
        _put(found, labels, self.colors)
        return found

    def opacities(self, labels: np.ndarray) -> np.ndarray:
        """Returns opacities (m,) per reference length of labels (m,), which must be sorted; 0 for
        those that are not visible.
        """
        found = np.full(len(labels), self.opacity)
        _put(found, labels, self.own_opacity)
        if self.visible is not None:
            shown = np.fromiter(self.visible, np.int64, len(self.visible))
            found[~np.isin(labels, shown)] = 0
        elif not self.everything:
            found[labels == BACKGROUND] = 0
        return found


def _put(rows: np.ndarray, labels: np.ndarray, told: Mapping[int, Any]) -> None:
    """Writes values by label (`told`) into the labels' rows; ignores labels without a row."""
    if not told:
        return
    wanted = np.fromiter(told, np.int64, len(told))
    at = np.searchsorted(labels, wanted).clip(max=len(labels) - 1)
    known = labels[at] == wanted
    rows[at[known]] = np.array(list(told.values()))[known]


def _label(number: Any) -> int:
    plain = getattr(number, "__index__", None)
    if plain is None or isinstance(number, bool) or not -(2**63) <= plain() < 2**63:
        raise ValueError(f"Labels: a label must be a whole number below 2^63, got {number!r}")
    return plain()


def _alpha(where: str, value: Any) -> float:
    return check.number(where, "opacity", value, low=0, high=1)


def _in_order(where: str, colors: Any) -> np.ndarray:
    """Returns colours (k, 3) of labels 0, 1, ..."""
    if isinstance(colors, Tensor):
        colors = colors.detach().cpu().numpy()
    if isinstance(colors, np.ndarray):
        if colors.ndim != 2 or colors.shape[1] != 3:
            raise ValueError(f"{where}: colors must be (k, 3), got {check.shown(colors)}")
        found = colors.astype(np.float64)
        found = array_from_srgb(found / 255) if colors.dtype == np.uint8 else found
        if not ((found >= 0) & (found <= 1)).all():
            raise ValueError(f"{where}: colors must lie in [0, 1]")
        return found
    if isinstance(colors, str) or not isinstance(colors, Sequence):
        raise ValueError(f"{where}: colors must be by label, or a list, got {colors!r}")
    return np.array([linear_color(where, color) for color in colors]).reshape(-1, 3)
