"""Decompression that is bounded by the size stated in a file's header: data that would unpack to
more counts as damaged. `PackedSource` is an array packed as a whole (zlib, gzip, bzip2, text).
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from bz2 import BZ2Decompressor
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from ..base.messages import need_library
from .source import Index, VolumeSource

_READ_BYTES = 1 << 20
_MAX_BLOCK_BYTES = 1 << 26  # of a Blosc block; VDB writers use blocks of 256 KB
_STORED_FLAG = 2  # Blosc's flag for data that is stored uncompressed


@dataclass(frozen=True, kw_only=True)
class PackedSource(VolumeSource):
    """An array that is compressed as a whole, or written as text, in a file."""

    file: str
    offset: int
    codec: str  # zlib, bz2, text, or shares: text of numbers from 0 to 1, which become 0 to 255
    skip: int = 0  # bytes before the numbers in the unpacked data
    fortran: bool = False
    whole: bool = True

    def read_stored(self, index: Index) -> np.ndarray:
        count = math.prod(self.shape)
        if self.codec in ("text", "shares"):
            are_fractions = self.codec == "shares"
            with open(self.file, "rb") as stream:
                stream.seek(self.offset + self.skip)
                stored = "<f8" if are_fractions else self.stored
                data = text_numbers(self.path, stream, count, stored, exact=False)
            if are_fractions:
                if not np.isfinite(data).all():
                    raise ValueError(f"{self.path}: holds colours that are NaN or infinite")
                data = np.rint(data * 255).clip(0, 255).astype(self.stored)
        else:
            needed_bytes = self.skip + count * np.dtype(self.stored).itemsize
            content = unpack(self.file, self.offset, needed_bytes, self.codec)
            data = np.frombuffer(content, self.stored, count, self.skip)
        return data.reshape(self.shape, order="F" if self.fortran else "C")[index]


def text_numbers(
    path: str, stream: IO[bytes], count: int, stored: str, *, exact: bool
) -> np.ndarray:
    """Reads (count,) numbers of dtype `stored` that are written as text, part by part: as Python
    objects, all of them at once would take twenty times the memory.

    Raises:
        ValueError: There are fewer numbers, or more and `exact` is true; a word is no number, or an
            integer out of the range of `stored`.
    """
    dtype, start = np.dtype(stored), stream.tell()
    is_float = dtype.kind == "f"
    size = stream.seek(0, os.SEEK_END) - start
    stream.seek(start)
    if count > size // 2 + 1:
        raise ValueError(f"{path}: {count} numbers expected, got {size} bytes of text")
    data, done = np.empty(count, dtype), 0
    for tokens in _tokens(stream):
        if exact and len(tokens) > count - done:
            raise ValueError(f"{path}: {count} numbers expected, got more")
        del tokens[count - done :]
        if b"_" in b"".join(tokens):  # which int() and float() would ignore
            raise ValueError(f"{path}: holds words that are not numbers")
        numbers: list[Any] = [float(token) if is_float else int(token) for token in tokens]
        if numbers and not is_float:
            limits = np.iinfo(dtype)
            if min(numbers) < limits.min or max(numbers) > limits.max:
                raise ValueError(f"{path}: holds numbers that {dtype.name} does not")
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite
            data[done : done + len(numbers)] = numbers
        done += len(numbers)
        if done == count and not exact:
            break
    if done < count:
        raise ValueError(f"{path}: {count} numbers expected, got {done}")
    return data


def _tokens(stream: IO[bytes]) -> Iterator[list[bytes]]:
    """Yields the words of a text, one list for each part that is read."""
    text, rest = b" ", b""
    while text:
        text = stream.read(_READ_BYTES)
        tokens = (rest + text).split()
        rest = tokens.pop() if tokens and text and not text[-1:].isspace() else b""
        if len(rest) > _READ_BYTES:
            raise ValueError(f"a word of more than {_READ_BYTES} bytes is not a number")
        yield tokens


def unpack_block(codec: str, packed: Any, needed_bytes: int) -> bytes:
    """Unpacks "zlib", "lzma", "lz4" or "blosc" data in memory, which must yield `needed_bytes`."""
    if not needed_bytes:
        return b""
    if codec == "zlib":
        unpacked = zlib.decompressobj().decompress(packed, needed_bytes + 1)
    elif codec == "lzma":
        import lzma

        unpacked = lzma.LZMADecompressor().decompress(packed, needed_bytes + 1)
    else:
        declared = int.from_bytes(packed[4:8], "little"), int.from_bytes(packed[12:16], "little")
        if codec == "blosc" and (len(packed) < 16 or declared != (needed_bytes, len(packed))):
            raise ValueError(
                f"a block of {needed_bytes} bytes expected, its header declares {declared[0]}"
            )
        codecs = need_library(f"what is packed by {codec}", "imagecodecs")
        unpacked = bytes(getattr(codecs, f"{codec}_decode")(bytes(packed), out=needed_bytes))
    if len(unpacked) != needed_bytes:
        raise ValueError(f"a block of {needed_bytes} bytes expected, {len(unpacked)} found")
    return unpacked


def is_packed_fits(path: str) -> bool:
    """Returns whether a FITS file is packed by gzip, whatever its name says; raises ValueError if
    it is neither gzip nor plain, as astropy unpacks others (ZIP, into a file) without a bound.
    """
    with open(path, "rb") as file:
        magic = file.read(6)
    if magic != b"SIMPLE" and not magic.startswith(b"\x1f\x8b"):
        raise ValueError(f"{path}: is not a FITS file")
    return magic != b"SIMPLE"


def unpack(file: str, offset: int, needed_bytes: int, codec: str) -> bytes:
    """Unpacks "zlib" (or gzip) or "bz2" data of a file, which must yield `needed_bytes`; stops
    at the first byte beyond them.
    """
    parts, size = [], 0
    with open(file, "rb") as stream:
        stream.seek(offset)
        for part in _unpacked_parts(stream, codec, needed_bytes):
            parts.append(part)
            size += len(part)
    if size != needed_bytes:
        raise ValueError(
            f"{file}: {needed_bytes} bytes expected, "
            f"{'more' if size > needed_bytes else size} found"
        )
    return b"".join(parts)


def _unpacked_parts(stream: IO[bytes], codec: str, needed_bytes: int) -> Iterator[bytes]:
    """Yields the content of consecutive streams in parts, at most `needed_bytes` + 1 in all."""
    size, packed = 0, b""
    unpacker: Any = None
    while size <= needed_bytes:
        if unpacker is None or unpacker.eof:  # gzip and bzip2 files may hold several streams
            packed = (unpacker.unused_data if unpacker else b"") or stream.read(_READ_BYTES)
            if not packed or (unpacker and not packed.startswith((b"\x1f\x8b", b"BZh"))):
                return
            unpacker = (
                zlib.decompressobj(zlib.MAX_WBITS | 32) if codec == "zlib" else BZ2Decompressor()
            )
        elif codec == "zlib":
            packed = unpacker.unconsumed_tail or stream.read(_READ_BYTES)
        else:
            packed = stream.read(_READ_BYTES) if unpacker.needs_input else b""
        if not packed and (codec == "zlib" or unpacker.needs_input):
            return
        part = unpacker.decompress(packed, needed_bytes + 1 - size)
        size += len(part)
        yield part


def blosc_begin(packed: bytes, count: int) -> bytes:
    """Returns at least the first `count` bytes of Blosc data, or all if it has fewer, by unpacking
    its first block alone, with a header of its own. (Layout: README_CHUNK_FORMAT of c-blosc 1.)
    """
    size, block = struct.unpack_from("<2I", packed, 4)
    count = min(count, size)
    if packed[2] & _STORED_FLAG:
        return packed[16 : 16 + count]
    block = min(block, size)
    (start,) = struct.unpack_from("<I", packed, 16)
    if not count <= block <= _MAX_BLOCK_BYTES or not 20 <= start < len(packed):
        raise ValueError(
            f"a packed part begins with a block of {block} bytes at byte {start}; expected {count} "
            f"to {_MAX_BLOCK_BYTES} bytes, within {len(packed)}"
        )
    header = struct.pack("<3I", block, block, 20 + len(packed) - start)
    return unpack_block(
        "blosc", packed[:4] + header + struct.pack("<I", 20) + packed[start:], block
    )
