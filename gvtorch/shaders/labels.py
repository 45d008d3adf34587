"""`Labels`: shows volumes whose voxels hold the numbers of objects, as segmentations do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self, TypeVar, Unpack

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.checked import Check, flag, optional, positive
from ..base.image_info import array_from_srgb
from ..base.lasting import lasting
from ..ops.reference.labels import LabelNumbers
from ..pool import N3Tree
from .colors import distinct_colors, linear_color
from .lights import LightSettings, LitShader
from .shader import ColorTable, Sampling, alpha_over

BACKGROUND = 0
_MAX_TABLE_ROWS = 2**24  # of a table, so that float32 can index its rows
_CACHED_RESULTS = 8  # cached tables and label tensors
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
        colors, opacity, visible, reference, lit: As they were given.
    """

    kind = "Labels"
    reads_labels = True
    checks: ClassVar[Mapping[str, Check]] = {"reference": optional(positive), "lit": flag}

    def __init__(
        self,
        colors: Mapping[int, Any] | Sequence[Any] | np.ndarray | Tensor | None = None,
        opacity: float | Mapping[int, float] = 1.0,
        visible: Iterable[int] | Literal["all"] | None = None,
        *,
        channel: str | None = None,
        reference: float | None = None,
        lit: bool = True,
        **light: Unpack[LightSettings],
    ) -> None:
        """See the class.

        Args:
            colors: By label, or in the order 0, 1, 2, ...; each is linear red, green, blue, or a
                name or #RRGGBB in sRGB. An array (k, 3) of uint8 holds sRGB. Labels left out get
                distinct colours.
            opacity: Of all labels, or by label (1 for those left out), in [0, 1], per reference
                length; labels with opacity 0 are treated as not present.
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
        super().__init__(**LightSettings(ambient=0.3, diffuse=0.7, specular=0.15) | light)
        if isinstance(visible, Iterator):  # it could be iterated only once
            visible = [*visible]
        self.colors, self.opacity, self.visible = colors, opacity, visible
        self.channel, self.reference, self.lit = channel, reference, lit
        self._cache: dict[Any, tuple[Any, Any]] = {}
        self._appearance()

    def __repr__(self) -> str:
        """Returns the arguments that differ from the defaults."""
        arguments = {"colors": self.colors, "visible": self.visible}
        parts = [f"{n}={check.as_text(v)}" for n, v in arguments.items() if v is not None]
        if isinstance(self.opacity, Mapping) or self.opacity < 1:
            parts.append(f"opacity={self.opacity}")
        return f"Labels({', '.join(parts + ['lit=False'] * (not self.lit))})"

    def __call__(self, labels: np.ndarray) -> np.ndarray:
        """Returns (..., 4) linear RGB and opacity per reference length of labels, in float64."""
        appearance = self._appearance()
        distinct, inverse = np.unique(np.asarray(labels).astype(np.int64), return_inverse=True)
        rows = np.column_stack((appearance.colors_of(distinct), appearance.opacities(distinct)))
        return rows[inverse.reshape(np.shape(labels))]

    def linear_colors(self) -> Mapping[int, Any] | np.ndarray | None:
        """Returns the chosen colours as linear RGB: by label, or (k, 3) of labels 0, 1, 2, ..."""
        appearance = self._appearance()
        if self.colors is None or isinstance(self.colors, Mapping):
            return appearance.color_by_label or self.colors
        return appearance.listed_colors

    def own_numbers(self, tree: N3Tree) -> LabelNumbers:
        return LabelNumbers(lit=float(self.lit))

    def unlit(self) -> Self:
        return super().unlit().changed(lit=True)

    def blocker(self) -> Labels:
        return self.changed(lit=False)  # normals would only cost time

    def table(self, sampling: Sampling) -> ColorTable:
        raise ValueError("Labels: which rows there are, the tree tells: table_of")

    def table_of(self, tree: N3Tree, channel: str, sampling: Sampling) -> ColorTable:
        """See `Shader`: a row for each label that the channel may hold, in order."""
        appearance = self._appearance()

        def make() -> ColorTable:
            return self._make_table(*label_rows(tree, channel), appearance, sampling)

        return self._cached(tree, channel, (appearance.key, self.reference, sampling), make)

    def label_names(self, tree: N3Tree, channel: str) -> Tensor:
        def make() -> Tensor:
            _, labels = label_rows(tree, channel)
            no_label = torch.full((1,), -1, dtype=torch.int64, device="cpu")
            return torch.cat((no_label, torch.from_numpy(labels))).to(tree.device)

        return self._cached(tree, channel, (tree.device,), make)

    @lasting
    def _cached(self, tree: N3Tree, channel: str, key: Any, make: Callable[[], _Made]) -> _Made:
        """Returns what `make` returns for a tree's labels; caches the last few, also for copies."""
        labels = tree.labels[channel]
        key = (id(labels), tree.value_range.get(channel), key)
        if key not in self._cache:
            if len(self._cache) == _CACHED_RESULTS:
                self._cache.pop(next(iter(self._cache)))
            self._cache[key] = labels, make()  # the reference to `labels` keeps their id unique
        return self._cache[key][1]

    def _appearance(self) -> _Appearance:
        """Returns the current colours, opacities and visibility, checked."""
        return _Appearance(self.colors, self.opacity, self.visible)

    def _make_table(
        self, first: float, labels: np.ndarray, appearance: _Appearance, sampling: Sampling
    ) -> ColorTable:
        rows = max(2, len(labels))
        levels = sampling.fitting(rows)
        table, opacity = np.zeros((levels, rows, 4)), appearance.opacities(labels)
        table[:, : len(labels), :3] = appearance.colors_of(labels)
        lengths = sampling.lengths(self.reference, levels)
        table[:, : len(labels), 3] = alpha_over(lengths[:, None], opacity)
        visible = np.zeros(rows, bool)
        visible[: len(labels)] = opacity > 0
        return ColorTable.of(table, (first, first + rows - 1), visible, sampling)


