"""HDF5 and NetCDF 4, read with h5py: a data set of a file, `file.h5:/group/data`, by region.

The meaning and steps of axes come from dimension scales and CF attributes (NetCDF), `axistags`
(ilastik) and `element_size_um` (ImageJ, ilastik); else `axes` is needed, as for arrays.
Source: HDF5 dimension scales; CF conventions 1.11, 4 (axes).
"""

from __future__ import annotations

import json
import math
import os
import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...base.image_info import ChannelInfo, ImageInfo
from ...base.named_axes import ask_axes, axes_placement, even_steps, letter_of, named_axes
from ...base.units import spacing_of
from ..budget import check_beside
from ..cf_source import CfSource, cf_fields, text_of, unpack_coordinates
from ..source import Index
from .format import Format, not_chosen

_ENDINGS = (".h5", ".hdf5", ".hdf", ".he5", ".h5ad", ".ilp", ".nc", ".nc4", ".cdf")
_MAX_CHUNK_BYTES = 1 << 31
_MAX_DATASETS = 100_000
_VOLUME_QUALIFIER = " of three or more axes"  # the data sets that messages list
_MAX_LINKS = 16  # that lead to one another
_MAX_COORDINATES = 1 << 24  # of an axis; more are not read


@dataclass(frozen=True, kw_only=True)
class Hdf5Source(CfSource):
    """A data set."""

    name: str

    def read_stored(self, index: Index) -> np.ndarray:
        import h5py

        with h5py.File(self.path, "r") as file:
            return self.unpack(np.asarray(file[self.name][index]))


@Format("HDF5", *_ENDINGS, options=("key", "axes"), library="h5py")
def open_hdf5(path: str, key: str | None = None, axes: str | None = None) -> Hdf5Source:
    """Opens the data set `key` of a file, the only one of three or more axes if left out. `axes` as
    in `ask_axes`.
    """
    import h5py

    with open(path, "rb") as start:
        if re.match(rb"CDF[\1\2\5]", start.read(4)):
            raise ValueError(
                f"{path}: is a NetCDF file of the classic kind; nccopy -k nc4 {path} NEW.nc makes "
                "one of NetCDF 4, which can be read"
            )
    with h5py.File(path, "r") as file:
        if key is not None:
            _check_files(path, file, key)
        name = _choose_dataset(path, file, key)
        _check_files(path, file, name)
        dataset = file[name]
        _check_dataset(path, name, dataset)
        shape = tuple(int(n) for n in dataset.shape)
        axis_order, steps, units, dropped = _axes(path, dataset, shape, axes)
        sources = dataset.virtual_sources() if dataset.is_virtual else ()
        names = sorted({source.file_name for source in sources} - {"."})
        if missing := [name for name in names if not _other_files(path, name)]:
            dropped.append(f"{len(missing)} files that are not there, such as {missing[0]}")
        info = _info(dataset, axis_order, shape)
        value_fields = cf_fields(dataset.dtype, dataset.attrs)
        placement, info_fields = axes_placement(axis_order, shape, steps, units, dropped)
        element_size = np.ravel(dataset.attrs.get("element_size_um", ())).tolist()
        if info_fields["unit"] is None and len(element_size) == 3:
            placement["spacing"], info_fields["unit"] = spacing_of(element_size[::-1], ["um"] * 3)
    fields = {"path": path, "shape": shape, "axes": axis_order, "name": name, **value_fields}
    fields |= {"info": replace(info, **info_fields), "dropped": tuple(dropped), **placement}
    return Hdf5Source(**fields)


