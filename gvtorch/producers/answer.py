"""Checks what a producer answered, item by item: a bad one becomes an error, the others stay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from .. import check
from ..pool import Channel
from ..volume import movable
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions


def checked_regions(answer: Any, nodes: Nodes, producer: Producer) -> Regions:
    """Returns `Regions` on the layout's device.

    Raises:
        ValueError: The answer is of the wrong type, shape or dtype.
    """
    where = f"{type(producer).__name__}.classify"
    if isinstance(answer, Tensor):
        answer = Regions(kind=answer)
    if not isinstance(answer, Regions):
        raise ValueError(f"{where}: must return Regions or a tensor, got {_name(answer)}")
    count, device = len(nodes), nodes.layout.device
    errors = _known_errors(where, answer.errors, count)
    kind = _kind(where, answer.kind, count, device, errors)
    shapes = {"constants": (), "ranges": (2,)}
    fields = {
        name: _by_channel(where, name, getattr(answer, name), (count, *shape), producer, device)
        for name, shape in shapes.items()
    }
    _need_constants(where, kind, fields["constants"], producer)
    alias = _alias(where, answer.alias, kind, nodes.layout, errors)
    for values in fields.values():
        _refuse_nan(values, errors)
    return Regions(kind=kind, alias=alias, errors=errors, **fields)


def checked_bricks(answer: Any, nodes: Nodes, producer: Producer) -> Bricks:
    """Returns `Bricks` on the layout's device, in which items that hold NaN are errors.

    Raises:
        ValueError: The answer is of the wrong type, shape or dtype.
    """
    where = f"{type(producer).__name__}.fill"
    if isinstance(answer, Mapping):
        answer = Bricks(data=answer)
    if not isinstance(answer, Bricks):
        raise ValueError(f"{where}: must return Bricks or a dict of tensors, got {_name(answer)}")
    layout = nodes.layout
    count, device = len(nodes), layout.device
    errors = _known_errors(where, answer.errors, count)
    whole = torch.full((count,), Region.DATA) if answer.kind is None else answer.kind
    kind = _kind(where, whole, count, device, errors)
    side = layout.brick_size + 2 * layout.border
    missing = sorted(set(producer.channels) - set(answer.data))
    if missing:
        raise ValueError(f"{where}: channel {missing[0]!r} is missing")
    shape = (count, side, side, side)
    data = _by_channel(where, "data", answer.data, shape, producer, device)
    constants = _by_channel(where, "constants", answer.constants, (count,), producer, device)
    _refuse_nan(data, errors)
    _refuse_nan(constants, errors)
    _need_constants(where, kind, constants, producer)
    alias = _alias(where, answer.alias, kind, layout, errors)
    return Bricks(data=data, kind=kind, constants=constants, alias=alias, errors=errors)


def layout_of(
    producer: Producer, depth: int, brick_size: int, border: int, device: torch.device
) -> Layout:
    """Returns how a producer's world is cut."""
    return Layout(
        depth=depth,
        branching=producer.branching,
        brick_size=brick_size,
        border=border,
        extent=producer.extent,
        spacing=producer.spacing,
        origin=producer.origin,
        device=device,
    )


def _name(answer: Any) -> str:
    return type(answer).__name__


def _known_errors(where: str, errors: Mapping[int, str], count: int) -> dict[int, str]:
    if any(not 0 <= index < count for index in errors):
        raise ValueError(f"{where}: errors names an item that is not in the batch of {count}")
    return dict(errors)


def _kind(
    where: str, kind: Any, count: int, device: torch.device, errors: dict[int, str]
) -> Tensor:
    if not isinstance(kind, Tensor) or kind.shape != (count,) or kind.is_floating_point():
        raise ValueError(f"{where}: kind must be ({count},) of Region, got {check.describe(kind)}")
    kind = kind.to(device=device, dtype=torch.int64)
    wrong = (kind < Region.EMPTY) | (kind > Region.ALIAS)
    for index in wrong.nonzero()[:, 0].tolist():
        errors[index] = f"{int(kind[index])} is no Region"
    return kind


def _by_channel(
    where: str,
    name: str,
    values: Mapping[str, Tensor],
    shape: tuple[int, ...],
    producer: Producer,
    device: torch.device,
) -> dict[str, Tensor]:
    result = {}
    for channel, value in values.items():
        if channel not in producer.channels:
            known = ", ".join(producer.channels)
            raise ValueError(f"{where}: {name} has channel {channel!r}; the producer has {known}")
        what: Channel = producer.channels[channel]
        wanted = (*shape, what.width)
        plain = isinstance(value, Tensor) and what.width == 1 and value.shape == shape
        tensor = value[..., None] if plain else value
        fits = isinstance(tensor, Tensor) and tensor.shape == wanted and tensor.dtype == what.dtype
        if not fits:
            sizes = ", ".join(str(size) for size in wanted)
            dtype = str(what.dtype).removeprefix("torch.")
            raise ValueError(
                f"{where}: {name}[{channel!r}] must be ({sizes}) {dtype}, "
                f"got {check.describe(tensor)}"
            )
        result[channel] = movable(tensor.detach()).to(device).view(what.dtype)
    return result


def _need_constants(
    where: str, kind: Tensor, constants: Mapping[str, Tensor], producer: Producer
) -> None:
    missing = sorted(set(producer.channels) - set(constants))
    if missing and bool((kind == Region.CONSTANT).any()):
        raise ValueError(f"{where}: constants must hold channel {missing[0]!r} of CONSTANT items")


def _alias(
    where: str, alias: Any, kind: Tensor, layout: Layout, errors: dict[int, str]
) -> Tensor | None:
    is_alias = kind == Region.ALIAS
    if not bool(is_alias.any()):
        return None
    if not isinstance(alias, Tensor) or alias.shape != (len(kind), 4):
        raise ValueError(
            f"{where}: alias must be ({len(kind)}, 4) where an item is ALIAS, "
            f"got {check.describe(alias)}"
        )
    alias = alias.to(device=layout.device, dtype=torch.int64)
    depth = alias[:, 3]
    nodes = float(layout.branching) ** depth.clamp(0, layout.depth).to(torch.float64)
    inside = ((alias[:, :3] >= 0) & (alias[:, :3] < nodes[:, None])).all(1)
    wrong = is_alias & ~(inside & (depth >= 0) & (depth <= layout.depth))
    for index in wrong.nonzero()[:, 0].tolist():
        errors.setdefault(index, f"alias {tuple(alias[index].tolist())} is no node of this tree")
    return alias


def _refuse_nan(values: Mapping[str, Tensor], errors: dict[int, str]) -> None:
    for channel, tensor in values.items():
        if not tensor.is_floating_point() or tensor.numel() == 0:
            continue
        if bool(torch.isfinite(tensor.sum(dtype=torch.float32))):
            continue
        bad = ~torch.isfinite(tensor).flatten(1).all(1)
        for index in bad.nonzero()[:, 0].tolist():
            errors.setdefault(index, f"channel {channel!r} holds NaN or infinite values")
