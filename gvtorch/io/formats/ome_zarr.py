"""OME-Zarr images, and stores of `convert`, which are such: a folder or a URL."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.image_info import ImageInfo
from ..ngff import is_zarr
from ..source import Index, VolumeSource
from .format import Format

_TIMEOUT = 600.0  # seconds for one read


@dataclass(frozen=True, kw_only=True)
class OmeZarrSource(VolumeSource):
    """The finest level of an image."""

    def read_stored(self, index: Index) -> np.ndarray:
        low, high = [s.start for s in index[:3]], [s.stop for s in index[:3]]
        return _store(self).read_region(0, low, high, timeout=_TIMEOUT)


@functools.lru_cache(maxsize=4)
def _store(source: OmeZarrSource) -> Any:
    from ..store import Store

    return Store.open(source.path)


@Format("OME-Zarr", ".zarr", matches=is_zarr)
def open_ome_zarr(path: str) -> OmeZarrSource:
    """Opens the first image, its first time point and all channels."""
    from ..store import Store

    store = Store.open(path)
    x, y, z = store.extent
    return OmeZarrSource(
        path=path,
        shape=(z, y, x, store.width),
        axes="zyxc",
        stored=str(store.dtype).removeprefix("torch."),
        spacing=store.spacing,
        origin=store.origin,
        info=ImageInfo(unit=store.unit),
    )
