"""`as_source`: arrays of other libraries as sources, read part by part where they lie elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.arrays import ArrayLike, as_volume
from ..base.volume import Volume
from .source import ArraySource, Index, MemorySource, VolumeSource


@dataclass(frozen=True, kw_only=True)
class ObjectSource(VolumeSource):
    """An array whose values are read or computed when they are asked for (dask, zarr, h5py, lazy
    xarray): as picklable as it is itself.
    """

    array: ArrayLike

    def read_stored(self, index: Index) -> np.ndarray:
        return self.array.read(index)


def as_source(where: str, given: Any, axes: str | None = None) -> VolumeSource:
    """Returns a volume or an array as a source; see `ArrayLike.of` for arguments and errors."""
    if isinstance(given, Volume):
        place: dict[str, Any] = {"spacing": given.spacing, "origin": given.origin}
        return MemorySource.of(given.data.cpu().numpy(), path=given.name, info=given.info, **place)
    if not hasattr(given, "shape") or not hasattr(given, "dtype") or hasattr(given, "device"):
        if not isinstance(given, np.ndarray):
            return as_source(where, as_volume(given, axes=axes, where=where))
    found = ArrayLike.of(where, given, axes)
    kept = {name: getattr(found, name) for name in ("spacing", "origin", "info", "lost")}
    kept["path"] = found.name or "array"
    told = {name: getattr(found, name) for name in ("shape", "axes", "flips")}
    told |= {"stored": found.dtype, **kept}
    mapped = _mapped(given)
    if mapped is not None:
        return ArraySource(**told, **mapped)
    source = ObjectSource(array=found, **told)
    if found.lazy:
        return source
    return MemorySource.of(source.read_times(0, source.times), **kept)


def _mapped(given: Any) -> dict[str, Any] | None:
    """Where the numbers of a memory map lie, if it is a whole one: other processes map it too."""
    if not isinstance(given, np.memmap) or given.filename is None:
        return None
    whole = given.base is not None and not isinstance(given.base, np.ndarray)
    if not whole or not (given.flags.c_contiguous or given.flags.f_contiguous):
        return None
    fortran = not given.flags.c_contiguous
    return {"file": str(given.filename), "offset": int(given.offset), "fortran": fortran}
