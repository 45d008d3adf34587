"""`Exchange`: passes pictures between OpenGL and torch, without the host if both use one device.

Colours and depths are read as tensors from the framebuffer bound for reading, and written into the
one bound for drawing. Each is transferred in the type in which OpenGL stores it, because drivers
convert types on the host. They also convert most formats of depth there, in both directions, so
depth is turned into a colour (or back) by drawing one triangle.

Source: CUDA runtime API, section "OpenGL interoperability".
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from ..base import check
from . import functions as gl

_VERTEX = """#version 150
void main() {  // one triangle over all pixels
  gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, 0, 1);
}
"""
_FRAGMENT = """#version 150
uniform sampler2D color, depth;
out vec4 result;
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  result = texelFetch(color, pixel, 0);
  gl_FragDepth = texelFetch(depth, pixel, 0).r;
}
"""
_PROGRAM_NUMBERS = itertools.count()
_READ_TYPES = {gl.UNSIGNED_BYTE: torch.uint8, gl.HALF_FLOAT: torch.float16}
_PIXEL_TYPES = {
    torch.uint8: gl.UNSIGNED_BYTE,
    torch.float16: gl.HALF_FLOAT,
    torch.float32: gl.FLOAT,
}
_COLOR_FORMATS = {torch.uint8: gl.RGBA8, torch.float16: gl.RGBA16F, torch.float32: gl.RGBA32F}
_DEPTH_FORMATS = {16: gl.DEPTH_COMPONENT16, 24: gl.DEPTH_COMPONENT24, 32: gl.DEPTH_COMPONENT32F}
#: Texture parameters: nearest filters, and 0 as the last mipmap level.
_TEXTURE_PARAMETERS = {0x2800: 0x2600, 0x2801: 0x2600, 0x813D: 0}
_SAMPLES_HINT = "it must be complete, and a framebuffer of several samples a pixel resolved first"


class Exchange:
    """Passes pictures of one size between an OpenGL context and torch.

    The context, or one that shares its objects, must be current on this thread in every call,
    `close` included; its state is left unchanged. Tensors have their first row at the top, as
    pictures do. Where buffers are shared, no call waits for the device. An exchange that is never
    closed leaves its buffers and textures to the context.

    Attributes:
        width, height, device: As they were given.
        shared: Whether CUDA maps OpenGL's buffers; else pixels are copied through the host.
        reason: Why they are not shared, or "".
    """

    def __init__(
        self,
        width: int,
        height: int,
        device: torch.device | str = "cuda",
        *,
        share: bool | None = None,
        load: gl.Loader | None = None,
    ) -> None:
        """Makes an exchange in the current context, OpenGL 3.2 or newer.

        Args:
            width: Pixels of each picture.
            height: Pixels of each picture.
            device: Device of the tensors that are read.
            share: Whether buffers are shared with CUDA; default: wherever that is possible.
            load: Returns the address of an OpenGL function by its name, from the library that made
                the context (such as `glfw.get_proc_address`); default: the system's library.

        Raises:
            ValueError: A size is not positive or more than a texture can have, or there is no such
                device.
            RuntimeError: There is no context, its OpenGL is too old, or `share` is true and CUDA
                can't map its buffers.
        """
        context = "opengl.Exchange"
        if not (share is None or isinstance(share, bool)):
            raise ValueError(f"{context}: share must be bool or None, got {share!r}")
        self.device = check.device(context, device)
        self._gl = gl.Functions(context, load)
        limit = self._gl.integer(gl.MAX_TEXTURE_SIZE)
        self.width = check.integer(context, "width", width, low=1, high=limit)
        self.height = check.integer(context, "height", height, low=1, high=limit)
        self._size = [self.width, self.height]
        declined = share is False
        self.reason = "share is False" if declined else _why_not_shared(self._gl, self.device)
        if share and self.reason:
            raise RuntimeError(f"{context}: buffers can't be shared: {self.reason}")
        self.shared = not self.reason
        # A tensor: all devices divide alike.
        self._byte_max = torch.full((1,), 255.0, dtype=torch.float32, device=self.device)
        transfer_type = _SharedTransfer if self.shared else _HostTransfer
        self._transfers = defaultdict[str, _HostTransfer](
            partial(transfer_type, self._gl, self.device)
        )
        self._textures: dict[str, tuple[int, int]] = {}  # name and format
        # No other program has an output of this name: `_require_context` looks it up.
        self._output_name = f"result_{next(_PROGRAM_NUMBERS)}"
        with self._gl.unchanged(drawing=True):
            self._program = self._gl.program(
                _VERTEX, _FRAGMENT.replace("result", self._output_name)
            )
            self._gl.UseProgram(self._program)
            for name, unit in (("color", 0), ("depth", 1)):
                location = self._gl.GetUniformLocation(self._program, name.encode())
                self._gl.Uniform1i(location, unit)

    def __repr__(self) -> str:
        how = f"shared with {self.device}" if self.shared else f"through the host: {self.reason}"
        return f"Exchange({self.width}x{self.height}, {how})"

    def read_color(self) -> Tensor:
        """Reads the read buffer of the framebuffer that is bound for reading.

        Returns:
            (h, w, 4) float32 as stored: 0 to 1 in normalised formats; sRGB formats are not decoded.

        Raises:
            RuntimeError: It has no such colours, several samples a pixel, or another size (OpenGL
                does not report that of a window).
        """
        with self._in_context("read_color"):
            self._require_size(self._gl.integer(gl.READ_BUFFER), "colours")
            dtype = _READ_TYPES.get(self._gl.integer(gl.COLOR_READ_TYPE), torch.float32)
            self._gl.forget_errors()  # the query may fail before OpenGL 4.1
            return self._read_pixels("read color", gl.RGBA, dtype)

    def read_depth(self) -> Tensor:
        """Reads the depth of the framebuffer that is bound for reading.

        Returns:
            (h, w, 1) float32 window depth, 0 to 1; `ray_distance` converts it to distances.

        Raises:
            RuntimeError: It has no depth, several samples a pixel, or another size.
        """
        with (
            self._in_context("read_depth", drawing=True),
            self._gl.temporary("Framebuffers") as framebuffer,
        ):
            self._require_size(gl.DEPTH_ATTACHMENT, "depth")
            attachment = (gl.READ_FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.ATTACHED_DEPTH_SIZE)
            bits = self._attachment_parameter(*attachment)
            self._bind_texture("copied depth", _DEPTH_FORMATS.get(bits, gl.DEPTH_COMPONENT24))
            self._gl.CopyTexSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 0, 0, *self._size)
            self._gl.check(f"the framebuffer has a depth? {_SAMPLES_HINT}")
            color_texture = self._bind_texture("shown depth", gl.R32F)
            self._gl.BindFramebuffer(gl.DRAW_FRAMEBUFFER, framebuffer)
            self._gl.BindFramebuffer(gl.READ_FRAMEBUFFER, framebuffer)
            self._gl.FramebufferTexture2D(
                gl.DRAW_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, color_texture, 0
            )
            self._draw_textures("copied depth", None)
            return self._read_pixels("read depth", gl.RED, torch.float32)

    def upload(self, color: Tensor, depth: Tensor | None = None) -> tuple[int, int]:
        """Writes pictures into textures that the caller's shaders can sample.

        Args:
            color: (h, w, 3) or (h, w, 4), uint8, float16 or float32, on any device; stored as
                RGBA8, RGBA16F or RGBA32F.
            depth: (h, w, 1) floats, stored as R32F.

        Returns:
            The names of both textures, whose first row is the bottom one; 0 for a depth that was
            not given. They belong to the exchange: the next `upload` or `draw` overwrites them.

        Raises:
            ValueError: A wrong shape or dtype.
        """
        with self._in_context("upload"):
            return self._upload(color, depth)

    def draw(self, color: Tensor, depth: Tensor | None = None) -> None:
        """Overwrites the first draw buffer of the framebuffer bound for drawing with pictures, from
        the lower left corner on; what is drawn later is tested against their depth.

        Args:
            color: As in `upload`, the values to be stored.
            depth: As in `upload`: window depth, 0 to 1, as `window_depth` gives it; if left out,
                the framebuffer's depth stays.

        Raises:
            ValueError: A wrong shape or dtype.
            RuntimeError: OpenGL can't draw into the framebuffer, or it has no depth and one was
                given.
        """
        with self._in_context("draw", drawing=True):
            self._upload(color, depth)
            attachment = (gl.DRAW_FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.ATTACHED_KIND)
            if depth is not None and not self._attachment_parameter(*attachment):
                raise RuntimeError(
                    f"{self._gl.context}: the framebuffer that is bound for drawing has no depth"
                )
            self._draw_textures("color", None if depth is None else "depth")

    def close(self) -> None:
        """Frees buffers, textures and program; the exchange can't be used afterwards. Raises
        RuntimeError if its context is not current; then it still has to be closed.
        """
        if not self._program:
            return
        self._require_context("close")
        with ExitStack() as cleanup:
            cleanup.callback(self._gl.forget_errors)
            cleanup.callback(self._transfers.clear)
            for transfer in self._transfers.values():
                cleanup.callback(transfer.close)
            for name, _ in self._textures.values():
                cleanup.callback(self._gl.drop, "Textures", name)
            cleanup.callback(self._gl.DeleteProgram, self._program)
            self._textures, self._program = {}, 0

    def __enter__(self) -> Exchange:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _in_context(self, method: str, *, drawing: bool = False) -> Iterator[None]:
        self._require_context(method)
        with self._gl.unchanged(drawing=drawing):
            yield

    def _require_context(self, method: str) -> None:
        """Raises unless the exchange is open and its context current."""
        context = self._gl.context = f"opengl.Exchange.{method}"
        if not self._program:
            raise RuntimeError(f"{context}: the exchange is closed")
        self._gl.require_context()
        is_own = self._gl.GetFragDataLocation(self._program, self._output_name.encode()) >= 0
        self._gl.forget_errors()  # of a context without this program
        if not is_own:
            raise RuntimeError(f"{context}: another OpenGL context is current than the exchange's")

    def _read_pixels(self, kind: str, channels: int, dtype: torch.dtype) -> Tensor:
        """Reads RGBA (h, w, 4) or RED (h, w, 1), float32, of the framebuffer bound for reading."""

        def read(address: int) -> None:
            self._gl.ReadPixels(0, 0, *self._size, channels, _PIXEL_TYPES[dtype], address)
            self._gl.check(f"the framebuffer has colours that are no integers? {_SAMPLES_HINT}")

        shape = (self.height, self.width, 4 if channels == gl.RGBA else 1)
        image = self._transfers[kind].pull(read, shape, dtype).float()
        return image / self._byte_max if dtype == torch.uint8 else image

    def _bind_texture(self, kind: str, stored_format: int) -> int:
        """Binds and returns the texture of a kind; recreates it if its format has changed."""
        name, old_format = self._textures.get(kind, (0, 0))
        if old_format != stored_format:
            self._gl.drop("Textures", name)  # ignores 0
            name = self._gl.make("Textures")
            self._textures[kind] = name, stored_format
            self._gl.BindTexture(gl.TEXTURE_2D, name)
            layout = (
                gl.DEPTH_COMPONENT if stored_format in _DEPTH_FORMATS.values() else gl.RED,
                gl.FLOAT,
            )
            self._gl.TexImage2D(gl.TEXTURE_2D, 0, stored_format, *self._size, 0, *layout, None)
            for parameter, value in _TEXTURE_PARAMETERS.items():
                self._gl.TexParameteri(gl.TEXTURE_2D, parameter, value)
            self._gl.check(f"a texture of {self.width}x{self.height} pixels")
        self._gl.BindTexture(gl.TEXTURE_2D, name)
        return name

    def _upload(self, color: Tensor, depth: Tensor | None) -> tuple[int, int]:
        size = (self.height, self.width)
        if not (
            isinstance(color, Tensor)
            and color.dtype in _COLOR_FORMATS
            and color.dim() == 3
            and (*color.shape[:2],) == size
            and color.shape[2] in (3, 4)
        ):
            raise ValueError(
                f"{self._gl.context}: color must be ({size[0]}, {size[1]}, 3 or 4) uint8, "
                f"float16 or float32, got {check.describe(color)}"
            )
        if depth is not None and not (
            isinstance(depth, Tensor) and depth.is_floating_point() and depth.shape == (*size, 1)
        ):
            raise ValueError(
                f"{self._gl.context}: depth must be ({size[0]}, {size[1]}, 1) floats, "
                f"got {check.describe(depth)}"
            )
        if color.shape[2] == 3:
            opaque = 255 if color.dtype == torch.uint8 else 1
            color = torch.cat((color, torch.full_like(color[..., :1], opaque)), -1)
        color_texture = self._write_texture(
            "color", color.detach(), _COLOR_FORMATS[color.dtype], gl.RGBA
        )
        if depth is None:
            return color_texture, 0
        return color_texture, self._write_texture("depth", depth.detach().float(), gl.R32F, gl.RED)

    def _write_texture(self, kind: str, image: Tensor, stored_format: int, channels: int) -> int:
        """Writes an image into the texture of a kind."""
        name = self._bind_texture(kind, stored_format)

        def write(address: int) -> None:
            layout = (channels, _PIXEL_TYPES[image.dtype])
            self._gl.TexSubImage2D(gl.TEXTURE_2D, 0, 0, 0, *self._size, *layout, address)

        self._transfers[f"write {kind}"].push(image, write)
        self._gl.check("a texture's pixels could not be written")
        return name

    def _draw_textures(self, color: str, depth: str | None) -> None:
        """Draws textures of these kinds over the framebuffer that is bound for drawing."""
        for unit, kind in enumerate((color, depth)):
            self._gl.ActiveTexture(gl.TEXTURE0 + unit)
            self._gl.BindTexture(gl.TEXTURE_2D, self._textures[kind][0] if kind else 0)
        (self._gl.Enable if depth else self._gl.Disable)(gl.DEPTH_TEST)
        self._gl.set_viewport(self.width, self.height)
        self._gl.UseProgram(self._program)
        with self._gl.temporary("VertexArrays") as vertices:
            self._gl.BindVertexArray(vertices)
            self._gl.DrawArrays(gl.TRIANGLES, 0, 3)
        self._gl.check("is the framebuffer that is bound for drawing complete?")

    def _attachment_parameter(self, target: int, attachment: int, parameter: int) -> int:
        """Returns a parameter of a framebuffer's attachment, or 0 if there is none."""
        if attachment == gl.DEPTH_ATTACHMENT and not self._gl.integer(
            gl.FRAMEBUFFER_BINDINGS[target]
        ):
            attachment = gl.DEPTH  # its name in a window's framebuffer
        get = "GetFramebufferAttachmentParameteriv"
        return self._gl.parameter(get, target, attachment, parameter)

    def _require_size(self, attachment: int, name: str) -> None:
        """Raises unless an image of the exchange's size is attached to the framebuffer bound for
        reading. A window's own framebuffer passes: OpenGL does not know its size.
        """
        if not self._gl.integer(gl.READ_FRAMEBUFFER_BINDING):
            return
        prefix = f"{self._gl.context}: the framebuffer that is bound for reading has"
        kind, object_name, level = (
            self._attachment_parameter(gl.READ_FRAMEBUFFER, attachment, parameter)
            for parameter in (gl.ATTACHED_KIND, gl.ATTACHED_NAME, gl.ATTACHED_LEVEL)
        )
        if not kind:
            raise RuntimeError(f"{prefix} no {name}")
        size = self._gl.attached_size(kind, object_name, level)
        # If the size is unknown, OpenGL itself reports whether the texture can be read.
        if size is not None and size != self._size:
            raise RuntimeError(
                f"{prefix} {size[0]}x{size[1]} pixels, the exchange {self.width}x{self.height}"
            )


