"""`TextSource`: an array that is written as text in a file; `text_numbers` reads such numbers."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from .source import Index, VolumeSource

_READ_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class TextSource(VolumeSource):
    """An array that is written as text, from a byte of a file on."""

    file: str
    offset: int
    fractions: bool = False  # the text's numbers from 0 to 1 become 0 to 255
    fortran: bool = False  # first axis fastest
    whole: bool = True

    def read_stored(self, index: Index) -> np.ndarray:
        count = math.prod(self.shape)
        with open(self.file, "rb") as stream:
            stream.seek(self.offset)
            stored = "<f8" if self.fractions else self.stored
            data = text_numbers(self.path, stream, count, stored, exact=False)
        if self.fractions:
            if not np.isfinite(data).all():
                raise ValueError(f"{self.path}: holds colours that are NaN or infinite")
            data = np.rint(data * 255).clip(0, 255).astype(self.stored)
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
