"""`RequestBatch`: what a producer is asked, and how its answer is prepared for writing."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from ..base.constants import ABSENT, CONSTANT, EMPTY, REQUEST_LOAD, TERMINAL
from ..base.volume import movable
from ..cache import Cache
from ..cache.write import Children, Targets
from ..pool import N3Tree
from ..pool.staging import SentBricks, Staging, TableRows, on_host, upload
from ..producers import Bricks, Layout, Nodes, Producer, Region, Regions
from ..producers.answer import checked_bricks, checked_regions, count_kinds

#: First and last `Region` of the kinds of answers that are written in the same way.
_WRITTEN_ALIKE = (
    (Region.ALIAS, Region.ALIAS),
    (Region.EMPTY, Region.CONSTANT),
    (Region.DATA, Region.DATA_MAX_DEPTH),
)


@dataclass(frozen=True, eq=False, repr=False)
class ProducedTree:
    """A tree and its producer."""

    name: str
    tree: N3Tree
    producer: Producer
    layout: Layout
    engine_patience: float  # seconds, for producers without their own

    @property
    def patience(self) -> float:
        """Seconds after which an answer that has not come is given up."""
        return self.producer.patience_in(self.engine_patience)

    def ask(self, kind: int, nodes: Nodes) -> Any:
        """Calls the producer, which records no gradients: bricks carry none, and what a backward
        pass would need is a multiple of their size.
        """
        producer_call = self.producer.fill if kind == REQUEST_LOAD else self.producer.classify
        with torch.no_grad():
            return producer_call(nodes)

    def wait(self, answer: Any) -> Any:
        """Returns the producer's answer; waits for a future, at most for `patience`."""
        if not isinstance(answer, Future):
            return answer
        try:
            return answer.result(None if self.patience == math.inf else self.patience)
        except TimeoutError:
            if answer.done():  # the error is the answer
                raise
            answer.cancel()
            raise TimeoutError(self.no_answer) from None

    @property
    def no_answer(self) -> str:
        """The message about an answer that has not come in time."""
        return f"no answer within {self.patience:g} s"

    @cached_property
    def host_layout(self) -> Layout:
        """The layout, with its tensors in host memory."""
        return replace(self.layout, device=torch.device("cpu"))

    def __repr__(self) -> str:
        return f"ProducedTree({self.name!r}, {type(self.producer).__name__})"


