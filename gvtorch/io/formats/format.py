"""`file_format`: enters a format into the registry."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ..source import VolumeSource

Opener = TypeVar("Opener", bound=Callable[..., VolumeSource])


@dataclass(frozen=True, kw_only=True)
class Format:
    """A file format: see `file_format`."""

    name: str
    endings: tuple[str, ...]
    open: Callable[..., VolumeSource]
    matches: Callable[[str], bool] | None
    options: tuple[str, ...]
    library: str
    package: str

    def fits(self, path: str) -> bool:
        """Whether a path is of this format."""
        return self.matches(path) if self.matches else path.lower().endswith(self.endings)

    @property
    def status(self) -> str:
        """The word "ready", or what to install."""
        if not self.library or importlib.util.find_spec(self.library):
            return "ready"
        return f"needs {self.package}: pip install 'gvtorch[io]'"

    def need_library(self, path: str) -> None:
        """Raises ImportError, with the pip command, if the library is missing."""
        try:
            importlib.import_module(self.library or __name__)
        except ImportError as error:
            raise ImportError(
                f"{path}: reading this format needs {self.package}: "
                f"pip install 'gvtorch[io]' ({error})"
            ) from None


#: Every format, in the order in which they are tried.
FORMATS: list[Format] = []


def file_format(
    name: str,
    *endings: str,
    matches: Callable[[str], bool] | None = None,
    options: tuple[str, ...] = (),
    library: str = "",
    package: str = "",
) -> Callable[[Opener], Opener]:
    """Enters a format into `FORMATS`; decorates the function that opens its files.

    That function is called with the path (str) and the options that the user gave. It reads the
    header alone and returns a source. It may raise anything if the file is damaged.

    Args:
        name: As users know it.
        endings: Of file names, in small letters.
        matches: Tells whether a path is of this format, where endings do not (folders, URLs).
        options: Arguments of `read_volume` that this format takes.
        library: The module that reading needs; it is there when files are opened.
        package: What pip installs it as, if that is another name.
    """

    def enter(opener: Opener) -> Opener:
        FORMATS.append(
            Format(
                name=name,
                endings=endings,
                open=opener,
                matches=matches,
                options=options,
                library=library,
                package=package or library,
            )
        )
        return opener

    return enter
