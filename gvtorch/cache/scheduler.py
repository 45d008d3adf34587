"""`Scheduler`: which requests are served in a frame, by priority and within the budgets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from ..base.constants import REQUEST_LOAD, REQUEST_PRIORITY, REQUEST_SUBDIVIDE
from .requests import Requests, RequestsByKind

_LEARN_FROM = 64  # items: smaller batches tell more about overhead than about throughput
_LEARN_RATE = 0.3  # weight of the newest frame


class Choice(NamedTuple):
    """Which requests are served."""

    nodes: dict[int, Tensor]  # for each kind (k,) int64, most wanted first
    deferred: int  # requests that the budgets put off
    exceeded: bool  # whether slots were too few


class Scheduler:
    """Orders requests and trims them to budgets.

    Attributes:
        most: For each kind, most items a frame.
        rate: For each kind, items a millisecond, learned from what production took; None at first.
        spent: For each kind, items that were asked for in this frame, which are off its budget.
    """

    def __init__(
        self,
        *,
        order: Literal["coarse", "fine"] = "coarse",
        loads: int = 4096,
        subdivisions: int = 4096,
        milliseconds: float | None = None,
    ) -> None:
        """Sets the budgets of a frame.

        Args:
            order: Coarse levels first, which shows something everywhere soon, or fine ones; then
                by size on the screen.
            loads: Most bricks a frame.
            subdivisions: Most node tiles a frame.
            milliseconds: Most time a frame for production, shared by both kinds; None: no limit.
        """
        self.order, self.milliseconds = order, milliseconds
        self.most = {REQUEST_LOAD: loads, REQUEST_SUBDIVIDE: subdivisions}
        self.rate: dict[int, float | None] = dict.fromkeys(self.most)
        self.spent = dict.fromkeys(self.most, 0)
        self._budget = dict(self.most)

    def begin(self) -> None:
        """Starts a frame: its budgets are whole."""
        self.spent = dict.fromkeys(self.most, 0)

    def choose(self, requests: RequestsByKind, room: Mapping[int, int]) -> Choice:
        """Returns the requests to serve.

        Args:
            requests: All requests of the frame.
            room: For each kind, how many slots may be taken.
        """
        nodes: dict[int, Tensor] = {}
        deferred, exceeded = 0, False
        for kind, most in self.most.items():
            asked = requests[kind]
            self._budget[kind] = min(most, self._in_time(kind))
            budget = max(0, self._budget[kind] - self.spent[kind])
            deferred += max(0, min(len(asked), room[kind]) - budget)
            exceeded |= len(asked) > room[kind]
            nodes[kind] = asked.node[self.rank(asked)[: min(budget, room[kind])]]
        return Choice(nodes, deferred, exceeded)

    def rank(self, requests: Requests) -> Tensor:
        """(k,) int64 rows in the order in which they are served: by level, then by size on the
        screen, then by node, so that it does not depend on chance.
        """
        level = requests.depth if self.order == "coarse" else -requests.depth
        small = REQUEST_PRIORITY - requests.priority.to(torch.int64)
        return (level * (REQUEST_PRIORITY + 1) + small).argsort(stable=True)

    def learn(self, kind: int, items: int, milliseconds: float) -> None:
        """Learns the throughput from a batch that took `milliseconds`. Small ones tell little,
        unless the budget itself made them small.
        """
        if items < min(_LEARN_FROM, self._budget[kind]) or milliseconds <= 0:
            return
        seen, known = items / milliseconds, self.rate[kind]
        self.rate[kind] = seen if known is None else known + _LEARN_RATE * (seen - known)

    def _in_time(self, kind: int) -> int:
        """How many items half of the time is enough for."""
        if self.milliseconds is None:
            return self.most[kind]
        rate = self.rate[kind]
        return _LEARN_FROM if rate is None else max(1, int(rate * 0.5 * self.milliseconds))

    def __repr__(self) -> str:
        loads, tiles = self.most[REQUEST_LOAD], self.most[REQUEST_SUBDIVIDE]
        time = "" if self.milliseconds is None else f", {self.milliseconds:g} ms"
        return f"Scheduler({self.order} first, at most {loads} bricks, {tiles} tiles{time} a frame)"
