"""Pictures between OpenGL and torch: in a real context without a window (EGL), a GPU's or Mesa's.

moderngl, which tracks the context's state itself, draws and reads in the same context.
"""

from __future__ import annotations

import ctypes
import threading

import pytest
import torch
from helpers.opengl import opengl_context

import gvtorch as gv
from gvtorch.opengl import functions as gl
from gvtorch.ops import unavailable

pytestmark = pytest.mark.backend("opengl")
WIDTH, HEIGHT = 37, 23  # rows of odd lengths: 37 pixels of 3 or 1 bytes end between words
DEPTHS = {  # internal formats, with their attachments
    "16": (0x81A5, gl.DEPTH_ATTACHMENT, 2**-16),
    "24": (0x81A6, gl.DEPTH_ATTACHMENT, 2**-24),
    "24 and stencil": (0x88F0, 0x821A, 2**-24),
    "32F": (0x8CAC, gl.DEPTH_ATTACHMENT, 0),
    "32F and stencil": (0x8CAD, 0x821A, 0),
}


@pytest.fixture
def context():
    """A current context, with no framebuffer bound and no capability enabled."""
    opened = opengl_context()
    opened.__enter__()
    opened.screen and opened.screen.use()
    return opened


HOST = pytest.param("cpu", False, id="cpu")
CUDA = [
    pytest.param("cuda", True, id="cuda, shared", marks=pytest.mark.backend("cuda")),
    pytest.param("cuda", False, id="cuda, through the host", marks=pytest.mark.backend("cuda")),
]
everywhere = pytest.mark.parametrize(("device", "shared"), [HOST, *CUDA])


@pytest.fixture
def exchange(context, device, shared):
    if device == "cuda" and (reason := unavailable()["cuda"]):
        pytest.skip(f"backend cuda: {reason}")
    with gv.opengl.Exchange(WIDTH, HEIGHT, device, share=None if shared else False) as opened:
        if shared and not opened.shared and "OpenGL draws on" in opened.reason:
            pytest.skip(opened.reason)
        assert opened.shared == shared
        yield opened


def scene(context, kind="f1", depth=None):
    """Returns a framebuffer with random colours and depths, and both as tensors, top row first."""
    generator = torch.Generator().manual_seed(5)
    numbers = torch.rand(HEIGHT, WIDTH, 4, generator=generator)
    data = {
        "f1": (numbers * 255).round().to(torch.uint8),
        "f2": numbers.half() * 8 - 4,
        "f4": numbers * 8 - 4,
    }[kind]
    texture = context.texture((WIDTH, HEIGHT), 4, data.flip(0).numpy().tobytes(), dtype=kind)
    z = torch.rand(HEIGHT, WIDTH, 1, generator=generator)
    z[0, 0], z[-1, -1] = 0, 1
    stored = context.depth_texture((WIDTH, HEIGHT), z.flip(0).contiguous().numpy().tobytes())
    frame = context.framebuffer([texture], stored if depth is None else depth)
    frame.use()
    color = data / 255 if kind == "f1" else data.float()
    return frame, color, z


@everywhere
@pytest.mark.parametrize("kind", ["f1", "f2", "f4"])
def test_colours_come_as_they_are_stored(context, exchange, kind):
    frame, color, _ = scene(context, kind)
    got = exchange.read_color()
    assert got.device.type == exchange.device.type and got.dtype == torch.float32
    assert torch.equal(got.cpu(), color)
    frame.clear(0.2, 0.4, 0.6, 1.0)
    again = exchange.read_color()
    assert torch.equal(got.cpu(), color)  # what was returned is not shared
    expected = torch.tensor([0.2, 0.4, 0.6, 1.0])
    torch.testing.assert_close(again.cpu(), expected.expand_as(again), rtol=2e-3, atol=0)


