"""RAW: numbers alone, x fastest; the file's name or the user tells extent and dtype. A file of any
ending is one if the user tells its shape.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..source import ArraySource
from .format import Format

_NAME = re.compile(r"_(\d+)x(\d+)x(\d+)_([a-z]+\d+)(?:_?(le|be))?(?=[._]|$)")
_HINT = "name it *_XxYxZ_dtype.raw or pass"


@Format("RAW", ".raw", ".raw.gz", options=("shape", "dtype", "offset"))
def open_raw(
    path: str,
    shape: Sequence[int] | None = None,
    dtype: str | np.dtype | None = None,
    offset: int | None = None,
) -> ArraySource:
    """Opens a RAW file of (x, y, z) voxels. What is not given is read from its name, as in
    `scan_512x512x300_int16.raw`, little endian unless that says "be". Where `offset` bytes of a
    header come first, something may also follow the numbers.
    """
    named = _NAME.search(Path(path).name.lower())
    if shape is None:
        if named is None:
            raise ValueError(f"{path}: a RAW file needs its extent: {_HINT} shape and dtype")
        shape = [int(named[axis]) for axis in (1, 2, 3)]
    if len(shape) != 3:
        raise ValueError(f"{path}: shape must be three numbers X,Y,Z, got {tuple(shape)}")
    if dtype is None and named is None:
        raise ValueError(f"{path}: a RAW file needs its dtype: {_HINT} dtype")
    told = named[4] if dtype is None and named else dtype
    try:
        kind = np.dtype(told)
    except TypeError:
        raise ValueError(f"{path}: dtype must be a NumPy dtype, got {told!r}") from None
    if kind.kind not in "iuf":
        raise ValueError(f"{path}: dtype must be an integer or a float, got {told!r}")
    if dtype is None and named:
        kind = kind.newbyteorder(">" if named[5] == "be" else "<")
    if offset is not None and (type(offset) is not int or offset < 0):
        raise ValueError(f"{path}: offset must be bytes, an int >= 0, got {offset!r}")
    return ArraySource(
        path=path,
        file=path,
        shape=tuple(int(size) for size in shape),
        axes="xyz",
        fortran=True,
        stored=kind.str,
        offset=offset or 0,
        exact=offset is None,
        whole=path.lower().endswith((".gz", ".bz2")),
    )
