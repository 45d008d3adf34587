"""`ArrayLike`: arrays of other libraries (xarray, dask, zarr, h5py, NumPy, and any object with
`__array__`, `__array_interface__` or `__dlpack__`), by duck typing: only NumPy is imported.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from . import boxes, check
from .image_info import ChannelInfo, ImageInfo
from .labels import check_narrowed
from .named_axes import ask_axes, even_steps, named_axes, place_named
from .units import spacing_of
from .volume import Volume, check_extent

#: Attributes by which NetCDF and HDF5 files specify how stored numbers map to values.
_PACKED = ("scale_factor", "add_offset", "_FillValue", "missing_value", "_Unsigned", "valid_range")
_OFFERS = ("__array__", "__array_interface__", "__dlpack__")


@dataclass(frozen=True, kw_only=True)
class ArrayLike:
    """An array of numbers, and the metadata it carries."""

    data: Any = field(repr=False)
    shape: tuple[int, ...]
    axes: str  # a letter for each: t, c, z, y, x, or - for one of size 1 to drop
    dtype: str
    lazy: bool  # values are read or computed on access
    name: str = ""
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)  # x y z
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    flips: str = ""  # letters of axes that run backwards
    info: ImageInfo = field(default_factory=ImageInfo)
    lost: tuple[str, ...] = ()  # phrases: metadata that is not kept

    def grid(self, time: int) -> np.ndarray:
        """Returns a time point, (z, y, x, c), with axes that run backwards flipped."""
        data = self.read(
            tuple(
                slice(time, time + 1) if axis == "t" else slice(0, n)
                for axis, n in zip(self.axes, self.shape, strict=True)
            )
        )
        data = boxes.to_zyxc(data, self.axes, "tzyxc")[0]
        return np.flip(data, tuple("zyx".index(axis) for axis in self.flips))

    def read(self, index: tuple[slice, ...]) -> np.ndarray:
        """Reads or computes a part of the array."""
        return np.asarray(self.data[index])

    @classmethod
    def of(cls, where: str, given: Any, axes: str | None = None) -> ArrayLike:
        """Returns the description of an array, reading its values only if necessary. `axes` has a
        letter for each axis, for arrays whose axes have no meaningful names.

        Raises:
            ValueError: It is not an array of real numbers, or `axes` is needed, or does not fit.
        """
        where = f"{where} ({type(given).__name__})"
        if hasattr(given, "data_vars"):
            held = ", ".join(map(str, given.data_vars))
            raise ValueError(f"{where}: is a set of arrays, take one of them: {held}")
        if not hasattr(given, "shape") or not hasattr(given, "dtype"):
            given = _plain(where, given)
        if isinstance(given, np.ma.MaskedArray):
            given = _filled(where, given)
        elif isinstance(getattr(given, "_meta", None), np.ma.MaskedArray):
            raise ValueError(f"{where}: its parts are masked arrays: fill them first")
        shape = tuple(int(n) for n in given.shape)
        dtype = np.dtype(str(given.dtype)) if not isinstance(given.dtype, np.dtype) else given.dtype
        if dtype.kind not in "biuf":
            raise ValueError(f"{where}: data must hold real numbers, got dtype {dtype}")
        names, steps, units, lost = _described(given, len(shape))
        letters = None if axes else named_axes(names, shape)
        letters = letters or ask_axes(where, shape, axes)
        place, moments = place_named(letters, shape, steps, units)
        attrs = _attributes(given)
        packed = [n for n in _PACKED if n in attrs and np.any(attrs[n] == attrs[n])]  # no NaN
        if packed:
            lost = [*lost, f"{', '.join(packed)}: values are taken as they are stored"]
        sizes = np.ravel(attrs.get("spacing", attrs.get("element_size_um", ()))).tolist()
        if not any(steps) and len(sizes) >= 3 and all(isinstance(n, (int, float)) for n in sizes):
            unit = "um" if "element_size_um" in attrs else str(attrs.get("unit", ""))
            place["spacing"], moments["unit"] = spacing_of(sizes[-3:][::-1], [unit] * 3)
        width = shape[letters.index("c")] if "c" in letters else 1
        return cls(
            data=given,
            shape=shape,
            axes=letters,
            dtype=dtype.str,
            lazy=_is_lazy(given),
            name=str(getattr(given, "name", None) or "") if hasattr(given, "coords") else "",
            info=ImageInfo(
                channels=_channels(given, letters, width),
                quantity=str(attrs["units"]) if isinstance(attrs.get("units"), str) else None,
                **moments,
            ),
            lost=tuple(lost),
            **place,
        )


def as_volume(
    given: Any,
    *,
    axes: str | None = None,
    time: int | None = None,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    nan: float | None = None,
    where: str = "as_volume",
) -> Volume:
    """Returns an array of any library as a volume in memory.

    Args:
        given: A volume (returned as it is), a tensor, or an array: NumPy, xarray (keeps names,
            coordinates and units of its axes), dask, zarr, h5py, or any object with `__array__`,
            `__array_interface__` or `__dlpack__`.
        axes: A letter among t c z y x for each axis, for axes without meaningful names. If left
            out, three axes are (z, y, x).
        time: Which time point, from 0; the first, with a warning, if left out where there are more.
        spacing: (x, y, z) world units; overrides the array's metadata.
        origin: (x, y, z) world position of the first voxel's centre; overrides the metadata.
        nan: Value for voxels that are NaN or infinite; they are an error if left out.
        where: The caller's name, for messages.

    Raises:
        ValueError: It is not an array of real numbers, does not fit into memory, or `axes` is
            needed, or does not fit.
    """
    if isinstance(given, Volume):
        return given
    if isinstance(given, Tensor):
        letters = ask_axes(where, given.shape, axes)
        if letters in ("zyx", "zyxc"):  # not by way of NumPy, which lacks bfloat16
            return Volume(given, spacing or (1, 1, 1), origin or (0, 0, 0), nan=nan)
        found = ArrayLike.of(where, given.detach().cpu().numpy(), letters)
    else:
        found = ArrayLike.of(where, given, axes)
    times = found.shape[found.axes.index("t")] if "t" in found.axes else 1
    check_extent(where, [n for n, a in zip(found.shape, found.axes, strict=True) if a != "t"])
    if time is None and times > 1:
        warnings.warn(
            f"{where}: has {times} time points, this is the first; time=N takes another, up to "
            f"{times - 1}",
            stacklevel=2,
        )
    at = check.whole(where, "time", time or 0, low=0, high=max(times - 1, 0))
    if found.lost:
        warnings.warn(f"{where}: not kept: {'; '.join(found.lost)}", stacklevel=2)
    return Volume(
        found.grid(at),
        found.spacing if spacing is None else spacing,
        found.origin if origin is None else origin,
        name=found.name or "volume",
        nan=nan,
        info=found.info,
    )


def _plain(where: str, given: Any) -> np.ndarray:
    """Returns the NumPy array of an object that offers one."""
    if not any(hasattr(given, name) for name in _OFFERS):
        raise ValueError(f"{where}: expected a volume or an array")
    try:
        return np.asarray(given)
    except Exception as error:
        raise ValueError(f"{where}: gives no array: {error}") from None


def _filled(where: str, given: np.ma.MaskedArray) -> np.ndarray:
    """Returns the array with NaN where it is masked; integers become float32 if anything is."""
    data, gaps = np.asarray(given.data), np.ma.getmaskarray(given)
    if not gaps.any() or data.dtype.kind not in "biuf":
        return data
    if data.dtype.kind != "f":
        check_narrowed(where, data[~gaps])
        data = data.astype(np.float32)
    return np.where(gaps, data.dtype.type(np.nan), data)


def _is_lazy(given: Any) -> bool:
    variable = getattr(given, "variable", None)
    if variable is not None:
        return not getattr(variable, "_in_memory", True)
    return not isinstance(given, np.ndarray) and not any(
        hasattr(given, name) for name in ("__array_interface__", "__dlpack__")
    )


def _attributes(given: Any) -> dict[str, Any]:
    attrs = getattr(given, "attrs", None)
    return dict(attrs) if attrs is not None and hasattr(attrs, "keys") else {}


def _described(
    given: Any, rank: int
) -> tuple[list[str], list[tuple[float, float] | None], list[str | None], list[str]]:
    """Returns each axis's name, coordinates (step and first) and unit, and notes on losses."""
    metadata = getattr(given, "metadata", None)  # zarr arrays have it
    dims: Any = getattr(given, "dims", None) or getattr(metadata, "dimension_names", None) or ()
    names = [str(name or "") for name in dims]
    if len(names) != rank or any("<" in name for name in names):  # h5py's dims are objects
        names = [""] * rank
    steps: list[tuple[float, float] | None] = [None] * rank
    units: list[str | None] = [None] * rank
    lost = []
    coords = getattr(given, "coords", {})
    for at, name in enumerate(names):
        if name and name in coords:
            places = coords[name]
            values = np.asarray(places.values)
            steps[at], even = even_steps(values)
            units[at] = str(places.attrs.get("units", "")) or None
            if not even:
                lost.append(f"that coordinates along {name} are not evenly spaced")
    return names, steps, units, lost


def _channels(given: Any, letters: str, width: int) -> tuple[ChannelInfo, ...]:
    """Returns the names of channels: the coordinates of the axis c, if they are text."""
    if "c" not in letters or not hasattr(given, "coords"):
        return ()
    name = given.dims[letters.index("c")]
    if name not in given.coords:
        return ()
    words = np.asarray(given.coords[name].values)
    if words.dtype.kind not in "UOT" or words.shape != (width,):
        return ()
    return tuple(ChannelInfo(name=str(word)) for word in words)
