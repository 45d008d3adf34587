"""Zeiss CZI, read with pylibCZIrw: by region, the finest level, with tiles joined.

Source: ZISRAW (CZI) metadata of pylibCZIrw's documentation: Scaling, Channels, DisplaySetting.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ...base.digits import finite_number
from ...base.image_info import ChannelInfo, ImageInfo, Rgb, color_channels, from_hex
from ...base.units import NO_DEPTH, spacing_of
from ..source import Index, Told, VolumeSource
from .format import Format, choose

_DTYPES = {
    "Gray8": ("u1", 1),
    "Gray16": ("u2", 1),
    "Gray32Float": ("f4", 1),
    "Bgr24": ("u1", 3),
    "Bgr48": ("u2", 3),
    "Bgr96Float": ("f4", 3),
}


@dataclass(frozen=True, kw_only=True)
class CziSource(VolumeSource):
    """A scene, (t, c, z, y, x, colour)."""

    scene: int | None
    corner: tuple[int, int]  # x y of its rectangle
    starts: tuple[tuple[str, int], ...]  # first index along each of T, C, Z

    def read_stored(self, index: Index) -> np.ndarray:
        from pylibCZIrw import czi

        rows, columns = index[3], index[4]
        size = (columns.stop - columns.start, rows.stop - rows.start)
        roi = (self.corner[0] + columns.start, self.corner[1] + rows.start, *size)
        out = np.empty([s.stop - s.start for s in index], self.stored)
        spans = [range(s.start, s.stop) for s in index[:3]]
        with czi.open_czi(self.path) as file:
            for place in itertools.product(*spans):
                plane = {n: at + first for at, (n, first) in zip(place, self.starts, strict=True)}
                found = file.read(roi=roi, plane=plane, scene=self.scene)
                if found.shape[2] == 3:
                    found = found[..., ::-1]  # blue comes first
                at = tuple(p - span.start for p, span in zip(place, spans, strict=True))
                out[at] = found[..., index[5]]
        return out


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
        kinds = sorted(set(file.pixel_types.values()))
        xml = file.raw_metadata
        scene, whole = None, file.total_bounding_rectangle
        others: tuple[str, ...] = ()
        if scenes or key is not None:
            at, others = choose(path, "scene", sorted(scenes), key)
            scene = sorted(scenes)[at]
            whole = scenes[scene]
    more = {n: b - a for n, (a, b) in box.items() if n not in "TCZXYSM" and b - a > 1}
    if more:
        told = ", ".join(f"{name} {size}" for name, size in more.items())
        raise ValueError(f"{path}: has axes other than T, C, Z, Y, X: {told}")
    if len(kinds) != 1 or kinds[0] not in _DTYPES:
        raise ValueError(f"{path}: pixels are {', '.join(map(str, kinds))}; expected one kind")
    stored, colors = _DTYPES[kinds[0]]
    starts = tuple((name, box.get(name, (0, 1))[0]) for name in "TCZ")
    counts = [box.get(name, (0, 1))[1] - first for name, first in starts]
    if counts[1] > 1 and colors > 1:
        raise ValueError(f"{path}: {counts[1]} channels of colours; expected one")
    info, spacing, lost = _told(xml, counts[1], colors, stored)
    return CziSource(
        path=path,
        shape=(*counts, whole.h, whole.w, colors),
        axes="tczyx-" if colors == 1 else "t-zyxc",
        stored=stored,
        spacing=spacing,
        info=info,
        lost=(*lost, *others),
        scene=scene,
        corner=(whole.x, whole.y),
        starts=starts,
    )


def _told(xml: str, width: int, colors: int, stored: str) -> Told:
    """Returns info and spacing from the metadata, and which metadata is not kept."""
    root = ElementTree.fromstring(xml)
    sizes: dict[str, float | None] = {}
    for item in root.iterfind(".//Scaling/Items/Distance"):
        value = finite_number(item.findtext("Value"))
        sizes[item.get("Id", "")] = value * 1e6 if value else None
    spacing, unit = spacing_of([sizes.get(axis) for axis in "XYZ"], ["um"] * 3)
    shown = {item.get("Id"): item for item in root.iterfind(".//DisplaySetting/Channels/Channel")}
    channels = [
        _channel(item, shown.get(item.get("Id")), stored)
        for item in root.iterfind(".//Information/Image/Dimensions/Channels/Channel")
    ]
    if colors == 3:
        channels = [*color_channels()]
    step = finite_number(
        root.findtext(".//Information/Image/Dimensions/T/Positions/Interval/Increment")
    )
    lost = []
    if unit and sizes.get("Z") is None and int(root.findtext(".//Image/SizeZ") or 1) > 1:
        lost.append(NO_DEPTH)
    info = ImageInfo(
        unit=unit,
        channels=tuple(channels) if len(channels) == width * colors else (),
        time_step=step if step and step > 0 else None,
        time_unit="second" if step and step > 0 else None,
    )
    return info, spacing, lost


def _channel(item: Any, shown: Any, stored: str) -> ChannelInfo:
    """Returns name, colour, window of a channel; Low and High are shares of the dtype's maximum."""
    text = (None if shown is None else shown.findtext("Color")) or item.findtext("Color") or ""
    color: Rgb | None = None
    if len(text) in (7, 9) and text.startswith("#"):
        color = from_hex(text[-6:])
    window = None
    ends = [
        finite_number(None if shown is None else shown.findtext(name)) for name in ("Low", "High")
    ]
    if None not in ends and stored != "f4":
        most = float(np.iinfo(stored).max)
        low, high = (float(end or 0.0) * most for end in ends)
        window = (low, high) if low < high else None
    return ChannelInfo(name=item.get("Name") or "", color=color, window=window)
