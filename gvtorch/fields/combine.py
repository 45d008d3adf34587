"""Fields made of fields: warped, masked, blended, painted, or stacked as channels.

Bounds are computed from those of the parts by interval arithmetic (Moore, "Interval analysis",
1966). Any part may have numbers that change with time: see `Producer.time`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn

from ..base import check
from .distance import HASH, Changed, Distance, grown
from .field import Bounds, Field, Interval, Values, between, checked_field, modules_by_name
from .solid import Solid


class Painted(Changed):
    """A shape coloured by a field of linear red, green and blue, 0 to 1."""

    def __init__(self, shape: Distance, colors: nn.Module) -> None:
        """Sets the shape, and the field that returns colours (..., 3) at points (..., 3)."""
        super().__init__(shape)
        self.paint = checked_field("Painted", "colors", colors)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.shape(points), self.paint(points).clamp(0, 1)

    def colors(self, center: Tensor, half: Tensor) -> Interval:
        return torch.zeros_like(center), torch.ones_like(center)

    def box(self) -> Tensor | None:
        return self.shape.box()

    def level_box(self, level: Tensor | float) -> Tensor | None:
        return self.shape.level_box(level)


class Warp(Field):
    """A field evaluated at points that another field displaces."""

    def __init__(self, field: nn.Module, offset: nn.Module, max_offset: float) -> None:
        """Sets the field and the displacement.

        Args:
            field: The field that is evaluated.
            offset: Returns displacements (..., 3), which are added to points (..., 3).
            max_offset: World units to which longer displacements are shortened, so that bounds can
                be those of the field over a box grown by this on all sides.
        """
        super().__init__()
        self.field = checked_field("Warp", "field", field)
        self.offset = checked_field("Warp", "offset", offset)
        self.max_offset = self.number("max_offset", max_offset, low=0)
        if isinstance(field, Field) and not field.prefiltered:
            self.threshold, self.dtypes = field.threshold, field.dtypes

    def forward(self, points: Tensor) -> Values:
        displacement = self.offset(points)
        if not isinstance(displacement, Tensor) or displacement.shape != points.shape:
            got = check.describe(displacement)
            raise ValueError(f"Warp: offset must give (..., 3) at (..., 3) points, got {got}")
        magnitude = torch.linalg.vector_norm(displacement, dim=-1, keepdim=True)
        scale = (self.max_offset / magnitude.clamp(min=1e-30)).clamp(max=1)
        return self.field(points + displacement * scale)

    def bounds(self, center: Tensor, half: Tensor) -> Bounds:
        return _bounds_of(self.field, center, half + self.max_offset, None)

    def near(self, center: Tensor, half: Tensor) -> Self:
        return self.replaced(field=_reduce(self.field, center, half + self.max_offset))

    def alike(self, center: Tensor, half: Tensor) -> Tensor:
        return _alike((self.field,), center, half + self.max_offset)

    def box(self) -> Tensor | None:
        return grown(self.field.box() if isinstance(self.field, Field) else None, self.max_offset)


class Stack(Field):
    """Several fields as the channels of one."""

    def __init__(self, **fields: nn.Module) -> None:
        """Takes fields by the names of their channels. If a field itself has named channels, their
        names are appended, as in "rock_rgba".
        """
        super().__init__()
        if not fields:
            raise ValueError("Stack: needs a field by name")
        self.fields = modules_by_name(
            "Stack", {name: checked_field("Stack", name, field) for name, field in fields.items()}
        )
        self.prefiltered = _prefiltered("Stack", fields.values())

    def forward(self, points: Tensor) -> Mapping[str, Tensor]:
        return _flatten({name: field(points) for name, field in self.fields.items()})

    def filtered(self, points: Tensor, size: Tensor) -> Mapping[str, Tensor]:
        """Returns means; fields that are not prefiltered are evaluated at the voxels' centres."""
        return _flatten({n: _evaluate(field, points, size) for n, field in self.fields.items()})

    def bounds(self, center: Tensor, half: Tensor) -> Mapping[str, Interval]:
        return self.filtered_bounds(center, half, None)

    def filtered_bounds(
        self, center: Tensor, half: Tensor, size: Tensor | None
    ) -> Mapping[str, Interval]:
        bounds = {n: _bounds_of(field, center, half, size) for n, field in self.fields.items()}
        return _flatten({n: known for n, known in bounds.items() if known is not None})

    def near(self, center: Tensor, half: Tensor) -> Self:
        parts = {name: _reduce(field, center, half) for name, field in self.fields.items()}
        return self.replaced(fields=nn.ModuleDict(parts))

    def alike(self, center: Tensor, half: Tensor) -> Tensor:
        return _alike(self.fields.values(), center, half)


