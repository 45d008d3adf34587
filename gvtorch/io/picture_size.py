"""`picture_size`: the size of a compressed image, read from its header before it is decoded.

Source: ISO/IEC 10918-1 (JPEG), markers SOF; 15444-1 (JPEG 2000), SIZ and boxes; 15948 (PNG), IHDR;
29199-2 (JPEG XR), annex A and IMAGE_HEADER; 18181 (JPEG XL), SizeHeader; RFC 9649 (WebP); Esri's
LERC, structs HeaderInfo of Lerc2 and CntZImage.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

_JPEG_FRAMES = {*range(0xC0, 0xD0), 0xF7} - {0xC4, 0xC8, 0xCC}  # of JPEG and of JPEG-LS
_JPEG_SCAN = 0xDA
_BARE_MARKERS = {0x01, *range(0xD0, 0xD9)}  # markers without a length
_RATIOS = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))  # of JPEG XL
_MAX_LAYERS = 64  # values per pixel of LERC
_SIDE_BITS = (9, 13, 18, 30)  # bits of a side of JPEG XL
_JXL_HEADER_BYTES = 32  # more than the fields that are read take


def picture_size(packed: bytes) -> tuple[int, int] | None:
    """Returns (columns, rows) of a PNG, WebP, JPEG, JPEG-LS, JPEG 2000, JPEG XR, JPEG XL or LERC
    image; None for any other header, and for animations.
    """
    for signature, reader in _READERS.items():
        if packed.startswith(signature):
            try:
                return reader(packed)
            except struct.error:
                return None
    size = jpeg_size(packed) or jpeg2k_size(packed)
    return None if size is None else size[:2]


def _jpeg_segments(packed: bytes) -> Iterator[tuple[int, int]]:
    """Yields marker and offset of each segment of a JPEG image, up to the first scan or to what is
    no segment, whose marker is then 0.
    """
    position = 2
    while packed[:2] == b"\xff\xd8" and position + 1 < len(packed) and packed[position] == 0xFF:
        marker, length = packed[position + 1], int.from_bytes(packed[position + 2 : position + 4])
        if marker != 0xFF:  # a fill byte
            yield marker, position
        if marker == _JPEG_SCAN:
            return
        position += 1 if marker == 0xFF else 2 if marker in _BARE_MARKERS else 2 + length
    yield 0, position


def jpeg_size(packed: bytes) -> tuple[int, int, int] | None:
    """Returns (columns, rows, samples) from the header of a JPEG or JPEG-LS image; None if it has
    no frame header, or several.
    """
    frames = [position for marker, position in _jpeg_segments(packed) if marker in _JPEG_FRAMES]
    if len(frames) != 1 or frames[0] + 10 > len(packed):
        return None
    rows, columns, samples = struct.unpack_from(">HHB", packed, frames[0] + 5)
    return (columns, rows, samples)


def has_jpeg_end(packed: bytes) -> bool:
    """Returns whether a JPEG has an end marker after the start of its first scan; if not, libraries
    make the missing part grey. The two bytes of that marker can't occur in a scan's data.
    """
    *_, (_, position) = _jpeg_segments(packed)
    return packed.find(b"\xff\xd9", position) >= 0


def jpeg2k_size(packed: bytes) -> tuple[int, int, int] | None:
    """Returns (columns, rows, samples) from the header of a JPEG 2000 codestream, or of the first
    codestream in a file of boxes (JP2).
    """
    start = 0
    if packed[4:8] == b"jP  ":
        start = next((start for start, _, kind in _boxes(packed) if kind == b"jp2c"), len(packed))
    if packed[start : start + 4] != b"\xff\x4f\xff\x51" or len(packed) < start + 42:
        return None
    right, bottom, left, top = struct.unpack_from(">4I", packed, start + 8)
    return (right - left, bottom - top, int.from_bytes(packed[start + 40 : start + 42]))


def _boxes(packed: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yields where the content of each box begins and ends, and its kind."""
    start = 0
    while start + 8 <= len(packed):
        size, header_bytes = int.from_bytes(packed[start : start + 4]), 8
        if size == 1:
            size, header_bytes = int.from_bytes(packed[start + 8 : start + 16]), 16
        # A size of 0: to the end of the file.
        end = start + size if size >= header_bytes else len(packed)
        yield start + header_bytes, end, packed[start + 4 : start + 8]
        if size < header_bytes:
            return
        start += size


