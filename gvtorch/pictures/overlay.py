"""`Overlay`: annotations of a picture: a colour bar, a scale bar, a text. They are white with a
dark rim, so that they are legible on any picture, and their size follows the picture's.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.messages import need_library
from ..base.units import unit_symbol
from .files import display_pixels
from .picture import Picture
from .tone import from_srgb

_PART = 36  # the picture's shorter side, in heights of a letter
_SMALLEST = 9  # pixels of a letter
_BAR = 0.45  # height of a colour bar, as a share of the picture's height
_SCALE = 0.25  # greatest length of a scale bar, as a share of the picture's width
_TICKS = 6  # most ticks of a colour bar


@dataclass(frozen=True, kw_only=True)
class ColorBar:
    """A colour bar: the colours of a range of values, and a title.

    Attributes:
        colors: Maps values (k,) to linear RGB and more, (k, 3 or 4), as a `TransferFunction` does.
        low: Value at the bar's lower end.
        high: Value at its upper end.
        title: Text above the bar, which says what the values are.
    """

    colors: Callable[[np.ndarray], np.ndarray]
    low: float
    high: float
    title: str = ""

    def __post_init__(self) -> None:
        low = check.number("ColorBar", "low", self.low)
        if check.number("ColorBar", "high", self.high) <= low:
            raise ValueError(f"ColorBar: high must be > low, got {low:g} and {self.high:g}")


class _Stamp(NamedTuple):
    top: int  # rows and columns of the picture
    left: int
    color: Tensor  # (h, w, 3) linear
    alpha: Tensor  # (h, w, 1)


class Overlay:
    """Draws annotations over pictures of one size, or over strips of such a picture."""

    def __init__(
        self,
        width: int,
        height: int,
        *,
        bar: ColorBar | None = None,
        pixel: float | None = None,
        unit: str | None = None,
        text: str | None = None,
    ) -> None:
        """Prepares the annotations.

        Args:
            width: Pixels of the whole picture.
            height: Pixels.
            bar: A colour bar at the right edge.
            pixel: Width of a pixel in world units, for a scale bar at the lower left; in
                perspective it holds at one distance only, see `Camera.pixel_width`.
            unit: Unit of `pixel`, as in `ImageInfo.unit`.
            text: Lines at the upper left.

        Raises:
            ValueError: The picture is too small for them, or a number is out of its range.
            ImportError: Pillow is not installed.
        """
        self._size = (width, height)
        self._pen = _Pen(max(_SMALLEST, round(min(width, height) / _PART)))
        self._stamps: list[_Stamp] = []
        if text:
            self._put(self._pen.text(text), top=self._pen.size, left=self._pen.size)
        if pixel is not None:
            pixel = check.number("Overlay", "pixel", pixel, low=0, open_low=True)
            made = self._pen.scale(_SCALE * width, pixel, unit)
            self._put(made, top=height - made.shape[0] - self._pen.size, left=self._pen.size)
        if bar is not None:
            made = self._pen.bar(bar, round(_BAR * height))
            top = (height - made.shape[0]) // 2
            self._put(made, top=top, left=width - made.shape[1] - self._pen.size)

    def _put(self, image: np.ndarray, *, top: int, left: int) -> None:
        """Adds a stamp, sRGB with straight alpha, (h, w, 4) uint8."""
        height, width = image.shape[:2]
        if top < 0 or left < 0 or top + height > self._size[1] or left + width > self._size[0]:
            have = "x".join(map(str, self._size))
            raise ValueError(
                f"Overlay: a picture of {have} has no room for what is drawn over it, which takes "
                f"{width}x{height} and some beside it"
            )
        parts = torch.from_numpy(image.astype(np.float32) / 255)
        self._stamps.append(_Stamp(top, left, from_srgb(parts[..., :3]), parts[..., 3:]))

    def over(self, picture: Picture, first: int = 0) -> Picture:
        """Returns the picture, (h, w, ...), with the annotations over its colour and alpha.

        Args:
            picture: A picture of the overlay's size, or a strip of its rows.
            first: Number of the strip's first row.
        """
        height, width = picture.color.shape[-3:-1]
        if picture.color.dim() != 3 or width != self._size[0]:
            raise ValueError(
                f"Overlay: the picture must be {self._size[0]} wide, got {width}x{height}"
            )
        color, alpha = picture.color.clone(), picture.alpha.clone()
        for stamp in self._stamps:
            begin, end = max(stamp.top, first), min(stamp.top + len(stamp.alpha), first + height)
            if begin >= end:
                continue
            rows = slice(begin - stamp.top, end - stamp.top)
            share, light = stamp.alpha[rows].to(color), stamp.color[rows].to(color)
            at = (slice(begin - first, end - first), slice(stamp.left, stamp.left + share.shape[1]))
            color[at] = color[at] * (1 - share) + light * share
            alpha[at] = alpha[at] * (1 - share) + share
        return replace(picture, color=color, alpha=alpha)


class _Pen:
    """Draws with Pillow, in letters of one size (pixels)."""

    def __init__(self, size: int) -> None:
        need_library("Overlay", "PIL", "Pillow", "image")
        from PIL import Image, ImageDraw, ImageFont

        self.size, self._image, self._draw = size, Image, ImageDraw
        self._font: Any = ImageFont.load_default(size)
        self._rim = max(1, round(size / 9))
        self._line = max(1, round(size / 9))

    def _sheet(self, width: float, height: float) -> Any:
        sheet = self._image.new("RGBA", (math.ceil(width), math.ceil(height)), (0, 0, 0, 0))
        return sheet, self._draw.Draw(sheet)

    def _wide(self, text: str) -> float:
        return max(float(self._font.getlength(line)) for line in text.split("\n"))

    def _write(self, draw: Any, at: tuple[float, float], text: str, anchor: str = "la") -> None:
        options = {"stroke_width": self._rim, "stroke_fill": (0, 0, 0, 200), "anchor": anchor}
        draw.text(at, text, font=self._font, fill=(255, 255, 255, 255), **options)

    def text(self, text: str) -> np.ndarray:
        """Returns lines of text, (h, w, 4)."""
        text = text.replace("\\n", "\n")
        self._warn_of_missing(text)
        lines = text.split("\n")
        step = round(1.35 * self.size)
        rim = self._rim
        sheet, draw = self._sheet(self._wide(text) + 2 * rim, step * len(lines) + 2 * rim)
        for number, line in enumerate(lines):
            self._write(draw, (rim, rim + number * step), line)
        return np.asarray(sheet)

    def _warn_of_missing(self, text: str) -> None:
        """Warns of characters that the font lacks and draws as boxes."""
        box = bytes(self._font.getmask("\uffff"))
        lacks = sorted(
            {one for one in text if one.strip() and bytes(self._font.getmask(one)) == box}
        )
        if lacks:
            warnings.warn(f"the font of pictures has no {' '.join(lacks)}", stacklevel=4)

    def scale(self, most: float, pixel: float, unit: str | None) -> np.ndarray:
        """Returns a scale bar at most `most` pixels long, (h, w, 4)."""
        length = _round_below(most * pixel)
        wide = length / pixel
        label = f"{length:g} {unit_symbol(unit)}".rstrip()
        rim, tick = self._rim, round(0.5 * self.size)
        text = self._wide(label)
        sheet, draw = self._sheet(
            max(wide, text) + 2 * (rim + self._line), 2.3 * self.size + 2 * rim
        )
        left, right = rim + self._line, rim + self._line + wide
        base = sheet.height - rim - self._line - 1
        lines: list[Any] = [((left, base), (right, base))]
        lines += [((x, base - tick), (x, base)) for x in (left, right)]
        self._lines(draw, lines)
        middle = max(left + wide / 2, rim + text / 2)
        self._write(draw, (middle, base - tick), label, "mb")
        return np.asarray(sheet)

    def _lines(self, draw: Any, lines: list[Any]) -> None:
        for color, more in (((0, 0, 0, 200), 2 * self._rim), ((255, 255, 255, 255), 0)):
            wide = self._line + more
            for (ax, ay), (bx, by) in lines:
                left, top = ax - wide / 2, ay - wide / 2
                right, bottom = bx + wide / 2 - 1, by + wide / 2 - 1
                draw.rectangle((left, top, max(left, right), max(top, bottom)), fill=color)

    def bar(self, bar: ColorBar, high: int) -> np.ndarray:
        """Returns a colour bar `high` pixels high, numbers to its left and the title above it."""
        ticks = _ticks(bar.low, bar.high)
        labels = [f"{value:g}" for value in ticks]
        size, rim, line = self.size, self._rim, self._line
        left = max(self._wide(label) for label in labels) + size
        wide = max(left + size + 2 * line, self._wide(bar.title)) + 2 * rim
        top = 2 * size if bar.title else size
        sheet, draw = self._sheet(wide, top + high + size)
        left = sheet.width - size - line - rim
        for value, label in zip(ticks, labels, strict=True):
            y = top + (bar.high - value) / (bar.high - bar.low) * (high - 1)
            self._lines(draw, [((left - 0.45 * size, y), (left - line, y))])
            self._write(draw, (left - 0.75 * size, y), label, "rm")
        edge = (left - line, top - line, left + size + line - 1, top + high + line - 1)
        a, b, c, d = edge
        draw.rectangle((a - rim, b - rim, c + rim, d + rim), fill=(0, 0, 0, 200))
        draw.rectangle(edge, fill=(255, 255, 255, 255))
        values = np.linspace(bar.high, bar.low, high)
        colors = torch.from_numpy(np.asarray(bar.colors(values), np.float32)[:, :3])
        rows = display_pixels(colors[:, None], None, 8).repeat(size, 1)
        sheet.paste(self._image.fromarray(rows), (left, top))
        if bar.title:
            self._warn_of_missing(bar.title)
            self._write(draw, (sheet.width - rim - 1, top - 0.6 * size), bar.title, "rb")
        return np.asarray(sheet)


def _round_below(length: float) -> float:
    """Returns the largest 1, 2 or 5 times a power of ten that is not above a length."""
    power = _power(length)
    return max(n * power for n in (1, 2, 5) if n * power <= length * (1 + 1e-12))


def _ticks(low: float, high: float) -> list[float]:
    """Returns round values from low to high, as many as possible but at most `_TICKS`."""
    least = _power((high - low) / _TICKS)
    for step in (n * least for n in (1, 2, 5, 10, 20)):
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if last - first < _TICKS:
            break
    return [n * step for n in range(first, last + 1)]


def _power(length: float) -> float:
    """Returns the largest power of ten that is not above a length."""
    return 10.0 ** math.floor(math.log10(length))
