"""`Field`: values as a function of position, such as distances, noise or a small network. Fields
know no voxels, nodes or bricks; `FieldProducer` makes these from them.

Source of the intervals: Moore, "Interval analysis", 1966; Snyder, "Interval analysis for computer
    graphics", SIGGRAPH 1992 (with bounds over boxes, a function is sampled only where it matters).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Self

import torch
from torch import Tensor, nn

from ..base import check
from ..base.lasting import lasting
from ..base.own_dtypes import OwnDtypes

#: One value per point (...,), several (..., c), or these by channel.
Values = Tensor | Mapping[str, Tensor]
#: Smallest and largest value over each of k boxes, (k,) or (k, c) float64; infinite: not known.
Interval = tuple[Tensor, Tensor]
#: An interval, or intervals by channel without the unknown ones; None: nothing is known.
Bounds = Interval | Mapping[str, Interval] | None


class Field(OwnDtypes):
    """Base of fields. A subclass implements `forward`, and `bounds` if it can: bricks whose bounds
    prove that they show nothing need not be made.

    All methods are pure functions of tensors in torch: no shape depends on values and the host
    never waits, so that they can be compiled and recorded. Numbers that may change between
    pictures are buffers (see `number` and `vector`), edited in place. Buffers keep their dtypes,
    whatever dtype a net that contains the field is converted to; parameters follow.

    Attributes:
        prefiltered: Whether the field can compute means over voxels: `filtered` is then called once
            a voxel instead of sampling `forward` several times.
        threshold: By channel, the value up to which a voxel shows nothing: where all channels named
            here are proven to stay at or below theirs, nothing is made. None: every value counts.
        margin: How many voxels beyond its bricks a prefiltered field is evaluated, so that `finish`
            can read neighbours.
        dtypes: By channel, the dtype of voxels that suits it; float32 for others.
    """

    prefiltered: bool = False
    margin: int = 0
    dtypes: Mapping[str, torch.dtype] = MappingProxyType({})
    threshold: Mapping[str, float] | None = None

    def forward(self, points: Tensor) -> Values:
        """Returns the values at points (..., 3), float32 or float64, in world units: (...,),
        (..., c), or these by channel, of the dtype of the points.
        """
        raise NotImplementedError(f"{type(self).__name__}: forward is not implemented")

    def filtered(self, points: Tensor, size: Tensor) -> Values:
        """Returns the means over voxels around points (..., 3); `size` (..., 3), the sides of the
        voxels, broadcasts with the points. Called if `prefiltered`.
        """
        raise NotImplementedError(f"{type(self).__name__}: filtered is not implemented")

    def finish(self, values: Mapping[str, Tensor], size: Tensor) -> Mapping[str, Tensor]:
        """Returns channels (k, z, y, x, c), computed from what `filtered` returned on a grid that
        is `margin` voxels wider on all sides, (k, z + 2 margin, y + 2 margin, x + 2 margin, c) by
        channel, for voxels of sides `size` (k, 3). Called if there is a margin.
        """
        raise NotImplementedError(f"{type(self).__name__}: finish is not implemented")

    def bounds(self, center: Tensor, half: Tensor) -> Bounds:
        """Returns intervals that hold `forward` everywhere in boxes center - half to center + half,
        (k, 3) float64. They may be wide, but never too narrow; None: nothing is known.
        """
        return None

    def filtered_bounds(self, center: Tensor, half: Tensor, size: Tensor) -> Bounds:
        """Returns intervals that hold the means over all voxels within the boxes, of sides `size`
        (k, 3) float64 or smaller; if there is a margin, what `finish` returns there. By default
        those of `bounds`, which hold for means as well.
        """
        return self.bounds(center, half)

    def near(self, center: Tensor, half: Tensor) -> Field:
        """Returns a field with bit for bit the same values in all of k boxes, (k, 3) float64 each,
        but without the parts that do not matter there; itself unless overridden. Unlike all other
        methods it reads values on the host, which waits for the device.

        Source: Keeter, "Massively parallel rendering of complex closed-form implicit surfaces",
            SIGGRAPH 2020 (formulas that are shortened region by region).
        """
        return self

    def alike(self, center: Tensor, half: Tensor) -> Tensor:
        """Returns (k,) int64 numbers, equal for boxes in which the same parts of the field matter:
        such boxes are best evaluated together; see `near`.
        """
        return torch.zeros_like(center[:, 0], dtype=torch.int64)

    def replaced(self, **parts: nn.Module) -> Self:
        """Returns a copy of this field with some submodules replaced; it shares everything else."""
        other = copy.copy(self)
        other._modules = {**self._modules, **parts}
        return other

    def box(self) -> Tensor | None:
        """Returns (2, 3) float64 corners of a box outside which there is nothing; None: unknown."""
        return None

    def number(
        self,
        name: str,
        value: Any,
        *,
        low: float = -math.inf,
        high: float = math.inf,
        open_low: bool = False,
    ) -> Tensor:
        """Stores a number as a buffer `name`, () float64, and returns it.

        Multiplying with a () float64 tensor does not change the dtype of the other factor.

        Raises:
            ValueError: It is not finite, not in [low, high], or is `low` and `open_low` is set.
        """
        context = type(self).__name__
        number = check.number(context, name, value, low=low, high=high, open_low=open_low)
        return self._register(name, number)

    def vector(
        self, name: str, value: Sequence[float] | Tensor, *, positive: bool = False
    ) -> Tensor:
        """Stores x, y, z as a buffer `name`, (3,) float64, and returns it. Convert it with
        `.to(points)` before use.

        Raises:
            ValueError: They are not three finite numbers, or not positive if `positive` is set.
        """
        triple = check.triple(type(self).__name__, name, value, positive=positive)
        return self._register(name, triple)

    @lasting
    def _register(self, name: str, value: Any) -> Tensor:
        buffer = torch.tensor(value, dtype=torch.float64, device="cpu")
        self.register_buffer(name, buffer)
        return buffer

    def __repr__(self) -> str:
        parts = ", ".join(type(part).__name__ for part in self.children())
        return f"{type(self).__name__}({parts})"


def checked_field(context: str, name: str, value: Any) -> nn.Module:
    """Returns `value` if it is a field or another module with a forward. Raises ValueError if it
    has none; producers have none.
    """
    field = check.instance(context, name, value, nn.Module)
    if getattr(field.forward, "__func__", None) is not nn.Module.forward:
        return field
    kind, reason = type(field).__name__, ", which has no forward"
    if hasattr(field, "classify"):
        reason = ", a producer: give its field, or put producers side by side by gv.JoinedProducer"
    raise ValueError(f"{context}: {name} must be a field, got {kind}{reason}")


def modules_by_name(context: str, parts: Mapping[str, nn.Module]) -> nn.ModuleDict:
    """Returns modules by the names of channels; ValueError for a name that torch refuses."""
    try:
        return nn.ModuleDict(parts)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{context}: bad name of a channel: {error.args[0]}") from None


def unit_vector(context: str, name: str, value: Sequence[float] | Tensor) -> Tensor:
    """Returns (3,) float64 a user's direction, of length 1; ValueError if it has no length."""
    vector = torch.tensor(check.triple(context, name, value), dtype=torch.float64, device="cpu")
    norm = vector.norm()
    if not 0 < float(norm) < math.inf:
        raise ValueError(f"{context}: {name} must have a direction, got {tuple(value)}")
    return vector / norm


