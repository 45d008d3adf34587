"""What users are told of errors: in one line, and what to install. torch is not imported here."""

from __future__ import annotations

import importlib
import re
from typing import Any

# What a terminal takes for a command, or for the end of a line, or writes from right to left.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")


_MOST = 1500  # characters of a line


def one_line(error: object, most: int = _MOST) -> str:
    """Returns what an error says, in one printable line; its type if it says nothing. Of a longer
    line, in which a file or a user may tell anything, the middle is left out.
    """
    text = str(error)
    text = text if len(text) <= 8 * most else f"{text[: 4 * most]} {text[-4 * most :]}"
    line = printable(" ".join(text.split())) or type(error).__name__
    if len(line) <= most:
        return line
    half = most // 2
    return f"{line[:half]} ... {line[-half:]}"


def printable(text: object) -> str:
    """Returns a text in which characters that a terminal obeys are told, as in "\\x1b": names of
    files and what stands in them come from anyone.
    """
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), str(text))


def need_library(what: str, library: str, package: str = "", extra: str = "io") -> Any:
    """Returns a module, for what needs it.

    Raises:
        ImportError: It is missing; the message tells which extra of gvtorch brings the package.
    """
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise ImportError(
            f"{what} needs {package or library}: pip install 'gvtorch[{extra}]' ({error})"
        ) from None
