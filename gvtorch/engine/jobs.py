"""`Job`: what a producer is asked, and its answer: checked, put on its way to the device, or turned
into the words of tiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..base.constants import ABSENT, CONSTANT, EMPTY, REQUEST_LOAD, TERMINAL
from ..base.volume import movable
from ..cache import Cache, Children
from ..pool import N3Tree, Rows, Staging
from ..pool.staging import Shipment, on_host, upload
from ..producers import Bricks, Layout, Nodes, Producer, Region, Regions
from ..producers.answer import checked_bricks, checked_regions, count_kinds


@dataclass(frozen=True, eq=False)
class Plant:
    """A tree and what makes it grow."""

    name: str
    tree: N3Tree
    producer: Producer
    layout: Layout


@dataclass(frozen=True, eq=False)
class Job:
    """Items asked for together."""

    plant: Plant
    kind: int
    node: Tensor  # (k,) int64: nodes to fill, or to subdivide
    loc: Tensor  # (k, 4) their places
    same: Tensor | None = None  # (k, 4) places that are filled in their stead: they are aliases

    def __len__(self) -> int:
        return len(self.node)

    def __getitem__(self, index: slice | Tensor) -> Job:
        if isinstance(index, Tensor):
            index = upload(index, self.node.device)
        same = None if self.same is None else self.same[index]
        return Job(self.plant, self.kind, self.node[index], self.loc[index], same)

    @property
    def bricks(self) -> Nodes:
        """What a producer is asked to fill."""
        return Nodes(self.loc if self.same is None else self.same, self.plant.layout)

    def ask(self) -> Any:
        """Calls the producer."""
        if self.kind == REQUEST_LOAD:
            return self.plant.producer.fill(self.bricks)
        return self.plant.producer.classify(self.children)

    @cached_property
    def children(self) -> Nodes:
        """All children of all nodes, node after node."""
        n = self.plant.layout.branching
        child = torch.arange(n**3, device=self.loc.device)
        digits = torch.stack((child % n, child // n % n, child // n**2, torch.ones_like(child)), 1)
        low = torch.cat((self.loc[:, :3] * n, self.loc[:, 3:]), 1)
        return Nodes((low[:, None] + digits).flatten(0, 1), self.plant.layout)

    def check(self, answer: Any) -> Answer:
        """Checks an answer; see producers/answer.py."""
        if isinstance(answer, Sent):
            return answer
        if self.kind == REQUEST_LOAD:
            return checked_bricks(answer, self.bricks, self.plant.producer)
        return checked_regions(answer, self.children, self.plant.producer)


@dataclass(frozen=True, eq=False)
class Sent:
    """Voxels that were checked, found right, and are on their way to the device."""

    shipment: Shipment
    errors: Mapping[int, str] = field(default_factory=dict)


Answer = Regions | Bricks | Sent
AnyAnswer = TypeVar("AnyAnswer", bound=Answer)


def children_of(job: Job, answer: Regions, cache: Cache) -> Children:
    """Turns a producer's regions into the words of tiles."""
    layout, count = job.plant.layout, len(job)
    nodes = job.children
    kind = answer.kind
    step = nodes.scale * layout.brick_size
    low = nodes.loc[:, :3] * step[:, None]
    kind = torch.where((low >= layout.extent_3).any(1), Region.EMPTY, kind)
    leaf = (kind == Region.EMPTY) | (kind == Region.CONSTANT) | (kind == Region.DATA_MAX_DEPTH)
    leaf |= nodes.depth >= layout.depth
    child = torch.where(leaf, TERMINAL, ABSENT).to(torch.int32)
    brick = torch.where(kind == Region.EMPTY, EMPTY, ABSENT)
    brick = torch.where(kind == Region.CONSTANT, CONSTANT, brick).to(torch.int32)

    def by_tile(values: Tensor) -> Tensor:
        return values.unflatten(0, (count, -1))

    constants = dict(answer.constants)
    for name, words in cache.nodes.constants.items():  # also what another tree left in these tiles
        if name not in constants:
            constants[name] = words.new_zeros((len(kind), words.shape[-1]))
    ranges = dict(answer.ranges)
    for name in cache.nodes.ranges:
        if name in ranges:
            continue
        ranges[name] = unknown_range(cache, name, len(kind))
        if name in answer.constants:
            ends = movable(answer.constants[name])[:, None].expand(-1, 2, -1)
            uniform = (kind == Region.CONSTANT)[:, None, None]
            merged = torch.where(uniform, ends, movable(ranges[name]))
            ranges[name] = merged.view(ranges[name].dtype)
    return Children(
        child=by_tile(child),
        brick=by_tile(brick),
        constants={name: by_tile(values) for name, values in constants.items()},
        ranges={name: by_tile(values) for name, values in ranges.items()},
        is_alias=by_tile(kind == Region.ALIAS),
        alias=None if answer.alias is None else by_tile(answer.alias),
    )


