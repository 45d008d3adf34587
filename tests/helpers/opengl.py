"""Whether OpenGL is available, and a context without a window."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import subprocess
import sys

import pytest

_context = []


def opengl_context():
    """Makes moderngl's windowless context current and returns it, or skips the test. Each process
    has one, until VTK closes a window, which terminates EGL's display for all its users.
    """
    moderngl = pytest.importorskip("moderngl")
    if _context:
        _context[0].__enter__()
        if not ctypes.CDLL("libEGL.so.1").eglGetCurrentContext():
            _context.clear()
    if not _context:
        try:
            _context.append(moderngl.create_context(standalone=True, backend="egl"))
        except Exception as error:  # it raises no other class
            pytest.skip(f"no OpenGL through EGL: {error}")
    return _context[0]


@functools.cache
def no_vtk() -> str:
    """Returns why VTK can't draw, or "". Tried in another process: without OpenGL, VTK aborts."""
    code = "import vtk; w = vtk.vtkRenderWindow(); w.SetOffScreenRendering(True); w.Render()"
    return _why_not("vtk", code)


def _no_moderngl() -> str:
    """Returns why moderngl can't draw here without a window, or an empty string."""
    code = "import moderngl; moderngl.create_context(standalone=True, backend='egl')"
    return _why_not("moderngl", code)


def _why_not(package: str, code: str) -> str:
    if not importlib.util.find_spec(package):
        return f"{package} is not installed"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    return f"{package} finds no OpenGL" if run.returncode else ""


#: Examples that draw with OpenGL, and the function that returns why they can't.
IN_OPENGL = {"mixed_triangles": no_vtk, "opengl_frame": _no_moderngl}
