"""The frames of a DICOM series: their positions, the scaling of their values, and their order.

A frame is one image of a file: the only one (classic), or one of many, which are described by
functional groups (enhanced) or by vectors in the header (others).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..base.image_info import ChannelInfo, ImageInfo, color_channels
from .source import Triple

_EVEN = 0.01  # of the usual step between slices: how much a step may differ from it
#: Attributes that may distinguish images at one position, in order of preference.
_APART = (
    "TemporalPositionIndex",
    "TemporalPositionIdentifier",
    "TriggerTime",
    "FrameReferenceTime",
    "AcquisitionTime",
    "DiffusionBValue",
    "EchoTime",
    "AcquisitionNumber",
    "InstanceNumber",
)
_IN_TIME = {"TriggerTime": "millisecond", "FrameReferenceTime": "millisecond"}
_IN_TIME["AcquisitionTime"] = "second"


@dataclass(frozen=True, kw_only=True)
class DicomFrame:
    """An image of a file."""

    file: str
    number: int  # index of the image in its file
    slope: float
    intercept: float
    position: Triple | None  # of the first voxel's centre, LPS millimetres
    orientation: tuple[float, ...] | None  # of rows, then of columns
    spacing: tuple[float, float]  # between rows, between columns
    between: float | None  # millimetres between slices, where positions do not give it
    moments: dict[str, float] = field(default_factory=dict)  # its values of `_APART`


#: The frames of each time, slice by slice; the (4, 4) affine from (slice, row, column) to LPS
#: millimetres; metadata that is not kept; and the fields time_step and time_unit of an `ImageInfo`.
Ordered = tuple[list[list[DicomFrame]], np.ndarray, list[str], dict[str, Any]]


def frames_of(header: Any, count: int) -> list[DicomFrame]:
    """Returns the frames of a file, from its header without pixels."""
    shared = _first(header.get("SharedFunctionalGroupsSequence"))
    each = header.get("PerFrameFunctionalGroupsSequence") or ()
    if each and len(each) != count:
        raise ValueError(f"{header.filename}: declares {len(each)} frames and holds {count}")
    offsets = [float(v) for v in _list(header.get("GridFrameOffsetVector"))]
    found = []
    for number in range(count):
        groups = [g for g in (each[number] if each else None, shared) if g is not None]
        frame = _frame(header, groups, number)
        if len(offsets) == count > 1 and frame.position and frame.orientation:  # a grid of doses
            normal = np.cross(frame.orientation[:3], frame.orientation[3:])
            moved = np.add(frame.position, normal * (offsets[number] - offsets[0]))
            x, y, z = moved.tolist()
            frame = replace(frame, position=(x, y, z))
        elif count > 1 and not each:  # the header has one position for all of them
            frame = replace(frame, position=None)
        found.append(frame)
    return found


def _frame(header: Any, groups: list[Any], number: int) -> DicomFrame:
    def told(sequence: str, name: str) -> Any:
        for group in groups:
            item = _first(group.get(sequence))
            if item is not None and item.get(name) is not None:
                return item.get(name)
        return header.get(name)

    spacing = _list(told("PixelMeasuresSequence", "PixelSpacing"))
    if not spacing:
        spacing = _list(header.get("ImagerPixelSpacing")) or [1.0, 1.0]
    position = _list(told("PlanePositionSequence", "ImagePositionPatient"))
    orientation = _list(told("PlaneOrientationSequence", "ImageOrientationPatient"))
    slope = told("PixelValueTransformationSequence", "RescaleSlope")
    slope = header.get("DoseGridScaling") if slope is None else slope
    intercept = told("PixelValueTransformationSequence", "RescaleIntercept")
    between = told("PixelMeasuresSequence", "SpacingBetweenSlices")
    moments: dict[str, float] = {}
    for name in _APART:
        value = told("FrameContentSequence", name)
        if name == "DiffusionBValue":
            value = told("MRDiffusionSequence", name)
        if value not in (None, ""):
            moments[name] = _seconds(str(value)) if name == "AcquisitionTime" else float(value)
    if groups:
        moments["InstanceNumber"] = number
    numbers = [*spacing, *position, *orientation, *(v for v in (slope, intercept) if v is not None)]
    if not all(math.isfinite(v) for v in numbers) or len(spacing) != 2:
        raise ValueError(f"{header.filename}: position, spacing or rescaling is not a number")
    return DicomFrame(
        file=header.filename,
        number=number,
        slope=1.0 if slope is None else float(slope),
        intercept=0.0 if intercept is None else float(intercept),
        position=tuple(position) if len(position) == 3 else None,  # type: ignore[arg-type]
        orientation=tuple(orientation) if len(orientation) == 6 else None,
        spacing=(spacing[0], spacing[1]),
        between=None if between is None else abs(float(between)),
        moments=moments,
    )


def order_frames(where: str, frames: Sequence[DicomFrame]) -> Ordered:
    """Sorts frames by time and position.

    Raises:
        ValueError: Slices differ in orientation, spacing or number of images, are missing, not
            evenly spaced or not on a line, or no attribute distinguishes the images of a slice.
    """
    first = frames[0]
    for frame in frames:
        same = np.allclose(frame.spacing, first.spacing, rtol=1e-3)
        if frame.orientation is not None and first.orientation is not None:
            same &= np.allclose(frame.orientation, first.orientation, atol=1e-3)
        if not same:
            raise ValueError(
                f"{where}: a series of slices of different orientation or spacing: "
                f"{first.orientation} {first.spacing} and {frame.orientation} {frame.spacing}; "
                "put those of one kind into a folder of their own"
            )
    rows, columns = _directions(where, first)
    affine = np.eye(4)
    affine[:3, 1], affine[:3, 2] = columns * first.spacing[0], rows * first.spacing[1]
    if any(frame.position is None for frame in frames):
        return _without_place(frames, affine, np.cross(rows, columns))
    slices = _by_place(frames, np.cross(rows, columns))
    count, apart = _times(where, slices)
    ordered = [[one[t] for one in slices] for t in range(count)]
    places = np.array([one[0].position for one in slices])
    affine[:3, 3] = places[0]
    affine[:3, 0] = np.cross(rows, columns) * (first.between or 1.0)
    lost = []
    if len(slices) > 1:
        affine[:3, 0] = _step(where, places, np.cross(rows, columns))
    elif first.between is None:
        lost.append("how thick its only slice is: it is 1 thick here")
    if apart is not None and apart not in (*_IN_TIME, *_APART[:2]):
        lost.append(f"{count} images of each slice differ in {apart}: they are read as time points")
    return ordered, affine, lost, _moments(ordered, apart)


def _directions(where: str, frame: DicomFrame) -> tuple[np.ndarray, np.ndarray]:
    """Returns unit vectors along a row and along a column."""
    told = np.array(frame.orientation or (1, 0, 0, 0, 1, 0), dtype=np.float64)
    rows, columns = told[:3], told[3:]
    lengths = np.linalg.norm(rows), np.linalg.norm(columns)
    if not np.allclose(lengths, 1, atol=1e-2) or abs(rows @ columns) > 1e-2:
        raise ValueError(f"{where}: Image Orientation {told.tolist()} is not a pair of directions")
    return rows / lengths[0], columns / lengths[1]


def _without_place(frames: Sequence[DicomFrame], affine: np.ndarray, normal: np.ndarray) -> Ordered:
    """Orders frames without positions of their own by their numbers."""
    ordered = sorted(frames, key=lambda f: (f.moments.get("InstanceNumber", 0), f.file, f.number))
    between = ordered[0].between
    affine[:3, 0] = normal * (between or 1.0)
    lost = ["slices have no place: they follow their numbers, from 0"]
    if between is None:
        lost[0] += ", 1 apart"
    return [ordered], affine, lost if len(ordered) > 1 else [], {}


def _by_place(frames: Sequence[DicomFrame], normal: np.ndarray) -> list[list[DicomFrame]]:
    """Groups frames by their position along the normal of their plane, in increasing order."""
    depths = np.array([frame.position for frame in frames]) @ normal
    order = np.argsort(depths, kind="stable")
    slices: list[list[DicomFrame]] = []
    last = -math.inf
    for at in order:
        if depths[at] - last > 1e-3:
            slices.append([])
            last = depths[at]
        slices[-1].append(frames[at])
    return slices


def _times(where: str, slices: list[list[DicomFrame]]) -> tuple[int, str | None]:
    """Sorts the frames of each slice by the attribute that distinguishes them; returns how many
    they are, and its name.
    """
    counts = sorted({len(one) for one in slices})
    if counts == [1]:
        return 1, None
    if len(counts) > 1:
        raise ValueError(
            f"{where}: slices occur {counts[0]} to {counts[-1]} times; expected each of "
            f"{len(slices)} positions equally often"
        )

    def differs(name: str) -> bool:
        return all(len({f.moments.get(name, 0.0) for f in one}) == counts[0] for one in slices)

    name = next(filter(differs, _APART), None)
    if name is None:
        raise ValueError(f"{where}: {counts[0]} images of each slice, which nothing distinguishes")
    for one in slices:
        one.sort(key=lambda frame: frame.moments.get(name, 0.0))
    return counts[0], name


def _moments(ordered: list[list[DicomFrame]], apart: str | None) -> dict[str, Any]:
    if len(ordered) == 1:
        return {}
    begin, end = (ordered[at][0].moments for at in (0, -1))
    name = apart if apart in _IN_TIME else next((n for n in _IN_TIME if n in begin), None)
    if name is None:
        return {}
    step = (end.get(name, 0.0) - begin.get(name, 0.0)) / (len(ordered) - 1)
    return {"time_step": step, "time_unit": _IN_TIME[name]} if step > 0 else {}


def _step(where: str, places: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Returns the step between slices; raises ValueError unless all are evenly spaced on a line."""
    gaps = np.diff(places @ normal)
    usual = float(np.median(gaps))
    odd = np.abs(gaps - usual) > max(_EVEN * usual, 2e-3)
    if odd.any():
        at = int(odd.argmax())
        times = gaps[at] / usual
        missing = round(times) - 1
        if missing > 0 and abs(times - round(times)) < 0.1:
            many = "slices are" if missing > 1 else "slice is"
            raise ValueError(
                f"{where}: {missing} {many} missing after slice {at + 1} of {len(places)}: "
                f"the next lies {gaps[at]:.4g} mm further, others {usual:.4g} mm"
            )
        raise ValueError(
            f"{where}: slices are not evenly spaced: {gaps.min():.4g} to {gaps.max():.4g} mm; "
            "resample them, or put those that are into a separate folder"
        )
    step: np.ndarray = (places[-1] - places[0]) / (len(places) - 1)
    beside = places - (places[0] + np.arange(len(places))[:, None] * step)
    if np.abs(beside).max() > max(0.05 * usual, 1e-2):
        raise ValueError(f"{where}: slices do not lie on a line, by {np.abs(beside).max():.4g} mm")
    return step


