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

_STEP_TOLERANCE = 0.01  # of the usual step between slices: how much a step may differ from it
#: Attributes that may distinguish images at one position, in order of preference.
_DISTINGUISHING = (
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
_TIME_UNITS = {"TriggerTime": "millisecond", "FrameReferenceTime": "millisecond"}
_TIME_UNITS["AcquisitionTime"] = "second"


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
    slice_spacing: float | None  # millimetres between slices, where positions do not give it
    attributes: dict[str, float] = field(default_factory=dict)  # its values of `_DISTINGUISHING`


#: The frames of each time, slice by slice; the (4, 4) affine from (slice, row, column) to LPS
#: millimetres; metadata that is not kept; and the fields time_step and time_unit of an `ImageInfo`.
Ordered = tuple[list[list[DicomFrame]], np.ndarray, list[str], dict[str, Any]]


def frames_of(header: Any, count: int) -> list[DicomFrame]:
    """Returns the frames of a file, from its header without pixels."""
    shared = _first_item(header.get("SharedFunctionalGroupsSequence"))
    per_frame = header.get("PerFrameFunctionalGroupsSequence") or ()
    if per_frame and len(per_frame) != count:
        raise ValueError(f"{header.filename}: declares {len(per_frame)} frames and holds {count}")
    offsets = _floats(header.get("GridFrameOffsetVector"))
    frames = []
    for number in range(count):
        groups = [g for g in (per_frame[number] if per_frame else None, shared) if g is not None]
        frame = _frame(header, groups, number)
        if len(offsets) == count > 1 and frame.position and frame.orientation:  # a grid of doses
            normal = np.cross(frame.orientation[:3], frame.orientation[3:])
            moved = np.add(frame.position, normal * (offsets[number] - offsets[0]))
            x, y, z = moved.tolist()
            frame = replace(frame, position=(x, y, z))
        elif count > 1 and not per_frame:  # the header has one position for all of them
            frame = replace(frame, position=None)
        frames.append(frame)
    return frames


def _frame(header: Any, groups: list[Any], number: int) -> DicomFrame:
    def attribute(sequence: str, name: str) -> Any:
        for group in groups:
            item = _first_item(group.get(sequence))
            if item is not None and item.get(name) is not None:
                return item.get(name)
        return header.get(name)

    spacing = _floats(attribute("PixelMeasuresSequence", "PixelSpacing"))
    for name in ("ImagerPixelSpacing", "PixelAspectRatio"):
        spacing = spacing or _floats(header.get(name))
    spacing = spacing or [1.0, 1.0]
    position = _floats(attribute("PlanePositionSequence", "ImagePositionPatient"))
    orientation = _floats(attribute("PlaneOrientationSequence", "ImageOrientationPatient"))
    slope = attribute("PixelValueTransformationSequence", "RescaleSlope")
    slope = header.get("DoseGridScaling") if slope is None else slope
    intercept = attribute("PixelValueTransformationSequence", "RescaleIntercept")
    slice_spacing = attribute("PixelMeasuresSequence", "SpacingBetweenSlices")
    attributes: dict[str, float] = {}
    for name in _DISTINGUISHING:
        value = attribute("FrameContentSequence", name)
        if name == "DiffusionBValue":
            value = attribute("MRDiffusionSequence", name)
        if value not in (None, ""):
            attributes[name] = _seconds(str(value)) if name == "AcquisitionTime" else float(value)
    if groups:
        attributes["InstanceNumber"] = number
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
        slice_spacing=None if slice_spacing is None else abs(float(slice_spacing)),
        attributes=attributes,
    )