def _check_files(path: str, file: Any, name: str, links_left: int = _MAX_LINKS) -> None:
    """Raises ValueError if `name` leads to another file, by a link or by a virtual or external data
    set, that lies outside the folder of `path` or is no regular file, which may never end.
    """
    import h5py

    if not links_left:
        raise ValueError(f"{path}: {name} leads through more than {_MAX_LINKS} links")
    item = file["/"] if name.startswith("/") else file
    for part in name.split("/"):
        link = item.get(part, getlink=True) if part not in ("", ".") else None
        if isinstance(link, h5py.ExternalLink):
            _check_other_file(path, link.filename, link.path, links_left)
        elif isinstance(link, h5py.SoftLink):
            _check_files(path, item, link.path, links_left - 1)
        item = item.get(part) if link is not None else item
        if not isinstance(item, h5py.Group):
            break
    if isinstance(item, h5py.Dataset):
        _check_sources(path, item, links_left)


def _check_sources(path: str, dataset: Any, links_left: int = _MAX_LINKS) -> None:
    """Checks where the values of a data set of `path` lie, if that is elsewhere. Names with % are
    refused: HDF5 puts numbers there, so they stand for names that can't be checked here.
    """
    for file_name, *_ in dataset.external or ():
        _check_other_file(path, file_name, None, links_left)
    for source in dataset.virtual_sources() if dataset.is_virtual else ():
        if "%" in source.file_name + source.dset_name:
            raise ValueError(
                f"{path}: refers to {source.dset_name} of {source.file_name}; names with % "
                "are not read"
            )
        if source.file_name == ".":
            _check_files(path, dataset.file, source.dset_name, links_left - 1)
        else:
            _check_other_file(path, source.file_name, source.dset_name, links_left)


def _check_other_file(path: str, file_name: str, name: str | None, links_left: int) -> None:
    """Checks a file that `path` refers to, and those that it refers to. It must lie in the folder
    of `path` or below. HDF5 may find it there, or from the working directory: both are checked.
    """
    import h5py

    for candidate in _other_files(path, file_name):
        check_beside(path, candidate)
        if name is not None:
            with h5py.File(candidate, "r") as file:
                _check_files(candidate, file, name, links_left - 1)


def _other_files(path: str, file_name: str) -> list[str]:
    """Returns where HDF5 may find a file that `path` refers to."""
    folder = os.path.realpath(os.path.dirname(path))
    candidates = {os.path.join(folder, file_name), os.path.abspath(file_name)}
    return [candidate for candidate in candidates if os.path.lexists(candidate)]


def _choose_dataset(path: str, file: Any, key: str | None) -> str:
    import h5py

    if key is not None:
        if isinstance(file.get(key), h5py.Dataset):
            return key
        if not isinstance(file.get(key), h5py.Group):
            raise not_chosen(path, "data set", [*_volumes(file)], key, _VOLUME_QUALIFIER)
        names = {f"{key.rstrip('/')}/{name}": text for name, text in _volumes(file[key]).items()}
    else:
        names = _volumes(file)
    if len(names) == 1:
        return next(iter(names))
    listed = [f"{path}:/{name.strip('/')} {text}" for name, text in names.items()]
    raise not_chosen(path, "data set", listed, None, _VOLUME_QUALIFIER)


def _volumes(group: Any) -> dict[str, str]:
    """Returns the numeric data sets of three or more axes: shape and dtype, as text, by name."""
    import h5py

    datasets: dict[str, str] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim >= 3 and item.dtype.kind in "biuf":
            if len(datasets) < _MAX_DATASETS:
                datasets[name] = f"({', '.join(map(str, item.shape))}) {item.dtype}"

    group.visititems(visit)
    return datasets


