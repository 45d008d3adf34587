"""`in_branches`: jobs of a recorded frame that do not wait for one another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


def in_branches(*jobs: Callable[[], Any]) -> list[Any]:
    """Returns what each job returns. While a CUDA graph is recorded, jobs become branches of it,
    which run at the same time and end before what comes next; else they run one after the other.
    No job may write what another reads.
    """
    if not (torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()):
        return [job() for job in jobs]
    main = torch.cuda.current_stream()
    streams = [main, *(torch.cuda.Stream() for _ in jobs[1:])]
    for stream in streams[1:]:
        stream.wait_stream(main)
    results = []
    for job, stream in zip(jobs, streams, strict=True):
        with torch.cuda.stream(stream):
            results.append(job())
    for stream in streams[1:]:
        main.wait_stream(stream)
    return results
