"""Whether OpenGL is here, and its context without a window."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import subprocess
import sys

import pytest

_context = []


def opengl_context():
    """moderngl's context without a window, current, or a skip. One a process, until VTK closes a
    window: that ends EGL's display, for all who have it.
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
    """Why VTK can't draw here, or nothing. Without OpenGL it ends its process, so another tries."""
    code = "import vtk; w = vtk.vtkRenderWindow(); w.SetOffScreenRendering(True); w.Render()"
    return _why_not("vtk", code)


def _no_moderngl() -> str:
    """Why moderngl can't draw here without a window, or nothing."""
    code = "import moderngl; moderngl.create_context(standalone=True, backend='egl')"
    return _why_not("moderngl", code)


def _why_not(package: str, code: str) -> str:
    if not importlib.util.find_spec(package):
        return f"{package} is not installed"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    return f"{package} finds no OpenGL" if run.returncode else ""


#: Examples that draw with OpenGL, and why they can't.
IN_OPENGL = {"mixed_triangles": no_vtk, "opengl_frame": _no_moderngl}
