"""NumPy arrays, (z, y, x) or (z, y, x, c): NPY, packed NPY, and NPZ. Nothing is unpickled."""

from __future__ import annotations

import zipfile

import numpy as np

from ..source import ArraySource, open_unpacked
from .format import Format


@Format("NPY", ".npy", ".npy.gz", ".npy.bz2")
def open_npy(path: str, member: str = "") -> ArraySource:
    """Opens an array file, or a member of an archive of them."""
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
    if len(shape) not in (3, 4):
        raise ValueError(f"{path}: data must be (z, y, x) or (z, y, x, c), got shape {shape}")
    return ArraySource(
        path=path,
        file=path,
        member=member,
        shape=tuple(int(n) for n in shape),
        axes="zyxc"[: len(shape)],
        stored=dtype.str,
        offset=offset,
        fortran=fortran,
        whole=not path.lower().endswith(".npy"),
    )


@Format("NPZ", ".npz", options=("key",))
def open_npz(path: str, key: str | None = None) -> ArraySource:
    """Opens the array `key` of an archive; without it, the only one."""
    with zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    if key is None and len(names) != 1:
        raise ValueError(
            f"{path}: holds {len(names)} arrays, choose one with key: {', '.join(names)}"
        )
    chosen = names[0] if key is None else key
    if chosen not in names:
        raise ValueError(f"{path}: has no array {chosen!r}; it holds {', '.join(names)}")
    return open_npy(path, f"{chosen}.npy")