def length(vectors: Tensor) -> Tensor:
    """Returns (...,) lengths of vectors (..., c), whose gradient at 0 is 0, not NaN."""
    return torch.linalg.vector_norm(vectors, dim=-1)


def box_distance(beyond: Tensor) -> Tensor:
    """Returns (...,) signed distances to a box, from how far points are beyond its faces along each
    axis, (..., c); below 0 inside.
    """
    return length(beyond.clamp(min=0)) + beyond.amax(-1).clamp(max=0)


def tighter(first: Interval, second: Interval) -> Interval:
    """Returns the intersection of two intervals of the same values."""
    return torch.maximum(first[0], second[0]), torch.minimum(first[1], second[1])


def between(first: Interval, second: Interval, low: Tensor, high: Tensor) -> Interval:
    """Returns the interval, (k,) or (k, c), of mixes of two values in which the second has a share
    between low and high (k,): one value's interval where the share is 0 or 1, else the hull.
    """
    if first[0].dim() > low.dim():
        low, high = low[:, None], high[:, None]
    hull = torch.minimum(first[0], second[0]), torch.maximum(first[1], second[1])
    lower, upper = (
        torch.where(high <= 0, a, torch.where(low >= 1, b, both))
        for a, b, both in zip(first, second, hull, strict=True)
    )
    return lower, upper


def parts_of(center: Tensor, half: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Splits each of k boxes into count^3 parts: returns centres and half sides,
    (k * count^3, 3) each, box after box. Intervals of small boxes are tighter than that of a large
    one; `joined` combines them to those of the boxes.
    """
    steps = torch.arange(count, device=center.device, dtype=center.dtype)
    axis_offsets = (steps + 0.5) * 2 / count - 1
    offsets = torch.cartesian_prod(axis_offsets, axis_offsets, axis_offsets)
    parts = (center[:, None] + half[:, None] * offsets).flatten(0, 1)
    return parts, (half / count).repeat_interleave(count**3, 0)


def joined(interval: Interval, count: int) -> Interval:
    """Returns (k,) intervals of boxes from those of each box's count^3 parts."""
    low, high = (end.unflatten(0, (-1, count**3)) for end in interval)
    return low.amin(1), high.amax(1)
