"""Orientation letters at the edges of slices: R right, L left, A front, P back, S head, I feet."""

from __future__ import annotations

import numpy as np

#: Letters of 5 x 7 pixels: the bits of each row as a number.
_GLYPH_ROWS = {
    "A": (14, 17, 17, 31, 17, 17, 17),
    "I": (14, 4, 4, 4, 4, 4, 14),
    "L": (16, 16, 16, 16, 16, 16, 31),
    "P": (30, 17, 17, 30, 16, 16, 16),
    "R": (30, 17, 17, 30, 20, 18, 17),
    "S": (15, 16, 16, 14, 1, 1, 30),
}
_MIN_SIDE = 40  # pixels: a smaller plane has no room


def draw_letters(image: np.ndarray, letters: str, shortest_side: int) -> None:
    """Draws four letters into an image (h, w, 3), white on black: at its top, right, bottom and
    left edge. An image without room for them stays as it is. The letters' size follows the shortest
    side (pixels) of the images that are shown together.
    """
    height, width, _ = image.shape
    if min(height, width) < _MIN_SIDE:
        return
    size = max(1, shortest_side // 160)  # pixels of a dot
    for edge, letter in zip(((0, 1), (1, 2), (2, 1), (1, 0)), letters, strict=True):
        dots = np.array([[row >> (4 - bit) & 1 for bit in range(5)] for row in _GLYPH_ROWS[letter]])
        stamp = np.pad(dots, 1).repeat(size, 0).repeat(size, 1).astype(image.dtype)
        free = height - stamp.shape[0] - 2 * size, width - stamp.shape[1] - 2 * size
        y, x = (size + halves * room // 2 for halves, room in zip(edge, free, strict=True))
        image[y : y + stamp.shape[0], x : x + stamp.shape[1]] = stamp[..., None]