def image_info(header: Any, samples: int, moments: dict[str, Any]) -> tuple[ImageInfo, list[str]]:
    """Returns the header's metadata of the values, and which metadata is not kept."""
    lost = []
    kind = str(header.get("PhotometricInterpretation", ""))
    if kind == "PALETTE COLOR":
        lost.append("the colours of its palette: values are numbers of its entries")
    if kind == "MONOCHROME1":
        lost.append("that high values are meant to be dark (MONOCHROME1)")
    table = header.get("ModalityLUTSequence") and header.get("RescaleSlope") is None
    if table:
        lost.append("the modality's table: values are those that it looks up")
    quantity = str(
        header.get("RescaleType") or header.get("Units") or header.get("DoseUnits") or ""
    )
    if header.get("Modality") == "CT" and quantity in ("", "US") and not table:
        quantity = "HU"
    shared = _first(header.get("SharedFunctionalGroupsSequence"))
    voi = _first(shared.get("FrameVOILUTSequence")) if shared is not None else None
    center, width = (
        _list((voi if voi is not None else header).get(name))
        for name in ("WindowCenter", "WindowWidth")
    )
    channels: tuple[ChannelInfo, ...] = ()
    if samples == 3:
        channels = color_channels()
    elif center and width and math.isfinite(center[0]) and width[0] >= 1:
        low = center[0] - 0.5 - (width[0] - 1) / 2
        channels = (ChannelInfo(window=(low, low + width[0] - 1)),) if width[0] > 1 else ()
    info = ImageInfo(
        unit="millimeter",
        channels=channels,
        quantity=quantity or None,
        space="right-anterior-superior",
        **moments,
    )
    return info, lost


def _first(sequence: Any) -> Any:
    return sequence[0] if sequence else None


def _list(value: Any) -> list[float]:
    if value is None or value == "":
        return []
    several = hasattr(value, "__iter__") and not isinstance(value, str)
    return [float(part) for part in (value if several else [value])]


def _seconds(text: str) -> float:
    """Returns the seconds since midnight of HHMMSS.FFF."""
    clock = text.replace(":", "").partition(".")
    digits = clock[0].ljust(6, "0")
    rest = float(f"0.{clock[2]}") if clock[2] else 0.0
    return int(digits[:2]) * 3600 + int(digits[2:4]) * 60 + int(digits[4:6]) + rest
