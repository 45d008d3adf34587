"""Plain Zarr arrays (versions 2 and 3) and N5 arrays, read by region with tensorstore.

The meaning and coordinates of Zarr's axes come from their names (`dimension_names`, xarray's
`_ARRAY_DIMENSIONS`) and from sibling arrays of these names, those of N5's from `pixelResolution`,
`resolution` or `transform`. N5's first axis is the fastest one: x.
Source: Zarr specification, versions 2 and 3; N5 specification (github.com/saalfeldlab/n5), and
n5-viewer for `downsamplingFactors`.
"""

from __future__ import annotations

import base64
import functools
import os
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...base.image_info import ImageInfo
from ...base.named_axes import ask_axes, axes_placement, even_steps, named_axes
from ...base.units import spacing_of
from ..cf_source import CfSource, cf_fields, unpack_coordinates
from ..source import Index, VolumeSource
from ..stores.chunk_files import ChunkFiles, begin_read, files_of
from ..stores.ngff import read_json_file
from ..stores.store_layout import is_number
from ..stores.tensorstores import Deadline, kvstore, opened_at
from .format import Format, not_chosen

_READ_TIMEOUT = 600.0  # seconds for one read
_OPEN_TIMEOUT = 20.0
_MAX_FOLDERS = 10_000
_METADATA_FILES = (("zarr3", "zarr.json"), ("zarr", ".zarray"), ("n5", "attributes.json"))


@dataclass(frozen=True, kw_only=True)
class ChunkedSource(CfSource):
    """A Zarr or N5 array."""

    driver: str
    folder: str

    def read_stored(self, index: Index) -> np.ndarray:
        array, files = _open_array(self.driver, self.folder, self.opened)
        values = Deadline(_READ_TIMEOUT).wait(begin_read(array[index], files), self.folder)
        return self.unpack(values)


@functools.lru_cache(maxsize=8)
def _open_array(driver: str, folder: str, _opened: int) -> tuple[Any, ChunkFiles]:
    future = opened_at(kvstore(folder), {"driver": driver})
    array = Deadline(_OPEN_TIMEOUT).wait(future, folder)
    return array, files_of(folder, array)


def _describe_array(folder: str) -> tuple[str, dict[str, Any]] | None:
    """Returns the driver and the metadata of an array; None for anything else."""
    for driver, name in _METADATA_FILES:
        file = Path(folder) / name
        if file.is_file():
            metadata = read_json_file(file)
            is_array = driver == "zarr" or metadata.get("node_type") == "array"
            return (driver, metadata) if is_array or "dimensions" in metadata else None
    return None


def _read_attributes(folder: str) -> dict[str, Any]:
    """Returns the user attributes of an array or a group."""
    for name, key in (("zarr.json", "attributes"), (".zattrs", ""), ("attributes.json", "")):
        file = Path(folder) / name
        if file.is_file():
            metadata = read_json_file(file)
            attributes = metadata.get(key, {}) if key else metadata
            return attributes if isinstance(attributes, dict) else {}
    return {}


def _array_names(folder: str) -> list[str]:
    """Returns the names of the arrays below a group that have three or more axes."""
    names, visited = [], 0
    for subfolder, folders, _ in os.walk(folder):
        visited += 1
        if visited > _MAX_FOLDERS:
            break
        if (description := _describe_array(subfolder)) is not None:
            folders.clear()  # these hold chunks
            shape = description[1].get("shape", description[1].get("dimensions", ()))
            if isinstance(shape, list) and len(shape) >= 3:
                names.append(os.path.relpath(subfolder, folder))
        folders.sort()
    return names


def _is_zarr_group(path: str) -> bool:
    """Returns whether a path is a Zarr array, or a group of arrays that is no OME-NGFF image."""
    if "://" in path or not Path(path).is_dir():
        return False
    if not any((Path(path) / name).is_file() for name in ("zarr.json", ".zarray", ".zgroup")):
        return False
    try:
        if (description := _describe_array(path)) is not None:
            return description[0] != "n5"
        return not _is_image(path) and bool(_array_names(path))
    except (ValueError, OSError):
        return False  # the OME-Zarr format reports what is wrong


def _is_image(folder: str) -> bool:
    """Returns whether a folder is an OME-NGFF image, or a group of them."""
    image_keys = {"multiscales", "ome", "gvtorch", "bioformats2raw.layout", "plate", "well"}
    return bool(image_keys & set(_read_attributes(folder)))


