"""Nikon ND2, read with nd2: frame by frame."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.image_info import ChannelInfo, ImageInfo, Rgb, color_channels
from ...base.units import spacing_of
from ..source import Index, Told, VolumeSource
from .format import Format, choose


@dataclass(frozen=True, kw_only=True)
class Nd2Source(VolumeSource):
    """A position of the stage, (t, z, c, y, x, colour)."""

    position: int

    def read_stored(self, index: Index) -> np.ndarray:
        import nd2

        times, places, *inside = index
        out = np.empty([s.stop - s.start for s in index], self.stored)
        with nd2.ND2File(self.path) as file:
            numbers = {
                (at.get("T", 0), at.get("Z", 0)): number
                for number, at in enumerate(file.loop_indices)
                if at.get("P", 0) == self.position
            }
            for t, z in itertools.product(
                range(times.start, times.stop), range(places.start, places.stop)
            ):
                frame = np.asarray(file.read_frame(numbers[t, z] if numbers else 0))
                part = frame.reshape(self.shape[2:])[tuple(inside)]
                out[t - times.start, z - places.start] = part
        return out


@Format("ND2", ".nd2", options=("key",), library="nd2", extra="microscopes")
def open_nd2(path: str, key: str | None = None) -> Nd2Source:
    """Opens the position of the stage of number `key`, the first one if left out."""
    import nd2

    with nd2.ND2File(path) as file:
        sizes: Mapping[str, int] = dict(file.sizes)
        more = {n: size for n, size in sizes.items() if n not in "TPZCYXS" and size > 1}
        if more:
            raise ValueError(f"{path}: has axes other than T, P, Z, C, Y, X: {more}")
        position, others = choose(path, "position", range(sizes.get("P", 1)), key)
        dtype = np.dtype(file.dtype).str
        info, spacing, lost = _told(file, sizes)
    width, colors = int(sizes.get("C", 1)), int(sizes.get("S", 1))
    if width > 1 and colors > 1:
        raise ValueError(f"{path}: {width} channels of colours; expected one")
    inside = [width, int(sizes["Y"]), int(sizes["X"]), colors]
    return Nd2Source(
        path=path,
        shape=(int(sizes.get("T", 1)), int(sizes.get("Z", 1)), *inside),
        axes="tzcyx-" if colors == 1 else "tz-yxc",
        stored=dtype,
        spacing=spacing,
        info=info,
        lost=(*lost, *others),
        position=position,
    )


def _told(file: Any, sizes: Mapping[str, int]) -> Told:
    """Returns info and spacing from the metadata, and which metadata is not kept."""
    voxel = file.voxel_size()
    spacing, unit = spacing_of([float(side) for side in voxel], ["um"] * 3)
    channels = []
    for one in getattr(file.metadata, "channels", None) or ():
        shade = getattr(one.channel, "color", None)
        color: Rgb | None = None
        if shade is not None and hasattr(shade, "r"):
            color = (shade.r / 255, shade.g / 255, shade.b / 255)
        channels.append(ChannelInfo(name=one.channel.name or "", color=color))
    if sizes.get("S", 1) == 3:
        channels = [*color_channels()]
    step = next(
        (
            float(loop.parameters.periodMs)
            for loop in file.experiment
            if loop.type == "TimeLoop" and loop.parameters.periodMs > 0
        ),
        None,
    )
    width = sizes.get("C", 1) * sizes.get("S", 1)
    lost = ["regions of interest (ROI)"] if getattr(file, "rois", None) else []
    info = ImageInfo(
        unit=unit,
        channels=tuple(channels) if len(channels) == width else (),
        time_step=step,
        time_unit="millisecond" if step else None,
    )
    return info, spacing, lost
