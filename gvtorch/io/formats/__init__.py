"""The file formats, one file for each; files in this folder are found by themselves.

torch is not imported here, so that the command line can name the formats at once.
"""

import importlib
import pkgutil
from collections.abc import Collection
from pathlib import Path

from .format import FORMATS, Format

for _module in sorted(module.name for module in pkgutil.iter_modules(__path__)):
    importlib.import_module(f".{_module}", __name__)


def find_format(path: str, *, raw: bool = False) -> Format:
    """Returns the format of a file, folder or URL, by its name and kind. With `raw` a file of
    unknown kind is RAW, since its extent is known.

    Raises:
        ValueError: There is none.
    """
    for candidate in FORMATS:
        if candidate.matches(path):
            return candidate
    if raw and not Path(path).is_dir():
        return next(candidate for candidate in FORMATS if candidate.name == "RAW")
    if Path(path).is_dir():
        raise ValueError(
            f"{path}: holds neither a DICOM series, nor images, nor a Zarr or N5 array"
        )
    endings = ", ".join(ending for candidate in FORMATS for ending in candidate.endings)
    raise ValueError(
        f"{path}: unknown volume format; known endings: {endings}, or a folder of DICOM files or "
        "of images; numbers alone are read if shape and dtype (--shape, --dtype) tell their extent"
    )


def check_options(path: str, found: Format, given: Collection[str]) -> None:
    """Raises ValueError, with the formats that take it, for an option that a format doesn't."""
    for name in given:
        if name not in found.options:
            owners = [candidate for candidate in FORMATS if name in candidate.options]
            names, those = " and ".join(owners[0].options), len(owners[0].options) > 1
            if len(owners) > 1:
                names, those = name, False
            raise ValueError(
                f"{path}: {names} {'are' if those else 'is'} for "
                f"{', '.join(owner.name for owner in owners)} files, this is {found.name}"
            )


def format_names() -> str:
    """The names of all formats for help texts, as in "FITS, NIfTI or RAW"."""
    *names, last = (candidate.name for candidate in FORMATS)
    return f"{', '.join(names)} or {last}"


__all__ = ["FORMATS", "Format", "check_options", "find_format", "format_names"]
