"""Image files: writes the layers of a picture as PNG, TIFF, EXR and NumPy; reading: read_files.py.

PNG and integer TIFF hold sRGB and, where there is alpha, straight colour (PNG specification,
section 12.3); EXR, NumPy and float TIFF hold linear light, premultiplied (OpenEXR technical
introduction).
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.messages import need_library, one_line
from ..base.whole_file import save_npy, whole_file
from .tone import finite, to_srgb

if TYPE_CHECKING:
    Layers = dict[str, np.ndarray]  # color (h, w, 3), alpha, depth, samples (h, w, 1)

_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_BITS = {".png": (8, 16), ".tif": (8, 16, 32), ".exr": (32, 16), ".npy": (32,), ".npz": (32,)}


def checked_path(
    context: str, path: Path, bits: int | None = None, suffixes: tuple[str, ...] = tuple(_BITS)
) -> int:
    """Returns the bits per number of a file to be written; raises ValueError if its ending is not
    one of `suffixes` or does not allow `bits`, FileNotFoundError if there is no such folder.
    """
    if path.suffix not in suffixes:
        expected = check.either(suffixes)
        raise ValueError(f"{context}: path must end in {expected}, got {str(path)!r}")
    allowed_bits = _BITS[path.suffix]
    if bits is not None and bits not in allowed_bits:
        choices = check.either(map(str, allowed_bits))
        raise ValueError(f"{context}: {path.suffix} has {choices} bits, got {bits!r}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{context}: folder not found: {path.parent}")
    return allowed_bits[0] if bits is None else bits


def write_image(path: Path, layers: Layers, *, transparent: bool, bits: int | None = None) -> None:
    """Writes a picture's layers; see `Picture.save`."""
    bits = checked_path("save", path, bits)
    with whole_file(path) as part:
        if path.suffix == ".npz":
            np.savez(part, **layers)  # type: ignore[arg-type]
        elif path.suffix == ".npy":
            save_npy(part, stacked(layers))
        elif path.suffix == ".exr":
            _write_exr(part, side_by_side(layers), bits)
        else:
            image = file_pixels(side_by_side(layers), transparent, bits)
            if path.suffix == ".tif":
                write_tiff(part, image.shape, image.dtype, [image], len(image))
            else:
                _write_png(part, np.ascontiguousarray(image))


@contextmanager
def _as_os_errors() -> Iterator[None]:
    """Raises OSError for whatever a library raises when it can't write."""
    try:
        yield
    except (OSError, MemoryError):
        raise
    except Exception as error:
        text = one_line(error)
        code = errno.ENOSPC if "No space left" in text else errno.EIO
        raise OSError(code, text) from None


def side_by_side(layers: Layers) -> Layers:
    """Joins the pictures of a batch to one, side by side."""
    return {n: np.concatenate(x, 1) if x.ndim == 4 else x for n, x in layers.items()}


def stacked(layers: Layers) -> np.ndarray:
    """Returns color, alpha, depth and samples as one array (..., 6) float32."""
    names = ("color", "alpha", "depth", "samples")
    return np.concatenate([layers[name].astype(np.float32) for name in names], -1)


def display_pixels(color: Tensor, alpha: Tensor | None, bits: int) -> np.ndarray:
    """Encodes linear RGB (..., 3) as sRGB (..., 3), uint8 or uint16. With alpha (..., 1) the input
    is premultiplied, and the result is straight colour and alpha (..., 4).
    """
    color = color.detach().to("cpu", torch.float32 if bits == 8 else torch.float64)
    if alpha is None:
        channels = to_srgb(color)
    else:
        alpha = finite(alpha.detach().to(color)).clamp(max=1)
        straight = torch.where(alpha > 0, color / alpha, 0.0)
        channels = torch.cat((to_srgb(straight), alpha), -1)
    scaled = (channels * (2**bits - 1)).round()
    return scaled.contiguous().numpy().astype(np.uint8 if bits == 8 else np.uint16)


def file_pixels(layers: Layers, transparent: bool, bits: int) -> np.ndarray:
    """Returns what a TIFF or PNG holds: (h, w, 3), or (h, w, 4) if transparent."""
    color, alpha = (torch.from_numpy(layers[name]) for name in ("color", "alpha"))
    if bits == 32:
        return torch.cat((color, alpha) if transparent else (color,), -1).numpy()
    return display_pixels(color, alpha if transparent else None, bits)


