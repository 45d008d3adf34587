"""Fields made of fields: warped, masked, blended, painted, put side by side.

What an interval of the parts tells of the whole is worked out by interval arithmetic (Moore,
"Interval analysis", 1966). Any of the parts may have numbers that change with time: see
`FieldProducer.changed`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from ..base import check
from .distance import Distance
from .field import Bounds, Field, Interval, Values


class Painted(Distance):
    """A shape coloured by a field of linear red, green and blue, 0 to 1."""

    def __init__(self, shape: Distance, colors: nn.Module) -> None:
        """Takes the shape and what gives (..., 3) colours at points (..., 3)."""
        super().__init__()
        self.shape = check.instance("Painted", "shape", shape, Distance)
        self.paint = check.instance("Painted", "colors", colors, nn.Module)
        self.exact, self.smooth = shape.exact, shape.smooth

    def forward(self, points: Tensor) -> Tensor:
        return self.shape(points)

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.shape(points), self.paint(points).clamp(0, 1)

    def slope(self, center: Tensor, half: Tensor) -> Tensor:
        return self.shape.slope(center, half)

    def bounds(self, center: Tensor, half: Tensor) -> Interval:
        return self.shape.bounds(center, half)

    def colors(self, center: Tensor, half: Tensor) -> Interval:
        return torch.zeros_like(center), torch.ones_like(center)

    def box(self) -> Tensor | None:
        return self.shape.box()


class Warp(Field):
    """A field asked at points that another field moves."""

    most: Tensor

    def __init__(self, field: nn.Module, way: nn.Module, most: float) -> None:
        """Takes the field, and how far points are moved.

        Args:
            field: What is asked.
            way: Gives (..., 3) that is added to points (..., 3).
            most: The way is made shorter where it is longer than this, in world units; so what is
                proven of a box that is so much wider holds.
        """
        super().__init__()
        self.field = check.instance("Warp", "field", field, nn.Module)
        self.way = check.instance("Warp", "way", way, nn.Module)
        self.number("most", most, low=0)
        if isinstance(field, Field) and not field.prefiltered:
            self.threshold, self.dtypes = field.threshold, field.dtypes

    def forward(self, points: Tensor) -> Values:
        way = self.way(points)
        size = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
        return self.field(points + way * (self.most / size.clamp(min=1e-30)).clamp(max=1))

    def bounds(self, center: Tensor, half: Tensor) -> Bounds:
        wide = half + self.most
        return self.field.bounds(center, wide) if isinstance(self.field, Field) else None

    def box(self) -> Tensor | None:
        box = self.field.box() if isinstance(self.field, Field) else None
        return None if box is None else torch.stack((box[0] - self.most, box[1] + self.most))


class Stack(Field):
    """Fields side by side, each a channel of its own, or several."""

    def __init__(self, **fields: nn.Module) -> None:
        """Takes fields by the name that their channel gets; the names of a field that gives several
        are put behind it, as in "rock_rgba".
        """
        super().__init__()
        if not fields:
            raise ValueError("Stack: needs a field by name")
        self.fields = nn.ModuleDict(
            {name: check.instance("Stack", name, one, nn.Module) for name, one in fields.items()}
        )

    def forward(self, points: Tensor) -> Mapping[str, Tensor]:
        return _flat({name: field(points) for name, field in self.fields.items()})

    def bounds(self, center: Tensor, half: Tensor) -> Mapping[str, Interval]:
        known = {}
        for name, field in self.fields.items():
            found = field.bounds(center, half) if isinstance(field, Field) else None
            if found is not None:
                known[name] = found
        return _flat(known)


class Blend(Field):
    """The one field where a mask is 0, the other where it is 1, and a mix between."""

    def __init__(self, first: nn.Module, second: nn.Module, mask: nn.Module) -> None:
        """Takes two fields of the same channels, and a mask of one value."""
        super().__init__()
        self.first = check.instance("Blend", "first", first, nn.Module)
        self.second = check.instance("Blend", "second", second, nn.Module)
        self.mask = check.instance("Blend", "mask", mask, nn.Module)

    def forward(self, points: Tensor) -> Values:
        first, second, share = self.first(points), self.second(points), self.mask(points)
        if isinstance(first, Mapping):
            return {name: _mixed(one, second[name], share) for name, one in first.items()}
        return _mixed(first, second, share)

    def bounds(self, center: Tensor, half: Tensor) -> Bounds:
        """What lies between both; one alone where the mask is known to be 0 or 1."""
        parts = (self.first, self.second)
        found = [part.bounds(center, half) if isinstance(part, Field) else None for part in parts]
        if found[0] is None or found[1] is None:
            return None
        share = self.mask.bounds(center, half) if isinstance(self.mask, Field) else None
        none = torch.zeros_like(center[:, 0])
        low, high = (none, none + 1) if share is None or isinstance(share, Mapping) else share
        if isinstance(found[0], Mapping) and isinstance(found[1], Mapping):
            both = {*found[0]} & {*found[1]}
            return {n: _between(found[0][n], found[1][n], low, high) for n in both}
        if isinstance(found[0], Mapping) or isinstance(found[1], Mapping):
            return None
        return _between(found[0], found[1], low, high)


class Mask(Blend):
    """A field where a mask is 1, and nothing, 0, where it is 0."""

    def __init__(self, field: nn.Module, mask: nn.Module) -> None:
        """Takes the field and a mask of one value."""
        super().__init__(_Nothing(field), field, mask)
        if isinstance(field, Field):
            self.threshold, self.dtypes = field.threshold, field.dtypes


class _Nothing(Field):
    """0 in all channels of a field."""

    def __init__(self, field: nn.Module) -> None:
        super().__init__()
        self.field = check.instance("Mask", "field", field, nn.Module)

    def forward(self, points: Tensor) -> Values:
        values = self.field(points)
        if isinstance(values, Mapping):
            return {name: torch.zeros_like(one) for name, one in values.items()}
        return torch.zeros_like(values)

    def bounds(self, center: Tensor, half: Tensor) -> Bounds:
        found = self.field.bounds(center, half) if isinstance(self.field, Field) else None
        if found is None:
            return None
        if isinstance(found, Mapping):
            return {n: (torch.zeros_like(a), torch.zeros_like(b)) for n, (a, b) in found.items()}
        return torch.zeros_like(found[0]), torch.zeros_like(found[1])


def _flat(by_name: Mapping[str, Any]) -> dict[str, Any]:
    """Channels of channels under one name."""
    flat: dict[str, Any] = {}
    for name, values in by_name.items():
        if isinstance(values, Mapping):
            flat |= {f"{name}_{channel}": one for channel, one in values.items()}
        else:
            flat[name] = values
    return flat


def _mixed(first: Tensor, second: Tensor, share: Tensor) -> Tensor:
    """Between two values (...,) or (..., c), by a share (...,), which is taken to 0 to 1."""
    share = share.clamp(0, 1)
    return torch.lerp(first, second, share if first.dim() == share.dim() else share[..., None])


def _between(first: Interval, second: Interval, low: Tensor, high: Tensor) -> Interval:
    """Of a mix of two intervals, by shares between low and high (k,)."""
    if first[0].dim() > low.dim():
        low, high = low[:, None], high[:, None]
    hull = torch.minimum(first[0], second[0]), torch.maximum(first[1], second[1])
    one, other = (
        torch.where(high <= 0, a, torch.where(low >= 1, b, both))
        for a, b, both in zip(first, second, hull, strict=True)
    )
    return one, other
