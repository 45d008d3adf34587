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
from .boxes import check_extent
from .image_info import ChannelInfo, ImageInfo
from .labels import check_narrowed
from .named_axes import ask_axes, axes_placement, even_steps, named_axes
from .units import spacing_of
from .volume import Volume, plain_tensor, to_numpy

#: Attributes by which NetCDF and HDF5 files specify how stored numbers map to values.
_PACKING_ATTRIBUTES = (
    "scale_factor",
    "add_offset",
    "_FillValue",
    "missing_value",
    "_Unsigned",
    "valid_range",
)
_ARRAY_PROTOCOLS = ("__array__", "__array_interface__", "__dlpack__")


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
    dropped: tuple[str, ...] = ()  # phrases: metadata that is not kept

    def grid(self, time: int) -> np.ndarray:
        """Returns a time point, (z, y, x, c), with axes that run backwards flipped."""
        index = [slice(0, n) for n in self.shape]
        if "t" in self.axes:
            index[self.axes.index("t")] = slice(time, time + 1)
        data = boxes.to_zyxc(self.read(tuple(index)), self.axes, "tzyxc")[0]
        return np.flip(data, tuple("zyx".index(axis) for axis in self.flips))

    def read(self, index: tuple[slice, ...]) -> np.ndarray:
        """Reads or computes a part of the array."""
        return np.asarray(self.data[index])

    @classmethod
    def of(cls, context: str, array: Any, axes: str | None = None) -> ArrayLike:
        """Returns the description of an array, reading its values only if necessary. `axes` has a
        letter for each axis, for arrays whose axes have no meaningful names.

        Raises:
            ValueError: It is not an array of real numbers, or `axes` is needed, or does not fit.
        """
        context = f"{context} ({type(array).__name__})"
        if hasattr(array, "data_vars"):
            variables = ", ".join(map(str, array.data_vars))
            raise ValueError(f"{context}: is a set of arrays, take one of them: {variables}")
        if isinstance(array, Tensor):
            array = to_numpy(plain_tensor(context, array))
        elif not hasattr(array, "shape") or not hasattr(array, "dtype"):
            array = _as_numpy(context, array)
        if isinstance(array, np.ma.MaskedArray):
            array = _fill_masked(context, array)
        elif isinstance(getattr(array, "_meta", None), np.ma.MaskedArray):
            raise ValueError(f"{context}: its parts are masked arrays: fill them first")
        shape = tuple(int(n) for n in array.shape)
        dtype = np.dtype(str(array.dtype)) if not isinstance(array.dtype, np.dtype) else array.dtype
        if dtype.kind not in "biuf":
            raise ValueError(f"{context}: data must hold real numbers, got dtype {dtype}")
        names, steps, units, dropped = _axis_metadata(array, len(shape))
        axis_letters = None if axes else named_axes(names, shape)
        axis_letters = axis_letters or ask_axes(context, shape, axes)
        placement, info_fields = axes_placement(axis_letters, shape, steps, units, dropped)
        attrs = _attributes(array)
        # A NaN differs from itself: it packs nothing.
        packing = [n for n in _PACKING_ATTRIBUTES if n in attrs and np.any(attrs[n] == attrs[n])]
        if packing:
            dropped = [*dropped, f"{', '.join(packing)}: values are taken as they are stored"]
        sizes = np.ravel(attrs.get("spacing", attrs.get("element_size_um", ()))).tolist()
        if not any(steps) and len(sizes) >= 3 and all(isinstance(n, (int, float)) for n in sizes):
            unit = "um" if "element_size_um" in attrs else str(attrs.get("unit", ""))
            placement["spacing"], info_fields["unit"] = spacing_of(sizes[-3:][::-1], [unit] * 3)
        width = shape[axis_letters.index("c")] if "c" in axis_letters else 1
        return cls(
            data=array,
            shape=shape,
            axes=axis_letters,
            dtype=dtype.str,
            lazy=_is_lazy(array),
            name=str(getattr(array, "name", None) or "") if hasattr(array, "coords") else "",
            info=ImageInfo(
                channels=_channel_infos(array, axis_letters, width),
                quantity=str(attrs["units"]) if isinstance(attrs.get("units"), str) else None,
                **info_fields,
            ),
            dropped=tuple(dropped),
            **placement,
        )


