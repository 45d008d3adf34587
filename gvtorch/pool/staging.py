"""`Staging`: the way of bricks from the host to the device. They are gathered into a ring of pinned
memory, copied on a stream of their own while the device renders, and written into their slots by
the stream that renders, which waits for the copy by an event.

The host waits for nothing: where the ring is full, fewer bricks are sent, and the others are sent
later. Gathering is one call a channel and chunk, in torch's threads, and so is copying. Bricks that
lie in pinned memory already are copied from where they are.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor

from ..base import check

_MOST = 256 * 10**6  # bytes of a ring
_CHUNKS = (2 * 10**6, 16 * 10**6)  # bytes of a chunk: fewer are all overhead, more overlap less
_ALIGN = 16  # bytes: where a channel begins in a chunk
_WORDS = {8: torch.int64, 4: torch.int32, 2: torch.int16, 1: torch.uint8}


class BrickTable:
    """Bricks that lie ready in host memory. A producer answers with `table[row]`: the bricks are
    gathered once, on their way to the device.
    """

    def __init__(self, bricks: Tensor) -> None:
        """Takes over (n, z, y, x, c) bricks on the CPU, borders included.

        Raises:
            ValueError: They are no contiguous tensor on the CPU, or hold NaN or infinite values.
        """
        if bricks.dim() != 5 or bricks.device.type != "cpu" or not bricks.is_contiguous():
            raise ValueError(
                "BrickTable: bricks must be contiguous (n, z, y, x, c) on the CPU, "
                f"got {check.describe(bricks)}"
            )
        if bricks.is_floating_point() and not torch.isfinite(bricks.sum(dtype=torch.float64)):
            raise ValueError("BrickTable: bricks hold NaN or infinite values")
        self.bricks = bricks

    def __len__(self) -> int:
        """Number of bricks."""
        return len(self.bricks)

    def __getitem__(self, row: Tensor) -> Rows:
        """Names bricks by their (k,) int64 rows.

        Raises:
            ValueError: A row is none of the table's.
        """
        row = row.to(device="cpu", dtype=torch.int64)
        if len(row) and (int(row.min()) < 0 or int(row.max()) >= len(self)):
            raise ValueError(f"BrickTable: rows must be 0 to {len(self) - 1}")
        return Rows(self.bricks, row)


class Rows:
    """Some bricks of a table, in an order of their own, not gathered yet."""

    def __init__(self, table: Tensor, row: Tensor) -> None:
        """Names `row` (k,) of `table` (n, z, y, x, c)."""
        self.table, self.row = table, row

    def __len__(self) -> int:
        """Number of bricks."""
        return len(self.row)

    def __getitem__(self, index: slice | Tensor) -> Rows:
        """Some of them."""
        return Rows(self.table, self.row[index.cpu() if isinstance(index, Tensor) else index])

    @property
    def shape(self) -> tuple[int, ...]:
        """(k, z, y, x, c)."""
        return (len(self.row), *self.table.shape[1:])

    @property
    def dtype(self) -> torch.dtype:
        """Of the table."""
        return self.table.dtype

    def gather(self) -> Tensor:
        """Returns the bricks."""
        out = torch.empty(self.shape, dtype=self.table.dtype)
        self.gather_into(out)
        return out

    def gather_into(self, out: Tensor) -> None:
        """Writes the bricks."""
        table, rows = wide_rows(self.table, out)
        torch.index_select(table, 0, self.row, out=rows)


Voxels = Mapping[str, Tensor | Rows]  # for each channel (k, z, y, x, c)


def wide_rows(*tensors: Tensor) -> list[Tensor]:
    """Returns (k, w) views of contiguous tensors in the widest integers that fit all of their rows:
    fewer elements move, and uint16, which torch can't index, becomes int16.
    """
    widest = 8
    for tensor in tensors:
        row = math.prod(tensor.shape[1:]) * tensor.itemsize
        widest = math.gcd(widest, row, tensor.storage_offset() * tensor.itemsize)
        widest = math.gcd(widest, tensor.data_ptr())
    word = _WORDS[widest]
    return [t.view(len(t), math.prod(t.shape[1:])).view(word) for t in tensors]


def on_host(data: Voxels) -> bool:
    """Tells whether any channel lies in host memory."""
    return any(isinstance(rows, Rows) or rows.device.type == "cpu" for rows in data.values())


def on_device(rows: Tensor | Rows, device: torch.device) -> Tensor:
    """Returns contiguous bricks on the device; the host waits for a copy."""
    gathered = rows.gather() if isinstance(rows, Rows) else rows
    return gathered.to(device).contiguous()


def joined(data: Voxels | Sequence[Part], device: torch.device) -> dict[str, Tensor]:
    """Returns all bricks on the device, in tensors of their own."""
    if isinstance(data, Mapping):
        return {name: on_device(rows, device) for name, rows in data.items()}
    pieces: list[dict[str, Tensor]] = []
    for part in data:
        with part as landed:
            pieces.append({name: rows.clone() for name, rows in landed.items()})
    return {name: torch.cat([piece[name] for piece in pieces]) for name in pieces[0]}


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """Returns a small tensor on the device; the host waits for nothing."""
    if device.type != "cuda" or tensor.device.type != "cpu" or tensor.numel() == 0:
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


class _Now:
    """Stands for a CUDA event on a device that does everything at once."""

    def query(self) -> bool:
        return True


class _Span:
    """Bytes of the ring. They are free again when the copy is done and its target was read, or
    nobody is left who could read it.
    """

    def __init__(self, begin: int, end: int) -> None:
        self.begin, self.end = begin, end
        self.copied: Any = None  # events, once they are recorded
        self.read: Any = None
        self.reader: Callable[[], Any] | None = None
        self.source: Any = None  # pinned memory that is copied from must live until then

    def free(self) -> bool:
        if self.reader is None or (self.copied is not None and not self.copied.query()):
            return False
        return self.read.query() if self.read is not None else self.reader() is None


class Part:
    """Bricks `begin` to `end` of what was sent. `with part as data:` lets the current stream wait
    for them and gives {channel: (k, z, y, x, c)} on the device; they are gone afterwards.
    """

    def __init__(self, begin: int, end: int, data: Mapping[str, Tensor], span: _Span) -> None:
        """Is on its way."""
        self.begin, self.end = begin, end
        self._data, self._span = data, span
        self._device = next(iter(data.values())).device

    def __enter__(self) -> Mapping[str, Tensor]:
        """Lets the stream wait."""
        if self._device.type == "cuda":
            torch.cuda.current_stream(self._device).wait_event(self._span.copied)
        return self._data

    def __exit__(self, *_error: object) -> None:
        """Gives the bytes back once the stream has come so far."""
        if self._device.type == "cuda":
            self._span.read = torch.cuda.current_stream(self._device).record_event()
        else:
            self._span.read = _Now()


class Shipment:
    """What was sent, and what found no room.

    Attributes:
        parts: What was sent.
        sent: Number of bricks in them.
        rest: The other bricks, still on the host.
    """

    def __init__(self, parts: Sequence[Part], sent: int, rest: Voxels) -> None:
        """Holds them."""
        self.parts, self.sent, self.rest = parts, sent, rest


class Staging:
    """A ring of pinned memory and one of the same size on the device. Any thread may send."""

    def __init__(self, payload: int, brick_bytes: int, device: torch.device) -> None:
        """Takes no memory before it is needed.

        Args:
            payload: Most bytes that a frame is to send.
            brick_bytes: Bytes of a brick, all channels.
            device: Where bricks go; on the CPU, for tests, nothing is pinned.
        """
        least, most = _CHUNKS
        room = brick_bytes + 64 * _ALIGN  # as many channels, and more
        self.chunk = max(room, min(most, max(least, payload // 8)))
        self.nbytes = max(4 * self.chunk, min(_MOST, 2 * payload))
        self._device = device
        self._spans: deque[_Span] = deque()
        self._lock = threading.Lock()
        self._host: Tensor | None = None
        self._target: Tensor | None = None
        self._stream: Any = None

    def send(self, data: Voxels) -> Shipment:
        """Sends bricks from the host, as many as there is room for."""
        count = len(next(iter(data.values())))
        if count == 0:
            return Shipment([], 0, data)
        row_bytes = {name: _row_bytes(rows) for name, rows in data.items()}
        pinned = {name for name, rows in data.items() if self._is_pinned(rows)}
        room = self.chunk if len(pinned) < len(data) else self.nbytes // 4  # nothing to overlap
        per_chunk = (room - _ALIGN * len(data)) // sum(row_bytes.values())
        if per_chunk < 1:
            raise ValueError(f"Staging: a brick of {sum(row_bytes.values())} bytes is too large")
        parts: list[Part] = []
        begin = 0
        while begin < count:
            end = min(count, begin + per_chunk)
            sizes = [-(-(end - begin) * size // _ALIGN) * _ALIGN for size in row_bytes.values()]
            span = self._take(sum(sizes))
            if span is None:
                break
            chunk = {name: rows[begin:end] for name, rows in data.items()}
            parts.append(self._send(span, begin, end, chunk, sizes, pinned))
            begin = end
        return Shipment(parts, begin, {name: rows[begin:] for name, rows in data.items()})

    def _send(
        self,
        span: _Span,
        begin: int,
        end: int,
        chunk: Voxels,
        sizes: Sequence[int],
        pinned: Set[str],
    ) -> Part:
        assert self._host is not None and self._target is not None
        offset, landed = span.begin, {}
        copies: list[tuple[Tensor, Tensor]] = []  # to, from
        try:
            for (name, rows), size in zip(chunk.items(), sizes, strict=True):
                at = slice(offset, offset + (end - begin) * _row_bytes(rows))
                offset += size
                to = landed[name] = self._target[at].view(rows.dtype).view(rows.shape)
                if isinstance(rows, Tensor) and name in pinned:
                    copies.append((to, rows))
                    continue
                here = self._host[at].view(rows.dtype).view(rows.shape)
                if isinstance(rows, Rows):
                    rows.gather_into(here)
                else:
                    here.copy_(rows)
                copies.append((to, here))
            with torch.cuda.stream(self._stream) if self._stream else nullcontext():
                for to, here in copies:
                    to.copy_(here, non_blocking=True)
                span.copied = self._stream.record_event() if self._stream else _Now()
            span.source = chunk
            part = Part(begin, end, landed, span)
        except BaseException:
            span.reader = _nobody
            raise
        span.reader = weakref.ref(part)
        return part

    def _is_pinned(self, rows: Tensor | Rows) -> bool:
        if self._device.type != "cuda" or not isinstance(rows, Tensor):
            return False
        return rows.is_contiguous() and rows.is_pinned()

    def _take(self, nbytes: int) -> _Span | None:
        """The next bytes of the ring, or None where they are not free."""
        with self._lock:
            self._open()
            while self._spans and self._spans[0].free():
                self._spans.popleft()
            begin, end = 0, self.nbytes
            if self._spans:
                begin, first = self._spans[-1].end, self._spans[0].begin
                if begin > first and begin + nbytes > end:
                    begin = 0  # the rest of the ring is too short
                if begin <= first:
                    end = first
            if begin + nbytes > end:
                return None
            span = _Span(begin, begin + nbytes)
            self._spans.append(span)
            return span

    def _open(self) -> None:
        if self._host is not None:
            return
        cuda = self._device.type == "cuda"
        self._target = torch.empty(self.nbytes, dtype=torch.uint8, device=self._device)
        if cuda:
            self._stream = torch.cuda.Stream(self._device)
            self._stream.wait_stream(torch.cuda.current_stream(self._device))
            self._target.record_stream(self._stream)
        self._host = torch.empty(self.nbytes, dtype=torch.uint8, pin_memory=cuda)


def _nobody() -> None:
    return None


def _row_bytes(rows: Tensor | Rows) -> int:
    return math.prod(rows.shape[1:]) * rows.dtype.itemsize