def _write_png(path: Path, image: np.ndarray) -> None:
    """Writes (h, w, 3) or (h, w, 4) at once, faster than row by row."""
    from kornia_rs.io import write_image_png_u8, write_image_png_u16

    write = write_image_png_u8 if image.dtype == np.uint8 else write_image_png_u16
    with _as_os_errors():
        write(str(path), image, "rgba" if image.shape[2] == 4 else "rgb")
    with path.open("rb") as file:  # it does not report that the last bytes did not fit
        file.seek(-min(len(_PNG_END), path.stat().st_size), os.SEEK_END)
        if file.read() != _PNG_END:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def write_png_rows(
    path: Path, shape: tuple[int, ...], bits: int, strips: Iterable[np.ndarray]
) -> None:
    """Writes a PNG (h, w, c), c 3, or 4 with alpha, strip by strip, (rows, w, c) uint8 or uint16.
    Each row gets the filter (None, Sub or Up) with the smallest sum of absolute values.
    """
    height, width, channels = shape
    pixel_bytes = channels * bits // 8  # bytes from pixel to pixel
    compressor = zlib.compressobj(6)
    row_above = np.zeros((1, width * pixel_bytes), np.uint8)
    with path.open("wb") as file:

        def chunk(kind: bytes, content: bytes) -> None:
            size, checksum = len(content), zlib.crc32(kind + content)
            file.write(struct.pack(">I", size) + kind + content + struct.pack(">I", checksum))

        file.write(b"\x89PNG\r\n\x1a\n")
        color_type = {3: 2, 4: 6}[channels]
        chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0))
        for strip in strips:
            rows = strip.astype(f">u{bits // 8}").reshape(len(strip), -1).view(np.uint8)
            left_difference = rows.copy()
            left_difference[:, pixel_bytes:] -= rows[:, :-pixel_bytes]
            up_difference = rows - np.concatenate((row_above, rows[:-1]))
            filtered = np.stack((rows, left_difference, up_difference))
            row_above = rows[-1:]
            sizes = np.abs(filtered.view(np.int8).astype(np.int16)).sum(2, dtype=np.int64)
            best_filter = sizes.argmin(0)
            best_rows = filtered[best_filter, np.arange(len(rows))]
            lines = np.column_stack((best_filter.astype(np.uint8), best_rows))
            if compressed := compressor.compress(lines.tobytes()):
                chunk(b"IDAT", compressed)
        chunk(b"IDAT", compressor.flush())
        chunk(b"IEND", b"")


def write_tiff(
    path: Path,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    strips: Iterable[np.ndarray],
    rows: int,
) -> None:
    """Writes a BigTIFF in strips of `rows` rows, the last perhaps fewer; see `write_png_rows`."""
    tifffile = need_library(".tif", "tifffile", extra="image")
    alpha_kind = "assocalpha" if dtype.kind == "f" else "unassalpha"
    with tifffile.TiffWriter(path, bigtiff=True) as file:
        file.write(
            (zlib.compress(strip.tobytes()) for strip in strips),
            shape=shape,
            dtype=dtype,
            rowsperstrip=rows,
            photometric="rgb",
            extrasamples=[alpha_kind] if shape[-1] == 4 else None,
            compression="zlib",
            metadata=None,
        )


def _write_exr(path: Path, layers: Layers, bits: int) -> None:
    OpenEXR = need_library(".exr", "OpenEXR", extra="image")
    dtype = np.float16 if bits == 16 else np.float32
    rgba = np.concatenate((layers["color"], layers["alpha"]), -1)
    if bits == 16:
        rgba = np.clip(rgba, -65504, 65504)  # the largest half
    channels = {name: rgba[..., index].astype(dtype, "C") for index, name in enumerate("RGBA")}
    channels["Z"] = np.ascontiguousarray(layers["depth"][..., 0])
    channels["samples"] = layers["samples"][..., 0].astype(np.uint32, "C")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with _as_os_errors():
        OpenEXR.File(header, channels).write(str(path))
