"""`PackedSource`: an array that is packed as a whole (zlib, gzip, bzip2, text), unpacked no further
than its header tells: what would unpack to more is damaged.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Literal

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
            data = data.astype(self.stored)
        else:
            need = count * np.dtype(self.stored).itemsize
            data = np.frombuffer(unpack_zlib(self.file, self.offset, need), self.stored)
        return data.reshape(self.shape, order="F" if self.fortran else "C")[index]


def unpack_zlib(file: str, offset: int, need: int) -> bytes:
    """Unpacks zlib or gzip data of a file, which must be of `need` bytes."""
    engine, parts, size = zlib.decompressobj(zlib.MAX_WBITS | 32), [], 0
    with open(file, "rb") as stream:
        stream.seek(offset)
        while size <= need and (packed := engine.unconsumed_tail or stream.read(_READ)):
            parts.append(engine.decompress(packed, need + 1 - size or 1))
            size += len(parts[-1])
            if engine.eof:
                break
    if size != need:
        raise ValueError(f"{file}: {need} bytes expected, {'more' if size > need else size} found")
    return b"".join(parts)