@Format("Zarr", matches=_is_zarr_group, options=("key", "axes"))
def open_zarr_array(path: str, key: str | None = None, axes: str | None = None) -> VolumeSource:
    """Opens an array, or the array or OME-NGFF image `key` of a group, the only array if left out.
    `axes` as in `ask_axes`.
    """
    if key is not None and axes is None and _is_image(str(Path(path) / key.strip("/"))):
        from .ome_zarr import open_ome_zarr  # imported here, as its format comes after this one

        return open_ome_zarr(path, key.strip("/"))
    folder = _choose_array(path, key)
    driver, metadata = _describe_array(folder) or ("", {})
    source, shape = _open_source(path, driver, folder)
    attributes = _read_attributes(folder)
    names = metadata.get("dimension_names") or attributes.get("_ARRAY_DIMENSIONS")
    names = [str(name or "") for name in names] if isinstance(names, list) else []
    steps: list[tuple[float, float] | None] = [None] * len(shape)
    units: list[str | None] = [None] * len(shape)
    axis_order, dropped = None, list[str]()
    if len(names) == len(shape):
        axis_order = named_axes(names, shape) if axes is None else None
        for axis, name in enumerate(names):
            sibling = Path(folder).parent / name
            # The name of an axis must not be a path to another folder.
            if sibling.parent != Path(folder).parent or name == ".." or sibling == Path(folder):
                continue
            if (description := _describe_array(str(sibling))) is not None:
                coordinates, files = _open_array(description[0], str(sibling), source.opened)
                if coordinates.shape == (shape[axis],) and shape[axis] < 1 << 24:
                    future = begin_read(coordinates, files)
                    values = Deadline(_READ_TIMEOUT).wait(future, str(sibling))
                    packing = _read_attributes(str(sibling))
                    steps[axis] = even_steps(name, unpack_coordinates(values, packing), dropped)
                    units[axis] = str(packing.get("units", "")) or None
    axis_order = axis_order or ask_axes(path, shape, axes)
    placement, info_fields = axes_placement(axis_order, shape, steps, units, dropped)
    quantity = attributes.get("units")
    info = ImageInfo(quantity=quantity if isinstance(quantity, str) else None, **info_fields)
    placement |= cf_fields(np.dtype(source.stored), _with_fill_value(driver, metadata, attributes))
    return replace(source, axes=axis_order, info=info, dropped=tuple(dropped), **placement)


def _with_fill_value(
    driver: str, metadata: dict[str, Any], attributes: dict[str, Any]
) -> dict[str, Any]:
    """Returns the attributes of an array with `_FillValue` as a number. xarray stores it as the
    array's `fill_value` (version 2), or as bytes of a float64 in base64 (floats, version 3).
    """
    value = attributes.get("_FillValue")
    if value is None and driver == "zarr" and "_ARRAY_DIMENSIONS" in attributes:
        value = metadata.get("fill_value") or None  # 0 is that of arrays without missing values
    if isinstance(value, str):
        try:
            (value,) = struct.unpack("<d", base64.b64decode(value))
        except (ValueError, struct.error):
            value = None
    return attributes if value is None else attributes | {"_FillValue": value}


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
        folder, metadata = f"{path.rstrip('/')}/{key}" if key else path, {}
    else:
        folder = _choose_array(path, key)
        metadata = (_describe_array(folder) or ("", {}))[1]
    source, shape = _open_source(path, "n5", folder)
    axis_order = ask_axes(path, shape[::-1], axes)[::-1]
    return replace(source, axes=axis_order, **_n5_placement(metadata, axis_order))


def _choose_array(path: str, key: str | None) -> str:
    if key is None and _describe_array(path) is not None:
        return path
    if key is not None:
        folder = Path(path) / key.strip("/")
        if ".." not in Path(key).parts and _describe_array(str(folder)) is not None:
            return str(folder)
    names = _array_names(path)
    if key is None and len(names) == 1:
        return str(Path(path) / names[0])
    raise not_chosen(path, "array", names, key, " of three or more axes")


def _open_source(path: str, driver: str, folder: str) -> tuple[ChunkedSource, tuple[int, ...]]:
    """Returns the source of an array, without axes and position, and its shape."""
    fields: dict[str, Any] = {"path": path, "axes": "", "driver": driver, "folder": folder}
    source = ChunkedSource(shape=(), stored="u1", packed="u1", **fields)
    array, _ = _open_array(driver, folder, source.opened)
    dtype, shape = array.dtype.numpy_dtype, tuple(int(n) for n in array.shape)
    if dtype.kind not in "biuf":
        raise ValueError(f"{path}: values must be real numbers, got dtype {array.dtype.name}")
    return replace(source, shape=shape, stored=dtype.str, packed=dtype.str), shape


def _n5_placement(metadata: dict[str, Any], axis_order: str) -> dict[str, Any]:
    """Returns spacing, origin and info of an N5 array; `axis_order`: the fastest first."""
    rank = len(axis_order)
    sizes: Any = metadata.get("pixelResolution", metadata.get("resolution"))
    unit: Any = metadata.get("units", metadata.get("unit"))
    origin: Any = metadata.get("translate", metadata.get("offset"))
    if isinstance(sizes, dict):
        unit, sizes = sizes.get("unit", unit), sizes.get("dimensions")
    transform = metadata.get("transform")
    if isinstance(transform, dict):  # its lists are in C order
        sizes, origin = (list(transform.get(n) or [])[::-1] for n in ("scale", "translate"))
        unit = transform.get("units")
    unit = unit[0] if isinstance(unit, list) and unit else unit
    given = ((sizes, 1.0), (origin, 0.0), (metadata.get("downsamplingFactors"), 1.0))
    steps, starts, factors = (
        dict(zip(axis_order, _numbers_or_default(*values, rank), strict=True)) for values in given
    )
    voxel_size = [abs(steps.get(a, 1.0) * factors.get(a, 1.0)) for a in "xyz"]
    spacing, unit_name = spacing_of(voxel_size, [unit if isinstance(unit, str) else None] * 3)
    # A coarse voxel's centre is that of the fine ones in it: (f - 1) / 2 of them further.
    shifts = {a: (factors.get(a, 1.0) - 1) / 2 * abs(steps.get(a, 1.0)) for a in "xyz"}
    position = tuple(starts.get(a, 0.0) + shift for a, shift in shifts.items())
    return {"spacing": spacing, "origin": position, "info": ImageInfo(unit=unit_name)}


def _numbers_or_default(values: Any, default: float, count: int) -> list[float]:
    is_valid = isinstance(values, list) and len(values) == count and all(map(is_number, values))
    return [float(v) for v in values] if is_valid else [default] * count
