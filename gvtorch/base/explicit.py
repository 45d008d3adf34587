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
    part = inspect.cleandoc(record.__doc__ or "").partition("Attributes:\n")[2]
    items = re.split(r"^(?=\w+: )", textwrap.dedent(part), flags=re.MULTILINE)
    pairs = (item.partition(": ") for item in items if item.strip())
    return {name: " ".join(text.split()) for name, _, text in pairs}


def explicit(record: type) -> Callable[[Function], Function]:
    """Makes a function whose last parameter is `**options: Unpack[...]` show the fields of a
    dataclass instead: in its signature, and in place of its docstring's line "**options:".
    """

    def shown(function: Function) -> Function:
        signature = inspect.signature(function)
        own = [one for one in signature.parameters.values() if one.kind is not one.VAR_KEYWORD]
        options = [
            inspect.Parameter(
                field.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=field.default,
                annotation=field.type,
            )
            for field in fields(record)
        ]
        made: Any = function
        made.__signature__ = signature.replace(parameters=[*own, *options])
        texts, lines = option_texts(record), []
        for one in options:
            text = f"{one.name}: {texts[one.name]} Default: {one.default!r}."
            lines += textwrap.wrap(text, 90, subsequent_indent="    ")

        def listed(line: re.Match[str]) -> str:
            return "\n".join(line[1] + one for one in lines)

        where = re.compile(r"^( +)\*\*options: Fields of `\w+`\.$", re.MULTILINE)
        made.__doc__ = where.sub(listed, function.__doc__ or "")
        return function

    return shown