def _check_dataset(path: str, name: str, dataset: Any) -> None:
    if dataset.dtype.kind not in "biuf":
        raise ValueError(f"{path}: {name} must hold real numbers, got dtype {dataset.dtype}")
    if dataset.ndim < 2:
        raise ValueError(f"{path}: {name} must have 2 to 5 axes, got shape {dataset.shape}")
    chunk_bytes = math.prod(dataset.chunks or (1,)) * dataset.dtype.itemsize
    if chunk_bytes > _MAX_CHUNK_BYTES:
        raise ValueError(
            f"{path}: a chunk of {name} takes {chunk_bytes} bytes, more than {_MAX_CHUNK_BYTES}"
        )
    if dataset.chunks is None and dataset.external is None and not dataset.is_virtual:
        stored_bytes = dataset.id.get_storage_size()
        if stored_bytes and stored_bytes < dataset.nbytes:
            raise ValueError(
                f"{path}: {name} takes {dataset.nbytes} bytes, the file has {stored_bytes}"
            )


def _axes(
    path: str, dataset: Any, shape: tuple[int, ...], axes: str | None
) -> tuple[str, list[tuple[float, float] | None], list[str | None], list[str]]:
    """Returns letter, (step, first position) and unit of each axis, and metadata not kept."""
    rank = len(shape)
    names: list[str] = [""] * rank
    steps: list[tuple[float, float] | None] = [None] * rank
    units: list[str | None] = [None] * rank
    dropped: list[str] = []
    for axis, dimension in enumerate(dataset.dims):
        scale = dimension[0] if len(dimension) else None
        attributes = dict(scale.attrs) if scale is not None else {}
        names[axis] = str(dimension.label or (scale.name.rpartition("/")[2] if scale else ""))
        kinds = (text_of(attributes.get(name)).lower() for name in ("axis", "standard_name"))
        kind = next(filter(None, kinds), "")
        if kind == "height" or text_of(attributes.get("positive")):  # vertical, see CF, 4.3
            kind = "z"
        names[axis] = kind if letter_of(kind) != "?" else names[axis]
        units[axis] = text_of(attributes.get("units")) or None
        note = text_of(attributes.get("NAME"))
        if scale is None or note.startswith("This is a netCDF dimension but not"):
            continue
        _check_sources(path, scale)
        is_fitting = scale.shape == shape[axis : axis + 1] and scale.dtype.kind in "iuf"
        if is_fitting and shape[axis] <= _MAX_COORDINATES:
            coordinates = unpack_coordinates(scale[()], attributes)
            steps[axis] = even_steps(names[axis], coordinates, dropped)
    tags = _tags(dataset)
    if len(tags) == rank:
        names = [str(tag.get("key", "")) for tag in tags]
        for axis, tag in enumerate(tags):
            size = tag.get("resolution")
            is_positive = isinstance(size, (int, float)) and size > 0
            steps[axis] = (float(size), 0.0) if is_positive else None
    axis_order = named_axes(names, shape) if axes is None else None
    if axis_order is None and axes is None and rank > 3 and set(shape[:-3]) == {1}:
        axis_order = "-" * (rank - 3) + "zyx"
    context = f"{path}:/{dataset.name.strip('/')}"
    return axis_order or ask_axes(context, shape, axes), steps, units, dropped


def _tags(dataset: Any) -> list[Any]:
    """Returns ilastik's `axistags`, one for each axis."""
    try:
        axistags = json.loads(text_of(dataset.attrs.get("axistags")) or "{}")
    except ValueError:
        return []
    tags = axistags.get("axes") if isinstance(axistags, dict) else None
    return tags if isinstance(tags, list) and all(isinstance(tag, dict) for tag in tags) else []


def _info(dataset: Any, axis_order: str, shape: tuple[int, ...]) -> ImageInfo:
    """Returns quantity and channel names from the attributes."""
    quantity, name = (text_of(dataset.attrs.get(key)) for key in ("units", "long_name"))
    width = shape[axis_order.index("c")] if "c" in axis_order else 1
    names = np.ravel(dataset.attrs.get("channel_names", ())).tolist()
    channels = tuple(ChannelInfo(name=text_of(n)) for n in names) if len(names) == width else ()
    if not channels and width == 1 and name:
        channels = (ChannelInfo(name=name),)
    return ImageInfo(quantity=quantity or None, channels=channels)
