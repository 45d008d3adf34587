"""`Overlay`: annotations of a picture: a colour bar, a scale bar, a text. They are white with a
dark rim, or black with a light one, and their size follows the picture's.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.messages import need_library
from ..base.units import length_unit, metres, unit_symbol
from .files import display_pixels
from .picture import Picture
from .tone import from_srgb

_LETTERS_PER_SIDE = 36  # the picture's shorter side, in heights of a letter
_MIN_LETTER_SIZE = 9  # pixels of a letter
_BAR_FRACTION = 0.45  # height of a colour bar, as a fraction of the picture's height
_SCALE_FRACTION = 0.25  # greatest length of a scale bar, as a fraction of the picture's width
_MAX_TICKS = 6  # most ticks of a colour bar
_FEWEST, _MOST = 1e-3, 1e4  # lengths that a scale bar tells in the data's own unit
_METRIC_UNITS = ("kilometer", "meter", "millimeter", "micrometer", "nanometer", "picometer")
_INKS = {"white": (255, 255, 255), "black": (0, 0, 0)}
_RIM_ALPHA = 200  # of 255
#: Letters of units that Pillow's font lacks, and those that they are drawn as, some with a mark.
_SUBSTITUTES = str.maketrans("\u00b5\u03bc\u00c5\u212b\u2212\u2013", "uuAA--")


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
        check.instance("ColorBar", "title", self.title, str)
        if not callable(self.colors):
            raise ValueError(f"ColorBar: colors must be callable, got {check.as_text(self.colors)}")
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
        ink: Literal["white", "black"] = "white",
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
            ink: Colour of letters and lines: black, with a light rim, is for light pictures.

        Raises:
            ValueError: The picture is too small for them, or a number is out of its range.
            ImportError: Pillow is not installed.
        """
        width = check.integer("Overlay", "width", width, low=1)
        height = check.integer("Overlay", "height", height, low=1)
        check.one_of("Overlay", "ink", ink, tuple(_INKS))
        self._size = (width, height)
        letter_size = max(_MIN_LETTER_SIZE, round(min(width, height) / _LETTERS_PER_SIDE))
        self._pen = _Pen(letter_size, ink)
        self._stamps: list[_Stamp] = []
        for name, value, kind in (("text", text, str), ("unit", unit, str), ("bar", bar, ColorBar)):
            if value is not None:
                check.instance("Overlay", name, value, kind)
        if text:
            self._add_stamp(self._pen.text_lines(text), top=self._pen.size, left=self._pen.size)
        if pixel is not None:
            pixel = check.number("Overlay", "pixel", pixel, low=0, open_low=True)
            image = self._pen.scale_bar(_SCALE_FRACTION * width, pixel, unit)
            top = height - image.shape[0] - self._pen.size
            self._add_stamp(image, top=top, left=self._pen.size)
        if bar is not None:
            image = self._pen.color_bar(bar, round(_BAR_FRACTION * height))
            top = (height - image.shape[0]) // 2
            self._add_stamp(image, top=top, left=width - image.shape[1] - self._pen.size)

    def __repr__(self) -> str:
        return f"Overlay({self._size[0]}x{self._size[1]}, {len(self._stamps)} annotations)"

    def _add_stamp(self, image: np.ndarray, *, top: int, left: int) -> None:
        """Adds a stamp, sRGB with straight alpha, (h, w, 4) uint8."""
        height, width = image.shape[:2]
        if top < 0 or left < 0 or top + height > self._size[1] or left + width > self._size[0]:
            picture_size = "x".join(map(str, self._size))
            raise ValueError(
                f"Overlay: a picture of {picture_size} has no room for what is drawn over it, "
                f"which takes {width}x{height} and some beside it"
            )
        rgba = torch.from_numpy(image.astype(np.float32) / 255)
        self._stamps.append(_Stamp(top, left, from_srgb(rgba[..., :3]), rgba[..., 3:]))

    def over(self, picture: Picture, first: int = 0) -> Picture:
        """Returns the picture, (h, w, ...), with the annotations over its colour and alpha.

        Args:
            picture: A picture of the overlay's size, or a strip of its rows.
            first: Number of the strip's first row.
        """
        height, width = picture.color.shape[-3:-1]
        if picture.color.dim() != 3 or width != self._size[0]:
            raise ValueError(f"Overlay: picture must be {self._size[0]} wide, got {width}x{height}")
        color, alpha = picture.color.clone(), picture.alpha.clone()
        for stamp in self._stamps:
            top, bottom = max(stamp.top, first), min(stamp.top + len(stamp.alpha), first + height)
            if top >= bottom:
                continue
            rows = slice(top - stamp.top, bottom - stamp.top)
            coverage, stamp_color = stamp.alpha[rows].to(color), stamp.color[rows].to(color)
            columns = slice(stamp.left, stamp.left + coverage.shape[1])
            region = (slice(top - first, bottom - first), columns)
            color[region] = color[region] * (1 - coverage) + stamp_color * coverage
            alpha[region] = alpha[region] * (1 - coverage) + coverage
        return replace(picture, color=color, alpha=alpha)


