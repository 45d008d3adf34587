"""Files that a page sends: transfer functions of gvtorch, ParaView and 3D Slicer."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

from ..shaders import TransferFunction
from .schema import MAX_ITEMS

_SUFFIXES = (".vp.json", ".json", ".vp", ".xml")


def read_function(
    file: str, text: str, name: str | None, low: float | None, high: float | None
) -> tuple[TransferFunction, list[str]]:
    """Returns the transfer function of a file, given its name and text, and notes on what of it is
    lost; raises ValueError if the file holds none. `name` selects one of several functions; one
    with relative values only, such as ParaView's, is stretched over `low` to `high`.
    """
    suffix = next((suffix for suffix in _SUFFIXES if file.lower().endswith(suffix)), None)
    if suffix is None:
        raise ValueError(f"{file:.80}: must end in {', '.join(_SUFFIXES)}")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        path = Path(folder) / f"function{suffix}"
        path.write_text(text, encoding="utf-8")
        try:
            function = TransferFunction.from_file(path, name)
        except ValueError as error:
            raise ValueError(str(error).replace(str(path), f"{file:.80}")) from None
    if function.relative and low is not None and high is not None:
        function = function.stretched(low, high)
    points = max(len(function.opacity), len(function.color))
    if points > MAX_ITEMS:
        raise ValueError(f"{file:.80}: has {points} points, more than {MAX_ITEMS}")
    notes = [str(warning.message).replace(str(path), f"{file:.80}") for warning in caught]
    return function, notes
