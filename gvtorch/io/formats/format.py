"""`Format`: an entry of the registry of file formats."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import TypeVar

from ...base.messages import need_library
from ..source import VolumeSource

Opener = TypeVar("Opener", bound=Callable[..., VolumeSource])

#: Every format, in the order in which they are tried.
FORMATS: list[Format] = []


class Format:
    """A file format: decorates the function that opens its files and enters it into `FORMATS`.

    That function is called with the path (str) and the options that the user gave. It reads the
    header alone and returns a source. It may raise anything if the file is damaged.
    """

    open: Callable[..., VolumeSource]

    def __init__(
        self,
        name: str,
        *endings: str,
        matches: Callable[[str], bool] | None = None,
        options: tuple[str, ...] = (),
        library: str = "",
        package: str = "",
        extra: str = "io",
    ) -> None:
        """Describes a format.

        Args:
            name: As users know it.
            endings: Of file names, in lower case.
            matches: Tells whether a path is of this format, where endings do not (folders, URLs).
            options: Arguments of `read_volume` that this format takes.
            library: The module that reading needs; it is there when files are opened.
            package: What pip installs it as, if that is another name.
            extra: The extra of gvtorch that brings it.
        """
        self.name, self.endings, self.options = name, endings, options
        self.matches = matches or (lambda path: path.lower().endswith(endings))
        self.library, self.package, self.extra = library, package or library, extra

    def __call__(self, opener: Opener) -> Opener:
        """Takes the function that opens files."""
        self.open = opener
        FORMATS.append(self)
        return opener

    def __repr__(self) -> str:
        return f"Format({self.name!r}, endings {self.endings})"

    @property
    def status(self) -> str:
        """The word "ready", or what to install."""
        if not self.library or importlib.util.find_spec(self.library):
            return "ready"
        return f"needs {self.package}: pip install 'gvtorch[{self.extra}]'"

    def need_library(self, path: str) -> None:
        """Raises ImportError, with the pip command, if the library is missing."""
        need_library(
            f"{path}: reading this format", self.library or __name__, self.package, self.extra
        )
