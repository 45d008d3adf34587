"""`read_image`: reads PNG, TIFF, EXR and NumPy files as linear light; files.py writes them.

The size in a header is compared with the file and with free memory before anything is unpacked: the
libraries allocate that memory, and one of them ends the process if it is not available.
Source: ISO/IEC 15948 (PNG), IHDR; OpenEXR file layout (attributes, box2i, chlist).
"""

from __future__ import annotations

import io
import math
import os
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..base.boxes import paste
from ..base.messages import need_library
from ..io.budget import MAX_UNPACK_RATIO, check_regular, header_budget
from ..io.picture_size import picture_size
from ..io.resources import amount, memory_free
from ..io.source import convert_errors
from ..io.tiff_info import JPEG, check_pictures, opened_tiff
from .tone import from_srgb

_ASSOCIATED_ALPHA = 1  # as an extra sample of TIFF: colours are premultiplied, as Blender writes
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_MAX_HEADER_BYTES = 1 << 20  # bytes
_LOCK = threading.Lock()
_MAX_CHANNELS = 6  # numbers a pixel, as `Picture.save` writes to .npy; more are no picture
_COPIES = 6  # of 8 bytes a number: the pixels read, and the steps to linear light


def read_image(path: str | Path) -> Tensor:
    """Reads a PNG (8 or 16 bits, sRGB), EXR, TIFF or NPY as linear light.

    Returns:
        (h, w, c) float32; c is 3, or 4 with alpha. Integers, as in PNG, are decoded as sRGB with
        straight alpha; floats stay as they are in the file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The ending is unknown, the file holds something else, or its pixels take more
            memory than is free or than its bytes can unpack to.
        ImportError: The library for this kind of file is missing.
    """
    path = Path(path)
    if path.suffix not in _READERS:
        raise ValueError(f"read_image: path must end in {', '.join(_READERS)}, got {str(path)!r}")
    if not path.exists():
        raise FileNotFoundError(f"image not found: {path}")
    with convert_errors(ValueError, str(path), "can't be read"):
        check_regular(path)
        with header_budget(str(path)):
            pixels = _READERS[path.suffix](path)
    is_picture = pixels.ndim == 3 and 3 <= pixels.shape[-1] <= _MAX_CHANNELS and pixels.size
    if not is_picture or pixels.dtype.kind not in "uf":
        raise ValueError(f"{path}: must hold (h, w, 3) numbers, got {pixels.shape} {pixels.dtype}")
    pixels = pixels[..., :4]
    if pixels.dtype.kind == "f":
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite
            return torch.from_numpy(pixels.astype(np.float32))
    image = torch.from_numpy(pixels.astype(np.float64) / np.iinfo(pixels.dtype).max)
    return torch.cat((from_srgb(image[..., :3]), image[..., 3:]), -1).float()


def _check_size(path: Path, shape: tuple[int, ...], itemsize: int, max_bytes: int = 0) -> None:
    """Raises ValueError if the numbers do not fit into free memory, or exceed `max_bytes`, the most
    bytes that the file can unpack to (0: not checked).
    """
    count = math.prod(shape)
    if count < 1 or (max_bytes and count * itemsize > max_bytes):
        size = path.stat().st_size
        raise ValueError(f"declares {shape} numbers, which {size} bytes can't unpack to")
    if 8 * _COPIES * count > (free := memory_free()):
        needed = amount(8 * _COPIES * count)
        raise ValueError(f"{shape} numbers take {needed} of memory, {amount(free)} are free")


def _read_png(path: Path) -> np.ndarray:
    from kornia_rs.io import read_image_png_u8, read_image_png_u16

    with path.open("rb") as file:
        header = file.read(26)
    size = picture_size(header)
    if len(header) < 26 or header[:8] != b"\x89PNG\r\n\x1a\n" or size is None:
        raise ValueError("no PNG")
    bits, color_type = header[24], header[25]  # of the IHDR chunk
    modes = {0: ("mono", 1), 2: ("rgb", 3), 6: ("rgba", 4)}
    if bits not in (8, 16) or color_type not in modes:
        raise ValueError("a PNG must have 8 or 16 bits and no palette")
    mode, channels = modes[color_type]
    _check_size(path, (*size[::-1], channels), bits // 8, MAX_UNPACK_RATIO * path.stat().st_size)
    read = read_image_png_u8 if bits == 8 else read_image_png_u16
    pixels = read(str(path), mode)
    return np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, -1) if color_type == 0 else pixels


def _read_exr(path: Path) -> np.ndarray:
    library = need_library(".exr", "OpenEXR", extra="image")
    data, display = _exr_windows(path)
    with _quiet():
        parts = library.File(str(path), separate_channels=True).parts
    if not parts:
        raise ValueError("damaged: its pixels can't be read")
    channels = parts[0].channels
    names = "RGBA" if "A" in channels else "RGB"
    missing = [name for name in names if name not in channels]
    if missing:
        listed = ", ".join(map(repr, channels))
        raise ValueError(f"has no channel {missing[0]!r}; it has {listed}")
    pixels = np.stack([channels[name].pixels for name in names], -1)
    if data == display:
        return pixels
    top, left, bottom, right = display
    picture = np.zeros((bottom - top, right - left, len(names)), pixels.dtype)
    paste(picture, (top, left), pixels, data[:2])
    return picture


