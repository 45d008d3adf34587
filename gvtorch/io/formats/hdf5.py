"""HDF5 and NetCDF 4, read with h5py: a data set of a file, `file.h5:/group/data`, by region.

The meaning and steps of axes come from dimension scales and CF attributes (NetCDF), `axistags`
(ilastik) and `element_size_um` (ImageJ, ilastik); else `axes` is needed, as for arrays.
Source: HDF5 dimension scales; CF conventions 1.11, 4 (axes) and 8.1 (packed data).
"""

from __future__ import annotations

import json
import math
import os
import re
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from ...base.image_info import ChannelInfo, ImageInfo
from ...base.labels import check_narrowed
from ...base.named_axes import ask_axes, even_steps, letter_of, named_axes, place_named
from ...base.units import spacing_of
from ..budget import check_beside
from ..source import Index, VolumeSource
from .format import Format, not_chosen

_ENDINGS = (".h5", ".hdf5", ".hdf", ".he5", ".h5ad", ".ilp", ".nc", ".nc4", ".cdf")
_MOST_CHUNK = 1 << 31  # bytes
_MOST_SETS = 100_000
_KIND = " of three or more axes"  # the data sets that messages list
_MOST_LINKS = 16  # that lead to one another
_MOST_PLACES = 1 << 24  # coordinates of an axis, above which they are not read


@dataclass(frozen=True, kw_only=True)
class Hdf5Source(VolumeSource):
    """A data set."""

    name: str
    packed: str  # dtype of the values in the file, according to its attributes
    scale: tuple[float, float] | None = None  # factor and offset of packed values
    missing: tuple[float, ...] = ()  # packed values that mean missing
    valid: tuple[float, float] = (-math.inf, math.inf)  # packed values outside are missing

    def as_labels(self) -> Self:
        """See `VolumeSource`; unless values are scaled, those that mean missing become labels."""
        found = super().as_labels()
        if self.scale:
            return found
        return replace(found, missing=(), valid=(-math.inf, math.inf), stored=self.packed)

    def read_stored(self, index: Index) -> np.ndarray:
        """Reads a part; packed values are unpacked, missing ones become NaN."""
        import h5py

        with h5py.File(self.path, "r") as file:
            data = np.asarray(file[self.name][index])
        if data.dtype.kind in "iu":
            data = data.view(self.packed)
        low, high = self.valid
        if self.scale is None and not self.missing and (low, high) == (-math.inf, math.inf):
            return data
        found = data * np.float64(self.scale[0]) + self.scale[1] if self.scale else data
        gaps = (data < low) | (data > high)
        for value in self.missing:
            gaps |= data == value
        if not self.scale:
            check_narrowed(self.path, data[~gaps])
        found = np.asarray(found).astype(self.stored)
        found[gaps] = np.nan
        return found


@Format("HDF5", *_ENDINGS, options=("key", "axes"), library="h5py")
def open_hdf5(path: str, key: str | None = None, axes: str | None = None) -> Hdf5Source:
    """Opens the data set `key` of a file, the only one of three or more axes if left out. `axes` as
    in `ask_axes`.
    """
    import h5py

    _check_kind(path)
    with h5py.File(path, "r") as file:
        if key is not None:
            _check_files(path, file, key)
        name = _choose(path, file, key)
        _check_files(path, file, name)
        data = file[name]
        _check(path, name, data)
        shape = tuple(int(n) for n in data.shape)
        letters, steps, units, lost = _axes(f"{path}:/{name.strip('/')}", data, shape, axes)
        info, values = _info(data, letters, shape), _values(data)
        place, moments = place_named(letters, shape, steps, units)
        sizes = np.ravel(data.attrs.get("element_size_um", ())).tolist()
        if moments["unit"] is None and len(sizes) == 3:
            place["spacing"], moments["unit"] = spacing_of(sizes[::-1], ["um"] * 3)
    info = replace(info, **moments)
    return Hdf5Source(
        path=path,
        shape=shape,
        axes=letters,
        name=name,
        **values,
        info=info,
        lost=tuple(lost),
        **place,
    )


def _check_kind(path: str) -> None:
    with open(path, "rb") as file:
        if re.match(rb"CDF[\1\2\5]", file.read(4)):
            raise ValueError(
                f"{path}: is a NetCDF file of the classic kind; nccopy -k nc4 {path} NEW.nc makes "
                "one of NetCDF 4, which can be read"
            )


