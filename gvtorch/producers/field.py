"""`FieldProducer`: a function of position as a producer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from ..base import check
from ..base.check import extent_in, extent_of
from ..base.constants import DEEP_VOXELS
from ..base.lasting import without_autocast
from ..base.messages import with_type
from ..base.own_dtypes import OwnDtypes
from ..fields import Distance, Field, Interval, Solid
from ..fields.field import checked_field
from ..pool import Channel
from .nodes import ROUNDING_VOXELS
from .producer import Bricks, Nodes, Producer, Region, Regions, check_points, clocks_of

_BATCH_BRICKS = 64  # made at a time on the CPU, so that intermediate values fit into its caches
_MIN_GROUP_BRICKS = 12  # smaller groups cost more than leaving out parts of a field saves
#: Modules that compute something else while they are trained.
_TRAINING_DIFFERS = (nn.modules.batchnorm._BatchNorm, nn.modules.dropout._DropoutNd)
_ROUNDING = 2.0**-18  # relative widening of intervals, because values are rounded too


class FieldProducer(OwnDtypes, Producer):
    """Evaluates a field where rays ask for it: any `Field`, or any module that computes values
    (..., c), or {channel: (..., c)}, from world positions (..., 3).

    A voxel of any level is the mean of `samples`^3 values spread evenly over it; fields that can
    compute their means (`Field.prefiltered`), such as `Solid`, are evaluated once a voxel. Regions
    that the field's bounds prove uniform or invisible are never made.

    Attributes:
        field: The field.
        dtype: Of the positions at which it is evaluated.
    """

    on_device = True
    offsets: Tensor  # (samples^3, 3) in voxels

    def __init__(
        self,
        field: nn.Module,
        extent: int | Sequence[int] = 1024,
        *,
        box: Sequence[Sequence[float]] | None = None,
        channels: Mapping[str, Channel] | None = None,
        samples: int | None = None,
        threshold: float | Mapping[str, float] | None = None,
        dtype: torch.dtype | None = None,
        branching: int = 2,
        value_range: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        """Sets the field and the grid of voxels.

        Args:
            field: A field or module; a `Distance` is converted to the `Solid` that it bounds. Call
                `changed` after its parameters have changed.
            extent: Voxels of the finest level, (x, y, z), or along the longest side of the box.
            box: World corners ((x, y, z), (x, y, z)); left out: the field's and 2 voxels around it.
            channels: What voxels hold; left out: the field's dtypes, by default float32. In integer
                channels a value of 1 becomes the largest number of the dtype.
            samples: n of the n^3 values that a voxel is the mean of; left out: `branching`, so that
                the level above the finest is the mean of values at the centres of finest voxels.
            threshold: Nodes whose values are all proven not to exceed it are EMPTY. One value for
                all channels, or by name for those channels that decide; left out: the field's, if
                it has one, else no node is EMPTY.
            dtype: float32 or float64, of positions; left out: float64 if the box reaches more than
                2^17 finest voxels from the world's origin along an axis.
            branching: N.
            value_range: Smallest and largest value of each channel for which they are known.

        Raises:
            ValueError: The field fails or returns no values of the shapes above, a channel has
                another width, the box is unknown or infinite, or a number is out of its range.
        """
        context = type(self).__name__
        checked_field(context, "field", field)
        field = Solid(field) if isinstance(field, Distance) else field
        known_field = field if isinstance(field, Field) else None
        extent, box = _grid(context, known_field, extent, box)
        field_channels = _field_channels(context, field)
        super().__init__(
            extent,
            channels=field_channels if channels is None else channels,
            box=box,
            branching=branching,
            value_range=value_range,
        )
        widths, expected = (
            {name: channel.width for name, channel in part.items()}
            for part in (self.channels, field_channels)
        )
        if widths != expected:
            raise ValueError(f"{context}: channels must be {expected} numbers wide, got {widths}")
        if dtype not in (None, torch.float32, torch.float64):
            raise ValueError(f"{context}: dtype must be float32 or float64, got {dtype}")
        self.field = field
        count = branching if samples is None else samples
        self.samples = check.integer(context, "samples", count, low=1, high=64)
        index = torch.arange(self.samples, dtype=torch.float64, device="cpu")
        offsets = (index + 0.5) / self.samples - 0.5
        self.register_buffer("offsets", torch.cartesian_prod(offsets, offsets, offsets))
        self.threshold = self._thresholds(context, known_field, threshold)
        self.dtype = dtype or position_dtype(box, self.spacing)

    def _thresholds(
        self, context: str, field: Field | None, threshold: float | Mapping[str, float] | None
    ) -> Mapping[str, float] | None:
        """Returns, by channel, the value up to which it shows nothing."""
        if threshold is None:
            return None if field is None else field.threshold
        if not isinstance(threshold, Mapping):
            threshold = dict.fromkeys(self.channels, threshold)
        for name in threshold:
            check.channel(f"{context}: threshold", name, self.channels, "the field")
        return {n: check.number(context, "threshold", value) for n, value in threshold.items()}

    def classify(self, nodes: Nodes) -> Regions:
        """Returns EMPTY where all channels that have a threshold are proven not to exceed it, else
        CONSTANT where all channels are proven uniform, else DATA; and the known ranges of values.
        """
        bounds = self._bounds(nodes.center, nodes.half_extent(), nodes.voxel_size)
        one_value = empty = torch.zeros_like(nodes.depth, dtype=torch.bool)
        if len(bounds) == len(self.channels):
            one_value = torch.stack([(high == low).all(1) for low, high in bounds.values()]).all(0)
        if self.threshold is not None and {*self.threshold} <= {*bounds}:
            unseen = [(bounds[n][1] <= limit).all(1) for n, limit in self.threshold.items()]
            empty = torch.stack(unseen).all(0)
        kind = torch.where(one_value, int(Region.CONSTANT), int(Region.DATA))
        kind, uniform = torch.where(empty, int(Region.EMPTY), kind), (one_value & ~empty)[:, None]
        constants, ranges = {}, {}
        for name, (low, high) in bounds.items():
            slack = _ROUNDING * torch.maximum(low.abs(), high.abs())
            slack = torch.where(uniform, 0.0, slack)
            constants[name] = self._to_channel_dtype(name, torch.where(uniform, low, 0.0))
            ranges[name] = self._to_channel_dtype(name, torch.stack((low - slack, high + slack), 1))
        return Regions(kind=kind, constants=constants, ranges=ranges)

    def fill(self, nodes: Nodes) -> Bricks:
        """Evaluates the field at every voxel, border included. On the CPU, bricks are batched by
        which parts of the field matter in them, and only these parts are evaluated.

        Raises:
            ValueError: A part of the field is in training mode, and computes other values there.
        """
        _check_evaluates(type(self).__name__, self.field)
        if nodes.loc.device.type != "cpu" or torch.compiler.is_compiling():
            data = self._evaluate(nodes, self.field)
        else:
            order, parts = [], []
            for rows, field in group_alike(self.field, nodes, self._margin_voxels):
                order.append(rows)
                parts.append(self._evaluate(nodes[rows], field))
            original_order = torch.cat(order).argsort()
            data = {
                name: torch.cat([part[name] for part in parts])[original_order]
                for name in self.channels
            }
        # Infinite values become NaN: they must fail, not be clamped to the largest number.
        nan_marked = {name: rows.masked_fill(rows.isinf(), math.nan) for name, rows in data.items()}
        stored = {name: self._to_channel_dtype(name, rows) for name, rows in nan_marked.items()}
        integers = [n for n, c in self.channels.items() if not c.dtype.is_floating_point]
        if not integers:
            return Bricks(data=stored)
        finite = torch.stack([data[n].isfinite().flatten(1).all(1) for n in integers]).all(0)
        # Integers can't hold NaN: such bricks get kind -1, which fails.
        return Bricks(data=stored, kind=torch.where(finite, int(Region.DATA), -1))

    def differs(self, nodes: Nodes, before: float, after: float) -> Tensor:
        """Returns the nodes where a part of the field with a time matters at either time."""
        return moving_nodes(self, self.field, nodes, self._margin_voxels, (before, after))

    @property
    def _margin_voxels(self) -> float:
        """Voxels beyond a brick's border in which the field is evaluated, and a rounding margin."""
        return getattr(self.field, "margin", 0) + ROUNDING_VOXELS

    def at(self, points: Tensor) -> dict[str, Tensor]:
        """Returns the field's own values at points (..., 3), for each channel (..., c), in the
        dtype of the points: not filtered and not rounded. Needs no engine.
        """
        context = type(self).__name__
        check_points(f"{context}.at", points, floats=True)
        if points.dim() == 1:  # () values would be promoted to the dtype of the field's numbers
            return {name: values[0] for name, values in self.at(points[None]).items()}
        return _by_channel(context, _call_field(context, self.field, self.field, points), points)

    def _evaluate(self, nodes: Nodes, field: nn.Module) -> dict[str, Tensor]:
        """Returns the voxels of k bricks, (k, z, y, x, c) by channel, before rounding."""
        context = type(self).__name__
        size = nodes.voxel_size.to(self.dtype)[:, None, None, None]
        if isinstance(field, Field) and field.prefiltered:
            points = nodes.wider(field.margin).points(self.dtype)
            values = _call_field(context, field, field.filtered, points, size)
            filtered = _by_channel(context, values, points)
            if field.margin == 0:
                return filtered
            side = nodes.layout.side
            brick_points = points[:, :side, :side, :side]
            values = _call_field(context, field, field.finish, filtered, size[:, 0, 0, 0])
            return _by_channel(context, values, brick_points)
        points = nodes.points(self.dtype)
        total: dict[str, Any] = {}
        for offset in self.offsets.to(size).unbind(0):
            result = _call_field(context, field, field, points + size * offset)
            values = _by_channel(context, result, points)
            total = {name: total.get(name, 0) + value for name, value in values.items()}
        return {name: value / len(self.offsets) for name, value in total.items()}

    def _bounds(self, center: Tensor, half_extent: Tensor, size: Tensor) -> dict[str, Interval]:
        """Returns intervals by channel, (k, c) each, for the channels that have known bounds."""
        if not isinstance(self.field, Field):
            return {}
        context, method = type(self).__name__, self.field.filtered_bounds
        bounds = _call_field(context, self.field, method, center, half_extent, size)
        if bounds is None:
            return {}
        by_channel = bounds if isinstance(bounds, Mapping) else {"value": bounds}
        return {
            name: interval_of(self.field, name, ends, len(center), self.channels[name].width)
            for name, ends in by_channel.items()
            if name in self.channels
        }

    def _to_channel_dtype(self, name: str, values: Tensor) -> Tensor:
        channel = self.channels[name]
        low, high = channel.limits
        values = values.float() if values.dtype.itemsize < 4 else values  # float16 has less range
        if channel.dtype.is_floating_point:
            return values.clamp(low, high).to(channel.dtype)
        return (values * high).round().clamp(low, high).to(channel.dtype)


