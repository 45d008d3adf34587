"""Plain Zarr arrays (versions 2 and 3) and N5 arrays, read by region with tensorstore.

The meaning and coordinates of Zarr's axes come from their names (`dimension_names`, xarray's
`_ARRAY_DIMENSIONS`) and from sibling arrays of these names, those of N5's from `pixelResolution`,
`resolution` or `transform`. N5's first axis is the fastest one: x.
Source: Zarr specification, versions 2 and 3; N5 specification (github.com/saalfeldlab/n5).
"""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...base.image_info import ImageInfo
from ...base.named_axes import ask_axes, even_steps, named_axes, place_named
from ...base.units import spacing_of
from ..source import Index, Triple, VolumeSource
from ..stores.chunk_files import ChunkFiles, begin_read, files_of
from ..stores.ngff import read_json_file
from ..stores.store_layout import Deadline, is_number, kvstore, opened_at
from .format import Format, not_chosen

_TIMEOUT = 600.0  # seconds for one read
_OPEN_TIMEOUT = 20.0
_MOST_FOLDERS = 10_000
_HEADS = (("zarr3", "zarr.json"), ("zarr", ".zarray"), ("n5", "attributes.json"))


@dataclass(frozen=True, kw_only=True)
class ChunkedSource(VolumeSource):
    """A Zarr or N5 array."""

    driver: str
    folder: str

    def read_stored(self, index: Index) -> np.ndarray:
        array, files = _array(self.driver, self.folder, self.opened)
        return Deadline(_TIMEOUT).wait(begin_read(array[index], files), self.folder)


@functools.lru_cache(maxsize=8)
def _array(driver: str, folder: str, _opened: int) -> tuple[Any, ChunkFiles]:
    future = opened_at(kvstore(folder), {"driver": driver})
    array = Deadline(_OPEN_TIMEOUT).wait(future, folder)
    return array, files_of(folder, array)


def _head(folder: str) -> tuple[str, dict[str, Any]] | None:
    """Returns the driver and the metadata of an array; None for anything else."""
    for driver, name in _HEADS:
        file = Path(folder) / name
        if file.is_file():
            told = read_json_file(file)
            is_array = {"zarr3": told.get("node_type") == "array", "n5": "dimensions" in told}
            return (driver, told) if is_array.get(driver, True) else None
    return None


def _attributes(folder: str) -> dict[str, Any]:
    """Returns the user attributes of an array or a group."""
    for name, inner in (("zarr.json", "attributes"), (".zattrs", ""), ("attributes.json", "")):
        file = Path(folder) / name
        if file.is_file():
            told = read_json_file(file)
            found = told.get(inner, {}) if inner else told
            return found if isinstance(found, dict) else {}
    return {}


def _arrays(folder: str) -> list[str]:
    """Returns the names of the arrays below a group that have three or more axes."""
    found, seen = [], 0
    for place, folders, _ in os.walk(folder):
        seen += 1
        if seen > _MOST_FOLDERS:
            break
        if (head := _head(place)) is not None:
            folders.clear()  # these hold chunks
            shape = head[1].get("shape", head[1].get("dimensions", ()))
            if isinstance(shape, list) and len(shape) >= 3:
                found.append(os.path.relpath(place, folder))
        folders.sort()
    return found


def _is_zarr_group(path: str) -> bool:
    """Returns whether a path is a Zarr array, or a group of arrays that is no OME-NGFF image."""
    if "://" in path or not Path(path).is_dir():
        return False
    if not any((Path(path) / name).is_file() for name in ("zarr.json", ".zarray", ".zgroup")):
        return False
    try:
        if (head := _head(path)) is not None:
            return head[0] != "n5"
        told = _attributes(path)
    except (ValueError, OSError):
        return False  # the OME-Zarr format reports what is wrong
    own = {"multiscales", "ome", "gvtorch", "bioformats2raw.layout", "plate", "well"}
    return not own & set(told) and bool(_arrays(path))