def order_frames(path: str, frames: Sequence[DicomFrame]) -> Ordered:
    """Sorts frames by time and position.

    Raises:
        ValueError: Slices differ in orientation, spacing or number of images, are missing, not
            evenly spaced or not on a line, or no attribute distinguishes the images of a slice.
    """
    first = frames[0]
    for frame in frames:
        is_alike = np.allclose(frame.spacing, first.spacing, rtol=1e-3)
        if frame.orientation is not None and first.orientation is not None:
            is_alike &= np.allclose(frame.orientation, first.orientation, atol=1e-3)
        if not is_alike:
            raise ValueError(
                f"{path}: a series of slices of different orientation or spacing: "
                f"{first.orientation} {first.spacing} and {frame.orientation} {frame.spacing}; "
                "put those of one kind into a folder of their own"
            )
    rows, columns = _directions(path, first)
    affine, normal = np.eye(4), np.cross(rows, columns)
    affine[:3, 1], affine[:3, 2] = columns * first.spacing[0], rows * first.spacing[1]
    if any(frame.position is None for frame in frames):
        return _order_by_number(frames, affine, normal)
    slices = _group_by_position(frames, normal)
    count, attribute = _sort_times(path, slices)
    ordered = [[slice_frames[t] for slice_frames in slices] for t in range(count)]
    positions = np.array([slice_frames[0].position for slice_frames in slices])
    affine[:3, 3] = positions[0]
    affine[:3, 0] = normal * (first.slice_spacing or 1.0)
    dropped = []
    if len(slices) > 1:
        affine[:3, 0] = _step(path, positions, normal)
    elif first.slice_spacing is None:
        dropped.append("how thick its only slice is: it is 1 thick here")
    if attribute is not None and attribute not in (*_TIME_UNITS, *_DISTINGUISHING[:2]):
        dropped.append(
            f"{count} images of each slice differ in {attribute}: they are read as time points"
        )
    return ordered, affine, dropped, _time_fields(ordered, attribute)


def _directions(path: str, frame: DicomFrame) -> tuple[np.ndarray, np.ndarray]:
    """Returns unit vectors along a row and along a column."""
    orientation = np.array(frame.orientation or (1, 0, 0, 0, 1, 0), dtype=np.float64)
    rows, columns = orientation[:3], orientation[3:]
    lengths = np.linalg.norm(rows), np.linalg.norm(columns)
    if not np.allclose(lengths, 1, atol=1e-2) or abs(rows @ columns) > 1e-2:
        raise ValueError(f"{path}: Image Orientation {orientation.tolist()} is not two directions")
    return rows / lengths[0], columns / lengths[1]


def _order_by_number(
    frames: Sequence[DicomFrame], affine: np.ndarray, normal: np.ndarray
) -> Ordered:
    """Orders frames without positions of their own by their numbers."""
    ordered = sorted(
        frames, key=lambda f: (f.attributes.get("InstanceNumber", 0), f.file, f.number)
    )
    slice_spacing = ordered[0].slice_spacing
    affine[:3, 0] = normal * (slice_spacing or 1.0)
    dropped = ["slices have no place: they follow their numbers, from 0"]
    if slice_spacing is None:
        dropped[0] += ", 1 apart"
    return [ordered], affine, dropped if len(ordered) > 1 else [], {}


def _group_by_position(frames: Sequence[DicomFrame], normal: np.ndarray) -> list[list[DicomFrame]]:
    """Groups frames by their position along the normal of their plane, in increasing order."""
    depths = np.array([frame.position for frame in frames]) @ normal
    order = np.argsort(depths, kind="stable")
    slices: list[list[DicomFrame]] = []
    last = -math.inf
    for index in order:
        if depths[index] - last > 1e-3:
            slices.append([])
            last = depths[index]
        slices[-1].append(frames[index])
    return slices


def _sort_times(path: str, slices: list[list[DicomFrame]]) -> tuple[int, str | None]:
    """Sorts each slice's frames by what distinguishes them; returns their number, and its name."""
    counts = sorted({len(slice_frames) for slice_frames in slices})
    if counts == [1]:
        return 1, None
    if len(counts) > 1:
        raise ValueError(
            f"{path}: slices occur {counts[0]} to {counts[-1]} times; expected each of "
            f"{len(slices)} positions equally often"
        )

    def differs(name: str) -> bool:
        values = ({f.attributes.get(name, 0.0) for f in slice_frames} for slice_frames in slices)
        return all(len(distinct) == counts[0] for distinct in values)

    name = next(filter(differs, _DISTINGUISHING), None)
    if name is None:
        raise ValueError(f"{path}: {counts[0]} images of each slice, which nothing distinguishes")
    for slice_frames in slices:
        slice_frames.sort(key=lambda frame: frame.attributes.get(name, 0.0))
    return counts[0], name