def depth_frame(context, name):
    """Returns a framebuffer of only depth in an OpenGL format, and the functions that made it."""
    functions = gl.Functions("test")
    stored, attachment, _ = DEPTHS[name]
    layout = {0x88F0: (0x84F9, 0x84FA), 0x8CAD: (0x84F9, 0x8DAD)}
    texture, frame = functions.make("Textures"), functions.make("Framebuffers")
    functions.BindTexture(gl.TEXTURE_2D, texture)
    pixels = layout.get(stored, (gl.DEPTH_COMPONENT, gl.FLOAT))
    functions.TexImage2D(gl.TEXTURE_2D, 0, stored, WIDTH, HEIGHT, 0, *pixels, None)
    for parameter in (0x2800, 0x2801):
        functions.TexParameteri(gl.TEXTURE_2D, parameter, 0x2600)
    for target in (gl.READ_FRAMEBUFFER, gl.DRAW_FRAMEBUFFER):
        functions.BindFramebuffer(target, frame)
    functions.FramebufferTexture2D(gl.DRAW_FRAMEBUFFER, attachment, gl.TEXTURE_2D, texture, 0)
    return functions


@everywhere
@pytest.mark.parametrize("name", DEPTHS)
def test_depths_go_there_and_come_back_in_every_format(context, exchange, name):
    _, color, z = scene(context)
    depth_frame(context, name)
    exchange.draw(color.to(exchange.device), z.to(exchange.device))
    got = exchange.read_depth().cpu()
    tolerance = 1.01 * DEPTHS[name][2]  # drivers may round either way
    error = float((got - z).abs().max())
    print(f"depth of {name} bits: off by {error:.1e}")
    assert got.shape == z.shape and error <= tolerance
    assert got[0, 0] == 0 and got[-1, -1] == 1


FORMATS = {  # internal formats, with the bits of red, green, blue and alpha
    "R8": (0x8229, 8, None, None, None),
    "RGB8": (0x8051, 8, 8, 8, None),
    "SRGB8_ALPHA8": (0x8C43, 8, 8, 8, 8),
    "RGB10_A2": (0x8059, 10, 10, 10, 2),
    "RGBA16": (0x805B, 16, 16, 16, 16),
    "R11F_G11F_B10F": (0x8C3A, 6, 6, 5, None),
}


@everywhere
@pytest.mark.parametrize("name", FORMATS)
def test_colours_keep_the_bits_of_their_format(context, exchange, name):
    """Missing components are 0, alpha 1."""
    functions = gl.Functions("test")
    stored, *bits = FORMATS[name]
    texture, frame = functions.make("Textures"), functions.make("Framebuffers")
    functions.BindTexture(gl.TEXTURE_2D, texture)
    functions.TexImage2D(
        gl.TEXTURE_2D, 0, stored, WIDTH, HEIGHT, 0, gl.RGBA, gl.UNSIGNED_BYTE, None
    )
    for target in (gl.READ_FRAMEBUFFER, gl.DRAW_FRAMEBUFFER):
        functions.BindFramebuffer(target, frame)
    functions.FramebufferTexture2D(
        gl.DRAW_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0
    )
    color = torch.rand(HEIGHT, WIDTH, 4)
    functions.Enable(0x8DB9)  # were sRGB encoded, it would be off by far more
    exchange.draw(color)
    got = exchange.read_color().cpu()
    functions.Disable(0x8DB9)
    for channel, kept in enumerate(bits):
        expected = color[..., channel] if kept else torch.full((HEIGHT, WIDTH), channel // 3.0)
        step = 1.01 / (2**kept - 1) if kept else 0  # drivers may round or truncate
        torch.testing.assert_close(got[..., channel], expected, rtol=0, atol=step)


@everywhere
def test_only_the_first_of_several_draw_buffers_changes(context, exchange):
    textures = [context.texture((WIDTH, HEIGHT), 4) for _ in range(3)]
    several = context.framebuffer(textures)
    several.use()
    several.clear(0.2, 0.4, 0.6, 0.8)
    exchange.draw(torch.ones(HEIGHT, WIDTH, 4))
    pixels = [list(texture.read()[-4:]) for texture in textures]
    assert pixels == [[255] * 4, [51, 102, 153, 204], [51, 102, 153, 204]]
    assert bool((exchange.read_color() == 1).all())


@everywhere
def test_depth_is_what_opengl_reads_itself(context, exchange):
    frame, _, _ = scene(context)
    raw = bytearray(frame.read(components=1, attachment=-1, dtype="f4"))
    expected = torch.frombuffer(raw, dtype=torch.float32).view(HEIGHT, WIDTH, 1).flip(0)
    torch.testing.assert_close(exchange.read_depth().cpu(), expected, rtol=0, atol=2**-24)


@everywhere
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.float32])
@pytest.mark.parametrize("channels", [3, 4])
def test_what_is_drawn_is_what_is_read(context, exchange, dtype, channels):
    kind = {torch.uint8: "f1", torch.float16: "f2", torch.float32: "f4"}[dtype]
    frame, _, before = scene(context, kind)
    stored = exchange.read_depth()
    numbers = torch.rand(HEIGHT, WIDTH, channels) * (255 if dtype == torch.uint8 else 9)
    image = numbers.to(exchange.device, dtype)
    exchange.draw(image)
    read = torch.frombuffer(bytearray(frame.read(components=channels, dtype=kind)), dtype=dtype)
    assert torch.equal(read.view(HEIGHT, WIDTH, channels).flip(0), image.cpu())
    got = exchange.read_color()
    scale = 255 if dtype == torch.uint8 else 1
    assert torch.equal(got[..., :channels].cpu(), image.cpu().float() / scale)
    assert channels == 4 or bool((got[..., 3] == 1).all())
    assert torch.equal(exchange.read_depth(), stored)  # no depth was given
    torch.testing.assert_close(stored.cpu(), before, rtol=0, atol=2**-23)


