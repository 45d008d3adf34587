"""Makes the wheel that holds the extension libraries, see libraries.py.

setuptools loads this file by itself (see `[tool.setuptools]` in pyproject.toml), so it imports
nothing of gvtorch and runs libraries.py by its path.

Environment:
    GVTORCH_COMPILE     0: an installation compiles nothing; libraries.py does, run as a program
"""

from __future__ import annotations

import os
import runpy
import shutil
from pathlib import Path
from types import SimpleNamespace

from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

libraries = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("libraries.py"))))
FOLDER: Path = libraries.FOLDER / "lib"


class BuildExt(build_ext):
    """Puts the libraries into cpp_ext/lib, in the source tree and in the wheel."""

    def run(self) -> None:
        """Compiles the libraries in the source tree, where the next build can reuse them, then
        copies them into the wheel.
        """
        if os.environ.get("GVTORCH_COMPILE") == "0":
            return
        paths = libraries.compile_libraries(FOLDER)
        if not (self.inplace or self.editable_mode):
            for library in paths:
                target = Path(self.build_lib) / library
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(library, target)

    def get_outputs(self) -> list[str]:
        """Returns the paths of the libraries in the build folder."""
        return list(self.get_output_mapping())

    def get_output_mapping(self) -> dict[str, str]:
        """Returns build folder path -> source tree path, for editable installs."""
        paths = libraries.commands(FOLDER)
        return {str(Path(self.build_lib) / library): str(library) for library in paths}


class BdistWheel(bdist_wheel):
    """Tags the wheel for any Python 3: the libraries do not use the Python C API."""

    def get_tag(self) -> tuple[str, str, str]:
        """Returns (py3, none, platform)."""
        return ("py3", "none", super().get_tag()[2])
