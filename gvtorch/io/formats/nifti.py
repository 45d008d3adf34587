"""NIfTI, through nibabel. Axes along the world's are turned to x, y, z."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..source import Index, VolumeSource, place_axes
from .format import Format


@dataclass(frozen=True, kw_only=True)
class NiftiSource(VolumeSource):
    """A NIfTI image, its values scaled as the header tells."""

    def read_stored(self, index: Index) -> np.ndarray:
        return np.asanyarray(_load(self.path).dataobj[index])


@Format("NIfTI", ".nii", ".nii.gz", library="nibabel")
def open_nifti(path: str) -> NiftiSource:
    """Opens an image; its first voxel tells the dtype after scaling."""
    image = _load(path)
    shape = tuple(int(n) for n in image.shape)
    if len(shape) not in (3, 4):
        raise ValueError(f"{path}: expected 3 or 4 dimensions, got {shape}")
    first = np.asanyarray(image.dataobj[(slice(0, 1),) * len(shape)])
    return NiftiSource(
        path=path,
        shape=shape,
        stored=first.dtype.str,
        whole=path.lower().endswith(".gz"),
        **place_axes(path, np.asarray(image.affine), shape, 3 if len(shape) == 4 else None),
    )


def _load(path: str) -> Any:
    import nibabel

    return nibabel.load(path)
