"""The cache's ops alone, compared with torch's ops for the same task: `lru` and `compact`."""

from __future__ import annotations

import itertools

import torch

from ..base.constants import REQUEST_KINDS, REQUEST_LOAD
from ..ops import compact_requests, lru_partition
from .record import Record, clock

_REQUESTS = 1000  # nodes with a request


def lru(record: Record) -> None:
    """Sorts slots by their last use; half of them were used in this frame."""
    settings, device = record.settings, record.settings.device
    slots = 1 << (12 if settings.quick else 20)
    case = f"{slots:,} slots, half used"
    if not record.wants(case):
        return
    generator = torch.Generator().manual_seed(1)
    stamp = torch.randint(0, 99, (slots,), generator=generator, dtype=torch.int32, device="cpu")
    order = torch.sort(stamp, stable=True).indices.to(torch.int32).to(device)
    stamp[torch.randperm(slots, generator=generator, device="cpu")[: slots // 2]] = 100
    stamp = stamp.to(device)
    frame = torch.tensor([100], dtype=torch.int32, device=device)
    calls = 20 if device.type == "cuda" else 1

    ours = clock(lambda: lru_partition(order, stamp, frame), settings, calls=calls)
    theirs = clock(lambda: torch.sort(stamp, stable=True), settings, calls=calls)
    ordered, free = ours.last[0], int(ours.last[1])
    same = torch.equal(ordered[:free].long(), theirs.last.indices[:free])
    rate = 1e3 * slots / ours.median
    record.add(case, "gvtorch", ours, slots_per_second=rate)
    record.add(
        *(case, "torch.sort", theirs),
        slots_per_second=1e3 * slots / theirs.median,
        times=theirs.median / ours.median,
        same=same,
    )
    record.note("same: both list the slots that can be reused in the same order")


def compact(record: Record) -> None:
    """Lists few requests out of many request words, which it clears; each call has other words."""
    settings = record.settings
    nodes = 1 << (12 if settings.quick else 23)
    case = f"{nodes:,} nodes, {_REQUESTS:,} requests"
    if not record.wants(case):
        return
    requesting = torch.randperm(nodes, generator=torch.Generator().manual_seed(2), device="cpu")[
        :_REQUESTS
    ]
    words = torch.zeros(nodes, dtype=torch.int16, device="cpu")
    words[requesting] = REQUEST_LOAD | 77
    words = words.view(-1, 8).to(settings.device)
    count = 16 if settings.device.type == "cuda" else 4
    copies = [words.clone() for _ in range(count)]
    cycle = itertools.cycle(copies)

    def refill() -> None:
        for copy in copies:
            copy.copy_(words)

    def list_nonzero() -> torch.Tensor:
        return torch.nonzero(next(cycle).view(-1) & REQUEST_KINDS)

    capacity = 1 << 17
    ours = clock(
        lambda: compact_requests(next(cycle), capacity), settings, calls=count, prepare=refill
    )
    theirs = clock(list_nonzero, settings, calls=count, prepare=refill)
    refill()
    requested = list_nonzero()[:, 0]
    node, _, counts = compact_requests(copies[0], capacity)
    same = torch.equal(node[: int(counts[0])].long(), requested)
    for who, timing in (("gvtorch", ours), ("torch.nonzero", theirs)):
        figures = {} if who == "gvtorch" else {"times": timing.median / ours.median, "same": same}
        rate = 1e3 * words.nbytes / timing.median
        record.add(case, who, timing, words_bytes_per_second=rate, **figures)
    record.note(
        "words bytes / s: bytes of request words (2 a node) read per second; torch.nonzero only "
        "lists the nodes: it does not clear their words, and it waits for the count"
    )