class _Pen:
    """Draws with Pillow, in letters of one size (pixels) and colour."""

    def __init__(self, size: int, ink: str) -> None:
        need_library("Overlay", "PIL", "Pillow", "image")
        from PIL import Image, ImageDraw, ImageFont

        self.size, self._image, self._draw = size, Image, ImageDraw
        self._font: Any = ImageFont.load_default(size)
        self._rim = self._line = max(1, round(size / 9))
        rim_ink = next(name for name in _INKS if name != ink)
        self._ink, self._rim_ink = (*_INKS[ink], 255), (*_INKS[rim_ink], _RIM_ALPHA)

    def _new_sheet(self, width: float, height: float) -> Any:
        return self._image.new("RGBA", (math.ceil(width), math.ceil(height)), (0, 0, 0, 0))

    def _text_width(self, text: str) -> float:
        lines = text.translate(_SUBSTITUTES).split("\n")
        return max(float(self._font.getlength(line)) for line in lines)

    def _write_line(
        self, sheet: Any, position: tuple[float, float], text: str, anchor: str = "la"
    ) -> None:
        plain, draw = text.translate(_SUBSTITUTES), self._draw.Draw(sheet)
        left, top, *_ = draw.textbbox(position, plain, font=self._font, anchor=anchor)
        bearing, height, *_ = self._font.getbbox(plain, anchor="ls")
        for fill, rim in ((self._rim_ink, self._rim), (self._ink, 0)):
            draw.text(position, plain, font=self._font, fill=fill, stroke_width=rim, anchor=anchor)
            for place, mark in ((n, _MARKS[m]) for n, m in enumerate(text) if m in _MARKS):
                origin = left - bearing + self._font.getlength(plain[:place]), top - height
                sheet.paste(
                    fill, (0, 0), self._image.fromarray(mark(self, sheet.size, origin, rim))
                )

    def _mask(
        self, size: tuple[int, int], origin: tuple[float, float], letter: str, rim: int = 0
    ) -> np.ndarray:
        """Returns what a letter covers of a sheet, (h, w) uint8, if its baseline begins there."""
        sheet = self._image.new("L", size)
        options = {"font": self._font, "fill": 255, "stroke_width": rim, "anchor": "ls"}
        self._draw.Draw(sheet).text(origin, letter, **options)
        return np.array(sheet)

    def _stem(self, size: tuple[int, int], origin: tuple[float, float], rim: int) -> np.ndarray:
        """Returns what the stem of a p covers, which makes a u a micro sign."""
        letter = self._mask(size, origin, "p")
        lowest_row = letter[np.flatnonzero(letter.any(1))[-1]]  # it crosses the stem alone
        first, last = np.flatnonzero(lowest_row)[[0, -1]]
        mask = self._mask(size, origin, "p", rim)
        mask[:, : max(0, first - rim)] = mask[:, last + 1 + rim :] = 0
        return mask

    def _ring(self, size: tuple[int, int], origin: tuple[float, float], rim: int) -> np.ndarray:
        """Returns what a ring covers that stands on an A."""
        x, y = origin
        x += (self._text_width("A") - self._text_width("\u00b0")) / 2
        bottom = np.flatnonzero(self._mask(size, (x, y), "\u00b0").any(1))[-1]
        top = np.flatnonzero(self._mask(size, origin, "A").any(1))[0]
        return self._mask(size, (x, y - float(bottom - top)), "\u00b0", rim)

    def text_lines(self, text: str) -> np.ndarray:
        """Returns lines of text, (h, w, 4)."""
        text = text.replace("\\n", "\n")
        self._warn_of_missing(text)
        lines = text.split("\n")
        step = round(1.35 * self.size)
        rim = self._rim
        sheet = self._new_sheet(self._text_width(text) + 2 * rim, step * len(lines) + 2 * rim)
        for number, line in enumerate(lines):
            self._write_line(sheet, (rim, rim + number * step), line)
        return np.asarray(sheet)

    def _warn_of_missing(self, text: str) -> None:
        """Warns of characters that the font lacks and draws as boxes."""
        placeholder = bytes(self._font.getmask("\uffff"))
        letters = sorted({letter for letter in text.translate(_SUBSTITUTES) if letter.strip()})
        missing = [n for n in letters if bytes(self._font.getmask(n)) == placeholder]
        if missing:
            warnings.warn(f"the font of pictures has no {' '.join(missing)}", stacklevel=4)

    def scale_bar(self, limit: float, pixel: float, unit: str | None) -> np.ndarray:
        """Returns a scale bar at most `limit` pixels long, (h, w, 4)."""
        length = _round_below(limit * pixel)
        width = length / pixel
        label = _length_text(length, unit)
        self._warn_of_missing(label)
        rim, tick = self._rim, round(0.5 * self.size)
        label_width = self._text_width(label)
        sheet_width = max(width, label_width) + 2 * (rim + self._line)
        sheet = self._new_sheet(sheet_width, 2.3 * self.size + 2 * rim)
        left, right = rim + self._line, rim + self._line + width
        base = sheet.height - rim - self._line - 1
        lines: list[Any] = [((left, base), (right, base))]
        lines += [((x, base - tick), (x, base)) for x in (left, right)]
        self._draw_lines(sheet, lines)
        middle = max(left + width / 2, rim + label_width / 2)
        self._write_line(sheet, (middle, base - tick), label, "mb")
        return np.asarray(sheet)

    def _draw_lines(self, sheet: Any, lines: list[Any]) -> None:
        draw = self._draw.Draw(sheet)
        for color, extra in ((self._rim_ink, 2 * self._rim), (self._ink, 0)):
            width = self._line + extra
            for (ax, ay), (bx, by) in lines:
                left, top = ax - width / 2, ay - width / 2
                right, bottom = bx + width / 2 - 1, by + width / 2 - 1
                draw.rectangle((left, top, max(left, right), max(top, bottom)), fill=color)

    def color_bar(self, bar: ColorBar, height: int) -> np.ndarray:
        """Returns a colour bar `height` pixels high, numbers to its left and the title above it."""
        ticks = _ticks(bar.low, bar.high)
        labels = _labels(ticks)
        size, rim, line = self.size, self._rim, self._line
        left = max(self._text_width(label) for label in labels) + size
        width = max(left + size + 2 * line, self._text_width(bar.title)) + 2 * rim
        top = 2 * size if bar.title else size
        sheet = self._new_sheet(width, top + height + size)
        left = sheet.width - size - line - rim
        for value, label in zip(ticks, labels, strict=True):
            y = top + (bar.high - value) / (bar.high - bar.low) * (height - 1)
            self._draw_lines(sheet, [((left - 0.45 * size, y), (left - line, y))])
            self._write_line(sheet, (left - 0.75 * size, y), label, "rm")
        edge = (left - line, top - line, left + size + line - 1, top + height + line - 1)
        x0, y0, x1, y1 = edge
        draw = self._draw.Draw(sheet)
        draw.rectangle((x0 - rim, y0 - rim, x1 + rim, y1 + rim), fill=self._rim_ink)
        draw.rectangle(edge, fill=self._ink)
        values = np.linspace(bar.high, bar.low, height)
        colors = torch.from_numpy(np.asarray(bar.colors(values), np.float32)[:, :3])
        rows = display_pixels(colors[:, None], None, 8).repeat(size, 1)
        sheet.paste(self._image.fromarray(rows), (left, top))
        if bar.title:
            self._warn_of_missing(bar.title)
            self._write_line(sheet, (sheet.width - rim - 1, top - 0.6 * size), bar.title, "rb")
        return np.asarray(sheet)


