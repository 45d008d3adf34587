"""OME-Zarr images, including stores written by `convert`: a folder or a URL."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.boxes import box_of
from ..source import Index, VolumeSource
from ..stores.ngff import is_zarr
from .format import Format

_TIMEOUT = 600.0  # seconds for one read


@dataclass(frozen=True, kw_only=True)
class OmeZarrSource(VolumeSource):
    """The finest level of an image, (t, z, y, x, c)."""

    key: str | None

    def read_stored(self, index: Index) -> np.ndarray:
        times, box = range(index[0].start, index[0].stop), box_of(index[1:4])
        stores = (_store(self.path, self.key, self.opened, time) for time in times)
        return np.stack([store.read_stored(*box, timeout=_TIMEOUT) for store in stores])


@functools.lru_cache(maxsize=4)
def _store(path: str, key: str | None, _opened: int, time: int) -> Any:
    from ..stores.store import Store

    return Store.open(path, image=key, time=time)


@Format("OME-Zarr", ".zarr", matches=is_zarr, options=("key",))
def open_ome_zarr(path: str, key: str | None = None) -> OmeZarrSource:
    """Opens the image `key`, the first one if left out, with all times and channels."""
    from ..stores.store import Store

    store = Store.open(path, image=key)
    x, y, z = store.extent
    return OmeZarrSource(
        path=path,
        shape=(store.times, z, y, x, store.width),
        axes="tzyxc",
        stored=store.stored,
        spacing=store.spacing,
        origin=store.origin,
        info=store.info,
        dropped=store.dropped,
        key=key,
    )
