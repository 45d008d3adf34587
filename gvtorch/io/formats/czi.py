"""Zeiss CZI, read with pylibCZIrw: by region, the finest level, with tiles joined.

Source: ZISRAW (CZI) metadata of pylibCZIrw's documentation: Scaling, Channels, DisplaySetting.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ...base.digits import finite_number
from ...base.image_info import ChannelInfo, Rgb, color_channels, from_hex
from ...base.units import NO_DEPTH, spacing_of
from ..source import FileMetadata, Index, VolumeSource, microscope_info, read_planes
from .format import Format, choose

_GRAY = {"Gray8": ("u1", 1), "Gray16": ("u2", 1), "Gray32Float": ("f4", 1)}
_DTYPES = {**_GRAY, "Bgr24": ("u1", 3), "Bgr48": ("u2", 3), "Bgr96Float": ("f4", 3)}


@dataclass(frozen=True, kw_only=True)
class CziSource(VolumeSource):
    """A scene, (t, c, z, y, x, colour)."""

    scene: int | None
    corner: tuple[int, int]  # x y of its rectangle

    def read_stored(self, index: Index) -> np.ndarray:
        from pylibCZIrw import czi

        rows, columns = index[3], index[4]
        size = (columns.stop - columns.start, rows.stop - rows.start)
        roi = (self.corner[0] + columns.start, self.corner[1] + rows.start, *size)
        with czi.open_czi(self.path) as file:

            def read(position: tuple[int, ...]) -> np.ndarray:
                plane = dict(zip("TCZ", position, strict=True))
                pixels = file.read(roi=roi, plane=plane, scene=self.scene)
                if pixels.shape[2] == 3:
                    pixels = pixels[..., ::-1]  # blue comes first
                return pixels[..., index[5]]

            return read_planes(index, 3, self.stored, read)


@Format("CZI", ".czi", options=("key",), library="pylibCZIrw", extra="microscopes")
def open_czi(path: str, key: str | None = None) -> CziSource:
    """Opens the scene of number `key`, the first one if left out."""
    from pylibCZIrw import czi

    with open(path, "rb") as file:
        if file.read(10) != b"ZISRAWFILE":
            raise ValueError("does not start like a CZI file")
    with czi.open_czi(path) as file:
        box = file.total_bounding_box
        scenes = file.scenes_bounding_rectangle
        pixel_types = sorted(set(file.pixel_types.values()))
        xml = file.raw_metadata
        scene, bounds = None, file.total_bounding_rectangle
        others: tuple[str, ...] = ()
        if scenes or key is not None:
            chosen, others = choose(path, "scene", sorted(scenes), key)
            scene = sorted(scenes)[chosen]
            bounds = scenes[scene]
    sizes = {axis: count for axis, (_, count) in box.items()}
    if extra_axes := [f"{a} {n}" for a, n in sizes.items() if a not in "TCZXYSM" and n > 1]:
        raise ValueError(f"{path}: has axes other than T, C, Z, Y, X: {', '.join(extra_axes)}")
    if len(pixel_types) != 1 or pixel_types[0] not in _DTYPES:
        kinds = ", ".join(map(str, pixel_types))
        raise ValueError(f"{path}: pixels are {kinds}; expected one kind")
    stored, colors = _DTYPES[pixel_types[0]]
    counts = [sizes[name] for name in "TCZ"]
    if counts[1] > 1 and colors > 1:
        raise ValueError(f"{path}: {counts[1]} channels of colours; expected one")
    info, spacing, dropped = _read_metadata(xml, counts[1], colors, stored)
    return CziSource(
        path=path,
        shape=(*counts, bounds.h, bounds.w, colors),
        axes="tczyx-" if colors == 1 else "t-zyxc",
        stored=stored,
        spacing=spacing,
        info=info,
        dropped=(*dropped, *others),
        scene=scene,
        corner=(bounds.x, bounds.y),
    )


def _read_metadata(xml: str, width: int, colors: int, stored: str) -> FileMetadata:
    """Returns info and spacing from the metadata, and which metadata is not kept."""
    root = ElementTree.fromstring(xml)
    sizes: dict[str, float | None] = {}
    for element in root.iterfind(".//Scaling/Items/Distance"):
        value = finite_number(element.findtext("Value"))
        sizes[element.get("Id", "")] = value * 1e6 if value else None
    spacing, unit = spacing_of([sizes.get(axis) for axis in "XYZ"], ["um"] * 3)
    shown = {e.get("Id"): e for e in root.iterfind(".//DisplaySetting/Channels/Channel")}
    dimensions = ".//Information/Image/Dimensions"
    elements = root.iterfind(f"{dimensions}/Channels/Channel")
    channels = [_channel(element, shown.get(element.get("Id")), stored) for element in elements]
    if colors == 3:
        channels = [*color_channels()]
    time_step = finite_number(root.findtext(f"{dimensions}/T/Positions/Interval/Increment"))
    dropped = []
    if unit and sizes.get("Z") is None and int(root.findtext(".//Image/SizeZ") or 1) > 1:
        dropped.append(NO_DEPTH)
    return microscope_info(unit, channels, width * colors, time_step, "second"), spacing, dropped


def _channel(element: Any, display: Any, stored: str) -> ChannelInfo:
    """Returns name, colour, window of a channel; Low and High are shares of the dtype's maximum."""
    shown = (lambda name: None) if display is None else display.findtext
    hex_color = shown("Color") or element.findtext("Color") or ""
    color: Rgb | None = None
    if len(hex_color) in (7, 9) and hex_color.startswith("#"):
        color = from_hex(hex_color[-6:])
    window = None
    limits = [finite_number(shown(name)) for name in ("Low", "High")]
    if None not in limits and stored != "f4":
        max_value = float(np.iinfo(stored).max)
        low, high = (float(end or 0.0) * max_value for end in limits)
        window = (low, high) if low < high else None
    return ChannelInfo(name=element.get("Name") or "", color=color, window=window)