class _HostTransfer:
    """Moves pixels between any OpenGL and any device through host memory, and flips their rows,
    which run upwards in OpenGL.
    """

    def __init__(self, functions: gl.Functions, device: torch.device) -> None:
        self._gl, self._device = functions, device

    def pull(
        self, read: Callable[[int], None], shape: tuple[int, ...], dtype: torch.dtype
    ) -> Tensor:
        """Returns an image; `read` has OpenGL write it to a host address, or to an offset in the
        bound buffer.
        """
        host = torch.empty(shape, dtype=dtype, pin_memory=self._device.type == "cuda", device="cpu")
        self._gl.BindBuffer(gl.PIXEL_PACK_BUFFER, 0)
        read(host.data_ptr())
        return host.to(self._device).flip(0)

    def push(self, image: Tensor, write: Callable[[int], None]) -> None:
        """Passes an image to OpenGL; `write` has OpenGL read it from such an address or offset."""
        host = image.flip(0).cpu().contiguous()
        self._gl.BindBuffer(gl.PIXEL_UNPACK_BUFFER, 0)
        write(host.data_ptr())

    def close(self) -> None:
        """Frees what it holds."""


class _SharedTransfer(_HostTransfer):
    """Moves pixels through an OpenGL buffer object that CUDA maps. The host does not wait: mapping
    and unmapping order the work of each side after the other's.
    """

    def __init__(self, functions: gl.Functions, device: torch.device) -> None:
        super().__init__(functions, device)
        self._buffer, self._nbytes, self._resource = 0, 0, None

    def pull(
        self, read: Callable[[int], None], shape: tuple[int, ...], dtype: torch.dtype
    ) -> Tensor:
        self._resize_buffer(torch.Size(shape).numel() * dtype.itemsize)
        self._gl.BindBuffer(gl.PIXEL_PACK_BUFFER, self._buffer)
        read(0)
        with self._mapped(shape, dtype) as pixels:
            return pixels.flip(0)

    def push(self, image: Tensor, write: Callable[[int], None]) -> None:
        self._resize_buffer(image.nbytes)
        with self._mapped(tuple(image.shape), image.dtype) as pixels:
            pixels.copy_(image.flip(0))
        self._gl.BindBuffer(gl.PIXEL_UNPACK_BUFFER, self._buffer)
        write(0)
        self._gl.BindBuffer(gl.PIXEL_UNPACK_BUFFER, 0)

    def close(self) -> None:
        name, resource = self._buffer, self._resource
        self._buffer, self._nbytes, self._resource = 0, 0, None
        try:
            if resource is not None:
                with torch.cuda.device(self._device):
                    self._call_cuda("cudaGraphicsUnregisterResource", resource)
        finally:
            self._gl.drop("Buffers", name)  # ignores 0

    def _resize_buffer(self, nbytes: int) -> None:
        """Recreates the buffer unless it has `nbytes` bytes."""
        if self._nbytes == nbytes:
            return
        self.close()
        self._buffer = self._gl.make("Buffers")
        self._gl.BindBuffer(gl.PIXEL_PACK_BUFFER, self._buffer)
        self._gl.BufferData(gl.PIXEL_PACK_BUFFER, nbytes, None, gl.DYNAMIC_COPY)
        self._gl.check(f"a buffer of {nbytes} bytes for pixels")
        with torch.cuda.device(self._device):
            self._resource = self._call_cuda("cudaGraphicsGLRegisterBuffer", self._buffer, 0)
        self._nbytes = nbytes

    @contextmanager
    def _mapped(self, shape: tuple[int, ...], dtype: torch.dtype) -> Iterator[Tensor]:
        """Yields the buffer's memory as a tensor while it is mapped to CUDA."""
        with torch.cuda.device(self._device):
            stream = torch.cuda.current_stream(self._device).cuda_stream
            self._call_cuda("cudaGraphicsMapResources", 1, self._resource, stream)
            try:
                address, _ = self._call_cuda("cudaGraphicsResourceGetMappedPointer", self._resource)
                array = {"shape": (self._nbytes,), "typestr": "|u1", "version": 3}
                array["data"] = (int(address), False)
                memory = SimpleNamespace(__cuda_array_interface__=array)
                yield torch.as_tensor(memory, device=self._device).view(dtype).view(shape)
            finally:
                self._call_cuda("cudaGraphicsUnmapResources", 1, self._resource, stream)

    def _call_cuda(self, function: str, *arguments: Any) -> Any:
        """Calls CUDA's runtime; raises RuntimeError if it fails."""
        from cuda.bindings import runtime

        error, *results = getattr(runtime, function)(*arguments)
        if int(error):
            reason = runtime.cudaGetErrorString(error)[1].decode()
            raise RuntimeError(f"{self._gl.context}: {function}: {reason}")
        return results[0] if len(results) == 1 else results


def _why_not_shared(functions: gl.Functions, device: torch.device) -> str:
    """Returns why CUDA on the device (with index) can't map the context's buffers, or ""."""
    if device.type != "cuda" or torch.version.cuda is None:
        return f"{device} is not a CUDA device"
    try:
        from cuda.bindings import runtime
    except ImportError:
        return "cuda-bindings is not installed"
    renderer = functions.GetString(gl.RENDERER).decode(errors="replace")
    with torch.cuda.device(device):
        torch.cuda.current_stream(device).query()  # makes CUDA's context current
        all_devices = runtime.cudaGLDeviceList.cudaGLDeviceListAll
        error, count, devices = runtime.cudaGLGetDevices(16, all_devices)
    if int(error) or device.index not in [int(number) for number in devices[:count]]:
        return f"OpenGL draws on {renderer}, not on {device}"
    return ""
