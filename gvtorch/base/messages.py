"""Messages for users: errors in one printable line, what to install, and what libraries log. Does
not import torch.
"""

from __future__ import annotations

import importlib
import logging
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# Characters that a terminal obeys, that end a line, or that change the direction of text.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
_MAX_CHARACTERS = 1500  # characters in a line
_COLLECTED = threading.local()  # its `records` are those that `collected_log` collects in a thread


def one_line(error: object, limit: int = _MAX_CHARACTERS) -> str:
    """Returns an error's message as one printable line; its type if the message is empty. A line
    longer than `limit` (files and users may put anything into it) loses its middle.
    """
    text = str(error)
    text = text if len(text) <= 8 * limit else f"{text[: 4 * limit]} {text[-4 * limit :]}"
    line = printable(" ".join(text.split())) or type(error).__name__
    if len(line) <= limit:
        return line
    half_length = limit // 2
    return f"{line[:half_length]} ... {line[-half_length:]}"


def with_type(error: BaseException) -> str:
    """Returns an error in one line, its type in front: "division by zero" alone tells little."""
    name = type(error).__name__
    return f"{name}: {one_line(error)}" if str(error).strip() else name


def reason(error: BaseException) -> str:
    """Returns in one line why something failed: a ValueError's own words, or `with_type`."""
    return one_line(error) if isinstance(error, ValueError) else with_type(error)


def printable(text: object) -> str:
    """Returns a text with control characters escaped, as in "\\x1b": names and contents of files
    are untrusted.
    """
    return _CONTROL.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), str(text))


def need_library(feature: str, library: str, package: str = "", extra: str = "io") -> Any:
    """Imports and returns a module on behalf of `feature`.

    Raises:
        ImportError: It is missing; the message names the extra of gvtorch that installs it.
    """
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise ImportError(
            f"{feature} needs {package or library}: pip install 'gvtorch[{extra}]' ({error})"
        ) from None


@contextmanager
def collected_log(name: str) -> Iterator[list[logging.LogRecord]]:
    """Collects what the logger `name` receives from this thread, instead of letting it be printed;
    the list grows during the `with` block.
    """
    logging.getLogger(name).addFilter(_collect)  # further calls add nothing
    _COLLECTED.records = records = list[logging.LogRecord]()
    try:
        yield records
    finally:
        _COLLECTED.records = None


def _collect(record: logging.LogRecord) -> bool:
    """Returns whether a record may be printed: nobody collects those of this thread."""
    records: list[logging.LogRecord] | None = getattr(_COLLECTED, "records", None)
    if records is not None:
        records.append(record)
    return records is None
