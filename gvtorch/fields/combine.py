"""Fields made of fields: warped, masked, blended, painted, or stacked as channels.

Bounds are computed from those of the parts by interval arithmetic (Moore, "Interval analysis",
1966). Any part may have numbers that change with time: see `Producer.time`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn

from .distance import HASH, Changed, Distance, grown
from .field import Bounds, Field, Interval, Values, between, checked_field
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


class Warp(Field):
    """A field evaluated at points that another field displaces."""

    def __init__(self, field: nn.Module, way: nn.Module, most: float) -> None:
        """Sets the field and the displacement.

        Args:
            field: The field that is evaluated.
            way: Returns displacements (..., 3), which are added to points (..., 3).
            most: World units to which longer displacements are shortened, so that bounds can be
                those of the field over a box grown by this on all sides.
        """
        super().__init__()
        self.field = checked_field("Warp", "field", field)
        self.way = checked_field("Warp", "way", way)
        self.most = self.number("most", most, low=0)
        if isinstance(field, Field) and not field.prefiltered:
            self.threshold, self.dtypes = field.threshold, field.dtypes

    def forward(self, points: Tensor) -> Values:
        way = self.way(points)
        size = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
        return self.field(points + way * (self.most / size.clamp(min=1e-30)).clamp(max=1))

    def bounds(self, center: Tensor, half: Tensor) -> Bounds:
        return _known(self.field, center, half + self.most, None)

    def near(self, center: Tensor, half: Tensor) -> Self:
        return self.replaced(field=_near(self.field, center, half + self.most))

    def alike(self, center: Tensor, half: Tensor) -> Tensor:
        return _alike((self.field,), center, half + self.most)

    def box(self) -> Tensor | None:
        return grown(self.field.box() if isinstance(self.field, Field) else None, self.most)


class Stack(Field):
    """Several fields as the channels of one."""

    def __init__(self, **fields: nn.Module) -> None:
        """Takes fields by the names of their channels. If a field itself has named channels, their
        names are appended, as in "rock_rgba".
        """
        super().__init__()
        if not fields:
            raise ValueError("Stack: needs a field by name")
        self.fields = nn.ModuleDict(
            {name: checked_field("Stack", name, one) for name, one in fields.items()}
        )
        self.prefiltered = _prefiltered("Stack", fields.values())

    def forward(self, points: Tensor) -> Mapping[str, Tensor]:
        return _flat({name: field(points) for name, field in self.fields.items()})

    def filtered(self, points: Tensor, size: Tensor) -> Mapping[str, Tensor]:
        """Returns means; fields that are not prefiltered are evaluated at the voxels' centres."""
        return _flat({name: _ask(field, points, size) for name, field in self.fields.items()})

    def bounds(self, center: Tensor, half: Tensor) -> Mapping[str, Interval]:
        return self.filtered_bounds(center, half, None)

    def filtered_bounds(
        self, center: Tensor, half: Tensor, size: Tensor | None
    ) -> Mapping[str, Interval]:
        known = {n: _known(field, center, half, size) for n, field in self.fields.items()}
        return _flat({name: found for name, found in known.items() if found is not None})

    def near(self, center: Tensor, half: Tensor) -> Self:
        near = {name: _near(field, center, half) for name, field in self.fields.items()}
        return self.replaced(fields=nn.ModuleDict(near))

    def alike(self, center: Tensor, half: Tensor) -> Tensor:
        return _alike(self.fields.values(), center, half)


