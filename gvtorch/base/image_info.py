"""`ImageInfo`: what a file tells of its numbers beside their grid: unit, channels, time, labels.

torch is not imported here, since readers of headers need it.
"""

from __future__ import annotations

from dataclasses import dataclass

Rgb = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class ChannelInfo:
    """How one channel is called, and how it is meant to be shown."""

    name: str = ""
    color: Rgb | None = None  # sRGB, 0 to 1
    window: tuple[float, float] | None = None  # the values that are shown dark and bright
    active: bool = True  # whether it is shown at first


@dataclass(frozen=True, kw_only=True)
class ImageInfo:
    """What is known of an image's numbers; what a file does not tell is left out."""

    unit: str | None = None  # of length, as OME-NGFF spells it: "micrometer", "millimeter", ...
    channels: tuple[ChannelInfo, ...] = ()  # one for each channel, or none
    quantity: str | None = None  # what the values measure, as in "HU"
    labels: bool = False  # values are numbers of things, which must not be blended
    time_step: float | None = None  # from one time point to the next
    time_unit: str | None = None  # as OME-NGFF spells it: "second", ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", tuple(self.channels))
