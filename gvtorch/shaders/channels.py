"""`Channels`: several numbers of a voxel, each in its own colour, composited at each sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

import numpy as np
import torch

from ..base import check
from ..base.image_info import COLORS, ChannelInfo, array_from_srgb, to_hex
from ..base.volume import Volume
from ..io.stores.store import Store
from ..io.window import windows
from ..ops.shading import Triple
from .colors import linear_color as named_color
from .shader import ColorTable, Sampling, Shader
from .transfer_function import TransferFunction

Mode = Literal["additive", "opacity"]

#: Of channels whose colour is not told, by their place; the first is blue, and light enough to see.
DISTINCT = (
    *("#2850ff", "#00ff00", "#ff0000", "#ff00ff", "#00ffff", "#ffff00", "#ff8000", "#ffffff"),
    *("#8000ff", "#80ff00", "#ff0080", "#0080ff", "#00ff80", "#ff8080", "#80c0ff", "#ffd080"),
)

MOST = len(DISTINCT)  # channels of a picture
_RAMP = 16  # straight parts in which opacity rises
_OPACITY = 0.5
_OPAQUE = 1024.0  # halvings that stand for an opacity of 1
_MOST_ROWS = 2**22  # of a table, whose places a float32 has to tell
_WINDOW = (50.0, 99.9)  # percentiles of the values


@dataclass(kw_only=True)
class ChannelLook:
    """How one channel is shown: by a transfer function, or by a colour and a window. Attributes may
    be edited: the next picture is made with them.

    Within the window colour rises evenly from black and opacity with the square, so that what is
    dark is thin; beyond it both stay. What is below the window has no opacity.

    Attributes:
        transfer: The transfer function; then there is no colour, window or opacity.
        color: Linear red, green, blue in [0, 1], or a name or #RRGGBB in sRGB; None: one by the
            channel's place in the list, blue, green, red, magenta, cyan, yellow, ...; white where
            it is the only one.
        window: Values at which it begins to show and is brightest, in data units.
        component: Which number of a voxel; None: that of the channel's place.
        visible: Whether it is shown.
        opacity: At the window's upper end, of an interval as long as the smallest spacing; 0.5 if
            left out.
        name: For people.
    """

    transfer: TransferFunction | None = None
    color: Triple | str | None = None
    window: tuple[float, float] | None = None
    component: int | None = None
    visible: bool = True
    opacity: float | None = None
    name: str = ""

    __repr__ = check.brief

    def function(self, place: int, count: int) -> TransferFunction:
        """Returns its transfer function, where it is the channel at a place of so many.

        Raises:
            ValueError: A number is out of its range, the window is not told, or the look has more
                than a transfer function.
        """
        where = f"Channels: channel {place}" + (f" ({self.name})" if self.name else "")
        if self.transfer is not None:
            for name in ("color", "window", "opacity"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{where}: it has a transfer function, so no {name}")
            return check.instance(where, "transfer", self.transfer, TransferFunction)
        if self.window is None:
            raise ValueError(
                f"{where}: window=(low, high) or a transfer function is missing; "
                "Channels.of(volume) finds windows"
            )
        low, high = window_of(where, self.window)
        default = DISTINCT[place] if count > 1 else "white"
        color = channel_color(where, default if self.color is None else self.color)
        opacity = _OPACITY if self.opacity is None else self.opacity
        opacity = check.number(where, "opacity", opacity, low=0, high=1)
        parts = [part / _RAMP for part in range(_RAMP)]
        rising = [(low + part * (high - low), opacity * part * part) for part in parts]
        return TransferFunction([*rising, (high, opacity)], [(low, 0, 0, 0), (high, *color)])


class Channels(Shader):
    """Up to 16 numbers of a voxel, each with a look of its own, composited together at each sample.

    An interval of length l through values v_i: channel i has by its function the colour c_i, and
    the opacity a_i over its reference length r_i, so it halves the light
    h_i = -log2(1 - a_i) l / r_i times. Of all channels

        additive:  H = max(h_1, h_2, ...)
        opacity:   H = h_1 + h_2 + ...

    and the interval's alpha is 1 - 2^-H, its premultiplied colour alpha (h_1 c_1 + ...) / H. Both
    solve emission and absorption: steps and levels of detail change no more than which places are
    sampled. One channel alone is in either mode what its transfer function shows. Where several
    are dense, "additive" adds their colours, as red and green make yellow, and they hide what is
    behind them no more than the densest does alone: colours may go above 1, which the picture's
    tone step clips. With "opacity" they are matter in one place: colours are a mean, weighted by
    h_i, and all of them hide what is behind.

    Numbers of one channel of the pool, in any order. From afar means are read, as of other shaders:
    it has no `Filtered`.

    Attributes:
        looks: The looks, in order; the list may be edited, too.
        mode: "additive" or "opacity".
    """

    kind = "ChannelMix"

    def __init__(
        self,
        looks: Sequence[ChannelLook | TransferFunction],
        mode: Mode = "additive",
        *,
        channel: str | None = None,
    ) -> None:
        """Takes the looks; a transfer function is a look that has no more.

        Args:
            looks: 1 to 16 of them.
            mode: How they are composited.
            channel: Name of the pool's channel; None: that of the options.

        Raises:
            ValueError: They are too many, no looks, or out of their ranges.
        """
        self.looks = [
            ChannelLook(transfer=one) if isinstance(one, TransferFunction) else one for one in looks
        ]
        self.mode, self.channel = mode, channel
        self._tables: dict[Any, ColorTable] = {}
        self._shown()

    @classmethod
    def of(
        cls,
        image: Volume | Store,
        mode: Mode = "additive",
        *,
        components: Sequence[int] | None = None,
        opacity: float | None = None,
    ) -> Self:
        """Returns the looks that an image tells of its channels: names, colours, windows, and which
        are shown. Where it tells no colour, see `ChannelLook`; a window that it does not tell is
        from the median to the 99.9th percentile of the values, of which some are looked at.

        Args:
            image: A volume or a store.
            mode: How they are composited.
            components: Which of its channels, in which order; None: all.
            opacity: See `ChannelLook`.

        Raises:
            ValueError: There are more than 16, or one of `components` is not there.
        """
        if not isinstance(image, Volume | Store):
            kind = type(image).__name__
            raise ValueError(f"Channels.of: image must be a Volume or a Store, got {kind}")
        width = image.width
        chosen = range(width) if components is None else components
        if len(chosen) > MOST:
            raise ValueError(
                f"Channels.of: at most {MOST} channels are shown together, got {len(chosen)}; "
                "choose some: components=[0, 1, ...]"
            )
        for component in chosen:
            check.whole("Channels.of", "component", component, low=0, high=width - 1)
        told = {c: one for c, one in enumerate(image.info.channels) if c in chosen}
        active = not any(one.active for one in told.values()) or components is not None
        unknown = [c for c in chosen if c not in told or told[c].window is None]
        found = dict(zip(unknown, windows(image, _WINDOW, unknown), strict=True))
        looks = []
        for component in chosen:
            one = told.get(component, ChannelInfo())
            looks.append(
                ChannelLook(
                    color=one.color and tuple(array_from_srgb(np.array(one.color)).tolist()),
                    window=one.window or found[component],
                    component=component,
                    visible=active or one.active,
                    opacity=opacity,
                    name=one.name,
                )
            )
        return cls(looks, mode)

    @property
    def component(self) -> int:  # type: ignore[override]
        """The last number of a voxel that it reads: the op checks that it is there."""
        return max((component for component, _ in self._shown()), default=0)

    def table(self, sampling: Sampling) -> ColorTable:
        """Returns the head and the rows of all channels, see csrc/shaders/channels.h."""
        shown = self._shown()
        functions = [(c, f.opacity.tobytes(), f.color.tobytes(), f.reference) for c, f in shown]
        key = (self.mode, *functions, sampling)
        if key not in self._tables:
            self._tables = {key: _make_table(shown, self.mode == "additive", sampling)}
        return self._tables[key]

    def _shown(self) -> list[tuple[int, TransferFunction]]:
        """Component and transfer function of each channel that is shown, as they are now."""
        where, looks = "Channels", self.looks
        check.one_of(where, "mode", self.mode, get_args(Mode))
        if not 1 <= len(looks) <= MOST:
            raise ValueError(f"{where}: takes 1 to {MOST} channels, got {len(looks)}")
        shown = []
        for place, look in enumerate(looks):
            check.instance(where, f"channel {place}", look, ChannelLook)
            component = place if look.component is None else look.component
            check.whole(where, f"component of channel {place}", component, low=0)
            function = look.function(place, len(looks))
            if look.visible:
                shown.append((component, function))
        return shown

    def __repr__(self) -> str:
        """Tells the looks, a few words each."""
        looks = ", ".join(
            look.name or f"{place if look.component is None else look.component}"
            for place, look in enumerate(self.looks)
        )
        return f"Channels([{looks}], {self.mode!r})"


def _make_table(
    shown: list[tuple[int, TransferFunction]], added: bool, sampling: Sampling
) -> ColorTable:
    sampled = [(component, function, *function.rows()) for component, function in shown]
    count = 1 + len(shown)
    total = max(2, count + sum(len(rows) for *_, rows in sampled))
    if total > _MOST_ROWS:
        raise ValueError(
            f"Channels: the transfer functions take {total} rows, more than {_MOST_ROWS}: "
            "some of their points are too close"
        )
    levels = sampling.fitting(total)
    table, opaque_m = np.zeros((levels, total, 4)), np.zeros(total, np.int32)
    table[:, 0, :2] = len(shown), added
    for place, (component, function, low, high, rows) in enumerate(sampled, 1):
        mine = slice(count, count + len(rows))
        table[:, place] = component, low, (len(rows) - 1) / (high - low), len(rows)
        table[:, mine, :3] = rows[:, :3]
        with np.errstate(divide="ignore"):
            halvings = np.log1p(-rows[:, 3]) * (-function.length(sampling) / math.log(2))
        table[:, mine, 3] = np.minimum(halvings, _OPAQUE) * 2.0 ** np.arange(levels)[:, None]
        opaque_m[mine] = np.cumsum(rows[:, 3] > 0)
        count += len(rows)
    dtype, device = sampling.dtype, sampling.device
    return ColorTable(
        table_lm4=torch.tensor(table, dtype=dtype, device=device),
        domain_2=torch.tensor((0.0, 1.0), dtype=dtype, device=device),  # each has its own
        opaque_m=torch.tensor(opaque_m, device=device),
    )


def window_of(where: str, window: Sequence[float]) -> tuple[float, float]:
    """Returns a window's ends; raises ValueError where it is none."""
    if not isinstance(window, Sequence) or len(window) != 2:
        raise ValueError(f"{where}: window must be (low, high), got {window!r}")
    low, high = (check.number(where, "window", end) for end in window)
    if not low < high:
        raise ValueError(f"{where}: window must rise, got {low:g} to {high:g}")
    return low, high


def channel_color(where: str, color: Triple | str) -> Triple:
    """Returns a colour as linear RGB; names are those of lookup tables."""
    named = {name: f"#{to_hex(one)}" for name, one in COLORS.items()}
    return named_color(where, color, named)
