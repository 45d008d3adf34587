"""NRRD, attached or detached; the header through pynrrd. Axes along the world's are turned to
x, y, z.

Source: "Definition of NRRD File Format" (teem.sourceforge.net/nrrd/format.html).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..source import ArraySource, Index, VolumeSource, place_axes
from .format import Format

_TYPES = {
    **dict.fromkeys(("signed char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32"), "u4"),
    **dict.fromkeys(("longlong", "long long", "long long int", "int64"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "uint64"), "u8"),
    **{"float": "f4", "double": "f8"},
}


@dataclass(frozen=True, kw_only=True)
class NrrdSource(VolumeSource):
    """A NRRD file that is packed, text, or spread over several files: pynrrd reads it whole."""

    def read_stored(self, index: Index) -> np.ndarray:
        """Reads all, and returns a part."""
        import nrrd

        return nrrd.read(self.path, index_order="F")[0][index]


@Format("NRRD", ".nrrd", ".nhdr", library="nrrd", package="pynrrd")
def open_nrrd(path: str) -> VolumeSource:
    """Opens a file."""
    import nrrd

    with open(path, "rb") as file:
        header = nrrd.read_header(file)
        offset = file.tell()
    shape = tuple(int(n) for n in header["sizes"])
    if len(shape) not in (3, 4):
        raise ValueError(f"{path}: expected 3 or 4 dimensions, got {shape}")
    kind = _TYPES.get(str(header["type"]).lower().removesuffix("_t"))
    if kind is None:
        raise ValueError(f"{path}: type {header['type']!r} is unknown")
    component, affine = _place(header, len(shape))
    told: dict[str, Any] = {
        "path": path,
        "shape": shape,
        "stored": np.dtype((">" if header.get("endian") == "big" else "<") + kind).str,
        **place_axes(path, affine, shape, component),
    }
    data = header.get("data file", header.get("datafile"))
    skip = int(header.get("byte skip", header.get("byteskip", 0)))
    lines = int(header.get("line skip", header.get("lineskip", 0)))
    one_file = data is None or (
        isinstance(data, str) and not data.startswith("LIST") and "%" not in data
    )
    if header["encoding"] != "raw" or lines or skip < 0 or not one_file:
        return NrrdSource(whole=True, **told)
    file_path = path if data is None else str(Path(path).parent / data)
    offset = skip if data is not None else offset + skip
    return ArraySource(file=file_path, offset=offset, fortran=True, **told)


def _place(header: dict[str, Any], rank: int) -> tuple[int | None, np.ndarray]:
    """Returns the axis that counts components, if any, and the (4, 4) place of the others."""
    directions = np.asarray(header.get("space directions", np.zeros((0, 3))), dtype=np.float64)
    spacings = np.asarray(header.get("spacings", np.zeros(0)), dtype=np.float64)
    kinds = list(header.get("kinds", ()))
    component = None
    if rank == 4:  # one axis counts components: the one that has no place, else the first
        placed = [np.isfinite(row).all() for row in directions] or list(np.isfinite(spacings))
        component = placed.index(False) if False in placed else 0
        component = next(
            (i for i, kind in enumerate(kinds) if kind not in ("domain", "space")), component
        )
        directions, spacings = (
            np.delete(a, component, 0) if len(a) == 4 else a for a in (directions, spacings)
        )
    affine = np.eye(4)
    if directions.shape == (3, 3) and np.isfinite(directions).all():
        affine[:3, :3] = directions.T
    elif spacings.shape == (3,) and np.isfinite(spacings).all():
        affine[:3, :3] = np.diag(spacings)
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    if origin.shape == (3,) and np.isfinite(origin).all():
        affine[:3, 3] = origin
    return component, affine