def label_rows(tree: N3Tree, channel: str) -> tuple[float, np.ndarray]:
    """Returns the smallest value of a channel of labels, and (m,) int64: the labels of this value
    and the m - 1 values after it. Raises ValueError if they are not known, or are too many.
    """
    labels = tree.labels[channel]
    if labels is not None:
        return 0.0, labels.cpu().numpy()
    dtype = tree.bricks.channels[channel].dtype
    value_range = tree.value_range.get(channel)
    if value_range is None and dtype.is_floating_point:
        raise ValueError(
            f"Labels: channel {channel!r} is {str(dtype).removeprefix('torch.')} without a known "
            "range: its producer must set value_range or labels"
        )
    low, high = value_range or (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
    if high - low >= _MAX_TABLE_ROWS:
        reach = f"reaches from {low:g} to {high:g}, a table holds {_MAX_TABLE_ROWS} labels"
        raise ValueError(f"Labels: channel {channel!r} {reach}")
    return float(low), np.arange(int(low), int(high) + 1)


class _Appearance:
    """How each label looks; two looks with equal `key` are the same."""

    def __init__(self, colors: Any, opacity: Any, visible: Any) -> None:
        context = "Labels"
        self.listed_colors = np.zeros((0, 3))  # colours of labels 0, 1, ...
        self.color_by_label: dict[int, tuple[float, float, float]] = {}
        if isinstance(colors, Mapping):
            self.color_by_label = {
                _checked_label(n): linear_color(context, color) for n, color in colors.items()
            }
        elif colors is not None:
            self.listed_colors = _listed_colors(context, colors)
        self.opacity, self.opacity_by_label = 1.0, dict[int, float]()
        if isinstance(opacity, Mapping):
            self.opacity_by_label = {
                _checked_label(n): _checked_opacity(context, alpha) for n, alpha in opacity.items()
            }
        else:
            self.opacity = _checked_opacity(context, opacity)
        self.show_all = isinstance(visible, str) and visible == "all"
        self.visible: frozenset[int] | None = None
        if isinstance(visible, Iterable) and not isinstance(visible, str):
            self.visible = frozenset(_checked_label(number) for number in visible)
        elif visible is not None and not self.show_all:
            raise ValueError(f"{context}: visible must be labels, 'all' or None, got {visible!r}")
        self.key = (
            *(self.listed_colors.tobytes(), tuple(self.color_by_label.items())),
            *(self.opacity, tuple(self.opacity_by_label.items()), self.show_all, self.visible),
        )

    def colors_of(self, labels: np.ndarray) -> np.ndarray:
        """Returns colours (m, 3) of sorted labels (m,)."""
        colors = distinct_colors(labels)
        listed = (labels >= 0) & (labels < len(self.listed_colors))
        colors[listed] = self.listed_colors[labels[listed]]
        _assign_rows(colors, labels, self.color_by_label)
        return colors

    def opacities(self, labels: np.ndarray) -> np.ndarray:
        """Returns opacities (m,) per reference length of sorted labels (m,); 0 if not visible."""
        opacities = np.full(len(labels), self.opacity)
        _assign_rows(opacities, labels, self.opacity_by_label)
        if self.visible is not None:
            visible_labels = np.fromiter(self.visible, np.int64, len(self.visible))
            opacities[~np.isin(labels, visible_labels)] = 0
        elif not self.show_all:
            opacities[labels == BACKGROUND] = 0
        return opacities


def _assign_rows(rows: np.ndarray, labels: np.ndarray, by_label: Mapping[int, Any]) -> None:
    """Writes values by label into the labels' rows; ignores labels without a row."""
    if not by_label:
        return
    given_labels = np.fromiter(by_label, np.int64, len(by_label))
    row = np.searchsorted(labels, given_labels).clip(max=len(labels) - 1)
    present = labels[row] == given_labels
    rows[row[present]] = np.array(list(by_label.values()))[present]


def _checked_label(number: Any) -> int:
    as_int = getattr(number, "__index__", None)
    if as_int is None or isinstance(number, bool) or not -(2**63) <= as_int() < 2**63:
        raise ValueError(f"Labels: a label must be a whole number below 2^63, got {number!r}")
    return as_int()


def _checked_opacity(context: str, value: Any) -> float:
    return check.number(context, "opacity", value, low=0, high=1)


def _listed_colors(context: str, colors: Any) -> np.ndarray:
    """Returns colours (k, 3) of labels 0, 1, ..."""
    if isinstance(colors, Tensor):
        colors = colors.detach().cpu().numpy()
    if isinstance(colors, np.ndarray):
        if colors.ndim != 2 or colors.shape[1] != 3:
            raise ValueError(f"{context}: colors must be (k, 3), got {check.as_text(colors)}")
        rgb = colors.astype(np.float64)
        rgb = array_from_srgb(rgb / 255) if colors.dtype == np.uint8 else rgb
        if not ((rgb >= 0) & (rgb <= 1)).all():
            raise ValueError(f"{context}: colors must lie in [0, 1]")
        return rgb
    if isinstance(colors, str) or not isinstance(colors, Sequence):
        raise ValueError(f"{context}: colors must be by label, or a list, got {colors!r}")
    return np.array([linear_color(context, color) for color in colors]).reshape(-1, 3)
