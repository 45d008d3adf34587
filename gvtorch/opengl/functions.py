"""OpenGL's functions and constants that `Exchange` needs, for the current context. The existing
Python bindings do not fit: they must know the window system, or make the context themselves.

Source: OpenGL 3.2 core specification, and the OpenGL registry for the constants.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from ctypes import c_char_p, c_float, c_int, c_ssize_t, c_ubyte, c_uint, c_void_p
from functools import partial
from typing import Any

COLOR_ATTACHMENT0, DEPTH_ATTACHMENT, DEPTH, DEPTH_COMPONENT = 0x8CE0, 0x8D00, 0x1801, 0x1902
DEPTH_COMPONENT16, DEPTH_COMPONENT24, DEPTH_COMPONENT32F = 0x81A5, 0x81A6, 0x8CAC
RED, RGBA, RGBA8, RGBA16F, RGBA32F, R32F = 0x1903, 0x1908, 0x8058, 0x881A, 0x8814, 0x822E
UNSIGNED_BYTE, FLOAT, HALF_FLOAT = 0x1401, 0x1406, 0x140B
DRAW_FRAMEBUFFER, READ_FRAMEBUFFER = 0x8CA9, 0x8CA8
DRAW_FRAMEBUFFER_BINDING, READ_FRAMEBUFFER_BINDING = 0x8CA6, 0x8CAA
PIXEL_PACK_BUFFER, PIXEL_UNPACK_BUFFER = 0x88EB, 0x88EC
READ_BUFFER, COLOR_READ_TYPE = 0x0C02, 0x8B9A
ATTACHED_KIND, ATTACHED_NAME, ATTACHED_LEVEL = 0x8CD0, 0x8CD1, 0x8CD2
ATTACHED_DEPTH_SIZE = 0x8216
TEXTURE0, TEXTURE_2D, RENDERBUFFER, RENDERBUFFER_BINDING = 0x84C0, 0x0DE1, 0x8D41, 0x8CA7
MAX_TEXTURE_SIZE, MAX_DRAW_BUFFERS = 0x0D33, 0x8824
DYNAMIC_COPY, FRONT, BACK, FRONT_AND_BACK, FILL = 0x88EA, 0x0404, 0x0405, 0x0408, 0x1B02
ACTIVE_TEXTURE, TEXTURE_BINDING, SAMPLER_BINDING = 0x84E0, 0x8069, 0x8919
PROGRAM, VERTEX_ARRAY, VIEWPORT, POLYGON_MODE = 0x8B8D, 0x85B5, 0x0BA2, 0x0B40
COLOR_MASK, DEPTH_MASK, DEPTH_FUNC = 0x0C23, 0x0B72, 0x0B74
CLAMP_READ_COLOR, CLAMP_FRAGMENT_COLOR, FIXED_ONLY = 0x891C, 0x891B, 0x891D
RENDERBUFFER_WIDTH, RENDERBUFFER_HEIGHT = 0x8D42, 0x8D43
TEXTURE_WIDTH, TEXTURE_HEIGHT = 0x1000, 0x1001
DEPTH_TEST, ALWAYS, TRIANGLES = 0x0B71, 0x0207, 4
FRAGMENT_SHADER, VERTEX_SHADER, LINK_STATUS = 0x8B30, 0x8B31, 0x8B82
VERSION, RENDERER, MAJOR_VERSION, MINOR_VERSION = 0x1F02, 0x1F01, 0x821B, 0x821C
PROFILE, CORE_PROFILE = 0x9126, 1

#: Capabilities that are disabled while `Exchange` draws: face culling, dithering, scissor and
#: stencil test, rasterizer discard, sample mask and coverage, polygon smoothing, logic operation,
#: depth clamping, sRGB encoding, clip distances.
_SWITCHES = (0x0B44, 0x0BD0, 0x0C11, 0x0B90, 0x8C89, 0x8E51, 0x809E, 0x809F, 0x80A0, 0x0B41)
_SWITCHES += (0x0BF2, 0x864F, 0x8DB9, *range(0x3000, 0x3008))
#: Indexed capabilities, disabled at index 0 only: blending and (from 4.1 on) the scissor test.
_INDEXED_SWITCHES = (0x0BE2, 0x0C11)
#: Of compatibility profiles: alpha test and polygon stipple; neutral values of the pixel transfer:
#: whether colours are looked up in a table, scale and bias of red, green, blue, alpha and depth.
_LEGACY_SWITCHES = (0x0BC0, 0x0B42)
_PIXEL_TRANSFER = {0x0D10: 0.0, 0x0D14: 1.0, 0x0D15: 0.0}
_PIXEL_TRANSFER |= {number: float(number % 2 == 0) for number in range(0x0D18, 0x0D20)}
#: Pixel storage modes: swapped bytes, order of bits, row length, skipped rows and pixels,
#: alignment; first for uploads (unpack), then for reads (pack).
_PIXEL_STORE = {number: 0 for number in (*range(0x0CF0, 0x0CF5), *range(0x0D00, 0x0D05))}
_PIXEL_STORE |= {0x0CF5: 1, 0x0D05: 1}
_BUFFER_BINDINGS = {PIXEL_PACK_BUFFER: 0x88ED, PIXEL_UNPACK_BUFFER: 0x88EF}
#: Framebuffer targets, with the constant that queries the binding.
FRAMEBUFFER_BINDINGS = {
    READ_FRAMEBUFFER: READ_FRAMEBUFFER_BINDING,
    DRAW_FRAMEBUFFER: DRAW_FRAMEBUFFER_BINDING,
}
_ERRORS = {0x0500: "INVALID_ENUM", 0x0501: "INVALID_VALUE", 0x0502: "INVALID_OPERATION"}
_ERRORS |= {0x0505: "OUT_OF_MEMORY", 0x0506: "INVALID_FRAMEBUFFER_OPERATION"}
_CONTEXT_LOST = 0x0507
_ERRORS |= {_CONTEXT_LOST: "CONTEXT_LOST"}
#: A number of the state: the function that sets it, that function's first arguments, the constant
#: that queries it, and its value while `Exchange` works (None: each step sets what it needs).
_StateNumber = tuple[str, tuple[int, ...], int, "int | None"]
_STATE: list[_StateNumber] = [
    *(("PixelStorei", (number,), number, value) for number, value in _PIXEL_STORE.items()),
    ("ClampColor", (CLAMP_READ_COLOR,), CLAMP_READ_COLOR, FIXED_ONLY),
    *(("BindBuffer", (target,), query, 0) for target, query in _BUFFER_BINDINGS.items()),
    *(("BindFramebuffer", (kind,), query, None) for kind, query in FRAMEBUFFER_BINDINGS.items()),
    ("ActiveTexture", (), ACTIVE_TEXTURE, None),
]
_DRAWING_STATE: list[_StateNumber] = [
    ("UseProgram", (), PROGRAM, None),
    ("BindVertexArray", (), VERTEX_ARRAY, None),
    ("DepthMask", (), DEPTH_MASK, 1),
    ("DepthFunc", (), DEPTH_FUNC, ALWAYS),
]
_LEGACY_STATE: list[_StateNumber] = [
    ("ClampColor", (CLAMP_FRAGMENT_COLOR,), CLAMP_FRAGMENT_COLOR, FIXED_ONLY)
]
#: Targets of textures with a width and a height, the constant that queries their binding, and the
#: target that queries their size: 2D, rectangle, array, cube, 3D, array of cubes.
_TEXTURE_TARGETS = [(TEXTURE_2D, 0x8069, TEXTURE_2D), (0x84F5, 0x84F6, 0x84F5)]
_TEXTURE_TARGETS += [(0x8C1A, 0x8C1D, 0x8C1A), (0x8513, 0x8514, 0x8515)]
_TEXTURE_TARGETS += [(0x806F, 0x806A, 0x806F), (0x9009, 0x900A, 0x9009)]

_CTYPES: dict[str, Any] = {"i": c_int, "u": c_uint, "f": c_float, "n": c_ssize_t}
_CTYPES |= {"p": c_void_p, "s": c_char_p, "-": None}
#: Functions by their prototype in letters of `_CTYPES`: the return type, then the arguments.
_PROTOTYPES = """
-u ActiveTexture BindVertexArray CompileShader DeleteProgram DeleteShader DepthFunc Disable Enable
-u LinkProgram UseProgram
-uu AttachShader BindBuffer BindFramebuffer BindRenderbuffer BindTexture ClampColor Disablei
-uu Enablei PolygonMode
-unpu BufferData
-uiiii ColorMaski
-uiiiiiii CopyTexSubImage2D
u CreateProgram GetError
uu CreateShader
-ip DeleteBuffers DeleteFramebuffers DeleteTextures DeleteVertexArrays
-ip GenBuffers GenFramebuffers GenTextures GenVertexArrays
-i DepthMask
-uii DrawArrays
-uuuui FramebufferTexture2D
-uup GetBooleani_v GetProgramiv GetRenderbufferParameteriv
iup GetFragDataLocation
-uuup GetFramebufferAttachmentParameteriv
-up GetIntegerv
su GetString
-uiup GetTexLevelParameteriv
ius GetUniformLocation
iu IsEnabled
iuu IsEnabledi
-ui PixelStorei
-iiiiuup ReadPixels
-uipp ShaderSource
-uiiiiiuup TexImage2D TexSubImage2D
-uui TexParameteri
-ii Uniform1i
-iiii Viewport
"""
_PROTOTYPE_LINES = [line.split() for line in _PROTOTYPES.strip().splitlines()]
_FUNCTIONS = {name: type_codes for type_codes, *names in _PROTOTYPE_LINES for name in names}
_SINCE_3_3 = {"BindSampler": "-uu"}
_SINCE_4_1 = {"GetFloati_v": "-uup", "ViewportIndexedf": "-uffff"}
_LEGACY = {"GetFloatv": "-up", "PixelTransferf": "-uf"}

_NO_CONTEXT = "no OpenGL context is current on this thread, none at least that the library knows"

#: Returns the address of a function by its name.
Loader = Callable[[str], "int | None"]


class Functions:
    """The OpenGL 3.2 functions of the current context, by their names without `gl`.

    Attributes:
        context: Name of the caller, for messages.
    """

    def __init__(self, context: str, load: Loader | None = None) -> None:
        """Loads the functions by `load` or from the system's library; raises as `Exchange`."""
        self.context = context
        load = _system_loader(context) if load is None else load
        if not callable(load):
            raise ValueError(f"{context}: load must be a function of a name, got {load!r}")
        self._load_functions(load, _FUNCTIONS)
        self.require_context()
        version = self.integer(MAJOR_VERSION), self.integer(MINOR_VERSION)
        version_text = self.GetString(VERSION).decode(errors="replace")
        if version < (3, 2) or version_text.startswith("OpenGL ES"):
            raise RuntimeError(f"{context}: OpenGL 3.2 is needed, got {version_text}")
        self._samplers = version >= (3, 3)  # there are sampler objects
        self._viewports = version >= (4, 1)  # and several viewports
        self._legacy = not self.integer(PROFILE) & CORE_PROFILE
        self._load_functions(load, _SINCE_3_3 if self._samplers else {})
        self._load_functions(load, _SINCE_4_1 if self._viewports else {})
        self._load_functions(load, _LEGACY if self._legacy else {})

    def _load_functions(self, load: Loader, functions: dict[str, str]) -> None:
        for name, type_codes in functions.items():
            address = load(f"gl{name}")
            if not address:
                raise RuntimeError(f"{self.context}: this OpenGL lacks gl{name}; 3.2 is needed")
            if not isinstance(address, int):
                got = f"{address!r} for gl{name}"
                raise ValueError(f"{self.context}: load must give addresses as int, got {got}")
            prototype: Any = ctypes.CFUNCTYPE(*(_CTYPES[code] for code in type_codes))
            setattr(self, name, prototype(address))

    def __getattr__(self, name: str) -> Callable[..., Any]:
        raise AttributeError(name)  # for type checkers: `_load_functions` sets the functions

    def require_context(self) -> None:
        """Raises RuntimeError unless a context is current; clears earlier errors."""
        if not self.GetString(VERSION):
            raise RuntimeError(f"{self.context}: {_NO_CONTEXT}")
        self.forget_errors()

    def check(self, hint: str) -> None:
        """Raises RuntimeError if OpenGL reports an error."""
        if error := self.GetError():
            name = _ERRORS.get(error, hex(error))
            raise RuntimeError(f"{self.context}: OpenGL says {name} ({hint})")

    def forget_errors(self) -> None:
        """Clears OpenGL's errors."""
        while self.GetError() not in (0, _CONTEXT_LOST):  # which is reported for ever
            pass

    def read(self, get: str, kind: Any, count: int, *arguments: int) -> list[Any]:
        """Returns the numbers that a function such as glGetIntegerv writes; 0 if it writes none."""
        values = (kind * max(count, 4))()
        getattr(self, get)(*arguments, values)
        return list(values)[:count]

    def integer(self, constant: int) -> int:
        """Returns a number of the context's state."""
        return self.integers(constant, 1)[0]

    def integers(self, constant: int, count: int) -> list[int]:
        """Returns several numbers of the context's state."""
        return self.read("GetIntegerv", c_int, count, constant)

    def parameter(self, get: str, *arguments: int) -> int:
        """Returns the number that a function such as glGetProgramiv writes; 0 if there is none."""
        (value,) = self.read(get, c_int, 1, *arguments)
        self.forget_errors()
        return value

    def attached_size(self, kind: int, name: int, level: int) -> list[int] | None:
        """Returns width and height of a renderbuffer or mipmap level; None where there are none."""
        if kind == RENDERBUFFER:
            previous = self.integer(RENDERBUFFER_BINDING)
            self.BindRenderbuffer(RENDERBUFFER, name)
            get = "GetRenderbufferParameteriv"
            parameters = (RENDERBUFFER_WIDTH, RENDERBUFFER_HEIGHT)
            size = [self.parameter(get, RENDERBUFFER, parameter) for parameter in parameters]
            self.BindRenderbuffer(RENDERBUFFER, previous)
            return size
        get, parameters = "GetTexLevelParameteriv", (TEXTURE_WIDTH, TEXTURE_HEIGHT)
        for target, binding, query in _TEXTURE_TARGETS:
            previous = self.integer(binding)
            self.BindTexture(target, name)
            if not self.GetError():
                size = [self.parameter(get, query, level, parameter) for parameter in parameters]
                self.BindTexture(target, previous)
                return size
        self.forget_errors()
        return None

    def set_viewport(self, width: int, height: int) -> None:
        """Sets the first viewport: its size in pixels, from the lower left corner on."""
        if self._viewports:
            self.ViewportIndexedf(0, 0, 0, width, height)
        else:
            self.Viewport(0, 0, width, height)

    def make(self, kind: str) -> int:
        """Returns a new name; `kind` is Buffers, Textures, Framebuffers or VertexArrays."""
        name = c_uint()
        getattr(self, f"Gen{kind}")(1, ctypes.byref(name))
        return name.value

    def drop(self, kind: str, name: int) -> None:
        """Deletes an object that `make` created; ignores 0."""
        getattr(self, f"Delete{kind}")(1, ctypes.byref(c_uint(name)))

    @contextmanager
    def temporary(self, kind: str) -> Iterator[int]:
        """Yields a new name and deletes it afterwards: contexts don't share objects of its kind."""
        name = self.make(kind)
        try:
            yield name
        finally:
            self.drop(kind, name)

    def program(self, vertex: str, fragment: str) -> int:
        """Links two shaders; raises RuntimeError if they do not compile or link."""
        program = self.CreateProgram()
        for kind, text in ((VERTEX_SHADER, vertex), (FRAGMENT_SHADER, fragment)):
            shader = self.CreateShader(kind)
            source = c_char_p(text.encode())
            self.ShaderSource(shader, 1, ctypes.byref(source), None)
            self.CompileShader(shader)
            self.AttachShader(program, shader)
            self.DeleteShader(shader)  # takes effect when the program goes
        self.LinkProgram(program)
        if not self.parameter("GetProgramiv", program, LINK_STATUS):
            self.DeleteProgram(program)
            raise RuntimeError(f"{self.context}: this OpenGL takes no GLSL 1.50")
        return program

    @contextmanager
    def unchanged(self, *, drawing: bool) -> Iterator[None]:
        """Restores afterwards the part of the context's state that `Exchange` changes.

        Until then pixels are tightly packed in host memory and transferred unconverted; with
        `drawing`, filled triangles overwrite the first draw buffer, without blending or tests.
        """
        with ExitStack() as restorers:
            restorers.callback(self.forget_errors)
            self._set_state(restorers, _STATE)
            for parameter, neutral in _PIXEL_TRANSFER.items() if self._legacy else ():
                old = self.read("GetFloatv", c_float, 1, parameter)
                restorers.callback(self.PixelTransferf, parameter, *old)
                self.PixelTransferf(parameter, neutral)
            for unit in (1, 0):
                self.ActiveTexture(TEXTURE0 + unit)
                if self._samplers:
                    restorers.callback(self.BindSampler, unit, self.integer(SAMPLER_BINDING))
                    self.BindSampler(unit, 0)
                restorers.callback(self.BindTexture, TEXTURE_2D, self.integer(TEXTURE_BINDING))
                restorers.callback(self.ActiveTexture, TEXTURE0 + unit)
            if drawing:
                self._draw_plainly(restorers)
            yield

    def _set_state(self, restorers: ExitStack, states: list[_StateNumber]) -> None:
        """Sets numbers of the state; `restorers` restores them."""
        for function, arguments, query, value in states:
            setter: Callable[..., None] = getattr(self, function)
            restorers.callback(setter, *arguments, self.integer(query))
            if value is not None:
                setter(*arguments, value)

    def _draw_plainly(self, restorers: ExitStack) -> None:
        """Sets the drawing state; indexed state only at index 0, except for the colour masks."""
        for switch in _INDEXED_SWITCHES:
            if self.IsEnabledi(switch, 0):
                restorers.callback(self.Enablei, switch, 0)
                self.Disablei(switch, 0)
        for switch in filter(self.IsEnabled, _SWITCHES + _LEGACY_SWITCHES * self._legacy):
            restorers.callback(self.Enable, switch)
            self.Disable(switch)
        switch_depth_test = self.Enable if self.IsEnabled(DEPTH_TEST) else self.Disable
        restorers.callback(switch_depth_test, DEPTH_TEST)
        self._set_state(restorers, _DRAWING_STATE + _LEGACY_STATE * self._legacy)
        if self._viewports:
            viewport = self.read("GetFloati_v", c_float, 4, VIEWPORT, 0)
            restorers.callback(self.ViewportIndexedf, 0, *viewport)
        else:
            restorers.callback(self.Viewport, *self.integers(VIEWPORT, 4))
        for buffer in range(self.integer(MAX_DRAW_BUFFERS)):
            mask = self.read("GetBooleani_v", c_ubyte, 4, COLOR_MASK, buffer)
            restorers.callback(self.ColorMaski, buffer, *mask)
            self.ColorMaski(buffer, *4 * [buffer == 0])
        faces = (FRONT, BACK) if self._legacy else (FRONT_AND_BACK,)
        for face, mode in zip(faces, self.integers(POLYGON_MODE, len(faces)), strict=True):
            restorers.callback(self.PolygonMode, face, mode)
        self.PolygonMode(FRONT_AND_BACK, FILL)


def _system_loader(context: str) -> Loader:
    """Returns the loader of the system's library that knows the current context. Libglvnd's (the
    first two) forward calls to any driver; OSMesa knows only its own contexts.
    """
    has_library = False
    for name in ("libOpenGL.so.0", "libGL.so.1", "libOSMesa.so.8"):
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        has_library = True
        library.glGetString.restype = c_char_p
        if library.glGetString(VERSION):
            return partial(_address, library)
    if has_library:
        raise RuntimeError(f"{context}: {_NO_CONTEXT}")
    hint = "pass load=..., such as glfw.get_proc_address"
    raise RuntimeError(f"{context}: found no OpenGL library; {hint}")


def _address(library: ctypes.CDLL, function: str) -> int | None:
    return ctypes.cast(getattr(library, function, 0), c_void_p).value
