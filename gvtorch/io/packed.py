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

_READ = 1 << 20  # bytes
_MOST_BLOCK = 1 << 26  # bytes of a Blosc block; VDB writers use blocks of 256 KB
_STORED = 2  # Blosc's flag for data that is stored uncompressed


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
            shares = self.codec == "shares"
            with open(self.file, "rb") as stream:
                stream.seek(self.offset + self.skip)
                stored = "<f8" if shares else self.stored
                data = text_numbers(self.path, stream, count, stored, exact=False)
            if shares:
                if not np.isfinite(data).all():
                    raise ValueError(f"{self.path}: holds colours that are NaN or infinite")
                data = np.rint(data * 255).clip(0, 255).astype(self.stored)
        else:
            need = self.skip + count * np.dtype(self.stored).itemsize
            content = unpack(self.file, self.offset, need, self.codec)
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
    kind, at = np.dtype(stored), stream.tell()
    wide = kind.kind == "f"
    size = stream.seek(0, os.SEEK_END) - at
    stream.seek(at)
    if count > size // 2 + 1:
        raise ValueError(f"{path}: {count} numbers expected, got {size} bytes of text")
    data, done = np.empty(count, kind), 0
    for words in _words(stream):
        if exact and len(words) > count - done:
            raise ValueError(f"{path}: {count} numbers expected, got more")
        del words[count - done :]
        if b"_" in b"".join(words):  # which int() and float() would ignore
            raise ValueError(f"{path}: holds words that are not numbers")
        numbers: list[Any] = [float(word) if wide else int(word) for word in words]
        if numbers and not wide:
            ends = np.iinfo(kind)
            if min(numbers) < ends.min or max(numbers) > ends.max:
                raise ValueError(f"{path}: holds numbers that {kind.name} does not")
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite
            data[done : done + len(numbers)] = numbers
        done += len(numbers)
        if done == count and not exact:
            break
    if done < count:
        raise ValueError(f"{path}: {count} numbers expected, got {done}")
    return data


def _words(stream: IO[bytes]) -> Iterator[list[bytes]]:
    """Yields the words of a text, one list for each part that is read."""
    text, rest = b" ", b""
    while text:
        text = stream.read(_READ)
        words = (rest + text).split()
        rest = words.pop() if words and text and not text[-1:].isspace() else b""
        if len(rest) > _READ:
            raise ValueError(f"a word of more than {_READ} bytes is not a number")
        yield words


def unpack_block(codec: str, packed: Any, need: int) -> bytes:
    """Unpacks "zlib", "lzma", "lz4" or "blosc" data in memory, which must yield `need` bytes."""
    if not need:
        return b""
    if codec == "zlib":
        found = zlib.decompressobj().decompress(packed, need + 1)
    elif codec == "lzma":
        import lzma

        found = lzma.LZMADecompressor().decompress(packed, need + 1)
    else:
        told = int.from_bytes(packed[4:8], "little"), int.from_bytes(packed[12:16], "little")
        if codec == "blosc" and (len(packed) < 16 or told != (need, len(packed))):
            raise ValueError(f"a block of {need} bytes expected, its header declares {told[0]}")
        codecs = need_library(f"what is packed by {codec}", "imagecodecs")
        found = bytes(getattr(codecs, f"{codec}_decode")(bytes(packed), out=need))
    if len(found) != need:
        raise ValueError(f"a block of {need} bytes expected, {len(found)} found")
    return found


def is_packed_fits(path: str) -> bool:
    """Returns whether a FITS file is packed by gzip, whatever its name says; raises ValueError if
    it is neither gzip nor plain, as astropy unpacks others (ZIP, into a file) without a bound.
    """
    with open(path, "rb") as file:
        begin = file.read(6)
    if begin != b"SIMPLE" and not begin.startswith(b"\x1f\x8b"):
        raise ValueError(f"{path}: is not a FITS file")
    return begin != b"SIMPLE"


def unpack(file: str, offset: int, need: int, codec: str) -> bytes:
    """Unpacks "zlib" (or gzip) or "bz2" data of a file, which must yield `need` bytes; stops at the
    first byte beyond them.
    """
    parts, size = [], 0
    with open(file, "rb") as stream:
        stream.seek(offset)
        for part in _unpacked(stream, codec, need):
            parts.append(part)
            size += len(part)
    if size != need:
        raise ValueError(f"{file}: {need} bytes expected, {'more' if size > need else size} found")
    return b"".join(parts)


def _unpacked(stream: IO[bytes], codec: str, need: int) -> Iterator[bytes]:
    """Yields the content of consecutive streams in parts, at most `need` + 1 bytes in all."""
    size, packed = 0, b""
    engine: Any = None
    while size <= need:
        if engine is None or engine.eof:  # gzip and bzip2 files may hold several streams
            packed = (engine.unused_data if engine else b"") or stream.read(_READ)
            if not packed or (engine and not packed.startswith((b"\x1f\x8b", b"BZh"))):
                return
            engine = (
                zlib.decompressobj(zlib.MAX_WBITS | 32) if codec == "zlib" else BZ2Decompressor()
            )
        elif codec == "zlib":
            packed = engine.unconsumed_tail or stream.read(_READ)
        else:
            packed = stream.read(_READ) if engine.needs_input else b""
        if not packed and (codec == "zlib" or engine.needs_input):
            return
        part = engine.decompress(packed, need + 1 - size)
        size += len(part)
        yield part


def blosc_begin(packed: bytes, most: int) -> bytes:
    """Returns at least the first `most` bytes of Blosc data, or all if it has fewer, by unpacking
    its first block alone, with a header of its own. (Layout: README_CHUNK_FORMAT of c-blosc 1.)
    """
    size, block = struct.unpack_from("<2I", packed, 4)
    most = min(most, size)
    if packed[2] & _STORED:
        return packed[16 : 16 + most]
    block = min(block, size)
    (start,) = struct.unpack_from("<I", packed, 16)
    if not most <= block <= _MOST_BLOCK or not 20 <= start < len(packed):
        raise ValueError(
            f"a packed part begins with a block of {block} bytes at byte {start}; expected {most} "
            f"to {_MOST_BLOCK} bytes, within {len(packed)}"
        )
    head = struct.pack("<3I", block, block, 20 + len(packed) - start)
    return unpack_block("blosc", packed[:4] + head + struct.pack("<I", 20) + packed[start:], block)