def interval_of(field: nn.Module, name: str, ends: Any, count: int, width: int) -> Interval:
    """Returns the interval that a field's `bounds` returned for a channel of `width` numbers, as
    (k, width) each, k = `count`; raises ValueError if it is not one.
    """
    context = f"{type(field).__name__}.bounds"
    if not isinstance(ends, tuple) or [isinstance(end, Tensor) for end in ends] != [True, True]:
        got = f"{len(ends)} items" if isinstance(ends, tuple) else type(ends).__name__
        raise ValueError(f"{context}: {name!r} must be two tensors, low and high, got {got}")
    if any(tuple(end.shape) not in ((count,), (count, width)) for end in ends):
        low, high = (check.describe(end) for end in ends)
        raise ValueError(
            f"{context}: {name!r} must be ({count},) or ({count}, {width}) each, "
            f"got {low} and {high}"
        )
    low, high = (end[:, None].expand(-1, width) if end.dim() == 1 else end for end in ends)
    check_values = low.device.type == "cpu" and not torch.compiler.is_compiling()
    if check_values and not bool((low <= high).all()):
        raise ValueError(f"{context}: {name!r} must be low <= high everywhere, and not NaN")
    return low, high


def distances_of(context: str, shape: nn.Module, points: Tensor) -> Tensor:
    """Returns a shape's distances (...,) at points (..., 3); ValueError for any other result."""
    distances = _call_field(context, shape, shape, points)
    leading_shape = points.shape[:-1]
    if (
        not isinstance(distances, Tensor)
        or distances.shape != leading_shape
        or not distances.dtype.is_floating_point
    ):
        sizes = ", ".join(str(size) for size in leading_shape)
        raise ValueError(
            f"{context}: shape {type(shape).__name__} must give ({sizes}) distances "
            f"at ({sizes}, 3) points, got {check.describe(distances)}"
        )
    return distances