def _check_files(path: str, file: Any, name: str, left: int = _MOST_LINKS) -> None:
    """Raises ValueError if `name` leads to another file, by a link or by a virtual or external data
    set, that lies outside the folder of `path` or is no regular file, which may never end.
    """
    import h5py

    if not left:
        raise ValueError(f"{path}: {name} leads through more than {_MOST_LINKS} links")
    at = file["/"] if name.startswith("/") else file
    for part in name.split("/"):
        link = at.get(part, getlink=True) if part not in ("", ".") else None
        if isinstance(link, h5py.ExternalLink):
            _check_other(path, link.filename, link.path, left)
        elif isinstance(link, h5py.SoftLink):
            _check_files(path, at, link.path, left - 1)
        at = at.get(part) if link is not None else at
        if not isinstance(at, h5py.Group):
            break
    if isinstance(at, h5py.Dataset):
        for other, *_ in at.external or ():
            _check_other(path, other, None, left)
        for source in at.virtual_sources() if at.is_virtual else ():
            if source.file_name != ".":
                _check_other(path, source.file_name, source.dset_name, left)


def _check_other(path: str, other: str, name: str | None, left: int) -> None:
    """Checks a file that `path` refers to, and those that it refers to. It must lie in the folder
    of `path` or below. HDF5 may find it there, or from the working directory: both are checked.
    """
    import h5py

    folder = os.path.realpath(os.path.dirname(path))
    for place in {os.path.join(folder, other), os.path.abspath(other)}:
        if not os.path.lexists(place):
            continue
        check_beside(path, place)
        if name is not None:
            with h5py.File(place, "r") as file:
                _check_files(place, file, name, left - 1)


def _choose(path: str, file: Any, key: str | None) -> str:
    import h5py

    if key is not None:
        if isinstance(file.get(key), h5py.Dataset):
            return key
        if not isinstance(file.get(key), h5py.Group):
            raise not_chosen(path, "data set", [*_volumes(file)], key, _KIND)
        names = {f"{key.rstrip('/')}/{name}": text for name, text in _volumes(file[key]).items()}
    else:
        names = _volumes(file)
    if len(names) == 1:
        return next(iter(names))
    listed = [f"{path}:/{name.strip('/')} {text}" for name, text in names.items()]
    raise not_chosen(path, "data set", listed, None, _KIND)


def _volumes(group: Any) -> dict[str, str]:
    """Returns the numeric data sets of three or more axes: shape and dtype, as text, by name."""
    import h5py

    found: dict[str, str] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim >= 3 and item.dtype.kind in "biuf":
            if len(found) < _MOST_SETS:
                found[name] = f"({', '.join(map(str, item.shape))}) {item.dtype}"

    group.visititems(visit)
    return found


def _check(path: str, name: str, data: Any) -> None:
    if data.dtype.kind not in "biuf":
        raise ValueError(f"{path}: {name} must hold real numbers, got dtype {data.dtype}")
    if data.ndim < 2:
        raise ValueError(f"{path}: {name} must have 2 to 5 axes, got shape {data.shape}")
    chunk = math.prod(data.chunks or (1,)) * data.dtype.itemsize
    if chunk > _MOST_CHUNK:
        raise ValueError(f"{path}: a chunk of {name} takes {chunk} bytes, more than {_MOST_CHUNK}")
    if data.chunks is None and data.external is None and not data.is_virtual:
        held = data.id.get_storage_size()
        need = math.prod(data.shape) * data.dtype.itemsize
        if held and held < need:
            raise ValueError(f"{path}: {name} takes {need} bytes, the file has {held}")


