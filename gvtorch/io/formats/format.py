"""`Format`: an entry of the registry of file formats; `choose`: finds an item of a file by name."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from typing import TypeVar

from ...base.digits import whole_number
from ...base.messages import need_library
from ..source import VolumeSource

Opener = TypeVar("Opener", bound=Callable[..., VolumeSource])

#: Every format, in the order in which they are tried.
FORMATS: list[Format] = []
_MAX_LISTED = 50  # names in a message


class Format:
    """A file format: decorates the function that opens its files and registers it in `FORMATS`.

    That function is called with the path (str) and the options that the user gave. It reads only
    the header and returns a source. It may raise anything if the file is damaged.
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
            matches: Returns whether a path has this format, if that is not decided by its ending
                (folders, URLs).
            options: Arguments of `read_volume` that this format takes.
            library: The module that reading needs; checked before a file is opened.
            package: Its name for pip, if that is another one.
            extra: The extra of gvtorch that installs it.
        """
        self.name, self.endings, self.options = name, endings, options
        self.matches = matches or (lambda path: path.lower().endswith(endings))
        self.library, self.package, self.extra = library, package or library, extra

    def __call__(self, opener: Opener) -> Opener:
        """Registers the function that opens files."""
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
        context = f"{path}: reading this format"
        need_library(context, self.library or __name__, self.package, self.extra)


def choose(
    path: str, noun: str, names: Sequence[str | int], key: str | None, preferred: str = ""
) -> tuple[int, tuple[str, ...]]:
    """Chooses one of several items of a file by its name or number.

    Args:
        path: For messages.
        noun: What the items are, for messages: "image".
        names: The names of all items; or their numbers, if they have no names.
        key: A name or a number (if items have names: their index, from 0), also after a slash, as
            in `file.vdb:/density`.
        preferred: The name to choose if `key` is left out; if there is none, the first is chosen.

    Returns:
        Its index among `names`, and an entry about the others for `VolumeSource.dropped` if `key`
        is left out.

    Raises:
        ValueError: There are no items, or none that matches `key`.
    """
    numbers = [index if isinstance(name, str) else name for index, name in enumerate(names)]
    pairs = zip(numbers, names, strict=True)
    listed = [f"{n} {name!r}" if isinstance(name, str) else str(n) for n, name in pairs]
    if key is None and names:
        others = f"{len(names) - 1} other {_plural(noun)}; key (--key) chooses among"
        dropped = (f"{others} {_join_names(listed)}",) if len(names) > 1 else ()
        return names.index(preferred) if preferred in names else 0, dropped
    plain_key = (key or "").removeprefix("/")
    for wanted, candidates in (
        (key, names),
        (plain_key, names),
        (whole_number(plain_key), numbers),
    ):
        if wanted in candidates:
            return candidates.index(wanted), ()
    raise not_chosen(path, noun, listed, key)


def not_chosen(
    path: str, noun: str, names: Sequence[str], key: str | None, qualifier: str = ""
) -> ValueError:
    """Returns the error for a `key` that matches none of several items, or is left out although one
    must be chosen. `noun` as in `choose`; `qualifier` says which items are listed: " of three or
    more axes".
    """
    if key is not None:
        message = f"has no {noun} {key!r}; it holds {_join_names(names) or f'none{qualifier}'}"
    elif names:
        listed = _join_names(names)
        message = f"holds {len(names)} {_plural(noun)}, choose one with key (--key): {listed}"
    else:
        message = f"holds no {noun}{qualifier}"
    return ValueError(f"{path}: {message}")


def _plural(noun: str) -> str:
    return noun if noun.endswith("s") else f"{noun}s"


def _join_names(names: Sequence[str]) -> str:
    ellipsis = ["..."] if len(names) > _MAX_LISTED else []
    return ", ".join([*names[:_MAX_LISTED], *ellipsis])
