"""Pictures of several renders: `Progressive` refines a picture of a camera at rest frame by frame;
`render_tiles` writes a picture strip by strip to a file, and the picture may exceed memory.

The first frame of a camera at rest samples the pixels' centres, each later frame another position
in every pixel: a point of Roberts' R2 sequence and, in the next frame, its mirror image through the
centre. So samples cover a pixel evenly after any number of frames, and linear variation across it
cancels out (antithetic sampling). The mean converges to the picture under a box filter.

Source: Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..base import check
from ..base.records import Rays, RenderStats
from ..base.stage import Progress, no_progress
from ..base.whole_file import whole_file
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from .files import checked_path, file_pixels, side_by_side, stacked, write_png_rows, write_tiff
from .overlay import Overlay
from .picture import Picture

_CENTRE_LAYERS = ("depth", "nearest", "normal", "features", "label")  # not averaged
_PLASTIC = 1.32471795724474602596  # the real root of x^3 = x + 1
STRIP = "256 MB"  # default memory of a strip
_PIXEL_BYTES = 400  # memory of a strip's pixel: rays (80), hits twice, layers and their encoding
_TILE_ROWS = 4  # rows of the tiles in which rays are traced


def jitter(index: int) -> tuple[float, float]:
    """Returns the offset (x, y) of a frame's samples from the pixels' centres, in [-1/2, 1/2]."""
    pair, sign = (index + 1) // 2, 1 if index % 2 else -1
    x, y = (sign * ((0.5 + pair / _PLASTIC**power) % 1 - 0.5) for power in (1, 2))
    return x, y


def _renderer(context: str, render: Callable[[Camera], Any]) -> Callable[[Camera], Picture]:
    """Wraps `render`, which may return statistics with its picture, to return the picture alone."""
    if not callable(render):
        raise ValueError(f"{context}: render must be callable, got {type(render).__name__}")

    def picture(camera: Camera) -> Picture:
        result = render(camera)
        result = result[0] if isinstance(result, tuple) else result
        return check.instance(context, "what render returns", result, Picture)

    return picture


class Progressive:
    """The running mean of jittered frames; does not wait for the device. For one thread at a time.

    Each ray's cone is as wide as `render` makes it: for a still of n samples give it a `cone_scale`
    of 4 / 3 / sqrt(n), so that several narrow rays resolve the detail within a pixel.

    A pixel's mean begins with its first frame without a miss, and leaves out later frames with one.
    Until then the pixel shows the newest frame. Module shaders have gradients through the mean:
    unless under `torch.no_grad`, the samples of all its frames stay in memory for them.

    Attributes:
        count: Frames since the camera moved.
    """

    def __init__(self, render: Callable[[Camera], Any]) -> None:
        """Takes a function from a camera to a `Picture`, or to a picture and statistics, such as
        `partial(gv.render, tree, shader=shader)`, `partial(engine.frame, shader=shader)` or the
        `replay` of a graph.
        """
        self._render = _renderer("Progressive", render)
        self.reset()

    def __repr__(self) -> str:
        return f"Progressive({self._camera}, {self.count} frames)"

    def reset(self) -> None:
        """Starts a new mean; call it when the scene or its shader has changed."""
        self.count = 0
        self._last_argument: Camera | Rays | None = None
        self._camera: Camera | None = None

    def frame(self, camera: Camera | Rays) -> Picture:
        """Renders one more frame, the first of a new mean if the camera moved.

        Returns:
            The mean of colour and alpha so far, summed in float64. Depth, nearest, normal, features
            and label are those of the pixel's first frame without a miss (frame 0: its centre);
            `samples` and `stats` are those of this frame; `missed` is true where every frame so far
            had a miss. The first picture equals the plain one to the last bit.
        """
        if self._camera is None or camera is not self._last_argument:
            converted = as_camera("Progressive", camera)
            if self._camera is None or not converted.same(self._camera):
                self.reset()
            self._last_argument, self._camera = camera, converted
        current_camera = self._camera
        if self.count:
            current_camera = current_camera.shifted(*jitter(self.count), sample=self.count)
        picture = self._render(current_camera)
        rgba = torch.cat((picture.color, picture.alpha), -1).double()
        missed = picture.missed
        complete = torch.ones_like(picture.alpha, dtype=torch.bool) if missed is None else ~missed
        layers = {name: getattr(picture, name) for name in _CENTRE_LAYERS}
        centre_layers = {name: image for name, image in layers.items() if image is not None}
        if not self.count:
            self._sum, self._complete_frames = rgba, complete.double()
            self._centre_layers = {name: image.clone() for name, image in centre_layers.items()}
        else:
            has_mean = self._complete_frames > 0
            # A pixel without a whole frame yet shows the newest one; others add whole frames only.
            mean_sum = torch.where(complete, self._sum + rgba, self._sum)
            self._sum = torch.where(has_mean, mean_sum, rgba)
            for name, image in centre_layers.items():
                self._centre_layers[name] = torch.where(has_mean, self._centre_layers[name], image)
            self._complete_frames = self._complete_frames + complete
        self.count += 1
        mean = (self._sum / self._complete_frames.clamp(min=1)).to(picture.color.dtype)
        layers = {"color": mean[..., :3], "alpha": mean[..., 3:], **self._centre_layers}
        return replace(picture, missed=self._complete_frames == 0, **layers)

    def refine(self, camera: Camera | Rays, samples: int) -> Picture:
        """Renders frames, at least one, until there are `samples` of this camera, and returns their
        mean; earlier frames of the same camera count.

        Raises:
            ValueError: `samples` is no whole number >= 1.
        """
        target = check.integer("Progressive", "samples", samples, low=1)
        camera = as_camera("Progressive", camera)
        while True:
            picture = self.frame(camera)
            if self.count >= target:
                return picture


def render_tiles(
    render: Callable[[Camera], Any],
    camera: Camera | Rays,
    path: str | Path,
    *,
    bits: int | None = None,
    memory: int | str = STRIP,
    overlay: Overlay | None = None,
    progress: Progress = no_progress,
) -> RenderStats:
    """Renders a picture of any size and writes it strip by strip.

    - .png: sRGB of 8 or 16 bits.
    - .tif: BigTIFF, Deflate; sRGB of 8 or 16 bits, or linear float of 32.
    - .npy: (h, w, 6) float32: linear color, alpha, depth, samples.

    Args:
        render: Renders a strip's camera to its `Picture`, such as `partial(gv.render, tree,
            shader=shader)` or `partial(engine.render, shader=shader)`; what it does to the picture,
            such as `tone_map`, must treat pixels one by one.
        camera: One camera; `render` must place an orbit camera.
        path: The file; it appears when it is complete.
        bits: Bits of a number; 8 for .png and .tif if left out.
        overlay: Annotations over the picture.
        memory: Most bytes for a strip (of at least one row), without scene and libraries.
        progress: Called with the number of finished rows.

    Returns:
        Statistics of the last strip, but milliseconds, rays and samples summed over all strips.

    Raises:
        ValueError: The path ends in none of these, the camera is a batch, or a number is wrong.
        FileNotFoundError: The folder does not exist.
        ImportError: .tif without tifffile.
    """
    picture_of = _renderer("render_tiles", render)
    path, camera = Path(path), as_camera("render_tiles", camera)
    if len(camera) != 1:
        raise ValueError(f"render_tiles: camera must be one, got a batch of {len(camera)}")
    bits = checked_path("render_tiles", path, bits, (".png", ".tif", ".npy"))
    height, width = camera.height, camera.width
    rows = strip_rows(check.nbytes("render_tiles", "memory", memory), width, height)
    stats: RenderStats | None = None

    def pictures() -> Iterator[Picture]:
        nonlocal stats
        for top in range(0, height, rows):
            end = min(top + rows, height)
            picture = picture_of(camera.strip(top, end))
            stats = picture.stats if stats is None else picture.stats.after(stats)
            yield picture if overlay is None else overlay.over(picture, top)
            progress("rows", end, height)

    with torch.no_grad(), whole_file(path) as part:
        _write_strips(part, path.suffix, pictures(), bits, (height, width), rows)
    assert stats is not None
    return stats


def _write_strips(
    part: Path,
    suffix: str,
    strips: Iterator[Picture],
    bits: int,
    size: tuple[int, int],
    rows: int,
) -> None:
    """Writes strips of `rows` rows, of which the last may have fewer, as they come."""
    first = next(strips)
    all_strips = itertools.chain((first,), strips)
    if suffix == ".npy":
        header = {"descr": "<f4", "fortran_order": False, "shape": (*size, 6)}
        with part.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, header)
            for picture in all_strips:
                file.write(stacked(picture.layers()).astype("<f4").tobytes())
        return
    pixels = (file_pixels(side_by_side(p.layers()), p.transparent, bits) for p in all_strips)
    shape = (*size, 4 if first.transparent else 3)
    if suffix == ".png":
        write_png_rows(part, shape, bits, pixels)
    else:
        dtype = {8: np.uint8, 16: np.uint16, 32: np.float32}[bits]
        write_tiff(part, shape, np.dtype(dtype), pixels, rows)


def strip_rows(limit: int, width: int, height: int) -> int:
    """Returns how many rows of a picture are rendered at once within `limit` bytes."""
    rows = limit // (_PIXEL_BYTES * width)
    return max(1, min(height, rows - rows % _TILE_ROWS or rows))
