"""`Channels`: several numbers of a voxel, each in its own colour, combined at each sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

import numpy as np
import torch

from ..base import check
from ..base.image_info import COLORS, ChannelInfo, array_from_srgb, to_hex
from ..base.lasting import lasting
from ..base.volume import Volume
from ..io.stores.store import Store
from ..io.window import windows
from ..ops.shading import Triple
from .colors import linear_color as named_color
from .shader import ColorTable, Sampling, Shader
from .transfer_function import TransferFunction

Mode = Literal["additive", "opacity"]

#: Default colours by a channel's index in the list; the first is a blue light enough to be seen.
DEFAULT_COLORS = (
    *("#2850ff", "#00ff00", "#ff0000", "#ff00ff", "#00ffff", "#ffff00", "#ff8000", "#ffffff"),
    *("#8000ff", "#80ff00", "#ff0080", "#0080ff", "#00ff80", "#ff8080", "#80c0ff", "#ffd080"),
)

MAX_CHANNELS = 16  # in one picture: `kMaxNumbers` in csrc/shaders/probe.h
_RAMP_PIECES = 16  # linear pieces that approximate the quadratic rise of opacity
_DEFAULT_OPACITY = 0.5
_OPAQUE_HALVINGS = 1024.0  # halvings of light that represent an opacity of 1
_MAX_TABLE_ROWS = 2**22  # of a table, so that float32 can index its rows
_WINDOW_PERCENTILES = (50.0, 99.9)  # percentiles of the values


@dataclass(kw_only=True)
class ChannelLook:
    """How one channel is shown: by a transfer function, or by a colour and a window. Attributes may
    be edited: the next picture uses them.

    Within the window colour rises linearly from black, and opacity quadratically, so that dark
    regions are thin; above the window both are constant. Below it opacity is 0.

    Attributes:
        transfer: The transfer function; if given, colour, window and opacity must be None.
        color: Linear red, green, blue in [0, 1], or a name or #RRGGBB in sRGB; None: by the
            channel's index in the list, blue, green, red, magenta, cyan, yellow, ...; white if it
            is the only one.
        window: (low, high) in data units: values at which it begins to show, and is brightest.
        component: Index of the number of a voxel; None: the channel's index in the list.
        visible: Whether it is shown.
        opacity: At the window's upper end, over a length of the smallest spacing; 0.5 if left out.
        name: Name for display.
    """

    transfer: TransferFunction | None = None
    color: Triple | str | None = None
    window: tuple[float, float] | None = None
    component: int | None = None
    visible: bool = True
    opacity: float | None = None
    name: str = ""

    __repr__ = check.summary

    def function(self, index: int, count: int) -> TransferFunction:
        """Returns its transfer function, if it is the channel `index` of `count`, from 0.

        Raises:
            ValueError: A number is out of its range, the window is missing, or the look has a
                transfer function and also a colour, window or opacity.
        """
        context = f"Channels: channel {index}" + (f" ({self.name})" if self.name else "")
        if self.transfer is not None:
            for name in ("color", "window", "opacity"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{context}: it has a transfer function, so no {name}")
            return check.instance(context, "transfer", self.transfer, TransferFunction)
        if self.window is None:
            missing = "window=(low, high) or a transfer function is missing"
            raise ValueError(f"{context}: {missing}; Channels.of(volume) finds windows")
        low, high = window_of(context, self.window)
        default = DEFAULT_COLORS[index] if count > 1 else "white"
        color = channel_color(context, default if self.color is None else self.color)
        opacity = _DEFAULT_OPACITY if self.opacity is None else self.opacity
        opacity = check.number(context, "opacity", opacity, low=0, high=1)
        fractions = [piece / _RAMP_PIECES for piece in range(_RAMP_PIECES)]
        rising = [(low + share * (high - low), opacity * share * share) for share in fractions]
        return TransferFunction([*rising, (high, opacity)], [(low, 0, 0, 0), (high, *color)])


class Channels(Shader):
    """Up to 16 numbers of a voxel, each with its own look, combined at each sample.

    In an interval of length l with values v_i, the function of channel i yields the colour c_i and
    the opacity a_i over its reference length r_i, so it halves the light
    h_i = -log2(1 - a_i) l / r_i times. Over all channels

        additive:  H = max(h_1, h_2, ...)
        opacity:   H = h_1 + h_2 + ...

    and the interval's alpha is 1 - 2^-H, its premultiplied colour alpha (h_1 c_1 + ...) / H. Both
    modes solve emission and absorption: steps and levels of detail only change which positions are
    sampled. A single channel is drawn as by its transfer function in either mode. Where several
    are dense, "additive" adds their colours, as red and green make yellow, and they hide what is
    behind them only as much as the densest alone: colours may exceed 1, and are clipped by the
    picture's tone step. In "opacity" they are matter that shares the same space: colours are a mean
    weighted by h_i, and all of them hide what is behind.

    The numbers are those of one channel of the pool, in any order. Coarse levels hold means, as for
    other shaders; there is no `Filtered` variant.
    """

    kind = "ChannelMix"

    def __init__(
        self,
        looks: Sequence[ChannelLook | TransferFunction],
        mode: Mode = "additive",
        *,
        channel: str | None = None,
    ) -> None:
        """Sets the looks; a transfer function is short for a look with only that.

        Args:
            looks: 1 to 16 of them, in order; the attribute is a list that may be edited, too.
            mode: How they are combined.
            channel: Name of the pool's channel; None: that of the options.

        Raises:
            ValueError: There are too many or none, one is no look, or a number is out of its range.
        """
        self.looks = [
            ChannelLook(transfer=look) if isinstance(look, TransferFunction) else look
            for look in check.items("Channels", "looks", looks)
        ]
        self.mode, self.channel = mode, channel
        self._tables: dict[Any, ColorTable] = {}
        self._visible_functions()

    @classmethod
    def of(
        cls,
        image: Volume | Store,
        mode: Mode = "additive",
        *,
        components: Sequence[int] | None = None,
        opacity: float | None = None,
    ) -> Self:
        """Returns a shader with the looks in an image's metadata: names, colours, windows, and
        which channels are shown. Colours that are missing there are the defaults of `ChannelLook`;
        missing windows go from the median to the 99.9th percentile of a subset of the values.

        Args:
            image: A volume or a store.
            mode: How they are combined.
            components: Indices of the image's channels to show, in order; None: all.
            opacity: See `ChannelLook`.

        Raises:
            ValueError: There are more than 16, or the image lacks one of `components`.
        """
        check.instance("Channels.of", "image", image, Volume, Store)
        width = image.width
        chosen = range(width) if components is None else components
        chosen = check.items("Channels.of", "components", chosen)
        if len(chosen) > MAX_CHANNELS:
            raise ValueError(
                f"Channels.of: at most {MAX_CHANNELS} channels are shown together, "
                f"got {len(chosen)}; choose some: components=[0, 1, ...]"
            )
        for component in chosen:
            check.integer("Channels.of", "component", component, low=0, high=width - 1)
        infos = {c: info for c, info in enumerate(image.info.channels) if c in chosen}
        show_all = not any(info.active for info in infos.values()) or components is not None
        unset = [c for c in chosen if c not in infos or infos[c].window is None]
        found_windows = dict(zip(unset, windows(image, _WINDOW_PERCENTILES, unset), strict=True))
        looks = []
        for component in chosen:
            info = infos.get(component, ChannelInfo())
            looks.append(
                ChannelLook(
                    color=info.color and tuple(array_from_srgb(np.array(info.color)).tolist()),
                    window=info.window or found_windows[component],
                    component=component,
                    visible=show_all or info.active,
                    opacity=opacity,
                    name=info.name,
                )
            )
        return cls(looks, mode)

    @property
    def component(self) -> int:  # type: ignore[override]
        """The highest index that it reads from a voxel: the op checks that voxels have it."""
        return max((component for component, _ in self._visible_functions()), default=0)

    @lasting
    def table(self, sampling: Sampling) -> ColorTable:
        """Returns the header and the rows of all channels, see csrc/shaders/channels.h."""
        functions = self._visible_functions()
        keys = [(c, f.opacity.tobytes(), f.color.tobytes(), f.reference) for c, f in functions]
        key = (self.mode, *keys, sampling)
        if key not in self._tables:
            self._tables = {key: _make_table(functions, self.mode == "additive", sampling)}
        return self._tables[key]

    def _visible_functions(self) -> list[tuple[int, TransferFunction]]:
        """Returns component and current transfer function of each visible channel."""
        context, looks = "Channels", self.looks
        check.one_of(context, "mode", self.mode, get_args(Mode))
        if not 1 <= len(looks) <= MAX_CHANNELS:
            raise ValueError(f"{context}: takes 1 to {MAX_CHANNELS} channels, got {len(looks)}")
        visible = []
        for index, look in enumerate(looks):
            check.instance(context, f"channel {index}", look, ChannelLook)
            component = index if look.component is None else look.component
            check.integer(context, f"component of channel {index}", component, low=0)
            function = look.function(index, len(looks))
            if look.visible:
                visible.append((component, function))
        return visible

    def __repr__(self) -> str:
        """Returns the mode and each look's name or component."""
        looks = ", ".join(
            look.name or f"{index if look.component is None else look.component}"
            for index, look in enumerate(self.looks)
        )
        return f"Channels([{looks}], {self.mode!r})"


