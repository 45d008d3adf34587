"""`PackedSource`: an array that is packed as a whole (zlib, gzip, bzip2, text), unpacked no further
than its header tells: what would unpack to more is damaged.
"""

from __future__ import annotations

import math
import zlib
from bz2 import BZ2Decompressor
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any, Literal

import numpy as np

from .source import Index, VolumeSource

_READ = 1 << 20  # bytes
_TEXT = 64  # characters of a number, at most


@dataclass(frozen=True, kw_only=True)
class PackedSource(VolumeSource):
    """Numbers in a stretch of a file."""

    file: str
    offset: int
    codec: Literal["zlib", "text", "shares"]  # shares: text that tells parts of 255
    fortran: bool = False
    whole: bool = True

    def read_stored(self, index: Index) -> np.ndarray:
        """Unpacks all, and returns a part."""
        count = math.prod(self.shape)
        if self.codec != "zlib":
            with open(self.file, "rb") as stream:
                stream.seek(self.offset)
                words = stream.read(count * _TEXT).split(maxsplit=count)[:count]
            if len(words) != count:
                raise ValueError(f"{self.path}: {count} numbers expected, got {len(words)}")
            wide = np.dtype(self.stored).kind == "f" or self.codec == "shares"
            data = np.array([float(w) if wide else int(w) for w in words])
            if self.codec == "shares":
                data = np.rint(data * 255).clip(0, 255)
            kind = np.dtype(self.stored)
            if not wide:
                ends = np.iinfo(kind)
                if data.dtype.kind not in "iu" or data.min() < ends.min or data.max() > ends.max:
                    raise ValueError(f"{self.path}: holds numbers that {kind.name} does not")
            data = data.astype(kind)
        else:
            need = count * np.dtype(self.stored).itemsize
            data = np.frombuffer(unpack(self.file, self.offset, need, "zlib"), self.stored)
        return data.reshape(self.shape, order="F" if self.fortran else "C")[index]


def unpack(file: str, offset: int, need: int, codec: str) -> bytes:
    """Unpacks "zlib" (or gzip) or "bz2" data of a file, which must be of `need` bytes, and no
    further than these.
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
    """Parts of at most one byte more than is needed, of one stream after another."""
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
