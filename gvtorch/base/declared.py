"""`declared_names`: names that a file declares, read without running it, so that `gvtorch --help`
does not wait for torch.
"""

from __future__ import annotations

import ast
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


def declared_names(module: str, variable: str) -> list[str]:
    """Returns the texts of the list, or the keys of the dict, that a module, named as in
    `shaders.built_in`, assigns to a variable once, at its top level.
    """
    path = _PACKAGE.joinpath(*module.split(".")).with_suffix(".py")
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            target, value = node.target, node.value
        else:
            continue
        if isinstance(target, ast.Name) and target.id == variable:
            if isinstance(value, ast.Dict):
                return [ast.literal_eval(key) for key in value.keys if key is not None]
            return ast.literal_eval(value)
    raise KeyError(f"{module} has no {variable}")