def _axes(
    where: str, data: Any, shape: tuple[int, ...], axes: str | None
) -> tuple[str, list[tuple[float, float] | None], list[str | None], list[str]]:
    """Returns letter, (step, first position) and unit of each axis, and metadata not kept."""
    rank = len(shape)
    names: list[str] = [""] * rank
    steps: list[tuple[float, float] | None] = [None] * rank
    units: list[str | None] = [None] * rank
    lost: list[str] = []
    for at, dimension in enumerate(data.dims):
        scale = dimension[0] if len(dimension) else None
        told = dict(scale.attrs) if scale is not None else {}
        names[at] = str(dimension.label or (scale.name.rpartition("/")[2] if scale else ""))
        kind = _text(told.get("axis")).lower() or _text(told.get("standard_name")).lower()
        names[at] = kind if letter_of(kind) != "?" else names[at]
        units[at] = _text(told.get("units")) or None
        if _text(told.get("NAME")).startswith("This is a netCDF dimension but not"):
            continue
        if scale is not None:
            _check_files(where, scale.file, scale.name or "/")
        if shape[at] > _MOST_PLACES:
            continue
        if scale is not None and scale.shape == shape[at : at + 1] and scale.dtype.kind in "iuf":
            steps[at], even = even_steps(scale[()])
            if not even:
                lost.append(f"that coordinates along {names[at]} are not evenly spaced")
    tags = _tags(data)
    if len(tags) == rank:
        names = [str(tag.get("key", "")) for tag in tags]
        for at, tag in enumerate(tags):
            size = tag.get("resolution")
            steps[at] = (float(size), 0.0) if isinstance(size, (int, float)) and size > 0 else None
    letters = named_axes(names, shape) if axes is None else None
    if letters is None and axes is None and rank > 3 and set(shape[:-3]) == {1}:
        letters = "-" * (rank - 3) + "zyx"
    return letters or ask_axes(where, shape, axes), steps, units, lost


def _tags(data: Any) -> list[Any]:
    """Returns ilastik's `axistags`, one for each axis."""
    try:
        found = json.loads(_text(data.attrs.get("axistags")) or "{}")
    except ValueError:
        return []
    tags = found.get("axes") if isinstance(found, dict) else None
    return tags if isinstance(tags, list) and all(isinstance(tag, dict) for tag in tags) else []


def _info(data: Any, letters: str, shape: tuple[int, ...]) -> ImageInfo:
    """Returns quantity and channel names from the attributes."""
    quantity, name = (_text(data.attrs.get(key)) for key in ("units", "long_name"))
    width = shape[letters.index("c")] if "c" in letters else 1
    names = np.ravel(data.attrs.get("channel_names", ())).tolist()
    channels = tuple(ChannelInfo(name=_text(n)) for n in names) if len(names) == width else ()
    if not channels and width == 1 and name:
        channels = (ChannelInfo(name=name),)
    return ImageInfo(quantity=quantity or None, channels=channels)


def _values(data: Any) -> dict[str, Any]:
    """Returns the fields `packed`, `scale`, `missing`, `valid` and `stored` of a source, from the
    attributes.

    Source: CF Conventions 1.11, sections 2.5.1 and 8.1; `_Unsigned` is of the NetCDF Users' Guide,
        appendix A.
    """
    packed, told = data.dtype, _text(data.attrs.get("_Unsigned")).lower()
    whole, other_sign = data.dtype.kind in "iu", told in ("true", "false")
    if whole and other_sign:
        packed = np.dtype(packed.str.replace(packed.kind, "u" if told == "true" else "i"))

    def numbers(name: str) -> list[float]:
        found = np.ravel(data.attrs.get(name, ()))
        if whole and other_sign and found.dtype.kind in "iu":
            found = found.astype(packed)
        return found.tolist() if found.dtype.kind in "iuf" else []

    def number(name: str, other: float) -> float:
        found = numbers(name)
        return found[0] if len(found) == 1 else other

    factor, offset = number("scale_factor", math.nan), number("add_offset", math.nan)
    scale = None
    if not math.isnan(factor) or not math.isnan(offset):
        scale = (1.0 if math.isnan(factor) else factor, 0.0 if math.isnan(offset) else offset)
    gaps = {number("_FillValue", math.nan), *numbers("missing_value")}
    missing = tuple(sorted(v for v in gaps if not math.isnan(v)))
    valid = numbers("valid_range")
    if len(valid) != 2:
        valid = [number("valid_min", -math.inf), number("valid_max", math.inf)]
    if whole and valid[0] <= np.iinfo(packed).min:  # no value lies beyond
        valid[0] = -math.inf
    if whole and valid[1] >= np.iinfo(packed).max:
        valid[1] = math.inf
    stored = packed.str
    if scale or missing or valid != [-math.inf, math.inf]:
        stored = "float64" if packed.kind == "f" and packed.itemsize > 4 else "float32"
    return {
        "packed": packed.str,
        "scale": scale,
        "missing": missing,
        "valid": tuple(valid),
        "stored": stored,
    }


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        value = value.ravel()[0] if value.size == 1 else ""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value or "")
