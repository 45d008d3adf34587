"""How pixels get from OpenGL to torch and back: in a buffer that both see, or through the host.

Source: CUDA runtime API, section "OpenGL interoperability".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from . import functions as gl

#: A call of OpenGL that reads or writes pixels at an address, or at an offset in a bound buffer.
Transfer = Callable[[int], None]


class ThroughHost:
    """Moves pixels between any OpenGL and any device, by a copy in host memory; and flips their
    rows, which go up in OpenGL.
    """

    def __init__(self, functions: gl.Functions, device: torch.device) -> None:
        self._gl, self._device = functions, device

    def pull(self, read: Transfer, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Returns what OpenGL reads."""
        host = torch.empty(shape, dtype=dtype, pin_memory=self._device.type == "cuda")
        self._gl.BindBuffer(gl.PIXEL_PACK_BUFFER, 0)
        read(host.data_ptr())
        return host.to(self._device).flip(0)

    def push(self, image: Tensor, write: Transfer) -> None:
        """Has OpenGL write an image."""
        host = image.flip(0).cpu().contiguous()
        self._gl.BindBuffer(gl.PIXEL_UNPACK_BUFFER, 0)
        write(host.data_ptr())

    def close(self) -> None:
        """Frees what it holds."""


class Shared(ThroughHost):
    """Moves them through a buffer object of OpenGL that CUDA maps. The host does not wait: mapping
    and unmapping order the work of each side after the other's.
    """

    def __init__(self, functions: gl.Functions, device: torch.device) -> None:
        super().__init__(functions, device)
        self._name, self._nbytes, self._resource = 0, 0, None

    def pull(self, read: Transfer, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        self._hold(torch.Size(shape).numel() * dtype.itemsize)
        self._gl.BindBuffer(gl.PIXEL_PACK_BUFFER, self._name)
        read(0)
        with self._seen(shape, dtype) as pixels:
            return pixels.flip(0)

    def push(self, image: Tensor, write: Transfer) -> None:
        self._hold(image.nbytes)
        with self._seen(tuple(image.shape), image.dtype) as pixels:
            pixels.copy_(image.flip(0))
        self._gl.BindBuffer(gl.PIXEL_UNPACK_BUFFER, self._name)
        write(0)
        self._gl.BindBuffer(gl.PIXEL_UNPACK_BUFFER, 0)

    def close(self) -> None:
        name, resource = self._name, self._resource
        self._name, self._nbytes, self._resource = 0, 0, None
        try:
            if resource is not None:
                with torch.cuda.device(self._device):
                    self._cuda("cudaGraphicsUnregisterResource", resource)
        finally:
            self._gl.drop("Buffers", name)  # 0 is nothing

    def _hold(self, nbytes: int) -> None:
        """Makes sure that the buffer has so many bytes."""
        if self._nbytes == nbytes:
            return
        self.close()
        self._name = self._gl.make("Buffers")
        self._gl.BindBuffer(gl.PIXEL_PACK_BUFFER, self._name)
        self._gl.BufferData(gl.PIXEL_PACK_BUFFER, nbytes, None, gl.DYNAMIC_COPY)
        self._gl.check(f"a buffer of {nbytes} bytes for pixels")
        with torch.cuda.device(self._device):
            self._resource = self._cuda("cudaGraphicsGLRegisterBuffer", self._name, 0)
        self._nbytes = nbytes

    @contextmanager
    def _seen(self, shape: tuple[int, ...], dtype: torch.dtype) -> Iterator[Tensor]:
        """The buffer's memory as a tensor, while it is mapped to CUDA."""
        with torch.cuda.device(self._device):
            stream = torch.cuda.current_stream(self._device).cuda_stream
            self._cuda("cudaGraphicsMapResources", 1, self._resource, stream)
            try:
                place, _ = self._cuda("cudaGraphicsResourceGetMappedPointer", self._resource)
                array = {"shape": (self._nbytes,), "typestr": "|u1", "version": 3}
                array["data"] = (int(place), False)
                memory = SimpleNamespace(__cuda_array_interface__=array)
                yield torch.as_tensor(memory, device=self._device).view(dtype).view(shape)
            finally:
                self._cuda("cudaGraphicsUnmapResources", 1, self._resource, stream)

    def _cuda(self, function: str, *arguments: Any) -> Any:
        """Calls CUDA's runtime.

        Raises:
            RuntimeError: It failed.
        """
        from cuda.bindings import runtime

        error, *results = getattr(runtime, function)(*arguments)
        if int(error):
            reason = runtime.cudaGetErrorString(error)[1].decode()
            raise RuntimeError(f"{self._gl.where}: {function}: {reason}")
        return results[0] if len(results) == 1 else results


def why_not_shared(functions: gl.Functions, device: torch.device) -> str:
    """Why CUDA on the device (with its index) can't see the current context's buffers, or ""."""
    if device.type != "cuda" or torch.version.cuda is None:
        return f"{device} is not a CUDA device"
    try:
        from cuda.bindings import runtime
    except ImportError:
        return "cuda-bindings is not installed"
    renderer = functions.GetString(gl.RENDERER).decode(errors="replace")
    with torch.cuda.device(device):
        torch.cuda.current_stream(device).query()  # makes CUDA's context current
        every = runtime.cudaGLDeviceList.cudaGLDeviceListAll
        error, count, devices = runtime.cudaGLGetDevices(16, every)
    if int(error) or device.index not in [int(each) for each in devices[:count]]:
        return f"OpenGL draws on {renderer}, not on {device}"
    return ""
