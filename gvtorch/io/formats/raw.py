"""RAW: numbers without a header, x fastest; the file's name or the user specifies extent and dtype.
A file of unknown ending is read as RAW if the user specifies its shape.
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
    """Opens a RAW file of (x, y, z) voxels. A shape or dtype that is left out is read from its
    name, as in `scan_512x512x300_int16.raw`, little endian unless that says "be". If `offset`, the
    bytes of a header to skip, is given, other bytes may also follow the numbers.
    """
    from ...base import check  # imports torch, which workers of a conversion do without

    name_match = _NAME.search(Path(path).name.lower())
    if shape is None:
        if name_match is None:
            raise ValueError(f"{path}: a RAW file needs its extent: {_HINT} shape and dtype")
        shape = [int(name_match[axis]) for axis in (1, 2, 3)]
    if len(shape) != 3:
        raise ValueError(f"{path}: shape must be three numbers X,Y,Z, got {tuple(shape)}")
    if dtype is None and name_match is None:
        raise ValueError(f"{path}: a RAW file needs its dtype: {_HINT} dtype")
    dtype_name = name_match[4] if dtype is None and name_match else dtype
    try:
        stored_dtype = np.dtype(dtype_name)
    except TypeError:
        raise ValueError(f"{path}: dtype must be a NumPy dtype, got {dtype_name!r}") from None
    if stored_dtype.kind not in "iuf":
        raise ValueError(f"{path}: dtype must be an integer or a float, got {dtype_name!r}")
    if dtype is None and name_match:
        stored_dtype = stored_dtype.newbyteorder(">" if name_match[5] == "be" else "<")
    return ArraySource(
        path=path,
        file=path,
        shape=tuple(check.integer(path, "shape", size, low=0) for size in shape),
        axes="xyz",
        fortran=True,
        stored=stored_dtype.str,
        offset=0 if offset is None else check.integer(path, "offset", offset, low=0),
        exact=offset is None,
        whole=path.lower().endswith((".gz", ".bz2")),
    )
