"""FITS, read with astropy: the first image of three dimensions.

Spacing is 1, since FITS axes have units of their own (degrees, m/s).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..packed import is_packed_fits
from ..source import ArraySource, Index, VolumeSource, read_planes
from .format import Format


@dataclass(frozen=True, kw_only=True)
class FitsSource(VolumeSource):
    """An image that is scaled or packed; it is read plane by plane, or all at once."""

    def read_stored(self, index: Index) -> np.ndarray:
        from astropy.io import fits

        with fits.open(self.path, memmap=False) as hdus:
            cube = _first_cube(self.path, hdus)
            if self.whole or self.covers(index):
                return np.asarray(cube.data)[index]

            def read(position: tuple[int, ...]) -> np.ndarray:
                return np.asarray(cube.section[position])[index[-2:]]

            return read_planes(index, len(index) - 2, self.stored, read)


@Format("FITS", ".fits", ".fits.gz", ".fit", library="astropy")
def open_fits(path: str) -> VolumeSource:
    """Opens a cube; its first voxel is read to find the dtype after scaling."""
    from astropy.io import fits

    packed = is_packed_fits(path)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*truncated.*")
        with fits.open(path, memmap=False) as hdus:
            cube = _first_cube(path, hdus)
            shape = tuple(int(n) for n in cube.shape)
            scaled = any(key in cube.header for key in ("BSCALE", "BZERO", "BLANK"))
            dtype = np.asarray(cube.section[(slice(0, 1),) * len(shape)]).dtype
            offset = int(cube.fileinfo()["datLoc"])
            is_plain = not (scaled or packed or isinstance(cube, fits.CompImageHDU))
    fields: dict[str, Any] = {"path": path, "shape": shape, "axes": "-" * (len(shape) - 3) + "zyx"}
    if is_plain:
        stored = dtype.newbyteorder(">").str
        return ArraySource(file=path, stored=stored, offset=offset, **fields)
    return FitsSource(stored=dtype.str, whole=packed, **fields)


def _first_cube(path: str, hdus: Any) -> Any:
    """Returns the first image of three dimensions among the header-data units of a file."""
    cube = next((hdu for hdu in hdus if hdu.is_image and len(hdu.shape) >= 3), None)
    if cube is None:
        raise ValueError(f"{path}: holds no image of three dimensions")
    if math.prod(cube.shape[:-3]) != 1:
        raise ValueError(f"{path}: expected a cube, got {cube.shape}")
    return cube