def as_volume(
    given: Any,
    *,
    axes: str | None = None,
    time: int | None = None,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    nan: float | None = None,
    context: str = "as_volume",
) -> Volume:
    """Returns an array of any library as a volume in memory.

    Args:
        given: A volume (returned as it is, with its own axes, time, spacing and origin), a tensor,
            or an array: NumPy, xarray (keeps names, coordinates and units of its axes), dask, zarr,
            h5py, or any object with `__array__`, `__array_interface__` or `__dlpack__`.
        axes: A letter among t c z y x for each axis, for axes without meaningful names. If left
            out, three axes are (z, y, x).
        time: Which time point, from 0; the first, with a warning, if left out where there are more.
        spacing: (x, y, z) world units; overrides the array's metadata.
        origin: (x, y, z) world position of the first voxel's centre; overrides the metadata.
        nan: Value for voxels that are NaN or infinite; they are an error if left out.
        context: The caller's name, for messages.

    Raises:
        ValueError: It is not an array of real numbers, does not fit into memory, or `axes` is
            needed, or does not fit.
    """
    if isinstance(given, Volume):
        own = {"axes": axes, "time": time or None, "spacing": spacing, "origin": origin}
        for name, value in own.items():
            if value is not None:
                raise ValueError(f"{context}: {name} is for arrays; a Volume has its own")
        return given
    first_time = 0 if time is None else time
    if isinstance(given, Tensor):
        axis_letters = ask_axes(context, given.shape, axes)
        if axis_letters in ("zyx", "zyxc"):  # it stays on its device
            check.integer(context, "time", first_time, low=0, high=0)
            spacing = (1, 1, 1) if spacing is None else spacing
            return Volume(given, spacing, (0, 0, 0) if origin is None else origin, nan=nan)
        axes = axis_letters
    array = ArrayLike.of(context, given, axes)
    times = array.shape[array.axes.index("t")] if "t" in array.axes else 1
    check_extent(context, [n for n, a in zip(array.shape, array.axes, strict=True) if a != "t"])
    if time is None and times > 1:
        warnings.warn(
            f"{context}: has {times} time points, this is the first; time=N takes another, up to "
            f"{times - 1}",
            stacklevel=2,
        )
    time_index = check.integer(context, "time", first_time, low=0, high=max(times - 1, 0))
    if array.dropped:
        warnings.warn(f"{context}: not kept: {'; '.join(array.dropped)}", stacklevel=2)
    return Volume(
        array.grid(time_index),
        array.spacing if spacing is None else spacing,
        array.origin if origin is None else origin,
        name=array.name or "volume",
        nan=nan,
        info=array.info,
    )


def _as_numpy(context: str, value: Any) -> np.ndarray:
    """Returns the NumPy array of an object that offers one."""
    if not any(hasattr(value, name) for name in _ARRAY_PROTOCOLS):
        raise ValueError(f"{context}: expected a volume or an array")
    try:
        return np.asarray(value)
    except Exception as error:
        raise ValueError(f"{context}: gives no array: {error}") from None


def _fill_masked(context: str, array: np.ma.MaskedArray) -> np.ndarray:
    """Returns the array with NaN where it is masked; integers become float32 if anything is."""
    data, gaps = np.asarray(array.data), np.ma.getmaskarray(array)
    if not gaps.any() or data.dtype.kind not in "biuf":
        return data
    if data.dtype.kind != "f":
        check_narrowed(context, data[~gaps])
        data = data.astype(np.float32)
    return np.where(gaps, data.dtype.type(np.nan), data)


def _is_lazy(array: Any) -> bool:
    variable = getattr(array, "variable", None)
    if variable is not None:
        return not getattr(variable, "_in_memory", True)
    return not isinstance(array, np.ndarray) and not any(
        hasattr(array, name) for name in ("__array_interface__", "__dlpack__")
    )


def _attributes(array: Any) -> dict[str, Any]:
    attrs = getattr(array, "attrs", None)
    return dict(attrs) if attrs is not None and hasattr(attrs, "keys") else {}


def _axis_metadata(
    array: Any, rank: int
) -> tuple[list[str], list[tuple[float, float] | None], list[str | None], list[str]]:
    """Returns each axis's name, coordinates (step and first) and unit, and notes on losses."""
    metadata = getattr(array, "metadata", None)  # zarr arrays have it
    dims: Any = getattr(array, "dims", None) or getattr(metadata, "dimension_names", None) or ()
    names = [str(name or "") for name in dims]
    if len(names) != rank or any("<" in name for name in names):  # h5py's dims are objects
        names = [""] * rank
    steps: list[tuple[float, float] | None] = [None] * rank
    units: list[str | None] = [None] * rank
    dropped: list[str] = []
    coords = getattr(array, "coords", {})
    for axis, name in enumerate(names):
        if name and name in coords:
            coordinate = coords[name]
            values, units[axis] = coordinate.values, str(coordinate.attrs.get("units", "")) or None
            if values.dtype.kind in "mM" and values.size:  # xarray turns times of NetCDF into dates
                values, units[axis] = (values - values[0]) / np.timedelta64(1, "s"), "second"
            steps[axis] = even_steps(name, values, dropped)
    return names, steps, units, dropped


def _channel_infos(array: Any, axis_letters: str, width: int) -> tuple[ChannelInfo, ...]:
    """Returns the names of channels: the coordinates of the axis c, if they are text."""
    if "c" not in axis_letters or not hasattr(array, "coords"):
        return ()
    name = array.dims[axis_letters.index("c")]
    if name not in array.coords:
        return ()
    channel_names = np.asarray(array.coords[name].values)
    if channel_names.dtype.kind not in "UOT" or channel_names.shape != (width,):
        return ()
    return tuple(ChannelInfo(name=str(channel_name)) for channel_name in channel_names)