def _png_size(packed: bytes) -> tuple[int, int] | None:
    columns, rows = struct.unpack_from(">II", packed, 16)
    return columns, rows


def _webp_size(packed: bytes) -> tuple[int, int] | None:
    kind = packed[8:16]
    if kind == b"WEBPVP8 ":
        columns, rows = struct.unpack_from("<HH", packed, 26)
        return columns & 0x3FFF, rows & 0x3FFF
    if kind == b"WEBPVP8L":
        (bits,) = struct.unpack_from("<I", packed, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"WEBPVP8X" and len(packed) >= 30 and not packed[20] & 2:
        columns, rows = packed[24:27], packed[27:30]
        return int.from_bytes(columns, "little") + 1, int.from_bytes(rows, "little") + 1
    return None


def _lerc_size(packed: bytes) -> tuple[int, int] | None:
    if packed[:1] == b"C":
        rows, columns = struct.unpack_from("<II", packed, 18)
        return columns, rows
    (version,) = struct.unpack_from("<i", packed, 6)
    rows, columns, layers = struct.unpack_from("<III", packed, 14 if version >= 3 else 10)
    return (columns, rows) if version < 4 or layers <= _MAX_LAYERS else None


def _jpegxr_size(packed: bytes) -> tuple[int, int] | None:
    """Returns the size from the codestream that the container points to."""
    (directory,) = struct.unpack_from("<I", packed, 4)
    (count,) = struct.unpack_from("<H", packed, directory)
    tags = (struct.unpack_from("<HHII", packed, directory + 2 + 12 * n) for n in range(count))
    start = next((value for tag, _, _, value in tags if tag == 0xBCC0), len(packed))
    if packed[start : start + 8] != b"WMPHOTO\0":
        return None
    (flags,) = struct.unpack_from("<B", packed, start + 10)
    columns, rows = struct.unpack_from(">HH" if flags & 0x80 else ">II", packed, start + 12)
    return columns + 1, rows + 1


def _jpegxl_size(packed: bytes) -> tuple[int, int] | None:
    """Returns (columns, rows); None for animations, and for images with a preview before them."""
    if packed[4:8] == b"JXL ":  # the codestream: whole (jxlc), or in parts after a number (jxlp)
        skipped = {b"jxlc": 0, b"jxlp": 4}
        boxes = ((a + skipped[k], b) for a, b, k in _boxes(packed) if k in skipped)
        packed = b"".join(packed[start:end] for start, end in boxes)[:_JXL_HEADER_BYTES]
    if packed[:2] != b"\xff\x0a" or len(packed) < 14:
        return None
    bits = int.from_bytes(packed[2:_JXL_HEADER_BYTES], "little")

    def take(count: int) -> int:
        nonlocal bits
        value, bits = bits & ((1 << count) - 1), bits >> count
        return value

    def size() -> tuple[int, int]:
        small = take(1)
        rows = 8 * (take(5) + 1) if small else take(_SIDE_BITS[take(2)]) + 1
        if ratio := take(3):
            return rows * _RATIOS[ratio - 1][0] // _RATIOS[ratio - 1][1], rows
        return 8 * (take(5) + 1) if small else take(_SIDE_BITS[take(2)]) + 1, rows

    dimensions = size()
    if not take(1) and take(1):  # all_default is unset, extra_fields is set
        take(3)  # orientation
        if take(1):
            size()  # intrinsic size
        if take(2):  # a preview, an animation
            return None
    return dimensions


_READERS: dict[bytes, Callable[[bytes], tuple[int, int] | None]] = {
    b"\x89PNG\r\n\x1a\n": _png_size,
    b"RIFF": _webp_size,
    b"II\xbc": _jpegxr_size,
    b"Lerc2 ": _lerc_size,
    b"CntZImage ": _lerc_size,
    b"\xff\x0a": _jpegxl_size,
    b"\0\0\0\x0cJXL ": _jpegxl_size,
}