class Blend(Field):
    """The first field where a mask is 0, the second where it is 1, and a mix in between."""

    def __init__(self, first: nn.Module, second: nn.Module, mask: nn.Module) -> None:
        """Takes two fields of the same channels, and a mask of one value, such as the density of a
        `Solid`; a `Distance` is converted to such a density.
        """
        super().__init__()
        where = type(self).__name__
        self.first = checked_field(where, "first", first)
        self.second = checked_field(where, "second", second)
        mask = Solid(mask, colors=False) if isinstance(mask, Distance) else mask
        self.mask = checked_field(where, "mask", mask)
        self.prefiltered = _prefiltered(where, (first, second, mask))

    def forward(self, points: Tensor) -> Values:
        return self._mix(lambda part: part(points))

    def filtered(self, points: Tensor, size: Tensor) -> Values:
        """Mixes means; fields that are not prefiltered are evaluated at the voxels' centres."""
        return self._mix(lambda part: _ask(part, points, size))

    def _mix(self, ask: Callable[[nn.Module], Values]) -> Values:
        first, second, share = ask(self.first), ask(self.second), _single(ask(self.mask))
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            return {name: _mixed(one, second[name], share) for name, one in first.items()}
        return _mixed(_single(first), _single(second), share)

    def bounds(self, center: Tensor, half: Tensor) -> Bounds:
        return self.filtered_bounds(center, half, None)

    def filtered_bounds(self, center: Tensor, half: Tensor, size: Tensor | None) -> Bounds:
        """Returns the hull of both fields' bounds; one field's where the mask is known 0 or 1."""
        found = [_known(part, center, half, size) for part in (self.first, self.second)]
        if found[0] is None or found[1] is None:
            return None
        low, high = self._shares(center, half, size)
        if isinstance(found[0], Mapping) and isinstance(found[1], Mapping):
            both = {*found[0]} & {*found[1]}
            return {n: between(found[0][n], found[1][n], low, high) for n in both}
        if isinstance(found[0], Mapping) or isinstance(found[1], Mapping):
            return None
        return between(found[0], found[1], low, high)

    def _shares(self, center: Tensor, half: Tensor, size: Tensor | None) -> Interval:
        """Returns the mask's bounds (k,) in boxes; 0 to 1 if they are unknown."""
        known = _known(self.mask, center, half, size)
        if isinstance(known, Mapping):
            known = next(iter(known.values())) if len(known) == 1 else None
        none = torch.zeros_like(center[:, 0])
        low, high = (none, none + 1) if known is None else known
        return low.reshape(len(none)), high.reshape(len(none))

    def near(self, center: Tensor, half: Tensor) -> Self:
        parts = {"first": self.first, "second": self.second, "mask": self.mask}
        return self.replaced(**{n: _near(part, center, half) for n, part in parts.items()})

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

    def _mix(self, ask: Callable[[nn.Module], Values]) -> Values:
        values, share = ask(self.first), _single(ask(self.mask))
        if isinstance(values, Mapping):
            return {n: _mixed(torch.zeros_like(v), v, share) for n, v in values.items()}
        return _mixed(torch.zeros_like(values), values, share)

    def filtered_bounds(self, center: Tensor, half: Tensor, size: Tensor | None) -> Bounds:
        """Returns 0 where the mask is 0, the field's bounds where it is 1, else their hull."""
        low, high = self._shares(center, half, size)
        found = _known(self.first, center, half, size)
        if found is None:  # even without bounds of the field, it is 0 where the mask is
            wild = torch.full_like(center[:, 0], torch.inf)
            found = (-wild, wild)
        if isinstance(found, Mapping):
            return {n: between(_zero(one), one, low, high) for n, one in found.items()}
        return between(_zero(found), found, low, high)


def _zero(interval: Interval) -> Interval:
    return torch.zeros_like(interval[0]), torch.zeros_like(interval[1])


def _prefiltered(where: str, parts: Iterable[nn.Module]) -> bool:
    """Returns whether any part is prefiltered; ValueError if one needs a margin for that."""
    fields = [part for part in parts if isinstance(part, Field)]
    if any(field.margin for field in fields):
        raise ValueError(f"{where}: takes no field with a margin, such as a Solid of differences")
    return any(field.prefiltered for field in fields)


def _ask(part: nn.Module, points: Tensor, size: Tensor) -> Values:
    """Returns the means over voxels if the part is prefiltered, else the values at centres."""
    if isinstance(part, Field) and part.prefiltered:
        return part.filtered(points, size)
    return part(points)


def _known(part: nn.Module, center: Tensor, half: Tensor, size: Tensor | None) -> Bounds:
    """Returns bounds of a part's values, or, if prefiltered, of its means over voxels of `size`."""
    if not isinstance(part, Field):
        return None
    if size is None or not part.prefiltered:
        return part.bounds(center, half)
    return part.filtered_bounds(center, half, size)


def _near(part: nn.Module, center: Tensor, half: Tensor) -> nn.Module:
    """Returns a part reduced to what matters in boxes; see `Field.near`."""
    return part.near(center, half) if isinstance(part, Field) else part


def _alike(parts: Iterable[nn.Module], center: Tensor, half: Tensor) -> Tensor:
    """Returns numbers (k,), equal for boxes in which each part's are equal; see `Field.alike`."""
    found = torch.zeros_like(center[:, 0], dtype=torch.int64)
    for part in parts:
        found = found * HASH + (part.alike(center, half) if isinstance(part, Field) else 0)
    return found


def _single(values: Values) -> Tensor:
    """Returns the values of the only channel; ValueError if there are several."""
    if isinstance(values, Mapping):
        if len(values) != 1:
            raise ValueError(f"Blend: needs one channel, got {', '.join(values)}")
        (values,) = values.values()
    return values


def _flat(by_name: Mapping[str, Any]) -> dict[str, Any]:
    """Flattens channels within channels: {"a": {"b": x}} becomes {"a_b": x}."""
    flat: dict[str, Any] = {}
    for name, values in by_name.items():
        if isinstance(values, Mapping):
            flat |= {f"{name}_{channel}": one for channel, one in values.items()}
        else:
            flat[name] = values
    return flat


def _mixed(first: Tensor, second: Tensor, share: Tensor) -> Tensor:
    """Mixes two values (...,) or (..., c) by a share (...,) of the second, clamped to [0, 1]."""
    share = share.clamp(0, 1)
    if first.dim() < share.dim():
        share = share[..., 0]
    elif first.dim() > share.dim():
        share = share[..., None]
    return torch.lerp(first, second, share)
