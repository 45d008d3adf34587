"""Nikon ND2, read with nd2: frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.image_info import ChannelInfo, Rgb, color_channels
from ...base.units import spacing_of
from ..source import FileMetadata, Index, VolumeSource, microscope_info, read_planes
from .format import Format, choose


@dataclass(frozen=True, kw_only=True)
class Nd2Source(VolumeSource):
    """A position of the stage, (t, z, c, y, x, colour)."""

    position: int

    def read_stored(self, index: Index) -> np.ndarray:
        import nd2

        with nd2.ND2File(self.path) as file:
            frame_numbers = {
                (loop_index.get("T", 0), loop_index.get("Z", 0)): number
                for number, loop_index in enumerate(file.loop_indices)
                if loop_index.get("P", 0) == self.position
            }

            def read(position: tuple[int, ...]) -> np.ndarray:
                t, z = position
                frame = np.asarray(file.read_frame(frame_numbers[t, z] if frame_numbers else 0))
                return frame.reshape(self.shape[2:])[index[2:]]

            return read_planes(index, 2, self.stored, read)


@Format("ND2", ".nd2", options=("key",), library="nd2", extra="microscopes")
def open_nd2(path: str, key: str | None = None) -> Nd2Source:
    """Opens the position of the stage of number `key`, the first one if left out."""
    import nd2

    with nd2.ND2File(path) as file:
        sizes: Mapping[str, int] = dict(file.sizes)
        extra_axes = {a: size for a, size in sizes.items() if a not in "TPZCYXS" and size > 1}
        if extra_axes:
            raise ValueError(f"{path}: has axes other than T, P, Z, C, Y, X: {extra_axes}")
        position, others = choose(path, "position", range(sizes.get("P", 1)), key)
        dtype = np.dtype(file.dtype).str
        info, spacing, dropped = _read_metadata(file, sizes)
    width, colors = int(sizes.get("C", 1)), int(sizes.get("S", 1))
    if width > 1 and colors > 1:
        raise ValueError(f"{path}: {width} channels of colours; expected one")
    plane_shape = [width, int(sizes["Y"]), int(sizes["X"]), colors]
    return Nd2Source(
        path=path,
        shape=(int(sizes.get("T", 1)), int(sizes.get("Z", 1)), *plane_shape),
        axes="tzcyx-" if colors == 1 else "tz-yxc",
        stored=dtype,
        spacing=spacing,
        info=info,
        dropped=(*dropped, *others),
        position=position,
    )


def _read_metadata(file: Any, sizes: Mapping[str, int]) -> FileMetadata:
    """Returns info and spacing from the metadata, and which metadata is not kept."""
    voxel = file.voxel_size()
    spacing, unit = spacing_of([float(side) for side in voxel], ["um"] * 3)
    channels = []
    for channel in getattr(file.metadata, "channels", None) or ():
        channel_color = getattr(channel.channel, "color", None)
        color: Rgb | None = None
        if channel_color is not None and hasattr(channel_color, "r"):
            color = (channel_color.r / 255, channel_color.g / 255, channel_color.b / 255)
        channels.append(ChannelInfo(name=channel.channel.name or "", color=color))
    if sizes.get("S", 1) == 3:
        channels = [*color_channels()]
    periods = (loop.parameters.periodMs for loop in file.experiment if loop.type == "TimeLoop")
    step = next((float(period) for period in periods if period > 0), None)
    width = sizes.get("C", 1) * sizes.get("S", 1)
    dropped = ["regions of interest (ROI)"] if getattr(file, "rois", None) else []
    return microscope_info(unit, channels, width, step, "millisecond"), spacing, dropped
