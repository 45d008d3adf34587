"""`Exchange` among several OpenGL contexts, made by EGL itself: foreign ones, ones that share
objects, ones on other threads, and compatibility profiles with their old state.
"""

from __future__ import annotations

import ctypes
import functools
import threading

import pytest
import torch
from helpers.opengl import opengl_context

import gvtorch as gv
from gvtorch.opengl import functions as gl
from gvtorch.ops import unavailable

pytestmark = pytest.mark.backend("opengl")
WIDTH, HEIGHT = 13, 7
CORE, COMPATIBILITY = 1, 2


@functools.cache
def _egl():
    """Returns EGL, and a display on which contexts need no surface."""
    opengl_context().__enter__()
    egl = ctypes.CDLL("libEGL.so.1")
    for name in ("eglGetCurrentDisplay", "eglCreateContext"):
        getattr(egl, name).restype = ctypes.c_void_p
    return egl, ctypes.c_void_p(egl.eglGetCurrentDisplay())


def make_context(profile: int = CORE, share: ctypes.c_void_p | None = None) -> ctypes.c_void_p:
    egl, display = _egl()
    egl.eglBindAPI(0x30A2)
    attributes = (ctypes.c_int * 5)(0x3040, 8, 0x3033, 1, 0x3038)  # OpenGL, pbuffers
    config, count = ctypes.c_void_p(), ctypes.c_int()
    egl.eglChooseConfig(display, attributes, ctypes.byref(config), 1, ctypes.byref(count))
    attributes = (ctypes.c_int * 7)(0x3098, 3, 0x30FB, 3, 0x30FD, profile, 0x3038)
    context = ctypes.c_void_p(egl.eglCreateContext(display, config, share, attributes))
    if not context:
        pytest.skip(f"EGL makes no context of profile {profile}")
    return context


def use(context: ctypes.c_void_p | None) -> None:
    egl, display = _egl()
    egl.eglBindAPI(0x30A2)
    assert egl.eglMakeCurrent(display, None, None, context)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.backend("cuda"))])
def device(request):
    if request.param == "cuda" and (reason := unavailable()["cuda"]):
        pytest.skip(f"backend cuda: {reason}")
    opengl_context()  # and EGL's display, which others may have terminated
    yield request.param
    use(None)


def target(functions: gl.Functions) -> tuple[int, int, int]:
    """Binds a new framebuffer with colour and depth; returns the names."""
    names = [functions.make("Textures") for _ in range(2)]
    layouts = [(gl.RGBA32F, gl.RGBA), (gl.DEPTH_COMPONENT32F, gl.DEPTH_COMPONENT)]
    frame = functions.make("Framebuffers")
    for binding in gl.FRAMEBUFFER_BINDINGS:
        functions.BindFramebuffer(binding, frame)
    attachments = (gl.COLOR_ATTACHMENT0, gl.DEPTH_ATTACHMENT)
    for name, (stored, layout), attachment in zip(names, layouts, attachments, strict=True):
        functions.BindTexture(gl.TEXTURE_2D, name)
        size = (WIDTH, HEIGHT)
        functions.TexImage2D(gl.TEXTURE_2D, 0, stored, *size, 0, layout, gl.FLOAT, None)
        functions.FramebufferTexture2D(gl.DRAW_FRAMEBUFFER, attachment, gl.TEXTURE_2D, name, 0)
    return frame, *names