class Blend(Field):
    """The first field where a mask is 0, the second where it is 1, and a mix in between."""

    def __init__(self, first: nn.Module, second: nn.Module, mask: nn.Module) -> None:
        """Takes two fields of the same channels, and a mask of one value, such as the density of a
        `Solid`; a `Distance` is converted to such a density.
        """
        super().__init__()
        context = type(self).__name__
        self.first = checked_field(context, "first", first)
        self.second = checked_field(context, "second", second)
        mask = Solid(mask, colors=False) if isinstance(mask, Distance) else mask
        self.mask = checked_field(context, "mask", mask)
        self.prefiltered = _prefiltered(context, (first, second, mask))

    def forward(self, points: Tensor) -> Values:
        return self._mix(lambda part: part(points))

    def filtered(self, points: Tensor, size: Tensor) -> Values:
        """Mixes means; fields that are not prefiltered are evaluated at the voxels' centres."""
        return self._mix(lambda part: _evaluate(part, points, size))

    def _mix(self, evaluate: Callable[[nn.Module], Values]) -> Values:
        first, second = evaluate(self.first), evaluate(self.second)
        fraction = _only_channel(evaluate(self.mask))
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            if first.keys() != second.keys():
                names = f"{', '.join(first)} and {', '.join(second)}"
                raise ValueError(f"Blend: both fields must have the same channels, got {names}")
            return {name: _mix_values(v, second[name], fraction) for name, v in first.items()}
        return _mix_values(_only_channel(first), _only_channel(second), fraction)

    def bounds(self, center: Tensor, half: Tensor) -> Bounds:
        return self.filtered_bounds(center, half, None)

    def filtered_bounds(self, center: Tensor, half: Tensor, size: Tensor | None) -> Bounds:
        """Returns the hull of both fields' bounds; one field's where the mask is known 0 or 1."""
        parts = (self.first, self.second)
        first, second = (_bounds_of(part, center, half, size) for part in parts)
        if first is None or second is None:
            return None
        low, high = self._mask_bounds(center, half, size)
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            return {n: between(first[n], second[n], low, high) for n in {*first} & {*second}}
        if isinstance(first, Mapping) or isinstance(second, Mapping):
            return None
        return between(first, second, low, high)

    def _mask_bounds(self, center: Tensor, half: Tensor, size: Tensor | None) -> Interval:
        """Returns the mask's bounds (k,) in boxes; 0 to 1 if they are unknown."""
        interval = _bounds_of(self.mask, center, half, size)
        if isinstance(interval, Mapping):
            interval = next(iter(interval.values())) if len(interval) == 1 else None
        zero = torch.zeros_like(center[:, 0])
        low, high = (zero, zero + 1) if interval is None else interval
        return low.reshape(len(zero)), high.reshape(len(zero))

    def near(self, center: Tensor, half: Tensor) -> Self:
        parts = {"first": self.first, "second": self.second, "mask": self.mask}
        return self.replaced(**{n: _reduce(part, center, half) for n, part in parts.items()})

    def alike(self, center: Tensor, half: Tensor) -> Tensor:
        return _alike(self.children(), center, half)


