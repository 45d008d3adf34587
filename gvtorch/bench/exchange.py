"""`opengl`: what it costs to pass pictures between OpenGL and torch."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from .. import opengl as gl
from . import Unavailable
from .record import Record, Settings, Timing, summarize, synchronize

#: Colour formats, as moderngl's dtype and torch's.
_FORMATS = {
    "RGBA8": ("f1", torch.uint8),
    "RGBA16F": ("f2", torch.float16),
    "RGBA32F": ("f4", torch.float32),
}


def opengl(record: Record) -> None:
    """Reads colours and depth from OpenGL and draws them, shared and through the host."""
    settings = record.settings
    size = (64, 48) if settings.quick else (1920, 1080)
    context = _context()
    record.note(f"OpenGL: {context.info['GL_RENDERER']}, without a window (EGL); 24-bit depth")
    with (
        gl.Exchange(*size, settings.device) as direct,
        gl.Exchange(*size, settings.device, share=False) as indirect,
    ):
        if not direct.shared:
            record.note(f"OpenGL and torch share no buffers here: {direct.reason}")
        for name in _FORMATS:
            _measure(record, context, name, [direct, indirect] if direct.shared else [indirect])
    record.note(
        "ms: until OpenGL and torch are done; host ms: until the calls return; draw: colour and "
        "depth into a framebuffer; read: both from it, as float32; same: what is read equals what "
        "the case's first row reads, bit for bit"
    )


def _measure(record: Record, context: Any, name: str, exchanges: list[gl.Exchange]) -> None:
    """Draws and reads random pictures of a format through each of the exchanges."""
    settings, (width, height) = record.settings, (exchanges[0].width, exchanges[0].height)
    gl_dtype, dtype = _FORMATS[name]
    generator = torch.Generator().manual_seed(1)
    values = torch.rand(height, width, 5, generator=generator, device="cpu").to(settings.device)
    color, depth = values[..., :4] * (255 if dtype == torch.uint8 else 1), values[..., 4:]
    color = color.to(dtype)
    texture = context.texture((width, height), 4, dtype=gl_dtype)
    framebuffer = context.framebuffer([texture], context.depth_texture((width, height)))
    framebuffer.use()

    def draw(exchange: gl.Exchange) -> None:
        exchange.draw(color, depth)

    def read(exchange: gl.Exchange) -> tuple[torch.Tensor, torch.Tensor]:
        return exchange.read_color(), exchange.read_depth()

    for run in (draw, read):
        case = f"{run.__name__}, {name}, {width}x{height}"
        if not record.wants(case):
            continue
        settings.tell(case)
        results = []
        for exchange in exchanges:
            draw(exchange)
            results.append(read(exchange))
            timing, host_ms = _clock(partial(run, exchange), settings, context)
            who = "shared" if exchange.shared else "through the host"
            same = all(map(torch.equal, results[0], results[-1]))
            record.add(case, who, timing, host_ms=host_ms, same=same)
    framebuffer.release()


def _context() -> Any:
    """Returns an OpenGL context without a window; raises Unavailable where there is none."""
    try:
        import moderngl

        without_a_window: dict[str, Any] = {"standalone": True, "backend": "egl"}
        return moderngl.create_context(**without_a_window)
    except ImportError:
        raise Unavailable("bench: opengl needs moderngl: pip install moderngl") from None
    except Exception as error:
        raise Unavailable(f"bench: opengl: there is no OpenGL through EGL: {error}") from None


def _clock(run: Callable[[], object], settings: Settings, context: Any) -> tuple[Timing, float]:
    """Returns the time until OpenGL and torch are done, and the median until a call returns, ms."""
    times, host_times = [], []
    for _ in range(settings.repeats + 1):  # the first warms up
        context.finish()
        synchronize(settings.device)
        start = time.perf_counter()
        run()
        host_times.append(1e3 * (time.perf_counter() - start))
        context.finish()
        synchronize(settings.device)
        times.append(1e3 * (time.perf_counter() - start))
    return summarize(times[1:]), summarize(host_times[1:]).median
