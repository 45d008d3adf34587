"""What users are told of errors: in one line, and what to install. torch is not imported here."""

from __future__ import annotations

import importlib
from typing import Any


def one_line(error: object) -> str:
    """Returns what an error says, in one line; its type if it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__


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
