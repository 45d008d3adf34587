"""Decompression that is bounded: of streams, which are read as far as a header says, and of blocks,
which count as damaged if they would unpack to more.
"""

from __future__ import annotations

import bz2
import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

from ..base.messages import need_library

GZIP_MAGIC = b"\x1f\x8b"
_READ_BYTES = 1 << 20
_MAX_BLOCK_BYTES = 1 << 26  # of a Blosc block; VDB writers use blocks of 256 KB
_STORED_FLAG = 2  # Blosc's flag for data that is stored uncompressed


@contextmanager
def open_unpacked(
    file: str, member: str = "", codec: str = "", start: int = 0
) -> Iterator[IO[bytes]]:
    """Opens what a file holds from byte `start` on to read it unpacked, by `codec` ("gzip", "bz2"
    or "zlib") or as its ending says (.gz, .bz2; others are not packed); or a member of a ZIP
    archive.
    """
    if member:
        with zipfile.ZipFile(file) as archive, archive.open(member) as stream:
            yield stream
        return
    codec = codec or {"gz": "gzip", "bz2": "bz2"}.get(file.lower().rpartition(".")[2], "")
    with open(file, "rb") as packed:
        packed.seek(start)
        unpacked: Any = packed
        if codec == "gzip":
            unpacked = gzip.GzipFile(fileobj=packed)
        elif codec == "bz2":
            unpacked = bz2.BZ2File(packed)
        elif codec == "zlib":
            unpacked = io.BufferedReader(ZlibStream(packed))
        yield unpacked


class ZlibStream(io.RawIOBase):
    """What an open file or an answer unpacks to by zlib, or by gzip, from its position on. Raises
    EOFError where it is cut off.
    """

    def __init__(self, packed: io.BufferedIOBase) -> None:
        self._file, self._unpacker = packed, new_unpacker()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        """Unpacks at most as many bytes as the buffer has; returns how many, 0 at the end."""
        part = b""
        while not part and not self._unpacker.eof:
            packed = self._unpacker.unconsumed_tail or self._file.read1(_READ_BYTES)
            if not packed:
                raise EOFError("what is packed is cut off")
            part = self._unpacker.decompress(packed, len(buffer))
        buffer[: len(part)] = part
        return len(part)


def new_unpacker() -> Any:
    """Returns what unpacks a stream of zlib or gzip."""
    return zlib.decompressobj(zlib.MAX_WBITS | 32)


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
            raise ValueError(f"a block of {needed_bytes} bytes expected, {declared[0]} declared")
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
    if magic != b"SIMPLE" and not magic.startswith(GZIP_MAGIC):
        raise ValueError(f"{path}: is not a FITS file")
    return magic != b"SIMPLE"


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
    header = struct.pack("<4I", block, block, 20 + len(packed) - start, 20)
    return unpack_block("blosc", packed[:4] + header + packed[start:], block)
