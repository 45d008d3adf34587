"""`Video`: writes pictures as a film: H.264 by PyAV, or a looping GIF or WebP by Pillow."""

from __future__ import annotations

import itertools
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ..base import check
from ..base.messages import need_library
from ..base.whole_file import whole_file
from .picture import Picture

#: Endings of films, and the most pixels of a side that their encoders take.
FILM_SIDES = {".mp4": 16384, ".gif": 65535, ".webp": 16383}
#: Of sRGB, as PyAV converts it (ITU-T H.273): BT.709 primaries, sRGB curve, BT.601 matrix, limited.
_H264_COLOR = {"color_primaries": 1, "color_trc": 13, "colorspace": 6, "color_range": 1}
_MAX_GIF_FPS = 50  # pictures a second; viewers play faster ones slowly
_PALETTE_FRAMES = 16  # pictures from which the colours of a GIF are taken


class Video:
    """A film of pictures of one size, written by one thread; the file appears when complete:

    with gv.Video("turn.mp4", 640, 480, fps=25) as video:
        video.add(picture)
    """

    def __init__(self, path: str | Path, width: int, height: int, *, fps: int = 25) -> None:
        """Prepares the film; .gif and .webp loop, and stay in memory until they are written.

        Args:
            path: The file: .mp4, .gif or .webp.
            width: Pixels, at most those of `FILM_SIDES`; even for .mp4.
            height: Pixels, likewise.
            fps: Pictures a second; at most 50 for .gif.

        Raises:
            ValueError: The ending is unknown, or does not allow the size or the frame rate.
            FileNotFoundError: The folder does not exist.
            ImportError: The library for this kind of film is missing.
        """
        self._path, self._size = Path(path), (width, height)
        suffix = self._path.suffix
        if suffix not in FILM_SIDES:
            suffixes = ", ".join(FILM_SIDES)
            raise ValueError(f"Video: path must end in {suffixes}, got {str(path)!r}")
        if not self._path.parent.is_dir():
            raise FileNotFoundError(f"folder not found: {self._path.parent}")
        check.integer("Video", "fps", fps, low=1, high=_MAX_GIF_FPS if suffix == ".gif" else 1000)
        for name, pixels in (("width", width), ("height", height)):
            check.integer("Video", name, pixels, low=1, high=FILM_SIDES[suffix])
        if suffix == ".mp4" and (width % 2 or height % 2):
            raise ValueError(f"Video: size must be even for .mp4, got {width}x{height}")
        self._stack: ExitStack | None = None  # while the film is open
        self._film = _Mp4(width, height, fps) if suffix == ".mp4" else _LoopingFilm(suffix, fps)

    def add(self, picture: Picture) -> None:
        """Appends a picture.

        Raises:
            ValueError: It is of another size, or a batch.
            RuntimeError: This is called outside the `with` block.
        """
        if self._stack is None:
            raise RuntimeError("Video: pictures can be added within its with block only")
        pixels = check.instance("Video", "picture", picture, Picture).to_srgb8().numpy()
        width, height = self._size
        if pixels.shape != (height, width, 3):
            raise ValueError(f"Video: picture must be ({height}, {width}, 3), got {pixels.shape}")
        self._film.add(pixels)
        self._count += 1

    def __enter__(self) -> Video:
        with ExitStack() as stack:  # closes the file if the film can't be opened
            self._film.open(stack.enter_context(whole_file(self._path)))
            stack.push(self._close)
            self._stack, self._count = stack.pop_all(), 0
        return self

    def _close(self, error_type: type[BaseException] | None, *_: object) -> None:
        self._film.close(complete=error_type is None and self._count > 0)
        if error_type is None and not self._count:
            raise ValueError(f"Video: no picture was added to {str(self._path)!r}")

    def __exit__(self, *error: Any) -> None:
        """Finishes the file, or deletes it after an error; without pictures raises ValueError."""
        stack, self._stack = self._stack, None
        if stack is not None:
            stack.__exit__(*error)

    def __repr__(self) -> str:
        return f"Video({str(self._path)!r}, {self._size[0]}x{self._size[1]})"


class _Mp4:
    """Writes pictures, (h, w, 3) sRGB uint8, as they come, by PyAV."""

    def __init__(self, width: int, height: int, fps: int) -> None:
        self._av = need_library(".mp4", "av", "PyAV", "video")
        self._size, self._fps = (width, height), fps

    def open(self, part: Path) -> None:
        self._file = self._av.open(str(part), "w")
        self._stream: Any = self._file.add_stream("libx264", rate=self._fps)
        self._stream.width, self._stream.height = self._size
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "18"}
        for name, code in _H264_COLOR.items():  # else players guess by the size of the film
            setattr(self._stream.codec_context, name, code)

    def add(self, pixels: np.ndarray) -> None:
        frame = self._av.VideoFrame.from_ndarray(pixels, format="rgb24")
        self._file.mux(self._stream.encode(frame))

    def close(self, *, complete: bool) -> None:
        try:
            if complete:
                self._file.mux(self._stream.encode())
        finally:
            self._file.close()


class _LoopingFilm:
    """Keeps the pictures until the film is complete; then Pillow writes it."""

    def __init__(self, suffix: str, fps: int) -> None:
        need_library(suffix, "PIL", "Pillow", "video")
        from PIL import Image

        self._image: Any = Image
        self._suffix, self._fps = suffix, fps

    def open(self, part: Path) -> None:
        self._part, self._frames = part, list[Any]()

    def add(self, pixels: np.ndarray) -> None:
        self._frames.append(self._image.fromarray(pixels))

    def close(self, *, complete: bool) -> None:
        if not complete or not self._frames:
            return
        unit_ms = 10 if self._suffix == ".gif" else 1  # a GIF counts in hundredths of a second
        frames = self._frames
        ends = [round(1000 * n / self._fps / unit_ms) * unit_ms for n in range(len(frames) + 1)]
        durations = [b - a for a, b in itertools.pairwise(ends)]
        options: dict[str, Any] = {"quality": 90, "method": 4}
        if self._suffix == ".gif":
            frames, options = self._in_palette(), {"optimize": False, "disposal": 1}
        first, *rest = frames
        options |= {"append_images": rest, "duration": durations, "loop": 0}
        first.save(self._part, save_all=True, **options)

    def _in_palette(self) -> list[Any]:
        """Returns the frames in 256 colours common to all, so that still parts do not flicker."""
        step = -(-len(self._frames) // _PALETTE_FRAMES)
        samples = [np.asarray(frame) for frame in self._frames[::step]]
        colors = self._image.fromarray(np.concatenate(samples)).quantize(256, kmeans=1)
        dither = self._image.Dither.FLOYDSTEINBERG
        return [frame.quantize(palette=colors, dither=dither) for frame in self._frames]