@everywhere
def test_what_is_drawn_later_is_tested_against_it(context, exchange):
    """A triangle at depth 1/2 over all pixels, on a depth that rises from left to right."""
    scene(context)
    z = torch.linspace(0, 1, WIDTH).expand(HEIGHT, WIDTH)[..., None].to(exchange.device)
    exchange.draw(torch.zeros(HEIGHT, WIDTH, 3, device=exchange.device), z)
    program = context.program(
        vertex_shader="#version 330\nvoid main() { gl_Position = vec4(4 * (gl_VertexID & 1) - 1, "
        "2 * (gl_VertexID & 2) - 1, 0, 1); }",
        fragment_shader="#version 330\nout vec4 c; void main() { c = vec4(1); }",
    )
    context.enable_only(context.DEPTH_TEST)
    context.depth_func = "<"
    context.vertex_array(program, []).render(vertices=3)
    assert torch.equal(exchange.read_color()[..., 0] == 1, z[..., 0] > 0.5)
    context.enable_only(context.NOTHING)


@everywhere
def test_textures_are_there_for_shaders_of_ones_own(context, exchange):
    image = torch.rand(HEIGHT, WIDTH, 4, device=exchange.device)
    z = torch.rand(HEIGHT, WIDTH, 1, device=exchange.device)
    names = exchange.upload(image, z.double())
    for name, expected, kind in zip(names, (image, z), ("f4", "f4"), strict=True):
        texture = context.external_texture(name, (WIDTH, HEIGHT), expected.shape[2], 0, kind)
        numbers = torch.frombuffer(bytearray(texture.read()), dtype=torch.float32)
        assert torch.equal(numbers.view(expected.shape).flip(0), expected.cpu())
    assert exchange.upload(image.half())[1] == 0


def state(functions: gl.Functions) -> dict[int, list[int]]:
    """Returns all of a context's state that an exchange touches."""
    several = {gl.VIEWPORT: 4}
    queries = [
        *gl._PIXEL_STORE,
        *gl._BUFFER_BINDINGS.values(),
        *gl.FRAMEBUFFER_BINDINGS.values(),
        *several,
        gl.PROGRAM,
    ]
    queries += [gl.VERTEX_ARRAY, gl.DEPTH_MASK, gl.DEPTH_FUNC, gl.POLYGON_MODE, gl.ACTIVE_TEXTURE]
    queries += [gl.RENDERBUFFER_BINDING, gl.CLAMP_READ_COLOR]
    saved = {query: functions.integers(query, several.get(query, 1)) for query in queries}
    for switch in (*gl._SWITCHES, gl.DEPTH_TEST):
        saved[switch] = [functions.IsEnabled(switch)]
    for index in range(2):
        mask = (ctypes.c_ubyte * 4)()
        functions.GetBooleani_v(gl.COLOR_MASK, index, mask)
        saved[-1 - index] = [*mask, *(functions.IsEnabledi(s, index) for s in gl._INDEXED_SWITCHES)]
    unit = functions.integer(gl.ACTIVE_TEXTURE)
    for each in (gl.TEXTURE0, gl.TEXTURE0 + 1):
        functions.ActiveTexture(each)
        saved[each] = [functions.integer(q) for q in (gl.TEXTURE_BINDING, gl.SAMPLER_BINDING)]
    functions.ActiveTexture(unit)
    return saved


