"""`explicit`: makes functions that take the fields of an options record as keyword arguments show
each field, with its type, default and meaning, to `help`, editors and `inspect`.

An option's default and description are written in the record only. Type checkers read a
`TypedDict` of the same fields; a test keeps the two equal.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


def option_texts(record: type) -> dict[str, str]:
    """Returns each field's text from the section "Attributes:" of the record's docstring."""
    section = inspect.cleandoc(record.__doc__ or "").partition("Attributes:\n")[2]
    items = re.split(r"^(?=\w+: )", textwrap.dedent(section), flags=re.MULTILINE)
    pairs = (item.partition(": ") for item in items if item.strip())
    return {name: " ".join(text.split()) for name, _, text in pairs}


def explicit(record: type) -> Callable[[Function], Function]:
    """Makes a function whose last parameter is `**options: Unpack[...]` show the fields of a
    dataclass instead: in its signature, and in place of its docstring's line "**options:".
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        *own_parameters, _ = signature.parameters.values()
        kind = inspect.Parameter.KEYWORD_ONLY
        options = [
            inspect.Parameter(field.name, kind, default=field.default, annotation=field.type)
            for field in fields(record)
        ]
        documented: Any = function
        documented.__signature__ = signature.replace(parameters=[*own_parameters, *options])
        texts, lines = option_texts(record), []
        for option in options:
            text = f"{option.name}: {texts[option.name]} Default: {option.default!r}."
            lines += textwrap.wrap(text, 90, subsequent_indent="    ")

        def option_lines(match: re.Match[str]) -> str:
            return "\n".join(match[1] + line for line in lines)

        options_line = re.compile(r"^( +)\*\*options: Fields of `\w+`\.$", re.MULTILINE)
        documented.__doc__ = options_line.sub(option_lines, function.__doc__ or "")
        return function

    return decorate
