"""`Mail`: rows of answers on their way from the host to a recorded frame. Any thread may post rows,
into pinned memory; a frame sends all posted rows in one copy, for which the host does not wait.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

Form = Mapping[str, tuple[tuple[int, ...], torch.dtype]]  # shape and dtype of a row's fields

_BUFFERS = 3  # one is filled while the others may still be copied
_ALIGN = 16  # bytes: alignment of fields


class Mail:
    """Boxes with room for `rows` rows each. A row's field `node` is -1 where the row is empty.

    Attributes:
        there: For each box, its fields (rows, ...) on the device.
        sent: Number of rows sent since `HostFrame.release` last reset it.
    """

    def __init__(self, boxes: Mapping[str, Form], rows: int, device: torch.device) -> None:
        """Allocates the buffers."""
        self.rows, self.sent = rows, 0
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, Mapping[str, Tensor], int]] = deque()
        self._taken = dict.fromkeys(boxes, 0)
        self._nodes = rows * len(boxes)  # node fields, at the front of a buffer
        places: dict[tuple[str, str], tuple[int, tuple[int, ...], torch.dtype]] = {}
        end = 8 * self._nodes
        for number, (box, form) in enumerate(boxes.items()):
            places[box, "node"] = (8 * rows * number, (rows,), torch.int64)
            for name, (shape, dtype) in form.items():
                end = -(-end // _ALIGN) * _ALIGN
                places[box, name] = (end, (rows, *shape), dtype)
                end += math.prod((rows, *shape)) * dtype.itemsize
        self._cuda = device.type == "cuda"
        self._target = torch.zeros(end, dtype=torch.uint8, device=device)
        self._buffers = [
            torch.zeros(end, dtype=torch.uint8, pin_memory=self._cuda) for _ in range(_BUFFERS)
        ]
        self.there = _views(self._target, places)
        self._here = [_views(buffer, places) for buffer in self._buffers]
        self._copied: list[Any] = [None] * _BUFFERS  # CUDA events
        self._open = 0
        for buffer in (self._target, *self._buffers):
            self._empty(buffer)

    def post(self, box: str, rows: Mapping[str, Tensor]) -> None:
        """Queues rows (k, ...) for a box, in host memory; rows that find no room are sent later."""
        if len(rows["node"]):
            with self._lock:
                self._queue.append((box, rows, 0))
                self._fill()

    def send(self) -> bool:
        """Starts copying the posted rows to the device, unless all buffers are still being copied;
        rows sent before must have been processed (`clear`). Returns whether anything was sent.
        """
        with self._lock:
            following = (self._open + 1) % _BUFFERS
            copied = self._copied[following]
            if not any(self._taken.values()) or (copied is not None and not copied.query()):
                return False
            self._target.copy_(self._buffers[self._open], non_blocking=True)
            if self._cuda:
                self._copied[self._open] = torch.cuda.current_stream().record_event()
            self.sent += sum(self._taken.values())
            self._open = following
            self._begin()
            self._fill()
            return True

    def clear(self) -> None:
        """Empties all boxes on the device."""
        self._empty(self._target)

    def forget(self) -> None:
        """Drops all rows that were not sent yet."""
        with self._lock:
            self._queue.clear()
            self._begin()

    def _begin(self) -> None:
        self._empty(self._buffers[self._open])
        self._taken = dict.fromkeys(self._taken, 0)

    def _fill(self) -> None:
        """Moves rows from the queue to the open buffer, in their order."""
        while self._queue:
            box, rows, begin = self._queue.popleft()
            at, total = self._taken[box], len(rows["node"])
            count = min(self.rows - at, total - begin)
            for name, values in rows.items():
                self._here[self._open][box][name][at : at + count] = values[begin : begin + count]
            self._taken[box] += count
            if begin + count < total:
                self._queue.appendleft((box, rows, begin + count))
                return

    def _empty(self, buffer: Tensor) -> None:
        buffer[: 8 * self._nodes].view(torch.int64).fill_(-1)

    def __repr__(self) -> str:
        return f"Mail({', '.join(self._taken)}; {self.rows} rows each)"


def _views(
    buffer: Tensor, places: Mapping[tuple[str, str], tuple[int, tuple[int, ...], torch.dtype]]
) -> dict[str, dict[str, Tensor]]:
    """Returns views of the fields of each box in a buffer."""
    made: dict[str, dict[str, Tensor]] = {}
    for (box, name), (begin, shape, dtype) in places.items():
        part = buffer[begin : begin + math.prod(shape) * dtype.itemsize]
        made.setdefault(box, {})[name] = part.view(dtype).view(shape)
    return made