def _time_fields(ordered: list[list[DicomFrame]], attribute: str | None) -> dict[str, Any]:
    if len(ordered) == 1:
        return {}
    first_attributes, last_attributes = (ordered[index][0].attributes for index in (0, -1))
    known = (n for n in _TIME_UNITS if n in first_attributes)
    name = attribute if attribute in _TIME_UNITS else next(known, None)
    if name is None:
        return {}
    step = (last_attributes.get(name, 0.0) - first_attributes.get(name, 0.0)) / (len(ordered) - 1)
    return {"time_step": step, "time_unit": _TIME_UNITS[name]} if step > 0 else {}


def _step(path: str, positions: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Returns the step between slices; raises ValueError unless all are evenly spaced on a line."""
    gaps = np.diff(positions @ normal)
    usual_gap = float(np.median(gaps))
    is_uneven = np.abs(gaps - usual_gap) > max(_STEP_TOLERANCE * usual_gap, 2e-3)
    if is_uneven.any():
        index = int(is_uneven.argmax())
        gap_ratio = gaps[index] / usual_gap
        missing = round(gap_ratio) - 1
        if missing > 0 and abs(gap_ratio - round(gap_ratio)) < 0.1:
            subject = "slices are" if missing > 1 else "slice is"
            raise ValueError(
                f"{path}: {missing} {subject} missing after slice {index + 1} of {len(positions)}: "
                f"the next lies {gaps[index]:.4g} mm further, others {usual_gap:.4g} mm"
            )
        raise ValueError(
            f"{path}: slices are not evenly spaced: {gaps.min():.4g} to {gaps.max():.4g} mm; "
            "resample them, or put those that are into a separate folder"
        )
    step: np.ndarray = (positions[-1] - positions[0]) / (len(positions) - 1)
    on_line = positions[0] + np.arange(len(positions))[:, None] * step
    deviation = np.abs(positions - on_line).max()
    if deviation > max(0.05 * usual_gap, 1e-2):
        raise ValueError(f"{path}: slices do not lie on a line, by {deviation:.4g} mm")
    return step


def image_info(
    header: Any, samples: int, time_fields: dict[str, Any]
) -> tuple[ImageInfo, list[str]]:
    """Returns the header's metadata of the values, and which metadata is not kept."""
    dropped = []
    photometric = str(header.get("PhotometricInterpretation", ""))
    if photometric == "PALETTE COLOR":
        dropped.append("the colours of its palette: values are numbers of its entries")
    if photometric == "MONOCHROME1":
        dropped.append("that high values are meant to be dark (MONOCHROME1)")
    uses_table = header.get("ModalityLUTSequence") and header.get("RescaleSlope") is None
    if uses_table:
        dropped.append("the modality's table: values are those that it looks up")
    if header.get("RealWorldValueMappingSequence") and header.get("RescaleSlope") is None:
        dropped.append("the mapping to real world values: values are as stored")
    quantities = (header.get(name) for name in ("RescaleType", "Units", "DoseUnits"))
    quantity = str(next(filter(None, quantities), ""))
    if header.get("Modality") == "CT" and quantity in ("", "US") and not uses_table:
        quantity = "HU"
    shared = _first_item(header.get("SharedFunctionalGroupsSequence"))
    voi = _first_item(shared.get("FrameVOILUTSequence")) if shared is not None else None
    window = voi if voi is not None else header
    center, width = (_floats(window.get(name)) for name in ("WindowCenter", "WindowWidth"))
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
        **time_fields,
    )
    return info, dropped


def _first_item(sequence: Any) -> Any:
    return sequence[0] if sequence else None


def _floats(value: Any) -> list[float]:
    if value is None or value == "":
        return []
    is_list = hasattr(value, "__iter__") and not isinstance(value, str)
    return [float(part) for part in (value if is_list else [value])]


def _seconds(text: str) -> float:
    """Returns the seconds since midnight of HHMMSS.FFF."""
    clock = text.replace(":", "").partition(".")
    digits = clock[0].ljust(6, "0")
    fraction = float(f"0.{clock[2]}") if clock[2] else 0.0
    return int(digits[:2]) * 3600 + int(digits[2:4]) * 60 + int(digits[4:6]) + fraction
