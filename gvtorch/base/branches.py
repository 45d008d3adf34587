"""`in_branches`: runs jobs of a recorded frame as parallel branches of its CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


def in_branches(*jobs: Callable[[], Any]) -> list[Any]:
    """Runs jobs and returns their results in order. While a CUDA graph is captured, jobs become its
    branches, which run at the same time and are joined at the end; else they run one by one. No job
    may write what another reads.
    """
    # Without CUDA in use there is no capture; in a forked child even the question is an error.
    if not (torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing()):
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
