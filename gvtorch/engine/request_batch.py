"""`RequestBatch`: what a producer is asked, and its answer: checked, sent to the device, or turned
into the words of tiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from ..base.constants import ABSENT, CONSTANT, EMPTY, REQUEST_LOAD, TERMINAL
from ..base.volume import movable
from ..cache import KINDS, Cache
from ..cache.write import Children, Targets
from ..pool import N3Tree, Staging, TableRows
from ..pool.brick_table import on_host
from ..pool.staging import Shipment, upload
from ..producers import Bricks, Layout, Nodes, Producer, Region, Regions
from ..producers.answer import checked_bricks, checked_regions, count_kinds


@dataclass(frozen=True, eq=False, repr=False)
class ProducedTree:
    """A tree and its producer."""

    name: str
    tree: N3Tree
    producer: Producer
    layout: Layout

    def __repr__(self) -> str:
        return f"ProducedTree({self.name!r}, {type(self.producer).__name__})"


@dataclass(frozen=True, eq=False, repr=False)
class RequestBatch:
    """Requests of one kind that go to one producer together."""

    source: ProducedTree
    kind: int
    targets: Targets  # nodes to fill, or to subdivide
    fill_loc: Tensor | None = None  # (k, 4) filled in their stead: alias targets

    def __len__(self) -> int:
        """Number of nodes."""
        return len(self.targets)

    def __getitem__(self, index: slice | Tensor) -> RequestBatch:
        """Some of the requests."""
        if isinstance(index, Tensor):
            index = upload(index, self.targets.node.device)
        fill_loc = None if self.fill_loc is None else self.fill_loc[index]
        return RequestBatch(self.source, self.kind, self.targets[index], fill_loc)

    @property
    def kind_name(self) -> str:
        """Load or subdivide."""
        return next(name for name, kind in KINDS.items() if kind == self.kind)

    @property
    def bricks(self) -> Nodes:
        """What a producer is asked to fill."""
        loc = self.targets.loc if self.fill_loc is None else self.fill_loc
        return Nodes(loc, self.source.layout)

    @cached_property
    def children(self) -> Nodes:
        """What a producer is asked to classify: all children of all nodes, node after node."""
        n, loc = self.source.layout.branching, self.targets.loc
        child = torch.arange(n**3, device=loc.device)
        digits = torch.stack((child % n, child // n % n, child // n**2, torch.ones_like(child)), 1)
        low = torch.cat((loc[:, :3] * n, loc[:, 3:]), 1)
        return Nodes((low[:, None] + digits).flatten(0, 1), self.source.layout)

    def ask(self) -> Any:
        """Calls the producer."""
        if self.kind == REQUEST_LOAD:
            return self.source.producer.fill(self.bricks)
        return self.source.producer.classify(self.children)

    def check(self, answer: Any) -> Answer:
        """Checks an answer; see producers/answer.py."""
        if isinstance(answer, Sent):
            return answer
        if self.kind == REQUEST_LOAD:
            return checked_bricks(answer, self.bricks, self.source.producer)
        return checked_regions(answer, self.children, self.source.producer)

    def __repr__(self) -> str:
        return f"RequestBatch({self.kind_name} {len(self)} of {self.source.name!r})"


@dataclass(frozen=True, eq=False)
class Sent:
    """Voxels that were checked, found right, and are on their way to the device."""

    shipment: Shipment
    errors: Mapping[int, str] = field(default_factory=dict)


Answer = Regions | Bricks | Sent
AnyAnswer = TypeVar("AnyAnswer", bound=Answer)


class Answered(NamedTuple):
    """A batch and its answer, checked; items that failed are left out of both."""

    batch: RequestBatch
    answer: Answer


def children_of(batch: RequestBatch, answer: Regions, cache: Cache) -> Children:
    """Turns a producer's regions into the words of tiles."""
    layout, nodes = batch.source.layout, batch.children
    low = nodes.loc[:, :3] * (nodes.scale * layout.brick_size)[:, None]
    kind = torch.where((low >= layout.extent_3).any(1), Region.EMPTY, answer.kind)
    leaf = (kind == Region.EMPTY) | (kind == Region.CONSTANT) | (kind == Region.DATA_MAX_DEPTH)
    leaf |= nodes.depth >= layout.depth
    child = torch.where(leaf, TERMINAL, ABSENT).to(torch.int32)
    brick = torch.where(kind == Region.EMPTY, EMPTY, ABSENT)
    brick = torch.where(kind == Region.CONSTANT, CONSTANT, brick).to(torch.int32)
    constants = dict(answer.constants)
    for name, words in cache.nodes.constants.items():  # also what another tree left in these tiles
        if name not in constants:
            constants[name] = words.new_zeros((len(kind), words.shape[-1]))
    ranges = dict(answer.ranges)
    for name in cache.nodes.ranges:
        if name not in ranges:
            ranges[name] = _untold_range(cache, name, kind, answer.constants.get(name))

    def by_tile(values: Tensor) -> Tensor:
        return values.unflatten(0, (len(batch), -1))

    return Children(
        child=by_tile(child),
        brick=by_tile(brick),
        constants={name: by_tile(values) for name, values in constants.items()},
        ranges={name: by_tile(values) for name, values in ranges.items()},
        is_alias=by_tile(kind == Region.ALIAS),
        alias=None if answer.alias is None else by_tile(answer.alias),
    )