def group_alike(
    field: nn.Module, nodes: Nodes, margin: float, *, split: bool = True
) -> Iterator[tuple[Tensor, nn.Module]]:
    """Groups nodes by which parts of a field matter in them, up to `margin` voxels beyond the
    brick's border. Yields the indices of a group, and the field reduced to these parts; small
    groups are joined, and on the CPU large ones are `split`. Waits for the device.
    """
    splits = split and nodes.loc.device.type == "cpu"
    count = _BATCH_BRICKS if splits else max(1, len(nodes))
    if not isinstance(field, Field):
        yield from ((rows, field) for rows in torch.arange(len(nodes), device="cpu").split(count))
        return
    center, half_extent = nodes.center, nodes.half_extent(margin)
    name, part_keys = type(field).__name__, field.alike(center, half_extent)
    if check.as_text(part_keys) != f"({len(nodes)},) int64":
        got = check.describe(part_keys)
        raise ValueError(f"{name}.alike: must give ({len(nodes)},) int64 numbers, got {got}")
    _, group_index = part_keys.unique(return_inverse=True)
    groups: list[Tensor] = []
    for group in group_index.argsort(stable=True).split(group_index.bincount().tolist()):
        if groups and len(groups[-1]) < _MIN_GROUP_BRICKS:
            groups[-1] = torch.cat((groups[-1], group))
        else:
            groups.append(group)
    for group in groups:
        reduced = field.near(center[group], half_extent[group])
        check.instance(f"{name}.near", "answer", reduced, Field)
        yield from ((rows, reduced) for rows in group.split(count))


