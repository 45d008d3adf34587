"""Checks of what a producer answered, item by item: a bad one becomes an error, the others stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..pool import Channel, TableRows
from ..pool.brick_table import on_device, on_host
from ..pool.pyramid import NodeSummary
from ..pool.staging import upload
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions


def checked_regions(answer: Any, nodes: Nodes, producer: Producer) -> Regions:
    """Returns a producer's answer to `classify(nodes)` as `Regions` on the layout's device.

    Raises:
        ValueError: The answer is of the wrong type, shape or dtype.
    """
    where = f"{type(producer).__name__}.classify"
    if isinstance(answer, Tensor):
        answer = Regions(kind=answer)
    if not isinstance(answer, Regions):
        came = type(answer).__name__
        raise ValueError(f"{where}: must return Regions or a tensor, got {came}")
    count, device = len(nodes), nodes.layout.device
    errors = _known_errors(where, answer.errors, count)
    kind = _kind(where, answer.kind, count)
    shapes = {"constants": (), "ranges": (2,)}
    fields = {
        name: _by_channel(where, name, getattr(answer, name), (count, *shape), producer)
        for name, shape in shapes.items()
    }
    counts = _refuse_bad(kind, [*fields.values()], errors)
    _need_constants(where, counts, fields["constants"], producer)
    alias = _alias(where, answer.alias, kind, counts, nodes.layout, errors)
    return Regions(
        kind=upload(kind, device),
        alias=None if alias is None else upload(alias, device),
        errors=errors,
        **{
            name: {channel: upload(values, device) for channel, values in by_channel.items()}
            for name, by_channel in fields.items()
        },
    )


def checked_bricks(answer: Any, nodes: Nodes, producer: Producer) -> Bricks:
    """Returns a producer's answer to `fill(nodes)` as `Bricks`. Voxels stay where they are, unless
    some channels lie on the host and others on the device: then all go to the device.

    Raises:
        ValueError: The answer is of the wrong type, shape or dtype.
    """
    where = f"{type(producer).__name__}.fill"
    if isinstance(answer, Mapping):
        answer = Bricks(data=answer)
    if not isinstance(answer, Bricks):
        came = type(answer).__name__
        raise ValueError(f"{where}: must return Bricks or a dict of tensors, got {came}")
    layout, count = nodes.layout, len(nodes)
    errors = _known_errors(where, answer.errors, count)
    kind = None if answer.kind is None else _kind(where, answer.kind, count)
    missing = sorted(set(producer.channels) - set(answer.data))
    if missing:
        raise ValueError(f"{where}: channel {missing[0]!r} is missing")
    shape = (count, *(layout.side,) * 3)
    data = _by_channel(where, "data", answer.data, shape, producer)
    if any(on_host({name: rows}) != on_host(data) for name, rows in data.items()):
        data = {name: on_device(rows, layout.device) for name, rows in data.items()}
    constants = _by_channel(where, "constants", answer.constants, (count,), producer)
    counts = _refuse_bad(kind, (data, constants), errors)
    _need_constants(where, counts, constants, producer)
    alias = None if kind is None else _alias(where, answer.alias, kind, counts, layout, errors)
    return Bricks(data=data, kind=kind, constants=constants, alias=alias, errors=errors)


def count_kinds(kind: Tensor) -> Tensor:
    """Returns (5,) int64: how many items are EMPTY, CONSTANT, DATA, DATA_MAX_DEPTH and ALIAS."""
    codes = torch.arange(len(Region), device=kind.device)
    return (kind == codes[:, None]).sum(1)


def regions_of(
    summaries: Mapping[str, NodeSummary], channels: Mapping[str, Channel], threshold: float | None
) -> Regions:
    """Returns what a summary of all channels tells of k nodes: CONSTANT where every channel is
    uniform, EMPTY where none has a value above the threshold, else DATA.
    """
    constant = torch.stack([one.is_constant for one in summaries.values()]).all(0)
    empty = torch.stack([one.is_empty(threshold) for one in summaries.values()]).all(0)
    kind = torch.where(constant, Region.CONSTANT, Region.DATA)
    return Regions(
        kind=torch.where(empty, Region.EMPTY, kind),
        constants={name: one.constants(channels[name].dtype) for name, one in summaries.items()},
        ranges={name: one.ranges(channels[name].dtype) for name, one in summaries.items()},
    )


def _known_errors(where: str, errors: Mapping[int, str], count: int) -> dict[int, str]:
    if any(not 0 <= index < count for index in errors):
        raise ValueError(f"{where}: errors names an item that is not in the batch of {count}")
    return dict(errors)


def _kind(where: str, kind: Any, count: int) -> Tensor:
    if not isinstance(kind, Tensor) or kind.shape != (count,) or kind.is_floating_point():
        raise ValueError(f"{where}: kind must be ({count},) of Region, got {check.describe(kind)}")
    return kind.to(torch.int64)


def _by_channel(
    where: str,
    name: str,
    values: Mapping[str, Any],
    shape: tuple[int, ...],
    producer: Producer,
) -> dict[str, Any]:
    """Returns the values of each channel as (*shape, width); a width of 1 may be left out."""
    result = {}
    for channel, value in values.items():
        if channel not in producer.channels:
            known = ", ".join(producer.channels)
            raise ValueError(f"{where}: {name} has channel {channel!r}; the producer has {known}")
        what: Channel = producer.channels[channel]
        wanted = (*shape, what.width)
        plain = isinstance(value, Tensor) and what.width == 1 and value.shape == shape
        tensor = value[..., None] if plain else value
        known_type = isinstance(tensor, Tensor) or (
            isinstance(tensor, TableRows) and name == "data"
        )
        fits = known_type and tensor.shape == wanted and tensor.dtype == what.dtype
        if not fits:
            sizes = ", ".join(str(size) for size in wanted)
            dtype = str(what.dtype).removeprefix("torch.")
            raise ValueError(
                f"{where}: {name}[{channel!r}] must be ({sizes}) {dtype}, "
                f"got {check.describe(tensor)}"
            )
        result[channel] = tensor.detach() if isinstance(tensor, Tensor) else tensor
    return result


def _need_constants(
    where: str, counts: Sequence[int], constants: Mapping[str, Tensor], producer: Producer
) -> None:
    missing = sorted(set(producer.channels) - set(constants))
    if missing and counts[Region.CONSTANT]:
        raise ValueError(f"{where}: constants must hold channel {missing[0]!r} of CONSTANT items")


def _alias(
    where: str,
    alias: Any,
    kind: Tensor,
    counts: Sequence[int],
    layout: Layout,
    errors: dict[int, str],
) -> Tensor | None:
    """Returns (k, 4) alias targets, None if no item is ALIAS; wrong places become errors."""
    if not counts[Region.ALIAS]:
        return None
    if not isinstance(alias, Tensor) or alias.shape != (len(kind), 4):
        raise ValueError(
            f"{where}: alias must be ({len(kind)}, 4) where an item is ALIAS, "
            f"got {check.describe(alias)}"
        )
    alias = alias.to(device=kind.device, dtype=torch.int64)
    depth = alias[:, 3]
    nodes = float(layout.branching) ** depth.clamp(0, layout.depth).to(torch.float64)
    inside = ((alias[:, :3] >= 0) & (alias[:, :3] < nodes[:, None])).all(1)
    wrong = (kind == Region.ALIAS) & ~(inside & (depth >= 0) & (depth <= layout.depth))
    for index in wrong.nonzero()[:, 0].tolist():
        errors.setdefault(index, f"alias {tuple(alias[index].tolist())} is no node of this tree")
    return alias


def _refuse_bad(
    kind: Tensor | None,
    fields: Sequence[Mapping[str, Tensor | TableRows]],
    errors: dict[int, str],
) -> list[int]:
    """Adds items of an unknown kind, and those that hold NaN or infinite values, to the errors.
    Rows of a table are not looked at: `BrickTable` has checked them.

    Returns:
        How many items are of each kind, zeros where `kind` is None. The host waits for the device
        once, if anything lies there.
    """
    floats = [
        (channel, values)
        for by_channel in fields
        for channel, values in by_channel.items()
        if isinstance(values, Tensor) and values.is_floating_point() and values.numel()
    ]
    if kind is None and not floats:
        return [0] * len(Region)
    sums = [torch.isfinite(values.sum(dtype=torch.float32)) for _, values in floats]
    kinds = torch.zeros(len(Region), dtype=torch.int64) if kind is None else count_kinds(kind)
    counts, *finite = _read([kinds, *(flag[None] for flag in sums)])
    if kind is not None and sum(counts) < len(kind):
        for index in ((kind < Region.EMPTY) | (kind > Region.ALIAS)).nonzero()[:, 0].tolist():
            errors[index] = f"{int(kind[index])} is no Region"
    for (channel, values), (whole,) in zip(floats, finite, strict=True):
        if whole:
            continue
        bad = ~torch.isfinite(values).flatten(1).all(1)
        for index in bad.nonzero()[:, 0].tolist():
            errors.setdefault(index, f"channel {channel!r} holds NaN or infinite values")
    return counts


def _read(values: Sequence[Tensor]) -> list[list[int]]:
    """Returns small tensors of integers as lists, with one transfer for each device."""
    result: dict[int, list[int]] = {}
    for device in {value.device for value in values}:
        here = [index for index, value in enumerate(values) if value.device == device]
        flat = torch.cat([values[index].to(torch.int64) for index in here]).tolist()
        for index in here:
            size = len(values[index])
            result[index], flat = flat[:size], flat[size:]
    return [result[index] for index in range(len(values))]
