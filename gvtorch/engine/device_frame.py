"""`DeviceFrame`: recorded frames whose producers answer on the device and are recorded as well, so
that the host takes no part. A batch that is not full is padded with the root, whose answers are
discarded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..base.branches import in_branches
from ..base.constants import ABSENT, REQUEST_LOAD, REQUEST_PRIORITY, REQUEST_SUBDIVIDE
from ..cache.requests import levels_wanted, nodes_to_subdivide
from ..cache.write import Children, Targets, put_bricks, put_tiles, put_uniform, write_rows
from ..producers import Region
from ..producers.answer import checked_bricks, checked_regions
from .parents import nearest_loadable, parent_bricks, without_repeats
from .production import Production
from .recorded import RecordedFrame
from .request_batch import ProducedTree, RequestBatch, brick_words, children_of
from .stats import FrameStats


class UncheckedAnswer(NamedTuple):
    """A producer's answer to a batch, not checked yet."""

    node: Tensor  # (batch,) int64 nodes that were asked for, -1 for none
    batch: RequestBatch
    answer: Any


class MadeTiles(NamedTuple):
    """Tiles that a producer's answer describes, not written yet."""

    targets: Targets  # nodes (batch,) to subdivide, -1 for none
    children: Children
    failed: Tensor  # () int64 number of nodes with an invalid answer


