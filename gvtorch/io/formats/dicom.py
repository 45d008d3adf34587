"""DICOM, read with pydicom: the images of a series in a folder, or the frames of one file.

World axes are those of NIfTI, x right, y anterior, z superior (RAS), in millimetres: DICOM's own x
and y (LPS) are negated, so a scan lies where its NIfTI version lies. Slices are separated by their
positions (Image Position), never by their thickness.
Source: DICOM PS3.3, C.7.6.2 (image plane), C.7.6.16 (functional groups), C.11.1 (rescale).
"""

from __future__ import annotations

import math
import os
import re
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import numpy as np

from ...base.boxes import check_extent
from ..dicom_codecs import plugin_of
from ..dicom_frames import DicomFrame, frames_of, image_info, order_frames
from ..source import LPS_TO_RAS, Index, VolumeSource, place_axes
from ..stores.ngff import is_zarr
from .format import Format, not_chosen

_MAX_FILES = 200_000
_MAX_UNPACKED_BYTES = 1 << 32
_ENDINGS = (".dcm", ".dicom", ".ima")
_SKIPPED_ENDINGS = (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".bmp", ".txt", ".json")  # not opened
_DEFLATED = "1.2.840.10008.1.2.1.99"


@dataclass(frozen=True, kw_only=True)
class DicomSource(VolumeSource):
    """Images (t, z, rows, columns) or (t, z, rows, columns, c)."""

    # File, number in it, slope and intercept of each frame, by time, then slice.
    frames: tuple[tuple[str, int, float, float], ...]

    @property
    def files(self) -> set[str]:
        """The files of all frames."""
        return {file for file, *_ in self.frames}

    def check_file(self) -> None:
        """Raises ValueError if an uncompressed file is too short for its images, or if their values
        do not begin at the lowest bit.
        """
        for file, number, *_ in dict((frame[0], frame) for frame in self.frames).values():
            header, file_bytes, syntax = _header(file), os.stat(file).st_size, _syntax(file)
            if not syntax or syntax.is_compressed or syntax == _DEFLATED:
                continue
            values = math.prod(_image_shape(header)) * (number + 1)
            if header.get("PhotometricInterpretation") == "YBR_FULL_422":
                values = values * 2 // 3  # two pixels share their colour
            needed_bytes = values * int(header.get("BitsAllocated") or 0) // 8
            if file_bytes < needed_bytes:
                raise ValueError(
                    f"{file}: its images take {needed_bytes} bytes, the file has {file_bytes}"
                )
            high_bit, bits = (header.get(name) or 0 for name in ("HighBit", "BitsStored"))
            if high_bit > bits - 1 >= 0:
                raise ValueError(
                    f"{file}: High Bit is {high_bit} of {bits} bits; expected {bits - 1}"
                )

    def read_stored(self, index: Index) -> np.ndarray:
        times, slices, *pixel_index = index
        frame_numbers = np.arange(len(self.frames)).reshape(self.shape[:2])[times, slices]
        data = np.empty((frame_numbers.size, *(s.stop - s.start for s in pixel_index)), self.stored)
        out = iter(data)
        wanted_frames = (self.frames[number] for number in frame_numbers.ravel())
        for file, group in groupby(wanted_frames, key=lambda frame: frame[0]):
            file_frames = list(group)
            images = _decode_images(file, [number for _, number, _, _ in file_frames])
            for (_, _, slope, intercept), image in zip(file_frames, images, strict=True):
                if image.shape != self.shape[2:]:
                    raise ValueError(f"{file}: {image.shape} differs from {self.shape[2:]}")
                pixels = image[tuple(pixel_index)]
                if (slope, intercept) != (1, 0):
                    pixels = pixels * np.float64(slope) + intercept
                next(out)[...] = pixels
        return data.reshape((*frame_numbers.shape, *data.shape[1:]))


def _has_magic(path: str | os.PathLike[str]) -> bool:
    try:
        if not os.path.isfile(path):  # opening a pipe would block
            return False
        with open(path, "rb") as file:
            return file.read(132)[128:] == b"DICM"
    except OSError:
        return False


