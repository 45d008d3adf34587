"""`HostFrame`: recorded frames whose producers answer from the host, while the device goes on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ..base.constants import ABSENT, REQUEST_LOAD, REQUEST_PENDING_SHIFT, REQUEST_SUBDIVIDE
from ..base.records import Hits
from ..base.volume import movable
from ..cache import KINDS, Cache
from ..cache.write import (
    Children,
    Targets,
    WriteOutcome,
    put_bricks,
    put_tiles,
    put_uniform,
    write_rows,
)
from ..pool.staging import TableRows, Voxels
from ..producers import Bricks, Region, Regions
from .asker import Answer, Asker, PendingBatch
from .production import Production
from .recorded import RecordedFrame, SlotCounts
from .request_batch import ProducedTree, RequestBatch, brick_words, children_of
from .stats import Collected, FrameStats
from .upload_queue import RowForm, UploadQueue

_CALL_GAP = 0.02  # seconds after which a late answer no longer delays the next call


class HostFrame(RecordedFrame, Asker):
    """Frames of an engine whose producers all answer from the host (`Producer.on_host`).

    The nodes that a frame chose reach the host with its counts (`ask`). A thread asks producers for
    all nodes chosen since its last call, once that call is answered: a busy host gets the nodes of
    several frames at once, so that it catches up. If an answer takes longer than `_CALL_GAP`, it
    calls without waiting: one slow read delays nothing else. The thread in which an answer arrives
    checks and queues it; the next frame sends all queued answers, and writes them.

    Attributes:
        graph: Weak reference to the graph that replays it; None: there is no graph.
    """

    graph: Callable[[], object] | None = None

    def __init__(self, production: Production, batch: int, fit: bool) -> None:
        RecordedFrame.__init__(self, production, batch, fit)
        Asker.__init__(self)
        device = self._unused_slots.device
        forms = [_table_forms(self.cache, source) for source in self.trees]
        self._uploads = [UploadQueue(form, batch, device) for form in forms]
        self._upload_index = {source.tree.number: index for index, source in enumerate(self.trees)}
        self.generation: int = 0  # counts releases
        # Nodes asked for, and failed, since the last `release`.
        self._asked_count = self._failed_count = 0
        self.active = False  # whether frames have been rendered since the last `release`
        # Held with the lock of `Asker`, like its list:
        self._chosen: dict[int, list[Tensor]] = {kind: [] for kind in KINDS.values()}
        self._last_call = dict.fromkeys(KINDS.values(), -math.inf)  # seconds
        self._ask_scheduled = False  # whether `_ask_producers` is scheduled
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="gvtorch-ask")

    @property
    def pending(self) -> int:
        """Number of nodes whose answers are on their way."""
        sent_count = sum(queue.sent for queue in self._uploads)
        return max(0, self._asked_count - self._failed_count - sent_count)

    def begin(self, stale: bool, steady: bool, stats: FrameStats) -> bool:
        """Sends the answers that were queued, and returns whether there are any; see
        `RecordedFrame`.
        """
        self.active = True
        if stale:
            self._unused_slots.zero_()  # the counts are out of date
        self._give_up_overdue()
        self._schedule_ask()
        sent = [queue.send() for queue in self._uploads]
        stats.pending, stats.failed = self.pending, len(self._production.failures)
        return any(sent)

    def release(self) -> None:
        """Drops the answers on their way, for a frame that the host serves; rays ask again."""
        if not self.active:
            return
        self.active = False
        # An answer being processed is either queued before, and dropped below, or refused by its
        # queue because its generation is over.
        with self._lock:
            self._waiting.clear()
            self.generation += 1
            for rows in self._chosen.values():
                rows.clear()
            for queue in self._uploads:
                queue.forget()
                queue.sent = 0
            self._asked_count = self._failed_count = 0
        self._production.restore_pending()

    @property
    def abandoned(self) -> bool:
        """Whether nobody can replay it any more."""
        return self.graph is not None and self.graph() is None

    def close(self) -> None:
        """Cancels the answers on their way, and ends the thread that asks for more."""
        with self._lock:
            self.generation += 1
        self._cancel()
        self._executor.shutdown(wait=False, cancel_futures=True)

    def serve(self) -> None:
        """Writes the answers that were sent."""
        for source, queue in zip(self.trees, self._uploads, strict=True):
            self._write_answers(source, queue)

    def finish(self, hits: Hits) -> Collected:
        """Ends a frame as `RecordedFrame.finish` does, then chooses the nodes that producers are
        asked for, marks them as pending, and appends them to the counts that the host reads.
        """
        collected = super().finish(hits)
        request_words, chosen = self.cache.nodes.request_tn.view(-1), self.choose()
        for kind, (node, _) in zip(KINDS.values(), chosen, strict=True):
            marked = request_words[node.clamp(min=0)] | kind << REQUEST_PENDING_SHIFT
            write_rows(request_words[:, None], node, marked[:, None])
        node = torch.cat([group.node for group in chosen])
        tree_number = self.tree_of(node)
        loc = self.trees[0].tree.loc(node)
        for source in self.trees[1:]:  # N may differ
            in_tree = (tree_number == source.tree.number)[:, None]
            loc = torch.where(in_tree, source.tree.loc(node), loc)
        rows = torch.cat((node[:, None], tree_number[:, None].to(torch.int64), loc), 1)
        return collected._replace(numbers=torch.cat((collected.numbers, rows.flatten())))

    def to_read_back(self, collected: Collected) -> Collected:
        return collected._replace(ask=partial(self.ask, self.generation))

    def _write_answers(self, source: ProducedTree, queue: UploadQueue) -> None:
        """Writes the answers sent for one tree; nodes that found no slot may be requested again."""
        tiles, bricks, uniform, to_host = (
            queue.device_tables[table] for table in ("tiles", "bricks", "uniform", "to_host")
        )
        children = Children(
            child=tiles["child"],
            brick=tiles["brick"],
            constants=_by_channel(tiles, "constants"),
            ranges=_by_channel(tiles, "ranges"),
            is_alias=torch.zeros_like(tiles["child"], dtype=torch.bool),
            alias=None,
            alias_tree=source.tree.number,
        )
        tables = tiles, bricks, uniform
        targets = [Targets(source.tree, table["node"], table["loc"]) for table in tables]
        outcome = put_tiles(self.cache, targets[0], children, self._tiles.unused)
        self._count_outcome(REQUEST_SUBDIVIDE, self._tiles, targets[0], outcome)
        data = _by_channel(bricks, "data")
        outcome = put_bricks(self.cache, targets[1], data, self._bricks.unused)
        self._count_outcome(REQUEST_LOAD, self._bricks, targets[1], outcome)
        constants = _by_channel(uniform, "constants")
        self._uniform_nodes.add_(put_uniform(self.cache, targets[2], uniform["word"], constants))
        self._clear_pending(to_host["node"], to_host["bit"])
        queue.clear()

    def _count_outcome(
        self, kind: int, slots: SlotCounts, targets: Targets, outcome: WriteOutcome
    ) -> None:
        slots.add(outcome)
        unplaced = torch.where(outcome.wanted & (outcome.slot < 0), targets.node, -1)
        bit = torch.full_like(unplaced, kind << REQUEST_PENDING_SHIFT, dtype=torch.int32)
        self._clear_pending(unplaced, bit)

    def _clear_pending(self, node: Tensor, bit: Tensor) -> None:
        request_words = self.cache.nodes.request_tn.view(-1, 1)
        write_rows(request_words, node, request_words[node.clamp(min=0)] & ~bit[:, None])

    def ask(self, generation: int, chosen_rows: Tensor) -> int:
        """Queues the nodes that a frame chose for the thread that asks producers: (2 * batch * 6,)
        int64 on the host, for each kind rows of node, tree and loc. Returns the number of nodes,
        including those dropped because their generation is over.
        """
        rows = chosen_rows.view(len(KINDS), -1, 6)
        counts = (rows.numpy()[..., 0] >= 0).sum(1).tolist()
        with self._lock:
            if generation == self.generation:
                self._asked_count += sum(counts)
                for kind, kind_rows, count in zip(KINDS.values(), rows, counts, strict=True):
                    if count:
                        self._chosen[kind].append(kind_rows[:count])
        self._schedule_ask()
        return sum(counts)

    def _schedule_ask(self) -> None:
        """Schedules `_ask_producers` if nodes were chosen and it is not scheduled yet."""
        with self._lock:
            if self._ask_scheduled or not any(self._chosen.values()):
                return
            self._ask_scheduled = True
        with suppress(RuntimeError):  # the executor is closed
            self._executor.submit(self._ask_producers)

    def _ask_producers(self) -> None:
        """Asks producers for the chosen nodes. Those of a kind that was asked for less than
        `_CALL_GAP` ago, with an answer still on its way, are left for later.
        """
        with self._lock:
            self._ask_scheduled, generation, now = False, self.generation, time.monotonic()
            busy_kinds = {item.batch.kind for item in self._waiting}
            free_kinds = [
                kind
                for kind in self._chosen
                if kind not in busy_kinds or now > self._last_call[kind] + _CALL_GAP
            ]
            chosen = {kind: self._chosen[kind] for kind in free_kinds if self._chosen[kind]}
            for kind in chosen:
                self._chosen[kind], self._last_call[kind] = [], now
        for kind, row_lists in chosen.items():
            rows = torch.cat(row_lists)
            for source in self.trees:
                tree_rows = rows[rows[:, 1] == source.tree.number]
                if len(tree_rows):
                    node, loc = tree_rows[:, 0].clone(), tree_rows[:, 2:].clone()
                    targets = Targets(source.tree, node, loc)
                    self._submit(RequestBatch(source, kind, targets, generation=generation))

    def _on_future(self, batch: RequestBatch, future: Future) -> None:
        item = self._wait_for(batch, future, future)
        future.add_done_callback(lambda _future: self._on_arrival(item))  # at once if it is done

    def _on_arrival(self, item: PendingBatch) -> None:
        """Settles a batch, in the thread in which its answer arrives."""
        was_waiting = bool(self._take(lambda other: other is item))  # else it was given up
        self._schedule_ask()
        if was_waiting:
            self._settle_late(item)

    def _on_answer(self, batch: RequestBatch, answer: Answer) -> None:
        if isinstance(answer, Regions):
            self._queue_tiles(batch, answer)
        elif isinstance(answer, Bricks):
            self._queue_bricks(batch, answer)

    def _fail(self, batch: RequestBatch, message: str, cause: BaseException | None) -> None:
        with self._lock:
            if batch.generation == self.generation:
                self._failed_count += len(batch)
                self._production.failures.add(batch, message, cause)

    def _queue_tiles(self, batch: RequestBatch, answer: Regions) -> None:
        if answer.alias is not None:
            self._leave_to_host(batch)
            return
        children, targets = children_of(batch, answer, self.cache), batch.targets
        rows = {"node": targets.node, "loc": targets.loc}
        words = {"child": children.child, "brick": children.brick}
        fields = {"constants": children.constants, "ranges": children.ranges}
        self._queue(batch, "tiles", rows | words, fields)

    def _queue_bricks(self, batch: RequestBatch, answer: Bricks) -> None:
        targets, kind = batch.targets, answer.kind
        rows = {"node": targets.node, "loc": targets.loc}
        data = {"data": answer.data}
        if kind is None:
            self._queue(batch, "bricks", rows, data)
            return
        is_alias = kind == Region.ALIAS
        if bool(is_alias.any()):
            self._leave_to_host(batch[is_alias])
        brick_word = brick_words(kind)
        is_uniform = brick_word != ABSENT
        self._queue(batch, "bricks", rows, data, ~is_uniform & ~is_alias)
        zeros = {
            name: torch.zeros((len(kind), channel.width), dtype=channel.dtype, device="cpu")
            for name, channel in batch.source.producer.channels.items()
        }
        constants = {"constants": {**zeros, **answer.constants}}
        self._queue(batch, "uniform", {**rows, "word": brick_word}, constants, is_uniform)

    def _leave_to_host(self, batch: RequestBatch) -> None:
        """Lets nodes be requested again, for `Engine.frame`, which can find alias targets."""
        self.host_needed = True
        pending = batch.kind << REQUEST_PENDING_SHIFT
        bit = torch.full((len(batch),), pending, dtype=torch.int32, device="cpu")
        self._queue(batch, "to_host", {"node": batch.targets.node, "bit": bit}, {})

    def _queue(
        self,
        batch: RequestBatch,
        table: str,
        rows: Mapping[str, Tensor],
        fields: Mapping[str, Voxels],
        index: Tensor | None = None,
    ) -> None:
        """Queues the entries `index`, or all, of `rows`, and of `fields` by channel. A node may be
        queued only once; those of an earlier generation are dropped: they may have been requested
        again.
        """
        flat_fields = {
            f"{name}.{channel}": values
            for name, by_channel in fields.items()
            for channel, values in by_channel.items()
        }
        queue = self._uploads[self._upload_index[batch.source.tree.number]]
        selected = {**rows, **flat_fields}
        if index is not None:
            selected = {
                n: v[index] if isinstance(v, TableRows) else movable(v)[index].view(v.dtype)
                for n, v in selected.items()
            }
        queue.add(table, selected, lambda: batch.generation == self.generation)


def _table_forms(cache: Cache, source: ProducedTree) -> dict[str, RowForm]:
    """Returns the tables of a tree's answers, and the fields of their rows."""
    n, brick, word = source.layout.branching**3, (source.layout.side,) * 3, torch.int32
    loc: dict[str, Any] = {"loc": ((4,), torch.int64)}
    tiles = loc | {"child": ((n,), word), "brick": ((n,), word)}
    for name, channel in cache.bricks.channels.items():
        tiles[f"constants.{name}"] = ((n, channel.width), channel.dtype)
        tiles[f"ranges.{name}"] = ((n, 2, channel.width), channel.dtype)
    bricks, uniform = dict(loc), loc | {"word": ((), word)}
    for name, channel in source.producer.channels.items():
        bricks[f"data.{name}"] = ((*brick, channel.width), channel.dtype)
        uniform[f"constants.{name}"] = ((channel.width,), channel.dtype)
    return {"tiles": tiles, "bricks": bricks, "uniform": uniform, "to_host": {"bit": ((), word)}}


def _by_channel(table: Mapping[str, Tensor], field: str) -> dict[str, Tensor]:
    """Returns a field of a table by channel."""
    parts = (name.partition(".") for name in table)
    return {channel: table[f"{field}.{channel}"] for name, _, channel in parts if name == field}
