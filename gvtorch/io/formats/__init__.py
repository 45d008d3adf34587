"""The file formats, one module for each; all modules in this folder are imported and registered."""

import importlib
import pkgutil
import re
from pathlib import Path

from .format import FORMATS, Format

for _module in sorted(module.name for module in pkgutil.iter_modules(__path__)):
    importlib.import_module(f".{_module}", __name__)


def find_format(path: str, *, raw: bool = False) -> Format:
    """Returns the format of a file, folder or URL, by its name and content. With `raw`, which says
    that the extent is known, a file of unknown format is RAW.

    Raises:
        ValueError: No format matches.
    """
    for candidate in FORMATS:
        if candidate.matches(path):
            return candidate
    if raw and not Path(path).is_dir():
        return next(candidate for candidate in FORMATS if candidate.name == "RAW")
    if Path(path).is_dir():
        raise ValueError(f"{path}: holds no DICOM series, no images and no Zarr or N5 array")
    from ..mesh_file import ENDINGS as MESHES

    ending = path.lower().removesuffix(".gz").rpartition(".")[2]
    if ending in MESHES:
        points = " (or gvtorch splat, of points)" if ending == "ply" else ""
        raise ValueError(f"{path}: not a volume: gvtorch voxelize{points} makes one of a mesh")
    endings = ", ".join(ending for candidate in FORMATS for ending in candidate.endings)
    raise ValueError(
        f"{path}: unknown volume format; known endings: {endings}, or a folder of DICOM files or "
        "of images; numbers alone are read if shape and dtype (--shape, --dtype) tell their extent"
    )


def split_path(text: str) -> tuple[str, str | None]:
    """Splits `file.h5:/group/data`, `image.zarr:/labels/cells` or `https://host/file.h5:/data` into
    the file and the path inside it; other paths and URLs are returned whole, with None.
    """
    if match := re.fullmatch(r"(\w+://.+\.\w+):(/.+)", text):
        return match[1], match[2]
    file, separator, inner_path = text.rpartition(":/")
    if separator and "://" not in text and not Path(text).exists() and Path(file).exists():
        return file, f"/{inner_path}"
    return text, None


def format_names() -> str:
    """Returns the names of all formats for help texts, as in "FITS, NIfTI or RAW"."""
    *names, last = (candidate.name for candidate in FORMATS)
    return f"{', '.join(names)} or {last}"


__all__ = ["FORMATS", "Format", "find_format", "format_names", "split_path"]
