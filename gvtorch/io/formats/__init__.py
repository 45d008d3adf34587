"""The file formats, one file for each; files in this folder are found by themselves.

torch is not imported here, so that the command line can name the formats at once.
"""

import importlib
import pkgutil

from .format import FORMATS, Format

for _module in sorted(module.name for module in pkgutil.iter_modules(__path__)):
    importlib.import_module(f".{_module}", __name__)


def find_format(path: str) -> Format:
    """Returns the format of a file, folder or URL, by its name and kind; ValueError if none."""
    for candidate in FORMATS:
        if candidate.matches(path):
            return candidate
    endings = ", ".join(ending for candidate in FORMATS for ending in candidate.endings)
    raise ValueError(
        f"{path}: unknown volume format; known endings: {endings}, or a folder of TIFF slices"
    )


def format_names() -> str:
    """The names of all formats for help texts, as in "FITS, NIfTI or RAW"."""
    *names, last = (candidate.name for candidate in FORMATS)
    return f"{', '.join(names)} or {last}"


__all__ = ["FORMATS", "Format", "find_format", "format_names"]
