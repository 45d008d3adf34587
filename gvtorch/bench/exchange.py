"""`opengl`: what it costs to pass pictures between OpenGL and torch."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from .. import opengl as gl
from . import Unavailable
from .record import Record, Settings, Timing, spread, synchronize

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
    record.note(f"OpenGL: {context.info['GL_RENDERER']}, without a window (EGL); depth: 24 bits")
    with (
        gl.Exchange(*size, settings.device) as first,
        gl.Exchange(*size, settings.device, share=False) as second,
    ):
        if not first.shared:
            record.note(f"no buffers are shared: {first.reason}")
        for name in _FORMATS:
            _measure(record, context, name, [first, second] if first.shared else [second])
    record.note(
        "ms: until both sides are done; host ms: until the calls return; draw: colour and depth "
        "into a framebuffer; read: both out of it as float32; same: what is read is what the "
        "case's first way reads, in every bit"
    )


def _measure(record: Record, context: Any, name: str, ways: list[gl.Exchange]) -> None:
    """Draws and reads random pictures of a format through each exchange of `ways`."""
    settings, (width, height) = record.settings, (ways[0].width, ways[0].height)
    kind, dtype = _FORMATS[name]
    generator = torch.Generator().manual_seed(1)
    numbers = torch.rand(height, width, 5, generator=generator).to(settings.device)
    color, depth = numbers[..., :4] * (255 if dtype == torch.uint8 else 1), numbers[..., 4:]
    color = color.to(dtype)
    texture = context.texture((width, height), 4, dtype=kind)
    frame = context.framebuffer([texture], context.depth_texture((width, height)))
    frame.use()

    def draw(way: gl.Exchange) -> None:
        way.draw(color, depth)

    def read(way: gl.Exchange) -> tuple[torch.Tensor, torch.Tensor]:
        return way.read_color(), way.read_depth()

    for run in (draw, read):
        case = f"{run.__name__}, {name}, {width}x{height}"
        if not record.wants(case):
            continue
        settings.tell(case)
        seen = []
        for way in ways:
            draw(way)
            seen.append(read(way))
            timing, host = _clock(partial(run, way), settings, context)
            who = "shared" if way.shared else "through the host"
            same = all(map(torch.equal, seen[0], seen[-1]))
            record.add(case, who, timing, host_ms=host, same=same)
    frame.release()


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
    times, host = [], []
    for _ in range(settings.repeats + 1):  # the first warms up
        context.finish()
        synchronize(settings.device)
        start = time.perf_counter()
        run()
        host.append(1e3 * (time.perf_counter() - start))
        context.finish()
        synchronize(settings.device)
        times.append(1e3 * (time.perf_counter() - start))
    return spread(times[1:]), spread(host[1:]).median