#: The marks of letters that the font lacks.
_MARKS = {
    **dict.fromkeys("\u00b5\u03bc", _Pen._stem),
    **dict.fromkeys("\u00c5\u212b", _Pen._ring),
}


def _round_below(length: float) -> float:
    """Returns the largest 1, 2 or 5 times a power of ten that is not above a length."""
    power = _power(length)
    return max(n * power for n in (1, 2, 5) if n * power <= length * (1 + 1e-12))


def _length_text(length: float, unit: str | None) -> str:
    """Returns a length as text; if its unit is known, one of many digits in another metric unit."""
    size = metres(length_unit(unit) or "")
    if size is not None and not _FEWEST <= length < _MOST:
        in_metres = length * size * (1 + 1e-9)
        fitting = [n for n in _METRIC_UNITS if (metres(n) or 0.0) <= in_metres]
        unit = fitting[0] if fitting else _METRIC_UNITS[-1]
        length *= size / (metres(unit) or 1.0)
    return f"{length:g} {unit_symbol(unit)}".rstrip()


def _ticks(low: float, high: float) -> list[float]:
    """Returns round values from low to high, as many as possible but at most `_MAX_TICKS`."""
    power = _power((high - low) / _MAX_TICKS)
    for step in (n * power for n in (1, 2, 5, 10, 20)):
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if last - first < _MAX_TICKS:
            break
    return [n * step for n in range(first, last + 1)]


def _labels(ticks: list[float]) -> list[str]:
    """Returns the ticks as text, with six digits, or as many as tell them apart."""
    for digits in range(6, 18):
        labels = [f"{value:.{digits}g}" for value in ticks]
        if len({*labels}) == len(ticks):
            break
    return labels


def _power(length: float) -> float:
    """Returns the largest power of ten that is not above a length."""
    return 10.0 ** math.floor(math.log10(length))
