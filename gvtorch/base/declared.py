"""`declared_names`, `declared_texts` and `imported_names`: what a module declares, read without
importing it, so that `gvtorch --help` does not wait for torch. `did_you_mean`: suggestions for a
misspelt name.
"""

from __future__ import annotations

import ast
import difflib
import functools
from collections.abc import Iterable
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


def declared_names(module: str, variable: str) -> list[str]:
    """Returns the items of the list of strings, or the keys of the dict, that a module (such as
    `shaders.built_in`) assigns to a variable once, at its top level.
    """
    value = _assigned(module, variable)
    assert isinstance(value, (ast.Dict, ast.List))
    names = value.keys if isinstance(value, ast.Dict) else value.elts
    return [ast.literal_eval(name) for name in names if name is not None]


def declared_texts(module: str, variable: str) -> dict[str, str]:
    """Returns the first item of each tuple in such a dict, strings, by key."""
    value = _assigned(module, variable)
    assert isinstance(value, ast.Dict)
    texts = [ast.literal_eval(item.elts[0]) for item in value.values if isinstance(item, ast.Tuple)]
    return dict(zip(declared_names(module, variable), texts, strict=True))


def imported_names(path: str, room: str = "") -> dict[str, str]:
    """Returns the names that a file of the package, in a room, imports from its neighbours, each
    with the module that it comes from. `*` stands for the names that a room's `__init__.py`
    imports, or for the `__all__` of a module.
    """
    homes: dict[str, str] = {}
    for node in ast.parse(_PACKAGE.joinpath(room, path).read_text("utf-8")).body:
        if not isinstance(node, ast.ImportFrom):
            continue
        home = ".".join(filter(None, (room, node.module)))
        if [alias.name for alias in node.names] != ["*"]:
            homes |= {alias.name: home for alias in node.names}
        elif _PACKAGE.joinpath(home).is_dir():
            homes |= imported_names("__init__.py", home)
        else:
            homes |= dict.fromkeys(declared_names(home, "__all__"), home)
    return homes


@functools.cache
def _assigned(module: str, variable: str) -> ast.expr:
    """Returns the expression that a module assigns to a variable at its top level."""
    path = _PACKAGE.joinpath(*module.split(".")).with_suffix(".py")
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if isinstance(target, ast.Name) and target.id == variable and node.value is not None:
                return node.value
    raise KeyError(f"{module} has no {variable}")


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Returns " (did you mean ...?)" with the known names most like `name`, or an empty text."""
    originals = {text.lower(): text for text in choices}
    close = difflib.get_close_matches(name.lower(), originals, n=3)
    return f" (did you mean {' or '.join(originals[text] for text in close)}?)" if close else ""
