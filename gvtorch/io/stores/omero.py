"""The `omero` part of OME-NGFF metadata: names, colours and windows of channels.

Source: OME-NGFF specification, versions 0.4 and 0.5 ("omero" metadata).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from reprlib import repr as brief
from typing import Any

from ...base.image_info import ChannelInfo, Rgb, from_hex, to_hex
from .store_layout import is_number

#: For viewers: of channels without a colour. A single one is white.
_COLORS = ("00ff00", "ff00ff", "00ffff", "ffff00", "ff0000", "0000ff")


def read_channels(omero: Any) -> tuple[tuple[ChannelInfo, ...], list[str]]:
    """Returns what is told of each channel, and what of it is damaged or not kept. Where the
    picture begins in a viewer (rdefs) and its number on a server (id) are no part of the data.
    """
    told = omero.get("channels") if isinstance(omero, dict) else None
    if not isinstance(told, list) or not all(isinstance(channel, dict) for channel in told):
        return (), ["omero, which holds no list of channels"]
    found, lost = [], []
    for number, channel in enumerate(told):
        color, window = _color(channel.get("color")), _window(channel.get("window"))
        for name, value in (("color", color), ("window", window)):
            if value is None and channel.get(name) is not None:
                lost.append(f"{name} {brief(channel[name])} of channel {number}")
        if channel.get("inverted") is True:
            lost.append(f"channel {number} is shown inverted")
        label, active = channel.get("label"), channel.get("active")
        name = label if isinstance(label, str) else "" if label is None else str(label)
        shown = active is not False
        found.append(ChannelInfo(name=name, color=color, window=window, active=shown))
    return tuple(found), lost


def write_channels(
    channels: Sequence[ChannelInfo], value_range: Sequence[Sequence[float]]
) -> tuple[dict[str, Any], dict[str, list[int]]]:
    """Returns the `omero` attribute of channels, and the numbers of those whose colour or window
    is not told: the specification wants one, so these are made up for viewers.
    """
    assumed: dict[str, list[int]] = {"color": [], "window": []}
    written = []
    for number, (channel, (low, high)) in enumerate(zip(channels, value_range, strict=True)):
        for name, numbers in assumed.items():
            if getattr(channel, name) is None:
                numbers.append(number)
        color = _COLORS[number % len(_COLORS)] if len(channels) > 1 else "ffffff"
        start, end = (low, high) if channel.window is None else channel.window
        one = {
            "label": channel.name,
            "color": (color if channel.color is None else to_hex(channel.color)).upper(),
            "window": {"min": min(low, start), "max": max(high, end), "start": start, "end": end},
            "active": channel.active,
        }
        written.append(one)
    return {"channels": written}, {name: numbers for name, numbers in assumed.items() if numbers}


def forget_assumed(channels: Sequence[ChannelInfo], assumed: Any) -> tuple[ChannelInfo, ...]:
    """Returns the channels without the colours and windows that `write_channels` made up."""
    told = assumed if isinstance(assumed, dict) else {}
    kept = list(channels)
    for name in ("color", "window"):
        numbers = told.get(name)
        for number, channel in enumerate(kept):
            if isinstance(numbers, list) and number in numbers:
                empty: dict[str, Any] = {name: None}
                kept[number] = replace(channel, **empty)
    return tuple(kept)


def _color(text: Any) -> Rgb | None:
    plain = text if isinstance(text, str) else ""
    found = re.fullmatch(r"#?([0-9a-fA-F]{6})([0-9a-fA-F]{2})?", plain)
    return None if found is None else from_hex(found[1])


def _window(told: Any) -> tuple[float, float] | None:
    if not isinstance(told, dict):
        return None
    ends: list[Any] = [told.get("start", told.get("min")), told.get("end", told.get("max"))]
    if not all(map(is_number, ends)) or ends[0] > ends[1]:
        return None
    return (float(ends[0]), float(ends[1]))