@dataclass(frozen=True, eq=False, repr=False)
class RequestBatch:
    """Requests of one kind that go to one producer together."""

    source: ProducedTree
    kind: int
    targets: Targets  # nodes to fill, or to subdivide
    parents: Mapping[str, Tensor] | None = None  # (k, z, y, x, c) bricks, where needed
    coarse: bool = False  # their bricks take coarse slots
    generation: int | None = None  # of the `HostFrame` that asks; targets are then on the host
    # Numbers the calls that raise, of this batch and its parts; `next` is safe between threads.
    raised: Iterator[int] = field(default_factory=partial(itertools.count, 1))

    def __len__(self) -> int:
        return len(self.targets)

    def by_slots(self) -> list[RequestBatch]:
        """Returns the batch; or, where its bricks take both kinds of slots, a batch for each."""
        channels = self.source.producer.channels.values()
        if not len(self) or self.kind != REQUEST_LOAD or not any(c.coarse for c in channels):
            return [self] if len(self) else []
        coarse = self.loc[:, 3] < self.source.tree.depth
        count, parts = int(coarse.sum()), []
        for mask, size in ((~coarse, len(self) - count), (coarse, count)):
            if size:
                row = torch.nonzero_static(mask, size=size)[:, 0]
                part = self if size == len(self) else self[row]
                parts.append(replace(part, coarse=mask is coarse))
        return parts

    def __getitem__(self, index: slice | Tensor) -> RequestBatch:
        if isinstance(index, Tensor):
            index = upload(index, self.targets.node.device)
        parents = self.parents
        if parents is not None:
            parents = {name: rows[index] for name, rows in parents.items()}
        return replace(self, targets=self.targets[index], parents=parents)

    @property
    def nodes(self) -> Nodes:
        """The nodes that the producer is asked for; a new object: `Nodes` caches positions."""
        layout = self.source.layout if self.generation is None else self.source.host_layout
        return Nodes(self.loc, layout, coarse=self.coarse, parents=self.parents)

    @cached_property
    def loc(self) -> Tensor:
        """(m, 4) nodes to fill, or all children of the nodes to subdivide, node after node."""
        loc, n = self.targets.loc, self.source.layout.branching
        if self.kind == REQUEST_LOAD:
            return loc
        child = torch.arange(n**3, device=loc.device)
        digits = torch.stack((child % n, child // n % n, child // n**2, torch.ones_like(child)), 1)
        low = torch.cat((loc[:, :3] * n, loc[:, 3:]), 1)
        return (low[:, None] + digits).flatten(0, 1)

    @property
    def per_node(self) -> int:
        """How many items an answer has for each node of the batch."""
        return len(self.loc) // len(self)

    def alias_tree(self, answer: Regions | Bricks) -> int:
        """Number of the tree in which the alias targets of an answer lie."""
        name, layout = answer.alias_tree, self.source.layout
        return self.source.tree.number if name is None else [*layout.scene].index(name)

    def ask(self) -> Any:
        return self.source.ask(self.kind, self.nodes)

    def check(self, answer: Any) -> Regions | Bricks:
        """Checks an answer; see producers/answer.py."""
        check_answer = checked_bricks if self.kind == REQUEST_LOAD else checked_regions
        return check_answer(answer, self.nodes, self.source.producer)


def brick_words(kind: Tensor) -> Tensor:
    """Returns brick words (k,) int32 of nodes whose kinds of `Region` are (k,): EMPTY or CONSTANT
    where no brick is needed, else ABSENT.
    """
    word = torch.where(kind == Region.EMPTY, EMPTY, ABSENT)
    return torch.where(kind == Region.CONSTANT, CONSTANT, word).to(torch.int32)


def children_of(batch: RequestBatch, answer: Regions, cache: Cache) -> Children:
    """Turns a producer's regions into the words of tiles, on the device of the regions."""
    nodes = batch.nodes
    layout = nodes.layout
    low = nodes.loc[:, :3] * (nodes.scale * layout.brick_size)[:, None]
    kind = torch.where((low >= layout.extent_3).any(1), Region.EMPTY, answer.kind)
    brick = brick_words(kind)
    is_leaf = (brick != ABSENT) | (kind == Region.DATA_MAX_DEPTH) | (nodes.depth >= layout.depth)
    child = torch.where(is_leaf, TERMINAL, ABSENT).to(torch.int32)
    constants, ranges = dict(answer.constants), dict(answer.ranges)
    for name, stored in cache.nodes.constants.items():  # overwrites what other trees left there
        if name not in constants:
            shape = (len(kind), stored.shape[-1])
            constants[name] = torch.zeros(shape, dtype=stored.dtype, device=kind.device)
        if name not in ranges:
            ranges[name] = _default_range(cache, name, kind, answer.constants.get(name))

    def by_tile(values: Tensor) -> Tensor:
        return values.unflatten(0, (len(batch), -1))

    return Children(
        child=by_tile(child),
        brick=by_tile(brick),
        constants={name: by_tile(values) for name, values in constants.items()},
        ranges={name: by_tile(values) for name, values in ranges.items()},
        is_alias=by_tile(kind == Region.ALIAS),
        alias=None if answer.alias is None else by_tile(answer.alias),
        alias_tree=batch.alias_tree(answer),
    )


def _default_range(cache: Cache, name: str, kind: Tensor, constant: Tensor | None) -> Tensor:
    """Returns (k, 2, c) ranges not given: constants (k, c) of CONSTANT nodes, else the dtype's."""
    ranges = cache.bricks.channels[name].unknown_range(len(kind), device=kind.device)
    if constant is None:
        return ranges
    uniform = (kind == Region.CONSTANT)[:, None, None]
    rows = torch.where(uniform, movable(constant)[:, None].expand(-1, 2, -1), movable(ranges))
    return rows.view(ranges.dtype)


def by_kind(batch: RequestBatch, answer: Bricks) -> dict[Region, tuple[RequestBatch, Bricks]]:
    """Splits an answer by how it is written: ALIAS, EMPTY (needs no brick), DATA, in this order."""
    if answer.kind is None:
        return {Region.DATA: (batch, answer)}
    counts, groups = count_kinds(answer.kind).tolist(), {}
    for first, last in _WRITTEN_ALIKE:
        size = sum(counts[first : last + 1])
        if size == len(batch):
            return {first: (batch, answer)}
        if size:
            mask = (answer.kind >= first) & (answer.kind <= last)
            row = torch.nonzero_static(mask, size=size)[:, 0]
            groups[first] = batch[row], answer.rows(row)
    return groups


def send_voxels(
    batch: RequestBatch, answer: Regions | Bricks | SentBricks, staging: Staging | None
) -> Regions | Bricks | SentBricks:
    """Sends a checked answer to the device if it is only voxels, on the host; else returns it."""
    if staging is None or not isinstance(answer, Bricks) or not on_host(answer.data):
        return answer
    kind = answer.kind
    if kind is not None and int(count_kinds(kind)[Region.DATA : Region.ALIAS].sum()) < len(batch):
        return answer
    return staging.send(answer.data)


def check_and_send(batch: RequestBatch, answer: Any, staging: Staging) -> Any:
    """Sends an answer to the device if it is only valid voxels, on the host; else returns it."""
    data = answer.data if isinstance(answer, Bricks) else answer
    if not isinstance(data, Mapping) or not all(
        isinstance(rows, TableRows) or (isinstance(rows, Tensor) and rows.device.type == "cpu")
        for rows in data.values()
    ):
        return answer
    try:
        checked = batch.check(answer)
    except Exception:
        return answer  # the frame reports it
    sent = answer if checked.errors else send_voxels(batch, checked, staging)
    return sent if isinstance(sent, SentBricks) else answer
