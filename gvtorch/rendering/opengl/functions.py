"""OpenGL's functions and numbers, as far as `Exchange` needs them, in the context that is current.

They come out of the system's library, which hands calls on to whichever context is current, or out
of the loader of the library that made the context. Python's bindings of OpenGL are no help here:
they must be told the window system, or make the context themselves.

Source: OpenGL 3.2 core specification, and its registry for the numbers.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from ctypes import c_char_p, c_int, c_ssize_t, c_uint, c_void_p
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
DYNAMIC_COPY, FRONT_AND_BACK, FILL = 0x88EA, 0x0408, 0x1B02
ACTIVE_TEXTURE, TEXTURE_BINDING, SAMPLER_BINDING = 0x84E0, 0x8069, 0x8919
PROGRAM, VERTEX_ARRAY, VIEWPORT, POLYGON_MODE = 0x8B8D, 0x85B5, 0x0BA2, 0x0B40
COLOR_MASK, DEPTH_MASK, DEPTH_FUNC = 0x0C23, 0x0B72, 0x0B74
RENDERBUFFER_WIDTH, RENDERBUFFER_HEIGHT = 0x8D42, 0x8D43
TEXTURE_WIDTH, TEXTURE_HEIGHT = 0x1000, 0x1001
DEPTH_TEST, ALWAYS, TRIANGLES = 0x0B71, 0x0207, 4
FRAGMENT_SHADER, VERTEX_SHADER, COMPILE_STATUS, LINK_STATUS = 0x8B30, 0x8B31, 0x8B81, 0x8B82
VERSION, RENDERER, MAJOR_VERSION, MINOR_VERSION = 0x1F02, 0x1F01, 0x821B, 0x821C

#: Switches that are off while `Exchange` works: blending, culling, dither, scissors, the stencil
#: test, what discards or masks samples, logic, clamped depth, the encoding of sRGB, clip distances.
_SWITCHES = (0x0BE2, 0x0B44, 0x0BD0, 0x0C11, 0x0B90, 0x8C89, 0x8E51, 0x809E, 0x0BF2, 0x864F)
_SWITCHES += (0x8DB9, *range(0x3000, 0x3008))
#: How pixels lie in memory: swapped bytes, order of bits, row length, skipped rows and pixels,
#: alignment; first for what is written (unpack), then for what is read (pack).
_STORE = {number: 0 for number in (*range(0x0CF0, 0x0CF5), *range(0x0D00, 0x0D05))}
_STORE |= {0x0CF5: 1, 0x0D05: 1}
_BUFFERS = {PIXEL_PACK_BUFFER: 0x88ED, PIXEL_UNPACK_BUFFER: 0x88EF}
_FRAMES = {READ_FRAMEBUFFER: READ_FRAMEBUFFER_BINDING, DRAW_FRAMEBUFFER: DRAW_FRAMEBUFFER_BINDING}
_ERRORS = {0x0500: "INVALID_ENUM", 0x0501: "INVALID_VALUE", 0x0502: "INVALID_OPERATION"}
_ERRORS |= {0x0505: "OUT_OF_MEMORY", 0x0506: "INVALID_FRAMEBUFFER_OPERATION"}

_TYPES: dict[str, Any] = {
    "i": c_int,
    "u": c_uint,
    "n": c_ssize_t,
    "p": c_void_p,
    "s": c_char_p,
    "-": None,
}
#: What each function returns, and what it takes.
_FUNCTIONS = {
    "ActiveTexture": "-u",
    "AttachShader": "-uu",
    "BindBuffer": "-uu",
    "BindFramebuffer": "-uu",
    "BindRenderbuffer": "-uu",
    "BindTexture": "-uu",
    "BindVertexArray": "-u",
    "BufferData": "-unpu",
    "ColorMask": "-iiii",
    "CompileShader": "-u",
    "CopyTexSubImage2D": "-uiiiiiii",
    "CreateProgram": "u",
    "CreateShader": "uu",
    "DeleteBuffers": "-ip",
    "DeleteFramebuffers": "-ip",
    "DeleteProgram": "-u",
    "DeleteShader": "-u",
    "DeleteTextures": "-ip",
    "DeleteVertexArrays": "-ip",
    "DepthFunc": "-u",
    "DepthMask": "-i",
    "Disable": "-u",
    "DrawArrays": "-uii",
    "Enable": "-u",
    "FramebufferTexture2D": "-uuuui",
    "GenBuffers": "-ip",
    "GenFramebuffers": "-ip",
    "GenTextures": "-ip",
    "GenVertexArrays": "-ip",
    "GetError": "u",
    "GetFramebufferAttachmentParameteriv": "-uuup",
    "GetIntegerv": "-up",
    "GetProgramiv": "-uup",
    "GetRenderbufferParameteriv": "-uup",
    "GetShaderiv": "-uup",
    "GetString": "su",
    "GetTexLevelParameteriv": "-uiup",
    "GetUniformLocation": "ius",
    "IsEnabled": "iu",
    "LinkProgram": "-u",
    "PixelStorei": "-ui",
    "PolygonMode": "-uu",
    "ReadPixels": "-iiiiuup",
    "ShaderSource": "-uipp",
    "TexImage2D": "-uiiiiiuup",
    "TexParameteri": "-uui",
    "TexSubImage2D": "-uiiiiiuup",
    "Uniform1i": "-ii",
    "UseProgram": "-u",
    "Viewport": "-iiii",
}

_NO_CONTEXT = "no OpenGL context is current on this thread, none at least that the library knows"

#: Address of a function by its name.
Loader = Callable[[str], "int | None"]


class Functions:
    """OpenGL 3.2 of the current context; functions have their names without `gl`."""

    def __init__(self, where: str, load: Loader | None = None) -> None:
        """Finds the functions.

        Args:
            where: Who asks, for messages.
            load: Address of a function by its name; default: the system's library.

        Raises:
            RuntimeError: There is no library, no context, or an older OpenGL.
        """
        self._where = where
        load = load or _system(where)
        for name, kinds in _FUNCTIONS.items():
            self._take(load, name, kinds)
        self.require_context()
        version = self.integer(MAJOR_VERSION), self.integer(MINOR_VERSION)
        if version < (3, 2):
            raise RuntimeError(f"{where}: OpenGL 3.2 is needed, got {version[0]}.{version[1]}")
        self._samplers = version >= (3, 3)  # there are sampler objects
        if self._samplers:
            self._take(load, "BindSampler", "-uu")

    def _take(self, load: Loader, name: str, kinds: str) -> None:
        place = load(f"gl{name}")
        if not place:
            raise RuntimeError(f"{self._where}: this OpenGL lacks gl{name}; 3.2 is needed")
        prototype: Any = ctypes.CFUNCTYPE(*(_TYPES[kind] for kind in kinds))
        setattr(self, name, prototype(place))

    def __getattr__(self, name: str) -> Callable[..., Any]:
        raise AttributeError(name)  # tells the type of the functions that __init__ sets

    def require_context(self) -> None:
        """Raises RuntimeError unless a context is current; forgets errors of before."""
        if not self.GetString(VERSION):
            raise RuntimeError(f"{self._where}: {_NO_CONTEXT}")
        self._forget_errors()

    def check(self, what: str, hint: str) -> None:
        """Raises RuntimeError if OpenGL tells of an error."""
        if error := self.GetError():
            name = _ERRORS.get(error, hex(error))
            raise RuntimeError(f"{self._where}: {what}: OpenGL says {name} ({hint})")

    def integer(self, what: int) -> int:
        """A number of the context's state."""
        return self.integers(what, 1)[0]

    def integers(self, what: int, count: int) -> list[int]:
        """Several numbers of the context's state."""
        values = (c_int * max(count, 4))()
        self.GetIntegerv(what, values)
        return list(values)[:count]

    def parameter(self, get: str, *arguments: int) -> int:
        """What a function of the kind of glGetShaderiv tells; 0 if it tells nothing."""
        value = c_int()
        getattr(self, get)(*arguments, ctypes.byref(value))
        return value.value

    def make(self, kind: str) -> int:
        """A new name: of Buffers, Textures, Framebuffers or VertexArrays."""
        name = c_uint()
        getattr(self, f"Gen{kind}")(1, ctypes.byref(name))
        return name.value

    def drop(self, kind: str, name: int) -> None:
        """Deletes what `make` made."""
        getattr(self, f"Delete{kind}")(1, ctypes.byref(c_uint(name)))

    def program(self, vertex: str, fragment: str) -> int:
        """Links two shaders.

        Raises:
            RuntimeError: OpenGL takes them not.
        """
        program = self.CreateProgram()
        for kind, text in ((VERTEX_SHADER, vertex), (FRAGMENT_SHADER, fragment)):
            shader = self.CreateShader(kind)
            source = c_char_p(text.encode())
            self.ShaderSource(shader, 1, ctypes.byref(source), None)
            self.CompileShader(shader)
            self.AttachShader(program, shader)
            self.DeleteShader(shader)  # as soon as the program is
        self.LinkProgram(program)
        if not self.parameter("GetProgramiv", program, LINK_STATUS):
            raise RuntimeError(f"{self._where}: this OpenGL takes no GLSL 1.50")
        return program

    @contextmanager
    def unchanged(self, *, drawing: bool) -> Iterator[None]:
        """Puts the context's state back afterwards, as far as `Exchange` changes it.

        Until then pixels lie in the host's memory, close together, and with `drawing` nothing is
        blended, tested or left out.
        """
        with ExitStack() as later:
            later.callback(self._forget_errors)
            for each, value in _STORE.items():
                later.callback(self.PixelStorei, each, self.integer(each))
                self.PixelStorei(each, value)
            for target, query in _BUFFERS.items():
                later.callback(self.BindBuffer, target, self.integer(query))
                self.BindBuffer(target, 0)
            for target, query in _FRAMES.items():
                later.callback(self.BindFramebuffer, target, self.integer(query))
            later.callback(self.ActiveTexture, self.integer(ACTIVE_TEXTURE))
            for unit in (1, 0):
                self.ActiveTexture(TEXTURE0 + unit)
                if self._samplers:
                    later.callback(self.BindSampler, unit, self.integer(SAMPLER_BINDING))
                    self.BindSampler(unit, 0)
                later.callback(self.BindTexture, TEXTURE_2D, self.integer(TEXTURE_BINDING))
                later.callback(self.ActiveTexture, TEXTURE0 + unit)
            if drawing:
                for each in filter(self.IsEnabled, _SWITCHES):
                    later.callback(self.Enable, each)
                    self.Disable(each)
                test = self.Enable if self.IsEnabled(DEPTH_TEST) else self.Disable
                later.callback(test, DEPTH_TEST)
                later.callback(self.UseProgram, self.integer(PROGRAM))
                later.callback(self.BindVertexArray, self.integer(VERTEX_ARRAY))
                later.callback(self.Viewport, *self.integers(VIEWPORT, 4))
                later.callback(self.ColorMask, *self.integers(COLOR_MASK, 4))
                later.callback(self.DepthMask, self.integer(DEPTH_MASK))
                later.callback(self.DepthFunc, self.integer(DEPTH_FUNC))
                later.callback(self.PolygonMode, FRONT_AND_BACK, self.integer(POLYGON_MODE))
            yield

    def _forget_errors(self) -> None:
        while self.GetError():
            pass


def _system(where: str) -> Loader:
    """The functions of the system's library that knows the current context. Libglvnd's (the first
    two) hand calls on to any driver; OSMesa's contexts are its own.

    Raises:
        RuntimeError: There is no library, or no context is current.
    """
    found = False
    for name in ("libOpenGL.so.0", "libGL.so.1", "libOSMesa.so.8"):
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        found = True
        library.glGetString.restype = c_char_p
        if library.glGetString(VERSION):
            return partial(_address, library)
    if found:
        raise RuntimeError(f"{where}: {_NO_CONTEXT}")
    raise RuntimeError(
        f"{where}: found no OpenGL library; hand over load=..., such as glfw.get_proc_address"
    )


def _address(library: ctypes.CDLL, function: str) -> int | None:
    place = getattr(library, function, None)
    return ctypes.cast(place, c_void_p).value if place else None