def _untold_range(cache: Cache, name: str, kind: Tensor, constant: Tensor | None) -> Tensor:
    """(k, 2, c) a range that the producer did not tell: the constant (k, c) of CONSTANT nodes, else
    all that the channel can hold.
    """
    channel = cache.bricks.channels[name]
    shape, dtype, device = (len(kind), channel.width), channel.dtype, kind.device
    ends = [torch.full(shape, end, dtype=dtype, device=device) for end in channel.limits]
    widest = torch.stack([movable(end) for end in ends], 1)
    if constant is not None:
        uniform = (kind == Region.CONSTANT)[:, None, None]
        widest = torch.where(uniform, movable(constant)[:, None].expand(-1, 2, -1), widest)
    return widest.view(channel.dtype)


def by_kind(batch: RequestBatch, answer: Bricks) -> dict[Region, Answered]:
    """Splits an answer by how it is written: ALIAS, CONSTANT for what needs no brick, DATA for
    voxels, in this order. An answer on a device is looked at once.
    """
    kind = answer.kind
    if kind is None:
        return {Region.DATA: Answered(batch, answer)}
    empty, constant, data, last, alias = count_kinds(kind).tolist()
    counts = {Region.ALIAS: alias, Region.CONSTANT: empty + constant, Region.DATA: data + last}
    found = [what for what, count in counts.items() if count]
    if len(found) == 1:
        return {found[0]: Answered(batch, answer)}
    masks = {
        Region.ALIAS: kind == Region.ALIAS,
        Region.CONSTANT: (kind == Region.EMPTY) | (kind == Region.CONSTANT),
        Region.DATA: (kind == Region.DATA) | (kind == Region.DATA_MAX_DEPTH),
    }
    groups = {}
    for what in found:
        rows = torch.nonzero_static(masks[what], size=counts[what])[:, 0]
        groups[what] = Answered(batch[rows], select(answer, rows))
    return groups


def send_ahead(batch: RequestBatch, answer: Any, staging: Staging) -> Any:
    """Checks an answer and sends it; returns it as it is unless it is voxels from the host and
    nothing else, all of them right.
    """
    data = answer.data if isinstance(answer, Bricks) else answer
    if not isinstance(data, Mapping) or not all(
        isinstance(rows, TableRows) or (isinstance(rows, Tensor) and rows.device.type == "cpu")
        for rows in data.values()
    ):
        return answer
    try:
        checked = batch.check(answer)
    except ValueError:
        return answer  # the frame tells of it
    if checked.errors:
        return answer
    sent = shipped(batch, checked, staging)
    return sent if isinstance(sent, Sent) else answer


def shipped(batch: RequestBatch, answer: AnyAnswer, staging: Staging | None) -> AnyAnswer | Sent:
    """Sends a checked answer to the device if it is voxels from the host and nothing else."""
    if staging is None or not isinstance(answer, Bricks) or not on_host(answer.data):
        return answer
    if answer.kind is not None:
        if int(count_kinds(answer.kind)[Region.DATA : Region.ALIAS].sum()) < len(batch):
            return answer
    return Sent(staging.send(answer.data))


def select(answer: Any, row: Tensor) -> Any:
    """The items of an answer that `row` (m,) names, errors left out."""

    def rows(value: Any) -> Any:
        if isinstance(value, TableRows):
            return value[row]
        if isinstance(value, Tensor):
            return movable(value)[row.to(value.device)].view(value.dtype)
        if isinstance(value, dict):
            return {name: rows(tensor) for name, tensor in value.items()}
        return value

    fields = {name: rows(value) for name, value in vars(answer).items() if name != "errors"}
    return type(answer)(**fields, errors={})
