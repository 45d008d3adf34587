"""Whether OpenGL is here, and its context without a window."""

from __future__ import annotations

import functools
import importlib.util
import subprocess
import sys

import pytest


@functools.cache
def opengl_context():
    """moderngl's context without a window, one a process, or a skip."""
    moderngl = pytest.importorskip("moderngl")
    try:
        return moderngl.create_context(standalone=True, backend="egl")
    except Exception as error:  # it raises no other class
        pytest.skip(f"no OpenGL through EGL: {error}")


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
