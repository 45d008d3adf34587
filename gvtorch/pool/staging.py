"""`Staging`: sends bricks from the host to the device while the device renders; `BrickTable`:
bricks that a producer keeps ready in host memory; `mapped`: host memory that the device reads.

Bricks are gathered chunk by chunk into a ring of pinned memory, copied on a separate stream, and
written into their slots by the stream that renders, which waits for each copy by an event. One
chunk is gathered, in torch's threads, while the one before is copied. Bricks already in pinned
memory are copied from there.

The host never waits: if the ring is full, fewer bricks are sent, and the others later.
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

from ..base import check
from ..base.lasting import lasting

_MAX_RING_BYTES = 256 * 10**6  # most bytes of a ring
#: Bytes of a chunk: smaller is all overhead, larger overlaps less.
_CHUNK_BYTES = (2 * 10**6, 16 * 10**6)
#: Most bytes copied, not mapped: the device reads its own memory faster.
_MAX_COPIED_BYTES = 64 * 10**6
_ALIGN_BYTES = 16  # alignment of channels in a chunk
_WORD_DTYPES = {8: torch.int64, 4: torch.int32, 2: torch.int16, 1: torch.uint8}


class BrickTable:
    """Bricks that are ready in host memory. A producer answers with `table[row]`: the bricks are
    gathered only once, on their way to the device.
    """

    def __init__(self, bricks: Tensor) -> None:
        """Wraps (n, z, y, x, c) bricks on the CPU, borders included.

        Raises:
            ValueError: They are not a contiguous tensor on the CPU, or hold NaN or infinite values.
        """
        is_table = isinstance(bricks, Tensor) and bricks.dim() == 5
        if not is_table or bricks.device.type != "cpu" or not bricks.is_contiguous():
            raise ValueError(
                "BrickTable: bricks must be contiguous (n, z, y, x, c) on the CPU, "
                f"got {check.describe(bricks)}"
            )
        if bricks.is_floating_point() and not torch.isfinite(bricks.sum(dtype=torch.float64)):
            raise ValueError("BrickTable: bricks hold NaN or infinite values")
        self.bricks = bricks

    def __len__(self) -> int:
        return len(self.bricks)

    def __getitem__(self, row: Tensor) -> TableRows:
        """Selects bricks by their (k,) rows, integers; ValueError if one is outside the table."""
        is_list = isinstance(row, Tensor) and row.dim() == 1
        if not is_list or row.is_floating_point() or row.dtype == torch.bool:
            raise ValueError(f"BrickTable: rows must be (k,) integers, got {check.describe(row)}")
        row = row.to(device="cpu", dtype=torch.int64)
        if len(row) and (int(row.min()) < 0 or int(row.max()) >= len(self)):
            raise ValueError(f"BrickTable: rows must be 0 to {len(self) - 1}")
        return TableRows(self.bricks, row)

    def __repr__(self) -> str:
        return f"BrickTable({check.describe(self.bricks)}, {self.bricks.nbytes / 1e6:.1f} MB)"


class TableRows:
    """Some bricks of a table, not gathered yet: like a tensor (k, z, y, x, c) on the CPU."""

    def __init__(self, table: Tensor, row: Tensor) -> None:
        """Selects rows (k,) int64 of a table (n, z, y, x, c)."""
        self.table, self.row = table, row

    def __len__(self) -> int:
        return len(self.row)

    def __getitem__(self, index: slice | Tensor) -> TableRows:
        return TableRows(self.table, self.row[index.cpu() if isinstance(index, Tensor) else index])

    @property
    def shape(self) -> tuple[int, ...]:
        """(k, z, y, x, c)."""
        return (len(self.row), *self.table.shape[1:])

    @property
    def dtype(self) -> torch.dtype:
        return self.table.dtype

    def gather(self, out: Tensor | None = None) -> Tensor:
        """Returns the bricks, in `out` if that is given."""
        out = torch.empty(self.shape, dtype=self.dtype, device="cpu") if out is None else out
        table, rows = wide_rows(self.table, out)
        torch.index_select(table, 0, self.row, out=rows)
        return out


Voxels = Mapping[str, Tensor | TableRows]  # for each channel (k, z, y, x, c)


def gather(rows: Tensor | TableRows, out: Tensor | None = None) -> Tensor:
    """Returns a copy of rows (k, ...), in `out` if that is given."""
    if isinstance(rows, TableRows):
        return rows.gather(out)
    return rows.clone() if out is None else out.copy_(rows)


def wide_rows(*tensors: Tensor) -> list[Tensor]:
    """Returns (k, w) views of contiguous tensors in the widest integers that fit all of their rows:
    fewer elements move, and uint16, which torch can't index, becomes int16.
    """
    widest = 8
    for tensor in tensors:
        row = math.prod(tensor.shape[1:]) * tensor.itemsize
        widest = math.gcd(widest, row, tensor.storage_offset() * tensor.itemsize)
        widest = math.gcd(widest, tensor.data_ptr())
    word = _WORD_DTYPES[widest]
    return [t.view(len(t), math.prod(t.shape[1:])).view(word) for t in tensors]


def on_host(data: Voxels) -> bool:
    """Returns whether any channel lies in host memory."""
    return any(isinstance(rows, TableRows) or rows.device.type == "cpu" for rows in data.values())


def on_device(rows: Tensor | TableRows, device: torch.device) -> Tensor:
    """Returns contiguous bricks on the device; the host waits for the copy."""
    gathered = rows.gather() if isinstance(rows, TableRows) else rows
    return gathered.to(device).contiguous()


@dataclass(eq=False)
class _RingSpan:
    """Bytes `begin` to `end` of the ring, taken by one chunk. They are free again when the copy is
    done and the chunk was read, or its `Chunk` was dropped unread.
    """

    begin: int
    end: int
    copied: Any = None  # CUDA events, None until they are recorded
    read: Any = None
    chunk: Callable[[], Chunk | None] | None = None  # weak reference, None until it is sent
    source: Any = None  # keeps pinned memory alive while it is copied

    def free(self) -> bool:
        if self.chunk is None or (self.copied is not None and not self.copied.query()):
            return False
        return self.read.query() if self.read is not None else self.chunk() is None


class Chunk:
    """Bricks `begin` to `end` of `SentBricks`. `with chunk as data:` makes the current stream wait
    for their copy and gives {channel: (k, z, y, x, c)} on the device, valid inside the block.
    """

    def __init__(self, begin: int, end: int, data: Mapping[str, Tensor], span: _RingSpan) -> None:
        self.begin, self.end = begin, end
        self.data, self._span = data, span
        self._device = next(iter(data.values())).device

    def __enter__(self) -> Mapping[str, Tensor]:
        if self._device.type == "cuda":
            torch.cuda.current_stream(self._device).wait_event(self._span.copied)
        return self.data

    def __exit__(self, *_error: object) -> None:
        if self._device.type == "cuda":
            self._span.read = torch.cuda.current_stream(self._device).record_event()
        else:
            self._span.chunk = lambda: None


@dataclass(frozen=True, eq=False, repr=False)
class SentBricks:
    """Bricks that were sent, and those that found no room."""

    chunks: Sequence[Chunk]  # the bricks on their way
    sent: int  # number of bricks in them
    rest: Voxels  # the other bricks, still on the host


class Staging:
    """A ring buffer in pinned memory and one like it on the device. Any thread may send."""

    def __init__(self, payload: int, brick_bytes: int, device: torch.device) -> None:
        """Chooses sizes for at most `payload` bytes a frame, in bricks of `brick_bytes`; memory is
        allocated at the first `send`. On the CPU, for tests, nothing is pinned.
        """
        smallest, largest = _CHUNK_BYTES
        padded_brick = brick_bytes + 64 * _ALIGN_BYTES  # alignment of up to 64 channels
        self.chunk = max(padded_brick, min(largest, max(smallest, payload // 8)))
        self.nbytes = max(4 * self.chunk, min(_MAX_RING_BYTES, 2 * payload))
        self._device = device
        self._spans: deque[_RingSpan] = deque()
        self._lock = threading.Lock()
        self._host_ring: Tensor | None = None
        self._device_ring: Tensor | None = None
        self._stream: Any = None

    def send(self, data: Voxels) -> SentBricks:
        """Sends bricks from the host, as many as there is room for; ValueError if one is larger
        than the ring was made for.
        """
        count = len(next(iter(data.values())))
        if count == 0:
            return SentBricks([], 0, data)
        widths = [row_bytes(rows) for rows in data.values()]
        cuda = self._device.type == "cuda"
        pinned = {name for name, rows in data.items() if cuda and _is_pinned(rows)}
        room = self.chunk if len(pinned) < len(data) else self.nbytes // 4  # nothing to overlap
        per_chunk = (room - _ALIGN_BYTES * len(data)) // sum(widths)
        if per_chunk < 1:
            raise ValueError(f"Staging: a brick of {sum(widths)} bytes is too large")
        chunks: list[Chunk] = []
        begin = 0
        while begin < count:
            end = min(count, begin + per_chunk)
            sizes = [-(-(end - begin) * size // _ALIGN_BYTES) * _ALIGN_BYTES for size in widths]
            span = self._reserve(sum(sizes))
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
        return SentBricks(chunks, begin, {name: rows[begin:] for name, rows in data.items()})

    def _copy(
        self, span: _RingSpan, bricks: Voxels, sizes: Sequence[int], pinned: Set[str]
    ) -> dict[str, Tensor]:
        """Gathers bricks into the ring and starts their copy; returns where they arrive."""
        assert self._host_ring is not None and self._device_ring is not None
        offset, arriving = span.begin, {}
        with torch.cuda.stream(self._stream) if self._stream else nullcontext():
            for (name, rows), size in zip(bricks.items(), sizes, strict=True):
                byte_range = slice(offset, offset + len(rows) * row_bytes(rows))
                offset += size
                arriving[name] = self._device_ring[byte_range].view(rows.dtype).view(rows.shape)
                if isinstance(rows, Tensor) and name in pinned:
                    source = rows
                else:
                    source = self._host_ring[byte_range].view(rows.dtype).view(rows.shape)
                    gather(rows, source)
                arriving[name].copy_(source, non_blocking=True)
            if self._stream:
                span.copied = self._stream.record_event()
        span.source = bricks
        return arriving

    def _reserve(self, nbytes: int) -> _RingSpan | None:
        """Reserves the next bytes of the ring; returns None if they are not free."""
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

    @lasting
    def _allocate(self) -> None:
        if self._host_ring is not None:
            return
        cuda = self._device.type == "cuda"
        self._device_ring = torch.empty(self.nbytes, dtype=torch.uint8, device=self._device)
        if cuda:
            self._stream = torch.cuda.Stream(self._device)
            self._stream.wait_stream(torch.cuda.current_stream(self._device))
            self._device_ring.record_stream(self._stream)
        self._host_ring = torch.empty(self.nbytes, dtype=torch.uint8, pin_memory=cuda, device="cpu")


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """Returns a small tensor on the device; the host does not wait for the copy."""
    if device.type != "cuda" or tensor.device.type != "cpu" or tensor.numel() == 0:
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


class _LockedPages:
    """Host memory that CUDA has page-locked, in a form that torch can wrap as a tensor."""

    def __init__(self, host: Tensor) -> None:
        runtime, start, size = torch.cuda.cudart(), host.data_ptr(), host.nbytes
        error_code = int(runtime.cudaHostRegister(start, size, 0))
        if error_code:
            raise RuntimeError(
                f"{size / 1e6:.0f} MB of host memory can't be locked (CUDA {error_code})"
            )
        self.host = host  # keeps it alive
        self.__cuda_array_interface__: dict[str, Any] = {
            "data": (start, False),
            "shape": (size,),
            "typestr": "|u1",
            "version": 3,
        }
        weakref.finalize(self, _unlock, start).atexit = False  # the process's end unlocks as well


def _unlock(start: int) -> None:
    torch.cuda.synchronize()  # until nothing reads there any more
    torch.cuda.cudart().cudaHostUnregister(start)


def mapped(host: Tensor, device: torch.device) -> Tensor:
    """Returns a tensor on the device with the content of a contiguous one on the host: small ones
    are copied, others mapped in place, and page-locked while the result lives.

    Raises:
        RuntimeError: The system does not let that much memory be locked.
    """
    if device.type != "cuda" or host.nbytes <= _MAX_COPIED_BYTES:
        return host.to(device)
    with torch.cuda.device(device):
        mapped_bytes = torch.as_tensor(_LockedPages(host), device=device)
    return mapped_bytes.view(host.dtype).view(host.shape)


def _is_pinned(rows: Tensor | TableRows) -> bool:
    return isinstance(rows, Tensor) and rows.is_contiguous() and rows.is_pinned()


def row_bytes(rows: Tensor | TableRows) -> int:
    """Returns the bytes of one of (k, ...) rows."""
    return math.prod(rows.shape[1:]) * rows.dtype.itemsize
