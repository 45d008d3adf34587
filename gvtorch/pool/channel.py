"""`Channel`: what a voxel holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from ..base import check
from ..base.volume import CHANNEL_DTYPES, Volume

_COMMON = ("extent", "spacing", "origin")  # what the volumes of one tree share


@dataclass(frozen=True)
class Channel:
    """What a voxel of a channel holds: `width` numbers of `dtype`."""

    dtype: torch.dtype = torch.float32
    width: int = 1

    def __post_init__(self) -> None:
        """Checks dtype and width."""
        if self.dtype not in CHANNEL_DTYPES:
            names = ", ".join(str(dtype).removeprefix("torch.") for dtype in CHANNEL_DTYPES)
            raise ValueError(f"Channel: dtype must be one of {names}, got {self.dtype}")
        check.whole("Channel", "width", self.width, low=1)

    @classmethod
    def of(cls, volume: Volume) -> Channel:
        """Returns the channel that holds a volume's voxels."""
        return cls(volume.data.dtype, volume.data.shape[3])

    @property
    def nbytes(self) -> int:
        """Bytes of one voxel."""
        return self.dtype.itemsize * self.width

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest number of the dtype."""
        known = torch.finfo if self.dtype.is_floating_point else torch.iinfo
        return (known(self.dtype).min, known(self.dtype).max)


def phrase(channels: Mapping[str, Channel]) -> str:
    """Returns channels as one phrase for a repr, as in "density float32x1, color uint8x4"."""
    return ", ".join(
        f"{name} {str(channel.dtype).removeprefix('torch.')}x{channel.width}"
        for name, channel in channels.items()
    )


def volumes_by_channel(where: str, volume: Volume | Mapping[str, Volume]) -> dict[str, Volume]:
    """Returns volumes by channel name; one volume alone becomes channel "value".

    Raises ValueError if there is none, one is no `Volume`, or they differ in place or extent.
    """
    volumes = dict(volume) if isinstance(volume, Mapping) else {"value": volume}
    if not volumes:
        raise ValueError(f"{where}: volume must name at least one channel")
    for name, one in volumes.items():
        if not isinstance(one, Volume):
            raise ValueError(
                f"{where}: volume must be a Volume (gv.Volume(data, spacing)), "
                f"got {type(one).__name__} for channel {name!r}"
            )
    first, *others = volumes.values()
    for other in others:
        if any(getattr(other, name) != getattr(first, name) for name in _COMMON):
            raise ValueError(
                f"{where}: channels must share extent, spacing and origin: {first} and {other}"
            )
    return volumes