@Format("Zarr", matches=_is_zarr_group, options=("key", "axes"))
def open_zarr_array(path: str, key: str | None = None, axes: str | None = None) -> ChunkedSource:
    """Opens an array, or the array `key` of a group, the only one if left out. `axes` as in
    `ask_axes`.
    """
    folder = _choose(path, key)
    driver, told = _head(folder) or ("", {})
    source, shape = _source(path, driver, folder)
    attributes = _attributes(folder)
    names = told.get("dimension_names") or attributes.get("_ARRAY_DIMENSIONS")
    names = [str(name or "") for name in names] if isinstance(names, list) else []
    steps: list[tuple[float, float] | None] = [None] * len(shape)
    units: list[str | None] = [None] * len(shape)
    letters, lost = None, []
    if len(names) == len(shape):
        letters = named_axes(names, shape) if axes is None else None
        for at, name in enumerate(names):
            beside = Path(folder).parent / name
            if beside.parent != Path(folder).parent or name == "..":
                continue  # the name of an axis must not be a path to another folder
            if name and beside != Path(folder) and (head := _head(str(beside))) is not None:
                places, files = _array(head[0], str(beside), source.opened)
                if places.shape == (shape[at],) and shape[at] < 1 << 24:
                    values = Deadline(_TIMEOUT).wait(begin_read(places, files), str(beside))
                    steps[at], even = even_steps(values)
                    units[at] = str(_attributes(str(beside)).get("units", "")) or None
                    lost += [] if even else [f"that coordinates along {name} are not evenly spaced"]
    letters = letters or ask_axes(path, shape, axes)
    place, moments = place_named(letters, shape, steps, units)
    quantity = attributes.get("units")
    info = ImageInfo(quantity=quantity if isinstance(quantity, str) else None, **moments)
    return replace(source, axes=letters, info=info, lost=tuple(lost), **place)


def _is_n5(path: str) -> bool:
    if "://" in path:
        return path.split("?", maxsplit=1)[0].rstrip("/").endswith(".n5")
    folder = Path(path)
    return (folder / "attributes.json").is_file() or path.rstrip("/").endswith(".n5")


@Format("N5", ".n5", matches=_is_n5, options=("key", "axes"))
def open_n5(path: str, key: str | None = None, axes: str | None = None) -> ChunkedSource:
    """Opens an array, or the array `key` of a container, the only one if left out. `axes` as in
    `ask_axes`, the slowest first, which is the last axis of N5.
    """
    if "://" in path:
        folder, told = f"{path.rstrip('/')}/{key}" if key else path, {}
    else:
        folder = _choose(path, key)
        told = (_head(folder) or ("", {}))[1]
    source, shape = _source(path, "n5", folder)
    letters = ask_axes(path, shape[::-1], axes)[::-1]
    spacing, origin, unit = _n5_place(told, letters)
    return replace(source, axes=letters, spacing=spacing, origin=origin, info=ImageInfo(unit=unit))


def _choose(path: str, key: str | None) -> str:
    if key is None and _head(path) is not None:
        return path
    if key is not None:
        folder = Path(path) / key.strip("/")
        if ".." not in Path(key).parts and _head(str(folder)) is not None:
            return str(folder)
    names = _arrays(path)
    if key is None and len(names) == 1:
        return str(Path(path) / names[0])
    raise not_chosen(path, "array", names, key, " of three or more axes")


def _source(path: str, driver: str, folder: str) -> tuple[ChunkedSource, tuple[int, ...]]:
    """Returns the source of an array, without axes and position, and its shape."""
    source = ChunkedSource(path=path, shape=(), axes="", stored="u1", driver=driver, folder=folder)
    array, _ = _array(driver, folder, source.opened)
    dtype, shape = array.dtype.numpy_dtype, tuple(int(n) for n in array.shape)
    if dtype.kind not in "biuf":
        raise ValueError(f"{path}: values must be real numbers, got dtype {array.dtype.name}")
    return replace(source, shape=shape, stored=dtype.str), shape


def _n5_place(told: dict[str, Any], letters: str) -> tuple[Triple, Triple, str | None]:
    """Returns voxel size, origin and unit of an N5 array; `letters` are its axes, fastest first."""
    rank = len(letters)
    sizes: Any = told.get("pixelResolution", told.get("resolution"))
    unit: Any = told.get("units", told.get("unit"))
    origin: Any = told.get("translate", told.get("offset"))
    if isinstance(sizes, dict):
        unit, sizes = sizes.get("unit", unit), sizes.get("dimensions")
    transform = told.get("transform")
    if isinstance(transform, dict):  # its lists are in C order
        sizes, origin = (list(transform.get(n) or [])[::-1] for n in ("scale", "translate"))
        unit = transform.get("units")
    unit = unit[0] if isinstance(unit, list) and unit else unit
    steps = dict(zip(letters, _numbers(sizes, rank, 1.0), strict=True))
    starts = dict(zip(letters, _numbers(origin, rank, 0.0), strict=True))
    factors = dict(zip(letters, _numbers(told.get("downsamplingFactors"), rank, 1.0), strict=True))
    found = [abs(steps.get(a, 1.0) * factors.get(a, 1.0)) for a in "xyz"]
    spacing, name = spacing_of(found, [unit if isinstance(unit, str) else None] * 3)
    return spacing, (starts.get("x", 0.0), starts.get("y", 0.0), starts.get("z", 0.0)), name


def _numbers(values: Any, count: int, plain: float) -> list[float]:
    good = isinstance(values, list) and len(values) == count and all(map(is_number, values))
    return [float(v) for v in values] if good else [plain] * count