def _files(folder: str) -> Iterator[str]:
    """Yields the DICOM files in a folder and those below, in order of their names."""
    visited = 0
    for subfolder, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            visited += 1
            if visited > _MAX_FILES:
                raise ValueError(f"{folder}: more than {_MAX_FILES} files")
            file = os.path.join(subfolder, name)
            is_other = name.lower().endswith(_SKIPPED_ENDINGS) or name.upper() == "DICOMDIR"
            if not is_other and _has_magic(file):
                yield file


def _is_dicom(path: str) -> bool:
    if "://" in path or is_zarr(path):
        return False
    if Path(path).is_dir():
        return next(_files(path), None) is not None
    # As in IM0001, 1.2.840.113619.5.
    is_numbered = re.fullmatch(r"|\.\d+", Path(path).suffix) is not None
    return path.lower().endswith(_ENDINGS) or (is_numbered and _has_magic(path))


@Format("DICOM", *_ENDINGS, matches=_is_dicom, options=("key",), library="pydicom")
def open_dicom(path: str, key: str | None = None) -> DicomSource:
    """Opens a series. Of a folder: the only one, or `key` (its number, UID or description). Of a
    file: its frames, if it has several, else the series that it belongs to.
    """
    series: dict[str, list[Any]] = defaultdict(list)
    if Path(path).is_dir():
        for file in _files(path):
            header = _header(file)
            if header.get("Rows") and header.get("Columns"):  # else a report, a plan, ...
                series[str(header.get("SeriesInstanceUID", ""))].append(header)
        headers = _choose_series(path, series, key)
    else:
        headers = [_header(path)]
        if _frame_count(headers[0]) == 1:
            headers += _siblings(path, headers[0])
    by_uid = {str(h.get("SOPInstanceUID", h.filename)): h for h in reversed(headers)}
    return _series_source(path, list(reversed(by_uid.values())))


def _siblings(path: str, first: Any) -> Iterator[Any]:
    """Yields the headers of the other files in the folder that belong to the same series."""
    for entry in sorted(Path(path).absolute().parent.iterdir()):
        if entry.is_file() and not os.path.samefile(entry, path) and _has_magic(entry):
            header = _header(str(entry))
            if header.get("SeriesInstanceUID") == first.get("SeriesInstanceUID") is not None:
                if header.get("Rows"):
                    yield header


def _header(file: str) -> Any:
    """Reads all but the pixels; refuses deflated files that would unpack to far too much."""
    import pydicom

    _check_deflated(file)
    header = pydicom.dcmread(file, stop_before_pixels=True, force=not _has_magic(file))
    header.filename = file
    return header


def _file_meta(file: str) -> Any:
    from pydicom.filereader import read_file_meta_info

    return read_file_meta_info(file) if _has_magic(file) else {}


def _syntax(file: str) -> Any:
    """Returns the transfer syntax of a file; "" if it does not say."""
    return _file_meta(file).get("TransferSyntaxUID", "")


def _check_deflated(file: str) -> None:
    meta = _file_meta(file)
    if meta.get("TransferSyntaxUID") != _DEFLATED:
        return
    size, decompressor = 0, zlib.decompressobj(-zlib.MAX_WBITS)
    with open(file, "rb") as stream:
        stream.seek(144 + int(meta.get("FileMetaInformationGroupLength", 0)))
        while size <= _MAX_UNPACKED_BYTES and (packed := stream.read(1 << 16)):
            while packed and size <= _MAX_UNPACKED_BYTES:
                size += len(decompressor.decompress(packed, 1 << 20))
                packed = decompressor.unconsumed_tail
    if size > _MAX_UNPACKED_BYTES:
        raise ValueError(f"{file}: unpacks to more than {_MAX_UNPACKED_BYTES} bytes")


def _choose_series(path: str, series: dict[str, list[Any]], key: str | None) -> list[Any]:
    if not series:
        raise ValueError(f"{path}: no DICOM file in this folder holds an image")
    if key is None and len(series) == 1:
        return next(iter(series.values()))
    names = {
        uid: [str(header.get("SeriesNumber", uid)), str(header.get("SeriesDescription", "")), uid]
        for uid, (header, *_) in series.items()
    }
    matches = [uid for uid, identifiers in names.items() if key in identifiers]
    if len(matches) == 1:
        return series[matches[0]]
    numbers = [identifiers[0] for identifiers in names.values()]
    listed = [
        f"{identifiers[0] if numbers.count(identifiers[0]) == 1 else uid} "
        f"({identifiers[1] or 'without a name'}, {len(series[uid])} files)"
        for uid, identifiers in names.items()
    ]
    raise not_chosen(path, "series", listed, key)