def make_plain(functions: gl.Functions, odd, on) -> None:
    """Sets a context's state to its initial values."""
    for number in odd:
        functions.PixelStorei(number, 0 if number not in (0x0CF5, 0x0D05) else 4)
    for switch in on:
        functions.Disable(switch)
    for target in (gl.PIXEL_PACK_BUFFER, gl.PIXEL_UNPACK_BUFFER):
        functions.BindBuffer(target, 0)
    for index in range(2):
        functions.ColorMaski(index, 1, 1, 1, 1)
    functions.ClampColor(gl.CLAMP_READ_COLOR, gl.FIXED_ONLY)
    functions.DepthMask(1)
    functions.DepthFunc(0x0201)
    functions.PolygonMode(gl.FRONT_AND_BACK, gl.FILL)
    for unit in range(2):
        functions.BindSampler(unit, 0)
    functions.ActiveTexture(gl.TEXTURE0)


@everywhere
def test_the_contexts_state_stays(context, exchange):
    """All state is set to unusual values first; what is drawn and read does not change."""
    frame, color, z = scene(context)
    functions = gl.Functions("test")
    buffer = context.buffer(reserve=64)
    textures = [context.texture((2, 2), 4) for _ in range(2)]
    for unit, each in enumerate(textures):
        each.use(unit)
        context.sampler().use(unit)
    for target in (gl.PIXEL_PACK_BUFFER, gl.PIXEL_UNPACK_BUFFER):
        functions.BindBuffer(target, buffer.glo)
    odd = {0x0CF2: 5, 0x0CF3: 1, 0x0CF4: 2, 0x0CF5: 8, 0x0D02: 7, 0x0D03: 2, 0x0D04: 1, 0x0D05: 2}
    for number, value in odd.items():
        functions.PixelStorei(number, value)
    on = [0x0BE2, 0x0B44, 0x0C11, 0x0B90, 0x8C89, 0x864F, 0x80A0, gl.DEPTH_TEST]
    for switch in on:
        functions.Enable(switch)
    functions.Disablei(0x0BE2, 1)  # blending
    functions.Viewport(1, 2, 3, 4)
    functions.ColorMaski(0, 1, 0, 1, 0)
    functions.ColorMaski(1, 0, 1, 1, 0)
    functions.ClampColor(gl.CLAMP_READ_COLOR, 1)
    functions.DepthMask(0)
    functions.DepthFunc(0x0200)  # never
    functions.PolygonMode(gl.FRONT_AND_BACK, 0x1B01)  # lines
    functions.ActiveTexture(gl.TEXTURE0 + 1)
    functions.GetError()
    before = state(functions)
    try:
        assert torch.equal(exchange.read_color().cpu(), color)
        torch.testing.assert_close(exchange.read_depth().cpu(), z, rtol=0, atol=2**-23)
        exchange.upload(color, z)
        exchange.draw(1 - color, z.flip(0))
        assert state(functions) == before and not functions.GetError()
        torch.testing.assert_close(exchange.read_color().cpu(), 1 - color, rtol=0, atol=1e-3)
        again = exchange.read_depth().cpu()
        torch.testing.assert_close(again, z.flip(0), rtol=0, atol=2**-23)
        context.screen and context.screen.use()
        with pytest.raises(RuntimeError):
            functions.BindFramebuffer(gl.READ_FRAMEBUFFER, functions.make("Framebuffers"))
            exchange.read_depth()
        functions.BindFramebuffer(gl.READ_FRAMEBUFFER, before[gl.READ_FRAMEBUFFER_BINDING][0])
        functions.BindFramebuffer(gl.DRAW_FRAMEBUFFER, before[gl.DRAW_FRAMEBUFFER_BINDING][0])
        assert state(functions) == before
    finally:
        make_plain(functions, odd, on)
    frame.release()


