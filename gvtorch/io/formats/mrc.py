"""MRC and CCP4 maps, whose header mrcfile reads: by region, or whole if the file is packed.

Source: Cheng et al., "MRC2014: extensions to the MRC format header", J. Struct. Biol. 2015;
"The MRC file format used by IMOD" (bio3d.colorado.edu/imod), imodStamp and imodFlags.
"""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np

from ...base.image_info import ImageInfo
from ...base.messages import one_line
from ..source import ArraySource, place_axes
from .format import Format

_PACKED_ENDINGS = (".gz", ".bz2")
_IMOD_STAMP, _SIGNED_BYTES, _HALF_BYTES = 1146047817, 1, 16  # and flags beside the stamp
_DTYPES = {0: "i1", 1: "i2", 2: "f4", 6: "u2", 12: "f2"}


@Format("MRC", ".mrc", ".map", ".rec", ".ccp4", ".mrcs", ".st", ".mrc.gz", ".map.gz", ".mrc.bz2",
        ".map.bz2", library="mrcfile")  # fmt: skip
def open_mrc(path: str) -> ArraySource:
    """Opens a map, in angstroms. The maps of a stack become time points."""
    import mrcfile

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with mrcfile.open(path, mode="r", header_only=True, permissive=True) as file:
            header = file.header
            if header is None:
                raise ValueError("the header can't be read")
            fields, order = header.copy(), header.mode.dtype.byteorder
    dropped = [one_line(warning.message) for warning in caught]
    serious = [text for text in dropped if "machine stamp" not in text and "Map ID" not in text]
    if serious:
        raise ValueError(serious[0])
    sizes = [int(fields[name]) for name in ("nz", "ny", "nx")]
    number_dtype = _DTYPES.get(int(fields["mode"]))
    byte_order = "<" if order in "<=|" else ">"
    stamp, flags = np.frombuffer(fields["extra2"].tobytes(), f"{byte_order}i4", 2, 40).tolist()
    if number_dtype is None:
        raise ValueError(f"{path}: mode {int(fields['mode'])}; expected one of {sorted(_DTYPES)}")
    if number_dtype == "i1" and stamp == _IMOD_STAMP:
        if flags & _HALF_BYTES:
            raise ValueError(f"{path}: holds IMOD's values of 4 bits, two in a byte")
        number_dtype = "i1" if flags & _SIGNED_BYTES else "u1"
    if int(fields["nsymbt"]) < 0:
        raise ValueError(f"{path}: an extended header of {int(fields['nsymbt'])} bytes")
    is_stack = int(fields["ispg"]) > 400 and int(fields["mz"]) > 0
    if is_stack:
        slices_per_map = int(fields["mz"])
        if sizes[0] % slices_per_map:
            raise ValueError(f"{path}: a stack of {sizes[0]} slices is not a whole number of maps")
        sizes = [sizes[0] // slices_per_map, slices_per_map, *sizes[1:]]
        dropped.append(f"that its {sizes[0]} maps are separate: they are read as time points")
    affine, unit = _placement(fields)
    return ArraySource(
        path=path,
        file=path,
        shape=tuple(sizes),
        stored=np.dtype(byte_order + number_dtype).str,
        offset=1024 + int(fields["nsymbt"]),
        whole=path.lower().endswith(_PACKED_ENDINGS),
        info=ImageInfo(unit=unit),
        dropped=tuple(dropped),
        **place_axes(path, affine, sizes, time=0 if is_stack else None),
    )


def _placement(header: Any) -> tuple[np.ndarray, str | None]:
    """Returns (4, 4) the affine from section, row and column to angstroms, and the unit."""
    order = [int(header[name]) for name in ("maps", "mapr", "mapc")]
    order = [axis - 1 for axis in (order if sorted(order) == [1, 2, 3] else [3, 2, 1])]
    cell = np.array([float(header["cella"][letter]) for letter in "xyz"])
    counts = np.array([int(header[f"m{letter}"]) for letter in "xyz"])
    has_steps = bool((np.isfinite(cell) & (cell > 0) & (counts > 0)).all())
    affine, steps = np.eye(4), np.eye(3)
    if has_steps:
        steps = _cell_axes(header["cellb"]) * (cell / counts)
    affine[:3, :3] = steps[:, order]
    position = np.array([float(header["origin"][letter]) for letter in "xyz"])
    if not position.any() or not np.isfinite(position).all():
        position = affine[:3, :3] @ [int(header[f"n{axis}start"]) for axis in "zyx"]
    affine[:3, 3] = position
    return affine, "angstrom" if has_steps else None


def _cell_axes(angles: Any) -> np.ndarray:
    """Returns (3, 3), in columns, the directions of a cell's edges: the first along x, the second
    in the plane of x and y. Angles that are not between 0 and 180 degrees are right ones.
    """
    degrees = [float(angles[name]) for name in ("alpha", "beta", "gamma")]
    alpha, beta, gamma = (
        0.0 if n == 90 or not 0 < n < 180 else math.cos(math.radians(n)) for n in degrees
    )
    sine = math.sqrt(1 - gamma**2)
    y = (alpha - beta * gamma) / sine
    z = math.sqrt(max(1 - beta**2 - y**2, 0))  # 0 if there is no such cell
    return np.array([[1, gamma, beta], [0, sine, y], [0, 0, z]])
