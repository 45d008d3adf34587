"""Checks producers' answers, item by item: a bad item becomes an error, the others are kept. An
answer of the wrong type, shape or dtype raises ValueError.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..base import check
from ..pool import Channel
from ..pool.pyramid import NodeSummary, constant_and_empty
from ..pool.staging import TableRows, on_device, on_host, upload
from .producer import Bricks, Nodes, Producer, Region, Regions

Form = TypeVar("Form", bound=Regions | Bricks)


def checked_regions(
    answer: Any, nodes: Nodes, producer: Producer, *, check_values: bool = True
) -> Regions:
    """Returns a producer's answer to `classify(nodes)` as `Regions` on the layout's device. With
    `check_values` false only types and shapes are checked, not values, and the host does not wait.
    """
    if isinstance(answer, Tensor):
        answer = Regions(kind=answer)
    regions = _checked("classify", answer, Regions, "a tensor", nodes, producer, check_values)
    return regions.each(lambda tensor: upload(tensor, nodes.layout.device))


def checked_bricks(
    answer: Any, nodes: Nodes, producer: Producer, *, check_values: bool = True
) -> Bricks:
    """Returns a producer's answer to `fill(nodes)` as `Bricks`. Voxels stay where they are, unless
    some channels are on the host and others on the device: then all are copied to the device. For
    `check_values` see `checked_regions`.
    """
    wrapped = producer.as_bricks(answer)
    bricks = _checked("fill", wrapped, Bricks, "a dict of tensors", nodes, producer, check_values)
    if len({on_host({name: rows}) for name, rows in bricks.data.items()}) == 1:
        return bricks
    device = nodes.layout.device
    return replace(bricks, data={n: on_device(rows, device) for n, rows in bricks.data.items()})


def raise_first(errors: Mapping[int, str]) -> None:
    """Raises ValueError with the first message, if there are any."""
    for message in errors.values():
        raise ValueError(message)


def count_kinds(kind: Tensor) -> Tensor:
    """Returns (5,) int64: how many items are EMPTY, CONSTANT, DATA, DATA_MAX_DEPTH and ALIAS."""
    codes = torch.arange(len(Region), device=kind.device)
    return (kind == codes[:, None]).sum(1)


def regions_of(
    summaries: Mapping[str, NodeSummary], channels: Mapping[str, Channel], threshold: float | None
) -> Regions:
    """Returns the regions of k nodes, given summaries of all channels: EMPTY where no channel has a
    value above the threshold, else CONSTANT where every channel is uniform, else DATA.
    """
    constant, empty = constant_and_empty(summaries.values(), threshold)
    kind = torch.where(constant, Region.CONSTANT, Region.DATA)
    return Regions(
        kind=torch.where(empty, Region.EMPTY, kind),
        constants={n: s.constants(channels[n].dtype) for n, s in summaries.items()},
        ranges={n: s.ranges(channels[n].dtype) for n, s in summaries.items()},
    )


def _checked(
    method: str,
    answer: Any,
    answer_type: type[Form],
    alternative: str,
    nodes: Nodes,
    producer: Producer,
    check_values: bool,
) -> Form:
    """Returns the answer with a width in every shape, and with an error for each bad item."""
    context = f"{type(producer).__name__}.{method}"
    if not isinstance(answer, answer_type):
        got = type(answer).__name__
        raise ValueError(
            f"{context}: must return {answer_type.__name__} or {alternative}, got {got}"
        )
    kind: Any
    layout, count, kind = nodes.layout, len(nodes), answer.kind
    for name in ("data", "constants", "ranges", "errors"):
        if not isinstance(by_name := getattr(answer, name, {}), Mapping):
            got = check.describe(by_name)
            raise ValueError(f"{context}: {name} must be a dict, got {got}")
    if not all(hasattr(index, "__index__") and 0 <= index < count for index in answer.errors):
        raise ValueError(f"{context}: errors names an item that is not in the batch of {count}")
    errors = {int(index): str(message) for index, message in answer.errors.items()}
    if kind is not None or isinstance(answer, Regions):
        is_integer = isinstance(kind, Tensor) and not (
            kind.is_floating_point() or kind.is_complex() or kind.dtype == torch.bool
        )
        if not is_integer or kind.shape != (count,):
            got = check.describe(kind)
            raise ValueError(f"{context}: kind must be ({count},) of Region, got {got}")
        kind = kind.to(torch.int64)
    brick_shape = (layout.side,) * 3
    shapes: dict[str, tuple[int, ...]] = {"data": brick_shape, "constants": (), "ranges": (2,)}
    by_field = {name: getattr(answer, name) for name in shapes if hasattr(answer, name)}
    fine_channels = {name for name, channel in producer.channels.items() if not channel.coarse}
    required = {*producer.channels} if nodes.coarse else fine_channels
    if missing := sorted(required - {*by_field.get("data", required)}):
        raise ValueError(f"{context}: channel {missing[0]!r} is missing")
    for name, values in by_field.items():
        allowed = required if name == "data" else fine_channels
        if unexpected := {*values} & {*producer.channels} - allowed:
            rule = "only bricks above the finest level hold"
            raise ValueError(f"{context}: {name} has channel {min(unexpected)!r}, which {rule}")
    fields: dict[str, Any] = {
        name: _by_channel(context, name, by_channel, (count, *shapes[name]), producer)
        for name, by_channel in by_field.items()
    }
    if not check_values:
        _refuse_late(context, answer, [*fields.values()], layout.device)
        return answer_type(kind=kind, **fields)
    counts = _refuse_bad(answer_type, kind, [*fields.values()], errors)
    _refuse_reversed(fields.get("ranges", {}), errors)
    missing = sorted(fine_channels - {*fields["constants"]})
    if missing and counts[Region.CONSTANT]:
        raise ValueError(f"{context}: constants must hold channel {missing[0]!r} of CONSTANT items")
    if not counts[Region.ALIAS]:
        return answer_type(kind=kind, errors=errors, **fields)
    alias = _checked_alias(context, answer, kind, nodes, errors)
    tree = answer.alias_tree
    return answer_type(kind=kind, alias=alias, alias_tree=tree, errors=errors, **fields)


def _refuse_late(
    context: str,
    answer: Any,
    fields: Sequence[Mapping[str, Tensor | TableRows]],
    device: torch.device,
) -> None:
    """Raises ValueError if an answer that must stay on the device needs the host."""
    if answer.alias is not None or answer.errors:
        raise ValueError(f"{context}: an on_device producer answers without alias and errors")
    for by_channel in fields:
        for name, values in by_channel.items():
            if isinstance(values, TableRows) or values.device != device:
                raise ValueError(f"{context}: channel {name!r} is not on the device: {device}")


def _refuse_reversed(ranges: Mapping[str, Tensor], errors: dict[int, str]) -> None:
    """Adds an error for each item whose smallest value is above its largest: nothing would be seen
    of it. Ranges on another device are not read, as the host would wait.
    """
    for channel, ends in ranges.items():
        if ends.device.type == "cpu":
            smallest, largest = ends.to(torch.float32).unbind(1)
            for index in (smallest > largest).any(1).nonzero()[:, 0].tolist():
                errors.setdefault(index, f"the range of channel {channel!r} is reversed")


def _by_channel(
    context: str, name: str, values: Mapping[str, Any], shape: tuple[int, ...], producer: Producer
) -> dict[str, Any]:
    """Returns the values of each channel as (*shape, width); a width of 1 may be left out."""
    result = {}
    for channel, value in values.items():
        check.channel(f"{context}: {name}", channel, producer.channels, "the producer")
        spec: Channel = producer.channels[channel]
        expected = (*shape, spec.width), spec.dtype
        lacks_width = isinstance(value, Tensor) and spec.width == 1 and value.shape == shape
        tensor = value[..., None] if lacks_width else value
        types = (Tensor, TableRows) if name == "data" else (Tensor,)
        fits = isinstance(tensor, types) and (tensor.shape, tensor.dtype) == expected
        if isinstance(tensor, Tensor):
            fits = fits and tensor.layout == torch.strided and not tensor.is_meta
        if not fits:
            sizes = ", ".join(str(size) for size in expected[0])
            dtype = str(spec.dtype).removeprefix("torch.")
            raise ValueError(
                f"{context}: {name}[{channel!r}] must be ({sizes}) {dtype}, "
                f"got {check.describe(tensor)}"
            )
        result[channel] = tensor.detach() if isinstance(tensor, Tensor) else tensor
    return result


def _checked_alias(
    context: str, answer: Regions | Bricks, kind: Tensor, nodes: Nodes, errors: dict[int, str]
) -> Tensor:
    """Returns (k, 4) alias targets; adds an error for each that is not a node of its tree, or lies
    in the node itself.
    """
    alias: Any = answer.alias
    layout, name = nodes.layout, answer.alias_tree
    if name is not None:
        check.one_of(context, "alias_tree", name, layout.scene)
        layout = layout.scene[name]
        if layout.branching != nodes.layout.branching:
            own_branching = nodes.layout.branching
            raise ValueError(
                f"{context}: tree {name!r} has N={layout.branching}, this one N={own_branching}"
            )
    if not isinstance(alias, Tensor) or alias.shape != (len(kind), 4):
        raise ValueError(
            f"{context}: alias must be ({len(kind)}, 4) where an item is ALIAS, "
            f"got {check.describe(alias)}"
        )
    alias = alias.to(device=kind.device, dtype=torch.int64)
    depth = alias[:, 3]
    side = float(layout.branching) ** depth.clamp(0, layout.depth).to(torch.float64)
    inside = ((alias[:, :3] >= 0) & (alias[:, :3] < side[:, None])).all(1)
    not_a_node = (kind == Region.ALIAS) & ~(inside & (depth >= 0) & (depth <= layout.depth))
    for index in not_a_node.nonzero()[:, 0].tolist():
        tree = "this tree" if name is None else f"tree {name!r}"
        errors.setdefault(index, f"alias {tuple(alias[index].tolist())} is no node of {tree}")
    if layout.extent is not nodes.layout.extent:  # the target tree has another producer
        return alias
    loc = nodes.loc.to(alias.device)
    up = layout.branching ** (depth - loc[:, 3]).clamp(0, layout.depth)
    inside_node = (alias[:, :3] // up[:, None] == loc[:, :3]).all(1) & (depth >= loc[:, 3])
    for index in ((kind == Region.ALIAS) & inside_node).nonzero()[:, 0].tolist():
        target, node = tuple(alias[index].tolist()), tuple(loc[index].tolist())
        errors.setdefault(index, f"alias {target} lies in the node itself, {node}")
    return alias


def _refuse_bad(
    answer_type: type[Form],
    kind: Tensor | None,
    fields: Sequence[Mapping[str, Tensor | TableRows]],
    errors: dict[int, str],
) -> list[int]:
    """Adds an error for each item of an unknown kind or with NaN or infinite values. Rows of a
    table are not read: `BrickTable` has checked them. Returns how many items are of each kind,
    zeros if `kind` is None. The host waits for the device once.
    """
    floats = [
        (channel, values)
        for by_channel in fields
        for channel, values in by_channel.items()
        if isinstance(values, Tensor) and values.is_floating_point() and values.numel()
    ]
    if kind is None and not floats:
        return [0] * len(Region)
    sums = [values.sum(dtype=torch.float32).view(1) for _, values in floats]
    counts_on_device = [count_kinds(kind) if kind is not None else sums[0].new_zeros(len(Region))]
    flags = counts_on_device + [torch.isfinite(number) for number in sums]
    read_device = max((flag.device for flag in flags), key=lambda device: device.type != "cpu")
    host_flags = torch.cat([flag.to(read_device, torch.int64) for flag in flags]).tolist()
    counts, finite = host_flags[: len(Region)], host_flags[len(Region) :]
    if kind is not None and sum(counts) < len(kind):
        for index in ((kind < Region.EMPTY) | (kind > Region.ALIAS)).nonzero()[:, 0].tolist():
            code = int(kind[index])
            not_finite = code == -1 and answer_type is Bricks  # see `Bricks.kind`
            errors[index] = "the values are not finite" if not_finite else f"{code} is no Region"
    for (channel, values), is_finite in zip(floats, finite, strict=True):
        if is_finite:
            continue
        bad = ~torch.isfinite(values).flatten(1).all(1)
        for index in bad.nonzero()[:, 0].tolist():
            errors.setdefault(index, f"channel {channel!r} holds NaN or infinite values")
    return counts