class Mask(Blend):
    """A field multiplied by a mask from 0 to 1. Where the mask is proven 0, nothing is made."""

    def __init__(self, field: nn.Module, mask: nn.Module) -> None:
        """Takes the field and a mask of one value; see `Blend`."""
        checked_field("Mask", "field", field)
        super().__init__(field, field, mask)
        if isinstance(field, Field):
            self.dtypes = field.dtypes

    def _mix(self, evaluate: Callable[[nn.Module], Values]) -> Values:
        values, fraction = evaluate(self.first), _only_channel(evaluate(self.mask))
        if isinstance(values, Mapping):
            return {n: _mix_values(torch.zeros_like(v), v, fraction) for n, v in values.items()}
        return _mix_values(torch.zeros_like(values), values, fraction)

    def filtered_bounds(self, center: Tensor, half: Tensor, size: Tensor | None) -> Bounds:
        """Returns 0 where the mask is 0, the field's bounds where it is 1, else their hull."""
        low, high = self._mask_bounds(center, half, size)
        field_bounds = _bounds_of(self.first, center, half, size)
        if field_bounds is None:  # even without bounds of the field, it is 0 where the mask is
            infinity = torch.full_like(center[:, 0], torch.inf)
            field_bounds = (-infinity, infinity)
        if isinstance(field_bounds, Mapping):
            return {n: between(_zero(ends), ends, low, high) for n, ends in field_bounds.items()}
        return between(_zero(field_bounds), field_bounds, low, high)


def _zero(interval: Interval) -> Interval:
    return torch.zeros_like(interval[0]), torch.zeros_like(interval[1])


def _prefiltered(context: str, parts: Iterable[nn.Module]) -> bool:
    """Returns whether any part is prefiltered; ValueError if one needs a margin for that."""
    fields = [part for part in parts if isinstance(part, Field)]
    if any(field.margin for field in fields):
        raise ValueError(f"{context}: takes no field with a margin, such as a Solid of differences")
    return any(field.prefiltered for field in fields)


def _evaluate(part: nn.Module, points: Tensor, size: Tensor) -> Values:
    """Returns the means over voxels if the part is prefiltered, else the values at centres."""
    if isinstance(part, Field) and part.prefiltered:
        return part.filtered(points, size)
    return part(points)


def _bounds_of(part: nn.Module, center: Tensor, half: Tensor, size: Tensor | None) -> Bounds:
    """Returns bounds of a part's values, or, if prefiltered, of its means over voxels of `size`."""
    if not isinstance(part, Field):
        return None
    if size is None or not part.prefiltered:
        return part.bounds(center, half)
    return part.filtered_bounds(center, half, size)


def _reduce(part: nn.Module, center: Tensor, half: Tensor) -> nn.Module:
    """Returns a part reduced to what matters in boxes; see `Field.near`."""
    return part.near(center, half) if isinstance(part, Field) else part


def _alike(parts: Iterable[nn.Module], center: Tensor, half: Tensor) -> Tensor:
    """Returns numbers (k,), equal for boxes in which each part's are equal; see `Field.alike`."""
    key = torch.zeros_like(center[:, 0], dtype=torch.int64)
    for part in parts:
        key = key * HASH + (part.alike(center, half) if isinstance(part, Field) else 0)
    return key


def _only_channel(values: Values) -> Tensor:
    """Returns the values of the only channel; ValueError if there are several."""
    if isinstance(values, Mapping):
        if len(values) != 1:
            raise ValueError(f"Blend: needs one channel, got {', '.join(values)}")
        (values,) = values.values()
    return values


def _flatten(by_name: Mapping[str, Any]) -> dict[str, Any]:
    """Flattens channels within channels: {"a": {"b": x}} becomes {"a_b": x}."""
    flat: dict[str, Any] = {}
    for name, values in by_name.items():
        channels = {name: values}
        if isinstance(values, Mapping):
            channels = {f"{name}_{inner}": value for inner, value in values.items()}
        if taken := flat.keys() & channels.keys():
            raise ValueError(f"Stack: two channels are named {min(taken)!r}")
        flat |= channels
    return flat


def _mix_values(first: Tensor, second: Tensor, fraction: Tensor) -> Tensor:
    """Mixes two values (...,) or (..., c) by a share (...,) of the second, clamped to [0, 1]."""
    fraction = fraction.clamp(0, 1)
    if first.dim() < fraction.dim():
        fraction = fraction[..., 0]
    elif first.dim() > fraction.dim():
        fraction = fraction[..., None]
    return torch.lerp(first, second, fraction)
