"""`CfSource`: a volume of numbers that are packed (scaled and shifted to small integers), or that
mean missing values, by the attributes of their array: in NetCDF 4, HDF5 and Zarr.

Source: CF Conventions 1.11, sections 2.5.1 and 8.1; `_Unsigned` is of the NetCDF Users' Guide,
appendix A.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from ..base.labels import check_narrowed
from .source import VolumeSource


@dataclass(frozen=True, kw_only=True)
class CfSource(VolumeSource):
    """A volume of packed values; `cf_fields` makes the fields."""

    packed: str  # dtype of the values in the file, according to its attributes
    scale: tuple[float, float] | None = None  # factor and offset of packed values
    missing: tuple[float, ...] = ()  # packed values that mean missing
    valid: tuple[float, float] = (-math.inf, math.inf)  # packed values outside are missing

    def as_labels(self) -> Self:
        """See `VolumeSource`; unless values are scaled, those that mean missing become labels."""
        source = super().as_labels()
        if self.scale:
            return source
        return replace(source, missing=(), valid=(-math.inf, math.inf), stored=self.packed)

    def unpack(self, data: np.ndarray) -> np.ndarray:
        """Returns the values of packed ones, as `stored`; missing ones become NaN."""
        if data.dtype.kind in "iu":
            data = data.view(self.packed)
        low, high = self.valid
        if self.scale is None and not self.missing and (low, high) == (-math.inf, math.inf):
            return data
        values = data * np.float64(self.scale[0]) + self.scale[1] if self.scale else data
        is_missing = (data < low) | (data > high)
        for value in self.missing:
            is_missing |= data == value
        if not self.scale:
            check_narrowed(self.path, data[~is_missing])
        values = np.asarray(values).astype(self.stored)
        values[is_missing] = np.nan
        return values


def cf_fields(dtype: np.dtype, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns `packed`, `scale`, `missing`, `valid` and `stored` for the source of an array."""
    packed, unsigned = dtype, text_of(attributes.get("_Unsigned")).lower()
    is_integer, sign_stated = dtype.kind in "iu", unsigned in ("true", "false")
    if is_integer and sign_stated:
        packed = np.dtype(packed.str.replace(packed.kind, "u" if unsigned == "true" else "i"))

    def numbers(name: str) -> list[float]:
        values = np.ravel(attributes.get(name, ()))
        if is_integer and sign_stated and values.dtype.kind in "iu":
            values = values.astype(packed)
        return values.tolist() if values.dtype.kind in "iuf" else []

    def number(name: str, default: float) -> float:
        values = numbers(name)
        return values[0] if len(values) == 1 else default

    factor, offset = number("scale_factor", math.nan), number("add_offset", math.nan)
    scale = None
    if not math.isnan(factor) or not math.isnan(offset):
        scale = (1.0 if math.isnan(factor) else factor, 0.0 if math.isnan(offset) else offset)
    missing_values = {number("_FillValue", math.nan), *numbers("missing_value")}
    missing = tuple(sorted(v for v in missing_values if not math.isnan(v)))
    valid = numbers("valid_range")
    if len(valid) != 2:
        valid = [number("valid_min", -math.inf), number("valid_max", math.inf)]
    if is_integer and valid[0] <= np.iinfo(packed).min:  # no value lies beyond
        valid[0] = -math.inf
    if is_integer and valid[1] >= np.iinfo(packed).max:
        valid[1] = math.inf
    stored = packed.str
    if scale or missing or valid != [-math.inf, math.inf]:
        stored = "float64" if packed.kind == "f" and packed.itemsize > 4 else "float32"
    fields = {"packed": packed.str, "scale": scale, "missing": missing, "stored": stored}
    return {**fields, "valid": tuple(valid)}


def unpack_coordinates(values: np.ndarray, attributes: Mapping[str, Any]) -> np.ndarray:
    """Returns the coordinates along an axis, which may be packed as other values are."""
    fields = cf_fields(values.dtype, attributes)
    if (scale := fields["scale"]) is None or values.dtype.kind not in "iuf":
        return values
    return values.view(fields["packed"]) * np.float64(scale[0]) + scale[1]


def text_of(value: Any) -> str:
    """Returns an attribute as text; "" if it is none, or holds several values."""
    if isinstance(value, np.ndarray):
        value = value.ravel()[0] if value.size == 1 else ""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value or "")
