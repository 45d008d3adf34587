"""A check that the host does not wait for the device."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def nobody_waits(mode: str = "error", device: str = "cuda") -> Iterator[None]:
    """Makes it an error, or a warning, if the host waits for a CUDA device within the block; does
    nothing on the CPU.
    """
    if torch.device(device).type != "cuda":
        yield
        return
    torch.cuda.synchronize()
    try:
        with warnings.catch_warnings():
            # torch warns, once a process, that this mode is a prototype.
            warnings.filterwarnings("ignore", "Synchronization debug mode")
            torch.cuda.set_sync_debug_mode(mode)
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")