def pictures(device: str, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    both = [torch.rand(HEIGHT, WIDTH, channels, generator=generator) for channels in (4, 1)]
    return [picture.to(device) for picture in both]


def assert_passes(exchange: gv.opengl.Exchange, seed: int = 0) -> None:
    color, depth = pictures(exchange.device, seed)
    exchange.draw(color, depth)
    assert torch.equal(exchange.read_color(), color)
    assert torch.equal(exchange.read_depth(), depth)


def test_a_foreign_context_is_told_and_stays_as_it_was(device):
    ours, foreign = make_context(), make_context()
    use(ours)
    exchange = gv.opengl.Exchange(WIDTH, HEIGHT, device)
    target(gl.Functions("test"))
    assert_passes(exchange)
    use(foreign)
    functions = gl.Functions("test")
    with gv.opengl.Exchange(WIDTH, HEIGHT, device) as other:  # its objects have the same names
        target(functions)
        assert_passes(other, seed=1)
        color, _ = pictures(device)
        for call in (
            exchange.read_color,
            exchange.read_depth,
            functools.partial(exchange.upload, color),
            functools.partial(exchange.draw, color),
            exchange.close,
        ):
            with pytest.raises(RuntimeError, match=r"Exchange\.\w+: another OpenGL context is"):
                call()
        assert not functions.GetError()
        assert torch.equal(other.read_color(), pictures(device, 1)[0])
    use(ours)
    assert torch.equal(exchange.read_color(), pictures(device)[0])
    exchange.close()
    use(None)
    exchange.close()  # nothing left to do, so no context is needed


def test_a_context_that_shares_objects_is_as_good(device):
    ours = make_context()
    use(ours)
    exchange = gv.opengl.Exchange(WIDTH, HEIGHT, device)
    target(gl.Functions("test"))
    assert_passes(exchange)
    use(make_context(share=ours))
    functions = gl.Functions("test")
    frames = [target(functions) for _ in range(4)]
    assert_passes(exchange)
    for frame, color, _ in frames:  # framebuffers are not shared
        functions.BindFramebuffer(gl.READ_FRAMEBUFFER, frame)
        query = (gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.ATTACHED_NAME)
        assert functions.parameter("GetFramebufferAttachmentParameteriv", *query) == color
    exchange.close()


def test_threads_have_exchanges_of_their_own(device):
    def work(context, seed: int) -> None:
        try:
            use(context)
            target(gl.Functions("test"))
            with gv.opengl.Exchange(WIDTH, HEIGHT, device) as exchange:
                for step in range(20):
                    assert_passes(exchange, seed + step)
            done.append(seed)
        finally:
            use(None)

    done: list[int] = []
    threads = [threading.Thread(target=work, args=(make_context(), 100 * n)) for n in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(done) == [0, 100]


def set_odd(functions: gl.Functions) -> None:
    """Sets old OpenGL state by which all fragments fail and all pixels change."""
    functions._load_functions(
        gl._system_loader("test"), {"AlphaFunc": "-uf", "PolygonStipple": "-p"}
    )
    for switch in gl._LEGACY_SWITCHES:
        functions.Enable(switch)
    functions.AlphaFunc(0x0200, 0)  # never
    functions.PolygonStipple(bytes(128))
    for number, value in gl._PIXEL_TRANSFER.items():
        if number != 0x0D10:
            functions.PixelTransferf(number, 0.5 * value + 0.25)
    functions.PolygonMode(gl.FRONT, 0x1B01)  # lines
    functions.PolygonMode(gl.BACK, 0x1B00)  # points


def test_old_state_of_a_compatibility_profile_changes_nothing_and_stays(device):
    use(make_context(COMPATIBILITY))
    functions = gl.Functions("test")
    assert functions._legacy
    target(functions)

    def state() -> list[float]:
        value = ctypes.c_float()
        gl_state: list[float] = functions.integers(gl.POLYGON_MODE, 2)
        gl_state += [functions.IsEnabled(switch) for switch in gl._LEGACY_SWITCHES]
        gl_state += [functions.integer(gl.CLAMP_FRAGMENT_COLOR)]
        for number in gl._PIXEL_TRANSFER:
            functions.GetFloatv(number, ctypes.byref(value))
            gl_state.append(value.value)
        return gl_state

    with gv.opengl.Exchange(WIDTH, HEIGHT, device) as exchange:
        set_odd(functions)
        before = state()
        assert before[:4] == [0x1B01, 0x1B00, 1, 1] and 0.75 in before
        assert_passes(exchange)
        assert state() == before