def _frame_count(header: Any) -> int:
    count = int(header.get("NumberOfFrames") or 1)
    if not 1 <= count <= os.stat(header.filename).st_size:
        raise ValueError(f"{header.filename}: {count} frames in a file that is too short for them")
    return count


def _series_source(path: str, headers: list[Any]) -> DicomSource:
    first = headers[0]
    rows, columns, samples = _image_shape(first)
    frames: list[DicomFrame] = []
    for header in headers:
        count = _frame_count(header)
        check_extent(header.filename, (count, rows, columns), max_values=1 << 40)
        if _image_shape(header) != (rows, columns, samples):
            raise ValueError(
                f"{path}: a series of images of different sizes: {(rows, columns, samples)} and "
                f"{_image_shape(header)} (rows, columns, samples, {Path(header.filename).name})"
            )
        frames += frames_of(header, count)
    times, affine, dropped, time_fields = order_frames(path, frames)
    depth, frames = len(times[0]), list(chain(*times))
    placement = place_axes(path, LPS_TO_RAS @ affine, (depth, rows, columns))
    color = (samples,) if samples > 1 else ()
    placement["axes"] = "t" + placement["axes"] + "c" * len(color)
    info, info_dropped = image_info(first, samples, time_fields)
    if any(frame.position is None for frame in frames):
        info = replace(info, unit=info.unit if first.get("PixelSpacing") else None)
    return DicomSource(
        path=path,
        shape=(len(times), depth, rows, columns, *color),
        stored=_dtype(headers, frames),
        frames=tuple((f.file, f.number, f.slope, f.intercept) for f in frames),
        info=info,
        dropped=(*dropped, *info_dropped),
        **placement,
    )


def _image_shape(header: Any) -> tuple[int, int, int]:
    samples = int(header.get("SamplesPerPixel") or 1)
    return (int(header.get("Rows") or 0), int(header.get("Columns") or 0), samples)


def _dtype(headers: Sequence[Any], frames: Sequence[DicomFrame]) -> str:
    """Returns the smallest dtype that holds every value after rescaling."""
    bits = headers[0].get("BitsAllocated")
    if "BitsStored" not in headers[0] and bits in (32, 64):  # Float or Double Float Pixel Data
        return f"float{bits}"
    ranges, extremes = {_stored_range(header) for header in headers}, list[float]()
    for slope, intercept in {(frame.slope, frame.intercept) for frame in frames}:
        if not (slope.is_integer() and intercept.is_integer()):
            return "float32"
        extremes += [end * slope + intercept for end in chain(*ranges)]
    for dtype in ("uint8", "int8", "int16", "uint16"):
        if np.iinfo(dtype).min <= min(extremes) and max(extremes) <= np.iinfo(dtype).max:
            return dtype
    is_wide = any(high - low >= 2**16 for low, high in ranges)
    return "int32" if max(map(abs, extremes)) < 2**31 and is_wide else "float32"


def _stored_range(header: Any) -> tuple[int, int]:
    """Returns the smallest and the largest value that an image may store."""
    bits, signed = int(header.get("BitsStored") or 0), int(header.get("PixelRepresentation") or 0)
    if not 1 <= bits <= 32:
        raise ValueError(f"{header.filename}: {bits} bits stored; expected 1 to 32")
    return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)


def _decode_images(file: str, numbers: list[int]) -> Iterator[np.ndarray]:
    import pydicom
    from pydicom.pixels import iter_pixels

    syntax = _syntax(file)
    if syntax == _DEFLATED:  # pydicom can only unpack whole files of this kind
        return iter_pixels(pydicom.dcmread(file), indices=numbers)
    return iter_pixels(file, indices=numbers, decoding_plugin=plugin_of(str(syntax)))
