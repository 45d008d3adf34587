"""`Video`: pictures to an H.264 file, through PyAV."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..pictures import Picture


class Video:
    """An .mp4 file that appears when it is whole."""

    def __init__(self, path: Path, width: int, height: int, *, fps: int = 25) -> None:
        """Opens it.

        Raises:
            ImportError: PyAV is missing.
            ValueError: A side is odd, which H.264 can't store.
        """
        try:
            import av
        except ImportError:
            raise ImportError(".mp4 needs PyAV: pip install 'gvtorch[video]'") from None
        if width % 2 or height % 2:
            raise ValueError(f"--size must be even for .mp4, got {width}x{height}")
        self._path, self._part = path, path.with_name(f".{path.stem}.part.mp4")
        self._file = av.open(str(self._part), "w")
        self._stream = self._file.add_stream("libx264", rate=fps)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "18"}

    def add(self, picture: Picture) -> None:
        """Appends a picture."""
        import av

        frame = av.VideoFrame.from_ndarray(picture.to_srgb8().numpy(), format="rgb24")
        self._file.mux(self._stream.encode(frame))

    def __enter__(self) -> Video:
        """Returns itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        """Finishes the file, or takes it away after a mistake."""
        try:
            if kind is None:
                self._file.mux(self._stream.encode())
        finally:
            self._file.close()
        if kind is None:
            os.replace(self._part, self._path)
        else:
            self._part.unlink(missing_ok=True)
