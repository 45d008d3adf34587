"""`UploadQueue`: rows of answers on their way from the host to a recorded frame. Any thread may add
rows, which are gathered in pinned memory; a frame sends all of them in one copy, and the host does
not wait.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..pool.staging import Voxels, gather

RowForm = Mapping[str, tuple[tuple[int, ...], torch.dtype]]  # shape and dtype of a row's fields

_BUFFERS = 3  # one is filled while the others may still be copied
_ALIGN = 16  # bytes: alignment of fields


class UploadQueue:
    """Tables with room for `rows` rows each. A row's field `node` is -1 where the row is empty.

    Attributes:
        device_tables: For each table, its fields (rows, ...) on the device.
        sent: Number of rows sent since `HostFrame.release` last reset it.
    """

    def __init__(self, tables: Mapping[str, RowForm], rows: int, device: torch.device) -> None:
        """Allocates the buffers; raises ValueError if they are larger than the memory."""
        self.rows, self.sent = rows, 0
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, Voxels]] = deque()  # found no room in the open buffer
        self._filled_rows = dict.fromkeys(tables, 0)
        self._node_rows = rows * len(tables)  # node fields, at the front of a buffer
        fields: dict[tuple[str, str], tuple[int, tuple[int, ...], torch.dtype]] = {}
        size = 8 * self._node_rows
        for table_index, (table, form) in enumerate(tables.items()):
            fields[table, "node"] = (8 * rows * table_index, (rows,), torch.int64)
            for name, (shape, dtype) in form.items():
                size = -(-size // _ALIGN) * _ALIGN
                fields[table, name] = (size, (rows, *shape), dtype)
                size += math.prod((rows, *shape)) * dtype.itemsize
        for place, count in ((device, 1), (torch.device("cpu"), _BUFFERS)):
            check.memory("Engine.capture", f"a batch of {rows}", count * size, place)
        self._cuda = device.type == "cuda"
        self._device_buffer = torch.zeros(size, dtype=torch.uint8, device=device)
        self._host_buffers = [
            torch.zeros(size, dtype=torch.uint8, pin_memory=self._cuda, device="cpu")
            for _ in range(_BUFFERS)
        ]
        self.device_tables = _views(self._device_buffer, fields)
        self._host_tables = [_views(buffer, fields) for buffer in self._host_buffers]
        self._copy_events: list[Any] = [None] * _BUFFERS  # CUDA events
        self._open = 0  # index of the buffer that is being filled
        for buffer in (self._device_buffer, *self._host_buffers):
            self._clear_buffer(buffer)

    def add(self, table: str, rows: Voxels, wanted: Callable[[], bool]) -> None:
        """Adds rows (k, ...) in host memory to a table, as long as `wanted` is true: it becomes
        false before `forget`. Those without room are copied, and sent later.
        """
        with self._lock:
            if not wanted():
                return
            added = 0 if self._queue else self._fill(table, rows)
        if added < len(rows["node"]):
            rest = {name: gather(values[added:]) for name, values in rows.items()}
            with self._lock:
                if wanted():
                    self._queue.append((table, rest))
                    self._fill_open_buffer()

    def send(self) -> bool:
        """Starts copying the added rows to the device, unless all buffers are still being copied;
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
        """Empties all tables on the device."""
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
            table, rows = self._queue.popleft()
            added = self._fill(table, rows)
            if added < len(rows["node"]):
                rest = {name: values[added:] for name, values in rows.items()}
                self._queue.appendleft((table, rest))
                return

    def _fill(self, table: str, rows: Voxels) -> int:
        """Writes the first rows into the open buffer; returns for how many it had room."""
        begin = self._filled_rows[table]
        end = min(self.rows, begin + len(rows["node"]))
        for name, values in rows.items():
            gather(values[: end - begin], self._host_tables[self._open][table][name][begin:end])
        self._filled_rows[table] = end
        return end - begin

    def _clear_buffer(self, buffer: Tensor) -> None:
        buffer[: 8 * self._node_rows].view(torch.int64).fill_(-1)

    def __repr__(self) -> str:
        return f"UploadQueue({', '.join(self._filled_rows)}; {self.rows} rows each)"


def _views(
    buffer: Tensor, fields: Mapping[tuple[str, str], tuple[int, tuple[int, ...], torch.dtype]]
) -> dict[str, dict[str, Tensor]]:
    """Returns views of the fields of each table in a buffer."""
    tables: dict[str, dict[str, Tensor]] = {}
    for (table, name), (offset, shape, dtype) in fields.items():
        field_bytes = buffer[offset : offset + math.prod(shape) * dtype.itemsize]
        tables.setdefault(table, {})[name] = field_bytes.view(dtype).view(shape)
    return tables