@contextmanager
def _quiet() -> Iterator[None]:
    """Silences both streams: OpenEXR prints there what is wrong with a file, and raises it too."""
    with _LOCK, redirect_stdout(io.StringIO()), ExitStack() as stack:
        with suppress(OSError):  # there is no standard error
            saved_stderr = os.dup(2)
            stack.callback(os.close, saved_stderr)
            null = os.open(os.devnull, os.O_WRONLY)
            stack.callback(os.close, null)
            os.dup2(null, 2)
            stack.callback(os.dup2, saved_stderr, 2)
        yield


def _exr_windows(path: Path) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Returns top, left, bottom, right of the pixels that a file holds, and of the picture, which
    may be another part of the plane. Raises ValueError if the header declares several parts, which
    are not supported, or more pixels than the file can hold: a file has an offset for at least
    every 256 lines, and OpenEXR allocates memory for all lines.
    """
    with path.open("rb") as file:
        header = file.read(_MAX_HEADER_BYTES)
    if header[:4] != _EXR_MAGIC or len(header) < 8:
        raise ValueError("no EXR")
    if header[5] & 0x18:
        raise ValueError("has several parts or deep pixels; expected one picture")
    attributes = dict(_attributes(header))
    if "dataWindow" not in attributes or "channels" not in attributes:
        raise ValueError("damaged: its header has no extent or no channels")
    count, size = sum(1 for _ in _channels(attributes["channels"])), path.stat().st_size
    windows, max_bytes = [], MAX_UNPACK_RATIO * size * 4
    for name in ("dataWindow", "displayWindow"):
        window = attributes.get(name, attributes["dataWindow"])
        left, top, right, bottom = struct.unpack("<4i", window)
        shape = (bottom - top + 1, right - left + 1, count)
        if min(shape) < 1 or (max_bytes and shape[0] // 256 * 8 > size):
            raise ValueError(f"damaged: declares {shape} numbers in {size} bytes")
        _check_size(path, shape, 1, max_bytes)
        windows.append((top, left, bottom + 1, right + 1))
        max_bytes = 0  # of the picture the file holds a part
    return windows[0], windows[1]


def _attributes(header: bytes) -> Iterator[tuple[str, bytes]]:
    """Yields names and values of an EXR header's attributes."""
    offset = 8
    while header[offset : offset + 1] not in (b"", b"\0"):
        name = header[offset : header.index(b"\0", offset)]
        offset += len(name) + 1
        offset = header.index(b"\0", offset) + 1  # its type
        (size,) = struct.unpack_from("<i", header, offset)
        if not 0 <= size <= len(header) - offset - 4:
            raise ValueError(f"damaged: an attribute of {size} bytes")
        yield name.decode("latin-1"), header[offset + 4 : offset + 4 + size]
        offset += 4 + size


def _channels(channel_list: bytes) -> Iterator[str]:
    """Yields the names of an EXR's channels; 16 bytes follow each name."""
    offset = 0
    while channel_list[offset : offset + 1] not in (b"", b"\0"):
        end = channel_list.index(b"\0", offset)
        yield channel_list[offset:end].decode("latin-1")
        offset = end + 17


def _read_npy(path: Path) -> np.ndarray:
    """Maps the file: one that is shorter than its header says is refused before memory is used."""
    mapped = np.lib.format.open_memmap(path, mode="r")
    _check_size(path, mapped.shape, mapped.itemsize)
    return mapped


def _read_tiff(path: Path) -> np.ndarray:
    need_library(".tif", "tifffile", extra="image")
    with opened_tiff(str(path)) as (file, _):
        series = file.series[0]
        max_bytes = MAX_UNPACK_RATIO * path.stat().st_size
        _check_size(path, tuple(series.shape), series.dtype.itemsize, max_bytes)
        check_pictures(series.pages)
        photometric, compression = series.keyframe.photometric, series.keyframe.compression
        if photometric not in (1, 2) and (photometric != 6 or compression not in JPEG):
            kind = getattr(photometric, "name", photometric)  # tifffile decodes YCbCr of JPEG only
            raise ValueError(f"its colours must be RGB, got {kind}")
        pixels = series.asarray()
        if "S" in series.axes:
            pixels = np.moveaxis(pixels, series.axes.index("S"), -1)
        if pixels.dtype.kind == "u" and series.pages[0].extrasamples[:1] == (_ASSOCIATED_ALPHA,):
            largest, alpha = np.iinfo(pixels.dtype).max, pixels[..., 3:4].astype(np.float64)
            straight = pixels[..., :3] * (largest / np.maximum(alpha, 1))
            straight = straight.clip(max=largest).round().astype(pixels.dtype)
            return np.concatenate((straight, pixels[..., 3:4]), -1)
        return pixels


_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": _read_png,
    ".exr": _read_exr,
    ".npy": _read_npy,
    ".tif": _read_tiff,
}