@everywhere
def test_a_layer_drawn_by_opengl_is_the_layer_of_its_distances(context, exchange):
    """From OpenGL's buffers to a picture with voxels, and back into them."""
    frame, _, _ = scene(context)
    camera = gv.Camera.orbit(30, 20, 2.0, 45, WIDTH, HEIGHT)
    volume = gv.Volume(torch.rand(16, 16, 16))
    tree = gv.N3Tree.from_volume(volume, device=exchange.device)
    placed = camera.placed(tree.box)
    projection, _ = gv.opengl.matrices(placed, near=0.1, far=60)
    color, z = exchange.read_color(), exchange.read_depth()
    depth = gv.opengl.ray_distance(z, projection)
    layer = gv.Layer(color[..., :3], depth)
    shader = gv.TransferFunction([(0, 0), (1, 0.9)], [(0, 1, 1, 1), (1, 1, 0, 0)])
    picture = gv.render(tree, placed, shader, layer=layer)
    plain_layer = gv.Layer(color[..., :3].cpu(), depth.cpu())
    expected = gv.render(tree, placed, shader, layer=plain_layer)
    assert torch.equal(picture.color, expected.color)
    exchange.draw(picture.color, gv.opengl.window_depth(picture.nearest, projection))
    assert (
        float((exchange.read_color()[..., :3] - picture.color).abs().max()) <= 0.6 / 255
    )  # blending hardware is imprecise
    back = gv.opengl.ray_distance(exchange.read_depth(), projection)
    near = (picture.nearest < 20).cpu()
    torch.testing.assert_close(
        back.cpu()[near], picture.nearest.double().cpu()[near], rtol=1e-4, atol=0
    )
    frame.release()


@everywhere
def test_what_opengl_cant_read_is_one_clear_line(context, exchange):
    frame, color, _ = scene(context)
    small = context.framebuffer([context.texture((8, 4), 4)], context.depth_texture((8, 4)))
    several = context.framebuffer(
        [context.renderbuffer((WIDTH, HEIGHT), 4, samples=4)],
        context.depth_renderbuffer((WIDTH, HEIGHT), samples=4),
    )
    plain = context.framebuffer([context.renderbuffer((WIDTH, HEIGHT), 4)])
    low = context.framebuffer([context.renderbuffer((8, 4), 4)])
    integers = context.framebuffer([context.texture((WIDTH, HEIGHT), 4, dtype="u1")])
    for used, call, message in (
        (small, exchange.read_color, "read_color: .* has 8x4 pixels, the exchange 37x23"),
        (small, exchange.read_depth, "read_depth: .* has 8x4 pixels, the exchange 37x23"),
        (low, exchange.read_color, "read_color: .* has 8x4 pixels, the exchange 37x23"),
        (several, exchange.read_color, "INVALID_OPERATION .*several samples a pixel"),
        (several, exchange.read_depth, "INVALID_OPERATION .*several samples a pixel"),
        (plain, exchange.read_depth, "read_depth: .* bound for reading has no depth"),
        (integers, exchange.read_color, "INVALID_OPERATION .*no integers"),
    ):
        used.use()
        with pytest.raises(RuntimeError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)
    plain.use()
    plain.clear(0.2, 0.4, 1, 1)
    assert exchange.read_color()[3, 4].mul(255).round().tolist() == [51, 102, 255, 255]
    with pytest.raises(RuntimeError, match=r"Exchange\.draw: .* for drawing has no depth"):
        plain.use()
        exchange.draw(color, torch.zeros(HEIGHT, WIDTH, 1))
    frame.use()  # and what went wrong left nothing behind
    assert torch.equal(exchange.read_color().cpu(), color)


@everywhere
@pytest.mark.parametrize("kind", ["array", "3D", "cube"])
def test_a_layer_is_read_if_it_has_the_size(context, exchange, kind):
    functions = gl.Functions("test")
    functions._load_functions(gl._system_loader("test"), {"FramebufferTextureLayer": "-uuuii"})
    frame = functions.make("Framebuffers")
    for target in (gl.READ_FRAMEBUFFER, gl.DRAW_FRAMEBUFFER):
        functions.BindFramebuffer(target, frame)
    make = {"array": context.texture_array, "3D": context.texture3d}.get(kind)
    side = 32
    texture = make((side, side, 3), 4) if make else context.texture_cube((side, side), 4)
    attachment = (gl.DRAW_FRAMEBUFFER, gl.COLOR_ATTACHMENT0)
    if make:
        functions.FramebufferTextureLayer(*attachment, texture.glo, 0, 1)
    else:
        functions.FramebufferTexture2D(*attachment, 0x8517, texture.glo, 0)
    with pytest.raises(RuntimeError, match="has 32x32 pixels, the exchange 37x23"):
        exchange.read_color()
    color = torch.rand(side, side, 4, device=exchange.device).round()
    share = exchange.shared or None
    with gv.opengl.Exchange(side, side, exchange.device, share=share) as fitting:
        fitting.draw(color)
        assert torch.equal(fitting.read_color(), color)