class DeviceFrame(RecordedFrame):
    """Frames of an engine whose producers all answer on the device (`Producer.on_device`)."""

    def __init__(self, production: Production, batch: int, fit: bool) -> None:
        super().__init__(production, batch, fit)
        # (batch, 2) nodes made last that are to be subdivided in turn, and their priorities.
        self._next_subdivisions = self._unused_slots.new_zeros((batch, 2)) - 1
        self.serve()  # warm-up before recording; there are no requests yet
        self.deepen()

    def begin(self, stale: bool, steady: bool, stats: FrameStats) -> bool:
        """Returns whether the listed requests are to be served; see `RecordedFrame`."""
        if stale:
            self._requests.zero_()  # the listed requests are out of date: the rays ask again
        return not steady

    def serve(self) -> None:
        """Serves the requests of the last frame that rank first. Bricks are made and written while
        tiles are made, which are written after that.
        """
        loads, subdivisions = self.choose()
        _, tiles = in_branches(
            partial(self._load, loads.node), partial(self._make_tiles, subdivisions.node)
        )
        self._subdivide(tiles, *subdivisions)

    def deepen(self) -> None:
        """Subdivides nodes that `serve` or the previous `deepen` has just made, where the priority
        of the parent shows that rays will want finer ones, so that no ray has to ask for them.
        """
        chosen, priority = self._next_subdivisions.unbind(1)
        self._subdivide(self._make_tiles(chosen), chosen, priority)

    def _count_levels(self) -> Tensor:
        if self._production.by_level:
            return super()._count_levels()
        word = self._requests[:, 1].flatten()
        priority = torch.where((word & REQUEST_SUBDIVIDE) != 0, word & REQUEST_PRIORITY, -1)
        branching = max(source.layout.branching for source in self.trees)
        return levels_wanted(priority, branching)

    def _ask_producers(self, kind: int, chosen: Tensor) -> list[UncheckedAnswer]:
        """Asks each tree's producer for those of the nodes (batch,) that belong to its tree."""
        tree_number, answers = self.tree_of(chosen), []
        for source in self.trees:
            node = torch.where(tree_number == source.tree.number, chosen, -1)
            if kind == REQUEST_LOAD and source.producer.needs_parent:
                node = without_repeats(nearest_loadable(self.cache, node, source.layout.depth))
            batch = self._padded_batch(source, kind, node)
            answers.append(UncheckedAnswer(node, batch, batch.ask()))
        return answers

    def _subdivide(self, made: Sequence[MadeTiles], chosen: Tensor, priority: Tensor) -> None:
        """Writes the tiles made for nodes (batch,), counts what was written and what failed, and
        lists the children to subdivide next, in order.
        """
        slot, child_priority = torch.full_like(chosen, -1), torch.zeros_like(chosen)
        for targets, children, failed in made:
            outcome = put_tiles(self.cache, targets, children, self._tiles.unused)
            self._tiles.add(outcome)
            self._failed_nodes.add_(failed)
            in_tree = targets.node >= 0
            slot = torch.where(in_tree, outcome.slot, slot)
            child_priority = torch.where(
                in_tree, priority // targets.tree.branching, child_priority
            )
        node, split = nodes_to_subdivide(self.cache, slot, child_priority, self._tiles.unused)
        rank = split.flatten().cumsum(0)
        rows = torch.stack((node, child_priority[:, None].expand_as(node)), 2).flatten(0, 1)
        self._next_subdivisions.fill_(-1)
        listed = split.flatten() & (rank <= self.batch)
        write_rows(self._next_subdivisions, torch.where(listed, rank - 1, -1), rows)

    def _load(self, chosen: Tensor) -> None:
        """Gives nodes (batch,) their bricks."""
        for answer in self._ask_producers(REQUEST_LOAD, chosen):
            self._write_bricks(answer)

    def _write_bricks(self, unchecked: UncheckedAnswer) -> None:
        """Checks bricks, writes them, and counts what was written and what failed."""
        node, batch, answer = unchecked
        bricks = checked_bricks(answer, batch.nodes, batch.source.producer, check_values=False)
        valid = _finite([bricks.data, bricks.constants], len(node), node.device)
        has_data = valid
        if bricks.kind is not None:
            word = brick_words(bricks.kind)
            uniform = valid & (word != ABSENT)
            has_data = valid & (bricks.kind >= Region.DATA) & (bricks.kind <= Region.DATA_MAX_DEPTH)
            valid = has_data | uniform
            targets = _masked_targets(batch.targets, node, uniform)
            self._uniform_nodes.add_(put_uniform(self.cache, targets, word, bricks.constants))
        targets = _masked_targets(batch.targets, node, has_data)
        self._bricks.add(put_bricks(self.cache, targets, bricks.data, self._bricks.unused))
        self._failed_nodes.add_(((node >= 0) & ~valid).sum())

    def _make_tiles(self, chosen: Tensor) -> list[MadeTiles]:
        """Asks producers for the regions of the children of nodes (batch,), and checks these."""
        made = []
        for node, batch, answer in self._ask_producers(REQUEST_SUBDIVIDE, chosen):
            regions = checked_regions(
                answer, batch.nodes, batch.source.producer, check_values=False
            )
            count = len(regions.kind)
            valid = _finite([regions.constants, regions.ranges], count, node.device)
            valid = valid & (regions.kind >= Region.EMPTY) & (regions.kind <= Region.DATA_MAX_DEPTH)
            valid = valid.view(len(node), -1).all(1)
            children = children_of(batch, regions, self.cache)
            failed = ((node >= 0) & ~valid).sum()
            made.append(MadeTiles(_masked_targets(batch.targets, node, valid), children, failed))
        return made

    def _padded_batch(self, source: ProducedTree, kind: int, node: Tensor) -> RequestBatch:
        """Returns the request batch of nodes (k,), with the root where the index is -1."""
        padded = torch.where(node >= 0, node, source.tree.root)
        batch = RequestBatch(source, kind, Targets(source.tree, padded, source.tree.loc(padded)))
        if kind == REQUEST_LOAD and source.producer.needs_parent:
            return replace(batch, parents=parent_bricks(self.cache, source, padded))
        return batch


def _masked_targets(targets: Targets, node: Tensor, mask: Tensor) -> Targets:
    """Returns the targets with node -1 for padding and wherever `mask` (k,) is false."""
    return replace(targets, node=torch.where(mask, node, -1))


def _finite(field_groups: Sequence[Mapping[str, Any]], count: int, device: torch.device) -> Tensor:
    """Returns (k,) bool, which items hold neither NaN nor infinite values."""
    finite = torch.ones(count, dtype=torch.bool, device=device)
    for by_channel in field_groups:
        for values in by_channel.values():
            if values.is_floating_point():
                finite = finite & torch.isfinite(values).flatten(1).all(1)
    return finite