def moving_nodes(
    producer: Producer, field: nn.Module, nodes: Nodes, margin: float, times: Sequence[float]
) -> Tensor:
    """Returns (k,) bool: the nodes in which a part of the producer's field that has a time matters
    at any of `times`; for `margin` see `group_alike`.
    """
    moves = torch.zeros_like(nodes.depth, dtype=torch.bool)
    for time in times:
        with producer.at_time(time):
            for rows, reduced in group_alike(field, nodes, margin, split=False):
                moves[rows] |= bool(clocks_of(reduced))
    return moves


def _check_evaluates(context: str, field: nn.Module) -> None:
    """Raises ValueError if a field's values depend on other values of a batch, or on chance."""
    for part in field.modules():
        if part.training and isinstance(part, _TRAINING_DIFFERS):
            kind = f"field {type(field).__name__} holds a {type(part).__name__} in training mode"
            raise ValueError(f"{context}: {kind}: bricks would depend on their batch: call eval()")


@contextmanager
def _evaluating(field: nn.Module) -> Iterator[None]:
    """Lets the block call a field in evaluation mode, which leaves the field as it is."""
    training = [part for part in field.modules() if part.training]
    try:
        for part in training:
            part.training = False
        yield
    finally:
        for part in training:
            part.training = True


@without_autocast
def _call_field(context: str, field: nn.Module, method: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a method of a field; if it fails, raises a ValueError of one line, naming the field."""
    try:
        return method(*arguments)
    except (MemoryError, torch.OutOfMemoryError):
        raise  # not the field's fault
    except Exception as error:
        reason = with_type(error)
        raise ValueError(f"{context}: field {type(field).__name__} failed: {reason}") from error


def _by_channel(context: str, values: Any, points: Tensor) -> dict[str, Tensor]:
    """Returns a field's values at points (..., 3) as (..., c) by channel; ValueError if invalid."""
    if isinstance(values, Tensor):
        values = {"value": values}
    if not isinstance(values, Mapping) or not values:
        got = type(values).__name__
        raise ValueError(f"{context}: field must give a tensor, or a dict of them, got {got}")
    by_channel, leading_shape = {}, points.shape[:-1]
    for name, value in values.items():
        if not isinstance(value, Tensor) or not value.dtype.is_floating_point:
            got = check.describe(value)
            raise ValueError(f"{context}: field must give floats for {name!r}, got {got}")
        with_width = value[..., None] if value.shape == leading_shape else value
        if with_width.shape[:-1] != leading_shape:
            sizes = ", ".join(str(size) for size in leading_shape)
            raise ValueError(
                f"{context}: field must give ({sizes}) or ({sizes}, c) for {name!r} "
                f"at ({sizes}, 3) points, got {check.describe(value)}"
            )
        by_channel[name] = with_width
    return by_channel


def _field_channels(context: str, field: nn.Module) -> dict[str, Channel]:
    """Returns the channels of a field: its dtypes, by default float32, and the widths of its values
    at 2 x 5 points.
    """
    tensors = [*field.parameters(), *field.buffers()]
    device = tensors[0].device if tensors else torch.device("cpu")
    points = torch.full((2, 5, 3), 0.25, dtype=torch.float32, device=device)
    with torch.no_grad(), _evaluating(field):
        if isinstance(field, Field) and field.prefiltered:
            values = _call_field(context, field, field.filtered, points, points)
        else:
            values = _call_field(context, field, field, points)
    dtypes: Mapping[str, torch.dtype] = getattr(field, "dtypes", {})
    return {
        name: Channel(dtypes.get(name, torch.float32), value.shape[-1])
        for name, value in _by_channel(context, values, points).items()
    }


def _grid(
    context: str,
    field: Field | None,
    extent: int | Sequence[int],
    box: Sequence[Sequence[float]] | None,
) -> tuple[tuple[int, int, int], Sequence[Sequence[float]]]:
    """Returns extent and box of the grid in `box`, or around a field's box, 2 voxels wider on each
    side.
    """
    if box is not None:
        return extent_in(context, extent, box), box
    around = None if field is None else field.box()
    if around is None or not bool(torch.isfinite(around).all() & (around[1] > around[0]).all()):
        raise ValueError(f"{context}: box must be given: the field does not say where it ends")
    around = around.cpu()
    sides, middle = around[1] - around[0], around.mean(0)
    sizes = extent_of(context, extent)
    if isinstance(extent, Sequence):
        half_size = sides / 2 * (1 + 4 / torch.tensor([max(n, 5) - 4 for n in sizes], device="cpu"))
    else:
        check.integer(context, "extent", extent, low=5)
        voxel = sides.max() / (sizes[0] - 4)
        x, y, z = (math.ceil(float(side / voxel) - 1e-9) + 4 for side in sides)
        sizes = x, y, z
        half_size = torch.tensor(sizes, dtype=torch.float64, device="cpu") * voxel / 2
    return sizes, ((middle - half_size).tolist(), (middle + half_size).tolist())


def position_dtype(box: Sequence[Sequence[float]], spacing: Sequence[float]) -> torch.dtype:
    """Returns float32 if a box ends within 2^17 finest voxels of the origin, else float64."""
    farthest = max(abs(float(end)) for corner in box for end in corner)
    return torch.float32 if farthest <= 0.5 * DEEP_VOXELS * min(spacing) else torch.float64
