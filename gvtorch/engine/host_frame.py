"""`HostFrame`: recorded frames whose producers answer from the host, while the device goes on."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from ..base.constants import ABSENT, REQUEST_LOAD, REQUEST_PENDING_SHIFT, REQUEST_SUBDIVIDE
from ..base.records import Hits
from ..base.volume import movable
from ..cache import KINDS, Cache
from ..cache.write import Children, Put, Targets, put_bricks, put_rows_of, put_tiles, put_uniform
from ..pool.staging import TableRows
from ..producers import Bricks, Region, Regions
from .mail import Form, Mail
from .production import Production
from .recorded import RecordedFrame
from .request_batch import ProducedTree, RequestBatch, brick_words, children_of
from .stats import Collected, FrameStats

_SOON = 0.02  # seconds after which a late answer no longer delays the next call


class HostFrame(RecordedFrame):
    """Frames of an engine whose producers all answer from the host (`Producer.on_host`).

    The nodes that a frame chose reach the host with its counts (`ask`). A thread asks producers for
    all nodes chosen since its last call, once that call is answered: a busy host gets the nodes of
    several frames at once, so that it catches up. If an answer takes longer than `_SOON`, it calls
    without waiting: one slow read delays nothing else. The thread in which an answer arrives checks
    and posts it; the next frame sends all posted answers, and writes them.
    """

    def __init__(self, production: Production, batch: int, fit: bool) -> None:
        super().__init__(production, batch, fit)
        device = self._unused.device
        self._mail = [Mail(_boxes(self.cache, one), batch, device) for one in self.trees]
        self._by_tree = {one.tree.number: n for n, one in enumerate(self.trees)}
        self.turn = 0  # counts releases: answers to requests of an earlier turn are dropped
        self._asked = self._done = 0  # nodes asked for, and failed, since the last `release`
        self.active = False  # whether frames have been rendered since the last `release`
        self._lock = threading.Lock()
        self._waiting: dict[Future, tuple[float, RequestBatch]] = {}  # deadlines
        self._chosen: dict[int, list[Tensor]] = {kind: [] for kind in KINDS.values()}
        self._last_asked = dict.fromkeys(KINDS.values(), -math.inf)  # seconds
        self._going = False  # whether `_ask` is scheduled
        self._asker = ThreadPoolExecutor(1, thread_name_prefix="gvtorch-ask")

    @property
    def pending(self) -> int:
        """Number of nodes whose answers are on their way."""
        return max(0, self._asked - self._done - sum(mail.sent for mail in self._mail))

    def begin(self, stale: bool, steady: bool, stats: FrameStats) -> bool:
        """Sends, before a frame, the answers that were posted, and returns whether there are any:
        then `serve` is to write them. `stale`: another frame was rendered since this graph's last
        one, so the counts of unused slots are out of date.
        """
        self.active = True
        if stale:
            self._unused.zero_()
        self._give_up()
        self._go_on()
        sent = [mail.send() for mail in self._mail]
        stats.pending, stats.failed = self.pending, len(self._production.failures)
        return any(sent)

    def release(self) -> None:
        """Drops the answers on their way, for a frame that the host serves; rays ask again."""
        if not self.active:
            return
        self.active = False
        self._waiting.clear()
        # An answer being processed is either posted before the lock is held, and dropped below, or
        # posted later, and refused because its turn is over.
        with self._lock:
            self.turn += 1
            for chosen in self._chosen.values():
                chosen.clear()
            for mail in self._mail:
                mail.forget()
                mail.sent = 0
            self._asked = self._done = 0
        self._production.restore_pending()

    def close(self) -> None:
        """Ends the thread that asks producers."""
        self._asker.shutdown(wait=False, cancel_futures=True)

    def serve(self) -> None:
        """Writes the answers that were sent."""
        for source, mail in zip(self.trees, self._mail, strict=True):
            self._write(source, mail)

    def finish(self, hits: Hits) -> Collected:
        """Ends a frame as `RecordedFrame.finish` does, then chooses the nodes that producers are
        asked for, marks them as pending, and appends them to the counts that the host reads.
        """
        collected = super().finish(hits)
        words, chosen = self.cache.nodes.request_tn.view(-1), self.choose()
        for kind, (node, _) in zip(KINDS.values(), chosen, strict=True):
            marked = words[node.clamp(min=0)] | kind << REQUEST_PENDING_SHIFT
            put_rows_of(words[:, None], node, marked[:, None])
        node = torch.cat([one.node for one in chosen])
        number = self.tree_of(node)
        loc = self.trees[0].tree.loc(node)
        for source in self.trees[1:]:  # N may differ
            mine = (number == source.tree.number)[:, None]
            loc = torch.where(mine, source.tree.loc(node), loc)
        rows = torch.cat((node[:, None], number[:, None].to(torch.int64), loc), 1)
        return collected._replace(numbers=torch.cat((collected.numbers, rows.flatten())))

    def _write(self, source: ProducedTree, mail: Mail) -> None:
        """Writes the answers sent for one tree; nodes that found no slot may be requested again."""
        tiles, bricks, bare, again = (
            mail.there[box] for box in ("tiles", "bricks", "bare", "again")
        )
        children = Children(
            child=tiles["child"],
            brick=tiles["brick"],
            constants=_named(tiles, "constants"),
            ranges=_named(tiles, "ranges"),
            is_alias=torch.zeros_like(tiles["child"], dtype=torch.bool),
            alias=None,
            alias_tree=source.tree.number,
        )
        targets = [Targets(source.tree, box["node"], box["loc"]) for box in (tiles, bricks, bare)]
        put = put_tiles(self.cache, targets[0], children, self._unused[:1])
        self._count(REQUEST_SUBDIVIDE, targets[0], put, 0)
        put = put_bricks(self.cache, targets[1], _named(bricks, "data"), self._unused[1:])
        self._count(REQUEST_LOAD, targets[1], put, 1)
        self._made[2] += put_uniform(
            self.cache, targets[2], bare["word"], _named(bare, "constants")
        )
        self._ask_again(again["node"], again["bit"])
        mail.clear()

    def _count(self, kind: int, targets: Targets, put: Put, which: int) -> None:
        _, given, held = put.counts
        self._unused[which] -= given
        self._made[which] += given
        self._made[3 + which] += held
        lost = torch.where(put.wanted & (put.slot < 0), targets.node, -1)
        bit = torch.full_like(lost, kind << REQUEST_PENDING_SHIFT, dtype=torch.int32)
        self._ask_again(lost, bit)

    def _ask_again(self, node: Tensor, bit: Tensor) -> None:
        words = self.cache.nodes.request_tn.view(-1, 1)
        put_rows_of(words, node, words[node.clamp(min=0)] & ~bit[:, None])

    def ask(self, turn: int, asked: Tensor) -> int:
        """Queues the nodes that a frame chose for the thread that asks producers: (2 * batch * 6,)
        int64 on the host, for each kind rows of node, tree and loc. Returns the number of nodes,
        including those dropped because their turn is over.
        """
        rows = asked.view(len(KINDS), -1, 6)
        count = (rows.numpy()[..., 0] >= 0).sum(1).tolist()
        with self._lock:
            if turn == self.turn:
                self._asked += sum(count)
                for kind, listed, k in zip(KINDS.values(), rows, count, strict=True):
                    if k:
                        self._chosen[kind].append(listed[:k])
        self._go_on()
        return sum(count)

    def _go_on(self) -> None:
        """Schedules `_ask` if nodes were chosen and it is not scheduled yet."""
        with self._lock:
            if self._going or not any(self._chosen.values()):
                return
            self._going = True
        with suppress(RuntimeError):  # the executor is closed
            self._asker.submit(self._ask)

    def _ask(self) -> None:
        """Asks for chosen nodes; of a kind with an answer due, only `_SOON` after its last call."""
        with self._lock:
            self._going, turn, now = False, self.turn, time.monotonic()
            busy = {batch.kind for _, batch in [*self._waiting.values()]}
            free = [k for k in self._chosen if k not in busy or now > self._last_asked[k] + _SOON]
            chosen = {kind: self._chosen[kind] for kind in free if self._chosen[kind]}
            for kind in chosen:
                self._chosen[kind], self._last_asked[kind] = [], now
        for kind, lists in chosen.items():
            rows = torch.cat(lists)
            for source in self.trees:
                mine = rows[rows[:, 1] == source.tree.number]
                if len(mine):
                    targets = Targets(source.tree, mine[:, 0].clone(), mine[:, 2:].clone())
                    self._submit(RequestBatch(source, kind, targets, turn=turn))

    def _submit(self, batch: RequestBatch) -> None:
        """Asks for a batch; if the producer raises, asks again for each half."""

        def arrived(future: Future) -> None:
            there = self._waiting.pop(future, None) is not None  # else it was given up
            self._go_on()
            if there and batch.turn == self.turn:
                self._settle(batch, future.result)

        try:
            answer = batch.ask()
        except Exception as error:
            self._split(batch, error)
            return
        if isinstance(answer, Future):
            self._waiting[answer] = time.monotonic() + batch.source.patience, batch
            answer.add_done_callback(arrived)
        else:
            self._settle(batch, lambda: answer)

    def _give_up(self) -> None:
        """Records batches as failed whose answers have not come in time."""
        now = time.monotonic()
        for future, (until, batch) in list(self._waiting.items()):
            if until < now and self._waiting.pop(future, None) is not None:
                future.cancel()
                self._fail(batch, f"no answer within {batch.source.patience:g} s")

    def _split(self, batch: RequestBatch, error: Exception) -> None:
        if len(batch) == 1:
            self._fail(batch, f"{type(error).__name__}: {error}", error)
            return
        for half in batch.halves():
            self._submit(half)

    def _settle(self, batch: RequestBatch, answer: Callable[[], Any]) -> None:
        """Checks an answer and posts it, in the thread in which it arrives."""
        try:
            given = answer()
        except CancelledError:
            return  # the producer is closed
        except Exception as error:
            self._split(batch, error)
            return
        try:
            checked = batch.check(given)
            failed, keep = batch.failed(checked)
            for node, message in failed.items():
                self._fail(batch[node : node + 1], message)
            good = keep.nonzero()[:, 0]
            if isinstance(checked, Regions):
                self._post_tiles(batch, checked, good)
            else:
                self._post_bricks(batch, checked, good)
        except ValueError as error:
            self._fail(batch, str(error), error)

    def _fail(self, batch: RequestBatch, message: str, cause: BaseException | None = None) -> None:
        """Records a batch as failed; its nodes stay pending, so that no ray asks again."""
        with self._lock:
            if batch.turn == self.turn:
                self._done += len(batch)
                self._production.failures.add(batch, message, cause)

    def _post_tiles(self, batch: RequestBatch, answer: Regions, good: Tensor) -> None:
        if answer.alias is not None:
            self._leave_to_host(batch[good])
            return
        made, targets = children_of(batch, answer, self.cache), batch.targets
        rows = {"node": targets.node, "loc": targets.loc, "child": made.child, "brick": made.brick}
        fields = {"constants": made.constants, "ranges": made.ranges}
        self._post(batch, "tiles", rows, fields, good)

    def _post_bricks(self, batch: RequestBatch, answer: Bricks, good: Tensor) -> None:
        fields: dict[str, Mapping[str, Any]]
        targets, kind = batch.targets, answer.kind
        rows = {"node": targets.node, "loc": targets.loc}
        data = {n: d.gather() if isinstance(d, TableRows) else d for n, d in answer.data.items()}
        fields = {"data": data}
        if kind is None:
            self._post(batch, "bricks", rows, fields, good)
            return
        alias = kind[good] == Region.ALIAS
        if bool(alias.any()):
            self._leave_to_host(batch[good[alias]])
        word = brick_words(kind)
        bare = word[good] != ABSENT
        self._post(batch, "bricks", rows, fields, good[~bare & ~alias])
        known = {
            name: torch.zeros((len(kind), one.width), dtype=one.dtype)
            for name, one in batch.source.producer.channels.items()
        }
        fields = {"constants": {**known, **answer.constants}}
        self._post(batch, "bare", {**rows, "word": word}, fields, good[bare])

    def _leave_to_host(self, batch: RequestBatch) -> None:
        """Lets nodes be requested again, for `Engine.frame`, which can find alias targets."""
        self.host_needed = True
        bit = torch.full((len(batch),), batch.kind << REQUEST_PENDING_SHIFT, dtype=torch.int32)
        self._post(batch, "again", {"node": batch.targets.node, "bit": bit}, {}, slice(None))

    def _post(
        self,
        batch: RequestBatch,
        box: str,
        rows: Mapping[str, Tensor],
        fields: Mapping[str, Mapping[str, Tensor]],
        which: Tensor | slice,
    ) -> None:
        """Posts entries `which` of `rows`, and of `fields` by channel. A node may be posted only
        once; those of an earlier turn are dropped: they may have been requested again.
        """
        flat = {f"{name}.{channel}": t for name, by in fields.items() for channel, t in by.items()}
        mail = self._mail[self._by_tree[batch.source.tree.number]]
        some = {n: movable(t)[which].view(t.dtype) for n, t in {**rows, **flat}.items()}
        with self._lock:
            if batch.turn == self.turn:
                mail.post(box, some)


def _boxes(cache: Cache, source: ProducedTree) -> dict[str, Form]:
    """Returns the boxes of a tree's mail, and the fields of their rows."""
    words, place = torch.int32, {"loc": ((4,), torch.int64)}
    own, n = source.producer.channels, source.layout.branching**3
    kinds = cache.bricks.channels
    tiles: dict[str, Any] = {"child": ((n,), words), "brick": ((n,), words)}
    for name, one in kinds.items():
        tiles[f"constants.{name}"] = ((n, one.width), one.dtype)
        tiles[f"ranges.{name}"] = ((n, 2, one.width), one.dtype)
    brick = (source.layout.side,) * 3
    return {
        "tiles": place | tiles,
        "bricks": place | {f"data.{m}": ((*brick, c.width), c.dtype) for m, c in own.items()},
        "bare": place
        | {"word": ((), words)}
        | {f"constants.{m}": ((c.width,), c.dtype) for m, c in own.items()},
        "again": {"bit": ((), words)},
    }


def _named(box: Mapping[str, Tensor], field: str) -> dict[str, Tensor]:
    """Returns a field of a box by channel."""
    parts = (name.partition(".") for name in box)
    return {channel: box[f"{field}.{channel}"] for name, _, channel in parts if name == field}