def _make_table(
    functions: list[tuple[int, TransferFunction]], additive: bool, sampling: Sampling
) -> ColorTable:
    sampled = [(component, function, *function.rows()) for component, function in functions]
    used_rows = 1 + len(functions)
    total_rows = max(2, used_rows + sum(len(rows) for *_, rows in sampled))
    if total_rows > _MAX_TABLE_ROWS:
        raise ValueError(
            f"Channels: the transfer functions take {total_rows} rows, more than "
            f"{_MAX_TABLE_ROWS}: some of their points are too close"
        )
    levels = sampling.fitting(total_rows)
    table, opaque_m = np.zeros((levels, total_rows, 4)), np.zeros(total_rows, np.int32)
    table[:, 0, :2] = len(functions), additive
    for header_row, (component, function, low, high, rows) in enumerate(sampled, 1):
        row_slice = slice(used_rows, used_rows + len(rows))
        table[:, header_row] = component, low, (len(rows) - 1) / (high - low), len(rows)
        table[:, row_slice, :3] = rows[:, :3]
        with np.errstate(divide="ignore"):
            (length,) = sampling.lengths(function.reference, 1)
            halvings = np.log1p(-rows[:, 3]) * (-length / math.log(2))
        halvings = np.minimum(halvings, _OPAQUE_HALVINGS)
        table[:, row_slice, 3] = halvings * 2.0 ** np.arange(levels)[:, None]
        opaque_m[row_slice] = np.cumsum(rows[:, 3] > 0, dtype=np.int32)
        used_rows += len(rows)
    dtype, device = sampling.dtype, sampling.device
    return ColorTable(
        table_lm4=torch.tensor(table, dtype=dtype, device=device),
        domain_2=torch.tensor((0.0, 1.0), dtype=dtype, device=device),  # each channel has its own
        opaque_m=torch.tensor(opaque_m, device=device),
    )


def window_of(context: str, window: Sequence[float]) -> tuple[float, float]:
    """Returns (low, high) of a window; raises ValueError if it is not one."""
    if not isinstance(window, Sequence) or len(window) != 2:
        raise ValueError(f"{context}: window must be (low, high), got {window!r}")
    low, high = (check.number(context, "window", end) for end in window)
    if not low < high:
        raise ValueError(f"{context}: window must rise, got {low:g} to {high:g}")
    return low, high


def channel_color(context: str, color: Triple | str) -> Triple:
    """Returns a colour as linear RGB; names are those of microscopy lookup tables (`COLORS`)."""
    named = {name: f"#{to_hex(rgb)}" for name, rgb in COLORS.items()}
    return named_color(context, color, named)
