"""`mapped`: host memory as a tensor of a CUDA device, which reads it in place, over the bus."""

from __future__ import annotations

import weakref
from typing import Any

import torch
from torch import Tensor

_SMALL = 64 * 10**6  # bytes: as much is copied, and read at the speed of the device's own memory


class _Pages:
    """Host memory that CUDA has locked, in the form in which torch takes memory over."""

    def __init__(self, host: Tensor) -> None:
        runtime, start, size = torch.cuda.cudart(), host.data_ptr(), host.nbytes
        failed = int(runtime.cudaHostRegister(start, size, 0))
        if failed:
            raise RuntimeError(
                f"{size / 1e6:.0f} MB of host memory can't be locked (CUDA {failed})"
            )
        self.host = host  # lives as long
        self.__cuda_array_interface__: dict[str, Any] = {
            "data": (start, False),
            "shape": (size,),
            "typestr": "|u1",
            "version": 3,
        }
        weakref.finalize(self, _unlock, start).atexit = False  # the process's end unlocks as well


def _unlock(start: int) -> None:
    torch.cuda.synchronize()  # nothing reads there any more
    torch.cuda.cudart().cudaHostUnregister(start)


def mapped(host: Tensor, device: torch.device) -> Tensor:
    """Returns a tensor on the device with the content of a contiguous one on the host: small ones
    copied, others where they lie, which stays locked while the result lives.

    Raises:
        RuntimeError: The system does not let that much memory be locked.
    """
    if device.type != "cuda" or host.nbytes <= _SMALL:
        return host.to(device)
    with torch.cuda.device(device):
        there = torch.as_tensor(_Pages(host), device=device)
    return there.view(host.dtype).view(host.shape)
