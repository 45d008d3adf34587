"""MetaImage, `.mha` and `.mhd`: a header of text lines, and numbers, packed by zlib or not.

World axes are converted to x right, y anterior, z superior (RAS), as in NIfTI: the file's own (LPS)
are x left, y posterior.
Source: "MetaIO documentation" (Insight Software Consortium), tags of images; ITK's MetaImageIO.
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from ...base.image_info import ImageInfo, color_channels
from ...base.units import length_unit
from ..source import (
    LPS_TO_RAS,
    ArraySource,
    VolumeSource,
    number_type,
    place_axes,
    time_fields,
)
from ..text_source import TextSource
from .format import Format

_LONG_TYPES = {"MET_LONG": "i4", "MET_ULONG": "u4"}
_MAX_HEADER_BYTES = 1 << 20
_STEP_FIELDS, _OFFSET_FIELDS = ("ElementSpacing", "ElementSize"), ("Offset", "Position", "Origin")
_KNOWN_FIELDS = {
    *("ObjectType", "NDims", "BinaryData", "BinaryDataByteOrderMSB", "ElementByteOrderMSB"),
    *("CompressedData", "CompressedDataSize", "TransformMatrix", "Rotation", "Orientation"),
    *("Offset", "Position", "Origin", "CenterOfRotation", "AnatomicalOrientation", "DimSize"),
    *("ElementSpacing", "ElementSize", "ElementType", "ElementNumberOfChannels", "HeaderSize"),
    *("ElementDataFile", "Modality", "DistanceUnits", "ObjectSubType", "ElementMin", "ElementMax"),
    *("ITK_InputFilterName", "CompressionLevel", "AcquisitionDate", "Name", "Comment", "ID"),
}


@Format("MetaImage", ".mha", ".mhd")
def open_metaimage(path: str) -> VolumeSource:
    """Opens an image of 2 to 4 axes, the fourth of which counts times."""
    header, end = _read_header(path)
    rank = int(header.get("NDims", 3))
    shape = tuple(int(n) for n in header["DimSize"].split())
    if rank not in (2, 3, 4) or len(shape) != rank:
        raise ValueError(f"{path}: expected 2 to 4 dimensions, got {shape} of {rank}")
    name = header["ElementType"].removesuffix("_ARRAY")
    number_dtype = _LONG_TYPES.get(name) or number_type(name.removeprefix("MET_"))
    if number_dtype is None:
        raise ValueError(f"{path}: ElementType {header['ElementType']!r} is unknown")
    width = int(header.get("ElementNumberOfChannels", 1))
    if width < 1:
        raise ValueError(f"{path}: {width} channels")
    is_big = _is_true(header, "ElementByteOrderMSB", "BinaryDataByteOrderMSB")
    dropped = [f"{name} of the header" for name in sorted(set(header) - _KNOWN_FIELDS)][:8]
    fields: dict[str, Any] = {
        "path": path,
        "stored": np.dtype((">" if is_big else "<") + number_dtype).str,
        "shape": ((width,) if width > 1 else ()) + shape,
        "info": _info(path, header, width, rank),
        "dropped": tuple(dropped),
        **_placement(path, header, shape, width),
    }
    data_name = header["ElementDataFile"]
    data_file = str(Path(path).parent / data_name)
    if data_name.upper() == "LIST" or ("%" in data_name and not os.path.exists(data_file)):
        raise ValueError(f"{path}: its slices are in several files (ElementDataFile = {data_name})")
    is_local = data_name.upper() == "LOCAL"
    data_file = path if is_local else data_file
    header_size = int(header.get("HeaderSize", 0))
    start = header_size if header_size > 0 else end if is_local else 0
    if "BinaryData" in header and not _is_true(header, "BinaryData"):
        return TextSource(file=data_file, offset=start, fortran=True, **fields)
    if _is_true(header, "CompressedData"):
        fields |= {"codec": "zlib", "start": start, "whole": True, "exact": True}
        return ArraySource(file=data_file, fortran=True, **fields)
    if header_size < 0:  # the numbers are at the end of the file
        needed_bytes = math.prod(fields["shape"]) * np.dtype(number_dtype).itemsize
        start = max(0, os.stat(data_file).st_size - needed_bytes)
    return ArraySource(file=data_file, offset=start, fortran=True, **fields)


def _read_header(path: str) -> tuple[dict[str, str], int]:
    """Returns the header's values by name, up to ElementDataFile, and the offset of its end."""
    with open(path, "rb") as file:
        text = file.read(_MAX_HEADER_BYTES).decode("latin-1")
    fields: dict[str, str] = {}
    position, line = 0, re.compile(r"[^\S\n]*(\w+)[^\S\n]*[=:](.*)\n?")
    while "ElementDataFile" not in fields and (match := line.match(text, position)):
        fields[match[1]], position = match[2].strip(), match.end()
    for name in ("ElementDataFile", "DimSize", "ElementType"):
        if name not in fields:
            raise ValueError(f"no MetaImage: the header has no {name}")
    return fields, position


def _is_true(header: dict[str, str], *names: str) -> bool:
    """Returns whether the first field of `names` that the header has is true. MetaIO decides by its
    first letter: "True", "T" and "1" are.
    """
    return next((header[name] for name in names if name in header), "")[:1] in ("T", "t", "1")


def _numbers(path: str, header: dict[str, str], count: int, *names: str) -> np.ndarray | None:
    """Returns `count` numbers of the first field that the header has; None if it has none."""
    text = next((header[name] for name in names if name in header), None)
    values = np.array([float(v) for v in text.split()]) if text else None
    if values is not None and len(values) != count:
        raise ValueError(f"{path}: {names[0]} must be {count} numbers, got {text!r}")
    return values


def _placement(
    path: str, header: dict[str, str], shape: tuple[int, ...], width: int
) -> dict[str, Any]:
    """Returns axes and position of the array; its first axis counts channels, if it has several."""
    rank = len(shape)
    steps = _numbers(path, header, rank, *_STEP_FIELDS)
    steps = np.ones(rank) if steps is None else steps
    matrix = _numbers(path, header, rank * rank, "TransformMatrix", "Rotation", "Orientation")
    matrix = np.eye(rank) if matrix is None else matrix.reshape(rank, rank).T
    offset = _numbers(path, header, rank, *_OFFSET_FIELDS)
    affine, space = np.eye(4), min(rank, 3)
    affine[:space, :space] = (matrix * steps)[:space, :space]
    affine[:space, 3] = 0.0 if offset is None else offset[:space]
    spatial = (*shape[:3], 1)[:3]
    placement = place_axes(path, LPS_TO_RAS @ affine, spatial)
    placement["axes"] = "c" * (width > 1) + placement["axes"][:space] + "t" * (rank == 4)
    return placement


def _info(path: str, header: dict[str, str], width: int, rank: int) -> ImageInfo:
    """Returns the header's metadata of the values."""
    modality = header.get("Modality", "")
    fields = (_numbers(path, header, rank, *names) for names in (_STEP_FIELDS, _OFFSET_FIELDS))
    step, origin = (0.0 if n is None or rank < 4 else float(n[3]) for n in fields)
    color = width == 3 and header["ElementType"].startswith("MET_UCHAR")
    return ImageInfo(
        unit=length_unit(header.get("DistanceUnits", "mm")),
        quantity="HU" if modality == "MET_MOD_CT" else None,
        channels=color_channels() if color else (),
        space="right-anterior-superior",
        **time_fields(step, None, origin),
    )
