"""`render_tiles`: pictures larger than memory, strip of rows by strip of rows, to a file."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..base import check
from ..base.records import Rays, RenderStats
from ..base.stage import Progress, no_progress
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from .files import checked_path, stacked, tiff_pixels, whole_file, write_tiff
from .picture import Picture

_PIXEL_BYTES = 400  # of a strip on its way: rays (80), hits twice, layers and their encoding
_TILE = 4  # rows of the tiles in which rays are traced


def render_tiles(
    render: Callable[[Camera], Any],
    camera: Camera | Rays,
    path: str | Path,
    *,
    bits: int | None = None,
    memory: int | str = "256 MB",
    progress: Progress = no_progress,
) -> RenderStats:
    """Renders a picture of any size and writes it as it comes.

    - .tif: BigTIFF, Deflate; sRGB of 8 or 16 bits, or linear float of 32.
    - .npy: (h, w, 6) float32: linear color, alpha, depth, samples.

    Args:
        render: From the camera of a strip to its `Picture`, as `partial(gv.render, tree,
            shader=shader)` or `partial(engine.render, shader=shader)`; what it does to the picture,
            such as `tone_map`, must treat pixels one by one.
        camera: One camera; an orbit camera must be placed by what renders.
        path: The file; it appears when it is complete.
        bits: Of a number; 8 for .tif if left out.
        memory: Most bytes that a strip takes, but for scene and libraries; a strip has at least
            one row.
        progress: Told how many rows are done.

    Returns:
        Statistics of the last strip, with milliseconds, rays and samples of all.

    Raises:
        ValueError: The path ends in neither, the camera is a batch, or an argument is out of range.
        FileNotFoundError: The folder does not exist.
        ImportError: .tif without tifffile.
    """
    if not callable(render):
        raise ValueError(f"render_tiles: render must be callable, got {type(render).__name__}")
    path, camera = Path(path), as_camera("render_tiles", camera)
    if len(camera) != 1:
        raise ValueError(f"render_tiles: camera must be one, got a batch of {len(camera)}")
    bits = checked_path("render_tiles", path, bits, (".tif", ".npy"))
    limit = check.nbytes("render_tiles", "memory", memory)
    height, width = camera.height, camera.width
    rows = strip_rows(limit, width, height)
    stats: RenderStats | None = None

    def pictures() -> Iterator[Picture]:
        nonlocal stats
        for top in range(0, height, rows):
            end = min(top + rows, height)
            made = render(camera.strip(top, end))
            picture: Picture = made[0] if isinstance(made, tuple) else made
            stats = picture.stats if stats is None else picture.stats.after(stats)
            yield picture
            progress("rows", end, height)

    with whole_file(path) as part:
        strips = pictures()
        first = next(strips)
        everything = itertools.chain((first,), strips)
        if path.suffix == ".npy":
            _write_npy(part, everything, (height, width, 6))
        else:
            pixels = (_pixels(picture, bits) for picture in everything)
            kind = {8: np.uint8, 16: np.uint16, 32: np.float32}[bits]
            shape = (height, width, 4 if first.transparent else 3)
            write_tiff(part, shape, np.dtype(kind), pixels, rows)
    assert stats is not None
    return stats


def strip_rows(limit: int, width: int, height: int) -> int:
    """Returns how many rows of a picture are rendered at once within `limit` bytes."""
    most = limit // (_PIXEL_BYTES * width)
    return max(1, min(height, most - most % _TILE or most))


def _pixels(picture: Picture, bits: int) -> np.ndarray:
    rows = picture.color.shape[:-2].numel()
    layers = {
        name: layer.reshape(rows, *layer.shape[-2:]) for name, layer in picture.layers().items()
    }
    return tiff_pixels(layers, picture.transparent, bits)


def _write_npy(path: Path, pictures: Iterator[Picture], shape: tuple[int, ...]) -> None:
    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for picture in pictures:
            file.write(stacked(picture.layers()).astype("<f4").tobytes())
