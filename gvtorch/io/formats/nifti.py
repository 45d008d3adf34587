"""NIfTI, read with nibabel: (x, y, z), then time, then components. Axes parallel to the world's,
which are x right, y anterior, z superior, are reordered and flipped to x, y, z.

Source: "NIfTI-1 data format", nifti1.h (nifti.nimh.nih.gov), dim, xyzt_units, intent_code, cal_max.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.image_info import ChannelInfo, ImageInfo, color_channels
from ...base.messages import collected_log
from ...base.units import length_unit, time_unit
from ..budget import MAX_UNPACK_RATIO
from ..source import ArraySource, Index, VolumeSource, place_axes, time_fields
from .format import Format

_LABEL_INTENT = 1002


@dataclass(frozen=True, kw_only=True)
class NiftiSource(VolumeSource):
    """A NIfTI image, its values scaled as the header says."""

    def read_stored(self, index: Index) -> np.ndarray:
        data = _load(self.path)[0].dataobj
        if self.whole and data.dtype.str == self.stored and (data.slope, data.inter) == (1, 0):
            # nibabel would take several times the memory.
            fields: dict[str, Any] = {"path": self.path, "axes": self.axes, "stored": self.stored}
            fields |= {"shape": data.shape, "offset": data.offset, "fortran": True, "whole": True}
            return ArraySource(file=self.path, **fields).read_stored(index)
        if data.dtype.fields is None:
            return np.asanyarray(data[index])
        return _components(np.asanyarray(data[index[: len(data.shape)]]))[..., index[-1]]


@Format("NIfTI", ".nii", ".nii.gz", library="nibabel")
def open_nifti(path: str) -> NiftiSource:
    """Opens an image; its first voxel is read to find the dtype after scaling."""
    image, corrections = _load(path)
    shape = tuple(int(n) for n in image.shape)
    packed = path.lower().endswith(".gz")
    needed_bytes, size = math.prod(shape) * image.dataobj.dtype.itemsize, os.stat(path).st_size
    if packed and needed_bytes > MAX_UNPACK_RATIO * size:  # nibabel allocates all of it at once
        raise ValueError(f"{path}: takes {needed_bytes} bytes, which {size} can't unpack to")
    first_voxel = np.asanyarray(image.dataobj[(slice(0, 1),) * len(shape)])
    if first_voxel.dtype.fields is not None:  # colours: a structured dtype of components
        first_voxel = _components(first_voxel)
        shape = (*shape, *[1] * (4 - len(shape)), first_voxel.shape[-1])
    if len(shape) < 3 or math.prod(shape[5:]) != 1:
        raise ValueError(f"{path}: expected 3 to 5 dimensions, got {shape}")
    component, time = (axis if len(shape) > axis else None for axis in (4, 3))
    placement = place_axes(path, np.asarray(image.affine), shape[:5], component, time)
    info, dropped = _info(image, shape)
    return NiftiSource(
        path=path,
        shape=shape,
        stored=first_voxel.dtype.str,
        whole=packed,
        info=info,
        dropped=(*corrections, *dropped),
        **placement | {"axes": placement["axes"] + "-" * len(shape[5:])},
    )


def _info(image: Any, shape: tuple[int, ...]) -> tuple[ImageInfo, list[str]]:
    """Returns the header's metadata of the values, and which metadata is not kept."""
    header, dropped = image.header, []
    try:
        length, period = header.get_xyzt_units()
    except KeyError:
        length = period = "unknown"
        dropped.append(f"xyzt_units {int(header['xyzt_units'])}, which are none")
    times: dict[str, Any] = {}
    if len(shape) > 3 and shape[3] > 1:
        times = time_fields(float(header["pixdim"][4]), time_unit(period), float(header["toffset"]))
        if time_unit(period) is None and period != "unknown":
            dropped.append(f"the fourth axis counts {period}, and is read as time")
    if int(header["qform_code"]) > 0 and int(header["sform_code"]) > 0:
        forms = header.get_qform(), header.get_sform()
        if not np.allclose(*forms, rtol=1e-3, atol=1e-2 * float(header["pixdim"][1:4].min())):
            dropped.append("the qform, which differs from the sform")
    if len(header.extensions):
        dropped.append(f"{len(header.extensions)} header extensions")
    window = (float(header["cal_min"]), float(header["cal_max"]))
    windowed = ChannelInfo(window=window if all(map(math.isfinite, window)) else None)
    channels = [windowed] * (shape[4] if len(shape) > 4 else 1) if window[0] < window[1] else []
    if image.dataobj.dtype.fields is not None:
        channels = [*color_channels(shape[4])]
    info = ImageInfo(
        unit=length_unit(length),
        channels=tuple(channels),
        labels=int(header["intent_code"]) == _LABEL_INTENT,
        space="right-anterior-superior",
        **times,
    )
    return info, dropped


def _components(data: np.ndarray) -> np.ndarray:
    """Converts (x, y, z[, t]) colours of a structured dtype to (x, y, z, t, c)."""
    names = data.dtype.names or ()
    parts = np.stack([data[name] for name in names], -1)
    return parts[..., None, :] if parts.ndim == 4 else parts


def _load(path: str) -> tuple[Any, list[str]]:
    """Returns the image, and what nibabel corrected in its header."""
    import nibabel

    with collected_log("nibabel.global") as log:
        image = nibabel.load(path)
    return image, [record.getMessage() for record in log]
