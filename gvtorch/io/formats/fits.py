"""FITS, read with astropy: an image of three dimensions.

Spacing is 1, since FITS axes have units of their own (degrees, m/s).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.image_info import ImageInfo
from ..packed import is_packed_fits
from ..source import ArraySource, Index, VolumeSource, read_planes
from .format import Format, choose


@dataclass(frozen=True, kw_only=True)
class FitsSource(VolumeSource):
    """An image that is scaled or packed; it is read plane by plane, or all at once."""

    number: int  # of its header-data unit

    def read_stored(self, index: Index) -> np.ndarray:
        from astropy.io import fits

        with fits.open(self.path, memmap=False) as hdus:
            cube = hdus[self.number]
            if self.whole or index == tuple(slice(0, n) for n in self.shape):
                return np.asarray(cube.data)[index]

            def read(position: tuple[int, ...]) -> np.ndarray:
                return np.asarray(cube.section[position])[index[-2:]]

            return read_planes(index, len(index) - 2, self.stored, read)


@Format("FITS", ".fits", ".fits.gz", ".fit", options=("key",), library="astropy")
def open_fits(path: str, key: str | None = None) -> VolumeSource:
    """Opens the image `key` (its number or name) of those of three dimensions, the first one if
    left out; its first voxel is read to find the dtype after scaling.
    """
    from astropy.io import fits

    packed = is_packed_fits(path)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*truncated.*")
        with fits.open(path, memmap=False) as hdus:
            cubes = {n: hdu for n, hdu in enumerate(hdus) if hdu.is_image and len(hdu.shape) >= 3}
            if not cubes:
                raise ValueError(f"{path}: holds no image of three dimensions")
            chosen, dropped = choose(path, "image", [hdu.name for hdu in cubes.values()], key)
            number, cube = list(cubes.items())[chosen]
            shape = tuple(int(n) for n in cube.shape)
            if math.prod(shape[:-3]) != 1:
                raise ValueError(f"{path}: expected a cube, got {shape}")
            scaled = any(name in cube.header for name in ("BSCALE", "BZERO", "BLANK"))
            if any(name.startswith(("CTYPE", "CRVAL", "CDELT")) for name in cube.header):
                dropped = (*dropped, "world coordinates: voxels are 1 wide")
            quantity = str(cube.header.get("BUNIT", "")).strip() or None
            dtype = np.asarray(cube.section[(slice(0, 1),) * len(shape)]).dtype
            offset = int(cube.fileinfo()["datLoc"])
            is_plain = not (scaled or packed or isinstance(cube, fits.CompImageHDU))
    fields: dict[str, Any] = {"path": path, "shape": shape, "axes": "-" * (len(shape) - 3) + "zyx"}
    fields |= {"info": ImageInfo(quantity=quantity), "dropped": dropped}
    if is_plain:
        stored = dtype.newbyteorder(">").str
        return ArraySource(file=path, stored=stored, offset=offset, **fields)
    return FitsSource(stored=dtype.str, whole=packed, number=number, **fields)
