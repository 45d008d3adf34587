"""`Failures`: which nodes could not be produced, and why."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import torch
from torch import Tensor

from .request_batch import RequestBatch

_KEPT = 1000  # named; all are counted


class ProductionError(RuntimeError):
    """A producer failed, and the engine is strict."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A node that could not be produced."""

    tree: str
    kind: str  # load or subdivide
    loc: tuple[int, ...]  # x, y, z, depth
    message: str

    def __str__(self) -> str:
        """Names tree, level, node and reason in one line."""
        x, y, z, depth = self.loc
        return (
            f"tree {self.tree!r}, depth {depth}, node ({x}, {y}, {z}), {self.kind}: {self.message}"
        )


class Failures:
    """All nodes that failed, by place: a node's tile may be given away and come back.

    Attributes:
        strict: `raise_if_strict` raises.
        newest: The last 1000, by name.
    """

    def __init__(self, strict: bool) -> None:
        """Starts with none."""
        self.strict = strict
        self.newest: deque[Failure] = deque(maxlen=_KEPT)
        self._places: set[tuple[str, int, tuple[int, ...]]] = set()  # tree, kind, loc
        self._first: tuple[Failure, BaseException | None] | None = None

    def __len__(self) -> int:
        """Number of nodes that failed."""
        return len(self._places)

    def add(self, batch: RequestBatch, message: str, cause: BaseException | None) -> None:
        """Takes note of a batch's nodes."""
        text = " ".join(message.split())
        for loc in map(tuple, batch.targets.loc.tolist()):
            self.newest.append(
                Failure(tree=batch.source.name, kind=batch.kind_name, loc=loc, message=text)
            )
            self._places.add((batch.source.name, batch.kind, loc))
        self._first = self._first or (self.newest[-1], cause)

    def among(self, batch: RequestBatch) -> Tensor | None:
        """(k,) bool, which nodes of a batch failed before; None if none did."""
        if not self._places:
            return None
        name, kind, places = batch.source.name, batch.kind, batch.targets.loc.tolist()
        failed = [(name, kind, tuple(loc)) in self._places for loc in places]
        return torch.tensor(failed, device=batch.targets.node.device) if any(failed) else None

    def raise_if_strict(self) -> None:
        """Raises `ProductionError` for the first failure since the last call, if strict: at the end
        of a frame, when the pools are in order.
        """
        first, self._first = self._first, None
        if self.strict and first is not None:
            failure, cause = first
            raise ProductionError(str(failure)) from cause

    def forget(self) -> None:
        """Forgets them all."""
        self.newest.clear()
        self._places.clear()
