"""Error messages for users: one printable line, and what to install. Does not import torch."""

from __future__ import annotations

import importlib
import re
from typing import Any

# Characters that a terminal obeys, that end a line, or that change the direction of text.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")


_MOST = 1500  # characters in a line


def one_line(error: object, most: int = _MOST) -> str:
    """Returns an error's message as one printable line; its type if the message is empty. A line
    longer than `most` (files and users may put anything into it) loses its middle.
    """
    text = str(error)
    text = text if len(text) <= 8 * most else f"{text[: 4 * most]} {text[-4 * most :]}"
    line = printable(" ".join(text.split())) or type(error).__name__
    if len(line) <= most:
        return line
    half = most // 2
    return f"{line[:half]} ... {line[-half:]}"


def printable(text: object) -> str:
    """Returns a text with control characters escaped, as in "\\x1b": names and contents of files
    are untrusted.
    """
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), str(text))


def need_library(what: str, library: str, package: str = "", extra: str = "io") -> Any:
    """Imports and returns a module on behalf of `what`.

    Raises:
        ImportError: It is missing; the message names the extra of gvtorch that installs it.
    """
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise ImportError(
            f"{what} needs {package or library}: pip install 'gvtorch[{extra}]' ({error})"
        ) from None