def unknown_range(cache: Cache, name: str, count: int) -> Tensor:
    """(k, 2, c) all that a channel can hold."""
    channel, device = cache.bricks.channels[name], cache.nodes.child_tn.device
    shape = (count, channel.width)
    ends = [torch.full(shape, end, dtype=channel.dtype, device=device) for end in channel.limits]
    return torch.stack([movable(end) for end in ends], 1).view(channel.dtype)


def by_kind(job: Job, answer: Bricks) -> list[tuple[Region, Job, Bricks]]:
    """The items that are written in one way: DATA for voxels, CONSTANT for what needs none, ALIAS.
    An answer on a device is looked at once.
    """
    kind = answer.kind
    if kind is None:
        return [(Region.DATA, job, answer)]
    empty, constant, data, last, alias = count_kinds(kind).tolist()
    counts = {Region.DATA: data + last, Region.CONSTANT: empty + constant, Region.ALIAS: alias}
    found = [what for what, count in counts.items() if count]
    if len(found) == 1:
        return [(found[0], job, answer)]
    masks = {
        Region.DATA: (kind == Region.DATA) | (kind == Region.DATA_MAX_DEPTH),
        Region.CONSTANT: (kind == Region.EMPTY) | (kind == Region.CONSTANT),
        Region.ALIAS: kind == Region.ALIAS,
    }
    groups = []
    for what in found:
        rows = torch.nonzero_static(masks[what], size=counts[what])[:, 0]
        groups.append((what, job[rows], select(answer, rows)))
    return groups


def send_ahead(job: Job, answer: Any, staging: Staging) -> Any:
    """Checks an answer and sends it; returns it as it is unless it is voxels from the host and
    nothing else, all of them right.
    """
    data = answer.data if isinstance(answer, Bricks) else answer
    if not isinstance(data, Mapping) or not all(
        isinstance(rows, Rows) or (isinstance(rows, Tensor) and rows.device.type == "cpu")
        for rows in data.values()
    ):
        return answer
    try:
        checked = job.check(answer)
    except ValueError:
        return answer  # the frame tells of it
    if not isinstance(checked, Bricks) or checked.errors:
        return answer
    way = shipped(job, checked, staging)
    return way if isinstance(way, Sent) else answer


def shipped(job: Job, answer: AnyAnswer, staging: Staging | None) -> AnyAnswer | Sent:
    """Puts a checked answer on its way if it is voxels from the host and nothing else."""
    if staging is None or not isinstance(answer, Bricks) or not on_host(answer.data):
        return answer
    if answer.kind is not None:
        if int(count_kinds(answer.kind)[Region.DATA : Region.ALIAS].sum()) < len(job):
            return answer
    return Sent(staging.send(answer.data))


def select(answer: Any, row: Tensor) -> Any:
    """The items of an answer that `row` (m,) names, errors left out."""

    def rows(value: Any) -> Any:
        if isinstance(value, Rows):
            return value[row]
        if isinstance(value, Tensor):
            return movable(value)[row.to(value.device)].view(value.dtype)
        if isinstance(value, dict):
            return {name: rows(tensor) for name, tensor in value.items()}
        return value

    fields = {name: rows(value) for name, value in vars(answer).items() if name != "errors"}
    return type(answer)(**fields, errors={})
