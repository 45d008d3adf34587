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
from ..cache.write import Targets, WriteOutcome, put_bricks, put_tiles, put_uniform, write_rows
from ..producers import Region
from ..producers.answer import checked_bricks, checked_regions
from .parents import nearest_loadable, parent_bricks, without_repeats
from .production import Production
from .recorded import RecordedFrame
from .request_batch import ProducedTree, RequestBatch, brick_words, children_of
from .stats import FrameStats, Readbacks


class UncheckedAnswer(NamedTuple):
    """A producer's answer to a batch, not checked yet."""

    node: Tensor  # (batch,) int64 nodes that were asked for, -1 for none
    batch: RequestBatch
    answer: Any


class DeviceFrame(RecordedFrame):
    """Frames of an engine whose producers all answer on the device (`Producer.on_device`)."""

    def __init__(self, production: Production, batch: int, fit: bool) -> None:
        super().__init__(production, batch, fit)
        # (batch, 2) nodes made last that are to be subdivided in turn, and their priorities.
        self._next_subdivisions = self._unused_slots.new_zeros((batch, 2)) - 1
        self.serve()  # warm-up before recording; there are no requests yet
        self.deepen()

    def begin(self, stale: bool, steady: bool, stats: FrameStats) -> bool:
        """Returns, before a frame, whether the listed requests are to be served. `stale`: another
        frame was rendered since this graph's last one; `steady`: the newest frame that was read
        back missed nothing, and the last replay did not look ahead.
        """
        if stale:
            self._requests.zero_()  # the listed requests are out of date: the rays ask again
        return not steady

    def serve(self) -> None:
        """Serves the requests of the last frame that rank first. Producers fill and classify at the
        same time; their answers are written after that.
        """
        loads, subdivisions = self.choose()
        bricks, regions = in_branches(
            partial(self._ask_producers, REQUEST_LOAD, loads.node),
            partial(self._ask_producers, REQUEST_SUBDIVIDE, subdivisions.node),
        )
        self._write_bricks(bricks)
        self._subdivide(regions, *subdivisions)

    def deepen(self) -> None:
        """Subdivides nodes that `serve` or the previous `deepen` has just made, where the priority
        of the parent shows that rays will want finer ones, so that no ray has to ask for them.
        """
        chosen, priority = self._next_subdivisions.unbind(1)
        self._subdivide(self._ask_producers(REQUEST_SUBDIVIDE, chosen), chosen, priority)

    def extra_levels(self, readbacks: Readbacks) -> int:
        """Returns how many more levels the last readback wanted on average; 0 if `by_level`."""
        return 0 if self._production.by_level else readbacks.extra_levels

    def _count_levels(self) -> Tensor:
        request_word = self._requests[:, 1].flatten()
        priority = torch.where(
            (request_word & REQUEST_SUBDIVIDE) != 0, request_word & REQUEST_PRIORITY, -1
        )
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

    def _write_bricks(self, answers: Sequence[UncheckedAnswer]) -> None:
        """Writes bricks."""
        free_slots = self._unused_slots[1:]
        for answer in answers:
            counts, uniform_count, failed_count = self._check_and_put_bricks(answer, free_slots)
            free_slots -= counts[1:2]
            self._outcomes[1:2] += counts[1:2]
            self._outcomes[2:3] += uniform_count
            self._outcomes[4:5] += counts[2:]
            self._outcomes[5:] += failed_count

    def _subdivide(
        self, answers: Sequence[UncheckedAnswer], chosen: Tensor, priority: Tensor
    ) -> None:
        """Subdivides nodes (batch,), and lists the children to subdivide next, in order."""
        free_slots = self._unused_slots[:1]
        slot, child_priority = torch.full_like(chosen, -1), torch.zeros_like(chosen)
        for answer in answers:
            in_tree, source = answer.node >= 0, answer.batch.source
            outcome, failed_count = self._check_and_put_tiles(answer, free_slots)
            free_slots -= outcome.counts[1:2]
            self._outcomes[:1] += outcome.counts[1:2]
            self._outcomes[3:4] += outcome.counts[2:]
            self._outcomes[5:] += failed_count
            slot = torch.where(in_tree, outcome.slot, slot)
            child_priority = torch.where(
                in_tree, priority // source.layout.branching, child_priority
            )
        node, split = nodes_to_subdivide(self.cache, slot, child_priority, free_slots)
        rank = split.flatten().cumsum(0)
        rows = torch.stack((node, child_priority[:, None].expand_as(node)), 2).flatten(0, 1)
        self._next_subdivisions.fill_(-1)
        listed = split.flatten() & (rank <= self.batch)
        write_rows(self._next_subdivisions, torch.where(listed, rank - 1, -1), rows)

    def _check_and_put_bricks(
        self, unchecked: UncheckedAnswer, free_slots: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Loads nodes (k,). Returns `WriteOutcome.counts`, how many need no brick (1,), and how
        many failed (1,).
        """
        node, batch, fill_answer = unchecked
        bricks = checked_bricks(fill_answer, batch.nodes, batch.source.producer, check_values=False)
        valid = _finite([bricks.data, bricks.constants], len(node), node.device)
        has_data, uniform_count = valid, torch.zeros_like(node[:1])
        if bricks.kind is not None:
            has_data = (bricks.kind == Region.DATA) | (bricks.kind == Region.DATA_MAX_DEPTH)
            word = brick_words(bricks.kind)
            uniform = word != ABSENT
            valid, has_data, uniform = (
                valid & (has_data | uniform),
                valid & has_data,
                valid & uniform,
            )
            targets = _masked_targets(batch.targets, node, uniform)
            uniform_count = put_uniform(self.cache, targets, word, bricks.constants).view(1)
        outcome = put_bricks(
            self.cache, _masked_targets(batch.targets, node, has_data), bricks.data, free_slots
        )
        return outcome.counts, uniform_count, ((node >= 0) & ~valid).sum().view(1)

    def _check_and_put_tiles(
        self, unchecked: UncheckedAnswer, free_slots: Tensor
    ) -> tuple[WriteOutcome, Tensor]:
        """Subdivides nodes (k,); returns the outcome, and how many failed (1,)."""
        node, batch, classify_answer = unchecked
        regions = checked_regions(
            classify_answer, batch.nodes, batch.source.producer, check_values=False
        )
        count = len(regions.kind)
        valid = _finite([regions.constants, regions.ranges], count, node.device)
        valid = valid & (regions.kind >= Region.EMPTY) & (regions.kind <= Region.DATA_MAX_DEPTH)
        valid = valid.view(len(node), -1).all(1)
        children = children_of(batch, regions, self.cache)
        outcome = put_tiles(
            self.cache, _masked_targets(batch.targets, node, valid), children, free_slots
        )
        return outcome, ((node >= 0) & ~valid).sum().view(1)

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