@everywhere
def test_samples_are_all_covered_and_floats_not_clamped(context, exchange):
    functions = gl.Functions("test")
    functions._load_functions(gl._system_loader("test"), {"SampleCoverage": "-fi"})
    plain = context.framebuffer([context.texture((WIDTH, HEIGHT), 4, dtype="f4")])
    samples = context.framebuffer([context.renderbuffer((WIDTH, HEIGHT), 4, 4, dtype="f4")])
    color = torch.rand(HEIGHT, WIDTH, 4) * 8 - 4
    samples.use()
    functions.Enable(0x80A0)
    functions.SampleCoverage(0, 0)  # none
    exchange.draw(color)
    functions.Disable(0x80A0)
    functions.SampleCoverage(1, 0)
    context.copy_framebuffer(plain, samples)
    plain.use()
    functions.ClampColor(gl.CLAMP_READ_COLOR, 1)
    got = exchange.read_color().cpu()
    functions.ClampColor(gl.CLAMP_READ_COLOR, gl.FIXED_ONLY)
    assert torch.equal(got, color)


@everywhere
def test_pictures_that_dont_fit_are_told(context, exchange):
    color, z = torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH, 1)
    for pictures, message in (
        ((color[:-1],), r"draw: color must be \(23, 37, 3 or 4\) uint8, .* got \(22, 37, 3\)"),
        ((color.double(),), "color must be .* got .* float64"),
        ((color[..., :1],), "color must be"),
        ((None,), "color must be .* got NoneType"),
        ((color, z[..., 0]), r"depth must be \(23, 37, 1\) floats, got \(23, 37\)"),
        ((color, z.int()), "depth must be .* got .* int32"),
    ):
        with pytest.raises(ValueError, match=message):
            exchange.draw(*pictures)


def test_sharing_that_can_not_be_says_why(context):
    with pytest.raises(RuntimeError, match="can't be shared: cpu is not a CUDA device"):
        gv.opengl.Exchange(4, 4, "cpu", share=True)
    with gv.opengl.Exchange(4, 4, "cpu") as exchange:
        assert not exchange.shared and "not a CUDA device" in exchange.reason
        assert repr(exchange) == "Exchange(4x4, through the host: cpu is not a CUDA device)"
    with pytest.raises(RuntimeError, match="read_color: the exchange is closed"):
        exchange.read_color()
    exchange.close()  # a second time: nothing left to do
    for (width, device, options), message in {
        (0, "cpu", ()): r"width must be an int >= 1 and <= \d+, got 0",
        (2**40, "cpu", ()): "width must be an int",
        (4, "gpu", ()): "device must name a device, got 'gpu'",
        (4, "cuda:99", ()): "device .* can't be used here",
        (4, "cpu", (("share", "yes"),)): "share must be bool or None, got 'yes'",
        (4, "cpu", (("load", 3),)): "load must be a function of a name, got 3",
        (4, "cpu", (("load", str),)): "load must give addresses as int, got 'glActiveTexture'",
    }.items():
        with pytest.raises(ValueError, match=f"^opengl.Exchange: {message}") as caught:
            gv.opengl.Exchange(width, 4, device, **dict(options))
        assert "\n" not in str(caught.value)


def test_without_a_context_it_says_so(context):
    def elsewhere():
        try:
            gv.opengl.Exchange(4, 4, "cpu")
        except RuntimeError as error:
            messages.append(str(error))

    messages: list[str] = []
    thread = threading.Thread(target=elsewhere)  # a context is current on one thread
    thread.start()
    thread.join()
    assert len(messages) == 1 and "no OpenGL context is current on this thread" in messages[0]


def test_ones_own_loader_is_asked(context):
    names: list[str] = []
    with pytest.raises(RuntimeError, match="this OpenGL lacks glActiveTexture"):
        gv.opengl.Exchange(4, 4, "cpu", load=names.append)
    assert names == ["glActiveTexture"]
