"""`Staging`: sends bricks from the host to the device while the device renders.

Bricks are gathered chunk by chunk into a ring of pinned memory, copied on a stream of their own,
and written into their slots by the stream that renders, which waits for each copy by an event. One
chunk is gathered, in torch's threads, while the one before is copied. Bricks that lie in pinned
memory already are copied from where they are.

The host waits for nothing: where the ring is full, fewer bricks are sent, and the others later.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .brick_table import TableRows, Voxels, on_device

_MOST = 256 * 10**6  # bytes of a ring
_CHUNKS = (2 * 10**6, 16 * 10**6)  # bytes of a chunk: fewer are all overhead, more overlap less
_ALIGN = 16  # bytes: where a channel begins in a chunk


class _NoEvent:
    """Stands for a CUDA event on a device that does everything at once."""

    def query(self) -> bool:
        return True


@dataclass(eq=False)
class _RingSpan:
    """Bytes `begin` to `end` of the ring, taken by one chunk. They are free again when the copy is
    done and the chunk was read, or its `Chunk` was dropped unread.
    """

    begin: int
    end: int
    copied: Any = None  # events, None until they are recorded
    read: Any = None
    chunk: Callable[[], Chunk | None] | None = None  # weak, None until it is sent
    source: Any = None  # keeps pinned memory alive while it is copied from

    def free(self) -> bool:
        if self.chunk is None or (self.copied is not None and not self.copied.query()):
            return False
        return self.read.query() if self.read is not None else self.chunk() is None


class Chunk:
    """Bricks `begin` to `end` of a shipment. `with chunk as data:` makes the current stream wait
    for their copy and gives {channel: (k, z, y, x, c)} on the device, valid inside the block.
    """

    def __init__(self, begin: int, end: int, data: Mapping[str, Tensor], span: _RingSpan) -> None:
        self.begin, self.end = begin, end
        self._data, self._span = data, span
        self._device = next(iter(data.values())).device

    def __enter__(self) -> Mapping[str, Tensor]:
        if self._device.type == "cuda":
            torch.cuda.current_stream(self._device).wait_event(self._span.copied)
        return self._data

    def __exit__(self, *_error: object) -> None:
        on_cuda = self._device.type == "cuda"
        stream = torch.cuda.current_stream(self._device) if on_cuda else None
        self._span.read = stream.record_event() if stream else _NoEvent()


@dataclass(frozen=True, eq=False, repr=False)
class Shipment:
    """Bricks that were sent, and those that found no room."""

    chunks: Sequence[Chunk]  # the bricks on their way
    sent: int  # number of bricks in them
    rest: Voxels  # the other bricks, still on the host


class Staging:
    """A ring of pinned memory and one of the same size on the device. Any thread may send."""

    def __init__(self, payload: int, brick_bytes: int, device: torch.device) -> None:
        """Chooses sizes for `payload` bytes a frame at most, in bricks of `brick_bytes`; memory is
        allocated when something is sent first. On the CPU, for tests, nothing is pinned.
        """
        least, most = _CHUNKS
        room = brick_bytes + 64 * _ALIGN  # as many channels, and more
        self.chunk = max(room, min(most, max(least, payload // 8)))
        self.nbytes = max(4 * self.chunk, min(_MOST, 2 * payload))
        self._device = device
        self._spans: deque[_RingSpan] = deque()
        self._lock = threading.Lock()
        self._host: Tensor | None = None
        self._target: Tensor | None = None
        self._stream: Any = None

    def send(self, data: Voxels) -> Shipment:
        """Sends bricks from the host, as many as there is room for; ValueError if one is larger
        than the ring was made for.
        """
        count = len(next(iter(data.values())))
        if count == 0:
            return Shipment([], 0, data)
        row_bytes = [_row_bytes(rows) for rows in data.values()]
        pinned = {name for name, rows in data.items() if self._is_pinned(rows)}
        room = self.chunk if len(pinned) < len(data) else self.nbytes // 4  # nothing to overlap
        per_chunk = (room - _ALIGN * len(data)) // sum(row_bytes)
        if per_chunk < 1:
            raise ValueError(f"Staging: a brick of {sum(row_bytes)} bytes is too large")
        chunks: list[Chunk] = []
        begin = 0
        while begin < count:
            end = min(count, begin + per_chunk)
            sizes = [-(-(end - begin) * size // _ALIGN) * _ALIGN for size in row_bytes]
            span = self._take(sum(sizes))
            if span is None:
                break
            bricks = {name: rows[begin:end] for name, rows in data.items()}
            try:
                chunk = Chunk(begin, end, self._copy(span, bricks, sizes, pinned), span)
            except BaseException:
                span.chunk = lambda: None
                raise
            span.chunk = weakref.ref(chunk)
            chunks.append(chunk)
            begin = end
        return Shipment(chunks, begin, {name: rows[begin:] for name, rows in data.items()})

    def _copy(
        self, span: _RingSpan, bricks: Voxels, sizes: Sequence[int], pinned: Set[str]
    ) -> dict[str, Tensor]:
        """Gathers bricks into the ring and starts their copy; returns where they arrive."""
        assert self._host is not None and self._target is not None
        offset, arriving = span.begin, {}
        copies: list[tuple[Tensor, Tensor]] = []  # to, from
        for (name, rows), size in zip(bricks.items(), sizes, strict=True):
            at = slice(offset, offset + len(rows) * _row_bytes(rows))
            offset += size
            arriving[name] = self._target[at].view(rows.dtype).view(rows.shape)
            if isinstance(rows, Tensor) and name in pinned:
                source = rows
            else:
                source = self._host[at].view(rows.dtype).view(rows.shape)
                rows.gather(source) if isinstance(rows, TableRows) else source.copy_(rows)
            copies.append((arriving[name], source))
        with torch.cuda.stream(self._stream) if self._stream else nullcontext():
            for to, source in copies:
                to.copy_(source, non_blocking=True)
            span.copied = self._stream.record_event() if self._stream else _NoEvent()
        span.source = bricks
        return arriving

    def _is_pinned(self, rows: Tensor | TableRows) -> bool:
        if self._device.type != "cuda" or not isinstance(rows, Tensor):
            return False
        return rows.is_contiguous() and rows.is_pinned()

    def _take(self, nbytes: int) -> _RingSpan | None:
        """Takes the next bytes of the ring; returns None if they are not free."""
        with self._lock:
            self._allocate()
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
            span = _RingSpan(begin, begin + nbytes)
            self._spans.append(span)
            return span

    def _allocate(self) -> None:
        if self._host is not None:
            return
        cuda = self._device.type == "cuda"
        self._target = torch.empty(self.nbytes, dtype=torch.uint8, device=self._device)
        if cuda:
            self._stream = torch.cuda.Stream(self._device)
            self._stream.wait_stream(torch.cuda.current_stream(self._device))
            self._target.record_stream(self._stream)
        self._host = torch.empty(self.nbytes, dtype=torch.uint8, pin_memory=cuda)


def joined(data: Voxels | Sequence[Chunk], device: torch.device) -> dict[str, Tensor]:
    """Returns all bricks on the device, in tensors of their own."""
    if isinstance(data, Mapping):
        return {name: on_device(rows, device) for name, rows in data.items()}
    pieces: list[dict[str, Tensor]] = []
    for chunk in data:
        with chunk as arrived:
            pieces.append({name: rows.clone() for name, rows in arrived.items()})
    return {name: torch.cat([piece[name] for piece in pieces]) for name in pieces[0]}


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """Returns a small tensor on the device; the host does not wait for the copy."""
    if device.type != "cuda" or tensor.device.type != "cpu" or tensor.numel() == 0:
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


def _row_bytes(rows: Tensor | TableRows) -> int:
    return math.prod(rows.shape[1:]) * rows.dtype.itemsize
