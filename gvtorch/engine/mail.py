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

RowForm = Mapping[str, tuple[tuple[int, ...], torch.dtype]]  # shape and dtype of a row's fields

_BUFFERS = 3  # one is filled while the others may still be copied
_ALIGN = 16  # bytes: alignment of fields


class Mail:
    """Boxes with room for `rows` rows each. A row's field `node` is -1 where the row is empty.

    Attributes:
        device_boxes: For each box, its fields (rows, ...) on the device.
        sent: Number of rows sent since `HostFrame.release` last reset it.
    """

    def __init__(self, boxes: Mapping[str, RowForm], rows: int, device: torch.device) -> None:
        """Allocates the buffers."""
        self.rows, self.sent = rows, 0
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, Mapping[str, Tensor], int]] = deque()
        self._filled_rows = dict.fromkeys(boxes, 0)
        self._node_rows = rows * len(boxes)  # node fields, at the front of a buffer
        fields: dict[tuple[str, str], tuple[int, tuple[int, ...], torch.dtype]] = {}
        size = 8 * self._node_rows
        for box_index, (box, form) in enumerate(boxes.items()):
            fields[box, "node"] = (8 * rows * box_index, (rows,), torch.int64)
            for name, (shape, dtype) in form.items():
                size = -(-size // _ALIGN) * _ALIGN
                fields[box, name] = (size, (rows, *shape), dtype)
                size += math.prod((rows, *shape)) * dtype.itemsize
        self._cuda = device.type == "cuda"
        self._device_buffer = torch.zeros(size, dtype=torch.uint8, device=device)
        self._host_buffers = [
            torch.zeros(size, dtype=torch.uint8, pin_memory=self._cuda) for _ in range(_BUFFERS)
        ]
        self.device_boxes = _views(self._device_buffer, fields)
        self._host_boxes = [_views(buffer, fields) for buffer in self._host_buffers]
        self._copy_events: list[Any] = [None] * _BUFFERS  # CUDA events
        self._open = 0  # index of the buffer that is being filled
        for buffer in (self._device_buffer, *self._host_buffers):
            self._clear_buffer(buffer)

    def post(self, box: str, rows: Mapping[str, Tensor]) -> None:
        """Queues rows (k, ...) for a box, in host memory; rows that find no room are sent later."""
        if len(rows["node"]):
            with self._lock:
                self._queue.append((box, rows, 0))
                self._fill_open_buffer()

    def send(self) -> bool:
        """Starts copying the posted rows to the device, unless all buffers are still being copied;
        rows sent before must have been processed (`clear`). Returns whether anything was sent.
        """
        with self._lock:
            next_index = (self._open + 1) % _BUFFERS
            event = self._copy_events[next_index]
            if not any(self._filled_rows.values()) or (event is not None and not event.query()):
                return False
            self._device_buffer.copy_(self._host_buffers[self._open], non_blocking=True)
            if self._cuda:
                self._copy_events[self._open] = torch.cuda.current_stream().record_event()
            self.sent += sum(self._filled_rows.values())
            self._open = next_index
            self._reset_open_buffer()
            self._fill_open_buffer()
            return True

    def clear(self) -> None:
        """Empties all boxes on the device."""
        self._clear_buffer(self._device_buffer)

    def forget(self) -> None:
        """Drops all rows that were not sent yet."""
        with self._lock:
            self._queue.clear()
            self._reset_open_buffer()

    def _reset_open_buffer(self) -> None:
        self._clear_buffer(self._host_buffers[self._open])
        self._filled_rows = dict.fromkeys(self._filled_rows, 0)

    def _fill_open_buffer(self) -> None:
        """Moves rows from the queue to the open buffer, in their order."""
        while self._queue:
            box, rows, first = self._queue.popleft()
            row, total = self._filled_rows[box], len(rows["node"])
            count = min(self.rows - row, total - first)
            for name, values in rows.items():
                self._host_boxes[self._open][box][name][row : row + count] = values[
                    first : first + count
                ]
            self._filled_rows[box] += count
            if first + count < total:
                self._queue.appendleft((box, rows, first + count))
                return

    def _clear_buffer(self, buffer: Tensor) -> None:
        buffer[: 8 * self._node_rows].view(torch.int64).fill_(-1)

    def __repr__(self) -> str:
        return f"Mail({', '.join(self._filled_rows)}; {self.rows} rows each)"


def _views(
    buffer: Tensor, fields: Mapping[tuple[str, str], tuple[int, tuple[int, ...], torch.dtype]]
) -> dict[str, dict[str, Tensor]]:
    """Returns views of the fields of each box in a buffer."""
    boxes: dict[str, dict[str, Tensor]] = {}
    for (box, name), (offset, shape, dtype) in fields.items():
        field_bytes = buffer[offset : offset + math.prod(shape) * dtype.itemsize]
        boxes.setdefault(box, {})[name] = field_bytes.view(dtype).view(shape)
    return boxes
