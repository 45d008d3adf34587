"""MRC and CCP4 maps, whose header mrcfile reads: by region, or whole if the file is packed.

Source: Cheng et al., "MRC2014: extensions to the MRC format header", J. Struct. Biol. 2015.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ...base.image_info import ImageInfo
from ...base.messages import one_line
from ..source import ArraySource, Triple
from .format import Format

_PACKED_ENDINGS = (".gz", ".bz2")
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
    if number_dtype is None:
        raise ValueError(f"{path}: mode {int(fields['mode'])}; expected one of {sorted(_DTYPES)}")
    if int(fields["nsymbt"]) < 0:
        raise ValueError(f"{path}: an extended header of {int(fields['nsymbt'])} bytes")
    axes = [int(fields[name]) for name in ("maps", "mapr", "mapc")]
    axis_order = "zyx" if sorted(axes) != [1, 2, 3] else "".join("xyz"[axis - 1] for axis in axes)
    spacing, origin, unit = _placement(fields)
    is_stack = int(fields["ispg"]) > 400 and int(fields["mz"]) > 0
    if is_stack:
        slices_per_map = int(fields["mz"])
        if sizes[0] % slices_per_map:
            raise ValueError(f"{path}: a stack of {sizes[0]} slices is not a whole number of maps")
        sizes, axis_order = (
            [sizes[0] // slices_per_map, slices_per_map, *sizes[1:]],
            "t" + axis_order,
        )
        dropped.append(f"that its {sizes[0]} maps are separate: they are read as time points")
    return ArraySource(
        path=path,
        file=path,
        shape=tuple(sizes),
        axes=axis_order,
        stored=np.dtype(("<" if order in "<=|" else ">") + number_dtype).str,
        offset=1024 + int(fields["nsymbt"]),
        whole=path.lower().endswith(_PACKED_ENDINGS),
        spacing=spacing,
        origin=origin,
        info=ImageInfo(unit=unit),
        dropped=tuple(dropped),
    )


def _placement(header: Any) -> tuple[Triple, Triple, str | None]:
    """Returns voxel size and position of the first voxel, angstroms, x y z, and their unit."""
    steps, starts = [], []
    names = ("nxstart", "nystart", "nzstart")  # of columns, rows, sections
    order = [int(header[name]) for name in ("mapc", "mapr", "maps")]
    order = order if sorted(order) == [1, 2, 3] else [1, 2, 3]
    for axis, letter in enumerate("xyz"):
        cell, count = float(header["cella"][letter]), int(header[f"m{letter}"])
        steps.append(cell / count if cell > 0 and count > 0 and np.isfinite(cell) else 0.0)
        starts.append(int(header[names[order.index(axis + 1)]]))
    has_steps = all(step > 0 for step in steps)
    x, y, z = steps if has_steps else (1.0, 1.0, 1.0)
    position = [float(header["origin"][letter]) for letter in "xyz"]
    if not any(position) or not np.isfinite(position).all():
        position = [start * step for start, step in zip(starts, (x, y, z), strict=True)]
    return (x, y, z), (position[0], position[1], position[2]), "angstrom" if has_steps else None
