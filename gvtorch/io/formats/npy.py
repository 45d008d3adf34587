"""NumPy arrays: NPY, packed NPY, and NPZ. Nothing is unpickled."""

from __future__ import annotations

import zipfile

import numpy as np

from ...base.named_axes import ask_axes
from ..packed import open_unpacked
from ..source import ArraySource
from .format import Format, choose, not_chosen


@Format("NPY", ".npy", ".npy.gz", ".npy.bz2", options=("axes",))
def open_npy(path: str, axes: str | None = None, member: str = "") -> ArraySource:
    """Opens an array file, or a member of an archive of them; `axes` as in `ask_axes`."""
    with open_unpacked(path, member) as stream:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if read_header is None:
            raise ValueError(f"{path}: .npy version {version} is unknown")
        shape, fortran, dtype = read_header(stream)
        offset = stream.tell()
    if dtype.hasobject:
        raise ValueError(f"{path}: holds Python objects, not numbers")
    return ArraySource(
        path=path,
        file=path,
        member=member,
        shape=tuple(int(n) for n in shape),
        axes=ask_axes(path, shape, axes),
        stored=dtype.str,
        offset=offset,
        fortran=fortran,
        whole=not path.lower().endswith(".npy"),
    )


@Format("NPZ", ".npz", options=("key", "axes"))
def open_npz(path: str, key: str | None = None, axes: str | None = None) -> ArraySource:
    """Opens the array `key` of an archive, the only one if left out; `axes` as in `ask_axes`."""
    with zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    if key is None and len(names) > 1:
        raise not_chosen(path, "array", names, key)
    chosen, _ = choose(path, "array", names, key)
    return open_npy(path, axes, f"{names[chosen]}.npy")
